"""Parallel execution of one function over many jobs, on all cores or by an executor, with BLAS on one thread, and
folders that end with their process."""

import contextlib
import itertools
import multiprocessing
import multiprocessing.context
import multiprocessing.util
import os
import shutil
import signal
import sys
import tempfile
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, ProcessPoolExecutor, wait
from contextvars import ContextVar
from functools import cache, cached_property
from multiprocessing import resource_tracker
from pathlib import Path
from typing import TypeVar

from stcal.errors import InputNote, environment, held

R = TypeVar("R")
Progress = Callable[[str, int, int], None]  # function that is called with (stage, done, total)
ONE_THREAD = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")
"""Variables from which libraries read their number of threads when they are loaded; worker processes have it 1."""
FOR_WORKERS: dict[str, str] = dict.fromkeys((*ONE_THREAD, "PYTHONSAFEPATH"), "1")
"""Environment of worker processes. The working folder might hold files with the names of modules."""
AT_ONCE = 4  # number of jobs that are handed over for each process, so that the next ones are there when one is done
_limited = threading.Lock()
_one_starts = threading.Lock()
LOCK = ".lock"  # file of a scratch folder; the system releases it when its process ends, in whatever way
YOUNG_S = 1.0  # age below which such a file may not be locked yet


@contextlib.contextmanager
def scratch_folder(name: str) -> Iterator[Path]:
    """Yields a new folder in the temporary folder, and removes it, and those of processes that were killed."""
    import filelock

    for left in Path(tempfile.gettempdir()).glob(f"stcal-*/{LOCK}"):
        with contextlib.suppress(OSError, filelock.Timeout):
            if time.time() - left.stat().st_mtime > YOUNG_S:
                with filelock.FileLock(left, timeout=0):
                    shutil.rmtree(left.parent, ignore_errors=True)
    folder = Path(tempfile.mkdtemp(prefix=f"stcal-{name}-"))
    try:
        with filelock.FileLock(folder / LOCK):
            own = folder / name  # empty, as the lock lies beside it
            own.mkdir()
            yield own
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def counted(progress: Progress, stage: str, total: int) -> Callable[[object], None]:
    """Reports to ``progress`` that nothing is done, and returns a function that reports one more job at each call."""
    done = itertools.count(1)
    progress(stage, 0, total)
    return lambda _: progress(stage, next(done), total)


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Limits BLAS and OpenMP to one thread in the context, or, as a decorator, ``@one_thread()``, during each call.
    The matrices here are small, or sparse: threads that wait for each other took most of a run's processor time.
    Only public functions set the limit, so that program and callers behave alike. A nested call, or one while
    another thread holds the limit, changes nothing: two that each restored the state before could leave it behind."""
    if not _limited.acquire(blocking=False):
        yield
        return
    try:
        from threadpoolctl import threadpool_limits  # takes 40 ms, which `stcal --version` need not wait for

        reserve_buffers()
        with threadpool_limits(1):
            yield
    finally:
        _limited.release()


@cache
def reserve_buffers() -> None:
    """Lets NumPy and SciPy take their working memory: without it OpenBLAS ends the process, or tries for ever."""
    import numpy as np
    import scipy.linalg

    np.linalg.inv(np.eye(2))
    scipy.linalg.cholesky(np.eye(2))


def run_parallel(
    function: Callable[..., R], jobs: Sequence[tuple], workers: int | None = None
) -> Iterator[tuple[int, R]]:
    """Yields (index of the job, result of ``function(*job)``) as results arrive, in any order. Processes are forked
    from a server that has loaded the libraries and has no threads, or spawned where the system cannot fork; they do
    not import the caller's main module. One worker, or one job, runs in this process; so does all work within a
    process of ``multiprocessing.Pool``. ``workers`` : one per core if None, or as :func:`kept_processes` has it."""
    kept = _kept.get()
    workers = min(kept.workers if kept else _number_of_processes(workers), len(jobs))
    if workers <= 1:
        for i, job in enumerate(jobs):
            yield i, function(*job)
        return
    with contextlib.nullcontext(kept) if kept else _Processes(workers) as processes:
        yield from hand_over(processes.pool, function, jobs, AT_ONCE * processes.workers)


def run_in_order(
    function: Callable[..., R],
    jobs: Sequence[tuple],
    workers: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[R]:
    """Returns the results of :func:`run_parallel` in the order of the jobs; jobs of a process that is ended from
    outside run in this one. ``progress`` is called with the numbers of jobs done and of all jobs."""
    results: dict[int, R] = {}
    here = ((i, function(*job)) for i, job in enumerate(jobs) if i not in results)
    for found in (run_parallel(function, jobs, workers), here):
        with contextlib.suppress(BrokenExecutor):
            for i, result in found:
                results[i] = result
                if progress:
                    progress(len(results), len(jobs))
    return [results[i] for i in range(len(jobs))]


def hand_over(
    executor: Executor, function: Callable[..., R], jobs: Iterable[tuple], at_once: int
) -> Iterator[tuple[int, R]]:
    """Yields index and result of each job, in any order; the executor has ``at_once`` of them at a time."""
    waiting: dict[Future[R], int] = {}
    remaining = enumerate(jobs)
    try:
        while True:
            with _starting():
                for i, job in itertools.islice(remaining, at_once - len(waiting)):
                    waiting[executor.submit(function, *job)] = i
            if not waiting:
                return
            for future in wait(waiting, return_when=FIRST_COMPLETED).done:
                yield waiting.pop(future), future.result()
    except BrokenExecutor:  # a pool ends its futures itself; cancelling them would break its thread
        raise
    except BaseException:
        for future in waiting:
            future.cancel()
        raise


class _Processes:
    def __init__(self, workers: int):
        self.workers = workers
        self._others = multiprocessing.active_children()

    @cached_property
    def pool(self) -> ProcessPoolExecutor:
        with _starting():
            return ProcessPoolExecutor(self.workers, _context(), _follow_parent, (_sockets(),))

    def __enter__(self) -> "_Processes":
        return self

    def __exit__(self, kind: type[BaseException] | None, *_) -> None:
        if "pool" not in vars(self):
            return
        if kind is not None and not issubclass(kind, Exception):  # asked to end: half-done work is of no use
            for process in multiprocessing.active_children():
                if process not in self._others:
                    process.terminate()
        # also after that: at the end of the interpreter the pool's thread must not be closing what is woken there
        self.pool.shutdown(wait=True, cancel_futures=True)


_kept: ContextVar[_Processes | None] = ContextVar("kept processes", default=None)


@contextlib.contextmanager
def kept_processes(workers: int | None = None) -> Iterator[None]:
    """Keeps the processes of :func:`run_parallel` from call to call, so that libraries are loaded only once."""
    if _kept.get():
        yield
        return
    with _Processes(_number_of_processes(workers)) as processes, held(_kept, processes):
        yield


def _cores() -> int:
    """Returns the number of cores that this process may use, of which a container or a queue may give it some alone."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _number_of_processes(workers: int | None) -> int:
    wanted = workers or _cores()
    if wanted > 1 and multiprocessing.current_process().daemon:
        note = "a process of multiprocessing.Pool may start no others: one process works, more slowly"
        warnings.warn(note, InputNote, stacklevel=2)
        return 1
    return wanted


def load_ahead(workers: int | None = None) -> None:
    """Starts the server of processes, which loads their libraries while this process goes on."""
    if (workers or _cores()) > 1:
        with _starting():
            _context()


def _context() -> multiprocessing.context.BaseContext:
    """Returns the way to start processes, a server that loads the libraries, or spawn; within :func:`_starting`."""
    _sockets()
    if "forkserver" in multiprocessing.get_all_start_methods():
        from multiprocessing.forkserver import ensure_running

        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload(["stcal.sfm.pipeline"])  # without effect if a server is running
        # The server may be of the process that forked this one, or TMPDIR too long a name for its socket.
        with contextlib.suppress(OSError):
            ensure_running()
            return context
    return multiprocessing.get_context("spawn")


@cache
def _sockets() -> str:
    """Returns the folder of the server's sockets, which workers remove, or the next process, if this one is killed."""
    kept = contextlib.ExitStack()
    folder = kept.enter_context(scratch_folder("mp"))
    multiprocessing.util.Finalize(None, kept.close, exitpriority=-200)  # after multiprocessing has removed its own
    before, tempfile.tempdir = tempfile.tempdir, str(folder)
    try:
        multiprocessing.util.get_temp_dir()
    finally:
        tempfile.tempdir = before
    return str(folder.parent)


@contextlib.contextmanager
def _starting() -> Iterator[None]:
    """Prepares the start of processes, by one thread at a time, and leaves all that it changes as it was."""
    main = vars(sys.modules["__main__"])
    with _one_starts, _deaf_to_interrupts(), environment(FOR_WORKERS):
        hidden = {name: main[name] for name in ("__file__", "__spec__") if name in main}
        undecided = multiprocessing.get_start_method(allow_none=True) is None
        main.update(dict.fromkeys(hidden))
        try:
            yield
        finally:
            main.update(hidden)
            if undecided:  # the start of a process asks for the default method, which then could not be set any more
                multiprocessing.set_start_method(None, force=True)


@contextlib.contextmanager
def _deaf_to_interrupts():
    """Hides Ctrl-C from processes that start in the context; SIGINT and SIGTERM here wait for its end."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    received: list[int] = []
    ends = (signal.SIGINT, signal.SIGTERM)
    handlers = {number: signal.signal(number, lambda number, _: received.append(number)) for number in ends}
    if sys.platform != "win32":
        resource_tracker.ensure_running()  # its start would let Ctrl-C through again
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # new processes inherit it
    try:
        yield
    finally:
        if sys.platform != "win32":
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        for number, handler in handlers.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
        for number in received[:1]:
            signal.raise_signal(number)


def _follow_parent(folder: str) -> None:
    """Lets a worker leave Ctrl-C to the parent, and end, without its ``folder`` of sockets, if that is killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    reserve_buffers()
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def watch() -> None:
        parent.join()
        shutil.rmtree(folder, ignore_errors=True)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
