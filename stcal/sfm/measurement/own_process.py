"""A process that keeps its state from call to call."""

import contextlib
import threading
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, CancelledError, ProcessPoolExecutor
from typing import TypeVar

from stcal.parallel import _context, _follow_parent, _starting

R = TypeVar("R")
LOOK_S = 0.05
"""Interval at which a waiting call looks whether its result is still wanted, s."""


class OwnProcess:
    """Process that keeps its state, such as a tracker, from call to call.

    A new process takes its place if it is ended from outside.

    Parameters
    ----------
    begin : callable
        Function that the process calls with ``arguments`` first.
    """

    def __init__(self, begin: Callable[..., object], *arguments):
        self._begin = (begin, *arguments)
        self._guard = threading.Lock()
        self._pool: ProcessPoolExecutor | None = None
        self._line: deque[object] = deque()
        self._moved = threading.Condition()

    def call(self, function: Callable[..., R], *arguments, given_up: Callable[[], bool] | None = None) -> R:
        """Returns the result of the function in the process, after all earlier calls.

        ``given_up`` : returns whether the result is no longer wanted, so that a call that still waits is cancelled

        Raises
        ------
        BrokenExecutor
            The process ended during the call; the next call starts another one.
        CancelledError
            The call was given up before it began.
        """
        if given_up is None:
            return self._called(function, *arguments)
        with self._in_turn(given_up):
            return self._called(function, *arguments)

    @contextlib.contextmanager
    def _in_turn(self, given_up: Callable[[], bool]) -> Iterator[None]:
        """Waits for the end of earlier calls: an executor begins a second one early, which then cannot be given up."""
        own = object()
        with self._moved:
            self._line.append(own)
        try:
            with self._moved:
                while self._line[0] is not own and not given_up():
                    self._moved.wait(LOOK_S)
            if given_up():
                raise CancelledError
            yield
        finally:
            with self._moved:
                self._line.remove(own)
                self._moved.notify_all()

    def _called(self, function: Callable[..., R], *arguments) -> R:
        with self._guard:
            if self._pool is None:
                with _starting():
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
        """Ends the process after the call that it works at; waiting calls are cancelled."""
        with self._guard:
            pool, self._pool = self._pool, None
        if pool is not None:
            pool.shutdown(wait=True, cancel_futures=True)  # see _Processes.__exit__


def _begin_own(begin: Callable[..., object], *arguments) -> None:
    _follow_parent("")
    begin(*arguments)
