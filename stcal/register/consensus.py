"""Fits of a registration's three models to point pairs, and the pairs that agree on one (the robust method).

1. A consensus, point pairs that agree on one transform, is searched, and again within itself until its points are
   consistent with one σ.
2. Fit, σ and inliers are updated in turn until the set stays the same. An outlier's deletion residual exceeds the
   F(3, ν) bound that any point of a clean set exceeds in one case of a thousand, or its residual the given threshold.
3. The consensus is tested for chance, now against points that lie anywhere among the others.
4. The other points are searched for another transform on which they agree as well.

In the search, random minimal samples are scored without a threshold, and the best are concentrated as in least trimmed
squares (Rousseeuw & Van Driessen 2006). Were all residuals Gaussian of one σ, x = RSS_k / RSS_n of the k points nearest
to a transform, over that of the fit to all n, would follow Beta((3k − p)/2, 3(n − k)/2) for a set chosen beforehand;
for the best of all C(n, k) sets the chance is at most Σ C(n, k) P(x), a number of false alarms in the sense of Moisan &
Stival (2004, a-contrario RANSAC). The set that minimises it is the consensus; above ``FALSE_ALARMS``, nothing
contradicts one σ for all points. Chernoff's bound stands for the Beta distribution: it has no underflow.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from math import comb
from typing import Any

import numpy as np
from scipy.optimize import root_scalar
from scipy.special import chdtr, gammaln

from stcal.errors import ConvergenceError, DegenerateError, InputError
from stcal.geometry.arrays import OF_POINT, first_fault
from stcal.geometry.least_squares import NormalEquations, minimise
from stcal.geometry.rigid import (
    Affine,
    ModelName,
    Rigid,
    Similarity,
    align,
    alignments,
    best_rotations,
    skew,
)
from stcal.geometry.robust import ratio_limit

Transform = Rigid | Similarity | Affine
EXACT = 1e-11
"""Relative σ, as a share of the coordinates' size, below which residuals are rounding errors."""
SHOWN = 5  # number of rows that a message names


@dataclass(frozen=True, slots=True)
class Model:
    """``sample`` : least number of point pairs."""

    name: ModelName
    parameters: int
    sample: int

    @property
    def needed(self) -> int:
        """Least number of point pairs of a fit with redundancy."""
        return max(self.sample, self.parameters // 3 + 1)

    def redundancy(self, n: int) -> int:
        """Returns the redundancy of a fit to n point pairs."""
        return 3 * n - self.parameters

    def transform(self, found: Affine) -> Transform:
        """Returns a transform of this model as what it is."""
        kind = {"rigid": Rigid, "similarity": Similarity.of, "affine": Affine}[self.name]
        return kind(found.linear, found.translation)


RIGID, SIMILARITY, AFFINE = Model("rigid", 6, 3), Model("similarity", 7, 3), Model("affine", 12, 4)
MODELS: dict[str, Model] = {model.name: model for model in (RIGID, SIMILARITY, AFFINE)}


def linear_part(transform: Transform) -> np.ndarray:
    """Returns the linear part (3, 3)."""
    return transform.matrix()[:3, :3]


def rotation_of(transform: Affine) -> np.ndarray:
    """Returns the rotation (3, 3) nearest to the linear part."""
    return best_rotations(transform.linear)[0]


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """Point pairs (n, 3) mm of a model, neither copied nor checked, as subsets are taken in inner loops.

    ``precision`` : (n,) inverse variances per axis, or (n, 3, 3) inverse covariances in frame b, scaled to mean σ 1
    (RMS), so that whitened residuals are mm of such a point.
    """

    model: Model
    xyz_a: np.ndarray
    xyz_b: np.ndarray
    precision: np.ndarray
    sigma_mm: float | None = None  # mean σ, if given
    lines: Sequence[int] | None = None  # of a file, by which messages name points; subsets have none

    def __len__(self) -> int:
        return len(self.xyz_a)

    def __getitem__(self, rows: np.ndarray) -> "Problem":
        """Returns the point pairs selected by a mask or by indices."""
        return Problem(self.model, self.xyz_a[rows], self.xyz_b[rows], self.precision[rows], self.sigma_mm)

    def name(self, row: Any) -> str:
        """Returns a point's name for messages: its line in the file, else its row from 1."""
        return f"row {row + 1}" if self.lines is None else f"line {self.lines[row]}"

    def names(self, rows: np.ndarray) -> str:
        """Returns the names of the first of some points, and the number of others."""
        more = f" and {len(rows) - SHOWN} more" if len(rows) > SHOWN else ""
        return ", ".join(map(self.name, rows[:SHOWN])) + more

    @property
    def redundancy(self) -> int:
        """Redundancy of a fit to all points."""
        return self.model.redundancy(len(self))

    @property
    def weights(self) -> np.ndarray:
        """Weights (n,) of the points, proportional to 1/σ²."""
        return self.precision if self.precision.ndim == 1 else np.trace(self.precision, axis1=1, axis2=2)

    def rounding_mm(self) -> float:
        """Returns the rounding error of residuals, mm. It is robust against wrong points of any size."""
        return EXACT * float(max(np.median(np.abs(xyz).max(1)) for xyz in (self.xyz_a, self.xyz_b)))

    def residuals(self, b_from_a: Transform) -> np.ndarray:
        """Returns b − b_from_a a, (n, 3) mm, frame b."""
        return self.xyz_b - b_from_a @ self.xyz_a

    def squares(self, b_from_a: Transform) -> np.ndarray:
        """Returns rᵀ P r, (n,), mm² of a point of mean σ."""
        residuals = self.residuals(b_from_a)
        if self.precision.ndim == 3:
            return np.einsum("ni,nij,nj->n", residuals, self.precision, residuals)
        return np.einsum("ni,ni->n", residuals, residuals) * self.precision

    def whitened(self, values: np.ndarray) -> np.ndarray:
        """Returns Lᵀ v of values (n, 3, …), with the precision P = L Lᵀ; residuals become mm of a point of mean σ."""
        if self.precision.ndim == 3:
            return np.einsum("nij,ni...->nj...", np.linalg.cholesky(self.precision), values)
        return values * np.sqrt(self.precision).reshape(-1, *[1] * (values.ndim - 1))

    def fit(self) -> Affine:
        """Returns the b_from_a of least Σ rᵢᵀ Pᵢ rᵢ. Raises DegenerateError; ConvergenceError with covariances."""
        start = Affine(*align(self.xyz_b, self.xyz_a, self.weights, self.model.name))
        if self.precision.ndim == 1:
            return start
        origin = self.weights @ self.xyz_a / self.weights.sum()

        def equations(transform: Affine) -> NormalEquations:
            force = np.einsum("nrs,ns->nr", self.precision, self.residuals(transform))
            pull = np.einsum("nr,nk->rk", force, _homogeneous(self.xyz_a - origin))
            gradient = -_motions(self.model, transform).T @ pull.ravel()
            return NormalEquations(float(self.squares(transform).sum()), self._normal(transform, origin), gradient)

        fitted = minimise(start, equations, lambda transform, step: _moved(self.model, transform, origin, step))
        return fitted.required("registration", "are the covariances true, or some of them huge?").state

    def unit_covariance(self, transform: Transform) -> np.ndarray:
        """Returns the covariance (p, p) of a fit's parameters at unit noise. Parameters of a left perturbation in frame
        b: rotation (rad), translation (mm), and the relative scale. Affine: rows of the 3×4 matrix."""
        origin = self._middle()
        normal, motions, shift = self._normal(transform, origin), _motions(self.model, transform), np.eye(4)
        shift[:3, 3] = -origin
        to_origin = np.linalg.pinv(motions) @ np.kron(np.eye(3), shift.T) @ motions
        scale = 1 / np.sqrt(np.diag(normal))
        covariance = np.linalg.inv(normal * scale[:, None] * scale) * scale[:, None] * scale
        return to_origin @ covariance @ to_origin.T

    def deletion_squares(self, transform: Transform, used: np.ndarray) -> np.ndarray:
        """Returns (n,) squares rᵀ C⁻¹ r of residuals from fits without the point itself (Cook & Weisberg 1982). At unit
        noise C is 1 − H of points that were ``used`` (n,) in the fit, and 1 + H of others: H = Lᵀ J N⁻¹ Jᵀ L, P = L Lᵀ.
        By an eigenvalue of H of 1, no other point checks this one."""
        origin = self[used]._middle()
        by_step = jacobian(self.model, transform, self.xyz_a - origin)
        added = by_step @ np.linalg.inv(self[used]._normal(transform, origin)) @ np.swapaxes(by_step, 1, 2)
        leverage = self.whitened(np.swapaxes(self.whitened(added), 1, 2))
        value, vector = np.linalg.eigh(np.eye(3) + np.where(used, -1.0, 1.0)[:, None, None] * leverage)
        turned = np.einsum("nij,ni->nj", vector, self.whitened(self.residuals(transform)))
        return (turned**2 / np.maximum(value, 1e-9)).sum(1)

    def _middle(self) -> np.ndarray:
        """Returns the weighted mean of a, about which the parameters correlate least."""
        return np.average(self.xyz_a, axis=0, weights=self.weights)

    def _normal(self, transform: Transform, origin: np.ndarray) -> np.ndarray:
        """Returns the normal matrix (p, p) about the origin, from the points' second moments."""
        places, motions = _homogeneous(self.xyz_a - origin), _motions(self.model, transform)
        if self.precision.ndim == 3:
            moments = np.einsum("nk,nrs,nl->rksl", places, self.precision, places)
        else:
            moments = np.einsum("rs,kl->rksl", np.eye(3), (places * self.precision[:, None]).T @ places)
        return motions.T @ moments.reshape(12, 12) @ motions


def problem_of(
    model: Model,
    xyz_a: np.ndarray,
    xyz_b: np.ndarray,
    weights: np.ndarray | None = None,
    covariances: np.ndarray | None = None,
    lines: Sequence[int] | None = None,
) -> Problem:
    """Returns the problem of pairs with (n,) weights, in 1/σ², or (n, 3, 3) covariances, or variances per axis (n,), of
    b − b_from_a a in frame b, mm². Raises InputError: both are given, a wrong shape, or not positive."""
    n = len(xyz_a)
    if weights is not None and covariances is not None:
        raise InputError("E-REGISTER-WEIGHTS", "registration: weights and covariances given; give only one of them")
    if weights is None and covariances is None:
        return Problem(model, xyz_a, xyz_b, np.ones(n), None, lines)
    name = "weights" if covariances is None else "covariances"
    given = np.asarray(weights if covariances is None else covariances, float)
    if given.shape != (n,) and (name == "weights" or given.shape != (n, 3, 3)):
        found = f"registration: {name} of shape {given.shape} for {n} point pairs"
        raise InputError("E-ARRAY-SHAPE", f"{found}; one for each needed")
    if given.ndim == 3:
        fault = first_fault(given, OF_POINT, definite=True)
        trouble = fault and f"row {fault.row + 1}: {fault.reason}"
    else:
        bad = np.flatnonzero(~(np.isfinite(given) & (given > 0)))
        trouble = f"row {bad[0] + 1} has {given[bad[0]]:.3g}, a positive number needed" if len(bad) else None
    if trouble:
        raise InputError("E-REGISTER-WEIGHTS", f"registration: {name}: {trouble}; leave a row out to give it no weight")
    if name == "weights":
        return Problem(model, xyz_a, xyz_b, given * np.mean(1 / given), None, lines)
    variance = float(np.mean(np.trace(given, axis1=1, axis2=2) / 3 if given.ndim == 3 else given))
    precision = (np.linalg.inv(given) if given.ndim == 3 else 1 / given) * variance
    return Problem(model, xyz_a, xyz_b, precision, float(np.sqrt(variance)), lines)


def jacobian(model: Model, transform: Transform, from_origin: np.ndarray) -> np.ndarray:
    """Returns the derivative (n, 3, p) of b_from_a a by the parameters of :meth:`Problem.unit_covariance` about a point
    of a, for points (n, 3) minus that point."""
    return np.einsum("nk,rkp->nrp", _homogeneous(from_origin), _motions(model, transform).reshape(3, 4, -1))


def _homogeneous(xyz: np.ndarray) -> np.ndarray:
    return np.column_stack([xyz, np.ones(len(xyz))])


def _motions(model: Model, transform: Transform) -> np.ndarray:
    """Returns the derivative (12, p) of the 3×4 matrix, row by row, by the parameters."""
    if model == AFFINE:
        return np.eye(12)
    linear = linear_part(transform)
    motions = np.zeros((model.parameters, 3, 4))
    motions[:3, :, :3] = skew(np.eye(3)) @ linear
    motions[3:6, :, 3] = np.eye(3)
    motions[6:, :, :3] = linear
    return motions.reshape(model.parameters, 12).T


def _moved(model: Model, transform: Affine, origin: np.ndarray, step: np.ndarray) -> Affine:
    """Returns the transform after a step of the parameters about ``origin``."""
    if model == AFFINE:
        change = step.reshape(3, 4)
        linear, there = transform.linear + change[:, :3], transform @ origin + change[:, 3]
    else:
        scale = 1 + step[6:].sum()
        if scale <= 0:
            fault = "registration: the scale is not determined"
            raise DegenerateError("E-REGISTER-SCALE", f"{fault}; are the covariances true?")
        linear = scale * Rigid.exp([*step[:3], 0, 0, 0]).rotation @ transform.linear
        there = transform @ origin + step[3:6]
    return Affine(linear, there - linear @ origin)


WIDE = 8.0  # threshold in σ beyond which nothing is cut off; the tail of χ²₃ is 1e-13


def sigma_within(square_sum: float, model: Model, count: int, threshold: float) -> float:
    """Returns σ per axis, mm, of ``count`` points whose residuals were cut off at a threshold, which may be infinite.
    Residuals within c σ hold only the share χ²₅(c²)/χ²₃(c²) of their variance; below c = 1 they tell nothing of σ."""
    sigma = float(np.sqrt(square_sum / model.redundancy(count)))
    if sigma == 0 or threshold > WIDE * sigma:
        return sigma

    def excess(candidate: float) -> float:
        return candidate**2 * variance_within(threshold / candidate) - sigma**2

    if excess(threshold) < 0:
        return threshold
    return float(root_scalar(excess, method="brentq", bracket=(sigma, threshold), xtol=1e-9 * sigma, rtol=1e-9).root)


def variance_within(cut: float) -> float:
    """Returns the variance of residuals within ``cut`` σ, over that of all."""
    return float(chdtr(5, cut**2) / chdtr(3, cut**2))


FALSE_ALARMS = 1e-4
"""Expectation of sets declared in data without outliers: small, as a chance set of few points claims too small a σ."""
LEAST_REDUNDANCY = 6
"""Redundancy of the smallest consensus: four points rigidly, five in similarity, six affinely."""
MISSED = 1e-9
"""Chance that no sample is free of outliers, for which the number of samples is chosen."""
LEAST_SHARE = 0.25
"""Smallest share of a consensus that the number of samples is chosen to find. A smaller one may be missed."""
EXHAUSTIVE, BATCH, MOST_SAMPLES, REFINED = 2000, 500, 20_000, 6
"""Number of possible samples that are all tried (23 points rigidly); number scored at once; largest number, above any
need, as ``LEAST_SHARE`` takes 15 900 of four points; number of the best ones of a batch that are refined."""
TINY = 1e-24
"""Relative square sums, as a share of the points' own, below which they are rounding errors."""

Score = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Score of squared distances (s, n): value of each row (less is better), and the largest square in the row's set."""


def by_scale(model: Model, count: int, total: float) -> Score:
    """Returns the logarithm of the number of false alarms as score; ``total`` : square sum of the fit to all points."""
    k = np.arange(model.sample, count)
    k = k[3 * k > model.parameters]  # sets too small to be trusted are scored, too; if one wins, the result is refused
    a, b = (3 * k - model.parameters) / 2, 3 * (count - k) / 2
    tests = np.log(len(k)) + _log_choices(count, k)

    def score(square: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        ordered = np.sort(square, axis=1)
        share = np.cumsum(ordered, axis=1)[:, k - 1] / total
        value = tests + chernoff(share, a, b)
        best = value.argmin(1)
        rows = np.arange(len(square))
        return value[rows, best], ordered[rows, k[best] - 1]

    return score


def _log_choices(n: int | np.ndarray, k: int | np.ndarray) -> np.ndarray:
    return gammaln(n + 1) - gammaln(k + 1) - gammaln(n - k + 1)


def chernoff(share: float | np.ndarray, a: float | np.ndarray, b: float | np.ndarray) -> np.ndarray:
    """Returns Chernoff's bound of log P(Beta(a, b) ≤ x): (x (a + b)/a)ᵃ ((1 − x)(a + b)/b)ᵇ below a/(a + b)."""
    limit = a / (a + b)
    share = np.clip(share, TINY, limit)
    return a * np.log(share / limit) + b * np.log((1 - share) / (1 - limit))


def by_share(model: Model, count: int) -> Score:
    """Returns least trimmed squares of the larger half as score, of the highest breakdown point (Rousseeuw 1984)."""
    k = max((count + model.parameters // 3 + 1) // 2, model.sample + 1)

    def score(square: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        ordered = np.partition(square, k - 1, axis=1)[:, :k]
        return ordered.sum(1), ordered[:, k - 1]

    return score


def by_threshold(threshold: float) -> Score:
    """Returns the score by the square sum, cut off at the threshold (MSAC, Torr & Zisserman 2000)."""
    return lambda square: (np.minimum(square, threshold**2).sum(1), np.full(len(square), threshold**2))


@dataclass(frozen=True, slots=True, eq=False)
class Consensus:
    """Points that agree on a transform."""

    inliers: np.ndarray  # (n,)
    value: float  # score, less is better
    samples: int = 0  # 0 if all were tried


def search(problem: Problem, score: Score, rng: np.random.Generator) -> Consensus | None:
    """Returns the best set by :func:`by_scale`, :func:`by_share` or :func:`by_threshold` of random samples, or None."""
    count, size = len(problem), problem.model.sample
    if comb(count, size) <= EXHAUSTIVE:
        return _best_of(problem, score, np.array(list(combinations(range(count), size))), None)
    drawn, needed, best = 0, 1.0, None
    while drawn < needed:
        samples = np.sort(rng.integers(count, size=(BATCH, size)), axis=1)
        samples = samples[(np.diff(samples, axis=1) > 0).all(1)]
        drawn += len(samples)
        best = _best_of(problem, score, samples, best)
        share = max(best.inliers.mean() if best is not None else 0, LEAST_SHARE)
        clean = min(share, 1 - 1e-9) ** size
        needed = min(3 * np.log(MISSED) / np.log1p(-clean), MOST_SAMPLES)  # every third clean sample is wide enough
    return best and replace(best, samples=drawn)


def _best_of(problem: Problem, score: Score, samples: np.ndarray, best: Consensus | None) -> Consensus | None:
    """Returns the best of the refined samples and of ``best``."""
    even = np.full(samples.shape[1], 1 / samples.shape[1])
    linear, translation = alignments(problem.xyz_b[samples], problem.xyz_a[samples], even, problem.model.name)
    residual = problem.xyz_b.T - translation[:, :, None]
    residual -= (linear.reshape(-1, 3) @ problem.xyz_a.T).reshape(len(linear), 3, -1)
    if problem.precision.ndim == 3:
        force = np.einsum("nij,sjn->sin", problem.precision, residual, optimize=True)
        square = np.maximum(np.einsum("sin,sin->sn", residual, force), 0)
    else:
        square = np.einsum("sin,sin->sn", residual, residual) * problem.precision
    value, cut = score(square)
    for i in np.argsort(value, kind="stable")[:REFINED]:  # fit and set in turn until the score decreases no more
        inliers, least = square[i] <= cut[i], np.inf
        while inliers.sum() >= problem.model.sample:
            try:
                refined = problem.squares(problem[inliers].fit())
            except (DegenerateError, ConvergenceError):
                break
            (now,), (limit,) = score(refined[None])
            if now >= least:
                break
            inliers, least = refined <= limit, float(now)
        if least < (np.inf if best is None else best.value):
            best = Consensus(inliers, least)
    return best


SUBSET = 500  # number of points on which samples are scored. It gives σ and shares to 2 %.
CLEAN_SETS_WITH_OUTLIER = 0.001
"""Probability that a clean set has any point that is called an outlier."""
LEVERAGE_UP_TO = 10_000
"""Largest number of points for which leverage is considered: beyond, it adds under 0.02 % to a residual."""
MAX_ROUNDS = 50
"""Largest number of iterations of fit, σ and inliers; a set that recurs ends them earlier."""
BY_CHANCE = 0.01  # largest number of false alarms of a consensus that is accepted, per file


@dataclass(frozen=True, slots=True, eq=False)
class Fitted:
    """A transform and the points that agree on it."""

    transform: Affine
    inliers: np.ndarray  # (n,)
    sigma: float  # per axis, mm, of a point of mean σ
    threshold: float  # likewise; may be infinite
    samples: int = 0  # random ones; 0 if all possible ones were tried


def robust_fit(problem: Problem, threshold: float | None = None, seed: int = 0) -> Fitted:
    """Returns the transform with its inliers and σ; ``threshold`` : mm of a point of mean σ, estimated if None. Raises
    DegenerateError: too few points agree. Raises ConvergenceError."""
    rng, count = np.random.default_rng(seed), len(problem)
    subset = problem if count <= SUBSET else problem[np.sort(rng.choice(count, SUBSET, replace=False))]
    if threshold is None:
        found = _consensus(subset, rng)
    else:
        found = search(subset, by_threshold(threshold), rng)
        if found is None:
            raise _too_few_agree(problem.model, count, threshold)
    start = settled(subset, found.inliers, threshold, found.samples)
    if count > SUBSET:
        near = problem.squares(start.transform) <= start.threshold**2
        start = settled(problem, near, threshold, found.samples)
    return start


def _consensus(problem: Problem, rng: np.random.Generator) -> Consensus:
    """Returns the points that agree, by a consensus within a consensus, as gross errors hide smaller ones."""
    rows, samples, model = np.arange(len(problem)), 0, problem.model
    while len(rows) > model.sample and model.redundancy(len(rows) - 1) > 0:
        subset = problem[rows]
        total = subset.squares(subset.fit()).sum()
        if total <= len(rows) * subset.rounding_mm() ** 2:
            break
        found = search(subset, by_scale(model, len(rows), total), rng)
        samples += found.samples if found is not None else 0
        if found is None or found.value > np.log(FALSE_ALARMS) or found.inliers.all():
            break
        agree = int(found.inliers.sum())
        if model.redundancy(agree) < LEAST_REDUNDANCY:
            fault = f"registration: only {agree} of {len(rows)} point pairs agree on one {model.name} transform"
            needed = f"{-(-(LEAST_REDUNDANCY + model.parameters) // 3)} needed to tell which are wrong"
            raise DegenerateError("E-REGISTER-DISAGREE", f"{fault}, at least {needed}; measure more points")
        rows = rows[found.inliers]
    return Consensus(np.isin(np.arange(len(problem)), rows), 0.0, samples)


def _too_few_agree(model: Model, count: int, threshold: float | None) -> DegenerateError:
    within, larger = ("", "") if threshold is None else (f" within {threshold:.4g} mm", ", or give a larger threshold")
    fault = f"fewer than {model.needed} of {count} point pairs agree on one {model.name} transform{within}"
    remedy = f"check the order of the rows and the units{larger}"
    return DegenerateError("E-REGISTER-DISAGREE", f"registration: {fault}; {remedy}")


def settled(problem: Problem, inliers: np.ndarray, threshold: float | None, samples: int = 0) -> Fitted:
    """Updates fit, σ and inliers in turn until the set stays the same; of a cycle, the largest is returned."""
    model, floor = problem.model, problem.rounding_mm()
    fit_of_set: dict[bytes, Fitted] = {}
    for _ in range(MAX_ROUNDS):
        count = int(inliers.sum())
        if count < model.needed:
            raise _too_few_agree(model, len(inliers), threshold)
        transform = problem[inliers].fit()
        square = problem.squares(transform)
        sigma = max(sigma_within(square[inliers].sum(), model, count, threshold or np.inf), floor)
        if threshold is not None:
            cut, chosen = threshold, square <= threshold**2
        else:
            cut, chosen = _chosen(problem, transform, square, inliers, sigma)
        key = np.packbits(inliers).tobytes()
        if key in fit_of_set:
            cycle = list(fit_of_set)
            return max((fit_of_set[k] for k in cycle[cycle.index(key) :]), key=lambda f: f.inliers.sum())
        fit_of_set[key] = Fitted(transform, inliers, sigma, cut, samples)
        # a test that leaves too few points is not applied
        enough = min(LEAST_REDUNDANCY, model.redundancy(count))
        too_few = threshold is None and model.redundancy(int(chosen.sum())) < enough
        if too_few or (chosen == inliers).all():
            return fit_of_set[key]
        inliers = chosen
    return max(fit_of_set.values(), key=lambda f: f.inliers.sum())


def _chosen(
    problem: Problem, transform: Affine, square: np.ndarray, used: np.ndarray, sigma: float
) -> tuple[float, np.ndarray]:
    """Returns the threshold at the middle of the points, mm, and the mask of the points that pass the test."""
    redundancy, beyond = problem.model.redundancy(int(used.sum())), CLEAN_SETS_WITH_OUTLIER / len(problem)
    outside = 3 * sigma**2 * ratio_limit(beyond, 3, redundancy)
    if len(problem) > LEVERAGE_UP_TO:
        return float(np.sqrt(outside)), square <= outside
    deletion = problem.deletion_squares(transform, used)
    passed = deletion <= outside
    if redundancy > 3:  # a point that was used is tested against the σ of the others
        rest = np.maximum(redundancy * sigma**2 - deletion[used], 0) / (redundancy - 3)
        passed[used] = deletion[used] <= 3 * ratio_limit(beyond, 3, redundancy - 3) * np.maximum(rest, 1e-300)
    return float(np.sqrt(outside)), passed


def chance(problem: Problem, fitted: Fitted, extent: np.ndarray | None = None) -> float:
    """Returns the log number of sets that would agree as well if points lay anywhere in a box of sides ``extent`` (3,)
    mm, by default the inliers' along principal axes: Moisan & Stival's (2004) (n − m) C(n, k) C(k, m) αᵏ⁻ᵐ, least over
    k; α(r) is the share of a cube of half side r."""
    size, every = problem.model.sample, len(problem)
    rows = np.arange(every)
    if every > LEVERAGE_UP_TO:  # at random, as wrong rows may recur in step
        rows = np.random.default_rng(0).choice(rows, LEVERAGE_UP_TO, replace=False)
    share, count, k = problem[rows], len(rows), np.arange(size + 1, len(rows) + 1)
    if not len(k):
        return 0.0
    order = np.sort(np.linalg.norm(share.residuals(fitted.transform), axis=1))
    if extent is None:
        centred = share.xyz_b[fitted.inliers[rows]]
        centred = centred - centred.mean(0)
        extent = np.ptp(centred @ np.linalg.eigh(centred.T @ centred)[1], axis=0)
    alpha = np.minimum(1, 2 * order[k - 1, None] / np.maximum(np.asarray(extent), 1e-300)).prod(1)
    choices = _log_choices(count, k) + _log_choices(k, size)
    value = np.log(count - size) + choices + (k - size) * np.log(np.maximum(alpha, 1e-300))
    return float(value.min())
