"""Least trimmed squares over random subsets: which observations agree, however the others err.

Huber weights bound the pull of an observation. In a set of few rows, however, several wrong rows together bend the
solution until they fit. Least trimmed squares (Rousseeuw 1984) seeks the solution whose better half fits best, and
tolerates any errors in nearly half of the rows. It is found from many small subsets by concentration steps (Rousseeuw &
Van Driessen, Data Mining and Knowledge Discovery 12, 2006). Rows that are unlikely by the solution of the agreeing
rows, with its own uncertainty, are called errors.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from stcal.geometry.robust import ratio_limit
from stcal.robot.identification.adjustment import State, linear, moved, parameter_units
from stcal.robot.identification.problem import ArmProblem

SUBSETS, SEED = 1000, 0
"""Number of random subsets, and seed. With a quarter of 40 rows wrong, one in forty is clean."""
KEPT_SUBSETS, FIRST_STEPS, STEPS = 20, 2, 50
"""Number of subsets that are followed to their end, and of concentration steps before and after their choice."""
MOST_ROWS = 400
"""Largest number of rows that are searched; of more a random sample is, with the same share of errors."""
HELD = 1e-4
"""Information on each parameter (of 1 mm) about its start, in units of that of one observation."""
FALSE_ALARM = 1e-3
"""False-alarm probability of a set: that any row of a good set is called wrong."""
TINY = 1e-300
ROUNDS, SEARCHES = 6, 2
"""Number of linear solutions, the third of which is practically exact, and of searches, the second by better σ."""


@dataclass(frozen=True, slots=True, eq=False)
class _Linearised:
    """``white`` : (r, w) residuals over σ; ``slope`` : (r, w, k) derivatives by parameters of about 1 mm."""

    white: np.ndarray
    slope: np.ndarray

    def of(self, rows: np.ndarray) -> "_Linearised":
        """Returns the problem of these rows alone."""
        return _Linearised(self.white[rows], self.slope[rows])

    def solved(self, masks: np.ndarray) -> np.ndarray:
        """Returns the steps (s, k) that solve the rows of each mask (s, r)."""
        r, _, k = self.slope.shape
        normal = np.einsum("rwa,rwb->rab", self.slope, self.slope).reshape(r, k * k)
        pull = np.einsum("rwa,rw->ra", self.slope, self.white)
        share = masks.astype(float)
        information = (share @ normal).reshape(-1, k, k) + HELD * np.eye(k)
        return np.linalg.solve(information, (share @ pull)[:, :, None])[:, :, 0]

    def left(self, steps: np.ndarray) -> np.ndarray:
        """Returns the residuals (s, r, w) after steps (s, k)."""
        r, w, k = self.slope.shape
        return (self.white.ravel() - steps @ self.slope.reshape(r * w, k).T).reshape(-1, r, w)

    def squares(self, steps: np.ndarray) -> np.ndarray:
        """Returns the squared lengths (s, r) of the residuals after steps (s, k)."""
        return (self.left(steps) ** 2).sum(2)

    def leverage(self, good: np.ndarray) -> np.ndarray:
        """Returns the variance (r, w) of each row's prediction by the ``good`` rows (r,), in units of σ²."""
        slopes = self.slope[good].reshape(-1, self.slope.shape[2])
        inverse = np.linalg.inv(slopes.T @ slopes + HELD * np.eye(slopes.shape[1]))
        return ((self.slope @ inverse) * self.slope).sum(2)


def agreeing(problem: ArmProblem, state: State) -> np.ndarray:
    """Returns a mask (r,) of the observations that agree with a solution near ``state``, linear about it; all agree if
    too few are redundant. Their σ need only be known up to a common factor."""
    measured, weighting = problem.measured, problem.weighting
    good = every = np.ones(len(measured), bool)
    for step in range(ROUNDS):
        errors, derivative = linear(state, measured)
        units = parameter_units(derivative)
        if step:
            medians = weighting.medians(weighting.whiten(errors, measured))
            weighting = weighting.with_values({n: weighting.value(n) * (value or 1.0) for n, value in medians.items()})
        rows = _Linearised(weighting.whiten(errors, measured), weighting.whiten(derivative * units, measured))
        r, w, k = rows.slope.shape
        half = (r + k // w + 1) // 2 + 1
        if half >= r:
            return every
        before, searched = good, step < SEARCHES
        begin = _trimmed(rows, half) if searched else good
        good = _tested(rows, begin, half if searched else None, list(weighting.columns(w).values()))
        state = moved(state, units * rows.solved(good[None])[0], measured.kind)
        if not searched and (good == before).all():
            break
    return good


def _trimmed(problem: _Linearised, half: int) -> np.ndarray:
    """Returns a mask (r,) of the rows of the best half."""
    rng, count = np.random.default_rng(SEED), len(problem.white)
    rows = np.sort(rng.permutation(count)[:MOST_ROWS])
    sample = problem.of(rows)
    r, w, k = sample.slope.shape
    wanted = half * r // count
    subsets = np.zeros((SUBSETS, r), bool)
    np.put_along_axis(subsets, rng.random((SUBSETS, r)).argpartition(k // w + 1, axis=1)[:, : k // w + 1], True, axis=1)
    steps = sample.solved(subsets)
    for _ in range(FIRST_STEPS):
        steps = sample.solved(_smallest(sample.squares(steps), wanted))
    cost = np.sort(sample.squares(steps), axis=1)[:, :wanted].sum(1)
    steps, last = steps[np.argsort(cost)[:KEPT_SUBSETS]], np.inf
    for _ in range(STEPS):
        squares = sample.squares(steps)
        cost = np.sort(squares, axis=1)[:, :wanted].sum(1)
        if cost.sum() >= last * (1 - 1e-9):
            break
        last = cost.sum()
        steps = sample.solved(_smallest(squares, wanted))
    return _smallest(problem.squares(steps[[cost.argmin()]]), half)[0]


def _smallest(squares: np.ndarray, wanted: int) -> np.ndarray:
    """Returns masks (s, r) of the ``wanted`` smallest values in each row."""
    masks = np.zeros(squares.shape, bool)
    np.put_along_axis(masks, squares.argpartition(wanted - 1, axis=1)[:, :wanted], True, axis=1)
    return masks


def _tested(problem: _Linearised, good: np.ndarray, half: int | None, kinds: Sequence[slice]) -> np.ndarray:
    """Returns the rows that fit the solution of the good rows within chance, repeated. ``half`` : number of good rows
    if they are the smallest; ``kinds`` : columns with one σ each, estimated from the good rows."""
    r, w, _ = problem.slope.shape
    for _ in range(STEPS):
        squares = problem.left(problem.solved(good[None]))[0] ** 2
        leverage = problem.leverage(good)
        redundancy = w * good.sum() - leverage[good].sum()
        if redundancy < 1:
            return np.ones(r, bool)
        share = 1.0
        if half is not None:  # mean square of so many smallest ones, in σ²
            limit = chi2.ppf(half / r, w)
            share, half = chi2.cdf(limit, w + 2) / (half / r), None
        length = np.zeros(r)
        for columns in kinds:
            left_over = max(squares[good, columns].size - leverage[good, columns].sum(), 1.0)
            variance = max(squares[good, columns].sum(), TINY) / left_over / share
            lever = leverage[:, columns].mean(1)
            length += squares[:, columns].sum(1) / variance / np.where(good, np.maximum(1 - lever, 1e-3), 1 + lever)
        new = length <= w * ratio_limit(FALSE_ALARM / r, w, redundancy)
        if (new == good).all():
            break
        good = new
    return good
