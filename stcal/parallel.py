"""Parallel execution of one function over many jobs, on all cores or by an executor, with BLAS on one thread."""

import contextlib
import itertools
import multiprocessing
import multiprocessing.context
import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    Executor,
    Future,
    ProcessPoolExecutor,
    as_completed,
    wait,
)
from contextvars import ContextVar
from functools import cache
from typing import TypeVar

from stcal.errors import InputNote

R = TypeVar("R")
Progress = Callable[[str, int, int], None]
"""Function that is called with (stage, done, total)."""
ONE_THREAD = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")
"""Variables from which libraries read their number of threads when they are loaded; parallel processes set it to 1."""
LOADED_ONCE = "stcal.one_thread", "stcal.sfm.pipeline"
"""Modules that are loaded, with all their imports, before processes are forked."""
_limited = threading.Lock()
_one_starts = threading.Lock()


def counted(progress: Progress, stage: str, total: int) -> Callable[[object], None]:
    """Reports to ``progress`` that nothing is done, and returns a function that reports one more job at each call."""
    done = itertools.count(1)
    progress(stage, 0, total)
    return lambda _: progress(stage, next(done), total)


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Limits BLAS and OpenMP to one thread in the context; as a decorator, ``@one_thread()``, during each call.

    The matrices here are small, or sparse: threads that wait for each other took the larger part of a run's processor
    time. The limit is set in the heavy public functions, not at the start of the program. The program and a caller from
    Python thus behave alike, libraries that are loaded later are limited too, and the limit is gone when the function
    returns. A nested call, or one while another thread holds the limit, changes nothing: two calls that
    each restored the previous state could leave the limit behind.
    """
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


def run_parallel(
    function: Callable[..., R],
    jobs: Sequence[tuple],
    workers: int | None = None,
    executor: Executor | None = None,
    at_once: int | None = None,
) -> Iterator[tuple[int, R]]:
    """Yields (index of the job, result of ``function(*job)``) as results arrive, in any order.

    Processes are forked from a server that has loaded the libraries and has no threads (forking a process with threads
    can hang). They are spawned if the system cannot fork. They do not import the caller's main module, so that a script
    needs no ``if __name__ == "__main__"``. One worker, or one job, runs in this process; so does all work within a
    process of ``multiprocessing.Pool``, which may start no others: a note says so.

    Parameters
    ----------
    workers : int, optional
        Number of processes; one per core if None. Within :func:`kept_processes`, its number counts.
    executor : concurrent.futures.Executor, optional
        Executor that runs the jobs instead of processes of this module. It is left open.
    at_once : int, optional
        Number of jobs that are handed to the executor at a time; all of them if None.
    """
    if executor is not None:
        yield from _handed_over(executor, function, jobs, at_once or len(jobs))
        return
    kept = _kept.get()
    workers = min(kept.workers if kept else _number_of_processes(workers), len(jobs))
    if workers <= 1:
        for i, job in enumerate(jobs):
            yield i, function(*job)
        return
    with contextlib.nullcontext(kept) if kept else _Processes(workers) as processes:
        yield from processes.run(function, jobs)


def run_briefly(
    function: Callable[..., R], jobs: Sequence[tuple], step: Callable[[object], None] | None = None
) -> list[R]:
    """Returns the results of ``function(*job)`` in the order of the jobs, for jobs of about a tenth of a second each.

    The jobs run in the processes of :func:`kept_processes` if there are any, else in this process; one job alone runs
    in this process. ``step`` : called with each result as it arrives, in any order
    """
    processes, results = _kept.get(), dict[int, R]()
    if processes and processes.workers > 1 and len(jobs) > 1:
        # If a process is ended from outside, the other jobs run in this process, more slowly.
        with contextlib.suppress(BrokenExecutor):
            for i, result in processes.run(function, jobs):
                results[i] = result
                if step:
                    step(result)
    for i, job in enumerate(jobs):
        if i not in results:
            results[i] = function(*job)
            if step:
                step(results[i])
    return [results[i] for i in range(len(jobs))]


def run_in_order(
    function: Callable[..., R],
    jobs: Sequence[tuple],
    workers: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[R]:
    """Returns the results of :func:`run_parallel` in the order of the jobs. ``progress`` : called with the number of
    jobs done, and the number of all jobs."""
    results = {}
    for i, result in run_parallel(function, jobs, workers):
        results[i] = result
        if progress:
            progress(len(results), len(jobs))
    return [results[i] for i in range(len(jobs))]


@contextlib.contextmanager
def kept_processes(workers: int | None = None) -> Iterator[None]:
    """Keeps the processes of :func:`run_parallel` from call to call, so that libraries are loaded only once.

    ``workers`` : number of processes, one per core if None; they start when they are first needed.
    """
    if _kept.get():
        yield
        return
    with _Processes(_number_of_processes(workers)) as processes:
        token = _kept.set(processes)
        try:
            yield
        finally:
            _kept.reset(token)


def _number_of_processes(workers: int | None) -> int:
    wanted = workers or os.cpu_count() or 1
    if wanted > 1 and multiprocessing.current_process().daemon:
        note = "a process of multiprocessing.Pool may start no others: one process works, more slowly"
        warnings.warn(note, InputNote, stacklevel=2)
        return 1
    return wanted


class _Processes:
    """Pool of processes that starts with the first job and ends with the context."""

    def __init__(self, workers: int):
        self.workers = workers
        self._pool: ProcessPoolExecutor | None = None
        self._others = multiprocessing.active_children()

    def _start(self) -> ProcessPoolExecutor:
        if self._pool is None:
            self._pool = ProcessPoolExecutor(self.workers, _context(), initializer=_follow_parent)
        return self._pool

    def run(self, function: Callable[..., R], jobs: Sequence[tuple]) -> Iterator[tuple[int, R]]:
        """Yields index and result of each job, in any order."""
        with _starting():
            pool = self._start()
            futures = {pool.submit(function, *job): i for i, job in enumerate(jobs)}
        try:
            for future in as_completed(futures):
                yield futures[future], future.result()
        except BrokenExecutor:  # the pool ends its futures itself; cancelling them would break its thread
            raise
        except (Exception, GeneratorExit):
            for future in futures:
                future.cancel()
            raise

    def __enter__(self) -> "_Processes":
        return self

    def __exit__(self, kind: type[BaseException] | None, *_) -> None:
        if self._pool is None:
            return
        asked_to_end = kind is not None and not issubclass(kind, Exception)  # half-done work is of no use
        if asked_to_end:
            for process in multiprocessing.active_children():
                if process not in self._others:
                    process.terminate()
        # also after that: at the end of the interpreter the pool's thread must not be closing what is woken there
        self._pool.shutdown(wait=True, cancel_futures=True)


_kept: ContextVar[_Processes | None] = ContextVar("kept processes", default=None)


@contextlib.contextmanager
def _starting() -> Iterator[None]:
    """Prepares the start of processes, by one thread at a time, and leaves all that it changes as it was."""
    with _one_starts, _plain_main(), _deaf_to_interrupts():
        undecided = multiprocessing.get_start_method(allow_none=True) is None
        try:
            yield
        finally:
            if undecided:  # the start of a process asks for the default method, which then could not be set any more
                multiprocessing.set_start_method(None, force=True)


@cache
def reserve_buffers() -> None:
    """Lets both libraries of linear algebra, NumPy's and SciPy's, take their working memory, which they keep.

    OpenBLAS takes it at the first call that needs it. Where it then gets none, it ends the process, or tries for ever.
    """
    import numpy as np
    import scipy.linalg

    np.linalg.inv(np.eye(2))
    scipy.linalg.cholesky(np.eye(2))


def load_ahead(workers: int | None = None) -> None:
    """Starts the server of processes, which loads their libraries while this process goes on."""
    if (workers or os.cpu_count() or 1) > 1:
        with _starting():
            _context()


def _context() -> multiprocessing.context.BaseContext:
    """Returns the way to start processes: a server without threads that loads the libraries, which it starts, or spawn.

    To be called within :func:`_starting`.
    """
    if "forkserver" in multiprocessing.get_all_start_methods():
        from multiprocessing.forkserver import ensure_running

        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload([*LOADED_ONCE])  # without effect if a server is running
        # The server may be of the process that forked this one, or TMPDIR too long a name for its socket.
        with contextlib.suppress(OSError):
            ensure_running()
            return context
    return multiprocessing.get_context("spawn")


def _handed_over(executor: Executor, function, jobs: Sequence[tuple], at_once: int) -> Iterator[tuple[int, R]]:
    waiting: dict[Future, int] = {}
    remaining = iter(range(len(jobs)))
    try:
        while True:
            for i in itertools.islice(remaining, at_once - len(waiting)):
                waiting[executor.submit(function, *jobs[i])] = i
            if not waiting:
                return
            for future in wait(waiting, return_when=FIRST_COMPLETED).done:
                yield waiting.pop(future), future.result()
    finally:
        for future in waiting:
            future.cancel()


@contextlib.contextmanager
def _deaf_to_interrupts():
    """Lets processes that start in the context ignore Ctrl-C from their first moment, not only after their imports.

    SIGTERM is delayed: a process whose parent ends before it has read its task prints a stack on the terminal.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    received: list[int] = []
    handlers = [(signal.SIGINT, signal.signal(signal.SIGINT, signal.SIG_IGN))]
    handlers.append((signal.SIGTERM, signal.signal(signal.SIGTERM, lambda number, _: received.append(number))))
    try:
        yield
    finally:
        for number, handler in handlers:
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
        for number in received[:1]:
            signal.raise_signal(number)


def _follow_parent() -> None:
    """Lets a worker leave Ctrl-C to the parent, which stops the pool in order, and end when the parent is killed.

    Libraries that it loads have one thread.
    """
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


@contextlib.contextmanager
def _plain_main():
    """Hides the main module's file and the working folder from new processes.

    The working folder might hold files with the names of modules.
    """
    main = sys.modules["__main__"]
    hidden = {name: getattr(main, name) for name in ("__file__", "__spec__") if getattr(main, name, None) is not None}
    before = os.environ.get("PYTHONSAFEPATH")
    for name in hidden:
        setattr(main, name, None)
    os.environ["PYTHONSAFEPATH"] = "1"
    try:
        yield
    finally:
        for name, value in hidden.items():
            setattr(main, name, value)
        if before is None:
            os.environ.pop("PYTHONSAFEPATH", None)
        else:
            os.environ["PYTHONSAFEPATH"] = before
