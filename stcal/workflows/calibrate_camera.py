"""Calibration of a camera, or of the cameras of a rig, from photographs of a board."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
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
from stcal.design import BoardDesign, TargetDesign
from stcal.errors import InputError, StcalError
from stcal.geometry.arrays import require_arguments
from stcal.geometry.camera import Camera
from stcal.io.cameras.forms import kalibr_chain
from stcal.io.cameras.model import CameraModel, cameras_txt
from stcal.io.cameras.write import require_camera_written
from stcal.io.files import json_text
from stcal.io.images import ImageFile, Skipped, find_images, name_fault, require_common_size
from stcal.io.json import ResultFile, require_result_written
from stcal.labels import DotLabel, Label
from stcal.parallel import Progress, one_thread
from stcal.sfm.camera.calibrate import (
    MAX_RESIDUAL_PX,
    CameraCalibration,
    calibrate_camera,
    judged,
    of_chosen_model,
    require_determined,
    require_model,
    require_views,
)
from stcal.sfm.camera.checks import AUTO, foretold
from stcal.sfm.camera.file import CalibrationFile, RigCalibrationFile
from stcal.sfm.camera.intrinsics import Intrinsics, adjust_intrinsics, closed_form, start_camera
from stcal.sfm.camera.rig import RigCalibration, rig_of
from stcal.sfm.data.model import ImageObservations
from stcal.workflows.board_views import detect_boards, kind_of

CORNER_SIGMA_PX = 0.1
"""σ of corners whose detector states none. Only their equality matters, since the factor is estimated."""
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
    if colmap_model == AUTO:
        return of_chosen_model(
            lambda model: calibrate_camera_by_corners(images, board, model, workers, progress), grid, workers
        )
    require_model(colmap_model)
    progress = progress or (lambda *_: None)
    files, skipped_files = find_images(images)
    camera = start_camera(*require_common_size(files)[0], colmap_model)
    rounds = ROUNDS.get(type(board), 1)
    for done in range(1, rounds + 1):
        model = CameraModel(camera.focal, camera.centre, camera.distortion, colmap_model, None, None, "the images")
        detections = detect_boards(files, model, board, (), workers, partial(progress, f"detect {done}"))
        views = _observations(files, detections.views(), grid, camera)
        skipped = (*skipped_files, *detections.skipped)
        require_views(views, files, skipped)
        result = adjust_intrinsics(views, grid, camera if done > 1 else closed_form(views, grid, camera), colmap_model)
        camera = result.camera
    gated = _without_gross_errors(views, grid, result)
    if gated.corners or gated.skipped:
        views, skipped = gated.views, (*skipped, *gated.skipped)
        require_views(views, files, skipped)
        result = replace(adjust_intrinsics(views, grid, result.camera, colmap_model), restarted=result.restarted)
    require_determined(result, views)
    calibration = judged(result, views, skipped, rounds, True, grid)
    return replace(calibration, warnings=(*calibration.warnings, *gated.warnings()))


@dataclass(frozen=True, slots=True, eq=False)
class _Gated:
    """``views`` : views without gross errors; ``skipped`` : views that consist of them, and why; ``corners`` : the
    other gross errors, by image."""

    views: list[ImageObservations]
    skipped: tuple[Skipped, ...]
    corners: dict[str, tuple[Label, ...]]

    def warnings(self) -> list[str]:
        """Returns a warning about gross errors, if there are any."""
        if not self.corners:
            return []
        count, (image, labels) = sum(map(len, self.corners.values())), next(iter(self.corners.items()))
        return [
            f"{count} corners in {len(self.corners)} views are left out, first {image} {labels[0]}: they lie more than "
            f"{GROSS_SIGMAS:g} σ and {MAX_RESIDUAL_PX:g} px from where the camera and all views put them; look whether "
            "something hides the board there"
        ]


def _without_gross_errors(views: Sequence[ImageObservations], grid: BoardDesign, result: Intrinsics) -> _Gated:
    """Returns the views without gross errors: their weights in the adjustment would be small, but not zero."""
    lengths = [np.linalg.norm(m.residuals_px(result.camera), axis=1) for m in result.models]
    suspects = {
        model.images[image]
        for model, length in zip(result.models, lengths, strict=True)
        for image in model.image_index[length > MAX_RESIDUAL_PX].tolist()
    }
    kept, skipped, corners = [], [], {}
    for view in views:
        own = _gated(view, grid, result) if view.name in suspects else view
        off = tuple(label for label in view.labels if label not in own.labels)
        if len(own) < max(LEAST_CORNERS, LEAST_SHARE * len(view)):
            reason = (
                f"{len(off)} of {len(view)} corners lie more than {GROSS_SIGMAS:g} σ and {MAX_RESIDUAL_PX:g} px from "
                "where the camera and the other views put them"
            )
            skipped.append(Skipped(view.name, reason, "corners", f"{len(own)}", f"{LEAST_SHARE * len(view):.0f}"))
            continue
        kept.append(own)
        if off:
            corners[view.name] = off
    return _Gated(kept, tuple(skipped), corners)


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
    """Returns the points of a board as a board of dots without extent.

    Raises InputError: a board of another kind, whose points are not on a grid.
    """
    if isinstance(board, TagLayout):
        raise InputError(
            "E-BOARD-TYPE",
            f"--board: {kind_of(board)}; a board of dots, a chessboard, a ChArUco board, an AprilGrid, asymmetric "
            "or hexagonal circles needed to calibrate a camera",
        )
    return CornerBoard.of(board)


def _observations(files: list[ImageFile], views: dict[str, BoardView], grid: CornerBoard, camera):
    group = {file.name: file.group for file in files}
    observations = []
    for name, view in views.items():
        labels = tuple(DotLabel(*cell) for cell in grid.cells()[view.ids].tolist())
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


RIG_FILE, CHAIN_FILE = "rig.json", "camchain.yaml"
TAKEN = ("rig", "camchain")
"""Names that a camera must not have, as its files would overwrite other files."""


def models_of(given: Sequence[str], default: str) -> tuple[dict[str, str], str]:
    """Returns the lens models by camera, and the one of all other cameras, from words NAME=MODEL and one word MODEL.

    Raises InputError: two models for one camera, or two words MODEL.
    """
    model_of: dict[str, str] = {}
    common = [word for word in given if "=" not in word]
    for word in given:
        name, separator, model = word.rpartition("=")
        if separator and name in model_of:
            raise InputError(
                "E-OPTION-REPEATED", f"--model {word}: {name} has {model_of[name]} already; one for each camera"
            )
        if separator:
            model_of[name] = model
    if len(common) > 1:
        raise InputError(
            "E-OPTION-CONFLICT",
            f"--model {common[1]}: {common[0]} is given too; one for all, or NAME=MODEL for each",
        )
    return model_of, common[0] if common else default


@require_arguments
def calibrate_rig(
    images: str | Path,
    target: TargetDesign,
    board: BoardDesign | FlatBoard,
    colmap_model: str = "OPENCV",
    models: Mapping[str, str] | None = None,
    workers: int | None = None,
    progress: Progress | None = None,
) -> RigCalibration:
    """Returns the intrinsics of cameras that are fixed to each other, and where they sit, from photographs of a board.

    Each camera is calibrated by itself, then all together.

    Parameters
    ----------
    images : str or Path
        Folder with a folder of photographs for each camera; those of one instant are named alike.
    target : TargetDesign
        Design of the target beside a board of dots, whose circles are not dots.
    board : BoardDesign or another board design
        The board, mm: dots, a chessboard or a ChArUco board.
    colmap_model : str
        COLMAP's camera model, or ``auto``.
    models : dict of str, optional
        Models of cameras that differ, by the name of their folder.
    workers : int, optional
        Number of processes; one per core if None.
    progress : callable, optional
        Called with (stage, done, total).

    Returns
    -------
    RigCalibration
        ``names``, ``cameras`` with their calibration alone, and ``camera_from_first``, mm.

    Raises
    ------
    InputError
        The folder, a name, a model or the board cannot be used.
    StcalError
        A camera cannot be calibrated; the message names it.
    """
    folder, own = Path(images), models or {}
    names = camera_names(folder)
    unknown = [name for name in own if name not in names]
    if unknown:
        raise InputError(
            "E-OPTION-VALUE", f"--model {unknown[0]}=…: no folder {unknown[0]} in {folder}; it has {', '.join(names)}"
        )
    grid = board if isinstance(board, BoardDesign) else corner_grid(board)
    cameras: dict[str, CameraCalibration] = {}
    for name in names:
        model = own.get(name, colmap_model)

        def step(stage: str, done: int, total: int, name=name) -> None:
            if progress:
                progress(f"{name}: {stage}", done, total)

        try:
            if isinstance(board, BoardDesign):
                calibration = calibrate_camera(folder / name, target, board, model, workers=workers, progress=step)
            else:
                calibration = calibrate_camera_by_corners(folder / name, board, model, workers, step)
        except StcalError as error:
            raise type(error)(error.code, f"rig: {name}: {error}") from error
        cameras[name] = calibration
    return rig_of(cameras, grid)


def camera_names(folder: Path) -> list[str]:
    """Returns the names of the folders in a folder.

    Raises InputError: not a folder, fewer than two folders in it, or names that no file can have.
    """
    if not folder.is_dir():
        raise InputError(
            "E-IMAGES-FOLDER",
            f"rig folder {folder}: {'not a folder' if folder.exists() else 'does not exist'}; give one",
        )
    names = sorted(
        subfolder.name for subfolder in folder.iterdir() if subfolder.is_dir() and not subfolder.name.startswith(".")
    )
    if len(names) < 2:
        raise InputError(
            "E-RIG-CAMERAS",
            f"rig folder {folder}: {len(names)} folders in it, one for each of two cameras and more needed; put "
            "photographs into <camera>/, or leave --rig away",
        )
    for name in names:
        fault = "is that of a file of the result" if name.lower() in TAKEN else name_fault(name)
        if fault or not name.isprintable():
            raise InputError(
                "E-RIG-CAMERAS", f"rig folder {folder}: camera name {name!r} {fault or 'is not printable'}; rename it"
            )
    return names


def files_of(rig: RigCalibration) -> tuple[dict[str, str], list[str]]:
    """Returns the contents of the files by name, and what is missing, with the reason.

    The files are a camera file and its JSON for each camera, ``rig.json``, and ``camchain.yaml`` where Kalibr has
    models for the lenses.
    """
    files, cameras = {}, []
    for name, calibration in zip(rig.names, rig.cameras, strict=True):
        intrinsics = calibration.intrinsics
        camera = Camera.of(intrinsics.camera, intrinsics.colmap_model, intrinsics.covariance)
        files |= {f"{name}.txt": cameras_txt(camera), f"{name}.json": json_text(CalibrationFile.of(calibration))}
        cameras.append((name, camera))
    summary: ResultFile = RigCalibrationFile.of(rig)
    files[RIG_FILE] = json_text(summary)
    missing = []
    try:
        chain = [(*named_camera, pose) for named_camera, pose in zip(cameras, rig.camera_from_first, strict=True)]
        files[CHAIN_FILE] = kalibr_chain(chain)
    except InputError as error:
        missing.append(f"no {CHAIN_FILE}: {error}")
    return files, missing


def require_rig_written(out: Path, files: Mapping[str, str], rig: RigCalibration) -> None:
    """Read the ``files`` of :func:`files_of` in folder ``out`` again, and require their content."""
    for number, (name, calibration) in enumerate(zip(rig.names, rig.cameras, strict=True)):
        require_camera_written(out / f"{name}.txt", calibration.intrinsics.camera)
        require_result_written(out / f"{name}.json", CalibrationFile.of(calibration))
        if CHAIN_FILE in files:
            require_camera_written(out / CHAIN_FILE, calibration.intrinsics.camera, f"cam{number}")
    require_result_written(out / RIG_FILE, RigCalibrationFile.of(rig))
