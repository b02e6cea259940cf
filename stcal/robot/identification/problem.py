"""The identification of an arm as one problem: least squares, what the data determine, and the σ of data and robot.

Components are the σ of the measurements and of the robot's dimensions about nominal. About the solution everything is
linear, so that for any σ the parameters and the likelihood of the σ (restricted maximum likelihood, Patterson &
Thompson 1971) are closed forms of a few k × k matrices. The covariance of the parameters is the mean, over the
posterior of the σ, of their covariance at these σ and of the square of their shift (Kass & Steffey 1989), by
Gauss-Hermite quadrature about the maximum. It exceeds the covariance with σ taken as known as a t distribution exceeds
a normal one.
"""

from dataclasses import astuple, dataclass, field, replace
from functools import partial
from itertools import compress

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import chdtr, chdtrc

from stcal.adjust.blocks import Components, Equations
from stcal.geometry.clusters import by_clusters
from stcal.geometry.least_squares import Minimum, NormalEquations, minimise
from stcal.geometry.normal_equations import blocks_of
from stcal.geometry.robust import huber_cost, huber_weights, length_limit
from stcal.robot.identification.adjustment import (
    FIELDS,
    UNSEEN,
    WIDTH,
    Kind,
    Observed,
    State,
    Weighting,
    curvature,
    jacobian,
    linear,
    moved,
    parameter_names,
    parameter_units,
    residuals,
)
from stcal.robot.identification.prior import ACROSS, AXIS, DOUBT, MOMENT, Deviations, NominalRows

MAX_STEPS = 100
SETTLED = 1e-10
"""Relative decrease of the cost below which the descent has converged."""
HUBER_LEVEL = 0.999
"""Probability that an observation without a gross error has full weight; one in a thousand has less."""
USELESS_MM = 50.0
"""Largest σ of a determined direction (1 mm, or the rotation that moves the tool by 1 mm). Beyond it the nominal value
is better. All parameters are held to their start by this σ, which determined directions do not feel."""
ACCEPTED, ACCEPTED_ELASTIC = 1e-4, 0.05
"""Largest predicted decrease of the cost, in σ², accepted after the last step, for rigid and elastic arms."""
MOST_BENT = 2 / 3
"""Largest share of the curvature that second derivatives may take away: flatter valleys have two minima."""
ROUNDING = 1e-13
"""Relative error by rounding in the square root of a normal matrix with unit diagonal and some hundred parameters."""
NEAR, NEAR_STEPS = 1.0, 50
"""Largest predicted decrease of a step, in σ², for which second derivatives are good, and largest number of steps
without them before: used from afar they may lead to a compliance and a moment that both have the wrong sign."""
STAYS_MM = 1e-3
"""σ, in mm, that fixes a movement which the observations never show."""
LEAST_GAIN, LEAST_ELASTIC = 1e-9, 1e-3
"""Decrease of the cost, in σ², below which a descent ends, for rigid and for elastic arms. Measurements without noise
still gain the first by rounding; the second moves no parameter by more than 0.03 σ."""
LEAST = 1e-9
"""Smallest σ, in mm or rad: that of data without noise."""
FARTHEST, NEAREST = 3.0, 0.7
"""Largest change of log σ in a round; the second of compliances, whose products with moments are nonlinear."""
QUIETER = -2.5
"""Second start of the search for log σ of the data: few data may be explained by noise alone, or by dimensions."""
GROSS = 0.5
"""Weight below which an observation is a gross error, and does not count for σ: normal errors are never so large."""
MOSTLY_GOOD = 0.5
"""Smallest share of good observations; where fewer would be good, nothing is called an error."""
NODES, NODE_WEIGHTS = np.sqrt(3.0) * np.array([0.0, -1.0, 1.0]), np.array([4.0, 1.0, 1.0]) / 6
"""Points and weights of three-point Gauss-Hermite quadrature for a standard normal distribution."""
MOST_PRODUCT = 5
"""Largest number of dimensions for the product rule: 243 points; rigid arms have no more."""
SHORTEST = 0.1
"""Smallest share of a step of the σ: two steps that lead back and forth by chance must not stop the iteration."""
STEP = 1e-4
"""Step of the second derivatives, in log σ."""
SAME_DIGITS = 5
"""Decimals, of rad or mm, to which joint values agree that are one place of the robot."""

Away = tuple[State, np.ndarray]
"""A state, and the sum of the steps (k,) that led to it."""


def huber_limit(kind: Kind) -> float:
    """Returns the length of an observation's whitened residual beyond which it weighs less."""
    return length_limit(WIDTH[kind], 1 - HUBER_LEVEL)


def mostly(good: np.ndarray) -> np.ndarray:
    """Returns the mask (r,) of good rows; all rows, where it holds too few."""
    return good | (good.mean() < MOSTLY_GOOD)


@dataclass(frozen=True, slots=True, eq=False)
class ArmProblem:
    """Observations of an arm with their σ, and what is known of the arm before.

    ``rows`` : its nominal dimensions, which it has to within ``deviations``; None if nothing is known; ``robust`` :
    whether outliers weigh less (Huber). Parameters are small motions about a state, so that none is singular.
    """

    measured: Observed
    weighting: Weighting
    robust: bool = True
    rows: NominalRows | None = None
    deviations: Deviations = field(default_factory=Deviations)

    @property
    def limit(self) -> float:
        """Length of an observation's whitened residual beyond which it weighs less."""
        return huber_limit(self.measured.kind) if self.robust else np.inf

    def of(self, good: np.ndarray) -> "ArmProblem":
        """Returns the problem of the rows of a mask (r,) alone."""
        return self if good.all() else replace(self, measured=self.measured[good])

    def scaled(self, change: np.ndarray) -> "ArmProblem":
        """Returns the problem after a ``change`` (p,) of the logarithms of its σ: of measurements, then dimensions."""
        assert self.rows is not None
        names = [name for name in FIELDS if name in self.weighting.estimated]
        new = {name: self.weighting.value(name) * np.exp(x) for name, x in zip(names, change, strict=False)}
        sigma = np.array(astuple(self.deviations))
        sigma[np.intersect1d(self.rows.groups, np.arange(len(sigma)))] *= np.exp(change[len(names) :])
        return replace(self, weighting=self.weighting.with_values(new), deviations=Deviations(*sigma.tolist()))

    def at(self, state: State) -> "ArmSolution":
        """Returns the observations alone, linearised about a state."""
        errors, derivative = linear(state, self.measured)
        units = parameter_units(derivative)
        white, whitened = (self.weighting.whiten(each, self.measured) for each in (errors, derivative))
        length = np.linalg.norm(white, axis=1)
        weights = huber_weights(length, self.limit)
        flat = whitened.reshape(-1, whitened.shape[2])
        weighted = flat * np.repeat(weights, white.shape[1])[:, None]
        cost, normal = float(huber_cost(length, self.limit).sum()), weighted.T @ flat
        gradient, zero = -weighted.T @ white.ravel(), np.zeros_like(normal)
        return ArmSolution(self, state, errors, weights, normal, gradient, units, cost, zero, zero)

    def solve(self, state: State) -> "ArmSolution":
        """Returns the state of least cost, from a start about which priors are linear; raises ConvergenceError."""
        measured, first = self.measured, self.at(state)
        held_normal, pull = np.zeros_like(first.normal), np.zeros(len(first.units))
        conditions, count = np.zeros_like(first.normal), 0
        if self.rows is not None:
            held = self.rows.held(state, self.deviations, measured.kind)
            weighted = held.jacobian.T / held.sigma**2
            held_normal, pull = weighted @ held.jacobian, weighted @ held.value  # half the gradient of the squares
            fixed = held.jacobian[held.fixed] / held.sigma[held.fixed, None]
            conditions, count = fixed.T @ fixed, len(fixed)
        _, directions, determined = replace(first, conditions=conditions).spectrum()
        prior = held_normal + first.fixed(directions[:, : UNSEEN[measured.kind]])
        hold = held_normal + first.fixed(directions[:, ~determined])  # along undetermined ones valleys bend, lead far

        def kept(away: np.ndarray) -> NormalEquations:
            return NormalEquations(float(away @ (hold @ away + 2 * pull)), hold, hold @ away + pull)

        def linearise(at: Away, bends: bool) -> NormalEquations:
            fit = self.at(at[0])
            straight = NormalEquations(fit.cost, fit.normal, fit.gradient) + kept(at[1])
            curved = fit.curvature() if bends else None
            if curved is None:
                return straight
            return replace(straight, normal=straight.normal - Bent.of(straight.normal, curved).taken())

        def cost(at: Away) -> float:
            white = self.weighting.whiten(residuals(at[0], measured), measured)
            return float(huber_cost(np.linalg.norm(white, axis=1), self.limit).sum() + kept(at[1]).cost)

        def descended(begin: Away, bends: bool, least_gain: float, max_steps: int) -> Minimum[Away, NormalEquations]:
            return minimise(
                begin,
                partial(linearise, bends=bends),
                lambda at, step: (moved(at[0], step, measured.kind), at[1] + step),
                cost=cost,
                settled=SETTLED,
                least_gain=least_gain,
                max_steps=max_steps,
            )

        begin = state, np.zeros(len(hold))
        if state.elastic:
            near = descended(begin, False, NEAR, NEAR_STEPS).state
            fit, accepted = descended(near, True, LEAST_ELASTIC, MAX_STEPS), ACCEPTED_ELASTIC
        else:
            fit, accepted = descended(begin, False, LEAST_GAIN, MAX_STEPS), ACCEPTED
        fit.required(f"{measured.data.where}: identification", "check the robot file and the outliers", accepted)
        return replace(self.at(fit.state[0]), prior=prior, conditions=conditions, count=count)


@dataclass(frozen=True, slots=True, eq=False)
class ArmSolution:
    """A problem linearised about a state.

    ``residuals`` : (r, w) rad, mm; ``weights`` : (r,) Huber weights; ``normal``, ``gradient`` : (k, k) normal matrix of
    the observations alone, whitened and weighted, and half the gradient (k,) of their ``cost``; ``units`` : (k,)
    factors that make each parameter a movement of the tool of about 1 mm; ``prior``, ``conditions`` : (k, k) normal
    matrices of the prior knowledge, and of the ``count`` conditions in it; ``spread`` : the σ about the solution, where
    they were estimated; ``notes`` : on iterations that did not converge.
    """

    problem: ArmProblem
    state: State
    residuals: np.ndarray
    weights: np.ndarray
    normal: np.ndarray
    gradient: np.ndarray
    units: np.ndarray
    cost: float
    prior: np.ndarray
    conditions: np.ndarray
    count: int = 0
    spread: "Spread | None" = None
    notes: tuple[str, ...] = ()

    def spectrum(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns eigenvalues (j,), directions (j, j) in columns, and a mask of determined ones, without elasticity."""
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

    def seeks(self) -> int:
        """Returns the number of parameters that observations of this kind could determine, without conditions."""
        kind = self.problem.measured.kind
        return len(parameter_names(self.state, kind)) - UNSEEN[kind] - self.count

    def fixed(self, directions: np.ndarray) -> np.ndarray:
        """Returns the normal matrix that holds parameters at their start, firmly along ``directions`` (j, d)."""
        padded = np.pad(directions, ((0, self.state.elastic_count), (0, 0)))
        fixed = np.eye(len(padded)) / USELESS_MM**2 + padded @ padded.T / STAYS_MM**2
        return fixed / self.units[:, None] / self.units

    def among(self, measured: Observed) -> "ArmSolution":
        """Returns the solution beside all observations, of which those of the problem are a part."""
        problem = replace(self.problem, measured=measured)
        errors = residuals(self.state, measured)
        length = np.linalg.norm(problem.weighting.whiten(errors, measured), axis=1)
        weights = huber_weights(length, huber_limit(measured.kind))
        return replace(self, problem=problem, residuals=errors, weights=weights)

    def curvature(self) -> np.ndarray | None:
        """Returns what second derivatives take from the normal matrix (k, k); None for rigid arms and distances."""
        state, measured, weighting = self.state, self.problem.measured, self.problem.weighting
        if not state.elastic or measured.kind == "distance":
            return None
        white = self.weights[:, None] * weighting.whiten(self.residuals, measured)
        elastic = curvature(state, measured, weighting.pull(white, measured))
        k, count = len(self.units), state.elastic_count
        taken = np.zeros((k, k))
        place = slice(k - count, k - count + len(elastic))
        taken[place, place] = elastic
        return taken

    def estimated(self) -> "Spread":
        """Returns what tells the σ, linear about the solution: of the data where σ is sought, then of dimensions."""
        problem, measured, weighting, rows = self.problem, self.problem.measured, self.problem.weighting, self.rows
        units = self.units
        white = weighting.whiten(self.residuals, measured)
        derivative = weighting.whiten(jacobian(self.state, measured), measured) * units
        huber_share = _kept(measured.kind) if problem.robust else 1.0
        honest = mostly(self.weights >= GROSS)
        # σ scales the square of the residual cut off at Huber's limit, (w e)²; the rest of w e² does not depend on σ.
        weight = self.weights[:, None, None]
        scaled = weight**2 * honest[:, None, None]
        parts, fixed = [], replace(Equations.nothing(len(units)), normal=np.eye(len(units)) / USELESS_MM**2)
        for name, columns in weighting.columns(white.shape[1]).items():
            if name in weighting.estimated:
                equations = _linear(white, derivative, columns, scaled)
                equations = replace(equations, count=huber_share * white[honest, columns].size)
                parts.append((equations, 0.0, np.inf, max(np.log(LEAST / weighting.value(name)), -FARTHEST), FARTHEST))
                fixed = fixed + _linear(white, derivative, columns, weight - scaled)
            else:
                fixed = fixed + _linear(white, derivative, columns, weight)
        held, group = rows.held(self.state, problem.deviations, measured.kind), rows.groups
        e, j = held.value / held.sigma, held.jacobian * units / held.sigma[:, None]
        fixed = fixed + Equations.of(e[group >= MOMENT], j[group >= MOMENT])
        for g, (sigma, expected) in enumerate(zip(astuple(problem.deviations), astuple(Deviations()), strict=True)):
            in_group = group == g
            if in_group.any():
                far = NEAREST if g in (AXIS, ACROSS) else FARTHEST
                parts.append((Equations.of(e[in_group], j[in_group]), np.log(expected / sigma), DOUBT, -far, far))
        each, *numbers = zip(*parts, strict=True)
        expected, doubt, least, most = (np.array(values, float) for values in numbers)
        curved = self.curvature()
        if curved is not None:
            # At the minimum the data pull as much as held and fixed parts hold; this changes with the σ of these parts.
            holds = np.isfinite(doubt)
            holding = fixed.normal + sum(own.normal for own in compress(each, holds))
            bends = Bent.of(holding, curved * units[:, None] * units).bends()
            each = [_bent(own, bends) if hold else own for own, hold in zip(each, holds, strict=True)]
            fixed = _bent(fixed, bends)
        return Spread(Components(each, fixed, expected, doubt), least, most, units)

    @property
    def rows(self) -> NominalRows:
        """The nominal dimensions."""
        assert self.problem.rows is not None
        return self.problem.rows

    def covariance(self) -> np.ndarray:
        """Returns the covariance (k, k) of the parameters; 0 along the directions that distances never show."""
        assert self.spread is not None
        covariance = self.spread.covariance(np.zeros(len(self.spread.least)))
        if self.problem.measured.kind != "distance":
            return self._by_places(covariance)
        blind = self.spectrum()[1][:, : UNSEEN["distance"]]
        blind = np.pad(blind, ((0, len(self.units) - len(blind)), (0, 0)))
        projector = (np.eye(len(self.units)) - blind @ blind.T) * self.units[:, None] / self.units
        return projector @ covariance @ projector.T

    def places(self) -> np.ndarray | None:
        """Returns the number (r,) of the joint values of each row; None if none are repeated, and for distances."""
        rows = np.round(self.problem.measured.data.q, SAME_DIGITS)
        first, place = np.unique(rows, axis=0, return_inverse=True)
        return None if self.problem.measured.kind == "distance" or len(first) == len(rows) else place.ravel()

    def _by_places(self, covariance: np.ndarray) -> np.ndarray:
        """Returns the covariance where at repeated joint values the model errs once, not several times."""
        place = self.places()
        if place is None:
            return covariance
        measured, whiten = self.problem.measured, self.problem.weighting.whiten
        sigma, root = np.sqrt(np.diag(covariance)), np.sqrt(self.weights)[:, None]
        slope = root[..., None] * whiten(jacobian(self.state, measured), measured) * sigma
        information, pull = blocks_of(slope, root * whiten(self.residuals, measured), place, place.max() + 1)
        clusters = by_clusters(np.linalg.inv(covariance / sigma[:, None] / sigma), pull, information)
        return covariance + (clusters.covariance - clusters.independent) * sigma[:, None] * sigma


@dataclass(frozen=True, slots=True, eq=False)
class Bent:
    """Shares, at most :data:`MOST_BENT`, of a normal matrix (k, k) with this ``root`` that second derivatives take
    away: ``share`` : (k,) of each of ``directions`` (k, k), columns that are independent in the matrix's metric."""

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


def _bent(equations: Equations, bends: np.ndarray) -> Equations:
    """Returns equations with BᵀNB in place of their normal matrix N."""
    return replace(equations, normal=bends.T @ equations.normal @ bends)


def _linear(white: np.ndarray, derivative: np.ndarray, columns: slice, weight: np.ndarray) -> Equations:
    """Returns the equations of the residuals e - J δ of some coordinates, with weights (r, 1, 1)."""
    root = np.sqrt(weight)
    return Equations.of(
        (root[:, :, 0] * white[:, columns]).ravel(), -(root * derivative[:, columns]).reshape(-1, derivative.shape[2])
    )


def _kept(kind: Kind) -> float:
    """Returns the share of the square of normal residuals below Huber's limit (Huber's Proposal 2)."""
    width, limit = WIDTH[kind], huber_limit(kind) ** 2
    return float(chdtr(width + 2, limit) + limit / width * chdtrc(width, limit))


@dataclass(frozen=True, slots=True, eq=False)
class Spread:
    """Components of a solution, linear about it, in ``units`` (k,) of its parameters. Those of the data come first,
    then the groups of the robot's dimensions. ``least``, ``most`` : (p,) limits of log (σ / present σ)."""

    parts: Components
    least: np.ndarray
    most: np.ndarray
    units: np.ndarray

    def best(self) -> np.ndarray:
        """Returns log (σ / present σ) (p,) of highest posterior density."""
        data = np.isinf(self.parts.doubt)
        starts = (np.zeros(len(data)), np.where(data, QUIETER, self.parts.expected))
        return self.parts.best(self.least, self.most, starts)

    def covariance(self, best: np.ndarray) -> np.ndarray:
        """Returns the covariance (k, k) of the parameters about the estimate at ``best`` (p,)."""
        root = self._root(best)
        z, rule = _rule(root.shape[1])
        log_density, _, step, inverse = map(np.array, zip(*map(self.parts.at, best + z @ root.T), strict=True))
        middle = self.parts.at(best)
        log_weight = np.log(rule) + log_density - middle[0] + 0.5 * (z**2).sum(1)
        weight = np.exp(log_weight - log_weight.max())
        weight /= weight.sum()
        shift = step - middle[2]
        mean = np.einsum("m,mkl->kl", weight, inverse) + (shift.T * weight) @ shift
        return mean * self.units[:, None] * self.units

    def _root(self, best: np.ndarray) -> np.ndarray:
        """Returns a square root (p, f) of the covariance of log σ, for the f components above their lower limit."""
        free = np.flatnonzero(best > self.least + STEP)
        moves = STEP * np.eye(len(best))[free]
        points = np.concatenate([best + moves, best - moves])
        gradient = np.array([self.parts.at(x)[1] for x in points]).reshape(points.shape)
        hessian = (gradient[: len(free)] - gradient[len(free) :])[:, free] / (2 * STEP)
        values, directions = np.linalg.eigh(-(hessian + hessian.T) / 2)
        # a flat or rising direction is at most as wide as the prior
        values = np.maximum(values, np.min(self.parts.doubt, initial=1.0) ** -2.0)
        root = np.zeros((len(best), len(free)))
        root[free] = directions / np.sqrt(values)
        return root


def _rule(width: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns points (m, width) and weights (m,) of a product rule, or a cubature (Arasaratnam & Haykin 2009)."""
    if width > MOST_PRODUCT:
        away = np.sqrt(width) * np.eye(width)
        return np.vstack([away, -away]), np.full(2 * width, 0.5 / width)
    index = np.indices((len(NODES),) * width).reshape(width, len(NODES) ** width).T
    return NODES[index], NODE_WEIGHTS[index].prod(1)


class Relaxation:
    """Shares to take of the steps of an iteration that may overshoot, by how the last two steps agree (Aitken's Δ² of
    vectors, Irons & Tuck, Int. J. Numerical Methods in Engineering 1, 1969)."""

    def __init__(self) -> None:
        self._share, self._last = 1.0, None

    def step(self, wanted: np.ndarray) -> np.ndarray:
        """Returns the part of a ``wanted`` step (p,) to take."""
        if self._last is not None:
            turned = wanted - self._last
            falls = -float(self._last @ turned)  # if this is not positive, there is no sign of overshooting
            share = self._share * falls / max(float(turned @ turned), 1e-300) if falls > 0 else 1.0
            self._share = float(np.clip(share, SHORTEST, 1.0))
        self._last = wanted
        return self._share * wanted
