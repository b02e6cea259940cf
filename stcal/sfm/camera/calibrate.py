"""Calibration of an unknown camera from photographs of the dot board: the calls in order, checks, and lens models."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
from scipy.optimize import least_squares

from stcal.adjust.blocks import Vector
from stcal.design import BoardDesign, TargetDesign
from stcal.errors import ConvergenceError, DegenerateError, DetectionError, InputError, StcalError
from stcal.explain import Candidate, explain
from stcal.geometry.arrays import Brief, require_arguments, rms
from stcal.geometry.camera import COLMAP_MODELS, FISHEYE, Camera, intrinsic_basis, parameter_names
from stcal.geometry.rigid import Poses
from stcal.io.cameras.camera_model import OF_IMAGES, CameraModel
from stcal.io.images import ImageFile, Skipped, find_images, require_common_size
from stcal.labels import DotLabel, Label, unseen_lines
from stcal.parallel import Progress, counted, one_thread, run_in_order, scratch_folder
from stcal.sfm.adjust.refine import eccentricity_px, placed
from stcal.sfm.camera import intrinsics
from stcal.sfm.camera.intrinsics import Intrinsics, ProjectionSigma, adjust_intrinsics, model_parameters
from stcal.sfm.data.group_model import ImageObservations
from stcal.sfm.data.patterns import MIN_DOTS, pattern_of_board
from stcal.sfm.detect.candidates import EllipseOptions
from stcal.sfm.detect.defocus import correct_defocus
from stcal.sfm.detect.detect_files import DetectionResult, detect_files

R = TypeVar("R")
MIN_REACH = 0.75  # of dots from the middle towards a corner, as advised: beyond it little distortion is extrapolated


CELLS = (12, 8)  # number of cells of the image, in x and y, within which residuals are compared
AGREEING, AGREEING_SIGMAS = 0.03, 4.0  # correlation between photographs that is worth a larger lens model
LARGER = {
    **dict.fromkeys(("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL"), "OPENCV"),
    **dict.fromkeys(("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"), "OPENCV_FISHEYE"),
    "OPENCV": "FULL_OPENCV",
    "OPENCV_FISHEYE": "THIN_PRISM_FISHEYE",
}
"""The lens model to try where one is too small."""


def mean_residuals(result: Intrinsics) -> tuple[np.ndarray, np.ndarray]:
    """Returns the weighted mean residual (v, cells, 2) of each photograph in each cell, px, and weights (v, cells)."""
    camera, first = result.camera, np.cumsum([0, *(len(model.images) for model in result.models)])
    image = np.concatenate([k + model.image_index for k, model in zip(first[:-1], result.models, strict=True)])
    xy, weight = np.concatenate([model.measured_px for model in result.models]), np.concatenate(result.weights())
    across, down = np.clip((xy / (camera.width, camera.height) * CELLS).astype(int), 0, np.array(CELLS) - 1).T
    cell = across * CELLS[1] + down
    mean, total = np.zeros((first[-1], CELLS[0] * CELLS[1], 2)), np.zeros((first[-1], CELLS[0] * CELLS[1]))
    np.add.at(mean, (image, cell), weight[:, None] * result.residuals_px())
    np.add.at(total, (image, cell), weight)
    return mean / np.maximum(total, 1e-12)[..., None], total


def agreement(result: Intrinsics) -> tuple[float, float]:
    """Returns the correlation between photographs of residuals at the same place of the image, and its σ by chance.
    What the lens model leaves is alike in all photographs; what light, focus and board leave is not."""
    mean, total = mean_residuals(result)
    square, count = (mean**2).sum(2), (total > 0).sum(0)
    both = float(((mean.sum(0) ** 2).sum(1) - square.sum(0)).sum())
    most, pairs = float(((count - 1) * square.sum(0)).sum()), float((count * (count - 1)).sum())
    return (both / most, 1 / np.sqrt(pairs)) if most > 0 and pairs else (0.0, 1.0)


def larger_models(result: Intrinsics, views: Sequence[ImageObservations], board: BoardDesign) -> list[Candidate]:
    """Returns the lens model to try if that of ``result`` is too small."""
    larger = LARGER.get(result.colmap_model)
    return [Candidate(f"use --model {larger}", lambda: _fitted(views, board, result.camera, larger))] if larger else []


def of_lens_model(result: Intrinsics, views: Sequence[ImageObservations], board: BoardDesign) -> list[str]:
    """Returns a warning where residuals agree between photographs, with the larger lens model if that explains it."""
    found, chance = agreement(result)
    if found < max(AGREEING, AGREEING_SIGMAS * chance):
        return []
    why = ", which is in no σ: look at the mean residuals, and at light that is alike in all photographs"
    for model, left in explain(larger_models(result, views, board), lambda fit: agreement(fit)[0], found / 2):
        why = f", {left:.2f} with a larger lens model: {result.colmap_model} is too small; {model.words}"
    return [f"residuals at one place of the image agree between photographs, correlation {found:.2f}{why}"]


FOLDS = 5
MIN_TRAINING = 3  # smallest number of views to calibrate with
CANDIDATES = (
    *("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"),
    *("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE", "THIN_PRISM_FISHEYE"),
)
AUTO = "auto"  # name of the option value for which :func:`choose_model` selects the model
LIKELY = 2.0
"""Number of standard errors by which a model with fewer parameters may be worse than the best and still be selected;
after the one-standard-error rule, Hastie, Tibshirani & Friedman 2009, The Elements of Statistical Learning, 7.10."""
HOPELESS = 3.0  # ratio of residuals to those of the best model from which on a model is not tried further
CLIP_SIGMAS = 5.0  # limit of residuals: gross errors of dots carry no information about the lens


@dataclass(frozen=True, slots=True, eq=False)
class HeldOut:
    """Residuals of views that were not used by the calibration; only the poses of these views were fitted."""

    residuals_px: tuple[np.ndarray, ...]  # by view, (n, 2)
    in_sigma: tuple[np.ndarray, ...]  # the same in the detected centres' σ
    factor: float  # median, by which residuals of the calibrations exceed these σ
    folds: int  # number of parts

    def rms_px(self) -> float:
        """Returns the RMS per coordinate without gross errors."""
        most = CLIP_SIGMAS * self.factor
        kept = [px[np.abs(own).max(axis=1) < most] for px, own in zip(self.residuals_px, self.in_sigma, strict=True)]
        return rms(np.concatenate(kept))

    def squares(self, factor: float) -> np.ndarray:
        """Returns the mean square of each view in σ times ``factor``, (v,). Residuals beyond 5 count as 5."""
        return np.array([(np.minimum(np.abs(own) / factor, CLIP_SIGMAS) ** 2).mean() for own in self.in_sigma])


@dataclass(frozen=True, slots=True)
class TriedModel:
    model: str
    parameters: int  # their number
    rms_px: float | None  # of held-out views
    worse: float | None  # their mean square minus that of the best model, in σ²
    worse_sigma: float | None  # its standard error
    why: str = ""  # it could not be tried


def held_out(
    result: Intrinsics, views: Sequence[ImageObservations], board: BoardDesign, folds: int = FOLDS
) -> HeldOut | None:
    """Returns the residuals of all ``views`` of a ``result``, each held out once; None with too few views. The places
    of the dots are those estimated from the other views of the folder, or design places if there are none. Raises
    StcalError: a calibration without some of the views fails."""
    folds = min(folds, len(views))
    if len(views) - -(-len(views) // folds) < MIN_TRAINING:
        return None
    residuals_of_view: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    factors = []
    for fold in range(folds):
        without = intrinsics.of_some_views(result, [view for i, view in enumerate(views) if i % folds != fold], board)
        factors.append(without.factors.centres)
        residuals_of_view |= {view.name: prediction_errors(view, board, without) for view in views[fold::folds]}
    residuals_px, in_sigma = zip(*(residuals_of_view[view.name] for view in views), strict=True)
    return HeldOut(residuals_px, in_sigma, float(np.median(factors)), folds)


def choose_model(
    views: Sequence[ImageObservations], board: BoardDesign, known: Intrinsics, workers: int | None = None
) -> tuple[str, tuple[TriedModel, ...]]:
    """Returns the simplest lens model that predicts held-out views as well as the best one, and all candidates.
    ``known``: intrinsics of any model that fits, at which models of the same projection start."""
    jobs = [(_fitted, views, board, known.camera, model) for model in CANDIDATES]
    fits = dict(zip(CANDIDATES, run_in_order(_or_error, jobs, workers), strict=True))
    fitted = {model: fit for model, fit in fits.items() if isinstance(fit, Intrinsics)}
    why = {model: str(fit) for model, fit in fits.items() if isinstance(fit, StcalError)}
    least = min(fitted, key=lambda model: fitted[model].factors.centres, default="")
    for model, fit in fitted.items():
        if (ratio := fit.factors.centres / fitted[least].factors.centres) > HOPELESS:
            why[model] = f"residuals {ratio:.3g} times those of {least}"
    tried = [model for model in fitted if model not in why]
    outcomes = run_in_order(_or_error, [(held_out, fitted[model], views, board) for model in tried], workers)
    both = dict(zip(tried, outcomes, strict=True))
    fared = {model: outcome for model, outcome in both.items() if isinstance(outcome, HeldOut)}
    why |= {model: str(outcome or "too few views") for model, outcome in both.items() if model not in fared}
    if not fared:
        errors = [fit for fit in fits.values() if isinstance(fit, StcalError)]
        if errors and not tried:
            raise errors[0]
        fault = f"--model auto: {len(views)} views, {MIN_TRAINING + 1} needed"
        raise DegenerateError("E-CALIBRATE-FEW-VIEWS", f"{fault}; add views, or choose a --model")
    factor = min(entry.factor for entry in fared.values())  # one σ for all models: that of the model that fits best
    squares = {model: entry.squares(factor) for model, entry in fared.items()}
    best = min(squares, key=lambda model: squares[model].mean())
    rows = []
    for model in CANDIDATES:
        row = TriedModel(model, len(parameter_names(model)), None, None, None, why.get(model, ""))
        if model in fared:
            apart = squares[model] - squares[best]
            sigma = float(apart.std(ddof=1) / np.sqrt(len(apart)))
            row = replace(row, rms_px=fared[model].rms_px(), worse=float(apart.mean()), worse_sigma=sigma)
        rows.append(row)
    as_good = [row for row in rows if row.worse is not None and row.worse <= LIKELY * (row.worse_sigma or 0.0)]
    return min(as_good, key=lambda row: (row.parameters, row.worse or 0.0)).model, tuple(rows)


def _fitted(views, board: BoardDesign, known: Camera, model: str) -> Intrinsics:
    start = known.with_parameters(intrinsic_basis(model) @ model_parameters(known, model))
    if known.fisheye != (FISHEYE in model):
        start = intrinsics.closed_form(views, board, intrinsics.start_camera(known.width, known.height, model))
    return adjust_intrinsics(views, board, start, model)


def _or_error(function: Callable[..., R], *arguments) -> R | StcalError:
    try:
        return function(*arguments)
    except StcalError as error:
        return error


def prediction_errors(view: ImageObservations, board: BoardDesign, result: Intrinsics) -> tuple[np.ndarray, np.ndarray]:
    """Returns the residuals (n, 2) of a view, px and in the detected centres' σ, after its pose is fitted."""
    camera, factor = result.camera, result.factors.centres
    model = intrinsics.model_of_views([view], board, camera)
    known = [own for own in result.models if own.group == view.group]
    places = {label: xyz for own in known for label, xyz in zip(own.labels, own.xyz_model, strict=True)}
    points = Vector(np.array([places.get(label, at) for label, at in zip(model.labels, model.xyz_model, strict=True)]))
    model = replace(model, xyz_model=points.array)
    radius: dict[Label, float] = {**board.radius_of()}
    for _ in range(2):  # eccentricity hardly changes with the pose
        model = replace(model, shift_px=eccentricity_px(model, camera, radius, 1.0))
        begin, poses = model, Poses.of(model.camera_from_model)

        def left(step: np.ndarray, begin=begin, poses=poses) -> np.ndarray:
            moved = placed(begin, poses.moved(step[None]), points)
            return moved.whiten(moved.residuals_px(camera)).ravel() / factor

        depth = float(np.linalg.norm(poses.translation[0]))
        solution = least_squares(left, np.zeros(6), loss="huber", f_scale=2.0, x_scale=[1, 1, 1, depth, depth, depth])
        model = placed(begin, poses.moved(solution.x[None]), points)
    residual = model.residuals_px(camera)
    return residual, model.whiten(residual)


GROSS_SIGMAS = 10.0  # smallest deviation of a gross error from camera and board; it is above MAX_RESIDUAL_PX, too
LEAST_CORNERS = 6  # smallest number of corners of a view of which others were left out: they still check one another
LEAST_SHARE = 0.5  # of the corners of a view that are no gross errors; with fewer of them the view is not used


def without_gross_errors(
    views: Sequence[ImageObservations], grid: BoardDesign, result: Intrinsics
) -> tuple[list[ImageObservations], list[Skipped], list[str]]:
    """Returns the views without gross errors, those that consist of them, and a warning about the others."""
    suspects = {
        model.images[image]
        for model in result.models
        for image in model.image_index[np.linalg.norm(model.residuals_px(result.camera), axis=1) > MAX_RESIDUAL_PX]
    }
    limits = f"{GROSS_SIGMAS:g} σ and {MAX_RESIDUAL_PX:g} px"
    kept, skipped, off = [], [], []
    for view in views:
        own = view
        while view.name in suspects and len(own) > LEAST_CORNERS:  # one by one: each disturbs the pose, and the others
            length_px, in_sigmas = (np.linalg.norm(each, axis=1) for each in prediction_errors(own, grid, result))
            in_sigmas /= result.factors.centres
            worst = int(np.argmax(np.where(length_px > MAX_RESIDUAL_PX, in_sigmas, 0)))
            if length_px[worst] <= MAX_RESIDUAL_PX or in_sigmas[worst] <= GROSS_SIGMAS:
                break
            own = own.select(np.delete(np.arange(len(own)), worst))
        if len(own) < max(LEAST_CORNERS, LEAST_SHARE * len(view)):
            far = f"{len(view) - len(own)} of {len(view)} corners lie more than {limits}"
            reason = f"{far} from where the camera and the other views put them"
            skipped.append(Skipped(view.name, reason, "corners", f"{len(own)}", f"{LEAST_SHARE * len(view):.0f}"))
            continue
        kept.append(own)
        off += [(view.name, label) for label in view.labels if label not in own.labels]
    if not off:
        return kept, skipped, []
    left_out = f"{len(off)} corners in {len(dict(off))} views are left out, first {' '.join(off[0])}"
    why = f"they lie more than {limits} from where the camera and all views put them"
    return kept, skipped, [f"{left_out}: {why}; look whether something hides the board there"]


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
    images : Folder of photographs, or of folders of them.
    target : Target that may also be in view; its circles are then not taken for dots.
    board : The dot board, mm, with the σ of its dots.
    colmap_model : COLMAP's camera model to adjust, such as ``OPENCV``; or ``auto``, the simplest model that predicts
        held-out views as well as the best one.
    ellipses : Options of detection; the defaults if None.
    workers : Number of processes; one per core if None.
    progress : Called with (stage, done, total).

    Returns
    -------
    CameraCalibration : Intrinsics with the covariance of their parameters, px and OpenCV's pixel origin; the views
        used, and warnings.

    Raises
    ------
    StcalError : A stage failed. The one-line message says what to do.
    """
    ellipses, progress = ellipses or EllipseOptions(), progress or (lambda *_: None)
    with scratch_folder("camera") as cache:

        def find(files: list[ImageFile], lens: CameraModel, camera: Camera, number: int, first: bool) -> Found:
            step = counted(progress, f"detect {number}", len(files))
            inputs = files, lens, target, board, ellipses, Path(cache), workers, step
            return views_of_dots(detect_files(*inputs, pictures=False), board, camera, first)

        return calibrated(find, images, board, colmap_model, workers)


Found = tuple[list[ImageObservations], tuple[Skipped, ...]]
Finder = Callable[[list[ImageFile], CameraModel, Camera, int, bool], Found]
"""Returns views and what was skipped, from files, the camera without its size, the camera, the number of the round of
detection, and whether it is the first, in which the camera is rough."""


def calibrated(
    find: Finder, images: str | Path, board: BoardDesign, colmap_model: str, workers: int | None, rounds: int = 0
) -> CameraCalibration:
    """Returns the calibration by the views that ``find`` sees in a folder's photographs; with ``auto``, of the best
    lens model. ``rounds``: of detection, after which gross errors are removed; 0: until the camera settles."""
    if colmap_model == AUTO:
        return of_chosen_model(lambda model: calibrated(find, images, board, model, workers, rounds), board, workers)
    if colmap_model not in COLMAP_MODELS:
        fault = f"camera model {colmap_model}: not supported"
        raise InputError("E-CAMERA-MODEL", f"{fault}; use one of {', '.join(COLMAP_MODELS)} or {AUTO}")
    files, not_images = find_images(images)
    camera = intrinsics.start_camera(*require_common_size(files)[0], colmap_model)
    before: Intrinsics | None = None
    settled, of_perspective, warnings = False, False, []
    for number in range(1, (rounds or MAX_ROUNDS) + 1):
        try:
            # Without its size, which then comes from most of the images, and messages say so.
            lens = CameraModel(camera.focal, camera.centre, camera.distortion, colmap_model, None, None, OF_IMAGES)
            views, skipped = find(files, lens, camera, number, before is None)
            skipped = (*not_images, *skipped)
            require_views(views, files, skipped)
            start = intrinsics.closed_form(views, board, camera) if before is None else camera
            result = adjust_intrinsics(views, board, start, colmap_model)
            if not rounds:
                require_determined(result, views, board)
        except (DetectionError, DegenerateError):
            if rounds or before is not None or of_perspective or not camera.fisheye:
                raise
            # With the focal length of a wide lens, boards of a longer one look bent. A perspective model finds it.
            found = calibrated(find, images, board, PERSPECTIVE, workers)
            camera, of_perspective = replace(camera, focal=found.intrinsics.camera.focal), True
            continue
        result = replace(result, restarted=result.restarted or (before is not None and before.restarted))
        camera = result.camera
        settled = before is not None and _next_move(before, result) < SETTLED_SIGMAS
        if settled and not rounds:
            break
        before = result
    if rounds:
        kept, without, warnings = without_gross_errors(views, board, result)
        if without or warnings:
            views, skipped = kept, (*skipped, *without)
            require_views(views, files, skipped)
            result = replace(adjust_intrinsics(views, board, camera, colmap_model), restarted=result.restarted)
        require_determined(result, views, board)
    calibration = judged(result, views, skipped, number, settled or rounds > 0, board)
    return replace(calibration, warnings=(*calibration.warnings, *warnings))


def views_of_dots(detection: DetectionResult, board: BoardDesign, camera: Camera, first: bool) -> Found:
    """Returns the views of the board in detected images, sharp but in the ``first`` round, and what was skipped."""
    views = intrinsics.board_views(detection.images, board, camera)
    if not first:
        views, _ = correct_defocus(views, camera, pattern_of_board(board))
    shown, skipped = {view.name for view in views}, list(detection.skipped)
    for each in detection.images:
        why = "; ".join(["no board recognised", *each.detection.notes[:1]])
        if "board" in each.detection.repeated:
            why = "the board is in view more than once"
        skipped += [] if each.file.name in shown else [Skipped(each.file.name, why)]
    return views, tuple(skipped)


def camera_of_dots(
    files: Sequence[ImageFile], detection: DetectionResult, board: BoardDesign, start: Camera, colmap_model: str
) -> Intrinsics:
    """Returns the intrinsics by the boards of one detection, which was made with the rough camera ``start``."""
    views, skipped = views_of_dots(detection, board, start, first=True)
    require_views(views, files, skipped)
    result = adjust_intrinsics(views, board, intrinsics.closed_form(views, board, start), colmap_model)
    require_determined(result, views, board)
    return result


def camera_of_labelled(
    images: Sequence[ImageObservations], board: BoardDesign, camera: Camera
) -> tuple[Intrinsics, Intrinsics]:
    """Returns the intrinsics by the labelled dots of the board alone, and an adjustment that keeps those of ``camera``.
    The first begins at a lens that ``camera`` does not influence, and has the same model."""
    dots = [[k for k, label in enumerate(image.labels) if isinstance(label, DotLabel)] for image in images]
    views = [image.select(own) for image, own in zip(images, dots, strict=True) if len(own) >= MIN_DOTS]
    require_views(views, (), ())
    model = camera.colmap_model
    start = intrinsics.closed_form(views, board, intrinsics.start_camera(camera.width, camera.height, model))
    found = adjust_intrinsics(views, board, start, model)
    require_determined(found, views, board)
    return found, adjust_intrinsics(views, board, camera, model, held=True)


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
    projection = intrinsics.projection_sigma(result)
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
        fault = f"camera: no board recognised in {len(files)} images{why}"
        remedy = "check the board file (rows, columns, corner, polarity, radius)"
        raise DetectionError("E-BOARD-NOT-FOUND", f"{fault}; {remedy} and keep a third of the dots in view at least")
    fault = f"camera: {len(views)} of {len(files)} images show the board, {MIN_VIEWS} needed, 10 and more advised{why}"
    raise DegenerateError("E-CALIBRATE-FEW-VIEWS", f"{fault}; add views in which it is tilted by 20° to 40°")


def require_determined(result: Intrinsics, views: Sequence[ImageObservations], board: BoardDesign) -> None:
    """Checks that the views determine the focal length and that the lens model fits them."""
    misfit_px = weighted_rms_px(result)
    if misfit_px > MAX_RESIDUAL_PX:
        found = explain(larger_models(result, views, board), weighted_rms_px, MAX_RESIDUAL_PX)
        other = "choose a --model with more parameters, check the board file, use images of one focus and zoom"
        remedy, allowed = found[0][0].words if found else other, f"{MAX_RESIDUAL_PX:g} px allowed"
        fault = f"camera: dots are {misfit_px:.1f} px RMS from where {result.colmap_model} puts them, {allowed}"
        raise DegenerateError("E-CALIBRATE-MISFIT", f"{fault}; {remedy}")
    relative = float(result.sigma()[0] / result.camera.focal[0])
    if relative > MAX_FOCAL_SIGMA:
        normals = np.array([pose.rotation[:, 2] for model in result.models for pose in model.camera_from_model])
        spread_deg = np.degrees(np.arccos(np.clip((normals @ normals.T).min(), -1, 1)))
        needed = f"{100 * MAX_FOCAL_SIGMA:.0f} % needed (largest angle between boards {spread_deg:.0f}°)"
        fault = f"camera: focal length determined to {100 * relative:.2g} % by {len(views)} views, {needed}"
        remedy = "add views in which the board is tilted by 20° to 40°, about different axes"
        raise DegenerateError("E-CALIBRATE-UNDETERMINED", f"{fault}; {remedy}")


def residual_rms_px(result: Intrinsics) -> float:
    return rms(result.residuals_px())


def weighted_rms_px(result: Intrinsics) -> float:
    """Returns the RMS residual per coordinate, px, with the adjustment's weights, which gross errors hardly change."""
    weight = np.concatenate(result.weights())
    return float(np.sqrt(np.average((result.residuals_px() ** 2).mean(axis=1), weights=weight)))


def _next_move(before: Intrinsics, after: Intrinsics) -> float:
    """Returns the predicted largest move of a parameter by another round, in σ, as projections' moves decrease."""
    moved = model_parameters(after.camera, after.colmap_model) - model_parameters(before.camera, before.colmap_model)
    ideal = before.camera.normalised_from_pixel(intrinsics.image_grid(before.camera))
    bent_px = np.abs((before.camera.distort(ideal) - ideal) * before.camera.focal).max()
    moved_px = np.abs(intrinsics.projection_jacobian(before.camera, before.colmap_model) @ moved).max()
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
