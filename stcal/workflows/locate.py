"""Photographs from which a target of tags is calibrated, with any board beside the tags, for ``stcal locate
calibrate``."""

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
    """Returns board and tags in all images of a folder; ``progress`` is called with (stage, done, total)."""
    files, skipped = find_images(folder)
    detections = detect_boards(files, model, board, dictionaries, workers, partial(progress, "images"))
    names, views, tags = zip(*((image.name, image.view, image.tags) for image in detections.images), strict=True)
    left_out = tuple(
        f"{image.name}: {image.reason}" for image in (*skipped, *detections.skipped) if image.name not in names
    )
    return CalibrationImages(names, views, tags, detections.camera, detections.symmetries, left_out)
