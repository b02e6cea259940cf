"""What the nominal D-H rows are worth: dimensions as made differ from the drawing by σ that the data show."""

from dataclasses import astuple, dataclass

import numpy as np

from stcal.robot.adjustment import Held, Solution
from stcal.robot.dh import robot_from_chain
from stcal.robot.model import Robot
from stcal.robot.observe import Kind, State, moved

DIFFERENCE_MM = 1e-4
"""Step of the derivatives by differences, in movement of the tool; the way back to rows has cases."""
LEAST = np.array([1e-3, 1e-6, 1e-6])
FEW = 0.3
"""Least redundancy of a group of dimensions: where the data say nothing, its σ is not moved far."""


@dataclass(frozen=True, slots=True)
class Deviations:
    """σ of a robot's dimensions about nominal: lengths (mm), twists, and zero positions of joints (rad, mm)."""

    length_mm: float = 0.5
    twist_rad: float = 1e-3
    zero_rad: float = 5e-3

    def by_column(self, prismatic: np.ndarray) -> np.ndarray:
        """(n, 5) of a, alpha, d, theta, beta."""
        row = [self.length_mm, self.twist_rad, self.length_mm, self.zero_rad, self.twist_rad]
        sigma = np.tile(row, (len(prismatic), 1))
        sigma[prismatic, 3] = self.twist_rad  # the zero of these is d
        return sigma


def dh_values(robot: Robot) -> np.ndarray:
    """(n, 5) of a, alpha, d, theta, beta."""
    return np.array([[row.a, row.alpha, row.d, row.theta, row.beta] for row in robot.rows], float)


def dh_slope(state: State, units: np.ndarray, kind: Kind, nominal: Robot) -> np.ndarray:
    """Derivative of :func:`dh_values` by the parameters, (n, 5, k)."""

    def values(step: np.ndarray) -> np.ndarray:
        there = moved(state, step, kind)
        return dh_values(robot_from_chain(there.chain, there.tools, nominal))

    columns = []
    for k, unit in enumerate(units):
        step = np.zeros(len(units))
        step[k] = DIFFERENCE_MM * unit
        columns.append((values(step) - values(-step)) / (2 * step[k]))
    return np.stack(columns, axis=-1)


@dataclass(frozen=True, slots=True, eq=False)
class NominalRows:
    """The nominal dimensions as observations of the parameters. ``slope`` : (n, 5, k), ``free`` : (n, 5) the dimensions
    that parameters move at all; both taken once, as they hardly change over what a factory does."""

    nominal: Robot
    slope: np.ndarray
    free: np.ndarray

    @classmethod
    def about(cls, solution: Solution, kind: Kind, nominal: Robot) -> "NominalRows":
        slope = dh_slope(solution.state, solution.units, kind, nominal)
        return cls(nominal, slope, np.abs(slope * solution.units).max(axis=2) > 1e-9)

    def away(self, state: State) -> np.ndarray:
        """(n, 5) dimensions beyond nominal."""
        return dh_values(robot_from_chain(state.chain, state.tools, self.nominal)) - dh_values(self.nominal)

    def held(self, state: State, deviations: Deviations) -> Held:
        """Linear about ``state``."""
        sigma = deviations.by_column(self.nominal.prismatic)
        return Held(self.away(state)[self.free], self.slope[self.free], sigma[self.free])

    def estimated(self, solution: Solution, before: Deviations) -> Deviations:
        """σ from how far the solution is from nominal, and from how much of that is its own (variance components)."""
        away = self.away(solution.state)
        sigma = before.by_column(self.nominal.prismatic)
        own = np.einsum("njk,kl,njl->nj", self.slope, solution.inverse(), self.slope) / sigma**2
        group = np.tile([0, 1, 0, 2, 1], (len(away), 1))
        group[self.nominal.prismatic, 3] = 1
        found = []
        for g, (least, sigma_before) in enumerate(zip(LEAST, astuple(before), strict=True)):
            mine = self.free & (group == g)
            redundancy = float((1 - own[mine]).clip(0).sum())
            square = float((away[mine] ** 2).sum())
            found.append(sigma_before if redundancy < FEW else max(float(np.sqrt(square / redundancy)), least))
        return Deviations(*found)
