"""Images worked on elsewhere: by any executor, by a cluster; the same results, bit by bit."""

import os
import signal
import subprocess
import sys
from concurrent.futures import BrokenExecutor, Executor, Future, ThreadPoolExecutor

import pytest

from stcal.errors import DetectionError, InputError
from stcal.io.spread import spread
from stcal.parallel import run_parallel
from stcal.sfm import RunOptions, run
from stcal.workflows import cluster

RESULTS = ("faces.json", "labels.csv", "detections.csv")
CLUSTER = """
from distributed import LocalCluster
if __name__ == "__main__":
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        print(cluster.scheduler_address, *[each.pid for each in cluster.workers.values()], flush=True)
        input()
"""


def run_into(out, data, **more):
    run(data / "images", data / "cameras.txt", out, data / "target.toml", data / "board.toml", **more)
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


class Broken(Executor):
    """Has lost its workers."""

    def submit(self, function, /, *arguments, **_):
        future = Future()
        future.set_exception(BrokenExecutor("all workers lost"))
        return future


@pytest.fixture(scope="module")
def expected(small_dataset, tmp_path_factory):
    """Results by processes of this machine."""
    return run_into(tmp_path_factory.mktemp("here") / "run", small_dataset, options=RunOptions(workers=2))


def test_jobs_go_to_an_executor_a_few_at_a_time():
    with ThreadPoolExecutor(3) as pool:
        found = dict(run_parallel(pow, [(i, 2) for i in range(50)], executor=pool, at_once=4))
    assert found == {i: i * i for i in range(50)}


@pytest.mark.slow
@pytest.mark.parametrize("send", [False, True])
def test_a_run_by_an_executor_is_the_same(small_dataset, expected, tmp_path, send):
    executor = Here()
    with spread(executor, 3, send):
        assert run_into(tmp_path / "run", small_dataset) == expected
    assert executor.jobs
    assert all((job[0].content is not None) == send for job in executor.jobs)


def test_workers_that_are_lost_for_good_are_one_line(small_dataset, tmp_path):
    with spread(Broken()), pytest.raises(DetectionError, match=r"all workers lost.*finished detections are kept"):
        run_into(tmp_path / "run", small_dataset)


def test_no_scheduler_is_one_line(monkeypatch):
    monkeypatch.setattr(cluster, "ANSWER_S", 1)
    with pytest.raises(InputError, match="no scheduler answers"), cluster.dask_cluster("tcp://127.0.0.1:9"):
        pass


@pytest.mark.parametrize("address", ["nowhere", "http://x", "http://x:80", "", "tcp://x", "tcp://x:y", "\x1b[31m:1"])
def test_what_is_no_address_is_one_line(address):
    with pytest.raises(InputError, match="no address of a scheduler"), cluster.dask_cluster(address):
        pass


def test_workers_of_other_versions_are_refused():
    own = cluster.versions()
    cluster._require_same({"tcp://a": own}, "tcp://b")
    with pytest.raises(InputError, match=r"worker tcp://a has numpy 1\.0"):
        cluster._require_same({"tcp://a": own | {"numpy": "1.0"}}, "tcp://b")


@pytest.mark.slow
@pytest.mark.parametrize("send", [False, True])
def test_a_run_by_a_cluster_that_loses_a_worker_is_the_same(small_dataset, expected, tmp_path, send):
    script = tmp_path / "start.py"
    script.write_text(CLUSTER)
    started = subprocess.Popen([sys.executable, script], stdin=-1, stdout=-1, stderr=subprocess.DEVNULL, text=True)
    try:
        address, first, _ = started.stdout.readline().split()
        lost = []

        def lose(stage, done, _total):
            if stage == "detect" and done == 2 and not lost:
                os.kill(int(first), signal.SIGKILL)
                lost.append(done)

        with cluster.dask_cluster(address, send):
            assert run_into(tmp_path / "run", small_dataset, progress=lose) == expected
        assert lost
    finally:
        started.communicate("\n", timeout=60)
