"""Run one function over many jobs on all cores, or by any executor, and BLAS on one."""

import contextlib
import itertools
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, as_completed, wait
from typing import TypeVar

R = TypeVar("R")
Progress = Callable[[str, int, int], None]
"""Called with (stage, done, total)."""
ONE_THREAD = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")
"""Libraries take their number of threads from these when they are loaded; processes side by side need one each."""
_limited = threading.Lock()


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

    Processes are started afresh (forking a process with threads can hang) and do not import the caller's main
    module, so that a script needs no ``if __name__ == "__main__"``. One worker, or one job, runs right here.

    Parameters
    ----------
    workers : int, optional
        Processes; one per core where None.
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
    others = multiprocessing.active_children()
    with (
        _plain_main(),
        ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), initializer=_follow_parent) as pool,
    ):
        with _deaf_to_interrupts():
            futures = {pool.submit(function, *job): i for i, job in enumerate(jobs)}
        try:
            for future in as_completed(futures):
                yield futures[future], future.result()
        except BaseException as error:
            pool.shutdown(wait=isinstance(error, Exception), cancel_futures=True)
            if not isinstance(error, Exception):  # asked to end: what is half done is of no use
                for process in multiprocessing.active_children():
                    if process not in others:
                        process.terminate()
            raise


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
    """Processes started meanwhile ignore Ctrl-C from their first moment, not only after their imports."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


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
    """Hide the main module's file from new processes, and keep their libraries to one thread."""
    main = sys.modules["__main__"]
    hidden = {name: getattr(main, name) for name in ("__file__", "__spec__") if getattr(main, name, None) is not None}
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    for name in hidden:
        setattr(main, name, None)
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
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
