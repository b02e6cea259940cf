"""Registration of two instruments from corresponding points: all steps in order. Read this file first.

The baseline ``liu2017`` is the method of Liu et al. (2017), "Research on coordinate transformation method between robot
and laser tracker" (China Measurement & Test 43(11), 102–107), as written: of random samples, each gives an affine
transform (eqs. 5–6), rejected if its 3×3 part is not orthogonal (eq. 7); other points with residuals within a limit are
inliers (eq. 8); of the transforms with enough inliers, that of the smallest variance is the answer (eq. 9), not fitted
again. The limit for orthogonality and the number of samples are not stated; both are options.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from stcal.errors import DegenerateError, InputError
from stcal.geometry.arrays import frozen, require_arguments, require_fields
from stcal.geometry.rigid import Affine
from stcal.io.table import FARTHEST
from stcal.parallel import one_thread
from stcal.register.consensus import (
    AS_GOOD,
    BY_CHANCE,
    MODELS,
    RIGID,
    Fitted,
    Problem,
    alternative_fit,
    chance,
    covariance_of,
    problem_of,
    robust_fit,
    rotation_of,
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
    moved_meanwhile,
    notes_of,
    order_note,
    shifted_rows,
    two_groups,
    wider,
)
from stcal.register.registered import Alternative, Registration, held_out


@dataclass(frozen=True, slots=True)
class Liu2017Options:
    """Options of the method of Liu et al. (2017). The defaults are in the paper's best range.

    Parameters
    ----------
    sample : number N of points of a sample; 4 … 40 in the paper, best 30–36.
    limit_mm : largest distance of an inlier; 0.18 … 0.23 in the paper.
    share : share of inliers among the points outside the sample, above which a sample is acceptable.
    orthogonal_within : largest entry of |RᵀR − 1| that passes; not stated in the paper.
    tries : number of samples drawn; not stated in the paper.
    Raises InputError: a sample of fewer than four points, or a number that is not positive.
    """

    sample: int = 30
    limit_mm: float = 0.2
    share: float = 0.85
    orthogonal_within: float = 0.01
    tries: int = 1000

    def __post_init__(self):
        require_fields(self, "liu2017")
        checks = {"sample": (self.sample >= 4, "4 or more points for twelve parameters")}
        checks["share"] = (0 < self.share <= 1, "more than 0 and at most 1")
        checks |= {
            name: (getattr(self, name) > 0, "a positive number") for name in self.__slots__ if name not in checks
        }
        for name, (fits, words) in checks.items():
            if not fits:
                raise InputError("E-LIU-OPTIONS", f"liu2017: {name} is {getattr(self, name):g}; {words} needed")


def affine_least_squares(xyz_a: np.ndarray, xyz_b: np.ndarray) -> Affine:
    """Returns b_from_a of twelve parameters (eqs. 5–6). Coplanar points leave it open off their plane, by metres."""
    design = np.column_stack([xyz_a, np.ones(len(xyz_a))])
    solution = np.linalg.lstsq(design, np.asarray(xyz_b, float), rcond=None)[0]
    return Affine(solution[:3].T, solution[3])


def liu2017(xyz_a: np.ndarray, xyz_b: np.ndarray, options: Liu2017Options, seed: int = 0) -> Fitted:
    """Returns the fit by the paper's method. Raises DegenerateError: too few points, or no sample is acceptable."""
    count, size = len(xyz_a), options.sample
    if count <= size:
        raise DegenerateError(
            "E-LIU-SAMPLE",
            f"liu2017: {count} point pairs, more than the {size} of a sample needed; lower it (--sample)",
        )
    best, least, most = None, np.inf, 0.0
    tried = False
    for sample, b_from_a, error in orthogonal_samples(xyz_a, xyz_b, options, seed):
        others = np.delete(error, sample)
        inside = others[others < options.limit_mm]
        share, tried = len(inside) / len(others), True
        most = max(most, share)
        if share > options.share and inside.var() < least:
            least, best = inside.var(), (b_from_a, error)
    if best is None:
        found = f"at most {100 * most:.0f} %" if tried else "none had an orthogonal 3×3 part"
        raise DegenerateError(
            "E-LIU-SAMPLE",
            f"liu2017: no sample of {size} points leaves more than {100 * options.share:g} % of the others within "
            f"{options.limit_mm:g} mm in {options.tries} tries ({found}); a larger limit (--threshold-mm), a smaller "
            "--share, another --sample, or the robust method needed",
        )
    b_from_a, error = best
    near = error < options.limit_mm
    return Fitted(b_from_a, near, float(np.sqrt((error[near] ** 2).mean() / 3)), options.limit_mm, options.tries)


def orthogonal_samples(xyz_a: np.ndarray, xyz_b: np.ndarray, options: Liu2017Options, seed: int):
    """Yields the tries whose 3×3 part is orthogonal enough: sample, transform, and errors (n,)."""
    rng, count = np.random.default_rng(seed), len(xyz_a)
    for _ in range(options.tries):
        sample = rng.choice(count, options.sample, replace=False)
        b_from_a = affine_least_squares(xyz_a[sample], xyz_b[sample])
        if np.abs(b_from_a.linear.T @ b_from_a.linear - np.eye(3)).max() <= options.orthogonal_within:
            yield sample, b_from_a, np.linalg.norm(xyz_b - b_from_a @ xyz_a, axis=1)


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
    xyz_a, xyz_b : (n, 3); mm; row i of both is the same point.
    model : ``rigid``, ``similarity`` or ``affine``; the method ``liu2017`` is always affine.
    method : ``robust``, ``least-squares`` or ``liu2017``.
    threshold_mm : largest distance of inliers; estimated from the data if not given (``liu2017``: in place of its
        limit).
    weights : (n,); weights, proportional to 1/σ², positive.
    covariances : (n, 3, 3) or (n,); covariance, or variance per axis, of b − b_from_a a in frame b, mm².
    seed : seed of the random samples; the same seed gives the same result.
    folds : number of folds of the cross-validation; 0 for none.
    allow_ambiguous : whether to return the transform of the larger set if another one is about as good, instead of an
        error.
    liu2017_options : options of the method ``liu2017``.
    lines : lines of a file by which messages name the points; by default rows, from 1.

    Raises InputError: shapes, values or options are invalid, or units or axes of the two frames do not fit together.
    Raises DegenerateError: the points do not determine the model, none agree beyond chance, or two transforms are about
    as good. Raises ConvergenceError: a fit with covariances did not converge.
    """
    problem = _checked(xyz_a, xyz_b, model, method, threshold_mm, weights, covariances, lines)
    if problem.model == RIGID:
        check_units(problem, seed)
    second = None
    published = replace(
        liu2017_options or Liu2017Options(), **({} if threshold_mm is None else {"limit_mm": threshold_mm})
    )
    again: Callable[[Problem], Fitted] = {
        "robust": partial(robust_fit, threshold=threshold_mm, seed=seed),
        "least-squares": _least_squares,
        "liu2017": lambda part: liu2017(part.xyz_a, part.xyz_b, published, seed),
    }[method]
    if method == "robust":
        fitted, second = _robust(problem, threshold_mm, seed)
    else:
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
        along = slice(3, None, 4) if len(off) == 12 else slice(3, 6)
        off[along] = (1 - len(shifted.rows) / shifted.count) * shifted.by_mm
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
    return replace(result, notes=tuple(notes_of(result, problem, other, shifted)))


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
