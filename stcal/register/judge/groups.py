"""Checks whether points that agree on one transform are two groups, with transforms of their own or shifted."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import KDTree
from scipy.special import bdtrc, chdtrc, gammaln

from stcal.errors import ConvergenceError, DegenerateError
from stcal.register.core.models import Model, Transform
from stcal.register.core.pairs import Problem
from stcal.register.core.search import FALSE_ALARMS, by_share, chernoff, search
from stcal.register.judge.mistakes import FEWEST_NEIGHBOURS, neighbours_alike

TRIED = 200
"""Largest number of points that are examined. It shows a shift of half of them by 4 σ."""
MAX_ROUNDS = 30
"""Largest number of rounds of assigning and fitting; each lowers the sum of squares, so that they end earlier."""
FEW = 16
"""Largest number of points for which square sums replace determinants (see above)."""
SPHERICAL = 0.1
"""Significance level of anisotropic noise. It detects half of the sets of 16 points whose noise is three times as
large along one axis; in the other sets the effect is too weak to mislead."""
TOGETHER = 0.01
"""Probability that scattered groups seem to lie together."""


@dataclass(frozen=True, slots=True, eq=False)
class Groups:
    """Two groups of points with a transform each.

    ``transforms`` : transforms of the larger group and of the other one; ``in_space`` : whether the place determines
    the group, which indicates a bent frame and not two motions.
    """

    transforms: tuple[Transform, Transform]
    in_space: bool


@dataclass(frozen=True, slots=True, eq=False)
class _Assignment:
    """Assignment of points to two groups.

    ``first`` : (n,) mask of the first group; ``total`` : square sum of both fits.
    """

    first: np.ndarray
    transforms: tuple[Transform, Transform]
    total: float


def two_groups(problem: Problem, rng: np.random.Generator) -> Groups | None:
    """Returns the two transforms of points that fall into two groups.

    Parameters
    ----------
    problem : Problem
    rng : numpy.random.Generator

    Returns
    -------
    Groups or None
        None if one transform explains the points as well.
    """
    n, model = len(problem), problem.model
    points = problem if n <= TRIED else problem[np.sort(rng.choice(np.arange(n), TRIED, replace=False))]
    n = len(points)
    if n < 2 * (model.sample + 1):
        return None
    try:
        single = points.whitened(points.fit())
        assigned = _assigned(points, rng)
    except (DegenerateError, ConvergenceError):
        return None
    if assigned is None or np.abs(single).max() <= points.rounding_mm():
        return None
    first, (one, two) = assigned.first, assigned.transforms
    parted = np.where(first[:, None], points.whitened(one), points.whitened(two))
    if (n - 1) * np.log(2) + _log_chance(model, single, parted) > np.log(FALSE_ALARMS):
        return None
    if first.sum() < n / 2:
        return Groups((two, one), lies_together(points.xyz_a, ~first))
    return Groups((one, two), lies_together(points.xyz_a, first))


def _log_chance(model: Model, whole: np.ndarray, parted: np.ndarray) -> float:
    """Returns a bound of the log probability that parting into given groups shrinks residuals (n, 3) that much.

    It is 0 if noise along the loudest axis enters the fit and exceeds the noise of the quiet axes there: the ratio of
    their variances is then above n / 2, and determinants give no information.
    """
    n, per_axis = len(whole), model.parameters / 3
    one, two = whole.T @ whole, parted.T @ parted
    of_error = n - 2 * per_axis
    if np.linalg.cond(two) > n / 2:
        return 0.0
    bound = wilks_bound(np.linalg.slogdet(two)[1] - np.linalg.slogdet(one)[1], of_error, per_axis)
    if n <= FEW and sphericity(two, of_error) > SPHERICAL:
        share = np.trace(two) / np.trace(one)
        bound = min(bound, float(chernoff(share, 1.5 * of_error, model.parameters / 2)))
    return bound


def sphericity(scatter: np.ndarray, redundancy: float) -> float:
    """Returns the p-value of equal noise along all axes (Mauchly 1940, with Bartlett's factor)."""
    w = np.linalg.slogdet(scatter)[1] - 3 * np.log(np.trace(scatter) / 3)
    return float(chdtrc(5, max(-(redundancy - 23 / 18) * w, 0.0)))


def wilks_bound(log_ratio: float, of_error: float, of_hypothesis: float) -> float:
    """Returns Chernoff's bound of log P(Λ ≤ exp(log_ratio)) for Wilks' Λ(3, of_error, of_hypothesis).

    Λ is a product of independent Beta((νₑ − i)/2, νₕ/2), i = 0, 1, 2 (Anderson 2003, th. 8.4.1); the bound is the least
    of λᵗ E[Λ⁻ᵗ] over t.
    """
    a, b = (of_error - np.arange(3)) / 2, of_hypothesis / 2
    t = np.linspace(0, a[2], 400, endpoint=False)[:, None]
    moments = gammaln(a - t) + gammaln(a + b) - gammaln(a) - gammaln(a + b - t)
    return float((t[:, 0] * log_ratio + moments.sum(1)).min())


def lies_together(xyz_a: np.ndarray, group: np.ndarray) -> bool:
    """Returns whether neighbours are in the same group more often than by chance."""
    nearest = np.asarray(KDTree(xyz_a).query(xyz_a, k=2)[1])[:, 1]
    same = int((group[nearest] == group).sum())
    share = group.mean()
    return bool(bdtrc(same - 1, len(group), share**2 + (1 - share) ** 2) < TOGETHER)


def _assigned(problem: Problem, rng: np.random.Generator) -> _Assignment | None:
    """Returns both groups, or None if one becomes too small."""
    model, n = problem.model, len(problem)
    core = search(problem, by_share(model, n), rng)
    if core is None:
        return None
    others = np.flatnonzero(~core.inliers)
    if len(others) <= model.sample:
        return None
    inner = search(problem[others], by_share(model, len(others)), rng)
    if inner is None:
        return None
    first, second = core.inliers, np.isin(np.arange(n), others[inner.inliers])
    best = None
    for _ in range(MAX_ROUNDS):
        if min(first.sum(), second.sum()) <= model.sample:
            break
        transforms = problem[first].fit(), problem[second].fit()
        apart = np.array([problem.squares(t) for t in transforms])
        total = apart.min(0).sum()
        if best is not None and total >= best.total:
            break
        first = apart[0] <= apart[1]
        second = ~first
        best = _Assignment(first, transforms, total)
    return best


NEEDED, ALONG = 14.5, 9.2
"""Least gain in log likelihood: along any direction, and along the first principal axis."""
LEAST_SHARE = 0.15
"""Smallest fraction of the points in a group."""
ROUNDS = 60
NARROWEST = 0.01
"""Smallest ratio of a group's variance to the variance of all points, along the shift."""


@dataclass(frozen=True, slots=True, eq=False)
class Shifted:
    """Points of which some are shifted relative to the others.

    ``rows`` : (m,) indices of the smaller group; ``count`` : number of all points; ``by_mm`` : (3,) shift of the
    smaller group relative to the others, frame b; ``together`` : whether the smaller group lies together in space.
    """

    rows: np.ndarray
    count: int
    by_mm: np.ndarray
    together: bool

    def off_mm(self) -> np.ndarray:
        """Returns the deviation (3,) of the transform from that of the smaller group, if the smaller group is right."""
        return (1 - len(self.rows) / self.count) * self.by_mm


def shifted_rows(problem: Problem, transform: Transform) -> Shifted | None:
    """Returns the rows that are shifted together.

    Parameters
    ----------
    problem : points that agree on one transform
    transform : fit to these points

    Returns
    -------
    Shifted or None
        None if one group or a bent frame explains the residuals, or there are too few points.
    """
    count = len(problem)
    residuals = problem.whitened(transform)
    if count < FEWEST_NEIGHBOURS or np.abs(residuals).max() <= problem.rounding_mm():
        return None
    sample = np.unique(np.linspace(0, count - 1, min(count, TRIED)).astype(int))
    middle = residuals[sample].mean(0)
    centred = residuals[sample] - middle
    variances, axes = np.linalg.eigh(centred.T @ centred / len(sample))
    if variances[0] <= 1e-12 * variances[2]:
        return None
    to_unit = axes / np.sqrt(variances) @ axes.T
    unit = centred @ to_unit
    best = _clear(unit, axes)
    if best is None or neighbours_alike(problem.xyz_a, problem.residuals(transform)):
        return None
    second = (residuals - middle) @ to_unit @ best.axis < best.border
    if second.sum() > count / 2:
        second = ~second
    plain = problem.residuals(transform)
    by_mm = plain[second].mean(0) - plain[~second].mean(0)
    return Shifted(np.flatnonzero(second), count, by_mm, lies_together(problem.xyz_a, second))


@dataclass(frozen=True, slots=True, eq=False)
class _Parted:
    """Division into two groups.

    ``gain`` : of log likelihood; ``axis`` : of the shift; ``border`` : between them along it.
    """

    gain: float
    axis: np.ndarray
    border: float


def _clear(unit: np.ndarray, axes: np.ndarray) -> _Parted | None:
    """Returns a division of residuals (n, 3) of unit scatter into two groups that is not due to chance, or None.

    ``axes`` : principal axes before the residuals were scaled, as columns, the longest last.
    """
    best = max((_parted(unit, axis) for axis in (*_by_kurtosis(unit).T, *axes.T)), key=lambda found: found.gain)
    across = unit - (unit @ best.axis)[:, None] * best.axis
    rest = max(_parted(across, axis).gain for axis in _by_kurtosis(across).T[1:])
    if best.gain - max(rest, 0.0) > NEEDED:
        return best
    *others, longest = (_parted(unit @ axis[:, None], np.ones(1)) for axis in axes.T)
    if longest.gain - max(0.0, *(each.gain for each in others)) > ALONG:
        return replace(longest, axis=longest.axis[0] * axes[:, 2])
    return None


def _by_kurtosis(unit: np.ndarray) -> np.ndarray:
    """Returns directions as columns (3, 3), by ascending kurtosis (Cardoso 1989).

    Directions without variance come first.
    """
    return np.linalg.eigh((unit * (unit**2).sum(1)[:, None]).T @ unit)[1]


def _parted(unit: np.ndarray, axis: np.ndarray) -> _Parted:
    """Divides residuals (n, d) of unit scatter into two groups, starting from the median along ``axis``."""
    along = unit @ axis
    first = (along > np.median(along)).astype(float)
    low, high, apart = 0.0, 0.0, 0.0
    for _ in range(ROUNDS):
        share = float(np.clip(first.mean(), LEAST_SHARE, 1 - LEAST_SHARE))
        shift = first @ unit / max(first.sum(), 1e-300) - (1 - first) @ unit / max(len(first) - first.sum(), 1e-300)
        apart = max(float(np.linalg.norm(shift)), 1e-12)
        axis, narrow = shift / apart, max(1 - share * (1 - share) * apart**2, NARROWEST)
        high, low = (1 - share) * apart, -share * apart
        along = unit @ axis
        one = np.log(share) - (along - high) ** 2 / (2 * narrow)
        two = np.log1p(-share) - (along - low) ** 2 / (2 * narrow)
        both = np.logaddexp(one, two)
        first = np.exp(one - both)
    gain = float((both + along**2 / 2).sum() - len(unit) / 2 * np.log(narrow))
    border = (high + low) / 2 - narrow / apart * np.log(share / (1 - share))
    return _Parted(gain, axis, float(border))
