"""Corners of a board in a folder of images: every kind of board, each image decoded once, in parallel.

Dots (``stcal.sfm``) and the boards of other makers (``stcal.boards``) are brought together here, for all commands that
start from images of a board.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from stcal.boards.design import BoardView
from stcal.boards.tags import Tags, find_tags
from stcal.errors import InputError
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid
from stcal.io.cameras.model import CameraModel
from stcal.io.image_jobs import run_on_images
from stcal.io.images import ImageFile, Skipped, decode
from stcal.workflows.board_in_image import Board, find_board, symmetries


@dataclass(frozen=True, slots=True, eq=False)
class BoardDetection:
    """One readable image: ``view`` of the board, or None with the reason ``why``; ``tags`` of the requested
    dictionaries."""

    name: str
    size: tuple[int, int]
    view: BoardView | None
    why: str = ""
    tags: Tags | None = None


@dataclass(frozen=True, slots=True, eq=False)
class BoardDetections:
    """``camera`` : with its size; ``images`` : readable images, in the order of the files; ``skipped`` : images without
    a usable view of the board, and why; ``symmetries`` : rotations by which the numbering of a view may be off."""

    camera: Camera
    images: tuple[BoardDetection, ...]
    skipped: tuple[Skipped, ...]
    symmetries: tuple[Rigid, ...]

    def views(self) -> dict[str, BoardView]:
        """Returns the views by image, for the images that show the board."""
        return {detection.name: detection.view for detection in self.images if detection.view is not None}

    def unused(self) -> list[str]:
        """Returns a line for each reason why views do not use a part of the board, or of the boards, that images
        show."""
        images: dict[str, list[str]] = {}
        for name, view in self.views().items():
            for reason in view.unused:
                images.setdefault(reason, []).append(name)
        total = len(self.views())
        return [f"{reason} (in {len(names)} of {total} images, {names[0]} …)" for reason, names in images.items()]


def detect_boards(
    files: Sequence[ImageFile],
    model: CameraModel,
    board: Board,
    dictionaries: Sequence[str] = (),
    workers: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> BoardDetections:
    """Find the board in all images, and the tags of ``dictionaries`` beside it.

    An image that cannot be used is skipped.

    Parameters
    ----------
    progress : called with the number of images done, and the number of all images

    Raises
    ------
    InputError
        No image is readable, or the camera is not that of the images; the message names the first.
    """
    if not files:
        raise InputError("E-IMAGES-NONE", "no image; images of the board needed")
    jobs = [(file, model, board, tuple(dictionaries)) for file in files]
    by_job: dict[int, BoardDetection | Skipped] = {}
    for i, detection in run_on_images(_detect_board, jobs, workers):
        by_job[i] = detection
        if progress:
            progress(len(by_job), len(jobs))
    outcomes = [by_job[i] for i in range(len(jobs))]
    detections = [outcome for outcome in outcomes if isinstance(outcome, BoardDetection)]
    if not detections:
        first = next(outcome for outcome in outcomes if isinstance(outcome, Skipped))
        raise InputError("E-IMAGES-NONE-USABLE", f"no usable image among {len(files)}: {first.name}: {first.reason}")
    size = detections[0].size
    model.require_inside(*detections[0].size, detections[0].name)
    outcomes = [_of_size(outcome, size, detections[0].name) for outcome in outcomes]
    detections = tuple(outcome for outcome in outcomes if isinstance(outcome, BoardDetection))
    without = (Skipped(s.name, s.why, "board") for s in detections if s.view is None)
    skipped = (*(outcome for outcome in outcomes if isinstance(outcome, Skipped)), *without)
    return BoardDetections(model.sized(*size), detections, skipped, tuple(symmetries(board)))


def _detect_board(
    file: ImageFile, model: CameraModel, board: Board, dictionaries: tuple[str, ...]
) -> BoardDetection | Skipped:
    try:
        image = decode(file.read(), file.name)
    except OSError as error:
        return Skipped(file.name, f"cannot be read: {error.strerror or error}")
    except InputError as error:
        return Skipped(file.name, str(error).removeprefix(f"{file.name}: "))
    height, width = image.shape
    if (model.width or width, model.height or height) != (width, height):
        reason = f"{width}×{height} px, the camera file says {model.width}×{model.height} px; use images as taken"
        return Skipped(file.name, reason, "image_size", f"{width}×{height} px", f"{model.width}×{model.height} px")
    tags = find_tags(image, dictionaries) if dictionaries else None
    view, why = find_board(image, file.name, model.sized(width, height), board)
    return BoardDetection(file.name, (width, height), view, why, tags)


def _of_size(each: BoardDetection | Skipped, size: tuple[int, int], first: str) -> BoardDetection | Skipped:
    if isinstance(each, Skipped) or each.size == size:
        return each
    own_size, wanted = ("{}×{} px".format(*s) for s in (each.size, size))
    return Skipped(
        each.name, f"{own_size}, but {first} has {wanted}; use images of one camera", "image_size", own_size, wanted
    )
