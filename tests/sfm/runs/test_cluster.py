"""Images worked on elsewhere: by any executor, by a cluster; the same results, bit by bit. SIGINT and SIGTERM end every
command with one line, 130 and 143; earlier results stay."""

import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from pathlib import Path

import pytest

from stcal.io.images import ImageFile, run_on_images, spread
from stcal.parallel import hand_over
from stcal.sfm import RunOptions, run
from stcal.workflows import cluster
from tests.levels import sampled
from tests.outcome import fails_with
from tests.shared import own_copy

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


SFM = (sys.executable, "-P", "-c", "from stcal.cli.entry import main_sfm; main_sfm()")
SFM_SAYING_ON = (*SFM[:-1], "from stcal.cli.entry import main_sfm; print('on', flush=True); main_sfm()")
ENDS = [(signal.SIGTERM, "terminated", 143), (signal.SIGINT, "interrupted", 130)]
PROGRESS = ("detect: ", "overlays: ", "map: ", "faces: ", "check: ", "report: ", "working: ")


def ended(process, number) -> tuple[int, list[str]]:
    process.send_signal(number)
    _, err = process.communicate(timeout=60)
    return process.returncode, [line for line in err.splitlines() if not line.startswith(PROGRESS)]


@pytest.mark.parametrize(("number", "said", "code"), ENDS)
def test_while_libraries_load_and_where_python_forgets_exceptions(number, said, code):
    """The moment is when the entry module is there and the program's imports go on. Python prints and forgets
    exceptions in a finaliser: the signal is sent again, and what the command waits for ends."""
    begin = (
        "import sys; from stcal.cli import entry; entry._answer(); print('on', flush=True); import time; time.sleep(60)"
    )
    process = subprocess.Popen([sys.executable, "-P", "-c", begin], stdout=-1, stderr=-1, text=True)
    assert process.stdout.readline() == "on\n"
    assert ended(process, number) == (code, [said])
    begin = (
        "import signal, sys, time, typer, weakref; from stcal.cli import entry, main\n"
        "class A: pass\n"
        "def command():\n"
        "    a = A()\n"
        f"    kept = weakref.ref(a, lambda _: signal.raise_signal({int(number)}))\n"
        "    del a\n"
        "    time.sleep(30)\n"
        "main.app = typer.Typer(); main.app.command()(command); sys.argv[1:] = []; entry.main()"
    )
    done = subprocess.run([sys.executable, "-P", "-c", begin], capture_output=True, text=True, timeout=20, check=False)
    assert (done.returncode, done.stderr.splitlines()) == (code, [said])


def test_signals_after_the_answer_change_no_exit_code_and_colmaps_bindings_leave_them_as_they_were():
    """While Python ends itself; the results are in place."""
    for number in (signal.SIGTERM, signal.SIGINT):
        begin = f"import atexit, os; atexit.register(os.kill, os.getpid(), {int(number)}); {SFM[-1]}"
        found = subprocess.run(
            [sys.executable, "-P", "-c", begin, "--version"], capture_output=True, text=True, check=False
        )
        assert (found.returncode, found.stderr) == (0, "")
    begin = (
        "import signal, sys; signal.signal(signal.SIGTERM, lambda *_: sys.exit(7));"
        "import stcal.sfm.mapping.database; print('on', flush=True); signal.pause()"
    )
    process = subprocess.Popen([sys.executable, "-P", "-c", begin], stdout=-1, stderr=-1, text=True)
    assert process.stdout.readline() == "on\n"
    assert ended(process, signal.SIGTERM) == (7, [])


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_the_thread_that_says_what_a_command_is_at_takes_no_signal(number):
    """While COLMAP's bindings load, they wait in the main thread, and any other that took one would end the process."""
    begin = (
        "import os, signal, time; from stcal.cli.terminal import _Beat\n"
        f"signal.signal({int(number)}, signal.SIG_DFL); _Beat().start(); time.sleep(0.3)\n"
        f"signal.pthread_sigmask(signal.SIG_BLOCK, [{int(number)}]); os.kill(os.getpid(), {int(number)})\n"
        "time.sleep(0.3); print('on', flush=True); os._exit(7)"
    )
    found = subprocess.run(
        [sys.executable, "-P", "-c", begin],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
    )
    assert (found.returncode, found.stdout) == (7, "on\n")


@pytest.mark.parametrize(
    ("number", "said", "code", "seconds"),
    sampled([(*end, seconds) for end in ENDS for seconds in (0.5, 2.0, 5.0)], kept=(1, 5)),
)
def test_during_a_run(small_set, small_run, number, said, code, seconds):
    """Earlier results stay, no process of it is left that still writes, and the next run goes through."""
    small = small_set("12", "14", detected=False)
    own_copy(small_run, small.out)
    command = [*SFM, *map(str, small.arguments()), "--workers", "2"]
    before = (small.out / "faces.json").read_bytes()
    for path in (small.out / ".stcal/cache").glob("*.npz"):
        path.unlink()
    process = subprocess.Popen([*SFM_SAYING_ON, *command[len(SFM) :]], stdout=-1, stderr=-1, text=True)
    assert process.stdout.readline() == "on\n"  # until then a signal ends Python itself, with 1 and its own words
    time.sleep(seconds)
    code_found, lines = ended(process, number)
    if code_found != 0:  # a fast machine may be through
        assert code_found == code
        assert len(lines) == 1
        assert lines[0].startswith(said)
    assert (small.out / "faces.json").read_bytes() == before
    subprocess.run(command, check=True, capture_output=True)
    assert not (small.out / ".stcal/unfinished").exists()
    assert (small.out / "faces.json").read_bytes() == before
