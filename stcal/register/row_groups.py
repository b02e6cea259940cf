"""Points that moved together: along the order of the rows, in two groups, or with their neighbours."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree
from scipy.special import bdtrc, chdtrc, gammaln, ndtr

from stcal.errors import ConvergenceError, DegenerateError
from stcal.geometry.rigid import Rigid
from stcal.register.consensus import FALSE_ALARMS, by_share, chernoff, search
from stcal.register.transforms import RIGID, Model, Problem, Transform, jacobian, rotation_of
from stcal.row_order import Change, change_along

NEIGHBOURS = 2000
"""Largest number of points whose residuals are compared with the nearest neighbour's."""
FEWEST_NEIGHBOURS = 20
"""Least number of points for this comparison, as the sum of fewer products is not normal."""
BY_NEIGHBOURS = 1e-4
"""Probability of calling clean data bent."""


def neighbours_alike(xyz_a: np.ndarray, residuals: np.ndarray) -> bool:
    """Returns whether residuals (n, 3) correlate with those of their nearest neighbours beyond chance."""
    rows = slice(None, None, max(1, len(xyz_a) // NEIGHBOURS))
    xyz, r = xyz_a[rows], residuals[rows]
    if len(xyz) < FEWEST_NEIGHBOURS:
        return False
    pairs = np.column_stack([np.arange(len(xyz)), _nearest(xyz)])
    one, two = np.unique(np.sort(pairs, axis=1), axis=0).T
    product = np.einsum("ni,ni->n", r[one], r[two])  # the variance of their sum is the sum of their squares
    return bool(ndtr(-product.sum() / max(np.sqrt((product**2).sum()), 1e-300)) < BY_NEIGHBOURS)


def _nearest(xyz: np.ndarray) -> np.ndarray:
    return np.asarray(KDTree(xyz).query(xyz, k=2)[1])[:, 1]


LEVEL = 0.01
"""Probability that sound points seem to move along the order of their rows."""
IN_ORDER = 10_000
"""Largest number of points that are examined; larger sets are clouds without an order."""


def moved_meanwhile(problem: Problem, transform: Transform) -> Change | None:
    """Returns the jump or drift of one frame against the other along the order of the rows; None if there is none
    beyond chance, or the frames are bent and it explains no bend."""
    if len(problem) > IN_ORDER:
        return None
    from_middle = problem.xyz_a - problem.xyz_a.mean(0)
    residuals, motions = problem.residuals(transform), jacobian(RIGID, Rigid(rotation_of(transform)), from_middle)
    by_parameters = jacobian(problem.model, transform, from_middle)
    change = change_along(*(problem.whitened(each) for each in (residuals, by_parameters, motions)))
    size = 0.0 if change is None else float(np.abs(motions @ change.motion).max())
    if change is None or change.p > LEVEL or size <= problem.rounding_mm():
        return None
    rest = residuals - change.moves[:, None] * (motions @ change.motion)
    alike = [neighbours_alike(problem.xyz_a[change.good], each[change.good]) for each in (residuals, rest)]
    return None if all(alike) else change


def order_note(change: Change, problem: Problem) -> str:
    """Returns one line on a change along the order of the rows."""
    size = f"{np.linalg.norm(change.motion[3:]):.3g} mm and {np.degrees(np.linalg.norm(change.motion[:3])):.2g}°"
    share = f"{change.share:.0%} of the squared residuals, p {'< 0.001' if change.p < 1e-3 else f'= {change.p:.2g}'}"
    if change.kind == "drift":
        return f"one frame drifts against the other along the rows, by {size} from the first to the last ({share})"
    first, row, last = (problem.name(row) for row in (change.first, change.row, change.last))
    likely = f" ({first} to {last} as likely)" if first != last else ""
    return (
        f"from {row} on{likely} an instrument stands elsewhere, by {size} ({share}): register the rows before it, and "
        "those from it on, separately"
    )


TRIED = 200
"""Largest number of points that are examined. It shows a shift of half of them by 4 σ."""
MAX_ROUNDS = 30
"""Largest number of rounds of assigning and fitting; each lowers the sum of squares, so that they end earlier."""
FEW = 16
"""Largest number of points for which square sums replace determinants (see above)."""
SPHERICAL = 0.1
"""Significance level of anisotropic noise: half of the sets of 16 points with three times the noise along one axis."""
TOGETHER = 0.01
"""Probability that scattered groups seem to lie together."""


def two_groups(problem: Problem, rng: np.random.Generator) -> tuple[Transform, Transform] | None:
    """Returns the transforms of the larger group of points and of the other; None if one transform explains all of them
    as well, or their places determine the group."""
    n, model = len(problem), problem.model
    points = problem if n <= TRIED else problem[np.sort(rng.choice(np.arange(n), TRIED, replace=False))]
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
    if (n - 1) * np.log(2) + _log_chance(model, single, parted) > np.log(FALSE_ALARMS):
        return None
    if lies_together(points.xyz_a, first):
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
    if n <= FEW and sphericity(two, of_error) > SPHERICAL:
        share = np.trace(two) / np.trace(one)
        bound = min(bound, float(chernoff(share, 1.5 * of_error, model.parameters / 2)))
    return bound


def sphericity(scatter: np.ndarray, redundancy: float) -> float:
    """Returns the p-value of equal noise along all axes (Mauchly 1940, with Bartlett's factor)."""
    w = np.linalg.slogdet(scatter)[1] - 3 * np.log(np.trace(scatter) / 3)
    return float(chdtrc(5, max(-(redundancy - 23 / 18) * w, 0.0)))


def wilks_bound(log_ratio: float, of_error: float, of_hypothesis: float) -> float:
    """Returns Chernoff's bound of log P(Λ ≤ exp(log_ratio)) for Wilks' Λ(3, of_error, of_hypothesis), a product of
    Beta((νₑ − i)/2, νₕ/2), i = 0, 1, 2 (Anderson 2003, th. 8.4.1)."""
    a, b = (of_error - np.arange(3)) / 2, of_hypothesis / 2
    t = np.linspace(0, a[2], 400, endpoint=False)[:, None]
    moments = gammaln(a - t) + gammaln(a + b) - gammaln(a) - gammaln(a + b - t)
    return float((t[:, 0] * log_ratio + moments.sum(1)).min())


def lies_together(xyz_a: np.ndarray, group: np.ndarray) -> bool:
    """Returns whether neighbours are in the same group more often than by chance."""
    same = int((group[_nearest(xyz_a)] == group).sum())
    share = group.mean()
    return bool(bdtrc(same - 1, len(group), share**2 + (1 - share) ** 2) < TOGETHER)


def _assigned(problem: Problem, rng: np.random.Generator) -> tuple[np.ndarray, tuple[Transform, Transform]] | None:
    """Returns the mask (n,) of one group, and the transforms of both; None if one becomes too small."""
    model, n = problem.model, len(problem)
    core = search(problem, by_share(model, n), rng)
    others = np.flatnonzero(~core.inliers) if core else np.zeros(0, int)
    inner = search(problem[others], by_share(model, len(others)), rng) if len(others) > model.sample else None
    if core is None or inner is None:
        return None
    first, second = core.inliers, np.isin(np.arange(n), others[inner.inliers])
    best, least = None, np.inf
    for _ in range(MAX_ROUNDS):
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


NEEDED, ALONG = 14.5, 9.2
"""Least gain in log likelihood: along any direction, and along the first principal axis."""
LEAST_SHARE = 0.15
"""Smallest fraction of the points in a group."""
ROUNDS = 60
NARROWEST = 0.01
"""Smallest ratio of a group's variance to the variance of all points, along the shift."""


@dataclass(frozen=True, slots=True, eq=False)
class Shifted:
    """``rows`` : (m,) of the smaller group of ``count`` points; ``by_mm`` : (3,) its shift, frame b."""

    rows: np.ndarray
    count: int
    by_mm: np.ndarray
    together: bool


def shifted_rows(problem: Problem, transform: Transform) -> Shifted | None:
    """Returns the rows that are shifted together; None if there is no such group, a bent frame, or too few points."""
    count = len(problem)
    plain = problem.residuals(transform)
    residuals = problem.whitened(plain)
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
    if best is None or neighbours_alike(problem.xyz_a, plain):
        return None
    _, axis, border = best
    second = (residuals - middle) @ to_unit @ axis < border
    if second.sum() > count / 2:
        second = ~second
    by_mm = plain[second].mean(0) - plain[~second].mean(0)
    return Shifted(np.flatnonzero(second), count, by_mm, lies_together(problem.xyz_a, second))


Parted = tuple[float, np.ndarray, float]
"""Gain of log likelihood by two groups, the axis of their shift, and the border between them along it."""


def _clear(unit: np.ndarray, axes: np.ndarray) -> Parted | None:
    """Divides residuals (n, 3) of unit scatter into two groups, or None; ``axes`` : principal, longest last."""
    best = max((_parted(unit, axis) for axis in (*_by_kurtosis(unit).T, *axes.T)), key=lambda found: found[0])
    across = unit - (unit @ best[1])[:, None] * best[1]
    rest = max(_parted(across, axis)[0] for axis in _by_kurtosis(across).T[1:])
    if best[0] - max(rest, 0.0) > NEEDED:
        return best
    *others, (gain, sign, border) = (_parted(unit @ axis[:, None], np.ones(1)) for axis in axes.T)
    if gain - max(0.0, *(each[0] for each in others)) > ALONG:
        return gain, sign[0] * axes[:, 2], border
    return None


def _by_kurtosis(unit: np.ndarray) -> np.ndarray:
    """Returns directions as columns (3, 3), by ascending kurtosis (Cardoso 1989), those without variance first."""
    return np.linalg.eigh((unit * (unit**2).sum(1)[:, None]).T @ unit)[1]


def _parted(unit: np.ndarray, axis: np.ndarray) -> Parted:
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
    return gain, axis, float(border)
