"""Least squares over the minimal parameters of a robot, robust; what the data determine told apart."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.linalg import solve_triangular

from stcal.geometry.least_squares import Minimum, NormalEquations, minimise
from stcal.geometry.robust import huber_cost, huber_weights, length_limit
from stcal.robot.identification.residuals import WIDTH, Kind, Observed, State, curvature, linear, moved, residuals

MAX_STEPS = 100
SETTLED = 1e-10
"""Relative fall of the cost below which nothing is gained."""
HUBER_LEVEL = 0.999
"""One honest observation in a thousand weighs less than one."""
USELESS_MM = 50.0
"""A direction (1 mm, or the turn that moves the tool by 1 mm) with a larger σ is not determined: the nominal is better.
All parameters are held to where they start by this σ, which nothing feels that is determined."""
ACCEPTED = 1e-4
"""In units of σ²: what a step may still promise when there have been enough. Along a flat direction, where Huber's
weights make every step half as long as it should be, they are many and short."""
ACCEPTED_ELASTIC = 0.05
"""The same along bent valleys: 0.2 σ of what is hardly known."""
MOST_BENT = 2 / 3
"""Of the curvature along a direction, what second derivatives may take away: variances become three times as large.
Flatter valleys have two minima, of which no curvature at one knows."""
ROUNDING = 1e-13
"""Of the square root of a normal matrix with a diagonal of 1 and some hundred parameters."""
NEAR, NEAR_STEPS = 1.0, 50
"""In units of σ²: what a straight step promises where second derivatives are good for. Steps by these from afar may end
where compliance and moment both have the wrong sign. Along bent valleys straight ones are many; they need not end."""
STAYS_MM = 1e-3
"""σ of a movement that the observations never show."""
LEAST_GAIN, LEAST_ELASTIC = 1e-9, 1e-3
"""In units of σ²: what measurements without noise still gain by rounding; and what is not worth a step along the bent
valleys of products of compliance and moment: no parameter is moved by it by more than 0.03 σ."""


@dataclass(frozen=True, slots=True)
class Weighting:
    """σ of one coordinate; the covariances that came with the measurements in place of both where ``given``; times
    ``factor``. ``estimated`` : which of ``"mm"``, ``"rad"``, ``"factor"`` the residuals tell."""

    sigma_mm: float
    sigma_rad: float
    given: bool = False
    factor: float = 1.0
    estimated: tuple[str, ...] = ()

    def whiten(self, values: np.ndarray, seen: Observed) -> np.ndarray:
        """Residuals (r, w) or derivatives (r, w, k) of ``seen`` in units of σ."""
        flat = values.ndim == 2
        values = values[..., None] if flat else values
        width = values.shape[1]
        if self.given and width > 1:
            root = self._root(seen, width)
            values = _decorrelated(np.linalg.solve(root, values), root, seen)
        else:
            values = values / self._sigma(width)[:, None]
        return values[..., 0] if flat else values

    def pull(self, white: np.ndarray, seen: Observed) -> np.ndarray:
        """Half the derivative (r, w) by residuals of the sum of squares of what :meth:`whiten` makes of them, ``white``
        (r, w)."""
        width = white.shape[1]
        if not (self.given and width > 1):
            return white / self._sigma(width)
        root = self._root(seen, width)
        white = _decorrelated(white[..., None], root, seen)
        return np.linalg.solve(np.swapaxes(root, 1, 2), white)[..., 0]

    def _sigma(self, width: int) -> np.ndarray:
        """(width,) of the coordinates."""
        return self.factor * np.array([self.sigma_rad] * 3 + [self.sigma_mm] * 3)[-width:]

    def _root(self, seen: Observed, width: int) -> np.ndarray:
        """(r, width, width) of the covariances that came with the measurements."""
        return self.factor * np.linalg.cholesky(seen.data.own_covariance()[:, -width:, -width:])

    def columns(self, width: int) -> dict[str, slice]:
        """Which of the ``width`` coordinates each σ is of."""
        if "factor" in self.estimated:
            return {"factor": slice(None)}
        return {"rad": slice(0, 3), "mm": slice(3, 6)} if width == 6 else {"mm": slice(None)}

    def value(self, name: str) -> float:
        """Of σ ``name``."""
        return {"mm": self.sigma_mm, "rad": self.sigma_rad, "factor": self.factor}[name]

    def with_values(self, found: Mapping[str, float]) -> "Weighting":
        """With other σ."""
        new = {name: found.get(name, self.value(name)) for name in ("mm", "rad", "factor")}
        return replace(self, sigma_mm=new["mm"], sigma_rad=new["rad"], factor=new["factor"])


def _decorrelated(values: np.ndarray, root: np.ndarray, seen: Observed) -> np.ndarray:
    """Values (r, w, k), all of σ 1 but for the errors that the observations have in common, times the inverse root of
    their covariance 1 + F Fᵀ, F being these errors over ``root`` (r, w, w) with its rows stacked: what all may have in
    common counts less."""
    if seen.data.common is None:
        return values
    common = np.linalg.solve(root, seen.data.common[:, -root.shape[1] :])
    f = common.reshape(-1, common.shape[2])
    size, directions = np.linalg.eigh(f.T @ f)
    size, directions = size[size > 0], directions[:, size > 0]
    u = f @ directions / np.sqrt(size)
    flat = values.reshape(len(f), -1)
    return (flat - u * (1 - 1 / np.sqrt(1 + size)) @ (u.T @ flat)).reshape(values.shape)


@dataclass(frozen=True, slots=True, eq=False)
class Held:
    """Knowledge from elsewhere, linear about a state: ``value + jacobian @ step``, (p,), is 0 with σ ``sigma``;
    ``fixed`` : (p,) which of it are conditions, of a σ that nothing feels."""

    value: np.ndarray
    jacobian: np.ndarray
    sigma: np.ndarray
    fixed: np.ndarray

    def conditions(self) -> np.ndarray:
        """(k, k) of these alone."""
        own = self.jacobian[self.fixed] / self.sigma[self.fixed, None]
        return own.T @ own

    def normal(self) -> np.ndarray:
        """(k, k)"""
        return (self.jacobian.T / self.sigma**2) @ self.jacobian

    def pull(self) -> np.ndarray:
        """(k,) half the gradient of the squares."""
        return (self.jacobian.T / self.sigma**2) @ self.value


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """``state`` : adjusted; ``residuals`` : (r, w) rad, mm; ``weights`` : (r,) Huber's; ``normal`` : (k, k) whitened
    and weighted, of the observations alone; ``prior`` : (k, k) of what was held; ``units`` : (k,) that make each
    parameter a movement of the tool of about 1 mm; ``cost`` : Huber's; ``conditions`` : (k, k) of them, and ``count``
    how many."""

    state: State
    residuals: np.ndarray
    weights: np.ndarray
    normal: np.ndarray
    units: np.ndarray
    cost: float
    prior: np.ndarray
    conditions: np.ndarray
    count: int = 0

    def spectrum(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of the j parameters of axes and tools: eigenvalues (j,), directions (j, j) in columns, and which the data
        determine (j,), or conditions. Of elasticity there is knowledge beforehand."""
        own = slice(len(self.units) - self.state.elastic_count)
        known = self.normal[own, own] + self.conditions[own, own]
        values, directions = np.linalg.eigh(known * self.units[own, None] * self.units[own])
        return values, directions, values > 1 / USELESS_MM**2

    def rank(self) -> int:
        """Directions that the data determine."""
        return int(self.spectrum()[2].sum()) - self.count

    def inverse(self) -> np.ndarray:
        """(k, k) covariance of the parameters at unit weight."""
        scaled = (self.normal + self.prior) * self.units[:, None] * self.units
        return np.linalg.inv(scaled) * self.units[:, None] * self.units


def solve(
    state: State, seen: Observed, weighting: Weighting, robust: bool = True, held: Held | None = None
) -> Solution:
    """Minimise the observations' whitened residuals from ``state``, where ``held`` is linear.

    Parameters are small motions about the present state, so that no representation is ever singular.

    Raises
    ------
    ConvergenceError
        No minimum is reached.
    """
    limit = huber_limit(seen.kind) if robust else np.inf
    first = _linearised(state, seen, weighting, limit)[0]
    elsewhere, pull = np.zeros_like(first.normal), np.zeros(len(first.units))
    conditions, count = np.zeros_like(first.normal), 0
    if held is not None:
        elsewhere, pull = held.normal(), held.pull()
        conditions, count = held.conditions(), int(held.fixed.sum())
    _, directions, good = replace(first, conditions=conditions).spectrum()
    known = elsewhere + _fixed(first, directions[:, : unseen(seen.kind)])
    hold = elsewhere + _fixed(first, directions[:, ~good])  # along open ones valleys bend, and lead far

    def kept(away: np.ndarray) -> NormalEquations:
        return NormalEquations(float(away @ (hold @ away + 2 * pull)), hold, hold @ away + pull)

    def linearise(at: _Away, bends: bool) -> NormalEquations:
        found, gradient = _linearised(at.state, seen, weighting, limit)
        straight = NormalEquations(found.cost, found.normal, gradient) + kept(at.away)
        curved = curvature_of(found, seen, weighting) if bends else None
        if curved is None:
            return straight
        return replace(straight, normal=straight.normal - Bent.of(straight.normal, curved).taken())

    def descended(begin: _Away, bends: bool, least_gain: float, max_steps: int) -> Minimum[_Away, NormalEquations]:
        return minimise(
            begin,
            partial(linearise, bends=bends),
            lambda at, step: _Away(moved(at.state, step, seen.kind), at.away + step),
            cost=lambda at: _cost(residuals(at.state, seen), seen, weighting, limit) + float(kept(at.away).cost),
            settled=SETTLED,
            least_gain=least_gain,
            max_steps=max_steps,
        )

    begin = _Away(state, np.zeros(len(hold)))
    if state.elastic:
        near = descended(begin, False, NEAR, NEAR_STEPS).state
        found, accepted = descended(near, True, LEAST_ELASTIC, MAX_STEPS), ACCEPTED_ELASTIC
    else:
        found, accepted = descended(begin, False, LEAST_GAIN, MAX_STEPS), ACCEPTED
    found.required(f"{seen.data.where}: identification", "check the robot file and the outliers", accepted)
    solution = _linearised(found.state.state, seen, weighting, limit)[0]
    return replace(solution, prior=known, conditions=conditions, count=count)


def curvature_of(solution: Solution, seen: Observed, weighting: Weighting) -> np.ndarray | None:
    """(k, k) what products of compliance and moment take from the normal matrix, where there are such; without it
    descents along their bent valleys take hundreds of steps. Of distances, which bend by themselves, none are taken."""
    if not solution.state.elastic or seen.kind == "distance":
        return None
    white = solution.weights[:, None] * weighting.whiten(solution.residuals, seen)
    own = curvature(solution.state, seen, weighting.pull(white, seen))
    k, count = len(solution.units), solution.state.elastic_count
    found = np.zeros((k, k))
    place = slice(k - count, k - count + len(own))
    found[place, place] = own
    return found


@dataclass(frozen=True, slots=True, eq=False)
class Bent:
    """What second derivatives take from a normal matrix (k, k), as shares of it along directions that are independent
    by it: at the most :data:`MOST_BENT`, since a saddle is no minimum, and what is left of a flat valley is.

    ``root`` : (k, k) of the normal matrix; ``directions`` : (k, k) in columns; ``share`` : (k,).
    """

    root: np.ndarray
    directions: np.ndarray
    share: np.ndarray

    @classmethod
    def of(cls, normal: np.ndarray, curved: np.ndarray) -> "Bent":
        """Where all of what second derivatives take is ``curved`` (k, k)."""
        scale = np.sqrt(np.diag(normal))
        unit = normal / scale[:, None] / scale + ROUNDING * np.eye(len(scale))
        root = scale[:, None] * np.linalg.cholesky(unit)
        half = solve_triangular(root, curved, lower=True)
        share, directions = np.linalg.eigh(solve_triangular(root, half.T, lower=True))
        return cls(root, directions, np.minimum(share, MOST_BENT))

    def taken(self) -> np.ndarray:
        """(k, k) from the normal matrix."""
        along = self.root @ self.directions
        return (along * self.share) @ along.T

    def bends(self) -> np.ndarray:
        """(k, k) B: with the normal matrix N, Bᵀ N B is what is left of it."""
        wider = (self.directions * np.sqrt(1 - self.share)) @ self.directions.T
        return solve_triangular(self.root, wider @ self.root.T, lower=True, trans=1)


@dataclass(frozen=True, slots=True, eq=False)
class _Away:
    """A state, and the sum of the steps (k,) that led there."""

    state: State
    away: np.ndarray


def unseen(kind: Kind) -> int:
    """Directions that this kind of observation never shows: where the instrument stands."""
    return 6 if kind == "distance" else 0


def _fixed(solution: Solution, directions: np.ndarray) -> np.ndarray:
    """(k, k) what keeps parameters where they start: hardly at all, but along ``directions`` (j, d) of them firmly."""
    kept = np.pad(directions, ((0, solution.state.elastic_count), (0, 0)))
    fixed = np.eye(len(kept)) / USELESS_MM**2 + kept @ kept.T / STAYS_MM**2
    return fixed / solution.units[:, None] / solution.units


def huber_limit(kind: Kind) -> float:
    """Length of an observation's whitened residual beyond which it weighs less."""
    return length_limit(WIDTH[kind], 1 - HUBER_LEVEL)


def normal_rank(state: State, seen: Observed, weighting: Weighting) -> int:
    """How many parameters these observations determine, at the state where they would be exact."""
    return _linearised(state, seen, weighting, np.inf)[0].rank()


def _linearised(state: State, seen: Observed, weighting: Weighting, limit: float) -> tuple[Solution, np.ndarray]:
    """State with its normal matrix, and half the gradient (k,) of the cost."""
    found, derivative = linear(state, seen)
    units = parameter_units(derivative)
    white, whitened = weighting.whiten(found, seen), weighting.whiten(derivative, seen)
    weights = huber_weights(np.linalg.norm(white, axis=1), limit)
    flat = whitened.reshape(-1, whitened.shape[2])
    weighted = flat * np.repeat(weights, white.shape[1])[:, None]
    cost = float(huber_cost(np.linalg.norm(white, axis=1), limit).sum())
    normal = weighted.T @ flat
    none = np.zeros_like(normal)
    return Solution(state, found, weights, normal, units, cost, none, none), -weighted.T @ white.ravel()


def parameter_units(derivative: np.ndarray) -> np.ndarray:
    """Of each parameter, what moves the tool by 1 mm RMS at most; 1 for what moves nothing."""
    lengths = derivative[:, -3:] if derivative.shape[1] > 1 else derivative
    moves = np.sqrt((lengths**2).sum(1).mean(0))
    turns = np.sqrt((derivative[:, :3] ** 2).sum(1).mean(0)) if derivative.shape[1] == 6 else np.zeros(len(moves))
    moves = np.where(moves > 1e-9, moves, turns)  # the tool's orientation moves no point
    return np.where(moves > 1e-9, 1 / np.maximum(moves, 1e-9), 1.0)


def _cost(found: np.ndarray, seen: Observed, weighting: Weighting, limit: float) -> float:
    return float(huber_cost(np.linalg.norm(weighting.whiten(found, seen), axis=1), limit).sum())
