"""Which observations agree, however the others err: least trimmed squares over random subsets.

Huber's weights bound what an observation pulls, but in a set of few rows some that are wrong together bend the solution
until they fit. Least trimmed squares (Rousseeuw 1984) asks for the solution whose better half fits best, and stands
nearly half of the rows being anything; it is found from many small subsets by concentration steps (Rousseeuw & Van
Driessen, Data Mining and Knowledge Discovery 12, 2006), and what the solution of the agreeing rows, with its own
uncertainty, makes unlikely is called an error.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from stcal.geometry.robust import ratio_limit
from stcal.robot.identification.adjustment import Weighting, parameter_units
from stcal.robot.identification.residuals import Observed, State, linear, moved

SUBSETS, SEED = 1000, 0
"""Of as few rows as determine all: with a quarter of 40 rows wrong, one in forty of them is clean."""
KEPT_SUBSETS, FIRST_STEPS, STEPS = 20, 2, 50
"""Subsets that are followed to their end, and concentration steps before and then."""
MOST_ROWS = 400
"""That are searched; of more a random part, whose share of errors is theirs."""
HELD = 1e-4
"""Information of each parameter (of 1 mm) about where it starts, in units of that of one observation: what a subset
leaves open stays nominal within a hundred times the noise."""
FALSE_ALARM = 1e-3
"""Probability that of all rows of a good set one is called wrong."""
TINY = 1e-300
ROUNDS, SEARCHES = 6, 2
"""Of linear solutions, the third of which is as good as exact; and searches, the second with σ of positions and
orientations that the first one's solution leaves."""


@dataclass(frozen=True, slots=True, eq=False)
class _Problem:
    """``white`` : (r, w) residuals in units of σ; ``slope`` : (r, w, k) by the parameters, of about 1 mm each."""

    white: np.ndarray
    slope: np.ndarray

    def of(self, rows: np.ndarray) -> "_Problem":
        """Those rows."""
        return _Problem(self.white[rows], self.slope[rows])

    def solved(self, masks: np.ndarray) -> np.ndarray:
        """Steps (s, k) by the rows of each mask (s, r)."""
        r, _, k = self.slope.shape
        normal = np.einsum("rwa,rwb->rab", self.slope, self.slope).reshape(r, k * k)
        pull = np.einsum("rwa,rw->ra", self.slope, self.white)
        share = masks.astype(float)
        held = (share @ normal).reshape(-1, k, k) + HELD * np.eye(k)
        return np.linalg.solve(held, (share @ pull)[:, :, None])[:, :, 0]

    def left(self, steps: np.ndarray) -> np.ndarray:
        """(s, r, w) what steps (s, k) leave."""
        r, w, k = self.slope.shape
        return (self.white.ravel() - steps @ self.slope.reshape(r * w, k).T).reshape(-1, r, w)

    def squares(self, steps: np.ndarray) -> np.ndarray:
        """Squared lengths (s, r) of what steps (s, k) leave."""
        return (self.left(steps) ** 2).sum(2)

    def leverage(self, good: np.ndarray) -> np.ndarray:
        """(r, w) variance of a row's prediction by the good ones (r,), in units of σ²."""
        own = self.slope[good].reshape(-1, self.slope.shape[2])
        inverse = np.linalg.inv(own.T @ own + HELD * np.eye(own.shape[1]))
        return ((self.slope @ inverse) * self.slope).sum(2)


def agreeing(state: State, seen: Observed, weighting: Weighting) -> np.ndarray:
    """(r,) of bool: which observations agree with a solution near ``state``; all where too few are more than needed.

    Parameters
    ----------
    state : State
        Where the search starts; steps from it are linear.
    seen : Observed
        r observations.
    weighting : Weighting
        Their σ up to a common factor.
    """
    good = every = np.ones(len(seen), bool)
    for step in range(ROUNDS):
        left, derivative = linear(state, seen)
        units = parameter_units(derivative)
        if step:
            weighting = _reweighed(weighting, left, seen)
        problem = _Problem(weighting.whiten(left, seen), weighting.whiten(derivative * units, seen))
        r, w, k = problem.slope.shape
        half = (r + k // w + 1) // 2 + 1
        if half >= r:
            return every
        before = good
        searched = step < SEARCHES
        begin = _trimmed(problem, half) if searched else good
        good = _tested(problem, begin, half if searched else None, list(weighting.columns(w).values()))
        state = moved(state, units * problem.solved(good[None])[0], seen.kind)
        if not searched and (good == before).all():
            break
    return good


def _reweighed(weighting: Weighting, left: np.ndarray, seen: Observed) -> Weighting:
    """With σ by the medians of what a solution leaves, (r, w): of positions, and of orientations."""
    white = weighting.whiten(left, seen)
    of = {name: float(np.median(np.abs(white[:, at]))) for name, at in weighting.columns(white.shape[1]).items()}
    return weighting.with_values({name: weighting.value(name) * (value or 1.0) for name, value in of.items()})


def _trimmed(problem: _Problem, half: int) -> np.ndarray:
    """(r,) of bool: the rows of the best half."""
    rng, count = np.random.default_rng(SEED), len(problem.white)
    part = np.sort(rng.permutation(count)[:MOST_ROWS])
    own = problem.of(part)
    r, w, k = own.slope.shape
    wanted = half * r // count
    few = np.zeros((SUBSETS, r), bool)
    np.put_along_axis(few, rng.random((SUBSETS, r)).argpartition(k // w + 1, axis=1)[:, : k // w + 1], True, axis=1)
    steps = own.solved(few)
    for _ in range(FIRST_STEPS):
        steps = own.solved(_smallest(own.squares(steps), wanted))
    cost = np.sort(own.squares(steps), axis=1)[:, :wanted].sum(1)
    steps, last = steps[np.argsort(cost)[:KEPT_SUBSETS]], np.inf
    for _ in range(STEPS):
        squares = own.squares(steps)
        cost = np.sort(squares, axis=1)[:, :wanted].sum(1)
        if cost.sum() >= last * (1 - 1e-9):
            break
        last = cost.sum()
        steps = own.solved(_smallest(squares, wanted))
    return _smallest(problem.squares(steps[[cost.argmin()]]), half)[0]


def _smallest(squares: np.ndarray, wanted: int) -> np.ndarray:
    """Masks (s, r) of so many smallest of each row."""
    masks = np.zeros(squares.shape, bool)
    np.put_along_axis(masks, squares.argpartition(wanted - 1, axis=1)[:, :wanted], True, axis=1)
    return masks


def _tested(problem: _Problem, good: np.ndarray, half: int | None, kinds: Sequence[slice]) -> np.ndarray:
    """The rows that are within chance of the solution of the good ones, over again until they stay.

    ``half`` : how many are good because they are the smallest; ``kinds`` : columns of one σ each, which the good rows
    tell: by one for both, positions of a small σ pass with what orientations of a large one allow.
    """
    r, w, _ = problem.slope.shape
    for _ in range(STEPS):
        squares = problem.left(problem.solved(good[None]))[0] ** 2
        leverage = problem.leverage(good)
        redundancy = w * good.sum() - leverage[good].sum()
        if redundancy < 1:
            return np.ones(r, bool)
        share = 1.0
        if half is not None:  # the mean of the smallest squares of so many
            limit = chi2.ppf(half / r, w)
            share, half = chi2.cdf(limit, w + 2) / (half / r), None
        length = np.zeros(r)
        for own in kinds:
            left_over = max(squares[good, own].size - leverage[good, own].sum(), 1.0)
            variance = max(squares[good, own].sum(), TINY) / left_over / share
            apart = leverage[:, own].mean(1)
            length += squares[:, own].sum(1) / variance / np.where(good, np.maximum(1 - apart, 1e-3), 1 + apart)
        new = length <= w * ratio_limit(FALSE_ALARM / r, w, redundancy)
        if (new == good).all():
            break
        good = new
    return good
