"""Calibration of a camera from photographs of a chessboard or a ChArUco board: the same adjustment as from dots.

The published method of documents 003 and 004 (Zhang 2000) takes corners as exact on the board and of one σ. Here their
places are unknowns with a σ, like those of dots.
"""

from functools import partial
from pathlib import Path

import numpy as np

from stcal.boards.design import BoardView, CharucoDesign, ChessboardDesign, FlatBoard
from stcal.design import BoardDesign
from stcal.errors import InputError
from stcal.io.cameras.model import CameraModel
from stcal.io.images import ImageFile, find_images
from stcal.labels import DotLabel
from stcal.parallel import Progress, one_thread
from stcal.sfm.camera.calibrate import (
    CameraCalibration,
    first_size,
    judged,
    of_chosen_model,
    require_determined,
    require_model,
    require_views,
)
from stcal.sfm.camera.held_out import AUTO
from stcal.sfm.camera.intrinsics import adjust_intrinsics
from stcal.sfm.camera.views import closed_form, start_camera
from stcal.sfm.data.observations import ImageObservations
from stcal.workflows.board_in_image import kind_of
from stcal.workflows.board_views import detect_boards

CORNER_SIGMA_PX = 0.1
"""σ of corners whose detector states none. Only their equality matters, since the factor is estimated."""
POINT_RADIUS_MM = 1e-6
"""Radius of a corner as a circle: it has no extent and therefore no eccentricity."""


@one_thread()
def calibrate_camera_by_corners(
    images: str | Path,
    board: FlatBoard,
    colmap_model: str = "OPENCV",
    workers: int | None = None,
    progress: Progress | None = None,
) -> CameraCalibration:
    """Returns intrinsics from a folder of photographs that show a chessboard or a ChArUco board.

    Parameters
    ----------
    images
        Folder of photographs, or of folders of them.
    board
        The board, mm, with the σ of its corners.
    colmap_model
        COLMAP's camera model to adjust, such as ``OPENCV``, or ``auto``.
    workers
        Processes; one per core where None.
    progress
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
    if colmap_model == AUTO:
        return of_chosen_model(
            lambda model: calibrate_camera_by_corners(images, board, model, workers, progress), grid, workers
        )
    require_model(colmap_model)
    progress = progress or (lambda *_: None)
    files, skipped_files = find_images(images)
    camera = start_camera(*first_size(files), colmap_model)
    rounds = 2 if isinstance(board, CharucoDesign) else 1  # a ChArUco board's corners are found by the camera
    for done in range(1, rounds + 1):
        model = CameraModel(camera.focal, camera.centre, camera.distortion, colmap_model, None, None, "the images")
        detections = detect_boards(files, model, board, (), workers, partial(progress, f"detect {done}"))
        views = _observations(files, detections.views(), grid, camera)
        skipped = (*skipped_files, *detections.skipped)
        require_views(views, len(files), skipped)
        start = camera if done > 1 else closed_form(views, grid, camera)
        result = adjust_intrinsics(views, grid, start, colmap_model)
        require_determined(result, views)
        camera = result.camera
    return judged(result, views, skipped, rounds, True, grid)


def corner_grid(board: FlatBoard) -> BoardDesign:
    """Returns the inner corners of a board as a board of dots without extent.

    Raises
    ------
    InputError
        A board of another kind, whose points are not a grid of squares.
    """
    if isinstance(board, ChessboardDesign):
        rows, columns = board.rows, board.columns
    elif isinstance(board, CharucoDesign):
        rows, columns = board.rows - 1, board.columns - 1
    else:
        raise InputError(
            "E-BOARD-TYPE",
            f"--board: {kind_of(board)}; a board of dots, a chessboard or a ChArUco board needed to calibrate a camera",
        )
    return BoardDesign(rows, columns, board.square_mm, POINT_RADIUS_MM, "bright", board.sigma_mm)


def _observations(files: list[ImageFile], views: dict[str, BoardView], grid: BoardDesign, camera):
    group = {file.name: file.group for file in files}
    observations = []
    for name, view in views.items():
        labels = tuple(DotLabel(*divmod(i, grid.columns)) for i in view.ids.tolist())
        covariance = view.covariance_px2
        if covariance is None:
            covariance = np.tile(CORNER_SIGMA_PX**2 * np.eye(2), (len(view), 1, 1))
        observations.append(
            ImageObservations(
                name=name,
                group=group[name],
                labels=labels,
                centre_px=view.xy_px,
                centre=camera.normalised_from_pixel(view.xy_px),
                shape=np.zeros((len(view), 2, 2)),
                covariance_px2=covariance,
            )
        )
    return observations
