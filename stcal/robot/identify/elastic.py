"""Elasticity as unknowns: what is expected of arms, and with what doubt.

Compliance, moments and gears are too many numbers for few rows; each is held to what is usual by a σ, and those of
compliance about the axes, across them, and of gears are estimated with the other variance components. Where an arm
shows nothing of a kind, its σ becomes small and the kind is as good as absent.
"""

from dataclasses import dataclass, replace

import numpy as np

from stcal.robot.identify.residuals import State
from stcal.robot.kinematics.forward import GRAVITY_M_S2, elasticity_values
from stcal.robot.kinematics.model import Chain, Elasticity, Robot

AXIS, ACROSS, PERIODIC, MOMENT = 3, 4, 5, 6
"""Groups of σ, after those of the dimensions; that of moments, and those after it, are not estimated."""
MASS_KG = 100.0
"""Of an arm of one metre, growing with the square of its length, from the first link to the last falling to nothing:
0.6 m 25 kg, 1.2 m 116, 2.1 m 550 are sold. Compliances make up for what it is wrong by, so that 3 times is no harm."""
BESIDE = 0.15
"""Of the arm's length: a link's centre of mass is so far from the middle of its two joints, each way."""
DOWN = np.array([0.0, 0.0, -1.0])
SOME = 0.1
"""Share of a σ at which compliances start: at 0 moments would move nothing."""


@dataclass(frozen=True, slots=True, eq=False)
class UsualElasticity:
    """``expected``, ``scale`` : (9 n,) what each of :func:`elasticity_values` is expected to be, and what makes it rad
    at the joint's usual torque, or a share of the usual moment; ``group`` : (9 n,) whose σ."""

    expected: np.ndarray
    scale: np.ndarray
    group: np.ndarray

    def away(self, chain: Chain) -> np.ndarray:
        """(9 n,) from what is expected, rad or shares."""
        assert chain.elasticity is not None
        return (elasticity_values(chain.elasticity) - self.expected) * self.scale


def usual(chain: Chain) -> UsualElasticity:
    """Of an arm with these dimensions."""
    n = len(chain)
    moment, beside = _moments(chain)
    torque = np.cumsum((np.linalg.norm(moment, axis=1) + beside)[::-1])[::-1]
    expected = np.concatenate([np.zeros(2 * n), moment.ravel(), np.zeros(4 * n)])
    scale = np.concatenate([np.repeat(torque, 2), np.repeat(1 / beside, 3), np.ones(4 * n)])
    group = np.concatenate([np.tile([AXIS, ACROSS], n), np.full(3 * n, MOMENT), np.full(4 * n, PERIODIC)])
    return UsualElasticity(expected, scale, group)


def bending(state: State, robot: Robot, deflection_rad: float) -> State:
    """The state with elasticity to be adjusted: as the robot file has it, or hardly any, and gravity down from the
    base."""
    if robot.elasticity is not None and robot.elasticity.compliance.any():
        return replace(state, elastic=True)
    n, known = len(state.chain), usual(state.chain)
    compliance = SOME * deflection_rad / known.scale[: 2 * n].reshape(n, 2)
    moment = known.expected[2 * n : 5 * n].reshape(n, 3)
    gravity = DOWN if robot.elasticity is None else robot.elasticity.gravity
    bent = replace(robot, elasticity=Elasticity(compliance, moment, np.zeros((n, 4)), gravity)).chain()
    return replace(state, chain=replace(state.chain, elasticity=bent.elasticity), elastic=True)


def _moments(chain: Chain) -> tuple[np.ndarray, np.ndarray]:
    """(n, 3) N m of each link with what follows put at the next joint, and (n,) what they are known to."""
    n = len(chain)
    to_next = np.vstack([chain.translation[1:], chain.last_from_flange.translation])
    length_m = 1e-3 * max(float(np.linalg.norm(to_next, axis=1).sum()), 1.0)
    share = np.arange(n, 0, -1) - 0.5
    weight = GRAVITY_M_S2 * MASS_KG * length_m**2 * share / share.sum()
    after = np.append(np.cumsum(weight[::-1])[::-1][1:], 0.0)
    moment = 1e-3 * to_next * (weight / 2 + after)[:, None]
    return moment, BESIDE * length_m * (weight + after)
