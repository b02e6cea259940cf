"""Jobs on images: by processes of this machine, or handed to an executor, of a cluster say."""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from contextvars import ContextVar
from dataclasses import dataclass
from typing import TypeVar

from stcal.io.images import ImageFile
from stcal.parallel import run_parallel

R = TypeVar("R")
AT_ONCE = 64


@dataclass(frozen=True, slots=True)
class _Spread:
    executor: Executor
    at_once: int
    send_images: bool


_current: ContextVar[_Spread | None] = ContextVar("spread", default=None)


@contextlib.contextmanager
def spread(executor: Executor, at_once: int = AT_ONCE, send_images: bool = False) -> Iterator[None]:
    """Hand what is done image by image meanwhile, detection and ``measure``, to an executor; it is left open.

    Results are the same, bit by bit, as by processes of this machine, where the libraries are the same.

    Parameters
    ----------
    executor : concurrent.futures.Executor
    at_once : int
        So many images are handed over at a time, which bounds the memory that their contents take.
    send_images : bool
        Images go with their content; by their paths, on storage that all machines share, where False.
    """
    token = _current.set(_Spread(executor, at_once, send_images))
    try:
        yield
    finally:
        _current.reset(token)


def run_on_images(
    function: Callable[..., R], jobs: Sequence[tuple], workers: int | None = None
) -> Iterator[tuple[int, R]]:
    """:func:`stcal.parallel.run_parallel` of jobs whose first argument is an image file, or a list of them, and which
    need nothing else of this machine; by the executor of :func:`spread` where there is one."""
    now = _current.get()
    if now is None:
        return run_parallel(function, jobs, workers)
    return run_parallel(
        function, _Carried(jobs) if now.send_images else jobs, executor=now.executor, at_once=now.at_once
    )


class _Carried(Sequence):
    """Jobs, each with its images' contents from the moment on when it is asked for."""

    def __init__(self, jobs: Sequence[tuple]):
        self._jobs = jobs

    def __len__(self) -> int:
        return len(self._jobs)

    def __getitem__(self, i):
        files, *rest = self._jobs[i]
        return (files.carried() if isinstance(files, ImageFile) else [each.carried() for each in files], *rest)
