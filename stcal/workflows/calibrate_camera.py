"""Calibration of a camera from photographs of a board with corners or circles."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from stcal.boards.design import (
    AprilGridDesign,
    AsymmetricCirclesDesign,
    BoardView,
    CornerBoard,
    FlatBoard,
    HexagonalCirclesDesign,
    TagLayout,
)
from stcal.design import BoardDesign
from stcal.errors import InputError
from stcal.geometry.arrays import require_arguments
from stcal.geometry.camera import Camera
from stcal.io.images import ImageFile, Skipped
from stcal.labels import DotLabel
from stcal.parallel import Progress, one_thread
from stcal.sfm.camera.calibrate import (
    MAX_RESIDUAL_PX,
    CameraCalibration,
    calibrated,
    judged,
    require_determined,
    require_views,
    unsized,
)
from stcal.sfm.camera.intrinsics import Intrinsics, adjust_intrinsics, closed_form
from stcal.sfm.camera.lens_checks import foretold
from stcal.sfm.data.model import ImageObservations
from stcal.workflows.board_views import covariance_px2, detect_boards, kind_of

GROSS_SIGMAS = 10.0
"""Smallest deviation of a gross error from camera and board, in σ; it is more than :data:`MAX_RESIDUAL_PX`, too."""
LEAST_CORNERS = 6
"""Smallest number of corners of a view of which others were left out: they still check one another."""
LEAST_SHARE = 0.5
"""Smallest share of the corners of a view that are no gross errors; with fewer of them the view is not used."""


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
    images : str or Path
        Folder of photographs, or of folders of them.
    board : board design
        The board, mm, with the σ of its corners, of :func:`stcal.load_flat_board`.
    colmap_model : str
        COLMAP's camera model to adjust, such as ``OPENCV``, or ``auto``.
    workers : int, optional
        Number of processes; one per core if None.
    progress : callable, optional
        Called with (stage, done, total).

    Returns
    -------
    CameraCalibration
        The same result as from dots; a corner (row, column) stands for the dot of that place.

    Raises
    ------
    StcalError
        One of its subclasses, with a one-line message that says what to do.
    """
    grid = corner_grid(board)
    told, rounds = progress or (lambda *_: None), ROUNDS.get(type(board), 1)

    def of_model(
        files: list[ImageFile], not_images: Sequence[Skipped], camera: Camera, colmap_model: str
    ) -> CameraCalibration:
        for done in range(1, rounds + 1):
            step = partial(told, f"detect {done}")
            detections = detect_boards(files, unsized(camera, colmap_model), board, (), workers, step)
            views = _observations(files, detections.views(), grid, camera)
            skipped = (*not_images, *detections.skipped)
            require_views(views, files, skipped)
            start = camera if done > 1 else closed_form(views, grid, camera)
            result = adjust_intrinsics(views, grid, start, colmap_model)
            camera = result.camera
        kept, without, warnings = without_gross_errors(views, grid, result)
        if without or warnings:
            views, skipped = kept, (*skipped, *without)
            require_views(views, files, skipped)
            result = replace(adjust_intrinsics(views, grid, camera, colmap_model), restarted=result.restarted)
        require_determined(result, views, grid)
        calibration = judged(result, views, skipped, rounds, True, grid)
        return replace(calibration, warnings=(*calibration.warnings, *warnings))

    return calibrated(of_model, images, grid, colmap_model, workers)


def without_gross_errors(
    views: Sequence[ImageObservations], grid: BoardDesign, result: Intrinsics
) -> tuple[list[ImageObservations], list[Skipped], list[str]]:
    """Returns the views without gross errors, whose weights in the adjustment would be small, but not zero; the views
    that consist of them; and a warning about the others."""
    suspects = {
        model.images[image]
        for model in result.models
        for image in model.image_index[np.linalg.norm(model.residuals_px(result.camera), axis=1) > MAX_RESIDUAL_PX]
    }
    limits = f"{GROSS_SIGMAS:g} σ and {MAX_RESIDUAL_PX:g} px"
    kept, skipped, off = [], [], []
    for view in views:
        own = _gated(view, grid, result) if view.name in suspects else view
        if len(own) < max(LEAST_CORNERS, LEAST_SHARE * len(view)):
            reason = (
                f"{len(view) - len(own)} of {len(view)} corners lie more than {limits} from where the camera and the "
                "other views put them"
            )
            skipped.append(Skipped(view.name, reason, "corners", f"{len(own)}", f"{LEAST_SHARE * len(view):.0f}"))
            continue
        kept.append(own)
        off += [(view.name, label) for label in view.labels if label not in own.labels]
    if not off:
        return kept, skipped, []
    image, label = off[0]
    warning = (
        f"{len(off)} corners in {len(dict(off))} views are left out, first {image} {label}: they lie more than "
        f"{limits} from where the camera and all views put them; look whether something hides the board there"
    )
    return kept, skipped, [warning]


def _gated(view: ImageObservations, grid: BoardDesign, result: Intrinsics) -> ImageObservations:
    """Returns a view without its gross errors, one by one, as each disturbs the pose and thereby the others."""
    while len(view) > LEAST_CORNERS:
        residual_px, in_sigma = foretold(view, grid, result)
        length_px = np.linalg.norm(residual_px, axis=1)
        in_sigmas = np.linalg.norm(in_sigma, axis=1) / result.factors.centres
        worst = int(np.argmax(np.where(length_px > MAX_RESIDUAL_PX, in_sigmas, 0)))
        if length_px[worst] <= MAX_RESIDUAL_PX or in_sigmas[worst] <= GROSS_SIGMAS:
            break
        view = view.select(np.delete(np.arange(len(view)), worst))
    return view


ROUNDS = {AprilGridDesign: 2, AsymmetricCirclesDesign: 3, HexagonalCirclesDesign: 3}
"""Rounds of detection where the camera helps to find the points, and for circles also moves them: an error of their
eccentricity shrinks to less than a tenth with each round. Corners of chessboards and ChArUco boards need one."""


def corner_grid(board: FlatBoard) -> CornerBoard:
    """Returns a board's points as dots without extent; raises InputError: points that are not on a grid."""
    if isinstance(board, TagLayout):
        raise InputError(
            "E-BOARD-TYPE",
            f"--board: {kind_of(board)}; a board of dots, a chessboard, a ChArUco board, an AprilGrid, asymmetric "
            "or hexagonal circles needed to calibrate a camera",
        )
    return CornerBoard.of(board)


def _observations(
    files: Sequence[ImageFile], views: dict[str, BoardView], grid: CornerBoard, camera: Camera
) -> list[ImageObservations]:
    group = {file.name: file.group for file in files}
    observations = []
    for name, view in views.items():
        labels = tuple(DotLabel(*cell) for cell in grid.cells()[view.ids].tolist())
        rays, shape = camera.normalised_from_pixel(view.xy_px), np.zeros((len(view), 2, 2))
        observations.append(ImageObservations(name, group[name], labels, view.xy_px, rays, shape, covariance_px2(view)))
    return observations
