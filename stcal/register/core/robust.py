"""The robust method: consensus of a subset, then σ, inliers and the final fit over all points together.

1. A consensus (``search.py``) is searched, and again within itself until its points are consistent with one σ.
2. Fit, σ and inliers are updated in turn until the set stays the same. A point is an outlier if its residual, with the
   fit's own uncertainty (deletion residual), exceeds the F(3, ν) bound that any point of a clean set exceeds in one
   case of a thousand (5 σ for a hundred points), or if it exceeds the given threshold.
3. The consensus is tested for chance: a-contrario again, now against points that lie anywhere among the others
   (Moisan & Stival 2004).
4. The other points are searched for another transform on which they agree as well.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri, gammaln

from stcal.errors import DegenerateError
from stcal.geometry.robust import ratio_limit
from stcal.register.core.covariance import sigma_within
from stcal.register.core.models import Model, Transform, leverages, parts
from stcal.register.core.pairs import Problem
from stcal.register.core.search import FALSE_ALARMS, LEAST_REDUNDANCY, Consensus, by_scale, by_threshold, search

SUBSET = 500
"""Number of points on which samples are scored. It gives σ and shares to 2 %."""
CLEAN_SETS_WITH_OUTLIER = 0.001
"""Probability that a clean set has any point that is called an outlier."""
LEVERAGE_UP_TO = 10_000
"""Largest number of points for which leverage is considered; beyond it the fit's uncertainty adds under 0.02 % to a
residual."""
MAX_ROUNDS = 50
"""Largest number of iterations of fit, σ and inliers; a set that recurs ends them earlier."""
NESTED = 6
"""Depth of consensus within a consensus, as gross errors hide smaller ones."""
BY_CHANCE = 0.01
"""Largest number of false alarms of a consensus that is accepted, per file."""
DISTINCT = 5.0
"""Least distance between two distinct transforms, in σ."""
MOST_OF_REST = 0.5
"""Least share of the outliers that must agree on another transform. A few of many outliers always lie near some
transform by chance; half of them do not."""
AS_GOOD = 0.5
"""Share of the result's points with which a second transform makes the result ambiguous. If 60 % of the points are
wrong and all in one other motion, the true ones are 40 : 60 of the wrong."""


@dataclass(frozen=True, slots=True, eq=False)
class Fitted:
    """A transform with the points that agree on it.

    Parameters
    ----------
    transform : b_from_a
    inliers : (n,) bool array
    sigma : σ per axis, mm of a point of mean σ
    threshold : largest distance of inliers, mm of a point of mean σ; infinite if no residual was cut off
    samples : number of random samples; 0 if none or all possible ones were tried
    """

    transform: Transform
    inliers: np.ndarray
    sigma: float
    threshold: float
    samples: int = 0


def robust_fit(problem: Problem, threshold: float | None = None, seed: int = 0) -> Fitted:
    """Returns the transform with its inliers and σ.

    ``problem`` : problem; ``threshold`` : largest distance of inliers, mm of a point of mean σ; estimated if not given;
    ``seed`` : seed of the random samples.

    Raises DegenerateError if too few points agree, or no more than could agree by chance. Raises ConvergenceError: if
    a fit with covariances did not converge.
    """
    rng = np.random.default_rng(seed)
    count = len(problem)
    subset = problem if count <= SUBSET else problem[np.sort(rng.choice(count, SUBSET, replace=False))]
    if threshold is None:
        inliers, samples = _consensus(subset, rng)
    else:
        consensus = search(subset, by_threshold(threshold), rng)
        if consensus is None:
            raise _too_few_agree(problem.model, count, threshold)
        inliers, samples = consensus.inliers, consensus.samples
    start = settled(subset, inliers, threshold, samples)
    if count > SUBSET:
        near = problem.squares(start.transform) <= start.threshold**2
        start = settled(problem, near, threshold, samples)
    return start


def _consensus(problem: Problem, rng: np.random.Generator) -> tuple[np.ndarray, int]:
    """Returns the mask of the points that agree, and the number of samples."""
    rows, samples = np.arange(len(problem)), 0
    model = problem.model
    for _ in range(NESTED):
        if len(rows) <= model.sample or model.redundancy(len(rows) - 1) <= 0:
            break
        subset = problem[rows]
        total = subset.squares(subset.fit()).sum()
        if total <= len(rows) * subset.rounding_mm() ** 2:
            break
        consensus = search(subset, by_scale(model, len(rows), total), rng)
        samples += consensus.samples if consensus is not None else 0
        if consensus is None or consensus.value > np.log(FALSE_ALARMS):
            break
        _check_trust(model, consensus)
        rows = rows[consensus.inliers]
    mask = np.zeros(len(problem), bool)
    mask[rows] = True
    return mask, samples


def _check_trust(model: Model, found: Consensus) -> None:
    agree = int(found.inliers.sum())
    if model.redundancy(agree) < LEAST_REDUNDANCY:
        raise DegenerateError(
            "E-REGISTER-DISAGREE",
            f"registration: only {agree} of {len(found.inliers)} point pairs agree on one {model.name} transform, at "
            f"least {-(-(LEAST_REDUNDANCY + model.parameters) // 3)} needed to tell which are wrong; measure more "
            "points",
        )


def _too_few_agree(model: Model, count: int, threshold: float | None) -> DegenerateError:
    within = "" if threshold is None else f" within {threshold:.4g} mm"
    larger = "" if threshold is None else ", or give a larger threshold"
    return DegenerateError(
        "E-REGISTER-DISAGREE",
        f"registration: fewer than {model.needed} of {count} point pairs agree on one {model.name} transform{within}; "
        f"check the order of the rows and the units{larger}",
    )


def settled(problem: Problem, inliers: np.ndarray, threshold: float | None, samples: int = 0) -> Fitted:
    """Updates fit, σ and inliers in turn until the set stays the same. Of a cycle of sets the largest is returned.

    Parameters
    ----------
    problem : problem
    inliers : (n,) first set of inliers
    threshold, samples : : as in :func:`robust_fit` and :class:`Fitted`

    Returns
    -------
    Fitted

    Raises
    ------
    DegenerateError
        If too few points agree.
    """
    model = problem.model
    fit_of_set: dict[bytes, Fitted] = {}
    floor = problem.rounding_mm()
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
    problem: Problem, transform: Transform, square: np.ndarray, used: np.ndarray, sigma: float
) -> tuple[float, np.ndarray]:
    """Returns the threshold at the middle of the points, mm, and the mask of the points that pass the test."""
    total, redundancy = len(problem), problem.model.redundancy(int(used.sum()))
    beyond = CLEAN_SETS_WITH_OUTLIER / total
    outside = 3 * sigma**2 * ratio_limit(beyond, 3, redundancy)
    if total > LEVERAGE_UP_TO:
        return float(np.sqrt(outside)), square <= outside
    deletion = deletion_squares(problem, transform, used)
    passed = deletion <= outside
    if redundancy > 3:  # a point that was used is tested against the σ of the others
        rest = np.maximum(redundancy * sigma**2 - deletion[used], 0) / (redundancy - 3)
        passed[used] = deletion[used] <= 3 * ratio_limit(beyond, 3, redundancy - 3) * np.maximum(rest, 1e-300)
    return float(np.sqrt(outside)), passed


def deletion_squares(problem: Problem, transform: Transform, used: np.ndarray) -> np.ndarray:
    """Returns the squares of each point's residual from a fit without this point.

    r (1 − H)⁻¹ r for points that were used, r (1 + H)⁻¹ r for others, with whitened residuals r and H of
    :func:`~stcal.register.core.models.leverages` (Cook & Weisberg 1982, Residuals and Influence in Regression).

    Parameters
    ----------
    problem : problem
    transform : fit to the points used
    used : (n,) bool array

    Returns
    -------
    (n,) array
        rᵀ C⁻¹ r, C the residual's covariance at unit noise.
    """
    added = leverages(problem.model, transform, problem.xyz_a, used, problem.noise.precision)
    own = np.where(used, -1.0, 1.0)[:, None, None]
    value, vector = np.linalg.eigh(np.eye(3) + own * added)
    turned = np.einsum("nij,ni->nj", vector, problem.whitened(transform))
    return (turned**2 / np.maximum(value, 1e-9)).sum(1)


def chance(problem: Problem, fitted: Fitted, extent: np.ndarray | None = None) -> float:
    """Returns the logarithm of the number of sets that would agree as well if the points lay anywhere among the others.

    Moisan & Stival's (2004) number of false alarms, (n − m) C(n, k) C(k, m) αᵏ⁻ᵐ, least over k; α(r) is the share of a
    box that a cube of half side r takes, at most 1 along each axis.

    Parameters
    ----------
    problem : Problem
    fitted : Fitted
    extent : (3,) array, optional
        Sides of this box, mm; by default those of the inliers along their principal axes (thin if they are coplanar).

    Returns
    -------
    float
        Its logarithm.
    """
    model, every = problem.model, len(problem)
    rows = np.arange(every)[:: max(1, every // LEVERAGE_UP_TO)]
    share = problem[rows]
    count, k = len(rows), np.arange(model.sample + 1, len(rows) + 1)
    if not len(k):
        return 0.0
    order = np.sort(np.linalg.norm(share.residuals(fitted.transform), axis=1))
    sides = np.ptp(_along_axes(share.xyz_b[fitted.inliers[rows]]), axis=0) if extent is None else extent
    alpha = np.minimum(1, 2 * order[k - 1, None] / np.maximum(sides, 1e-300)).prod(1)
    choices = gammaln(count + 1) - gammaln(count - k + 1) - gammaln(model.sample + 1) - gammaln(k - model.sample + 1)
    value = np.log(count - model.sample) + choices + (k - model.sample) * np.log(np.maximum(alpha, 1e-300))
    return float(value.min())


def _along_axes(points: np.ndarray) -> np.ndarray:
    """Returns the points along their own principal axes."""
    centred = points - points.mean(0)
    return centred @ np.linalg.eigh(centred.T @ centred)[1]


def alternative_fit(problem: Problem, fitted: Fitted, seed: int) -> Fitted | None:
    """Returns the transform on which the outliers agree within the same threshold.

    Parameters
    ----------
    problem : problem
    fitted : transform of the inliers
    seed : seed as in :func:`robust_fit`

    Returns
    -------
    Fitted or None
        None if the outliers agree no better than by chance.
    """
    model = problem.model
    outside = np.flatnonzero(~fitted.inliers)
    if len(outside) <= model.sample or model.redundancy(len(outside)) <= 0:
        return None
    rng = np.random.default_rng(seed + 1)
    tried = outside if len(outside) <= SUBSET else np.sort(rng.choice(outside, SUBSET, replace=False))
    redundancy = model.redundancy(int(fitted.inliers.sum()))
    # σ may be so large
    threshold = fitted.threshold * float(np.sqrt(redundancy / chdtri(redundancy, 1 - FALSE_ALARMS)))
    consensus = search(problem[tried], by_threshold(threshold), rng)
    if consensus is None or consensus.inliers.sum() <= model.sample:
        return None
    transform = problem[tried[consensus.inliers]].fit()
    outliers = problem[outside]
    near = outliers.squares(transform) <= threshold**2
    if near.sum() <= model.sample or near.sum() < min(MOST_OF_REST * len(outliers), AS_GOOD * fitted.inliers.sum()):
        return None
    points = outliers.xyz_a[near]
    if np.sqrt(((transform @ points - fitted.transform @ points) ** 2).sum(1).mean()) < DISTINCT * fitted.sigma:
        return None  # good points that a tight threshold cut off
    # wrong points lie anywhere as far off the transform found as the farthest of them
    off = np.linalg.norm(outliers.residuals(fitted.transform), axis=1).max()
    alone = Fitted(transform, near, fitted.sigma, threshold)
    if chance(outliers, alone, np.full(3, 2 * off)) > np.log(BY_CHANCE):
        return None
    mask = np.zeros(len(problem), bool)
    mask[outside[near]] = True
    return Fitted(transform, mask, fitted.sigma, threshold, consensus.samples)


def turn_between(one: Transform, two: Transform) -> float:
    """Returns the angle between the rotations of two rigid or similarity transforms, rad."""
    (a, _), (b, _) = parts(one), parts(two)
    cosine = (np.trace(a @ b.T) / np.cbrt(np.linalg.det(a) * np.linalg.det(b)) - 1) / 2
    return float(np.arccos(np.clip(cosine, -1, 1)))
