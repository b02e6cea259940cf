"""Registration of two instruments from corresponding points: all steps in order. Read this file first."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from stcal.errors import DegenerateError, InputError
from stcal.geometry.arrays import frozen, require_arguments
from stcal.io.table import FARTHEST
from stcal.parallel import one_thread
from stcal.register.consensus import (
    AS_GOOD,
    BY_CHANCE,
    Fitted,
    alternative_fit,
    chance,
    covariance_of,
    robust_fit,
    settled,
    sigma_within,
)
from stcal.register.doubts import (
    by_chance,
    check_extent,
    check_mirrored,
    check_mirrored_with_outliers,
    check_supports,
    check_units,
    notes_of,
    wider,
)
from stcal.register.liu2017 import Liu2017Options, liu2017
from stcal.register.registered import Alternative, Registration, held_out
from stcal.register.row_groups import moved_meanwhile, order_note, shifted_rows, two_groups
from stcal.register.transforms import MODELS, RIGID, Problem, problem_of, rotation_of

METHODS = ("robust", "least-squares", "liu2017")
NEAREST_MM = 1e-9
"""Smallest threshold, mm: the precision of a double for points at a distance up to 1e12 mm."""


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
    if problem.model == RIGID:
        check_units(problem, seed)
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
        check_mirrored(inside)
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
    covariance, scaled, redundancy = covariance_of(inside, fitted.transform, fitted.sigma, fitted.threshold)
    other = shifted = None
    if method != "liu2017":
        other = wider(inside, fitted.transform)
        shifted = shifted_rows(*((inside, fitted.transform) if other is None else (other.problem, other.transform)))
    if shifted is not None:  # the transform is off by so much if the smaller group is right
        off = np.zeros(len(covariance))
        off[slice(3, None, 4) if len(off) == 12 else slice(3, 6)] = (
            1 - len(shifted.rows) / shifted.count
        ) * shifted.by_mm
        covariance = covariance + np.outer(off, off)
    result = Registration(
        model=problem.model.name,
        method=method,
        b_from_a=fitted.transform,
        covariance=covariance,
        inliers=fitted.inliers,
        residuals=problem.residuals(fitted.transform),
        sigma_mm=fitted.sigma,
        redundancy=redundancy,
        threshold_mm=fitted.threshold if np.isfinite(fitted.threshold) else None,
        sigma_factor=None if problem.sigma_mm is None else fitted.sigma / problem.sigma_mm,
        scaled=scaled,
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
    for name, value, choices, code in (
        ("model", model, MODELS, "E-OPTION-VALUE"),
        ("method", method, METHODS, "E-OPTION-METHOD"),
    ):
        if value not in choices:
            raise InputError(code, f"registration: {name} {value!r}; one of {', '.join(choices)} needed")
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
    return problem_of(chosen, a, b, weights, covariances, lines)


def _least_squares(problem: Problem) -> Fitted:
    return replace(_as_assigned(problem, np.ones(len(problem), bool), None), threshold=np.inf)


def _liu2017(problem: Problem, options: Liu2017Options, seed: int) -> Fitted:
    found = liu2017(problem.xyz_a, problem.xyz_b, options, seed)
    total = (problem.residuals(found.b_from_a)[found.inliers] ** 2).sum()
    sigma = float(np.sqrt(total / (3 * found.inliers.sum())))
    return Fitted(found.b_from_a, found.inliers, sigma, options.limit_mm, options.tries)


def _robust(problem: Problem, threshold: float | None, seed: int) -> tuple[Fitted, Fitted | None]:
    """Returns the fit, and another fit on which other points agree."""
    try:
        fitted = robust_fit(problem, threshold, seed)
        if len(problem) > problem.model.sample and chance(problem, fitted) > np.log(BY_CHANCE):
            raise by_chance(int(fitted.inliers.sum()), len(problem), fitted.sigma)
    except DegenerateError:
        check_mirrored_with_outliers(problem, None, threshold, seed)
        raise
    check_mirrored_with_outliers(problem, fitted, threshold, seed)
    inside = np.flatnonzero(fitted.inliers)
    groups = two_groups(problem[inside], np.random.default_rng([seed, 4]))
    if groups is None:
        return fitted, alternative_fit(problem, fitted, seed)
    apart = [problem[inside].squares(transform) for transform in groups]
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


def _alternative(fitted: Fitted, other: Fitted, a: np.ndarray) -> Alternative:
    apart = np.sqrt(np.mean(((fitted.transform @ a - other.transform @ a) ** 2).sum(1)))
    turn = Rotation.from_matrix(rotation_of(fitted.transform) @ rotation_of(other.transform).T).magnitude()
    return Alternative(other.transform, np.flatnonzero(other.inliers), float(apart), float(turn))
