"""Cross-validation of intrinsics: views that were held out, and the lens model that foretells them best."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from operator import itemgetter
from typing import TypeVar

import numpy as np
from scipy.optimize import least_squares

from stcal.design import BoardDesign
from stcal.errors import DegenerateError, StcalError
from stcal.geometry.camera import Camera
from stcal.io.cameras.model import FISHEYE, intrinsic_basis, parameter_names
from stcal.labels import Label
from stcal.parallel import run_parallel
from stcal.sfm.adjust.group import moved_poses
from stcal.sfm.adjust.refine import eccentricity_px
from stcal.sfm.camera.intrinsics import Intrinsics, adjust_intrinsics, model_of_views, model_parameters
from stcal.sfm.camera.views import closed_form, start_camera
from stcal.sfm.data.observations import ImageObservations, by_group

FOLDS = 5
MIN_TRAINING = 3
"""Views to calibrate with."""
CANDIDATES = (
    *("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"),
    *("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE", "THIN_PRISM_FISHEYE"),
)
AUTO = "auto"
"""In place of a model: the one that :func:`choose_model` takes."""
LIKELY = 2.0
"""Standard errors by which a model with fewer parameters may be worse than the best in the mean and still be taken;
after the rule of one, Hastie, Tibshirani & Friedman 2009, The Elements of Statistical Learning, 7.10."""
HOPELESS = 3.0
"""Times the residuals of the model that fits best; what fits worse is not tried further."""
T = TypeVar("T")
POSE_PASSES = 2
"""Eccentricity of circles hardly changes with the pose."""
CLIP_SIGMAS = 5.0
"""A dot that is measured wrongly tells nothing of the lens."""


@dataclass(frozen=True, slots=True, eq=False)
class HeldOut:
    """Residuals of views that the calibration did not have: their poses alone were fitted to them.

    ``residuals_px`` and ``in_sigma`` : by view, (n, 2), px and in the centres' own σ; ``factor`` : by which residuals
    of the calibrations exceed those, as a median; ``folds`` .
    """

    residuals_px: tuple[np.ndarray, ...]
    in_sigma: tuple[np.ndarray, ...]
    factor: float
    folds: int

    def rms_px(self, factor: float | None = None) -> float:
        """Per coordinate, without dots that are wrong; ``factor`` : in place of the own one."""
        most = CLIP_SIGMAS * (factor or self.factor)
        kept = [px[np.abs(own).max(axis=1) < most] for px, own in zip(self.residuals_px, self.in_sigma, strict=True)]
        return float(np.sqrt((np.concatenate(kept) ** 2).mean()))

    def squares(self, factor: float) -> np.ndarray:
        """Mean square of each view in σ times that factor, (v,); what is beyond five counts as five."""
        return np.array([(np.minimum(np.abs(own) / factor, CLIP_SIGMAS) ** 2).mean() for own in self.in_sigma])


@dataclass(frozen=True, slots=True)
class Candidate:
    """A lens model: how many parameters it has, RMS of held-out views, by how much worse than the best model their mean
    square is, in σ, and the standard error of that; ``why`` it could not be tried, or ``""``."""

    model: str
    parameters: int
    rms_px: float | None
    worse: float | None
    worse_sigma: float | None
    why: str = ""


def held_out(
    views: Sequence[ImageObservations], board: BoardDesign, start: Camera, colmap_model: str, folds: int = FOLDS
) -> HeldOut | None:
    """Every view held out once; None with too few views.

    The places of the dots are those that the other views of its folder gave, with the design where there are none.

    Raises
    ------
    StcalError
        A calibration without some of the views fails.
    """
    folds = min(folds, len(views))
    if len(views) - -(-len(views) // folds) < MIN_TRAINING:
        return None
    found: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    factors = []
    for fold in range(folds):
        own = [view for i, view in enumerate(views) if i % folds == fold]
        others = [view for i, view in enumerate(views) if i % folds != fold]
        result = adjust_intrinsics(others, board, start, colmap_model)
        factors.append(result.factors.centres)
        found |= {view.name: foretold(view, board, result) for view in own}
    residuals_px, in_sigma = zip(*(found[view.name] for view in views), strict=True)
    return HeldOut(residuals_px, in_sigma, float(np.median(factors)), folds)


def choose_model(
    views: Sequence[ImageObservations], board: BoardDesign, known: Intrinsics, workers: int | None = None
) -> tuple[str, tuple[Candidate, ...]]:
    """The simplest lens model that foretells held-out views as well as the best one, and how all of them fare.

    Parameters
    ----------
    views : sequence of ImageObservations
        Dots of the board, found with about the right camera.
    board : BoardDesign
    known : Intrinsics
        Of any model that fits; where each begins, if of the same projection.
    workers : int, optional
        Processes; one per core where None.

    Raises
    ------
    StcalError
        None can be calibrated with four fifths of the views.
    """
    fitted = dict(
        zip(CANDIDATES, _all(_fitted, [(views, board, known.camera, m) for m in CANDIDATES], workers), strict=True)
    )
    factors = {m: each.factors.centres for m, each in fitted.items() if isinstance(each, Intrinsics)}
    why = {m: str(each) for m, each in fitted.items() if isinstance(each, StcalError)}
    least = min(factors, key=factors.__getitem__, default="")
    for model, factor in factors.items():
        if factor > HOPELESS * factors[least]:
            why[model] = f"residuals {factor / factors[least]:.3g} times those of {least}"
    jobs = {
        m: (views, board, each.camera, m) for m, each in fitted.items() if isinstance(each, Intrinsics) and m not in why
    }
    fared: dict[str, HeldOut] = {}
    for model, outcome in zip(jobs, _all(_tried, list(jobs.values()), workers), strict=True):
        if isinstance(outcome, HeldOut):
            fared[model] = outcome
        else:
            why[model] = str(outcome or "too few views")
    if not fared:
        failed = next((each for each in fitted.values() if isinstance(each, StcalError)), None)
        raise failed if failed and not jobs else _too_few(len(views))
    factor = min(each.factor for each in fared.values())  # one measure for all: that of the model that fits best
    squares = {model: each.squares(factor) for model, each in fared.items()}
    best = min(squares, key=lambda model: squares[model].mean())
    rows = [_row(model, fared.get(model), squares, best, why.get(model, "")) for model in CANDIDATES]
    as_good = [row for row in rows if row.worse is not None and row.worse <= LIKELY * (row.worse_sigma or 0.0)]
    chosen = min(as_good, key=lambda row: (row.parameters, row.worse or 0.0))
    return chosen.model, tuple(rows)


def _too_few(count: int) -> StcalError:
    return DegenerateError(
        "E-CALIBRATE-FEW-VIEWS",
        f"--model auto: {count} views, {MIN_TRAINING + 1} needed; add views, or choose a --model",
    )


def _row(model: str, outcome: HeldOut | None, squares: dict[str, np.ndarray], best: str, why: str) -> Candidate:
    count = len(parameter_names(model))
    if outcome is None:
        return Candidate(model, count, None, None, None, why)
    apart = squares[model] - squares[best]
    sigma = float(apart.std(ddof=1) / np.sqrt(len(apart)))
    return Candidate(model, count, outcome.rms_px(), float(apart.mean()), sigma)


def _all(function: Callable[..., T], jobs: list[tuple], workers: int | None) -> list[T]:
    """Results in the order of the jobs."""
    return [result for _, result in sorted(run_parallel(function, jobs, workers), key=itemgetter(0))]


def _fitted(views, board: BoardDesign, known: Camera, model: str) -> Intrinsics | StcalError:
    start = known.with_parameters(intrinsic_basis(model) @ model_parameters(known, model))
    if known.fisheye != (FISHEYE in model):
        start = closed_form(views, board, start_camera(known.width, known.height, model))
    try:
        return adjust_intrinsics(views, board, start, model)
    except StcalError as error:
        return error


def _tried(views, board: BoardDesign, start: Camera, model: str) -> HeldOut | StcalError | None:
    try:
        return held_out(views, board, start, model)
    except StcalError as error:
        return error


def foretold(view: ImageObservations, board: BoardDesign, result: Intrinsics) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (n, 2) of a view, px and in the centres' own σ, after its pose is fitted to it."""
    camera = result.camera
    ((group, members),) = by_group([view]).items()
    model = model_of_views(group, view.labels, members, board, camera)
    places = {label: xyz for own in result.models if own.group == group for label, xyz in _places(own)}
    xyz = np.array([places.get(label, at) for label, at in zip(model.labels, model.xyz_model, strict=True)])
    model = replace(model, xyz_model=xyz)
    factor = result.factors.centres
    radius: dict[Label, float] = {**board.radius_of()}
    for _ in range(POSE_PASSES):
        model = replace(model, shift_px=eccentricity_px(model, camera, radius, 1.0))
        begin = model

        def left(step: np.ndarray, begin=begin) -> np.ndarray:
            moved = replace(begin, camera_from_model=moved_poses(begin.camera_from_model, step[None]))
            return moved.whiten(moved.residuals_px(camera)).ravel() / factor

        depth = float(np.linalg.norm(begin.camera_from_model[0].translation))
        found = least_squares(left, np.zeros(6), loss="huber", f_scale=2.0, x_scale=[1, 1, 1, depth, depth, depth])
        model = replace(model, camera_from_model=moved_poses(begin.camera_from_model, found.x[None]))
    residual = model.residuals_px(camera)
    return residual, model.whiten(residual)


def _places(model) -> list[tuple[Label, np.ndarray]]:
    return list(zip(model.labels, model.xyz_model, strict=True))
