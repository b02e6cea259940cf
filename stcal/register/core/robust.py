"""The robust method: consensus of a subset, then σ, inliers and the final fit over all points together.

1. Consensus (``search.py``), again within its own set until nothing contradicts one σ there any more.
2. Fit, σ, inliers in turn until the set stays: a point is an outlier when its residual, with what the fit's own
   uncertainty adds (deletion residual), exceeds the F(3, ν) bound that a set of clean points exceeds anywhere in one
   case of a thousand (5 σ for a hundred points); or when it exceeds the threshold given.
3. Whether that consensus can be chance: a-contrario again, now against points that lie anywhere among the others
   (Moisan & Stival 2004).
4. Whether other points agree as well on another transform.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import gammaln
from scipy.stats import chi2
from scipy.stats import f as fisher

from stcal.errors import DegenerateError
from stcal.register.core.covariance import Noise, sigma_within
from stcal.register.core.models import Model, Transform, fit, leverages, parts, rounding_mm, squares, whitened
from stcal.register.core.search import FALSE_ALARMS, LEAST_FREEDOM, Consensus, Score, by_scale, by_threshold, search

SUBSET = 500
"""Samples are scored on so many points: σ is then known to 2 %, shares to 2 %."""
CLEAN_SETS_WITH_OUTLIER = 0.001
LEVERAGE_UP_TO = 10_000
"""With more points the fit's own uncertainty adds under 0.02 % to a residual."""
MAX_ROUNDS = 50
NESTED = 6
BY_CHANCE = 0.01
"""Sets that random points would give and that are taken for a transform: so many in one file."""
DISTINCT = 5.0
"""σ between two transforms; nearer ones are one."""
MOST_OF_REST = 0.5
"""Of many outliers some always lie near some transform; half of them do for a reason."""
AS_GOOD = 0.5
"""Another transform with this share of the points of the one found makes the answer ambiguous: with up to 60 % wrong
points, all in one other motion, the true ones are 40 : 60 of the wrong."""


@dataclass(frozen=True, slots=True, eq=False)
class Fitted:
    """``inliers`` : (n,) mask; ``sigma``, ``threshold`` : mm of a point of mean σ."""

    transform: Transform
    inliers: np.ndarray
    sigma: float
    threshold: float
    samples: int = 0


def robust_fit(
    model: Model, xyz_a: np.ndarray, xyz_b: np.ndarray, noise: Noise, threshold: float | None, seed: int
) -> Fitted:
    """Transform, inliers and σ.

    Raises
    ------
    DegenerateError
        Too few points agree, or none that could not by chance.
    """
    rng = np.random.default_rng(seed)
    count = len(xyz_a)
    rows = np.arange(count) if count <= SUBSET else np.sort(rng.choice(count, SUBSET, replace=False))
    a, b, own = xyz_a[rows], xyz_b[rows], noise[rows]
    if threshold is None:
        inliers, samples = _consensus(model, a, b, own, rng)
    else:
        found = search(model, a, b, own, by_threshold(threshold), rng)
        _enough(model, found.inliers if found is not None else np.zeros(count, bool), threshold)
        inliers, samples = found.inliers, found.samples
    start = settled(model, a, b, own, inliers, threshold)
    if count > SUBSET:
        near = squares(xyz_b - start.transform @ xyz_a, noise.precision) <= start.threshold**2
        start = settled(model, xyz_a, xyz_b, noise, near, threshold)
    return Fitted(start.transform, start.inliers, start.sigma, start.threshold, samples)


def _consensus(model: Model, a, b, noise: Noise, rng) -> tuple[np.ndarray, int]:
    """Mask of the points that agree, and samples drawn."""
    rows, samples = np.arange(len(a)), 0
    for _ in range(NESTED):
        if len(rows) <= model.sample or model.freedom(len(rows) - 1) <= 0:
            break
        x, y, own = a[rows], b[rows], noise[rows]
        total = squares(y - fit(model, x, y, own.precision) @ x, own.precision).sum()
        if total <= len(rows) * rounding_mm(x, y) ** 2:
            break
        found = search(model, x, y, own, by_scale(model, len(rows), total), rng)
        samples += found.samples if found is not None else 0
        if found is None or found.value > np.log(FALSE_ALARMS):
            break
        _can_be_trusted(model, found, rows)
        rows = rows[found.inliers]
    mask = np.zeros(len(a), bool)
    mask[rows] = True
    return mask, samples


def _can_be_trusted(model: Model, found: Consensus, rows: np.ndarray) -> None:
    agree = int(found.inliers.sum())
    if model.freedom(agree) < LEAST_FREEDOM:
        raise DegenerateError(
            f"registration: only {agree} of {len(rows)} point pairs agree on one {model.name} transform, at least "
            f"{-(-(LEAST_FREEDOM + model.parameters) // 3)} needed to tell which are wrong; measure more points"
        )


def _enough(model: Model, inliers: np.ndarray, threshold: float | None) -> None:
    agree = int(inliers.sum())
    if agree >= model.sample and model.freedom(agree) > 0:
        return
    needed = max(model.sample, model.parameters // 3 + 1)
    within = "" if threshold is None else f" within {threshold:.4g} mm"
    larger = "" if threshold is None else ", or give a larger threshold"
    raise DegenerateError(
        f"registration: fewer than {needed} of {len(inliers)} point pairs agree on one {model.name} transform{within}; "
        f"check the order of the rows and the units{larger}"
    )


def settled(
    model: Model,
    xyz_a: np.ndarray,
    xyz_b: np.ndarray,
    noise: Noise,
    inliers: np.ndarray,
    threshold: float | None,
) -> Fitted:
    """Fit, σ and inliers in turn until the set stays, or comes again: then the larger of those in the cycle."""
    seen: dict[bytes, Fitted] = {}
    floor = rounding_mm(xyz_a, xyz_b)
    for _ in range(MAX_ROUNDS):
        count = int(inliers.sum())
        _enough(model, inliers, threshold)
        transform = fit(model, xyz_a[inliers], xyz_b[inliers], noise[inliers].precision)
        residuals = xyz_b - transform @ xyz_a
        square = squares(residuals, noise.precision)
        sigma = max(sigma_within(square[inliers].sum(), model, count, threshold), floor)
        if threshold is not None:
            cut, chosen = threshold, square <= threshold**2
        else:
            cut, chosen = _chosen(model, transform, xyz_a, residuals, square, noise, inliers, sigma)
        key = np.packbits(inliers).tobytes()
        if key in seen:
            break
        seen[key] = Fitted(transform, inliers, sigma, cut)
        # no test that leaves too few to judge by
        too_few = threshold is None and model.freedom(int(chosen.sum())) < min(LEAST_FREEDOM, model.freedom(count))
        if too_few or (chosen == inliers).all():
            return seen[key]
        inliers = chosen
    names = list(seen)
    return max((seen[k] for k in names[names.index(key) if key in names else 0 :]), key=lambda f: f.inliers.sum())


def _chosen(model, transform, xyz_a, residuals, square, noise: Noise, used, sigma) -> tuple[float, np.ndarray]:
    """The threshold at the middle of the points, mm, and who passes the test."""
    total, freedom = len(square), model.freedom(int(used.sum()))
    beyond = CLEAN_SETS_WITH_OUTLIER / total
    outside = 3 * sigma**2 * fisher.isf(beyond, 3, freedom)
    if total > LEVERAGE_UP_TO:
        return float(np.sqrt(outside)), square <= outside
    deletion = deletion_squares(model, transform, xyz_a, residuals, noise, used)
    passed = deletion <= outside
    if freedom > 3:  # a point that was used is tested against the σ of the others
        rest = np.maximum(freedom * sigma**2 - deletion[used], 0) / (freedom - 3)
        passed[used] = deletion[used] <= 3 * fisher.isf(beyond, 3, freedom - 3) * np.maximum(rest, 1e-300)
    return float(np.sqrt(outside)), passed


def deletion_squares(
    model: Model,
    transform: Transform,
    xyz_a: np.ndarray,
    residuals: np.ndarray,
    noise: Noise,
    used: np.ndarray,
) -> np.ndarray:
    """(n,) rᵀ C⁻¹ r of each point's residual from a fit without it, C its covariance at unit noise.

    ``residuals`` : (n, 3) of the fit to the points ``used``; for these r (1 − H)⁻¹ r, for others r (1 + H)⁻¹ r.
    """
    spread = leverages(model, transform, xyz_a, used, noise.precision)
    own = np.where(used, -1.0, 1.0)[:, None, None]
    value, vector = np.linalg.eigh(np.eye(3) + own * spread)
    turned = np.einsum("nij,ni->nj", vector, whitened(residuals, noise.precision))
    return (turned**2 / np.maximum(value, 1e-9)).sum(1)


def chance(
    model: Model, fitted: Fitted, xyz_a: np.ndarray, xyz_b: np.ndarray, extent: np.ndarray | None = None
) -> float:
    """Logarithm of the number of sets that would agree so well were the points anywhere among the others.

    Moisan & Stival's number of false alarms, (n − m) C(n, k) C(k, m) αᵏ⁻ᵐ, least over k; α(r) is the share of a box
    that a cube of half side r takes, at most 1 along each axis. ``extent`` : (3,) sides of that box, mm; else those of
    the inliers along their principal axes (thin where they are coplanar).
    """
    rows = np.arange(len(xyz_a))[:: max(1, len(xyz_a) // LEVERAGE_UP_TO)]
    count, k = len(rows), np.arange(model.sample + 1, len(rows) + 1)
    if not len(k):
        return 0.0
    order = np.sort(np.linalg.norm(xyz_b[rows] - fitted.transform @ xyz_a[rows], axis=1))
    if extent is None:
        extent = np.ptp(_along_axes(xyz_b[rows][fitted.inliers[rows]]), axis=0)
    alpha = np.minimum(1, 2 * order[k - 1, None] / np.maximum(extent, 1e-300)).prod(1)
    choices = gammaln(count + 1) - gammaln(count - k + 1) - gammaln(model.sample + 1) - gammaln(k - model.sample + 1)
    value = np.log(count - model.sample) + choices + (k - model.sample) * np.log(np.maximum(alpha, 1e-300))
    return float(value.min())


def _along_axes(points: np.ndarray) -> np.ndarray:
    """Points along their own principal axes."""
    centred = points - points.mean(0)
    return centred @ np.linalg.eigh(centred.T @ centred)[1]


def alternative_fit(
    model: Model, fitted: Fitted, xyz_a: np.ndarray, xyz_b: np.ndarray, noise: Noise, seed: int
) -> Fitted | None:
    """What the outliers agree on, within the same threshold; None where they do not beyond chance."""
    rest = np.flatnonzero(~fitted.inliers)
    if len(rest) <= model.sample or model.freedom(len(rest)) <= 0:
        return None
    rng = np.random.default_rng(seed + 1)
    tried = rest if len(rest) <= SUBSET else np.sort(rng.choice(rest, SUBSET, replace=False))
    freedom = model.freedom(int(fitted.inliers.sum()))
    threshold = fitted.threshold * float(np.sqrt(freedom / chi2.isf(1 - FALSE_ALARMS, freedom)))  # σ may be so large
    score: Score = by_threshold(threshold)
    found = search(model, xyz_a[tried], xyz_b[tried], noise[tried], score, rng)
    if found is None or found.inliers.sum() <= model.sample:
        return None
    inside = tried[found.inliers]
    transform = fit(model, xyz_a[inside], xyz_b[inside], noise[inside].precision)
    near = squares(xyz_b[rest] - transform @ xyz_a[rest], noise[rest].precision) <= threshold**2
    if near.sum() <= model.sample or near.sum() < min(MOST_OF_REST * len(rest), AS_GOOD * fitted.inliers.sum()):
        return None
    own = xyz_a[rest[near]]
    if np.sqrt(((transform @ own - fitted.transform @ own) ** 2).sum(1).mean()) < DISTINCT * fitted.sigma:
        return None  # good points that a tight threshold cut off
    mask = np.zeros(len(xyz_a), bool)
    mask[rest[near]] = True
    other = Fitted(transform, mask, fitted.sigma, threshold, found.samples)
    alone = Fitted(transform, near, fitted.sigma, threshold)
    # wrong points lie anywhere as far off the transform found as the farthest of them
    off = np.linalg.norm(xyz_b[rest] - fitted.transform @ xyz_a[rest], axis=1).max()
    is_chance = chance(model, alone, xyz_a[rest], xyz_b[rest], np.full(3, 2 * off)) > np.log(BY_CHANCE)
    return None if is_chance else other


def turn_between(one: Transform, two: Transform) -> float:
    """Angle between the rotations of two rigid or similarity transforms, rad."""
    (a, _), (b, _) = parts(one), parts(two)
    cosine = (np.trace(a @ b.T) / np.cbrt(np.linalg.det(a) * np.linalg.det(b)) - 1) / 2
    return float(np.arccos(np.clip(cosine, -1, 1)))
