"""Boards of any kind in images: their points, and the camera that took photographs of a board of corners or circles."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from stcal.boards.board_designs import (
    AprilGridDesign,
    AsymmetricCirclesDesign,
    BoardSet,
    BoardView,
    CharucoDesign,
    ChessboardDesign,
    CornerBoard,
    FlatBoard,
    HexagonalCirclesDesign,
    TagLayout,
    turns,
)
from stcal.boards.finders import find_charuco, find_chessboard, shift_by_curves, straightened, why_no_chessboard
from stcal.boards.tags import Tags, find_aprilgrid, find_tags, view_of_tags
from stcal.design import BoardDesign, TargetDesign
from stcal.errors import InputError, StcalError
from stcal.geometry.arrays import require_arguments
from stcal.geometry.camera import Camera
from stcal.geometry.plane import camera_from_plane, circle_image_offset, fit_homography, refine_planar_pose
from stcal.geometry.rigid import Rigid
from stcal.io.cameras.camera_model import CameraModel
from stcal.io.cameras.read import camera_model
from stcal.io.images import MAJORITY, TOP_GROUP, ImageFile, Skipped, common_size, find_images, grey_8bit, run_on_images
from stcal.labels import DotLabel
from stcal.locate.layout_calibration import CalibrationImages
from stcal.parallel import Progress, one_thread
from stcal.sfm.camera.calibrate import CameraCalibration, Found, calibrated
from stcal.sfm.data.group_model import ImageObservations
from stcal.sfm.data.patterns import pattern_of_board
from stcal.sfm.detect.candidates import Candidates, EllipseOptions, find_ellipses
from stcal.sfm.detect.defocus import correct_defocus
from stcal.sfm.detect.detect_files import load_image, sized_by
from stcal.sfm.detect.image import detect_image
from stcal.sfm.detect.labelling import labelled_image

CENTRING_ROUNDS = 3  # of the correction for the ellipses' centres; two would leave a thousandth of it
CORNER_SIGMA_PX = 0.1  # σ of corners whose detector states none
NEAREST = 6  # number of outlines about a circle, one of which is its neighbour
MIN_SHARE = 0.35  # smallest share of a board's circles that must be seen
Board = BoardDesign | FlatBoard | BoardSet
Circles = BoardDesign | AsymmetricCirclesDesign
Seen = tuple[BoardView | None, str]  # a view of a board, or why there is none
KINDS = {
    BoardDesign: "dots",
    ChessboardDesign: "chessboard",
    CharucoDesign: "ChArUco",
    TagLayout: "tags",
    AprilGridDesign: "AprilGrid",
    AsymmetricCirclesDesign: "asymmetric circles",
    HexagonalCirclesDesign: "hexagonal circles",
}


def kind_of(board: Board) -> str:
    return f"{len(board.boards)} boards" if isinstance(board, BoardSet) else KINDS[type(board)]


def symmetries(board: Board) -> list[Rigid]:
    """Returns the rotations after which the board looks the same, as board_from_board, without the identity."""
    if not isinstance(board, BoardDesign):
        return board.symmetries()
    if board.unique():
        return []
    return turns(board.xy_mm(), [1, 2, 3] if board.rows == board.columns else [2])


def find_board(image: np.ndarray, name: str, camera: Camera, board: Board) -> Seen:
    """Returns the view of the board, or of all that are seen of a set, in a grey image, or why there is none."""
    if not isinstance(board, BoardSet):
        try:
            return _find_flat(image, name, camera, board)
        except StcalError as error:
            return None, str(error)
    views, reasons = [], []
    places = zip(board.names, board.common_from_board, board.first_ids(), strict=True)
    for single, (own, place, first) in zip(board.boards, places, strict=True):
        view, why = find_board(image, name, camera, single)
        if view is None:
            reasons.append(f"{own}: {why}")
            continue
        xyz, normal = place @ view.xyz_board, np.tile(place.rotation[:, 2], (len(view), 1))
        unused = tuple(f"{own}: {reason}" for reason in view.unused)
        views.append(replace(view, ids=view.ids + first, xyz_board=xyz, normal=normal, unused=unused))
    if not views:
        return None, "; ".join(reasons)
    parts = ("ids", "xyz_board", "xy_px", "normal")
    ids, xyz, xy, normals = (np.concatenate([getattr(view, part) for view in views]) for part in parts)
    unused = (*(reason for view in views for reason in view.unused), *reasons)
    return BoardView(name, ids, xyz, xy, np.concatenate([*map(covariance_px2, views)]), normals, unused), ""


def covariance_px2(view: BoardView) -> np.ndarray:
    """Returns the covariances (k, 2, 2) of a view's points, or that of corners if their detector states none."""
    if view.covariance_px2 is None:
        return np.tile(CORNER_SIGMA_PX**2 * np.eye(2), (len(view), 1, 1))
    return view.covariance_px2


def _find_flat(image: np.ndarray, name: str, camera: Camera, board: BoardDesign | FlatBoard) -> Seen:
    if isinstance(board, BoardDesign):
        place = np.arange(board.rows * board.columns).reshape(board.rows, board.columns)
        return _find_circles(image, name, camera, board, board, place)
    if isinstance(board, AsymmetricCirclesDesign):
        if board.radius_mm is None:
            radius = _radius_seen(image, camera, board)
            if radius is None:
                return None, f"no {board.polarity} circles"
            board = replace(board, radius_mm=radius)
        grid = board.lattice()
        place = np.full((grid.rows, grid.columns), -1)
        place[tuple(grid.cells().T)] = np.arange(len(grid.cells()))
        return _find_circles(image, name, camera, board, grid, place)
    if isinstance(board, ChessboardDesign):
        view = find_chessboard(image, name, board)
        return view, "" if view else why_no_chessboard(image, board)
    if isinstance(board, CharucoDesign):
        view = find_charuco(image, name, board)
        return view, "" if view else _without_charuco(image, board)
    if isinstance(board, AprilGridDesign):
        view, why = find_aprilgrid(image, name, board, camera)
        return straightened(view, camera), why
    tags = find_tags(image, tuple(dict.fromkeys(dictionary for dictionary, _ in board.tags)))
    return straightened(view_of_tags(name, tags, board), camera), "no tag of the layout"


def _without_charuco(image: np.ndarray, board: CharucoDesign) -> str:
    ids = [tag for _, tag in find_tags(image, (board.dictionary,)).tags]
    few, board_ids = "fewer than 4 corners of the ChArUco board", board.tag_ids()
    if not ids:
        return f"{few}: no tag of {board.dictionary}"
    if foreign := [tag for tag in ids if tag not in board_ids]:
        first = f" from {board_ids[0]}" if board_ids[0] else ""
        extent = f"{len(board_ids)} on a board of {board.rows}×{board.columns}{first}"
        return f"{few}: tag {max(foreign)} of {board.dictionary}, of {extent}"
    return f"{few}, but {len(ids)} of its tags, not where rows, columns and legacy of its file put them; correct these"


def _radius_seen(image: np.ndarray, camera: Camera, board: AsymmetricCirclesDesign) -> float | None:
    """Returns the circles' radius, mm, as a median, by the distance of neighbours; None without circles."""
    candidates = Candidates(find_ellipses(grey_8bit(image), board.polarity, EllipseOptions()), camera)
    if len(candidates) < len(board.xy_mm()) * MIN_SHARE:
        return None
    near = candidates.tree.query(candidates.xy, k=NEAREST + 1)[1][:, 1:]
    # In oblique views, the circle that looks nearest may not be nearest: lengths are in units of the circle's image.
    apart = np.linalg.solve(candidates.shape[:, None], (candidates.xy[near] - candidates.xy[:, None])[..., None])
    return board.nearest_mm() / np.median(np.linalg.norm(apart[..., 0], axis=2).min(1))


def _find_circles(
    image: np.ndarray, name: str, camera: Camera, board: Circles, grid: BoardDesign, place: np.ndarray
) -> Seen:
    """``grid`` : lattice in which circles are found; ``place`` : (rows, columns) rows of the lattice in ``xy_mm``."""
    pattern = "board of dots" if grid is board else f"grid of {kind_of(board)}"
    detected = detect_image(image, camera, TargetDesign("none", grid.polarity, ()), grid, EllipseOptions())
    if detected.repeated:
        return None, "the board is in view more than once"
    if detected.board is None or not len(detected.board.rows):
        return None, f"no {pattern} recognised"
    ids = place[tuple(np.moveaxis(detected.board.numberings, 2, 0))]
    if not _turned_only(ids, board):
        return None, "a strip of the board is hidden, so that its dots cannot be numbered; show more of it"
    centres, xy = detected.centres.select(detected.board.rows), board.xy_mm()[ids[0]]
    labels = [DotLabel(*cell) for cell in detected.board.numberings[0].tolist()]
    seen = labelled_image(name, TOP_GROUP, labels, centres, ()).observations
    (sharp,), _ = correct_defocus([seen], camera, pattern_of_board(grid))
    xyz = np.column_stack([xy, np.zeros(len(xy))])
    centre_px = images_of_centres(sharp.centre_px, xyz, board.radii_mm()[ids[0]], camera)
    return BoardView(name, ids[0], xyz, centre_px, sharp.covariance_px2), ""


def _turned_only(ids: np.ndarray, board: Circles) -> bool:
    """True if all numberings (k, n) differ only by a rotation that leaves the board as it is."""
    xy = board.xy_mm()
    pitch = board.pitch_mm if isinstance(board, BoardDesign) else board.spacing_mm
    places = [(turn @ np.column_stack([xy, np.zeros(len(xy))]))[:, :2] for turn in (Rigid(), *symmetries(board))]
    return all(any(np.allclose(xy[numbering], place[ids[0]], atol=pitch / 4) for place in places) for numbering in ids)


def images_of_centres(
    centre_px: np.ndarray, xyz_board: np.ndarray, radius_mm: np.ndarray, camera: Camera
) -> np.ndarray:
    """Returns images (n, 2) of a flat board's circles' centres, px, from their ellipses' centres; raises
    DegenerateError: fewer than four, or on a line."""
    corrected_px = centre_px
    for _ in range(CENTRING_ROUNDS):
        normalised = camera.normalised_from_pixel(corrected_px)
        pose = camera_from_plane(fit_homography(xyz_board[:, :2], normalised))
        pose = refine_planar_pose(pose, xyz_board[:, :2], normalised)
        centre = pose @ xyz_board
        ellipse = circle_image_offset(centre, pose.rotation[:, 2], radius_mm)
        corrected_px = centre_px - (camera.project(ellipse) - camera.project(centre))
    return corrected_px


@dataclass(frozen=True, slots=True, eq=False)
class BoardDetection:
    """One readable image: ``view``, or None with the reason ``why``; ``tags`` of the requested dictionaries."""

    name: str
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
        return {detection.name: detection.view for detection in self.images if detection.view is not None}

    def unused(self) -> list[str]:
        """Returns a line for each reason why views lack a part of the board, or of the boards, that images show."""
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
    progress: Callable[[int, int], None] = lambda *_: None,
) -> BoardDetections:
    """Find the board, and the tags of ``dictionaries``, in all images that can be used; ``progress`` : called with
    images done, and all. Raises InputError: no image is readable, or the camera is not that of the images."""
    if not files:
        raise InputError("E-IMAGES-NONE", "no image; images of the board needed")
    if model.width and model.height:
        model.require_inside(model.width, model.height, "the image")
    if (model.width and model.height) or common_size(files):
        camera, size_from = sized_by(model, list(files))
    else:  # of any size: each file says why it cannot be read
        camera, size_from = model.sized(1, 1), MAJORITY
    outcomes: dict[int, BoardDetection | Skipped] = {}
    jobs = [(file, camera, size_from, board, tuple(dictionaries)) for file in files]
    for i, outcome in run_on_images(_detect_board, jobs, workers):
        outcomes[i] = outcome
        progress(len(outcomes), len(jobs))
    every = [outcomes[i] for i in range(len(jobs))]
    detections = tuple(each for each in every if isinstance(each, BoardDetection))
    unusable = tuple(each for each in every if isinstance(each, Skipped))
    if not detections:
        reason = f"{unusable[0].name}: {unusable[0].reason}"
        raise InputError("E-IMAGES-NONE-USABLE", f"no usable image among {len(files)}: {reason}")
    without = (Skipped(each.name, each.why, "board") for each in detections if each.view is None)
    return BoardDetections(camera, detections, (*unusable, *without), tuple(symmetries(board)))


def _detect_board(
    file: ImageFile, camera: Camera, size_from: str, board: Board, dictionaries: tuple[str, ...]
) -> BoardDetection | Skipped:
    loaded = load_image(file, camera, size_from)
    if isinstance(loaded, Skipped):
        return loaded
    image = loaded[1]
    tags = find_tags(image, dictionaries) if dictionaries else None
    view, why = find_board(image, file.name, camera, board)
    return BoardDetection(file.name, view, why, tags)


@require_arguments
def calibration_images(
    images: str | Path,
    camera: str | Path | Camera | CameraModel,
    board: Board,
    dictionaries: tuple[str, ...],
    workers: int | None = None,
    progress: Progress | None = None,
) -> CalibrationImages:
    """Returns a board and tags in one plane in photographs, from which :func:`stcal.locate.calibrate` finds the tags.

    Parameters
    ----------
    images : Folder of the photographs, and of folders of them.
    camera : The camera that took them, or its file.
    board : The board, mm, of :func:`stcal.load_flat_board`.
    dictionaries : Dictionaries of the tags.
    workers : Number of processes; one per core if None.
    progress : Called with (stage, done, total).

    Returns
    -------
    CalibrationImages : ``views``, ``tags``, ``names``, ``camera`` and ``symmetries``, the arguments of
        :func:`stcal.locate.calibrate`; ``left_out``, images that are not used, and why.
    """
    files, skipped = find_images(images)
    told, model = progress or (lambda *_: None), camera_model(camera)
    detections = detect_boards(files, model, board, dictionaries, workers, partial(told, "images"))
    names, views, tags = zip(*((image.name, image.view, image.tags) for image in detections.images), strict=True)
    without = (image for image in (*skipped, *detections.skipped) if image.name not in names)
    left_out = tuple(f"{image.name}: {image.reason}" for image in without)
    tags = tuple(
        replace(each, corners_px=each.corners_px - shift_by_curves(each.corners_px, detections.camera)) for each in tags
    )
    return CalibrationImages(names, views, tags, detections.camera, detections.symmetries, left_out)


@require_arguments
@one_thread()
def calibrate_camera_by_corners(
    images: str | Path,
    board: FlatBoard,
    colmap_model: str = "OPENCV",
    workers: int | None = None,
    progress: Progress | None = None,
) -> CameraCalibration:
    """Returns intrinsics from photographs of a chessboard, ChArUco board, AprilGrid, or asymmetric circles.

    Parameters
    ----------
    images : Folder of photographs, or of folders of them.
    board : The board, mm, with the σ of its corners, of :func:`stcal.load_flat_board`.
    colmap_model : COLMAP's camera model to adjust, such as ``OPENCV``, or ``auto``.
    workers : Number of processes; one per core if None.
    progress : Called with (stage, done, total).

    Returns
    -------
    CameraCalibration : The same result as from dots; a corner (row, column) stands for the dot of that place.

    Raises
    ------
    StcalError : One of its subclasses, with a one-line message that says what to do.
    """
    grid, told = corner_grid(board), progress or (lambda *_: None)

    def find(files: list[ImageFile], lens: CameraModel, camera: Camera, number: int, _first: bool) -> Found:
        detections = detect_boards(files, lens, board, (), workers, partial(told, f"detect {number}"))
        group = {file.name: file.group for file in files}
        views = []
        for name, view in detections.views().items():
            labels = tuple(DotLabel(*cell) for cell in grid.cells()[view.ids].tolist())
            rays, covariance = camera.normalised_from_pixel(view.xy_px), covariance_px2(view)
            seen = view.xy_px, rays, np.zeros_like(covariance), covariance
            views.append(ImageObservations(name, group[name], labels, *seen))
        return views, detections.skipped

    return calibrated(find, images, grid, colmap_model, workers, ROUNDS.get(type(board), 1))


ROUNDS: dict[type, int] = {AprilGridDesign: 2, AsymmetricCirclesDesign: 3, HexagonalCirclesDesign: 3}
"""Rounds of detection where the camera helps to find the points, and for circles also moves them: an error of their
eccentricity shrinks to less than a tenth with each round. Corners of chessboards and ChArUco boards need one."""


def corner_grid(board: FlatBoard) -> CornerBoard:
    """Returns a board's points as dots without extent; raises InputError: points that are not on a grid."""
    if isinstance(board, TagLayout):
        said = f"--board: {kind_of(board)}; a board of dots, a chessboard, a ChArUco board, an AprilGrid, asymmetric "
        said += "or hexagonal circles needed to calibrate a camera"
        raise InputError("E-BOARD-TYPE", said)
    return CornerBoard.of(board)
