"""What the nominal D-H rows are worth: dimensions as made differ from the drawing by σ that the data show."""

from dataclasses import asdict, astuple, dataclass

import numpy as np

from stcal.robot.identify.adjustment import Held
from stcal.robot.identify.residuals import Kind, State, unknowns
from stcal.robot.kinematics.dh import PARALLEL_RAD, robot_from_chain
from stcal.robot.kinematics.forward import chain_parameters, moved_chain
from stcal.robot.kinematics.model import Robot

DIFFERENCE_MM = 1e-4
"""Step of the derivatives by differences, in movement of the tool: linear to a millionth, and far above rounding."""
DOUBT = 1.0
"""Of the logarithm of the deviations' σ: what makes of robots are known for is known within a factor of e or so."""
COAXIAL_MM = 100.0
"""Of parallel axes closer than this an error of length across them turns θ by more than zero positions err (0.5 mm over
5 mrad)."""
LENGTH, TWIST, ZERO = 0, 1, 2


@dataclass(frozen=True, slots=True)
class Deviations:
    """σ of a robot's dimensions about nominal: lengths (mm), twists, and zero positions of joints (rad, mm). The values
    here are what is expected before the data are seen: some tenths of a millimetre and of a degree."""

    length_mm: float = 0.5
    twist_rad: float = 1e-3
    zero_rad: float = 5e-3

    def of(self, groups: np.ndarray) -> dict[str, float | None]:
        """By name; None of groups that the robot has no dimensions of."""
        present = np.isin((LENGTH, TWIST, ZERO), groups)
        return {k: v if there else None for (k, v), there in zip(asdict(self).items(), present, strict=True)}


def dh_values(robot: Robot) -> np.ndarray:
    """(n, 5) of a, alpha, d, theta, beta."""
    return np.array([[row.a, row.alpha, row.d, row.theta, row.beta] for row in robot.rows], float)


@dataclass(frozen=True, slots=True, eq=False)
class NominalRows:
    """The nominal dimensions as observations of the parameters.

    Dimensions are the rows' a, alpha, d, theta, beta, but of coaxial joints the offset along and across the nominal x
    in place of a and theta (its polar form). ``coaxial`` : rows of theta, and of the a that follows it; ``jacobian`` :
    (n, 5, k) by the parameters of the axes (tools move no row), taken once, as it hardly changes over what a factory
    does; ``free`` : (n, 5) dimensions that parameters move at all; ``group`` : (n, 5) whose σ.
    """

    nominal: Robot
    coaxial: tuple[tuple[int, int], ...]
    jacobian: np.ndarray
    free: np.ndarray
    group: np.ndarray

    @classmethod
    def about(cls, state: State, units: np.ndarray, nominal: Robot) -> "NominalRows":
        """With the derivatives at ``state``, where ``units`` (k,) of the parameters move the tool by 1 mm."""
        coaxial = _coaxial(nominal)

        def values(step: np.ndarray) -> np.ndarray:
            found = robot_from_chain(moved_chain(state.chain, step), state.tools, nominal)
            return _dimensions(found, nominal, coaxial)

        units = units[: len(chain_parameters(state.chain))]
        jacobian, here = np.zeros((len(nominal.rows), 5, len(units))), values(np.zeros(len(units)))
        for k in range(len(units)):
            step = np.zeros(len(units))
            step[k] = DIFFERENCE_MM * units[k]
            jacobian[:, :, k] = (values(step) - here) / step[k]
        group = np.tile([LENGTH, TWIST, LENGTH, ZERO, TWIST], (len(jacobian), 1))
        group[nominal.prismatic, 3] = TWIST  # the zero of these is d
        group[[turn for turn, _ in coaxial], 3] = LENGTH
        return cls(nominal, coaxial, jacobian, np.abs(jacobian * units).max(axis=2) > 1e-9, group)

    def held(self, state: State, deviations: Deviations, kind: Kind) -> Held:
        """Linear about ``state``, with the σ of ``deviations``, by all parameters of this kind of observation."""
        robot = robot_from_chain(state.chain, state.tools, self.nominal)
        away = _dimensions(robot, self.nominal, self.coaxial) - _dimensions(self.nominal, self.nominal, self.coaxial)
        jacobian = self.jacobian[self.free]
        tools = unknowns(state.chain, len(state.tools), kind) - jacobian.shape[1]
        jacobian = np.pad(jacobian, ((0, 0), (0, tools)))
        return Held(away[self.free], jacobian, np.array(astuple(deviations))[self.group[self.free]])

    def notes(self, robot: Robot) -> tuple[str, ...]:
        """What is to be known of the rows of ``robot``."""
        return tuple(
            f"joints {turn + 1} and {turn + 2} lie nearly on one line: theta of row {turn + 1} is the direction of the "
            f"{robot.rows[reach].a:.3g} mm between them, not a zero position"
            for turn, reach in self.coaxial
        )

    def sigma(self, robot: Robot, covariance: np.ndarray) -> np.ndarray:
        """(n, 5) σ of the rows of ``robot`` (a, alpha, d, theta, beta) from the parameters' covariance (k, k)."""
        jacobian = self.by_parameters(robot)
        covariance = covariance[: jacobian.shape[2], : jacobian.shape[2]]
        return np.sqrt(np.einsum("njk,kl,njl->nj", jacobian, covariance, jacobian).clip(0))

    def by_parameters(self, robot: Robot) -> np.ndarray:
        """(n, 5, k) derivatives of the rows of ``robot``, of a, alpha, d, theta, beta."""
        jacobian = self.jacobian.copy()
        for turn, reach in self.coaxial:
            angle = robot.rows[turn].theta - self.nominal.rows[turn].theta
            along, across = self.jacobian[reach, 0], self.jacobian[turn, 3]
            jacobian[reach, 0] = np.cos(angle) * along + np.sin(angle) * across
            offset = max(abs(robot.rows[reach].a), 1e-9)
            jacobian[turn, 3] = (np.cos(angle) * across - np.sin(angle) * along) / offset
        return jacobian


def _dimensions(robot: Robot, nominal: Robot, coaxial: tuple[tuple[int, int], ...]) -> np.ndarray:
    """(n, 5) of a, alpha, d, theta, beta, or what stands in their place."""
    values = dh_values(robot)
    for turn, reach in coaxial:
        angle, offset = values[turn, 3] - nominal.rows[turn].theta, values[reach, 0]
        values[turn, 3], values[reach, 0] = offset * np.sin(angle), offset * np.cos(angle)
    return values


def _coaxial(nominal: Robot) -> tuple[tuple[int, int], ...]:
    """(row of theta, row of a) of consecutive joints on nearly one line."""
    found = []
    for i in range(1, len(nominal.rows)):
        reach = i - 1 if nominal.convention == "standard" else i
        row = nominal.rows[reach]
        parallel = abs(np.cos(row.alpha) * np.cos(row.beta)) > np.cos(PARALLEL_RAD)
        if parallel and abs(row.a) < COAXIAL_MM and not nominal.prismatic[i]:
            found.append((i - 1, reach))
    return tuple(found)
