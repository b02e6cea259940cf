"""Calibration of an unknown camera from photographs of the dot board: the calls in order, and their result."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from stcal.design import BoardDesign, TargetDesign
from stcal.errors import ConvergenceError, DegenerateError, DetectionError, InputError, StcalError
from stcal.explain import explain
from stcal.geometry.arrays import Brief, require_arguments
from stcal.geometry.camera import COLMAP_MODELS, Camera
from stcal.io.cameras.model import OF_IMAGES, CameraModel
from stcal.io.images import ImageFile, Skipped, find_images, require_common_size
from stcal.labels import DotLabel, unseen_lines
from stcal.parallel import Progress, counted, one_thread, scratch_folder
from stcal.sfm.camera.intrinsics import (
    Intrinsics,
    adjust_intrinsics,
    board_views,
    closed_form,
    model_parameters,
    start_camera,
)
from stcal.sfm.camera.lens_checks import (
    AUTO,
    MIN_REACH,
    HeldOut,
    ProjectionSigma,
    TriedModel,
    choose_model,
    held_out,
    image_grid,
    larger_models,
    of_lens_model,
    projection_jacobian,
    projection_sigma,
)
from stcal.sfm.data.model import ImageObservations
from stcal.sfm.data.patterns import MIN_DOTS, pattern_of_board
from stcal.sfm.detect.circles.candidates import EllipseOptions
from stcal.sfm.detect.defocus import correct_defocus
from stcal.sfm.detect.files import DetectionResult, detect_files

MIN_VIEWS = 3
PERSPECTIVE, WIDE = "OPENCV", "OPENCV_FISHEYE"
MAX_ROUNDS = 5
SETTLED_SIGMAS = 0.1  # largest move of a parameter by the next detection round, in its σ, at which the rounds end
MAX_FOCAL_SIGMA = 0.02
"""Largest relative σ of the focal length. Beyond it the boards do not determine the focal length. Prints that may be
stretched are in σ: ten views of a small board by a telephoto lens leave 1.1 %, those of an exact board 0.3 %."""
MAX_RESIDUAL_PX = 1.0  # largest weighted RMS residual of a camera model and a board file that fit the images
SUSPICIOUS_FACTOR = 3.0
OUTLIER_WEIGHT = 0.5
CORNERS = ("top left", "top right", "bottom left", "bottom right")


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class CameraCalibration(Brief):
    """Result of calibrating one camera."""

    intrinsics: Intrinsics
    views: tuple[ImageObservations, ...]
    skipped: tuple[Skipped, ...]  # files and images without a board, and why
    rounds: int  # of detection
    projection: ProjectionSigma
    held_out: HeldOut | None  # None with fewer than four
    warnings: tuple[str, ...]  # problems that the σ may not show, and what to do about them
    candidates: tuple[TriedModel, ...] = ()  # lens models that were tried, empty if a model was given


@require_arguments
@one_thread()
def calibrate_camera(
    images: str | Path,
    target: TargetDesign,
    board: BoardDesign,
    colmap_model: str = "OPENCV",
    ellipses: EllipseOptions | None = None,
    workers: int | None = None,
    progress: Progress | None = None,
) -> CameraCalibration:
    """Calibrates the intrinsics from a folder of photographs that show the board.

    The start needs no knowledge of the lens: labels do not depend on the focal length, and a closed form estimates it.
    Ellipses are fitted in undistorted coordinates, so detection is repeated with the calibrated camera. Closed form:
    Zhang (2000).

    Parameters
    ----------
    images : path
        Folder of photographs, or of folders of them.
    target : TargetDesign
        Target that may also be in view; its circles are then not taken for dots.
    board : BoardDesign
        The dot board, mm, with the σ of its dots.
    colmap_model : str
        COLMAP's camera model to adjust, such as ``OPENCV``; or ``auto``, the simplest model that predicts held-out
        views as well as the best one.
    ellipses : EllipseOptions, optional
        Options of detection; the defaults if None.
    workers : int, optional
        Number of processes; one per core if None.
    progress : callable, optional
        Called with (stage, done, total).

    Returns
    -------
    CameraCalibration
        Intrinsics with the covariance of their parameters, px and OpenCV's pixel origin; the views used, and warnings.

    Raises
    ------
    StcalError
        A stage failed. The one-line message says what to do.
    """
    ellipses, progress = ellipses or EllipseOptions(), progress or (lambda *_: None)

    def of_model(
        files: list[ImageFile], not_images: Sequence[Skipped], camera: Camera, colmap_model: str
    ) -> CameraCalibration:
        before: Intrinsics | None = None
        settled = of_perspective = False
        with scratch_folder("camera") as cache:
            for rounds in range(1, MAX_ROUNDS + 1):
                step, lens = counted(progress, f"detect {rounds}", len(files)), unsized(camera, colmap_model)
                inputs = files, lens, target, board, ellipses, Path(cache), workers, step
                found = files, not_images, detect_files(*inputs, pictures=False)
                try:
                    views, skipped, result = _of_one_round(*found, board, camera, colmap_model, before is None)
                except (DetectionError, DegenerateError):
                    if before is not None or of_perspective or not camera.fisheye:
                        raise
                    # With the focal length of a wide lens, boards of a longer one look bent. A perspective model finds
                    # it.
                    start = start_camera(camera.width, camera.height, PERSPECTIVE)
                    rough = of_model(files, not_images, start, PERSPECTIVE)
                    camera, of_perspective = replace(camera, focal=rough.intrinsics.camera.focal), True
                    continue
                result = replace(result, restarted=result.restarted or (before is not None and before.restarted))
                camera = result.camera
                settled = before is not None and _next_move(before, result) < SETTLED_SIGMAS
                if settled:
                    break
                before = result
        return judged(result, views, skipped, rounds, settled, board)

    return calibrated(of_model, images, board, colmap_model, workers)


def calibrated(
    of_model: Callable[[list[ImageFile], list[Skipped], Camera, str], CameraCalibration],
    images: str | Path,
    board: BoardDesign,
    colmap_model: str,
    workers: int | None,
) -> CameraCalibration:
    """Returns the calibration ``of_model`` by a folder's photographs; with ``auto``, of the best lens model."""
    if colmap_model == AUTO:
        return of_chosen_model(lambda model: calibrated(of_model, images, board, model, workers), board, workers)
    if colmap_model not in COLMAP_MODELS:
        raise InputError(
            "E-CAMERA-MODEL",
            f"camera model {colmap_model}: not supported; use one of {', '.join(COLMAP_MODELS)} or {AUTO}",
        )
    files, not_images = find_images(images)
    return of_model(files, not_images, start_camera(*require_common_size(files)[0], colmap_model), colmap_model)


def unsized(camera: Camera, colmap_model: str) -> CameraModel:
    """Returns a camera without its size, which then comes from most of the images, and messages say so."""
    return CameraModel(camera.focal, camera.centre, camera.distortion, colmap_model, None, None, OF_IMAGES)


def camera_of_dots(
    files: Sequence[ImageFile], detection: DetectionResult, board: BoardDesign, start: Camera, colmap_model: str
) -> Intrinsics:
    """Returns the intrinsics by the boards of one detection, which was made with the rough camera ``start``."""
    return _of_one_round(files, (), detection, board, start, colmap_model, True)[2]


def camera_of_labelled(
    images: Sequence[ImageObservations], board: BoardDesign, camera: Camera
) -> tuple[Intrinsics, Intrinsics]:
    """Returns the intrinsics by the labelled dots of the board alone, and an adjustment that keeps those of ``camera``.
    The first begins at a lens that ``camera`` does not influence, and has the same model."""
    dots = [[k for k, label in enumerate(image.labels) if isinstance(label, DotLabel)] for image in images]
    views = [image.select(own) for image, own in zip(images, dots, strict=True) if len(own) >= MIN_DOTS]
    require_views(views, (), ())
    model = camera.colmap_model
    start = closed_form(views, board, start_camera(camera.width, camera.height, model))
    found = adjust_intrinsics(views, board, start, model)
    require_determined(found, views, board)
    return found, adjust_intrinsics(views, board, camera, model, held=True)


def _of_one_round(
    files: Sequence[ImageFile],
    not_images: Sequence[Skipped],
    detection: DetectionResult,
    board: BoardDesign,
    camera: Camera,
    colmap_model: str,
    first: bool,
) -> tuple[list[ImageObservations], tuple[Skipped, ...], Intrinsics]:
    """Views of the board, what was skipped, and the intrinsics; in the ``first`` round depths are unknown."""
    views = board_views(detection.images, board, camera)
    if not first:
        views, _ = correct_defocus(views, camera, pattern_of_board(board))
    shown, repeated = {view.name for view in views}, "the board is in view more than once"
    without = (
        Skipped(each.file.name, repeated if "board" in each.detection.repeated else "no board recognised")
        for each in detection.images
        if each.file.name not in shown
    )
    skipped = (*not_images, *detection.skipped, *without)
    require_views(views, files, skipped)
    result = adjust_intrinsics(views, board, closed_form(views, board, camera) if first else camera, colmap_model)
    require_determined(result, views, board)
    return views, skipped, result


def of_chosen_model(
    calibrate: Callable[[str], CameraCalibration], board: BoardDesign, workers: int | None
) -> CameraCalibration:
    """Returns the calibration with the lens model that held-out views select, which a usual model finds."""
    try:
        first = calibrate(PERSPECTIVE)
    except (DegenerateError, ConvergenceError, DetectionError) as error:
        try:
            first = calibrate(WIDE)
        except (DegenerateError, ConvergenceError, DetectionError):
            raise error from None
    chosen, candidates = choose_model(first.views, board, first.intrinsics, workers)
    result = first if chosen == first.intrinsics.colmap_model else calibrate(chosen)
    return replace(result, candidates=candidates)


def judged(
    result: Intrinsics,
    views: Sequence[ImageObservations],
    skipped: tuple[Skipped, ...],
    rounds: int,
    settled: bool,
    board: BoardDesign,
) -> CameraCalibration:
    """Returns a calibration with its checks and warnings; ``settled``: whether the detection rounds converged."""
    projection = projection_sigma(result)
    unseen = unseen_lines((label for view in views for label in view.labels), board.rows, board.columns)
    moving = f"the camera still moves after {MAX_ROUNDS} rounds of detection; add views, or choose a simpler --model"
    changing = "the σ of centres and dots still change when the rounds end; look at the outliers"
    warnings = [*unseen, *([] if settled else [moving]), *([] if result.settled else [changing])]
    warnings += [*_warnings(result, projection, board), *of_lens_model(result, views, board)]
    try:
        of_held_out = held_out(result, views, board)
    except StcalError as error:
        of_held_out = None
        warnings.append(f"no views could be held out, as the others alone are too few: {error}")
    return CameraCalibration(result, tuple(views), skipped, rounds, projection, of_held_out, tuple(warnings))


def require_views(views: Sequence[ImageObservations], files: Sequence[ImageFile], skipped: Sequence[Skipped]) -> None:
    if len(views) >= MIN_VIEWS:
        return
    images = {file.name for file in files}  # other files are skipped too, and explain nothing
    why = next((f"; {each.name}: {each.reason}" for each in skipped if each.name in images), "")
    if not views:
        raise DetectionError(
            "E-BOARD-NOT-FOUND",
            f"camera: no board recognised in {len(files)} images{why}; check the board file (rows, columns, "
            "corner, polarity, radius) and keep a third of the dots in view at least",
        )
    raise DegenerateError(
        "E-CALIBRATE-FEW-VIEWS",
        f"camera: {len(views)} of {len(files)} images show the board, {MIN_VIEWS} needed, 10 and more advised{why}; "
        "add views in which it is tilted by 20° to 40°",
    )


def require_determined(result: Intrinsics, views: Sequence[ImageObservations], board: BoardDesign) -> None:
    """Checks that the views determine the focal length and that the lens model fits them."""
    rms = weighted_rms_px(result)
    if rms > MAX_RESIDUAL_PX:
        found = explain(larger_models(result, views, board), weighted_rms_px, MAX_RESIDUAL_PX)
        other = "choose a --model with more parameters, check the board file, use images of one focus and zoom"
        remedy = found[0][0].words if found else other
        raise DegenerateError(
            "E-CALIBRATE-MISFIT",
            f"camera: dots are {rms:.1f} px RMS from where {result.colmap_model} puts them, {MAX_RESIDUAL_PX:g} px "
            f"allowed; {remedy}",
        )
    relative = float(result.sigma()[0] / result.camera.focal[0])
    if relative > MAX_FOCAL_SIGMA:
        normals = np.array([pose.rotation[:, 2] for model in result.models for pose in model.camera_from_model])
        spread_deg = np.degrees(np.arccos(np.clip((normals @ normals.T).min(), -1, 1)))
        raise DegenerateError(
            "E-CALIBRATE-UNDETERMINED",
            f"camera: focal length determined to {100 * relative:.2g} % by {len(views)} views, "
            f"{100 * MAX_FOCAL_SIGMA:.0f} % needed (largest angle between boards {spread_deg:.0f}°); "
            "add views in which the board is tilted by 20° to 40°, about different axes",
        )


def residual_rms_px(result: Intrinsics) -> float:
    return float(np.sqrt((result.residuals_px() ** 2).mean()))


def weighted_rms_px(result: Intrinsics) -> float:
    """Returns the RMS residual per coordinate, px, with the adjustment's weights, which gross errors hardly change."""
    weight = np.concatenate(result.weights())
    return float(np.sqrt(np.average((result.residuals_px() ** 2).mean(axis=1), weights=weight)))


def _next_move(before: Intrinsics, after: Intrinsics) -> float:
    """Returns the predicted largest move of a parameter by another round, in σ, as projections' moves decrease."""
    moved = model_parameters(after.camera, after.colmap_model) - model_parameters(before.camera, before.colmap_model)
    ideal = before.camera.normalised_from_pixel(image_grid(before.camera))
    bent_px = np.abs((before.camera.distort(ideal) - ideal) * before.camera.focal).max()
    moved_px = np.abs(projection_jacobian(before.camera, before.colmap_model) @ moved).max()
    return float(np.abs(moved / after.sigma()).max() * min(1.0, moved_px / max(bent_px, 1e-9)))


def _warnings(result: Intrinsics, projection: ProjectionSigma, board: BoardDesign) -> list[str]:
    centres, dots, differ = result.factors.centres, result.factors.dots, result.differ
    restarted = (
        "from the closed form no minimum was reached, only from the best focal length: other minima may exist, and "
        "σ hold about this one alone; add views that fill the image and are tilted, or choose a simpler --model"
    )
    corners = [
        f"no dots near the corner {corner}: they reach {100 * reach:.0f} %, {100 * MIN_REACH:.0f} % advised, the "
        f"distortion is extrapolated there, σ of a projection {sigma:.3f} px; add views with the board in it"
        for corner, reach, sigma in zip(CORNERS, projection.reach, projection.corner_sigma_px, strict=True)
        if reach < MIN_REACH
    ]
    suspicious = {
        f"residuals exceed the σ of the centres {centres:.1f} times: σ are scaled by it, but images are blurred or "
        "moved": centres,
        f"dots deviate from the grid {dots:.1f} times as much as the board file says: sigma_mm = "
        f"{dots * board.sigma_mm:.3g} fits, {board.sigma_mm:g} is stated": dots,
        f"photographs differ {differ:.1f} times more than their pixels explain, and σ are larger by that; keep "
        "focus and zoom fixed, and the light even": differ,
    }
    return [restarted] * result.restarted + corners + [said for said, v in suspicious.items() if v > SUSPICIOUS_FACTOR]
