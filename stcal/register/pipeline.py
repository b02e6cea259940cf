"""Registration of two instruments from corresponding points: all steps in order. Read this file first."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from stcal.errors import DegenerateError, InputError
from stcal.geometry.arrays import frozen, require_arguments
from stcal.geometry.rigid import best_rotations
from stcal.io.table import FARTHEST
from stcal.parallel import one_thread
from stcal.register.liu2017 import Liu2017Options, liu2017
from stcal.register.mistakes import (
    check_mirrored,
    check_units,
    mirrored_error,
    mirrored_ratio,
    moved_meanwhile,
    order_note,
    shifted_rows,
    two_groups,
    wider,
)
from stcal.register.models import MODELS, parts, squares
from stcal.register.notes import by_chance, check_extent, check_supports, notes_of
from stcal.register.pairs import Problem, noise_of
from stcal.register.result import Alternative, Registration, held_out
from stcal.register.robust import (
    AS_GOOD,
    BY_CHANCE,
    LEAST_SHARE,
    Fitted,
    alternative_fit,
    chance,
    covariance_of,
    robust_fit,
    settled,
    shifted_too,
    sigma_within,
)

METHODS = ("robust", "least-squares", "liu2017")
NEAREST_MM = 1e-9
"""Smallest threshold, mm: the precision of a double for points at a distance up to 1e12 mm."""
SUSPICIOUS_SHARE = 0.5
SUSPICIOUS_SIGMA = 0.05
"""Inlier share below which, and σ as a fraction of the points' RMS distance from their centroid above which, a mirrored
frame is tried. Both are met long before a mirrored frame is found; the trial costs time only."""


@require_arguments
@one_thread()
def register(
    xyz_a: ArrayLike,
    xyz_b: ArrayLike,
    *,
    model: str = "rigid",
    method: str = "robust",
    threshold_mm: float | None = None,
    weights: ArrayLike | None = None,
    covariances: ArrayLike | None = None,
    seed: int = 0,
    folds: int = 6,
    allow_ambiguous: bool = False,
    liu2017_options: Liu2017Options | None = None,
    lines: Sequence[int] | None = None,
) -> Registration:
    """Returns b_from_a from corresponding points of two frames, some of which may be wrong.

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
        Largest distance of inliers; estimated from the data if not given (``liu2017``: in place of its limit).
    weights : (n,) array, optional
        Weights, proportional to 1/σ², positive.
    covariances : (n, 3, 3) or (n,) array, optional
        Covariance, or variance per axis, of b − b_from_a a in frame b, mm².
    seed : int
        Seed of the random samples; the same seed gives the same result.
    folds : int
        Number of folds of the cross-validation; 0 for none.
    allow_ambiguous : bool
        Whether to return the transform of the larger set if another one is about as good, instead of an error.
    liu2017_options : Liu2017Options, optional
        Options of the method ``liu2017``.
    lines : sequence of int, optional
        Lines of a file by which messages name the points; by default rows, from 1.

    Returns
    -------
    Registration

    Raises
    ------
    InputError
        If shapes, values or options are invalid, or units or axes of the two frames do not fit together.
    DegenerateError
        If the points do not determine the model, none agree beyond chance, or two transforms are about as good.
    ConvergenceError
        If a fit with covariances did not converge.
    """
    problem = _checked(xyz_a, xyz_b, model, method, threshold_mm, weights, covariances, lines)
    if problem.model.name == "rigid":
        check_units(problem.xyz_a, problem.xyz_b, seed)
    second = None
    if method == "robust":
        again: Callable[[Problem], Fitted] = partial(robust_fit, threshold=threshold_mm, seed=seed)
        fitted, second = _robust(problem, threshold_mm, seed)
    else:
        published = liu2017_options or Liu2017Options()
        if threshold_mm is not None:
            published = replace(published, limit_mm=threshold_mm)
        again = _least_squares if method == "least-squares" else partial(_liu2017, options=published, seed=seed)
        fitted = again(problem)
    inside = problem[fitted.inliers]
    if method != "liu2017":  # the baseline runs as published
        check_mirrored(inside.model, inside.xyz_a, inside.xyz_b)
        check_extent(inside.model, inside.xyz_a, fitted.sigma)
    if method == "robust" and not fitted.inliers.all():
        check_supports(problem, fitted.inliers, fitted.sigma)
    alternative = None if second is None else _alternative(fitted, second, problem.xyz_a)
    ambiguous = alternative is not None and len(alternative.rows) >= AS_GOOD * fitted.inliers.sum()
    if alternative is not None and ambiguous and not allow_ambiguous:
        change = moved_meanwhile(problem, fitted.transform)
        moved = "" if change is None else f"; {order_note(change, problem)}"
        raise DegenerateError(
            "E-REGISTER-TWO-TRANSFORMS",
            f"registration: {fitted.inliers.sum()} point pairs agree on one transform and {len(alternative.rows)} "
            f"others on another, {alternative.apart_mm:.4g} mm from it; register one group of rows alone, or allow "
            f"ambiguous answers{moved}",
        )
    covariance = covariance_of(inside, fitted.transform, fitted.sigma, fitted.threshold)
    other = shifted = None
    if method != "liu2017":
        other = wider(inside, fitted.transform)
        shifted = shifted_rows(*((inside, fitted.transform) if other is None else (other.problem, other.transform)))
    if shifted is not None:  # the transform is off by so much if the smaller group is right
        covariance = shifted_too(covariance, (1 - len(shifted.rows) / shifted.count) * shifted.by_mm)
    given = problem.noise.sigma_mm
    result = Registration(
        model=problem.model.name,
        method=method,
        b_from_a=fitted.transform,
        covariance=covariance.matrix,
        inliers=fitted.inliers,
        residuals=problem.residuals(fitted.transform),
        sigma_mm=fitted.sigma,
        redundancy=covariance.redundancy,
        threshold_mm=fitted.threshold if np.isfinite(fitted.threshold) else None,
        sigma_factor=None if given is None else fitted.sigma / given,
        scaled=covariance.scaled,
        held_out=held_out(problem, lambda rows: again(problem[rows]).transform, fitted.inliers, folds, seed),
        ambiguous=ambiguous,
        alternative=alternative,
        seed=seed,
        samples=fitted.samples,
    )
    return replace(result, notes=notes_of(result, problem, other, shifted))


def _checked(xyz_a, xyz_b, model: str, method: str, threshold_mm: float | None, weights, covariances, lines) -> Problem:
    a, b = (frozen(xyz, None, f"points of {name}", finite=False) for name, xyz in (("a", xyz_a), ("b", xyz_b)))
    if a.ndim != 2 or a.shape[1:] != (3,) or a.shape != b.shape:
        raise InputError(
            "E-ARRAY-SHAPE", f"registration: points of shapes {a.shape} and {b.shape}; (n, 3) twice needed"
        )
    for name, xyz in (("a", a), ("b", b)):
        bad = np.flatnonzero(~np.isfinite(xyz).all(1))
        if len(bad):
            raise InputError("E-ARRAY-NOT-FINITE", f"registration: row {bad[0] + 1} of {name} is not finite; remove it")
    if model not in MODELS:
        raise InputError("E-OPTION-VALUE", f"registration: model {model!r}; one of {', '.join(MODELS)} needed")
    if method not in METHODS:
        raise InputError("E-OPTION-METHOD", f"registration: method {method!r}; one of {', '.join(METHODS)} needed")
    if threshold_mm is not None and not NEAREST_MM <= threshold_mm <= FARTHEST:
        raise InputError(
            "E-OPTION-RANGE",
            f"registration: threshold {threshold_mm:g} mm; a positive number, {NEAREST_MM:g} to {FARTHEST:g}, needed",
        )
    if method == "liu2017" and (weights is not None or covariances is not None):
        raise InputError(
            "E-REGISTER-WEIGHTS", "registration: method liu2017 knows no weights or covariances; leave them out"
        )
    chosen = MODELS["affine" if method == "liu2017" else model]
    if len(a) < chosen.needed:
        raise DegenerateError(
            "E-POINTS-FEW", f"registration: {len(a)} point pairs, {chosen.needed} needed for the {chosen.name} model"
        )
    return Problem(chosen, a, b, noise_of(len(a), weights, covariances), lines)


def _least_squares(problem: Problem) -> Fitted:
    return replace(_as_assigned(problem, np.ones(len(problem), bool), None), threshold=np.inf)


def _liu2017(problem: Problem, options: Liu2017Options, seed: int) -> Fitted:
    found = liu2017(problem.xyz_a, problem.xyz_b, options, seed)
    near = found.inliers
    total = squares(problem.residuals(found.b_from_a)[near]).sum()
    sigma = float(np.sqrt(total / (3 * near.sum())))
    return Fitted(found.b_from_a, near, sigma, options.limit_mm, options.tries)


def _robust(problem: Problem, threshold: float | None, seed: int) -> tuple[Fitted, Fitted | None]:
    """Returns the fit, and another fit on which other points agree."""
    try:
        fitted = robust_fit(problem, threshold, seed)
        if len(problem) > problem.model.sample and chance(problem, fitted) > np.log(BY_CHANCE):
            raise by_chance(int(fitted.inliers.sum()), len(problem), fitted.sigma)
    except DegenerateError:
        _check_mirrored_with_outliers(problem, None, threshold, seed)
        raise
    size = np.sqrt(np.var(problem.xyz_a[fitted.inliers], axis=0).sum())
    if fitted.inliers.mean() < SUSPICIOUS_SHARE or fitted.sigma > SUSPICIOUS_SIGMA * size:
        _check_mirrored_with_outliers(problem, fitted, threshold, seed)
    inside = np.flatnonzero(fitted.inliers)
    groups = two_groups(problem[inside], np.random.default_rng([seed, 4]))
    if groups is None or groups.in_space:
        return fitted, alternative_fit(problem, fitted, seed)
    apart = [problem[inside].squares(t) for t in groups.transforms]
    first = np.zeros(len(problem), bool)
    first[inside[apart[0] <= apart[1]]] = True
    second = fitted.inliers & ~first
    one = settled(problem, first, threshold)
    if (one.inliers & second).sum() < second.sum() / 2:
        return one, alternative_fit(problem, one, seed)
    return _as_assigned(problem, first, threshold), _as_assigned(problem, second, threshold)


def _as_assigned(problem: Problem, group: np.ndarray, threshold: float | None) -> Fitted:
    """Returns the fit to one of two groups that overlap: no threshold separates them, but their assignment is known."""
    part = problem[group]
    transform = part.fit()
    square = part.squares(transform)
    sigma = sigma_within(float(square.sum()), part.model, len(part), threshold or np.inf)
    return Fitted(transform, group, sigma, threshold or float(np.sqrt(square.max())))


def _check_mirrored_with_outliers(problem: Problem, fitted: Fitted | None, threshold: float | None, seed: int) -> None:
    """Refuses points of which far more agree, or agree far better, if a is mirrored."""
    if problem.model.name == "affine":
        return
    flip = np.array([1, 1, -1.0])
    image = replace(problem, xyz_a=problem.xyz_a * flip)
    try:
        mirrored = robust_fit(image, threshold, seed)
    except DegenerateError:
        return
    if mirrored.inliers.mean() < LEAST_SHARE:  # points near any one plane fit
        return
    usual = 0.0 if fitted is None else chance(problem, fitted)
    if chance(image, mirrored) < 2 * usual + np.log(BY_CHANCE) and (
        fitted is None or mirrored.inliers.sum() > fitted.inliers.sum() or mirrored.sigma < fitted.sigma / 2
    ):
        agreeing = problem[mirrored.inliers]
        times = float(np.sqrt(mirrored_ratio(agreeing.xyz_a, agreeing.xyz_b)[0]))
        linear = parts(mirrored.transform)[0]
        rotation = linear / np.cbrt(np.linalg.det(linear))
        raise mirrored_error(rotation * flip, mirrored.inliers.sum(), len(problem), times)


def _alternative(fitted: Fitted, other: Fitted, a: np.ndarray) -> Alternative:
    apart = np.sqrt(np.mean(((fitted.transform @ a - other.transform @ a) ** 2).sum(1)))
    one, two = (best_rotations(parts(each.transform)[0])[0] for each in (fitted, other))
    turn = float(Rotation.from_matrix(one @ two.T).magnitude())
    return Alternative(other.transform, np.flatnonzero(other.inliers), float(apart), turn)
