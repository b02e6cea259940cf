"""Jobs on images, run by processes of this machine or by an executor such as a cluster's."""

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
    """Let an executor run the jobs on single images, detection and ``measure``, inside the ``with`` block.

    The executor stays open. With the same libraries, results equal those of local processes bit by bit.

    ``executor`` : concurrent.futures.Executor; ``at_once`` : number of images that are handed over at a time; it bounds
    the memory for their contents; ``send_images`` : True sends images with their content; False sends paths on storage
    that all machines share.
    """
    token = _current.set(_Spread(executor, at_once, send_images))
    try:
        yield
    finally:
        _current.reset(token)


def run_on_images(
    function: Callable[..., R], jobs: Sequence[tuple], workers: int | None = None, kept: bool = False
) -> Iterator[tuple[int, R]]:
    """Yield index and result of each job, run by :func:`stcal.parallel.run_parallel` or the executor of :func:`spread`.

    The first argument of a job is an image file, or a list of them; a job needs nothing else of this machine.

    ``kept`` : True if the caller keeps finished results, so that a second try continues there.

    Raises DetectionError: a process was ended from outside, or the executor is broken. Raises InputError: a worker does
    not see the folder of an image that it should read.
    """
    current = _current.get()
    try:
        if current is None:
            yield from run_parallel(function, jobs, workers)
        else:
            sent = _Sent(function, jobs, current.send_images)
            yield from run_parallel(_on_worker, sent, executor=current.executor, at_once=current.at_once)
    except BrokenExecutor as error:
        local = isinstance(error, BrokenProcessPool)
        reason = "a process was ended from outside, for lack of memory perhaps" if local else str(error)
        raise DetectionError(
            "E-WORKER-DIED",
            f"images, {len(jobs)} of them: {reason}; run the same command again{', with fewer --workers' * local}"
            f"{', finished detections are kept' * kept}",
        ) from error


class _Sent(Sequence):
    """Jobs as a worker gets them: images as absolute paths, or with their contents, read when the job is fetched."""

    def __init__(self, function: Callable, jobs: Sequence[tuple], with_content: bool):
        self._function, self._jobs, self._with_content = function, jobs, with_content

    def __len__(self) -> int:
        return len(self._jobs)

    def __getitem__(self, i):
        files, *arguments = self._jobs[i]
        sent = self._sent(files) if isinstance(files, ImageFile) else [self._sent(file) for file in files]
        return (self._function, sent, *arguments)

    def _sent(self, file: ImageFile) -> ImageFile:
        return file.carried() if self._with_content else replace(file, path=file.path.absolute())


def _on_worker(function: Callable, files: ImageFile | list[ImageFile], *arguments):
    for file in [files] if isinstance(files, ImageFile) else files:
        if file.content is None and not file.path.parent.is_dir():
            raise InputError(
                "E-WORKER-PATH",
                f"{file.path.parent}: does not exist on worker {socket.gethostname()}; give a path that all workers "
                "see, or "
                "--send-images",
            )
    return function(files, *arguments)
