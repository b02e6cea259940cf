"""Corners of a board in a folder of images: every kind of board, each image decoded once, in parallel.

Here dots (``stcal.sfm``) and the boards of other makers (``stcal.boards``) come together, for all commands that start
from images of a board.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from stcal.boards.chessboard import find_chessboard
from stcal.boards.design import BoardView, CharucoDesign, ChessboardDesign, FlatBoard, turns
from stcal.boards.tags import Tags, find_charuco, find_tags, view_of_tags
from stcal.design import BoardDesign, TargetDesign
from stcal.errors import InputError, StcalError
from stcal.geometry.camera import Camera
from stcal.geometry.conic import circle_image_offset
from stcal.geometry.plane import camera_from_plane, fit_homography, refine_planar_pose
from stcal.geometry.rigid import Rigid
from stcal.io.camera import CameraModel
from stcal.io.images import ImageFile, Skipped, decode
from stcal.io.spread import run_on_images
from stcal.sfm.detect.circles.ellipses import EllipseOptions
from stcal.sfm.detect.image import detect_image

CENTRING_ROUNDS = 3
"""The pose that the ellipses' centres give is off by less than a thousandth of what they are moved by: two would do."""
Board = BoardDesign | FlatBoard


@dataclass(frozen=True, slots=True, eq=False)
class BoardDetection:
    """One readable image: ``view`` of the board, None where ``why`` tells the reason; ``tags`` that were asked for."""

    name: str
    size: tuple[int, int]
    view: BoardView | None
    why: str = ""
    tags: Tags | None = None


@dataclass(frozen=True, slots=True, eq=False)
class BoardDetections:
    """``camera`` : with its size; ``images`` : readable ones, in the order of the files; ``skipped`` : all that show no
    board that could be used, and why; ``symmetries`` : turns by which the numbering of a view may be off."""

    camera: Camera
    images: tuple[BoardDetection, ...]
    skipped: tuple[Skipped, ...]
    symmetries: tuple[Rigid, ...]

    def views(self) -> dict[str, BoardView]:
        """By image, those that show the board."""
        return {detection.name: detection.view for detection in self.images if detection.view is not None}


def detect_boards(
    files: Sequence[ImageFile],
    model: CameraModel,
    board: Board,
    dictionaries: Sequence[str] = (),
    workers: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> BoardDetections:
    """Find the board in all images, and the tags of ``dictionaries`` beside it; trouble with one image skips it.

    Parameters
    ----------
    progress : called with the number of images done, and that of all

    Raises
    ------
    InputError
        No image is readable, or the camera is not that of the images; the message names the first.
    """
    if not files:
        raise InputError("no image; images of the board needed")
    jobs = [(file, model, board, tuple(dictionaries)) for file in files]
    by_job: dict[int, BoardDetection | Skipped] = {}
    for i, detection in run_on_images(_detect_board, jobs, workers):
        by_job[i] = detection
        if progress:
            progress(len(by_job), len(jobs))
    found = [by_job[i] for i in range(len(jobs))]
    detections = [each for each in found if isinstance(each, BoardDetection)]
    if not detections:
        first = next(each for each in found if isinstance(each, Skipped))
        raise InputError(f"no usable image among {len(files)}: {first.name}: {first.reason}")
    size = detections[0].size
    model.require_inside(*detections[0].size, detections[0].name)
    found = [_of_size(each, size, detections[0].name) for each in found]
    detections = tuple(each for each in found if isinstance(each, BoardDetection))
    without = (Skipped(s.name, s.why, "board") for s in detections if s.view is None)
    skipped = (*(each for each in found if isinstance(each, Skipped)), *without)
    return BoardDetections(model.sized(*size), detections, skipped, tuple(symmetries(board)))


def symmetries(board: Board) -> list[Rigid]:
    """Turns after which the board looks the same, as board_from_board; never the identity."""
    if not isinstance(board, BoardDesign):
        return board.symmetries()
    if board.corner is not None:
        return []
    return turns(board.xy_mm(), [1, 2, 3] if board.rows == board.columns else [2])


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
    try:
        view, why = _find(image, file.name, model.sized(width, height), board)
    except StcalError as error:
        view, why = None, str(error)
    return BoardDetection(file.name, (width, height), view, why, tags)


def _find(image: np.ndarray, name: str, camera: Camera, board: Board) -> tuple[BoardView | None, str]:
    """The view of the board, or why there is none."""
    if isinstance(board, BoardDesign):
        return _find_dots(image, name, camera, board)
    if isinstance(board, ChessboardDesign):
        inner = f"not all {board.rows}×{board.columns} inner corners of the chessboard"
        return find_chessboard(image, name, board), f"{inner}, which rows and columns of its file count"
    if isinstance(board, CharucoDesign):
        view = find_charuco(image, name, board, camera)
        return view, "" if view else _without_charuco(image, board)
    tags = find_tags(image, tuple(dict.fromkeys(dictionary for dictionary, _ in board.tags)))
    return view_of_tags(name, tags, board), "no tag of the layout"


def _without_charuco(image: np.ndarray, board: CharucoDesign) -> str:
    """Why there are no corners, as far as the tags tell."""
    ids = [tag for _, tag in find_tags(image, (board.dictionary,)).tags]
    few, count = "fewer than 4 corners of the ChArUco board", board.rows * board.columns // 2
    if not ids:
        return f"{few}: no tag of {board.dictionary}"
    if max(ids) >= count:
        return f"{few}: tag {max(ids)} of {board.dictionary}, of {count} on a board of {board.rows}×{board.columns}"
    return (
        f"{few}, but {len(ids)} of its tags: are rows and columns exchanged, or is it one that OpenCV drew before 4.6 "
        "(legacy = true)?"
    )


def _find_dots(image: np.ndarray, name: str, camera: Camera, board: BoardDesign) -> tuple[BoardView | None, str]:
    found = detect_image(image, camera, TargetDesign("none", board.polarity, ()), board, EllipseOptions())
    if found.repeated:
        return None, "the board is in view more than once"
    if found.board is None or not len(found.board.rows):
        return None, "no board of dots recognised"
    ids = found.board.numberings @ [board.columns, 1]
    if not _turned_only(ids, board):
        return None, "a strip of the board is hidden, so that its dots cannot be numbered; show more of it"
    centres, xy = found.centres.select(found.board.rows), board.xy_mm()[ids[0]]
    xyz = np.column_stack([xy, np.zeros(len(xy))])
    centre_px = images_of_centres(centres.centre_px, xyz, board.radii_mm()[ids[0]], camera)
    return BoardView(name, ids[0], xyz, centre_px, centres.covariance_px2), ""


def _turned_only(ids: np.ndarray, board: BoardDesign) -> bool:
    """Whether all numberings (k, n) differ by nothing but a turn that leaves the board as it is."""
    xy = board.xy_mm()
    places = [(turn @ np.column_stack([xy, np.zeros(len(xy))]))[:, :2] for turn in (Rigid(), *symmetries(board))]
    return all(any(np.allclose(xy[own], place[ids[0]], atol=board.pitch_mm / 4) for place in places) for own in ids)


def images_of_centres(
    centre_px: np.ndarray, xyz_board: np.ndarray, radius_mm: np.ndarray, camera: Camera
) -> np.ndarray:
    """Images (n, 2) of the centres of a flat board's circles, px, from the centres (n, 2) of their ellipses.

    Raises
    ------
    DegenerateError
        Fewer than four circles, or all on a line.
    """
    seen = centre_px
    for _ in range(CENTRING_ROUNDS):
        normalised = camera.normalised_from_pixel(seen)
        pose = camera_from_plane(fit_homography(xyz_board[:, :2], normalised))
        pose = refine_planar_pose(pose, xyz_board[:, :2], normalised)
        centre = pose @ xyz_board
        ellipse = circle_image_offset(centre, pose.rotation[:, 2], radius_mm)
        seen = centre_px - (camera.project(ellipse) - camera.project(centre))
    return seen


def _of_size(each: BoardDetection | Skipped, size: tuple[int, int], first: str) -> BoardDetection | Skipped:
    if isinstance(each, Skipped) or each.size == size:
        return each
    own, wanted = ("{}×{} px".format(*s) for s in (each.size, size))
    return Skipped(each.name, f"{own}, but {first} has {wanted}; use images of one camera", "image_size", own, wanted)
