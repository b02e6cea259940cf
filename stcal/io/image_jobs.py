"""Jobs on images, run by processes of this machine or by an executor such as a cluster's."""

import contextlib
import socket
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Executor
from contextvars import ContextVar
from dataclasses import replace
from typing import TypeVar

from stcal.errors import DetectionError, InputError
from stcal.io.images import ImageFile
from stcal.parallel import hand_over, run_parallel

R = TypeVar("R")
_elsewhere: ContextVar[tuple[Executor, int, bool] | None] = ContextVar("executor of images", default=None)


@contextlib.contextmanager
def spread(executor: Executor, at_once: int, send_images: bool = False) -> Iterator[None]:
    """Let an executor, which stays open, run the jobs on single images inside the ``with`` block; results are the same.

    ``at_once`` : number of images that are handed over at a time; ``send_images`` : whether by content, and not by
    their path on storage that all machines share.
    """
    token = _elsewhere.set((executor, at_once, send_images))
    try:
        yield
    finally:
        _elsewhere.reset(token)


def run_on_images(
    function: Callable[..., R], jobs: Sequence[tuple], workers: int | None = None, kept: bool = False
) -> Iterator[tuple[int, R]]:
    """Yield index and result of each job, run by :func:`stcal.parallel.run_parallel` or the executor of :func:`spread`.

    The first argument of a job is an image file, or a list of them. ``kept`` : True if the caller keeps finished
    results, so that a second try continues there. Raises DetectionError: a process was ended from outside. Raises
    InputError: a worker does not see the folder of an image.
    """
    if current := _elsewhere.get():
        executor, at_once, send_images = current
        sent = ((function, _sent(files, send_images), *arguments) for files, *arguments in jobs)
        yield from hand_over(executor, _on_worker, sent, at_once)
        return
    try:
        yield from run_parallel(function, jobs, workers)
    except BrokenExecutor as error:
        raise DetectionError(
            "E-WORKER-DIED",
            f"images, {len(jobs)} of them: a process was ended from outside, for lack of memory perhaps; run the same "
            f"command again, with fewer --workers{', finished detections are kept' * kept}",
        ) from error


def _sent(files: ImageFile | list[ImageFile], with_content: bool) -> list[ImageFile] | ImageFile:
    if isinstance(files, list):
        return [_sent(file, with_content) for file in files]  # type: ignore[misc]
    return files.carried() if with_content else replace(files, path=files.path.absolute())


def _on_worker(function: Callable, files: ImageFile | list[ImageFile], *arguments):
    for file in [files] if isinstance(files, ImageFile) else files:
        if file.content is None and not file.path.parent.is_dir():
            raise InputError(
                "E-WORKER-PATH",
                f"{file.path.parent}: does not exist on worker {socket.gethostname()}; give a path that all workers "
                "see, or --send-images",
            )
    return function(files, *arguments)
