"""Search for point pairs that agree on one transform: random minimal samples are scored, the best are concentrated.

The score needs no threshold. For a transform and the k points nearest to it, x = RSS_k / RSS_n compares their square
sum with that of the least-squares fit to all n. Were all residuals Gaussian of one σ, x would follow
Beta((3k − p)/2, 3(n − k)/2) for a set chosen beforehand; for the best of all C(n, k) sets of all sizes the chance is at
most Σ C(n, k) P(x): a number of false alarms in the sense of Moisan & Stival (2004, a-contrario RANSAC), but with
Gaussian least squares as the background, so that neither a threshold nor a volume enters. The set that minimises it
is the consensus; a minimum above ``FALSE_ALARMS`` means that nothing contradicts one σ for all points. Chernoff's bound
stands for the Beta distribution (it is never below it, and has no underflow). Refinement is the concentration step of
least trimmed squares (Rousseeuw & Van Driessen 2006): fit to the set, choose the set anew.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations
from math import comb

import numpy as np
from scipy.special import gammaln

from stcal.errors import ConvergenceError, DegenerateError
from stcal.register.core.models import Model, hypotheses
from stcal.register.core.pairs import Problem

FALSE_ALARMS = 1e-4
"""Expectation of sets declared in data without outliers. It is small because a chance set of few points claims a
σ far too small. Real ones are far below: ten of 20 points that agree to 0.15 mm, the others off by 5 mm, have 1e-14."""
LEAST_REDUNDANCY = 6
"""Redundancy of the smallest consensus: four points rigidly, five in similarity, six affinely."""
MISSED = 1e-9
"""Chance that no sample is free of outliers, for which the number of samples is chosen."""
LEAST_SHARE = 0.25
"""Smallest share of a consensus that the number of samples is chosen to find. A smaller one may be missed."""
CLEAN_PER_WIDE = 3
"""Number of clean samples assumed for each one wide enough to lead to the optimum; measured: every second one does."""
EXHAUSTIVE = 2000
"""Largest number of possible samples that are all tried (23 points rigidly)."""
BATCH = 500
"""Number of samples scored at once."""
MOST_SAMPLES = 20_000
"""Largest number of samples, above any need: ``LEAST_SHARE`` takes 3900 samples of three points, 15 900 of four."""
REFINED = 6
"""Number of the best samples of a batch that are refined."""
MAX_STEPS = 30
"""Largest number of concentration steps. They end after a few: each lowers the score, and the sets are finite."""
TINY = 1e-24
"""Relative square sums, as a share of the points' own, below which they are rounding errors."""

Score = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Score of squared distances (s, n): value of each row (less is better), and the largest square in the row's set."""


@dataclass(frozen=True, slots=True, eq=False)
class Consensus:
    """A set of points that agree on a transform.

    ``inliers`` : (n,) bool array; ``value`` : score, less is better; ``samples`` : number of samples; 0 if all possible
    ones were tried.
    """

    inliers: np.ndarray
    value: float
    samples: int


def by_scale(model: Model, count: int, total: float) -> Score:
    """Returns a score that minimises the logarithm of the number of false alarms.

    ``total`` : sum of squares of the least-squares fit to all points.
    """
    k = np.arange(model.sample, count)
    k = k[3 * k > model.parameters]  # sets too small to be trusted are scored, too; if one wins, the result is refused
    a, b = (3 * k - model.parameters) / 2, 3 * (count - k) / 2
    tests = np.log(len(k)) + gammaln(count + 1) - gammaln(k + 1) - gammaln(count - k + 1)

    def score(square: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        ordered = np.sort(square, axis=1)
        share = np.cumsum(ordered, axis=1)[:, k - 1] / total
        value = tests + chernoff(share, a, b)
        best = value.argmin(1)
        rows = np.arange(len(square))
        return value[rows, best], ordered[rows, k[best] - 1]

    return score


def chernoff(share: float | np.ndarray, a: float | np.ndarray, b: float | np.ndarray) -> np.ndarray:
    """Returns Chernoff's bound of log P(Beta(a, b) ≤ share).

    The bound of P is (x (a + b)/a)ᵃ ((1 − x)(a + b)/b)ᵇ below a/(a + b), else 1.
    """
    limit = a / (a + b)
    share = np.clip(share, TINY, limit)
    return a * np.log(share / limit) + b * np.log((1 - share) / (1 - limit))


def by_share(model: Model, count: int) -> Score:
    """Returns the score by least trimmed squares of the larger half.

    Its breakdown point is highest (Rousseeuw 1984).
    """
    k = max((count + model.parameters // 3 + 1) // 2, model.sample + 1)

    def score(square: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        ordered = np.partition(square, k - 1, axis=1)[:, :k]
        return ordered.sum(1), ordered[:, k - 1]

    return score


def by_threshold(threshold: float) -> Score:
    """Returns the score by the square sum, cut off at the threshold (MSAC, Torr & Zisserman 2000)."""

    def score(square: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.minimum(square, threshold**2).sum(1), np.full(len(square), threshold**2)

    return score


def search(problem: Problem, score: Score, rng: np.random.Generator) -> Consensus | None:
    """Returns the best set that random samples lead to.

    Parameters
    ----------
    problem : problem
    score : score as in :func:`by_scale`, :func:`by_share` and :func:`by_threshold`
    rng : numpy.random.Generator

    Returns
    -------
    Consensus or None
        None if no sample leads to a set of enough points.
    """
    count, size = len(problem), problem.model.sample
    drawn, needed, best = 0, 1.0, None
    every = None
    if comb(count, size) <= EXHAUSTIVE:
        every = np.array(list(combinations(range(count), size)))
    while drawn < needed:
        samples = every if every is not None else _random_samples(count, size, rng)
        drawn += len(samples)
        found = _best_of(problem, score, samples)
        if found is not None and (best is None or found.value < best.value):
            best = found
        if every is not None:
            break
        share = max(best.inliers.mean() if best is not None else 0, LEAST_SHARE)
        clean = min(share, 1 - 1e-9) ** size
        needed = min(CLEAN_PER_WIDE * np.log(MISSED) / np.log1p(-clean), MOST_SAMPLES)
    return None if best is None else Consensus(best.inliers, best.value, 0 if every is not None else drawn)


def _best_of(problem: Problem, score: Score, samples: np.ndarray) -> Consensus | None:
    linear, translation = hypotheses(problem.model, problem.xyz_a[samples], problem.xyz_b[samples])
    square = _squares_of_many(linear, translation, problem)
    value, cut = score(square)
    best = None
    for i in np.argsort(value, kind="stable")[:REFINED]:
        found = _concentrated(problem, score, square[i] <= cut[i])
        if found is not None and (best is None or found.value < best.value):
            best = found
    return best


def _concentrated(problem: Problem, score: Score, inliers: np.ndarray) -> Consensus | None:
    """Alternates between fitting and selecting the set until the score decreases no more."""
    best = None
    for _ in range(MAX_STEPS):
        if inliers.sum() < problem.model.sample:
            break
        try:
            transform = problem[inliers].fit()
        except (DegenerateError, ConvergenceError):
            break
        square = problem.squares(transform)
        value, cut = score(square[None])
        if best is not None and value[0] >= best.value:
            break
        inliers = square <= cut[0]
        best = Consensus(inliers, float(value[0]), 0)
    return best


def _squares_of_many(linear: np.ndarray, translation: np.ndarray, problem: Problem) -> np.ndarray:
    """Returns the squared distances (s, n) under s transforms."""
    turned = (linear.reshape(-1, 3) @ problem.xyz_a.T).reshape(len(linear), 3, -1)
    residual = problem.xyz_b.T - translation[:, :, None]
    residual -= turned
    precision = problem.noise.precision
    if precision is not None and precision.ndim == 3:
        weighted = np.einsum("nij,sjn->sin", precision, residual, optimize=True)
        return np.maximum(np.einsum("sin,sin->sn", residual, weighted), 0)
    plain = np.einsum("sin,sin->sn", residual, residual)
    return plain if precision is None else plain * precision


def _random_samples(count: int, size: int, rng: np.random.Generator) -> np.ndarray:
    """Returns random indices (s, size), all different within each sample."""
    drawn = np.sort(rng.integers(count, size=(BATCH, size)), axis=1)
    return drawn[(np.diff(drawn, axis=1) > 0).all(1)]
