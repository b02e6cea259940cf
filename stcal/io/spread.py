"""Jobs on images: by processes of this machine, or handed to an executor, of a cluster say."""

import contextlib
import socket
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Executor
from concurrent.futures.process import BrokenProcessPool
from contextvars import ContextVar
from dataclasses import dataclass, replace
from typing import TypeVar

from stcal.errors import DetectionError, InputError
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
    function: Callable[..., R], jobs: Sequence[tuple], workers: int | None = None, kept: bool = False
) -> Iterator[tuple[int, R]]:
    """:func:`stcal.parallel.run_parallel` of jobs whose first argument is an image file, or a list of them, and which
    need nothing else of this machine; by the executor of :func:`spread` where there is one.

    Parameters
    ----------
    kept : bool
        The caller keeps what is finished; a second try goes on there.

    Raises
    ------
    DetectionError
        A process was ended from outside, or the executor is broken.
    InputError
        A worker does not see the folder of an image that it should read.
    """
    now = _current.get()
    try:
        if now is None:
            yield from run_parallel(function, jobs, workers)
        else:
            sent = _Sent(function, jobs, now.send_images)
            yield from run_parallel(_on_worker, sent, executor=now.executor, at_once=now.at_once)
    except BrokenExecutor as error:
        here = isinstance(error, BrokenProcessPool)
        what = "a process was ended from outside, for lack of memory perhaps" if here else str(error)
        raise DetectionError(
            "E-WORKER-DIED",
            f"images, {len(jobs)} of them: {what}; run the same command again{', with fewer --workers' * here}"
            f"{', finished detections are kept' * kept}",
        ) from error


class _Sent(Sequence):
    """Jobs as a worker gets them: by absolute paths, or with the images' contents from the moment when one is asked
    for."""

    def __init__(self, function: Callable, jobs: Sequence[tuple], with_content: bool):
        self._function, self._jobs, self._with_content = function, jobs, with_content

    def __len__(self) -> int:
        return len(self._jobs)

    def __getitem__(self, i):
        files, *rest = self._jobs[i]
        sent = self._sent(files) if isinstance(files, ImageFile) else [self._sent(each) for each in files]
        return (self._function, sent, *rest)

    def _sent(self, file: ImageFile) -> ImageFile:
        return file.carried() if self._with_content else replace(file, path=file.path.absolute())


def _on_worker(function: Callable, files: ImageFile | list[ImageFile], *arguments):
    for file in [files] if isinstance(files, ImageFile) else files:
        if file.content is None and not file.path.parent.is_dir():
            raise InputError(
                "E-WORKER-PATH",
                f"{file.path.parent}: not there on worker {socket.gethostname()}; give a path that all workers see, or "
                "--send-images",
            )
    return function(files, *arguments)
