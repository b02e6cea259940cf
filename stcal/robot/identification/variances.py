"""Variance components of an identification, and a covariance of the parameters that allows for their uncertainty.

Components are the σ of the measurements and of the robot's dimensions about nominal. About the solution everything is
linear, so that for any σ the parameters and the likelihood of the σ (restricted maximum likelihood, Patterson &
Thompson 1971) are closed forms of a few k × k matrices. The covariance of the parameters is the mean, over the
posterior of the σ, of their covariance at these σ and of the square of their shift (Kass & Steffey 1989), by
Gauss-Hermite quadrature about the maximum. It exceeds the covariance with σ taken as known as a t distribution exceeds
a normal one.
"""

from dataclasses import astuple, dataclass, replace
from itertools import compress

import numpy as np
from scipy.special import chdtr, chdtrc

from stcal.adjust.components import Components, Equations
from stcal.robot.identification.adjustment import (
    USELESS_MM,
    WIDTH,
    Bent,
    Kind,
    Observed,
    Solution,
    Weighting,
    curvature_of,
    huber_limit,
    jacobian,
)
from stcal.robot.identification.prior import ACROSS, AXIS, DOUBT, MOMENT, Deviations, NominalRows

LEAST = 1e-9
"""Smallest σ, in mm or rad: that of data without noise."""
FARTHEST = 3.0
"""Largest change of log σ in a round, a factor of 20; beyond it rounding spoils the squares."""
NEAREST = 0.7
"""The same for σ of compliances, a factor of two: their products with moments are nonlinear, so that farther away the
tangent is wrong, and may call a wrong value best."""
QUIETER = -2.5
"""Second start of the search for log σ of the data: few data may be explained by noise alone, or by dimensions."""
GROSS = 0.5
"""Weight below which an observation is a gross error, not noise (normal errors are never so large), and does not count
for σ."""
NODES, NODE_WEIGHTS = np.sqrt(3.0) * np.array([0.0, -1.0, 1.0]), np.array([4.0, 1.0, 1.0]) / 6
"""Points and weights of three-point Gauss-Hermite quadrature for a standard normal distribution."""
MOST_PRODUCT = 5
"""Largest number of dimensions for the product rule: 243 points; rigid arms have no more."""
SHORTEST = 0.1
"""Smallest share of a step of the σ: two steps that lead back and forth by chance must not stop the iteration."""
STEP = 1e-4
"""Step of the second derivatives, in log σ."""


@dataclass(frozen=True, slots=True, eq=False)
class Spread:
    """Components of an adjustment, linear about its solution, in ``units`` (k,) of its parameters. Those of the data
    come first, then the groups of the robot's dimensions. ``least``, ``most`` : (p,) limits of log (σ / present σ)."""

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
        least = np.full(len(free), np.min(self.parts.doubt, initial=1.0) ** -2.0)
        values = np.maximum(values, least)
        root = np.zeros((len(best), len(free)))
        root[free] = directions / np.sqrt(values)
        return root


def _rule(width: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns points (m, width) and weights (m,) for a standard normal distribution: the product rule, or in many
    dimensions the cubature of degree three (Arasaratnam & Haykin 2009)."""
    if width > MOST_PRODUCT:
        away = np.sqrt(width) * np.eye(width)
        return np.vstack([away, -away]), np.full(2 * width, 0.5 / width)
    index = np.indices((len(NODES),) * width).reshape(width, len(NODES) ** width).T
    return NODES[index], NODE_WEIGHTS[index].prod(1)


def components(
    solution: Solution,
    measured: Observed,
    weighting: Weighting,
    robust: bool,
    rows: NominalRows,
    deviations: Deviations,
) -> Spread:
    """Returns the parts of an adjustment: those of the data whose σ is estimated, then groups of dimensions."""
    units = solution.units
    white = weighting.whiten(solution.residuals, measured)
    derivative = weighting.whiten(jacobian(solution.state, measured), measured) * units
    huber_share = _kept(measured.kind) if robust else 1.0
    honest = solution.weights >= GROSS
    honest |= honest.mean() < 0.5
    # σ scales the square of the residual cut off at Huber's limit, (w e)²; the rest of w e² does not depend on σ.
    weight = solution.weights[:, None, None]
    scaled = weight**2 * honest[:, None, None]
    nothing = Equations.nothing(len(units))
    parts, fixed = [], replace(nothing, normal=np.eye(len(units)) / USELESS_MM**2)
    for name, columns in weighting.columns(white.shape[1]).items():
        if name in weighting.estimated:
            equations = _linear(white, derivative, columns, scaled)
            equations = replace(equations, count=huber_share * white[honest, columns].size)
            parts.append((equations, 0.0, np.inf, max(np.log(LEAST / weighting.value(name)), -FARTHEST), FARTHEST))
            fixed = fixed + _linear(white, derivative, columns, weight - scaled)
        else:
            fixed = fixed + _linear(white, derivative, columns, weight)
    held, group = rows.held(solution.state, deviations, measured.kind), rows.groups
    e, j = held.value / held.sigma, held.jacobian * units / held.sigma[:, None]
    fixed = fixed + Equations.of(e[group >= MOMENT], j[group >= MOMENT])
    for g, (sigma, expected) in enumerate(zip(astuple(deviations), astuple(Deviations()), strict=True)):
        in_group = group == g
        if in_group.any():
            far = NEAREST if g in (AXIS, ACROSS) else FARTHEST
            parts.append((Equations.of(e[in_group], j[in_group]), np.log(expected / sigma), DOUBT, -far, far))
    each, *numbers = zip(*parts, strict=True)
    expected, doubt, least, most = (np.array(values, float) for values in numbers)
    curved = curvature_of(solution, measured, weighting)
    if curved is not None:
        # At the minimum the data pull as much as held and fixed parts hold; this changes with the σ of these parts.
        held = np.isfinite(doubt)
        holding = fixed.normal + sum(own.normal for own in compress(each, held))
        bends = Bent.of(holding, curved * units[:, None] * units).bends()
        each = [_bent(own, bends) if holds else own for own, holds in zip(each, held, strict=True)]
        fixed = _bent(fixed, bends)
    return Spread(Components(each, fixed, expected, doubt), least, most, units)


def _bent(equations: Equations, bends: np.ndarray) -> Equations:
    """Returns equations with BᵀNB in place of their normal matrix N."""
    return replace(equations, normal=bends.T @ equations.normal @ bends)


def _linear(white: np.ndarray, derivative: np.ndarray, columns: slice, weight: np.ndarray) -> Equations:
    """Returns the equations of the residuals e - J δ of some coordinates, with weights (r, 1, 1)."""
    root = np.sqrt(weight)
    return Equations.of(
        (root[:, :, 0] * white[:, columns]).ravel(), -(root * derivative[:, columns]).reshape(-1, derivative.shape[2])
    )


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


def estimated(
    change: np.ndarray, rows: NominalRows, weighting: Weighting, deviations: Deviations
) -> tuple[Weighting, Deviations]:
    """Returns σ of the measurements and of the dimensions, after a ``change`` (p,) of their logarithms."""
    names = [name for name in ("factor", "rad", "mm") if name in weighting.estimated]
    new = {name: weighting.value(name) * np.exp(x) for name, x in zip(names, change, strict=False)}
    sigma = np.array(astuple(deviations))
    sigma[np.intersect1d(rows.groups, np.arange(len(sigma)))] *= np.exp(change[len(names) :])
    return weighting.with_values(new), Deviations(*sigma.tolist())


def _kept(kind: Kind) -> float:
    """Returns the share of the square of normal residuals below Huber's limit (Huber's Proposal 2)."""
    width, limit = WIDTH[kind], huber_limit(kind) ** 2
    return float(chdtr(width + 2, limit) + limit / width * chdtrc(width, limit))
