"""Robust least squares over the minimal parameters of a robot; it separates determined from undetermined directions."""

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
"""Relative decrease of the cost below which the descent has converged."""
HUBER_LEVEL = 0.999
"""Probability that an observation without a gross error has full weight; one in a thousand has less."""
USELESS_MM = 50.0
"""Largest σ of a determined direction (1 mm, or the rotation that moves the tool by 1 mm). Beyond it the nominal value
is better. All parameters are held to their start by this σ, which determined directions do not feel."""
ACCEPTED = 1e-4
"""Largest predicted decrease of the cost, in σ², that is accepted when a descent has used up its steps. Along a flat
direction Huber weights halve every step, so that steps are many and short."""
ACCEPTED_ELASTIC = 0.05
"""The same for elastic arms, whose valleys are curved: 0.2 σ of a hardly determined parameter."""
MOST_BENT = 2 / 3
"""Largest share of the curvature along a direction that second derivatives may take away; variances become three times
as large. Flatter valleys have two minima, and the curvature at one minimum does not describe the other."""
ROUNDING = 1e-13
"""Relative error by rounding in the square root of a normal matrix with unit diagonal and some hundred parameters."""
NEAR, NEAR_STEPS = 1.0, 50
"""Largest predicted decrease of a step, in σ², for which second derivatives are good, and largest number of steps
without them before. Second derivatives used from afar may lead to a state where compliance and moment both have the
wrong sign. Steps without them are many along curved valleys, and need not converge."""
STAYS_MM = 1e-3
"""σ, in mm, that fixes a movement which the observations never show."""
LEAST_GAIN, LEAST_ELASTIC = 1e-9, 1e-3
"""Decrease of the cost, in σ², below which a descent ends, for rigid and for elastic arms. Measurements without noise
still gain the first by rounding. The second moves no parameter by more than 0.03 σ: it is not worth a step along the
curved valleys of products of compliance and moment."""


@dataclass(frozen=True, slots=True)
class Weighting:
    """Weights of the observations: ``sigma_mm``, ``sigma_rad`` : σ of one coordinate; ``given`` : the covariances that
    came with the measurements replace both; ``factor`` : multiplies either; ``estimated`` : which of ``"mm"``,
    ``"rad"``, ``"factor"`` are estimated from the residuals."""

    sigma_mm: float
    sigma_rad: float
    given: bool = False
    factor: float = 1.0
    estimated: tuple[str, ...] = ()

    def whiten(self, values: np.ndarray, measured: Observed) -> np.ndarray:
        """Returns residuals (r, w) or derivatives (r, w, k) of ``measured`` in units of σ."""
        flat = values.ndim == 2
        values = values[..., None] if flat else values
        width = values.shape[1]
        if self.given and width > 1:
            root = self._root(measured, width)
            values = _decorrelated(np.linalg.solve(root, values), root, measured)
        else:
            values = values / self._sigma(width)[:, None]
        return values[..., 0] if flat else values

    def pull(self, white: np.ndarray, measured: Observed) -> np.ndarray:
        """Returns half the derivative (r, w) by the residuals of the sum of squares of ``white`` (r, w), the output of
        :meth:`whiten`."""
        width = white.shape[1]
        if not (self.given and width > 1):
            return white / self._sigma(width)
        root = self._root(measured, width)
        white = _decorrelated(white[..., None], root, measured)
        return np.linalg.solve(np.swapaxes(root, 1, 2), white)[..., 0]

    def _sigma(self, width: int) -> np.ndarray:
        """Returns σ (width,) of the coordinates."""
        return self.factor * np.array([self.sigma_rad] * 3 + [self.sigma_mm] * 3)[-width:]

    def _root(self, measured: Observed, width: int) -> np.ndarray:
        """Returns the roots (r, width, width) of the covariances that came with the measurements, times ``factor``."""
        return self.factor * np.linalg.cholesky(measured.data.own_covariance()[:, -width:, -width:])

    def columns(self, width: int) -> dict[str, slice]:
        """Returns the columns among the ``width`` coordinates to which each σ belongs."""
        if "factor" in self.estimated:
            return {"factor": slice(None)}
        return {"rad": slice(0, 3), "mm": slice(3, 6)} if width == 6 else {"mm": slice(None)}

    def value(self, name: str) -> float:
        """Returns the value of σ ``name``."""
        return {"mm": self.sigma_mm, "rad": self.sigma_rad, "factor": self.factor}[name]

    def with_values(self, found: Mapping[str, float]) -> "Weighting":
        """Returns the weighting with the σ ``found`` in place of its own."""
        new = {name: found.get(name, self.value(name)) for name in ("mm", "rad", "factor")}
        return replace(self, sigma_mm=new["mm"], sigma_rad=new["rad"], factor=new["factor"])


def _decorrelated(values: np.ndarray, root: np.ndarray, measured: Observed) -> np.ndarray:
    """Whitens values (r, w, k) for the errors that the observations have in common.

    All values have σ 1 apart from these errors. They are multiplied by the inverse root of their covariance 1 + F Fᵀ,
    where F is the common errors over ``root`` (r, w, w), rows stacked. What all observations may have in common counts
    less.
    """
    if measured.data.common is None:
        return values
    common = np.linalg.solve(root, measured.data.common[:, -root.shape[1] :])
    f = common.reshape(-1, common.shape[2])
    size, directions = np.linalg.eigh(f.T @ f)
    size, directions = size[size > 0], directions[:, size > 0]
    u = f @ directions / np.sqrt(size)
    flat = values.reshape(len(f), -1)
    return (flat - u * (1 - 1 / np.sqrt(1 + size)) @ (u.T @ flat)).reshape(values.shape)


@dataclass(frozen=True, slots=True, eq=False)
class Held:
    """Prior knowledge, linear about a state: ``value + jacobian @ step``, (p,), is 0 with σ ``sigma``. ``fixed`` : (p,)
    mask of those that are conditions, with a negligible σ."""

    value: np.ndarray
    jacobian: np.ndarray
    sigma: np.ndarray
    fixed: np.ndarray

    def conditions(self) -> np.ndarray:
        """Returns the normal matrix (k, k) of the conditions alone."""
        own = self.jacobian[self.fixed] / self.sigma[self.fixed, None]
        return own.T @ own

    def normal(self) -> np.ndarray:
        """Returns the normal matrix (k, k)."""
        return (self.jacobian.T / self.sigma**2) @ self.jacobian

    def pull(self) -> np.ndarray:
        """Returns half the gradient (k,) of the sum of squares."""
        return (self.jacobian.T / self.sigma**2) @ self.value


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """An adjusted state with its normal equations. ``residuals`` : (r, w) rad, mm; ``weights`` : (r,) Huber weights;
    ``normal`` : (k, k) normal matrix of the observations alone, whitened and weighted; ``units`` : (k,) factors that
    make each parameter a movement of the tool of about 1 mm; ``cost`` : Huber cost; ``prior`` : (k, k) normal matrix of
    the prior knowledge; ``conditions`` : (k, k) normal matrix of the conditions; ``count`` : number of conditions."""

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
        """Returns the spectrum of the normal matrix with conditions, over the j parameters of axes and tools.

        These are eigenvalues (j,), directions (j, j) in columns, and a mask (j,) of the directions that the data or
        conditions determine. Elasticity is left out, as there is prior knowledge of it.
        """
        rigid = slice(len(self.units) - self.state.elastic_count)
        known = self.normal[rigid, rigid] + self.conditions[rigid, rigid]
        values, directions = np.linalg.eigh(known * self.units[rigid, None] * self.units[rigid])
        return values, directions, values > 1 / USELESS_MM**2

    def rank(self) -> int:
        """Returns the number of directions that the data determine."""
        return int(self.spectrum()[2].sum()) - self.count

    def inverse(self) -> np.ndarray:
        """Returns the covariance (k, k) of the parameters at unit weight."""
        scaled = (self.normal + self.prior) * self.units[:, None] * self.units
        return np.linalg.inv(scaled) * self.units[:, None] * self.units


def solve(
    state: State, measured: Observed, weighting: Weighting, robust: bool = True, held: Held | None = None
) -> Solution:
    """Minimises the whitened residuals of the observations, from ``state``; ``held`` is linear about it.

    Parameters are small motions about the present state, so that no representation is ever singular.

    Raises
    ------
    ConvergenceError
        No minimum is reached.
    """
    limit = huber_limit(measured.kind) if robust else np.inf
    first = _linearised(state, measured, weighting, limit)[0]
    held_normal, pull = np.zeros_like(first.normal), np.zeros(len(first.units))
    conditions, count = np.zeros_like(first.normal), 0
    if held is not None:
        held_normal, pull = held.normal(), held.pull()
        conditions, count = held.conditions(), int(held.fixed.sum())
    _, directions, determined = replace(first, conditions=conditions).spectrum()
    prior = held_normal + _fixed(first, directions[:, : unseen(measured.kind)])
    hold = held_normal + _fixed(first, directions[:, ~determined])  # along undetermined ones valleys bend, and lead far

    def kept(away: np.ndarray) -> NormalEquations:
        return NormalEquations(float(away @ (hold @ away + 2 * pull)), hold, hold @ away + pull)

    def linearise(at: _Away, bends: bool) -> NormalEquations:
        fit, gradient = _linearised(at.state, measured, weighting, limit)
        straight = NormalEquations(fit.cost, fit.normal, gradient) + kept(at.away)
        curved = curvature_of(fit, measured, weighting) if bends else None
        if curved is None:
            return straight
        return replace(straight, normal=straight.normal - Bent.of(straight.normal, curved).taken())

    def descended(begin: _Away, bends: bool, least_gain: float, max_steps: int) -> Minimum[_Away, NormalEquations]:
        return minimise(
            begin,
            partial(linearise, bends=bends),
            lambda at, step: _Away(moved(at.state, step, measured.kind), at.away + step),
            cost=lambda at: (
                _cost(residuals(at.state, measured), measured, weighting, limit) + float(kept(at.away).cost)
            ),
            settled=SETTLED,
            least_gain=least_gain,
            max_steps=max_steps,
        )

    begin = _Away(state, np.zeros(len(hold)))
    if state.elastic:
        near = descended(begin, False, NEAR, NEAR_STEPS).state
        fit, accepted = descended(near, True, LEAST_ELASTIC, MAX_STEPS), ACCEPTED_ELASTIC
    else:
        fit, accepted = descended(begin, False, LEAST_GAIN, MAX_STEPS), ACCEPTED
    fit.required(f"{measured.data.where}: identification", "check the robot file and the outliers", accepted)
    solution = _linearised(fit.state.state, measured, weighting, limit)[0]
    return replace(solution, prior=prior, conditions=conditions, count=count)


def curvature_of(solution: Solution, measured: Observed, weighting: Weighting) -> np.ndarray | None:
    """Returns the part (k, k) of the normal matrix that the second derivatives by compliance and moment subtract.

    Without it, descents along the curved valleys of products of compliance and moment take hundreds of steps. It is
    None for rigid arms, and for distances, which are nonlinear themselves.
    """
    if not solution.state.elastic or measured.kind == "distance":
        return None
    white = solution.weights[:, None] * weighting.whiten(solution.residuals, measured)
    elastic = curvature(solution.state, measured, weighting.pull(white, measured))
    k, count = len(solution.units), solution.state.elastic_count
    taken = np.zeros((k, k))
    place = slice(k - count, k - count + len(elastic))
    taken[place, place] = elastic
    return taken


@dataclass(frozen=True, slots=True, eq=False)
class Bent:
    """Shares of a normal matrix (k, k) that second derivatives take away, along directions that are independent in its
    metric.

    A share is at most :data:`MOST_BENT`: a saddle is no minimum, but what is left of a flat valley is. ``root`` : (k,
    k) root of the normal matrix; ``directions`` : (k, k) in columns; ``share`` : (k,) of each direction.
    """

    root: np.ndarray
    directions: np.ndarray
    share: np.ndarray

    @classmethod
    def of(cls, normal: np.ndarray, curved: np.ndarray) -> "Bent":
        """Returns the shares for ``curved`` (k, k), all that second derivatives take."""
        scale = np.sqrt(np.diag(normal))
        unit = normal / scale[:, None] / scale + ROUNDING * np.eye(len(scale))
        root = scale[:, None] * np.linalg.cholesky(unit)
        half = solve_triangular(root, curved, lower=True)
        share, directions = np.linalg.eigh(solve_triangular(root, half.T, lower=True))
        return cls(root, directions, np.minimum(share, MOST_BENT))

    def taken(self) -> np.ndarray:
        """Returns what is taken from the normal matrix, (k, k)."""
        along = self.root @ self.directions
        return (along * self.share) @ along.T

    def bends(self) -> np.ndarray:
        """Returns B (k, k): Bᵀ N B is what is left of the normal matrix N."""
        wider = (self.directions * np.sqrt(1 - self.share)) @ self.directions.T
        return solve_triangular(self.root, wider @ self.root.T, lower=True, trans=1)


@dataclass(frozen=True, slots=True, eq=False)
class _Away:
    """A state, and the sum of the steps (k,) that led to it."""

    state: State
    away: np.ndarray


def unseen(kind: Kind) -> int:
    """Returns the number of directions that this kind of observation never shows: those of the instrument's place."""
    return 6 if kind == "distance" else 0


def _fixed(solution: Solution, directions: np.ndarray) -> np.ndarray:
    """Returns the normal matrix (k, k) that holds parameters at their start: weakly, but firmly along ``directions``
    (j, d)."""
    padded = np.pad(directions, ((0, solution.state.elastic_count), (0, 0)))
    fixed = np.eye(len(padded)) / USELESS_MM**2 + padded @ padded.T / STAYS_MM**2
    return fixed / solution.units[:, None] / solution.units


def huber_limit(kind: Kind) -> float:
    """Returns the length of an observation's whitened residual beyond which it weighs less."""
    return length_limit(WIDTH[kind], 1 - HUBER_LEVEL)


def normal_rank(state: State, measured: Observed, weighting: Weighting) -> int:
    """Returns how many parameters these observations determine, at the state where they would be exact."""
    return _linearised(state, measured, weighting, np.inf)[0].rank()


def _linearised(state: State, measured: Observed, weighting: Weighting, limit: float) -> tuple[Solution, np.ndarray]:
    """Returns the state with its normal matrix, and half the gradient (k,) of the cost."""
    errors, derivative = linear(state, measured)
    units = parameter_units(derivative)
    white, whitened = weighting.whiten(errors, measured), weighting.whiten(derivative, measured)
    weights = huber_weights(np.linalg.norm(white, axis=1), limit)
    flat = whitened.reshape(-1, whitened.shape[2])
    weighted = flat * np.repeat(weights, white.shape[1])[:, None]
    cost = float(huber_cost(np.linalg.norm(white, axis=1), limit).sum())
    normal = weighted.T @ flat
    zero = np.zeros_like(normal)
    return Solution(state, errors, weights, normal, units, cost, zero, zero), -weighted.T @ white.ravel()


def parameter_units(derivative: np.ndarray) -> np.ndarray:
    """Returns the step (k,) of each parameter that moves the tool by 1 mm RMS, or by 1 rad if it moves no point; 1 if
    it moves nothing."""
    lengths = derivative[:, -3:] if derivative.shape[1] > 1 else derivative
    moves = np.sqrt((lengths**2).sum(1).mean(0))
    turns = np.sqrt((derivative[:, :3] ** 2).sum(1).mean(0)) if derivative.shape[1] == 6 else np.zeros(len(moves))
    moves = np.where(moves > 1e-9, moves, turns)  # the tool's orientation moves no point
    return np.where(moves > 1e-9, 1 / np.maximum(moves, 1e-9), 1.0)


def _cost(found: np.ndarray, measured: Observed, weighting: Weighting, limit: float) -> float:
    return float(huber_cost(np.linalg.norm(weighting.whiten(found, measured), axis=1), limit).sum())
