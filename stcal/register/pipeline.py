"""Registration of two instruments from corresponding points: the calls in order; read this first."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from stcal.errors import DegenerateError, InputError
from stcal.parallel import one_thread
from stcal.register.core.covariance import Noise, covariance_of, noise_of, sigma_within
from stcal.register.core.liu2017 import Liu2017Options, liu2017
from stcal.register.core.models import MODELS, Model, fit, parts, squares
from stcal.register.core.result import Alternative, Registration
from stcal.register.core.robust import (
    AS_GOOD,
    BY_CHANCE,
    Fitted,
    alternative_fit,
    chance,
    robust_fit,
    settled,
    turn_between,
)
from stcal.register.core.search import LEAST_SHARE
from stcal.register.core.validate import held_out
from stcal.register.judge.degeneracy import check_extent, check_supports, row_name
from stcal.register.judge.groups import two_groups
from stcal.register.judge.mistakes import check_mirrored, check_units, mirrored_error
from stcal.register.judge.notes import Subject, notes_of

METHODS = ("robust", "least-squares", "liu2017")
SUSPICIOUS_SHARE = 0.5
SUSPICIOUS_SIGMA = 0.05
"""Fewer inliers, or a σ above this share of the points' spread: a mirrored frame is tried."""


@one_thread()
def register(
    xyz_a: np.ndarray,
    xyz_b: np.ndarray,
    *,
    model: str = "rigid",
    method: str = "robust",
    threshold_mm: float | None = None,
    weights: np.ndarray | None = None,
    covariances: np.ndarray | None = None,
    seed: int = 0,
    folds: int = 6,
    allow_ambiguous: bool = False,
    liu2017_options: Liu2017Options | None = None,
    lines: Sequence[int] | None = None,
) -> Registration:
    """b_from_a from corresponding points of two frames, some of which may be wrong.

    >>> import numpy as np
    >>> rng = np.random.default_rng(1)
    >>> xyz_a = rng.uniform(-100, 100, (40, 3))
    >>> xyz_b = xyz_a[:, [1, 2, 0]] + [1000, 0, 50] + rng.normal(0, 0.1, (40, 3))
    >>> xyz_b[7] += [3, 0, 0]
    >>> found = register(xyz_a, xyz_b)
    >>> found.outliers
    array([7])
    >>> found.b_from_a.translation.round(0)
    array([1000.,    0.,   50.])

    Parameters
    ----------
    xyz_a, xyz_b : (n, 3) arrays
        mm; row i of both is the same point.
    model : str
        ``rigid``, ``similarity`` or ``affine``; the method ``liu2017`` is always affine.
    method : str
        ``robust``, ``least-squares`` or ``liu2017``.
    threshold_mm : float, optional
        Inliers are nearer than this; estimated from the data where not given (``liu2017``: instead of its limit).
    weights : (n,) array, optional
        ~ 1/σ², positive.
    covariances : (n, 3, 3) or (n,) array, optional
        Covariance, or variance per axis, of b − b_from_a a in frame b, mm².
    seed : int
        Of the random samples; the same seed gives the same answer.
    folds : int
        Of the cross-validation; 0 for none.
    allow_ambiguous : bool
        Give the transform of the more points where another one is about as good, instead of an error.
    liu2017_options : Liu2017Options, optional
    lines : sequence of int, optional
        Lines of a file that messages name the points by; else rows, from 1.

    Raises
    ------
    InputError
        Shapes, values or options that cannot be used; units or axes of the two frames that do not fit together.
    DegenerateError
        The points do not determine the model; none agree beyond chance; two transforms are about as good.
    ConvergenceError
        A fit with covariances did not settle.
    """
    a, b, chosen, noise = _checked(xyz_a, xyz_b, model, method, threshold_mm, weights, covariances)
    if chosen.name == "rigid":
        check_units(a, b, seed)
    if method == "robust":
        fit_rows = partial(_robust_rows, chosen, a, b, noise, threshold_mm, seed)
        fitted, other = _robust(chosen, a, b, noise, threshold_mm, seed)
    else:
        if method == "least-squares":
            fit_rows = partial(_least_squares, chosen, a, b, noise)
        else:
            fit_rows = partial(_liu2017, a, b, _liu2017_options(liu2017_options, threshold_mm), seed)
        fitted, other = fit_rows(np.arange(len(a))), None
    _check_geometry(chosen, method, a, b, fitted, lines)
    inliers = fitted.inliers
    alternative = None if other is None else _alternative(fitted, other, a)
    ambiguous = alternative is not None and len(alternative.rows) >= AS_GOOD * inliers.sum()
    if ambiguous and not allow_ambiguous:
        raise DegenerateError(
            f"registration: {inliers.sum()} point pairs agree on one transform and {len(alternative.rows)} others on "
            f"another, {alternative.apart_mm:.4g} mm from it; register one group of rows alone, or allow ambiguous "
            "answers"
        )
    covariance, scaled, dof = covariance_of(
        chosen, fitted.transform, a[inliers], noise[inliers], fitted.sigma, fitted.threshold
    )
    residuals = b - fitted.transform @ a
    length = np.linalg.norm(residuals[inliers], axis=1)
    factor = None if noise.sigma_mm is None else fitted.sigma / noise.sigma_mm
    subject = Subject(chosen, method, a, b, fitted, alternative, ambiguous, factor if scaled else None, dof, lines)
    return Registration(
        model=chosen.name,
        method=method,
        b_from_a=fitted.transform,
        covariance=covariance,
        inliers=inliers,
        residuals=residuals,
        sigma_mm=fitted.sigma,
        dof=dof,
        threshold_mm=fitted.threshold,
        mean_mm=float(length.mean()),
        rms_mm=float(np.sqrt((length**2).mean())),
        max_mm=float(length.max()),
        sigma_factor=factor,
        scaled=scaled,
        held_out=held_out(lambda rows: fit_rows(rows).transform, a, b, inliers, folds, chosen.sample + 1, seed),
        ambiguous=ambiguous,
        alternative=alternative,
        notes=tuple(notes_of(subject)),
        seed=seed,
        samples=fitted.samples,
    )


def _checked(
    xyz_a, xyz_b, model: str, method: str, threshold_mm, weights, covariances
) -> tuple[np.ndarray, np.ndarray, Model, Noise]:
    a, b = np.asarray(xyz_a, float), np.asarray(xyz_b, float)
    if a.ndim != 2 or a.shape[1:] != (3,) or a.shape != b.shape:
        raise InputError(f"registration: points of shapes {a.shape} and {b.shape}; (n, 3) twice needed")
    for name, xyz in (("a", a), ("b", b)):
        bad = np.flatnonzero(~np.isfinite(xyz).all(1))
        if len(bad):
            raise InputError(f"registration: row {bad[0] + 1} of {name} is not finite; remove it")
    if model not in MODELS:
        raise InputError(f"registration: model {model!r}; one of {', '.join(MODELS)} needed")
    if method not in METHODS:
        raise InputError(f"registration: method {method!r}; one of {', '.join(METHODS)} needed")
    if threshold_mm is not None and not (np.isfinite(threshold_mm) and threshold_mm > 0):
        raise InputError(f"registration: threshold {threshold_mm} mm; a positive number needed")
    if method == "liu2017" and (weights is not None or covariances is not None):
        raise InputError("registration: method liu2017 knows no weights or covariances; leave them out")
    chosen = MODELS["affine" if method == "liu2017" else model]
    if len(a) < chosen.sample or chosen.freedom(len(a)) <= 0:
        needed = max(chosen.sample, chosen.parameters // 3 + 1)
        raise DegenerateError(f"registration: {len(a)} point pairs, {needed} needed for the {chosen.name} model")
    return a, b, chosen, noise_of(len(a), weights, covariances)


def _check_geometry(model: Model, method: str, a, b, fitted: Fitted, lines: Sequence[int] | None) -> None:
    """Refuse mirrored frames, and points that do not determine the model; the baseline runs as it was published."""
    if method == "liu2017":
        return
    inliers = fitted.inliers
    check_mirrored(model, a[inliers], b[inliers])
    check_extent(model, a[inliers], fitted.sigma)
    if method == "robust" and not inliers.all():
        check_supports(model, a, inliers, fitted.sigma, lambda row: row_name(row, lines))


def _least_squares(model: Model, a: np.ndarray, b: np.ndarray, noise: Noise, rows: np.ndarray) -> Fitted:
    a, b, noise = a[rows], b[rows], noise[rows]
    transform = fit(model, a, b, noise.precision)
    total = squares(b - transform @ a, noise.precision).sum()
    sigma = sigma_within(float(total), model, len(a), None)
    return Fitted(transform, np.ones(len(a), bool), sigma, None)


def _liu2017_options(options: Liu2017Options | None, threshold_mm: float | None) -> Liu2017Options:
    options = options or Liu2017Options()
    return options if threshold_mm is None else replace(options, limit_mm=threshold_mm)


def _liu2017(a: np.ndarray, b: np.ndarray, options: Liu2017Options, seed: int, rows: np.ndarray) -> Fitted:
    a, b = a[rows], b[rows]
    found = liu2017(a, b, options, seed)
    near = found.inliers
    total = squares((b - found.b_from_a @ a)[near]).sum()
    sigma = float(np.sqrt(total / (3 * near.sum())))
    return Fitted(found.b_from_a, near, sigma, options.limit_mm, options.tries)


def _robust_rows(model: Model, a, b, noise: Noise, threshold: float | None, seed: int, rows: np.ndarray) -> Fitted:
    return robust_fit(model, a[rows], b[rows], noise[rows], threshold, seed)


def _robust(
    model: Model, a: np.ndarray, b: np.ndarray, noise: Noise, threshold: float | None, seed: int
) -> tuple[Fitted, Fitted | None]:
    """The fit, and another one that other points agree on."""
    try:
        fitted = robust_fit(model, a, b, noise, threshold, seed)
        _beyond_chance(model, fitted, a, b)
    except DegenerateError:
        _check_mirrored_with_outliers(model, None, a, b, noise, threshold, seed)
        raise
    spread = np.sqrt(np.var(a[fitted.inliers], axis=0).sum())
    if fitted.inliers.mean() < SUSPICIOUS_SHARE or fitted.sigma > SUSPICIOUS_SIGMA * spread:
        _check_mirrored_with_outliers(model, fitted, a, b, noise, threshold, seed)
    inside = np.flatnonzero(fitted.inliers)
    groups = two_groups(model, a[inside], b[inside], noise[inside], np.random.default_rng([seed, 4]))
    if groups is None or groups.in_space:
        return fitted, alternative_fit(model, fitted, a, b, noise, seed)
    apart = [squares(b[inside] - t @ a[inside], noise[inside].precision) for t in groups.transforms]
    first = np.zeros(len(a), bool)
    first[inside[apart[0] <= apart[1]]] = True
    second = fitted.inliers & ~first
    one = settled(model, a, b, noise, first, threshold)
    if (one.inliers & second).sum() < second.sum() / 2:
        return one, alternative_fit(model, one, a, b, noise, seed)
    return _as_assigned(model, a, b, noise, first, threshold), _as_assigned(model, a, b, noise, second, threshold)


def _as_assigned(model: Model, a, b, noise: Noise, group: np.ndarray, threshold: float | None) -> Fitted:
    """The fit to a group too near the other one for a threshold between them: that of its own σ reaches into it."""
    transform = fit(model, a[group], b[group], noise[group].precision)
    square = squares(b[group] - transform @ a[group], noise[group].precision)
    sigma = sigma_within(float(square.sum()), model, int(group.sum()), threshold)
    return Fitted(transform, group, sigma, threshold or float(np.sqrt(square.max())))


def _beyond_chance(model: Model, fitted: Fitted, a: np.ndarray, b: np.ndarray) -> None:
    if len(a) > model.sample and chance(model, fitted, a, b) > np.log(BY_CHANCE):
        raise DegenerateError(
            f"registration: {fitted.inliers.sum()} of {len(a)} point pairs agree to {fitted.sigma:.4g} mm, no better "
            "than chance; check that row i of both is the same point"
        )


def _check_mirrored_with_outliers(model: Model, fitted: Fitted | None, a, b, noise, threshold, seed) -> None:
    """Refuse points of which far more agree, or far better, when a is mirrored."""
    if model.name == "affine":
        return
    flip = np.array([1, 1, -1.0])
    try:
        mirrored = robust_fit(model, a * flip, b, noise, threshold, seed)
    except DegenerateError:
        return
    if mirrored.inliers.mean() < LEAST_SHARE:  # points near any one plane fit
        return
    usual = 0.0 if fitted is None else chance(model, fitted, a, b)
    if chance(model, mirrored, a * flip, b) < 2 * usual + np.log(BY_CHANCE) and (
        fitted is None or mirrored.inliers.sum() > fitted.inliers.sum() or mirrored.sigma < fitted.sigma / 2
    ):
        scale = 1 if fitted is None else fitted.sigma / mirrored.sigma
        linear = parts(mirrored.transform)[0]
        raise mirrored_error(linear / np.cbrt(np.linalg.det(linear)) * flip, mirrored.inliers.sum(), len(a), scale)


def _alternative(fitted: Fitted, other: Fitted, a: np.ndarray) -> Alternative:
    apart = np.sqrt(np.mean(((fitted.transform @ a - other.transform @ a) ** 2).sum(1)))
    turn = turn_between(fitted.transform, other.transform)
    return Alternative(other.transform, np.flatnonzero(other.inliers), float(apart), turn)
