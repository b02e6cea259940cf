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
from scipy.special import chdtrc, chdtri, gammaln

from stcal.errors import ConvergenceError, DegenerateError, InputError
from stcal.geometry.arrays import frozen, require_arguments, require_fields, rms
from stcal.geometry.rigid import Affine
from stcal.io.table import FARTHEST
from stcal.parallel import one_thread
from stcal.register import consensus, doubts
from stcal.register.consensus import MODELS, RIGID, Fitted, Model, Problem, problem_of
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
        positive = "limit_mm", "orthogonal_within", "tries"
        for name, fits, needed in (
            ("sample", self.sample >= 4, "4 or more points for twelve parameters"),
            ("share", 0 < self.share <= 1, "more than 0 and at most 1"),
            *((name, getattr(self, name) > 0, "a positive number") for name in positive),
        ):
            if not fits:
                raise InputError("E-LIU-OPTIONS", f"liu2017: {name} is {getattr(self, name):g}; {needed} needed")


def affine_least_squares(xyz_a: np.ndarray, xyz_b: np.ndarray) -> Affine:
    """Returns b_from_a of twelve parameters (eqs. 5–6). Coplanar points leave it open off their plane, by metres."""
    design = np.column_stack([xyz_a, np.ones(len(xyz_a))])
    solution = np.linalg.lstsq(design, np.asarray(xyz_b, float), rcond=None)[0]
    return Affine(solution[:3].T, solution[3])


def liu2017(xyz_a: np.ndarray, xyz_b: np.ndarray, options: Liu2017Options, seed: int = 0) -> Fitted:
    """Returns the fit by the paper's method. Raises DegenerateError: too few points, or no sample is acceptable."""
    count, size = len(xyz_a), options.sample
    if count <= size:
        fault = f"liu2017: {count} point pairs, more than the {size} of a sample needed"
        raise DegenerateError("E-LIU-SAMPLE", f"{fault}; lower it (--sample)")
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
        wanted = f"more than {100 * options.share:g} % of the others within {options.limit_mm:g} mm"
        fault = f"liu2017: no sample of {size} points leaves {wanted} in {options.tries} tries ({found})"
        remedy = "a larger limit (--threshold-mm), a smaller --share, another --sample, or the robust method needed"
        raise DegenerateError("E-LIU-SAMPLE", f"{fault}; {remedy}")
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
DISTINCT = 5.0  # least distance between two distinct transforms, in σ
MOST_OF_REST = 0.5
"""Least share of the outliers that must agree on another transform: a few of many always lie near one by chance."""
AS_GOOD = 0.5
"""Share of the result's points with which a second transform makes the result ambiguous."""
CONTRADICTED_AT = 0.01
"""Significance level of the one-sided χ² test; stated σ are scaled if the test rejects them."""
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
    xyz_a, xyz_b : (n, 3) mm; row i of both is the same point.
    model : ``rigid``, ``similarity`` or ``affine``; the method ``liu2017`` is always affine.
    method : ``robust``, ``least-squares`` or ``liu2017``.
    threshold_mm : largest distance of inliers; estimated from the data if not given (``liu2017``: in place of its
        limit).
    weights : (n,) weights, proportional to 1/σ², positive.
    covariances : (n, 3, 3) or (n,) covariance, or variance per axis, of b − b_from_a a in frame b, mm².
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
        doubts.check_units(problem, seed)
    second = None
    published = liu2017_options or Liu2017Options()
    if threshold_mm is not None:
        published = replace(published, limit_mm=threshold_mm)
    again: Callable[[Problem], Fitted] = {
        "robust": partial(consensus.robust_fit, threshold=threshold_mm, seed=seed),
        "least-squares": lambda part: replace(_as_assigned(part, np.ones(len(part), bool), None), threshold=np.inf),
        "liu2017": lambda part: liu2017(part.xyz_a, part.xyz_b, published, seed),
    }[method]
    if method == "robust":
        fitted, second = _robust(problem, threshold_mm, seed)
    else:
        fitted = again(problem)
    inside = problem[fitted.inliers]
    if method != "liu2017":  # the baseline runs as published
        doubts.check_mirrored(inside)
        doubts.check_extent(inside.model, inside.xyz_a, fitted.sigma)
    if method == "robust" and not fitted.inliers.all():
        doubts.check_supports(problem, fitted.inliers, fitted.sigma)
    alternative = None
    if second is not None:
        rotations = [consensus.rotation_of(each.transform) for each in (fitted, second)]
        apart = np.linalg.norm(fitted.transform @ problem.xyz_a - second.transform @ problem.xyz_a, axis=1)
        turn = float(Rotation.from_matrix(rotations[0] @ rotations[1].T).magnitude())
        alternative = Alternative(
            problem.model.transform(second.transform), np.flatnonzero(second.inliers), rms(apart), turn
        )
    ambiguous = alternative is not None and len(alternative.rows) >= AS_GOOD * fitted.inliers.sum()
    if alternative is not None and ambiguous and not allow_ambiguous:
        change = doubts.moved_meanwhile(problem, fitted.transform)
        moved = "" if change is None else f"; {doubts.order_note(change, problem)}"
        others = f"{len(alternative.rows)} others on another, {alternative.apart_mm:.4g} mm from it"
        fault = f"registration: {fitted.inliers.sum()} point pairs agree on one transform and {others}"
        remedy = f"register one group of rows alone, or allow ambiguous answers{moved}"
        raise DegenerateError("E-REGISTER-TWO-TRANSFORMS", f"{fault}; {remedy}")
    covariance, scaled, redundancy = covariance_of(inside, fitted.transform, fitted.sigma, fitted.threshold)
    explained, shifted = doubts.Explained(inside, fitted.transform, fitted.sigma), None
    if method != "liu2017":
        explained = doubts.explained(inside, fitted.transform, fitted.sigma)
        shifted = doubts.shifted_rows(explained.problem, explained.transform)
    if shifted is not None:  # the transform is off by so much if the smaller group is right
        off = np.zeros(len(covariance))
        along = slice(3, None, 4) if len(off) == 12 else slice(3, 6)
        off[along] = (1 - len(shifted.rows) / shifted.count) * shifted.by_mm
        covariance = covariance + np.outer(off, off)
    result = Registration(
        model=problem.model.name,
        method=method,
        b_from_a=problem.model.transform(fitted.transform),
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
    return replace(result, notes=tuple(doubts.notes_of(result, problem, explained, shifted)))


def _checked(xyz_a, xyz_b, model: str, method: str, threshold_mm: float | None, weights, covariances, lines) -> Problem:
    a, b = (frozen(xyz, None, f"points of {name}", finite=False) for name, xyz in (("a", xyz_a), ("b", xyz_b)))
    if a.ndim != 2 or a.shape[1:] != (3,) or a.shape != b.shape:
        fault = f"registration: points of shapes {a.shape} and {b.shape}"
        raise InputError("E-ARRAY-SHAPE", f"{fault}; (n, 3) twice needed")
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
        fault = f"registration: threshold {threshold_mm:g} mm"
        raise InputError("E-OPTION-RANGE", f"{fault}; a positive number, {NEAREST_MM:g} to {FARTHEST:g}, needed")
    if method == "liu2017" and (weights is not None or covariances is not None):
        fault = "registration: method liu2017 knows no weights or covariances"
        raise InputError("E-REGISTER-WEIGHTS", f"{fault}; leave them out")
    chosen = MODELS["affine" if method == "liu2017" else model]
    if len(a) < chosen.needed:
        raise DegenerateError(
            "E-POINTS-FEW", f"registration: {len(a)} point pairs, {chosen.needed} needed for the {chosen.name} model"
        )
    return problem_of(chosen, a, b, weights, covariances, lines)


def _robust(problem: Problem, threshold: float | None, seed: int) -> tuple[Fitted, Fitted | None]:
    """Returns the fit, and another fit on which other points agree."""
    try:
        fitted = consensus.robust_fit(problem, threshold, seed)
        if len(problem) > problem.model.sample and consensus.chance(problem, fitted) > np.log(consensus.BY_CHANCE):
            raise doubts.by_chance(int(fitted.inliers.sum()), len(problem), fitted.sigma)
    except DegenerateError:
        doubts.check_mirrored_with_outliers(problem, None, threshold, seed)
        raise
    doubts.check_mirrored_with_outliers(problem, fitted, threshold, seed)
    inside = np.flatnonzero(fitted.inliers)
    groups = two_groups(problem[inside], np.random.default_rng([seed, 4]))
    if groups is None:
        return fitted, alternative_fit(problem, fitted, seed)
    apart = [problem[inside].squares(transform) for transform in groups]
    first = np.zeros(len(problem), bool)
    first[inside[apart[0] <= apart[1]]] = True
    second = fitted.inliers & ~first
    one = consensus.settled(problem, first, threshold)
    if (one.inliers & second).sum() < second.sum() / 2:
        return one, alternative_fit(problem, one, seed)
    return _as_assigned(problem, first, threshold), _as_assigned(problem, second, threshold)


def _as_assigned(problem: Problem, group: np.ndarray, threshold: float | None) -> Fitted:
    """Returns the fit to one of two groups that overlap: no threshold separates them, but their assignment is known."""
    part = problem[group]
    transform = part.fit()
    square = part.squares(transform)
    sigma = consensus.sigma_within(float(square.sum()), part.model, len(part), threshold or np.inf)
    return Fitted(transform, group, sigma, threshold or float(np.sqrt(square.max())))


def alternative_fit(problem: Problem, fitted: Fitted, seed: int) -> Fitted | None:
    """Returns the transform on which outliers agree beyond chance, within the threshold and σ's uncertainty."""
    model, outside = problem.model, np.flatnonzero(~fitted.inliers)
    if len(outside) <= model.sample or model.redundancy(len(outside)) <= 0:
        return None
    rng = np.random.default_rng(seed + 1)
    most = consensus.SUBSET
    tried = outside if len(outside) <= most else np.sort(rng.choice(outside, most, replace=False))
    redundancy = model.redundancy(int(fitted.inliers.sum()))
    threshold = fitted.threshold * float(np.sqrt(redundancy / chdtri(redundancy, 1 - consensus.FALSE_ALARMS)))
    agreed = consensus.search(problem[tried], consensus.by_threshold(threshold), rng)
    if agreed is None or agreed.inliers.sum() <= model.sample:
        return None
    transform = problem[tried[agreed.inliers]].fit()
    outliers = problem[outside]
    near = outliers.squares(transform) <= threshold**2
    if near.sum() <= model.sample or near.sum() < min(MOST_OF_REST * len(outliers), AS_GOOD * fitted.inliers.sum()):
        return None
    points = outliers.xyz_a[near]
    if np.sqrt(((transform @ points - fitted.transform @ points) ** 2).sum(1).mean()) < DISTINCT * fitted.sigma:
        return None  # good points that a tight threshold cut off
    # wrong points lie anywhere as far off the transform found as the farthest of them
    off = np.linalg.norm(outliers.residuals(fitted.transform), axis=1).max()
    found = Fitted(transform, near, fitted.sigma, threshold, agreed.samples)
    if consensus.chance(outliers, found, np.full(3, 2 * off)) > np.log(consensus.BY_CHANCE):
        return None
    return replace(found, inliers=np.isin(np.arange(len(problem)), outside[near]))


FEW, SPHERICAL = 16, 0.1
"""Largest number of points for which square sums replace determinants; significance of anisotropic noise, of half the
sets of 16 points with three times the noise along one axis."""


def two_groups(problem: Problem, rng: np.random.Generator) -> tuple[Affine, Affine] | None:
    """Returns the transforms of the larger group of points and of the other; None if one transform explains all of them
    as well, or their places determine the group."""
    n, model = len(problem), problem.model
    points = problem if n <= doubts.TRIED else problem[np.sort(rng.choice(np.arange(n), doubts.TRIED, replace=False))]
    n = len(points)
    if n < 2 * (model.sample + 1):
        return None
    try:
        single = points.whitened(points.residuals(points.fit()))
        assigned = _assigned(points, rng)
    except (DegenerateError, ConvergenceError):
        return None
    if assigned is None or np.abs(single).max() <= points.rounding_mm():
        return None
    first, (one, two) = assigned
    parted = points.whitened(np.where(first[:, None], points.residuals(one), points.residuals(two)))
    if (n - 1) * np.log(2) + _log_chance(model, single, parted) > np.log(consensus.FALSE_ALARMS):
        return None
    if doubts.lies_together(points.xyz_a, first):
        return None
    return (two, one) if first.sum() < n / 2 else (one, two)


def _log_chance(model: Model, whole: np.ndarray, parted: np.ndarray) -> float:
    """Returns a bound of the log probability that parting into given groups shrinks residuals (n, 3) so. It is 0 if the
    loudest axis's noise in the fit exceeds the quiet axes' there: determinants then tell nothing."""
    n, per_axis = len(whole), model.parameters / 3
    one, two = whole.T @ whole, parted.T @ parted
    of_error = n - 2 * per_axis
    if np.linalg.cond(two) > n / 2:
        return 0.0
    bound = wilks_bound(np.linalg.slogdet(two)[1] - np.linalg.slogdet(one)[1], of_error, per_axis)
    # of equal noise along all axes (Mauchly 1940, with Bartlett's factor)
    statistic = -(of_error - 23 / 18) * (np.linalg.slogdet(two)[1] - 3 * np.log(np.trace(two) / 3))
    if n <= FEW and chdtrc(5, max(statistic, 0.0)) > SPHERICAL:
        share = np.trace(two) / np.trace(one)
        bound = min(bound, float(consensus.chernoff(share, 1.5 * of_error, model.parameters / 2)))
    return bound


def wilks_bound(log_ratio: float, of_error: float, of_hypothesis: float) -> float:
    """Returns Chernoff's bound of log P(Λ ≤ exp(log_ratio)) for Wilks' Λ(3, of_error, of_hypothesis), a product of
    Beta((νₑ − i)/2, νₕ/2), i = 0, 1, 2 (Anderson 2003, th. 8.4.1)."""
    a, b = (of_error - np.arange(3)) / 2, of_hypothesis / 2
    t = np.linspace(0, a[2], 400, endpoint=False)[:, None]
    moments = gammaln(a - t) + gammaln(a + b) - gammaln(a) - gammaln(a + b - t)
    return float((t[:, 0] * log_ratio + moments.sum(1)).min())


def _assigned(problem: Problem, rng: np.random.Generator) -> tuple[np.ndarray, tuple[Affine, Affine]] | None:
    """Returns the mask (n,) of one group, and the transforms of both; None if one becomes too small."""
    model, n = problem.model, len(problem)
    core = consensus.search(problem, consensus.by_share(model, n), rng)
    others = np.flatnonzero(~core.inliers) if core else np.zeros(0, int)
    if core is None or len(others) <= model.sample:
        return None
    inner = consensus.search(problem[others], consensus.by_share(model, len(others)), rng)
    if inner is None:
        return None
    first, second = core.inliers, np.isin(np.arange(n), others[inner.inliers])
    best, least = None, np.inf
    while True:  # ends: each round lowers the sum of squares
        if min(first.sum(), second.sum()) <= model.sample:
            break
        transforms = problem[first].fit(), problem[second].fit()
        apart = np.array([problem.squares(t) for t in transforms])
        total = apart.min(0).sum()
        if total >= least:
            break
        first = apart[0] <= apart[1]
        second = ~first
        best, least = (first, transforms), total
    return best


def covariance_of(inliers: Problem, b_from_a: Affine, sigma: float, threshold: float) -> tuple[np.ndarray, bool, float]:
    """Returns the covariance of a fit, whether residuals scale it, and the degrees of freedom of its σ. A given σ is
    kept unless χ² contradicts it; its degrees of freedom are infinite. Cutting off at c σ, ``threshold`` in mm,
    increases the variance by χ²₃(c²)/χ²₅(c²), as for an M-estimator with hard rejection."""
    redundancy, used, scaled = float(inliers.redundancy), sigma, True
    if inliers.sigma_mm is not None:
        scaled = bool(chdtrc(redundancy, redundancy * (sigma / inliers.sigma_mm) ** 2) < CONTRADICTED_AT)
        if not scaled:
            used, redundancy = inliers.sigma_mm, np.inf
    matrix = used**2 * inliers.unit_covariance(b_from_a)
    if used > 0 and threshold < consensus.WIDE * used:
        matrix = matrix / consensus.variance_within(threshold / used)
    return matrix, scaled, redundancy
