"""Whether points that seem to agree on one transform are two groups, each with a transform of its own.

When half of the points are shifted together by a few σ, one transform between the two leaves residuals that look like
more noise. Two transforms are found by least trimmed squares for half of the points and for the rest, and then by
assigning points and fitting in turn. x = RSS₂ / RSS₁ of two and one transform would be Beta((3n − 2p)/2, p/2) for
groups chosen beforehand, and there are 2ⁿ⁻¹ ways to choose: the same number of false alarms as in ``search.py``.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.stats import binom

from stcal.errors import ConvergenceError, DegenerateError
from stcal.register.covariance import Noise
from stcal.register.models import Model, Transform, fit, squares
from stcal.register.search import FALSE_ALARMS, by_share, chernoff, search

TRIED = 200
"""Points that are looked at: a shift of 4 σ of half of them is seen then."""
MAX_ROUNDS = 30
TOGETHER = 0.01
"""Chance of scattered groups to seem to lie together."""


@dataclass(frozen=True, slots=True, eq=False)
class Groups:
    """``transforms`` : of the larger group and of the other; ``in_space`` : whether place tells the group, which speaks
    for a bent frame and not for two motions."""

    transforms: tuple[Transform, Transform]
    in_space: bool


def two_groups(
    model: Model, xyz_a: np.ndarray, xyz_b: np.ndarray, noise: Noise, rng: np.random.Generator
) -> Groups | None:
    """The two transforms; None where one explains the points as well."""
    rows = np.arange(len(xyz_a))
    if len(rows) > TRIED:
        rows = np.sort(rng.choice(rows, TRIED, replace=False))
    a, b, own = xyz_a[rows], xyz_b[rows], noise[rows]
    n = len(rows)
    least = model.sample + 1
    if n < 2 * least:
        return None
    try:
        whole = squares(b - fit(model, a, b, own.precision) @ a, own.precision).sum()
        found = _assigned(model, a, b, own, rng)
    except (DegenerateError, ConvergenceError):
        return None
    if found is None or whole == 0:
        return None
    first, transforms, rest = found
    degrees = 3 * n - 2 * model.parameters
    false_alarms = (n - 1) * np.log(2) + chernoff(rest / whole, degrees / 2, model.parameters / 2)
    if false_alarms > np.log(FALSE_ALARMS):
        return None
    if first.sum() < n / 2:
        first, transforms = ~first, transforms[::-1]
    return Groups(transforms, lies_together(a, first))


def lies_together(xyz_a: np.ndarray, group: np.ndarray) -> bool:
    """Whether neighbours are in the same group more often than chance would have it."""
    nearest = cKDTree(xyz_a).query(xyz_a, k=2)[1][:, 1]
    same = int((group[nearest] == group).sum())
    share = group.mean()
    return bool(binom.sf(same - 1, len(group), share**2 + (1 - share) ** 2) < TOGETHER)


def _assigned(model: Model, a, b, noise: Noise, rng):
    """Mask of the first group, both transforms and the square sum; None where a group becomes too small."""
    core = search(model, a, b, noise, by_share(model, len(a)), rng)
    if core is None:
        return None
    rest = np.flatnonzero(~core.inliers)
    if len(rest) <= model.sample:
        return None
    inner = search(model, a[rest], b[rest], noise[rest], by_share(model, len(rest)), rng)
    if inner is None:
        return None
    first, second = core.inliers, np.isin(np.arange(len(a)), rest[inner.inliers])
    best = None
    for _ in range(MAX_ROUNDS):
        if min(first.sum(), second.sum()) <= model.sample:
            break
        pair = tuple(fit(model, a[g], b[g], noise[g].precision) for g in (first, second))
        apart = np.array([squares(b - t @ a, noise.precision) for t in pair])
        total = apart.min(0).sum()
        if best is not None and total >= best[2]:
            break
        first = apart[0] <= apart[1]
        second = ~first
        best = (first, pair, total)
    return best
