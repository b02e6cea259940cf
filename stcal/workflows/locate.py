"""Photographs to calibrate a target of tags from: any board beside the tags, for ``stcal locate calibrate``."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

from stcal.io.cameras.model import CameraModel
from stcal.io.images import find_images
from stcal.locate.data.views import CalibrationImages
from stcal.workflows.board_views import Board, detect_boards


def calibration_images(
    folder: Path,
    model: CameraModel,
    board: Board,
    dictionaries: tuple[str, ...],
    workers: int | None = None,
    progress: Callable[[str, int, int], None] = lambda *_: None,
) -> CalibrationImages:
    """Board and tags in all images of a folder; ``progress`` is called with (stage, done, total)."""
    files, skipped = find_images(folder)
    found = detect_boards(files, model, board, dictionaries, workers, partial(progress, "images"))
    names, views, tags = zip(*((each.name, each.view, each.tags) for each in found.images), strict=True)
    left_out = tuple(f"{each.name}: {each.reason}" for each in (*skipped, *found.skipped) if each.name not in names)
    return CalibrationImages(names, views, tags, found.camera, found.symmetries, left_out)
