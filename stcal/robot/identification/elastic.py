"""Elasticity as unknowns: what is expected of arms, and with what doubt.

Compliance, moments and gears are too many numbers for few rows; each is held to what is usual by a σ, and those of
compliance about the axes, across them, and of gears are estimated with the other variance components. Where an arm
shows nothing of a kind, its σ becomes small and the kind is as good as absent.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from stcal.geometry.rigid import Rigid
from stcal.robot.identification.residuals import State
from stcal.robot.kinematics.conditions import USUAL, Conditions
from stcal.robot.kinematics.forward import GRAVITY_M_S2, elasticity_values
from stcal.robot.kinematics.model import Chain, Elasticity, Robot

AXIS, ACROSS, PERIODIC, HYSTERESIS, MOMENT = 3, 4, 5, 6, 7
"""Groups of σ, after those of the dimensions; that of moments, and those after it, are not estimated."""
MASS_KG = 100.0
"""Of an arm of one metre, growing with the square of its length, from the first link to the last falling to nothing:
0.6 m 25 kg, 1.2 m 116, 2.1 m 550 are sold. Compliances make up for what it is wrong by, so that 3 times is no harm."""
BESIDE = 0.15
"""Of the arm's length: a link's centre of mass is so far from the middle of its two joints, each way."""
HEAVIER = 0.5
"""σ of the factor by which an arm is heavier than usual. Without loads nothing shows it, and compliances make up for
it; beside the torques of masses that are known compliances have a scale."""
DOWN = np.array([0.0, 0.0, -1.0])
SOME = 0.1
"""Share of a σ at which compliances start: at 0 moments would move nothing."""


@dataclass(frozen=True, slots=True, eq=False)
class UsualElasticity:
    """``expected``, ``scale`` : (9 n,), or (10 n,) with hysteresis, what each of :func:`elasticity_values` is expected
    to be, and what makes it rad at the joint's usual torque, or a share of the usual moment; ``group`` : of each, whose
    σ; ``factor_sigma`` : of a factor that all moments have in common."""

    expected: np.ndarray
    scale: np.ndarray
    group: np.ndarray
    factor_sigma: float = 0.0

    def away(self, chain: Chain) -> np.ndarray:
        """From what is expected, rad or shares."""
        assert chain.elasticity is not None
        values = elasticity_values(chain.elasticity, HYSTERESIS in self.group)
        return self._apart((values - self.expected) * self.scale)

    def jacobian(self) -> np.ndarray:
        """Of :meth:`away` by the values."""
        return self._apart(np.diag(self.scale))

    def _apart(self, shares: np.ndarray) -> np.ndarray:
        """Shares, independent with σ 1: moments err by these and, all together, by the factor. The inverse
        root of their covariance 1 + σ² m mᵀ is shorter along m, the usual moments, and as it was across."""
        if not self.factor_sigma:
            return shares
        along = np.where(self.group == MOMENT, self.expected * self.scale, 0.0)
        size = np.linalg.norm(along)
        along = along / size
        less = 1 - 1 / np.sqrt(1 + (self.factor_sigma * size) ** 2)
        return shares - less * np.multiply.outer(along, along @ shares)


def usual(chain: Chain, carried: bool = False, hysteresis: bool = False) -> UsualElasticity:
    """Of an arm with these dimensions; known loads are ``carried``, which show how heavy it is itself; with
    ``hysteresis`` (10 n,)."""
    n = len(chain)
    moment, beside = _moments(chain)
    torque = chain.gathered(np.linalg.norm(moment, axis=1) + beside)
    expected = np.concatenate([np.zeros(2 * n), moment.ravel(), np.zeros(4 * n)])
    scale = np.concatenate([np.repeat(torque, 2), np.repeat(1 / beside, 3), np.ones(4 * n)])
    group = np.concatenate([np.tile([AXIS, ACROSS], n), np.full(3 * n, MOMENT), np.full(4 * n, PERIODIC)])
    if hysteresis:
        expected, scale = np.append(expected, np.zeros(n)), np.append(scale, np.ones(n))
        group = np.append(group, np.full(n, HYSTERESIS))
    return UsualElasticity(expected, scale, group, HEAVIER if carried else 0.0)


def carries(chain: Chain, conditions: Conditions) -> bool:
    """Whether the masses that rows carried, or that of the chain where they say nothing, are any."""
    if conditions.payload_kg is None:
        return chain.elasticity is not None and chain.elasticity.payload_kg > 0
    return conditions.loaded


def bending(state: State, robot: Robot, deflection_rad: float, conditions: Conditions = USUAL) -> State:
    """The state with elasticity to be adjusted: as the robot file has it, or hardly any, and gravity down from the
    base; with the mass that all rows carried, if it was one, and with hysteresis if rows say from where joints came."""
    elasticity = state.chain.elasticity
    if elasticity is None or not elasticity.compliance.any():
        n, known = len(state.chain), usual(state.chain)
        compliance = SOME * deflection_rad / known.scale[: 2 * n].reshape(n, 2)
        moment = known.expected[2 * n : 5 * n].reshape(n, 3)
        stated = robot.elasticity or Elasticity(compliance, moment, np.zeros((n, 4)), DOWN)
        bent = replace(stated, compliance=compliance, moment=moment, periodic=np.zeros((n, 4)))
        elasticity = replace(robot, elasticity=bent).chain().elasticity
        assert elasticity is not None
    mass = conditions.payload_kg
    if mass is not None and np.ptp(mass) == 0:
        elasticity = replace(elasticity, payload_kg=float(mass[0]))
    chain = replace(state.chain, elasticity=elasticity)
    return replace(state, chain=chain, elastic=True, hysteresis=conditions.approached)


def _moments(chain: Chain) -> tuple[np.ndarray, np.ndarray]:
    """(n, 3) N m of each link with what follows put at the next joint, and (n,) what they are known to."""
    n = len(chain)
    carrier = [chain.after(i) for i in range(n)]
    last = sorted(set(range(n)) - set(carrier))
    ends = {i: chain.last_from_flange if chain.grown is None else chain.grown.ends[i] for i in last}
    longest, above = _longest(chain, ends)
    length_m = 1e-3 * max(longest, 1.0)
    share = above - 0.5
    weight = GRAVITY_M_S2 * MASS_KG * length_m**2 * share / (0.5 * above.max() ** 2)
    whole = chain.gathered(weight)
    moment = np.zeros((n, 3))
    for i in range(n):
        following = [k for k in range(n) if carrier[k] == i]
        next_mm = chain.translation[following] if following else ends[i].translation[None]
        moment[i] = next_mm.mean(0) * weight[i] / 2 + whole[following] @ next_mm[: len(following)]
    return 1e-3 * moment, BESIDE * length_m * whole


def _longest(chain: Chain, ends: Mapping[int, Rigid]) -> tuple[float, np.ndarray]:
    """Length, mm, of the longest way from the first joint of a branch at the base to its end; and (n,) how many joints
    follow one another from each to the farthest end, itself counted."""
    length, above = np.zeros(len(chain)), np.ones(len(chain))
    for i, end in ends.items():
        length[i] = np.linalg.norm(end.translation)
    for i in range(len(chain) - 1, -1, -1):
        before = chain.after(i)
        if before >= 0:
            length[before] = max(length[before], np.linalg.norm(chain.translation[i]) + length[i])
            above[before] = max(above[before], 1 + above[i])
    return float(length.max()), above
