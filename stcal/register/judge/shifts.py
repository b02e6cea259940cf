"""Whether points that seem to agree are two groups with a shift between them, too small for ``groups.py`` to part them.

Two normal distributions of one covariance, a shift apart, are fitted to the residuals by expectation and maximisation
(Dempster, Laird & Rubin 1977), from the axes of greatest and of least kurtosis and from the principal ones, each parted
at its median. With the residuals' scatter known, all that matters is the direction of the shift and the residuals along
it. The gain of log likelihood over one normal distribution, less what the directions across gain too (noise that is
spread evenly, as rounding leaves it, gains along all of them alike), exceeds ``NEEDED`` in one clean set of 10 000:
simulated, its tail falls by 0.7 in the logarithm per unit, for 20 to 300 points alike. Where noise is equal along all
axes a shift lengthens the first principal axis; along it alone, and less than the gain along the others, ``ALONG`` is
exceeded as seldom, and shifts of 4.7 σ of 40 % of 100 points are missed in less than 1 of 300.
"""

from dataclasses import dataclass, replace

import numpy as np

from stcal.register.core.models import Transform
from stcal.register.core.problem import Problem
from stcal.register.judge.groups import lies_together
from stcal.register.judge.neighbours import FEWEST_NEIGHBOURS, neighbours_alike

TRIED = 200
"""Points that are looked at."""
NEEDED, ALONG = 14.5, 9.2
"""Gain in log likelihood that is needed: along any direction, and along the first principal axis."""
LEAST_SHARE = 0.15
"""Smallest fraction of the points in a group."""
ROUNDS = 60
NARROWEST = 0.01
"""Variance of a group over that of all, along the shift."""


@dataclass(frozen=True, slots=True, eq=False)
class Shifted:
    """Points of which some are shifted against the others.

    Parameters
    ----------
    rows : (m,) int array
        Indices of the fewer.
    count : int
        Of all points.
    by_mm : (3,) array
        Their shift against the others, frame b.
    together : bool
        Whether they lie together in space.
    """

    rows: np.ndarray
    count: int
    by_mm: np.ndarray
    together: bool

    def off_mm(self) -> np.ndarray:
        """(3,) how far the transform lies off that of the fewer, if these are the right ones."""
        return (1 - len(self.rows) / self.count) * self.by_mm


def shifted_rows(problem: Problem, transform: Transform) -> Shifted | None:
    """The rows that are shifted together.

    Parameters
    ----------
    problem : Problem
        Points that agree.
    transform : Transform
        Their fit.

    Returns
    -------
    Shifted or None
        None where one group explains the residuals, where a bent frame does, or with too few points.
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
    """``gain`` of log likelihood by two groups, ``axis`` of the shift, ``border`` between them along it."""

    gain: float
    axis: np.ndarray
    border: float


def _clear(unit: np.ndarray, axes: np.ndarray) -> _Parted | None:
    """Two groups of residuals (n, 3) of unit scatter that chance does not make; ``axes`` : principal ones before they
    were scaled, in columns, the longest last."""
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
    """(3, 3) directions in columns, that of the least kurtosis first of those in which points vary (Cardoso 1989)."""
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
