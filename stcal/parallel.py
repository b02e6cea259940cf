"""Run one function over many jobs on all cores, or by any executor, and BLAS on one."""

import contextlib
import itertools
import multiprocessing
import multiprocessing.context
import os
import signal
import sys
import threading
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
from importlib import import_module
from operator import itemgetter
from typing import TypeVar

R = TypeVar("R")
Progress = Callable[[str, int, int], None]
"""Called with (stage, done, total)."""
ONE_THREAD = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")
"""Libraries take their number of threads from these when they are loaded; processes side by side need one each."""
LOADED_ONCE = "stcal.sfm.pipeline"
"""Module that is loaded before processes are forked, with all that it imports."""
_limited = threading.Lock()
_one_starts = threading.Lock()


def counted(progress: Progress, stage: str, total: int) -> Callable[[object], None]:
    """Tell ``progress`` that nothing is done, and, at each call of what is returned, that one more is."""
    done = itertools.count(1)
    progress(stage, 0, total)
    return lambda _: progress(stage, next(done), total)


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Keep BLAS and OpenMP to one thread meanwhile; as a decorator, ``@one_thread()``, during each call.

    The matrices here are small, or sparse: threads that wait for each other took the larger part of a run's processor
    time. The limit stands at the heavy public functions, not at the program's start: the program and a caller from
    Python get the same, libraries that are loaded after the start are limited too, and the caller's own process is as
    before when the function returns. Calls inside another, or while one of another thread lasts, leave it to that one:
    two that each restored what they had found could leave the limit behind.
    """
    if not _limited.acquire(blocking=False):
        yield
        return
    try:
        from threadpoolctl import threadpool_limits  # 40 ms that `stcal --version` need not wait for

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
    """Yield (index of the job, result of ``function(*job)``) as results come in, in any order.

    Processes are forked from a server that has loaded the libraries and has no threads (forking one with threads can
    hang), or started afresh where the system cannot; they do not import the caller's main module, so that a script
    needs no ``if __name__ == "__main__"``. One worker, or one job, runs right here.

    Parameters
    ----------
    workers : int, optional
        Processes; one per core where None. As many as :func:`kept_processes` says, within it.
    executor : concurrent.futures.Executor, optional
        Runs the jobs in place of processes of our own, and is left open.
    at_once : int, optional
        So many jobs are handed to the executor at a time; all of them where None.
    """
    if executor is not None:
        yield from _handed_over(executor, function, jobs, at_once or len(jobs))
        return
    workers = min(workers or os.cpu_count() or 1, len(jobs))
    if workers <= 1:
        for i, job in enumerate(jobs):
            yield i, function(*job)
        return
    kept = _kept.get()
    with contextlib.nullcontext(kept) if kept else _Processes(workers) as processes:
        yield from processes.run(function, jobs)


def run_briefly(function: Callable[..., R], jobs: Sequence[tuple]) -> list[R]:
    """Results of ``function(*job)`` in the order of the jobs, of a tenth of a second each: by several processes where
    :func:`kept_processes` keeps them, else right here."""
    kept = _kept.get()
    if kept and kept.workers > 1:
        try:
            return [result for _, result in sorted(kept.run(function, jobs), key=itemgetter(0))]
        except BrokenExecutor:  # a process was ended from outside: it goes on here, and takes longer
            pass
    return [function(*job) for job in jobs]


@contextlib.contextmanager
def kept_processes(workers: int | None = None) -> Iterator[None]:
    """Keep the processes of :func:`run_parallel` from call to call, so that libraries are loaded once; so many of them,
    one per core where None, started when they are first needed."""
    if _kept.get():
        yield
        return
    with _Processes(workers or os.cpu_count() or 1) as processes:
        token = _kept.set(processes)
        try:
            yield
        finally:
            _kept.reset(token)


class _Processes:
    """Processes of our own, started when the first job comes; they end with the context."""

    def __init__(self, workers: int):
        self.workers = workers
        self._pool: ProcessPoolExecutor | None = None
        self._others = multiprocessing.active_children()

    def _start(self) -> ProcessPoolExecutor:
        if self._pool is None:
            self._pool = ProcessPoolExecutor(self.workers, _context(), initializer=_follow_parent)
        return self._pool

    def run(self, function: Callable[..., R], jobs: Sequence[tuple]) -> Iterator[tuple[int, R]]:
        """Index and result of each job, in any order."""
        with _plain_main(), _deaf_to_interrupts():
            pool = self._start()
            futures = {pool.submit(function, *job): i for i, job in enumerate(jobs)}
        try:
            for future in as_completed(futures):
                yield futures[future], future.result()
        except BrokenExecutor:  # the pool itself ends its futures; cancelled ones would break its thread
            raise
        except (Exception, GeneratorExit):
            for future in futures:
                future.cancel()
            raise

    def everywhere(self, function: Callable, arguments: tuple) -> None:
        """Begin the same in every process, as far as they are idle."""
        with _plain_main(), _deaf_to_interrupts():
            for _ in range(self.workers):
                self._start().submit(function, *arguments)

    def __enter__(self) -> "_Processes":
        return self

    def __exit__(self, kind: type[BaseException] | None, *_) -> None:
        if self._pool is None:
            return
        asked_to_end = kind is not None and not issubclass(kind, Exception)  # what is half done is of no use
        self._pool.shutdown(wait=not asked_to_end, cancel_futures=True)
        if asked_to_end:
            for process in multiprocessing.active_children():
                if process not in self._others:
                    process.terminate()


def load_in_processes(*modules: str) -> None:
    """Load modules in the processes that :func:`kept_processes` keeps, while this one goes on."""
    kept = _kept.get()
    if kept and kept.workers > 1:
        with contextlib.suppress(BrokenExecutor):
            kept.everywhere(_load, modules)


def _load(*modules: str) -> None:
    for name in modules:
        import_module(name)


_kept: ContextVar[_Processes | None] = ContextVar("kept processes", default=None)


class OwnProcess:
    """One process that holds what it has begun with, such as a tracker, from call to call; a new one takes its place
    when it ends from outside.

    Parameters
    ----------
    begin : callable
        Called with ``arguments`` in the process before all else.
    """

    def __init__(self, begin: Callable[..., object], *arguments):
        self._begin = (begin, *arguments)
        self._guard = threading.Lock()
        self._pool: ProcessPoolExecutor | None = None

    def call(self, function: Callable[..., R], *arguments) -> R:
        """Result of the function there, after those of calls before.

        Raises
        ------
        BrokenExecutor
            The process ended meanwhile; the next call starts another.
        """
        with self._guard:
            if self._pool is None:
                with _as_processes_start():
                    self._pool = ProcessPoolExecutor(1, _context(), initializer=_begin_own, initargs=self._begin)
                    pool, future = self._pool, self._pool.submit(function, *arguments)
            else:
                pool, future = self._pool, self._pool.submit(function, *arguments)
        try:
            return future.result()
        except BrokenExecutor:
            with self._guard:
                if self._pool is pool:
                    self._pool = None
            raise

    def close(self) -> None:
        """End the process; calls that wait are given up."""
        with self._guard:
            pool, self._pool = self._pool, None
        if pool is not None:
            pool.shutdown(wait=False, cancel_futures=True)


def _begin_own(begin: Callable[..., object], *arguments) -> None:
    _follow_parent()
    begin(*arguments)


@contextlib.contextmanager
def _as_processes_start() -> Iterator[None]:
    with _one_starts, _plain_main(), _deaf_to_interrupts():
        yield


def load_ahead(workers: int | None = None) -> None:
    """Load what processes will need, beside this process, which goes on."""
    if (workers or os.cpu_count() or 1) > 1 and _context().get_start_method() == "forkserver":
        from multiprocessing.forkserver import ensure_running

        with _plain_main(), _deaf_to_interrupts():
            ensure_running()


def _context() -> multiprocessing.context.BaseContext:
    """How processes are started: by a server without threads, which has the libraries, where the system can fork."""
    if "forkserver" not in multiprocessing.get_all_start_methods():
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([LOADED_ONCE])  # without effect where a server is running
    return context


def _handed_over(executor: Executor, function, jobs: Sequence[tuple], at_once: int) -> Iterator[tuple[int, R]]:
    waiting: dict[Future, int] = {}
    rest = iter(range(len(jobs)))
    try:
        while True:
            for i in itertools.islice(rest, at_once - len(waiting)):
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
    """Processes started meanwhile ignore Ctrl-C from their first moment, not only after their imports. SIGTERM waits: a
    process that its parent leaves before it has read what to do ends with a stack on the terminal."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    asked: list[int] = []
    before = [(signal.SIGINT, signal.signal(signal.SIGINT, signal.SIG_IGN))]
    before.append((signal.SIGTERM, signal.signal(signal.SIGTERM, lambda number, _: asked.append(number))))
    try:
        yield
    finally:
        for number, handler in before:
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
        for number in asked[:1]:
            signal.raise_signal(number)


def _follow_parent() -> None:
    """In a worker: leave Ctrl-C to the parent, which stops the pool in order; end when the parent is killed."""
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
    """Hide the main module's file from new processes, and the folder that the program runs in, whose files might be
    named like modules; keep their libraries to one thread."""
    main = sys.modules["__main__"]
    hidden = {name: getattr(main, name) for name in ("__file__", "__spec__") if getattr(main, name, None) is not None}
    meanwhile: dict[str, str] = dict.fromkeys((*ONE_THREAD, "PYTHONSAFEPATH"), "1")
    before = {name: os.environ.get(name) for name in meanwhile}
    for name in hidden:
        setattr(main, name, None)
    os.environ.update(meanwhile)
    try:
        yield
    finally:
        for name, value in hidden.items():
            setattr(main, name, value)
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
