"""Images worked on elsewhere: by any executor, by a cluster; the same results, bit by bit."""

import contextlib
import os
import signal
import socket
import subprocess
import sys
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from pathlib import Path

import pytest

from stcal.io.images import ImageFile, run_on_images, spread
from stcal.parallel import hand_over
from stcal.sfm import RunOptions, run
from stcal.workflows import cluster
from tests.levels import sampled
from tests.outcome import fails_with

pytestmark = pytest.mark.usefixtures("no_page")
RESULTS = ("faces.json", "labels.csv")
CLUSTER = """
from distributed import LocalCluster
if __name__ == "__main__":
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        print(cluster.scheduler_address, *[each.pid for each in cluster.workers.values()], flush=True)
        input()
"""


def run_into(out, small, **more):
    """Of one group, chained: faces and labels."""
    run(small.images, small.camera, out, options=RunOptions(solve="chain"), **more)
    return {name: (out / name).read_bytes() for name in RESULTS}


class Here(Executor):
    """Runs jobs at once, and remembers what it was given."""

    def __init__(self):
        self.jobs = []

    def submit(self, function, /, *arguments, **_):
        self.jobs.append(arguments)
        future = Future()
        future.set_result(function(*arguments))
        return future


def test_jobs_go_to_an_executor_a_few_at_a_time_and_processes_that_end_are_one_line(tmp_path, monkeypatch):
    """Paths go to workers from the root; folders that they do not see are one line, too."""
    with ThreadPoolExecutor(3) as pool:
        found = dict(hand_over(pool, pow, [(i, 2) for i in range(50)], 4))
    assert found == {i: i * i for i in range(50)}
    monkeypatch.chdir(tmp_path)
    with spread(Here(), 3):
        assert dict(run_on_images(lambda file: file.path, [(ImageFile(Path("a.jpg"), "a.jpg", "."),)])) == {
            0: tmp_path / "a.jpg"
        }
    with fails_with("E-WORKER-DIED … 2"):
        dict(run_on_images(end, [(1,), (2,)], 2))
    file = ImageFile(tmp_path / "elsewhere" / "a.jpg", "a.jpg", ".")
    with spread(Here(), 3), fails_with("E-WORKER-PATH … elsewhere … --send-images"):
        dict(run_on_images(len, [(file,)]))


def end(_):
    """As a process ends that takes more memory than there is."""
    os._exit(1)


@pytest.mark.slow
@pytest.mark.parametrize("somebody", [False, True])
def test_no_scheduler_is_one_line(monkeypatch, somebody):
    """Nobody listens, or somebody listens and says nothing."""
    monkeypatch.setattr(cluster, "ANSWER_S", 1)
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        if somebody:
            listening.listen()
        address = f"tcp://127.0.0.1:{listening.getsockname()[1]}"
        with fails_with("E-CLUSTER-SCHEDULER"), cluster.dask_cluster(address):
            pass


def test_what_is_no_address_and_workers_of_other_versions_are_refused():
    for address in ("http://x:80", "", "tcp://x", "tcp://x:y", "\x1b[31m:1"):
        with fails_with("E-OPTION-VALUE"), cluster.dask_cluster(address):
            pass
    own = cluster.versions()
    cluster._require_same({"tcp://a": own}, "tcp://b")
    with fails_with("E-CLUSTER-VERSIONS … tcp://a … numpy 1.0"):
        cluster._require_same({"tcp://a": own.replace("numpy", "numpy 1.0,")}, "tcp://b")


@contextlib.contextmanager
def two_workers(folder):
    """Address of a scheduler in a process of its own, and the numbers of that process and of its workers'."""
    script = folder / "start.py"
    script.write_text(CLUSTER)
    started = subprocess.Popen([sys.executable, script], stdin=-1, stdout=-1, stderr=subprocess.DEVNULL, text=True)
    try:
        address, *workers = started.stdout.readline().split()
        yield address, started.pid, [int(each) for each in workers]
    finally:
        with contextlib.suppress(BrokenPipeError):
            started.communicate("\n", timeout=60)


def killing(process):
    """A progress that kills a process when two images are done, and the list of what it did."""
    killed = []

    def progress(stage, done, _total):
        if stage == "detect" and done == 2 and not killed:
            os.kill(process, signal.SIGKILL)
            killed.append(process)

    return progress, killed


@pytest.mark.parametrize("send", sampled([False, True]))
def test_a_run_by_a_cluster_that_loses_a_worker_is_the_same_and_without_its_scheduler_ends_in_one_line(
    small_set, tmp_path, send
):
    small = small_set("12")
    expected = run_into(small.out, small)
    with two_workers(tmp_path) as (address, scheduler, workers):
        progress, killed = killing(workers[0])
        with cluster.dask_cluster(address, send):
            assert run_into(tmp_path / "run", small, progress=progress) == expected
        assert killed
        progress, killed = killing(scheduler)
        with fails_with(f"E-WORKER-DIED … {address}"), cluster.dask_cluster(address):
            run_into(tmp_path / "other", small, progress=progress)
        assert killed
