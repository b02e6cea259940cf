"""Checks of calibrated intrinsics: σ of projections over the image, cross-validation of lens models."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from scipy.optimize import least_squares

from stcal.adjust.blocks import Vector
from stcal.design import BoardDesign
from stcal.errors import ConvergenceError, DegenerateError, StcalError
from stcal.explain import Candidate, explain
from stcal.geometry.camera import FISHEYE, Camera, intrinsic_basis, parameter_names
from stcal.geometry.least_squares import PoseStack
from stcal.labels import Label
from stcal.parallel import run_in_order
from stcal.sfm.adjust.refine import eccentricity_px, placed
from stcal.sfm.camera.intrinsics import (
    Intrinsics,
    adjust_intrinsics,
    closed_form,
    model_of_views,
    model_parameters,
    of_some_views,
    start_camera,
)
from stcal.sfm.data.model import ImageObservations, by_group

R = TypeVar("R")
GRID = (13, 9)
MIN_REACH = 0.75  # of dots from the middle towards a corner, as advised: beyond it little distortion is extrapolated


@dataclass(frozen=True, slots=True, eq=False)
class ProjectionSigma:
    sigma_px: np.ndarray  # (n,) per axis at :func:`image_grid`, up to a rotation of the camera, which poses absorb
    reach: np.ndarray  # (4,) of dots towards the corners (top left, top right, bottom left, bottom right), 1 there
    corner_sigma_px: np.ndarray  # (4,)


def image_grid(camera: Camera) -> np.ndarray:
    """Returns a grid of places over the whole image, including the corners, (n, 2) px."""
    x, y = np.linspace(0, camera.width - 1, GRID[0]), np.linspace(0, camera.height - 1, GRID[1])
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def projection_jacobian(camera: Camera, colmap_model: str) -> np.ndarray:
    """Returns derivatives (n, 2, q) of projections by the parameters, up to a rotation of the camera."""
    try:
        ideal = camera.normalised_from_pixel(image_grid(camera))
    except ConvergenceError as error:
        raise DegenerateError(
            "E-CAMERA-FOLDED",
            "camera: the distortion folds over in a part of the image without dots; add views that fill the image "
            "to its corners, or choose a --model with fewer parameters",
        ) from error
    jacobian = camera.parameter_jacobian(ideal) @ intrinsic_basis(colmap_model)
    x, y = ideal.T
    rotation = np.stack([np.stack([-x * y, 1 + x * x, -y], axis=-1), np.stack([-1 - y * y, x * y, x], axis=-1)], axis=1)
    by_ideal = camera.pixel_jacobian(ideal)
    by_rotation = (by_ideal @ rotation).reshape(-1, 3)
    flat = jacobian.reshape(len(by_rotation), -1)
    return (flat - by_rotation @ np.linalg.lstsq(by_rotation, flat, rcond=None)[0]).reshape(jacobian.shape)


def projection_sigma(result: Intrinsics) -> ProjectionSigma:
    """Returns σ of projections over the image, and how far dots reach towards its corners."""
    camera = result.camera
    xy = image_grid(camera)
    jacobian = projection_jacobian(camera, result.colmap_model)
    sigma = np.sqrt(np.einsum("nip,pq,niq->n", jacobian, result.covariance, jacobian) / 2)
    middle = np.array([camera.width - 1, camera.height - 1]) / 2
    corners = np.array([[-1, -1], [1, -1], [-1, 1], [1, 1]])
    dots = np.concatenate([m.measured_px for m in result.models]) - middle
    # The smaller of the two coordinates counts: a dot at the side of the image is not in its corner.
    reach = np.minimum.reduce(dots[:, None] * corners / middle, axis=2).max(0)
    corner_index = [int(np.argmin(((xy - middle - corner * middle) ** 2).sum(1))) for corner in corners]
    return ProjectionSigma(sigma, np.maximum(reach, 0), sigma[corner_index])


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
        why = f", {left:.2f} with a larger lens model; {model.words}"
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
POSE_PASSES = 2  # of pose and eccentricity; few suffice, as eccentricity hardly changes with the pose
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
        return float(np.sqrt((np.concatenate(kept) ** 2).mean()))

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
    """Returns the residuals of all ``views`` of a ``result``, each held out once; None with too few views.

    The places of the dots are those estimated from the other views of the folder, or design places if there are none.

    Raises StcalError: a calibration without some of the views fails.
    """
    folds = min(folds, len(views))
    if len(views) - -(-len(views) // folds) < MIN_TRAINING:
        return None
    residuals_of_view: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    factors = []
    for fold in range(folds):
        without = of_some_views(result, [view for i, view in enumerate(views) if i % folds != fold], board)
        factors.append(without.factors.centres)
        residuals_of_view |= {view.name: foretold(view, board, without) for view in views[fold::folds]}
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
        for fit in fits.values():
            if isinstance(fit, StcalError) and not tried:
                raise fit
        raise DegenerateError(
            "E-CALIBRATE-FEW-VIEWS",
            f"--model auto: {len(views)} views, {MIN_TRAINING + 1} needed; add views, or choose a --model",
        )
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
        start = closed_form(views, board, start_camera(known.width, known.height, model))
    return adjust_intrinsics(views, board, start, model)


def _or_error(function: Callable[..., R], *arguments) -> R | StcalError:
    try:
        return function(*arguments)
    except StcalError as error:
        return error


def foretold(view: ImageObservations, board: BoardDesign, result: Intrinsics) -> tuple[np.ndarray, np.ndarray]:
    """Returns the residuals (n, 2) of a view, px and in the detected centres' σ, after its pose is fitted."""
    camera = result.camera
    ((group, members),) = by_group([view]).items()
    model = model_of_views(group, view.labels, members, board, camera)
    known = [own for own in result.models if own.group == group]
    places = {label: xyz for own in known for label, xyz in zip(own.labels, own.xyz_model, strict=True)}
    xyz = np.array([places.get(label, at) for label, at in zip(model.labels, model.xyz_model, strict=True)])
    model = replace(model, xyz_model=xyz)
    factor = result.factors.centres
    radius: dict[Label, float] = {**board.radius_of()}
    points = Vector(xyz)
    for _ in range(POSE_PASSES):
        model = replace(model, shift_px=eccentricity_px(model, camera, radius, 1.0))
        begin, poses = model, PoseStack.of(*model.camera_from_model)

        def left(step: np.ndarray, begin=begin, poses=poses) -> np.ndarray:
            moved = placed(begin, poses.moved(step[None]), points)
            return moved.whiten(moved.residuals_px(camera)).ravel() / factor

        depth = float(np.linalg.norm(begin.camera_from_model[0].translation))
        solution = least_squares(left, np.zeros(6), loss="huber", f_scale=2.0, x_scale=[1, 1, 1, depth, depth, depth])
        model = placed(begin, poses.moved(solution.x[None]), points)
    residual = model.residuals_px(camera)
    return residual, model.whiten(residual)
