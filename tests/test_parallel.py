"""Threads of BLAS: one while heavy functions work, and in each worker; processes, and what is left of them."""

import multiprocessing
import os
import subprocess
import sys
import tempfile
import time
import warnings
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from threadpoolctl import threadpool_info

from stcal.parallel import ONE_THREAD, kept_processes, run_in_order, run_parallel, scratch_folder

UNLIMITED = {name: value for name, value in os.environ.items() if name not in ONE_THREAD}
CORES = str(len(os.sched_getaffinity(0)))  # OpenBLAS begins as many threads


def threads() -> set[int]:
    assert np.eye(1) == 1
    return {library["num_threads"] for library in threadpool_info()}


BEGIN = """
import threading
import numpy, scipy.linalg
from threadpoolctl import threadpool_info
from stcal.parallel import kept_processes, one_thread, run_parallel
from tests.test_parallel import threads
def say():
    print(*{library["num_threads"] for library in threadpool_info()}, end=" ")
"""
LIMIT = """
say()
try:
    with one_thread():
        say()
        one_thread()(say)()
        say()
        raise ValueError
except ValueError:
    say()
"""
SEVERAL_THREADS = """
began, first_ended = threading.Event(), threading.Event()
def second():
    with one_thread():
        say()
        began.set()
        first_ended.wait(10)
def first():
    with one_thread():
        other.start()
        began.wait(10)
    first_ended.set()
other = threading.Thread(target=second)
first()
other.join()
say()
"""
NOTHING_LEFT = """
import asyncio, ctypes, multiprocessing, os, signal, sys, warnings
import stcal.sfm.data.group_model  # loads libraries with filters of warnings of their own

system = ctypes.CDLL(None)
def handler_of(number):
    action = ctypes.create_string_buffer(1024)
    system.sigaction(int(number), None, action)
    restorer = 0x04000000  # of the C library, which sets it with whatever handler
    return action.raw[:16], int.from_bytes(action.raw[136:140], "little") & ~restorer  # with the mask's filled part
def state():
    main = sys.modules["__main__"]
    return {
        "environment": dict(os.environ),
        "main": (getattr(main, "__file__", None), main.__spec__),
        "handlers": {n: (signal.getsignal(n), handler_of(n)) for n in signal.valid_signals()},
        "start method": multiprocessing.get_start_method(allow_none=True),
        "warnings": list(warnings.filters),
        "threads": sorted((each["filepath"], each["num_threads"]) for each in threadpool_info() if each in known),
    }
@one_thread()
def work(fails=False):
    with kept_processes(2):
        dict(run_parallel(pow, [(2, 3)] * 4))
        import stcal.sfm.mapping.database
        if fails:
            raise ValueError
def in_threads():
    both = [threading.Thread(target=work) for _ in range(2)]
    [each.start() for each in both]
    [each.join() for each in both]
def failing():
    try:
        work(fails=True)
    except ValueError:
        pass
answered = []
signal.signal(signal.SIGTERM, lambda *_: answered.append("answered"))
known = threadpool_info()
before = state()
ways = [lambda: asyncio.run(asyncio.to_thread(work)), in_threads, work, failing]
for way in ways:
    way()
    after = state()
    print(*(name.replace(" ", "-") for name in before if before[name] != after[name]) , end=" ")
signal.raise_signal(signal.SIGTERM)
print(*answered, end=" ")
"""
WORKERS = """
print(*(number for _, found in run_parallel(threads, [(), ()], 2) for number in found))
"""


@pytest.fixture(scope="module")
def said() -> dict[str, list[str]]:
    """What each of the programs says in a process whose number of threads nobody limits."""
    programs = (LIMIT, SEVERAL_THREADS, NOTHING_LEFT, WORKERS)
    code = "\nprint()\n".join([BEGIN, *programs])
    done = subprocess.run([sys.executable, "-c", code], env=UNLIMITED, capture_output=True, text=True, check=True)
    return dict(zip(programs, map(str.split, done.stdout.splitlines()[1:]), strict=True))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("program", "answer"),
    [
        pytest.param(LIMIT, [CORES, "1", "1", "1", CORES], id="the limit ends with the outermost call or an error"),
        # The first to begin is the first to end; the second found one thread, and must not restore that.
        pytest.param(SEVERAL_THREADS, ["1", CORES], id="calls of several threads leave no limit behind"),
        pytest.param(WORKERS, ["1", "1"], id="workers have one thread"),
        # By the first work of a process, in a thread of asyncio; by two threads at once; the main one; after an error.
        pytest.param(NOTHING_LEFT, ["answered"], id="nothing is left behind"),
    ],
)
def test_threads_and_what_is_left_of_them(said, program, answer):
    assert threads() == {1}
    assert said[program] == answer


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")  # what it is about
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_a_process_of_a_pool_works_alone_and_a_forked_one_starts_its_own():
    """The server of the process that forked it answers that one alone."""
    with multiprocessing.get_context("fork").Pool(1) as pool:
        found, notes = pool.apply(in_a_pool)
    assert found == [(0, 8), (1, 8)]
    assert notes == ["a process of multiprocessing.Pool may start no others: one process works, more slowly"]
    dict(run_parallel(process, [(0,), (1,)], 2))
    with ProcessPoolExecutor(1, multiprocessing.get_context("fork")) as pool:
        assert pool.submit(in_a_pool).result(60) == ([(0, 8), (1, 8)], [])


def in_a_pool() -> tuple[list, list[str]]:
    with warnings.catch_warnings(record=True) as noted:
        warnings.simplefilter("always")
        with kept_processes(2):
            found = sorted(run_parallel(pow, [(2, 3)] * 2))
    return found, [str(note.message) for note in noted]


def process(_) -> int:
    time.sleep(0.05)  # so that one alone does not do all
    return os.getpid()


@pytest.mark.slow
def test_processes_are_kept_from_call_to_call_also_after_an_error():
    with kept_processes(2):
        first = set(run_in_order(process, [(i,) for i in range(6)]))
        with pytest.raises(ZeroDivisionError):
            dict(run_parallel(divmod, [(1, 0), (2, 0)]))
        assert set(run_in_order(process, [(i,) for i in range(6)], 1)) == first
    assert len(first) == 2
    assert run_in_order(process, [(0,), (1,)], 1) == [os.getpid()] * 2
    assert not multiprocessing.active_children()


def end_elsewhere(parent: int) -> int:
    """As a process ends that takes more memory than there is."""
    if os.getpid() != parent:
        os._exit(1)
    return parent


def test_work_goes_on_here_when_a_process_is_ended_and_processes_end_when_it_is_broken_off():
    done = []
    with kept_processes(2):
        assert (
            run_in_order(end_elsewhere, [(os.getpid(),)] * 4, progress=lambda *at: done.append(at)) == [os.getpid()] * 4
        )
    assert done == [(1, 4), (2, 4), (3, 4), (4, 4)]

    def broken_off():
        with kept_processes(2):
            dict(run_parallel(process, [(0,), (1,)]))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        broken_off()
    for child in multiprocessing.active_children():
        child.join(10)
    assert not multiprocessing.active_children()


@pytest.mark.slow
def test_files_beside_the_user_are_no_modules(tmp_path):
    """A folder with files named like libraries, where a program works in several processes."""
    for name in ("numpy", "scipy", "stcal"):
        (tmp_path / f"{name}.py").write_text("raise RuntimeError('not this one')\n")
    script = tmp_path / "elsewhere" / "go.py"
    script.parent.mkdir()
    script.write_text(
        "from stcal.parallel import load_ahead, run_parallel\n"
        "load_ahead()\n"
        "print(sorted(run_parallel(pow, [(2, 3)] * 2, 2)))\n"
    )
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run([sys.executable, script], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert (done.stdout, done.stderr) == ("[(0, 8), (1, 8)]\n", "")


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="/proc")
def test_a_killed_program_leaves_no_process_and_no_file(tmp_path):
    code = (
        "import tests.test_parallel as t\n"
        "with t.kept_processes(2):\n"
        "    print(*set(t.run_in_order(t.process, [(i,) for i in range(6)])), flush=True)\n"
        "    t.run_in_order(t.time.sleep, [(60,)] * 2)\n"
    )
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    with subprocess.Popen([sys.executable, "-c", code], stdout=-1, text=True, env=environment) as started:
        assert started.stdout is not None
        workers = started.stdout.readline().split()
        assert any(tmp_path.iterdir())
        started.kill()
    until = time.monotonic() + 20
    while time.monotonic() < until and (any(map(is_alive, workers)) or any(tmp_path.iterdir())):
        time.sleep(0.05)
    assert not any(map(is_alive, workers))
    assert not any(tmp_path.iterdir())


def is_alive(number: str) -> bool:
    try:
        return Path(f"/proc/{number}/stat").read_text().split()[2] != "Z"
    except OSError:
        return False


@pytest.mark.skipif(sys.platform == "win32", reason="no limits of memory")
def test_linear_algebra_takes_its_memory_before_there_is_none():
    """OpenBLAS would end the process, or ask for ever."""
    code = """
import resource
import numpy as np, scipy.linalg
from stcal.parallel import one_thread
with one_thread():
    used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + (16 << 20),) * 2)
    square = np.eye(300) + 1
    print(scipy.linalg.cholesky(square).shape, np.linalg.inv(square @ square).shape)
"""
    done = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, timeout=20, check=True)
    assert done.stdout == "(300, 300) (300, 300)\n"


HELD = """
import sys, time
from stcal.parallel import _sockets, scratch_folder
with scratch_folder("run") as folder:
    (folder / "image.npz").touch()
    _sockets()
    print("ready", flush=True)
    time.sleep(60)
"""


def test_the_next_process_removes_what_a_killed_one_left(tmp_path, monkeypatch):
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    with subprocess.Popen([sys.executable, "-c", HELD], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        process.kill()
    left = [path.parent for path in tmp_path.glob("stcal-*/.lock")]
    assert len(left) == 2
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with scratch_folder("other"):  # too young: it might not be locked yet
        assert all(folder.exists() for folder in left)
    for folder in left:
        os.utime(folder / ".lock", (0, 0))
    with scratch_folder("one") as one:
        os.utime(one.parent / ".lock", (0, 0))
        with scratch_folder("two"):
            assert one.exists()  # its process lives
    assert not list(tmp_path.iterdir())
