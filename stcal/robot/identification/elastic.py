"""Elasticity as unknowns: the values expected of an arm, and their σ.

Compliance, moments and gears are too many numbers for few rows. Each number is held to its usual value by a σ. The σ of
compliance about the axes, of compliance across them, and of gears are estimated with the other variance components.
Where an arm shows nothing of a kind, the σ of this kind becomes small, and the kind is as good as absent.
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
"""Groups of σ, after those of the dimensions; the σ of moments, and of groups after it, are not estimated."""
MASS_KG = 100.0
"""Usual mass of an arm of one metre. It grows with the square of the length, and falls to nothing from the first link
to the last; arms on the market have 25 kg at 0.6 m, 116 kg at 1.2 m, 550 kg at 2.1 m. Compliances compensate its error,
so that a factor of 3 does no harm."""
BESIDE = 0.15
"""Typical distance of a link's centre of mass from the middle of its two joints, in each direction, as a share of the
arm's length."""
HEAVIER = 0.5
"""σ of the factor by which an arm is heavier than usual. Without loads nothing shows this factor, and compliances
compensate it. The torques of known masses give compliances a scale."""
DOWN = np.array([0.0, 0.0, -1.0])
SOME = 0.1
"""Share of a σ at which compliances start; at 0 moments would move nothing."""


@dataclass(frozen=True, slots=True, eq=False)
class UsualElasticity:
    """The prior of :func:`elasticity_values`, (9 n,), or (10 n,) with hysteresis. ``expected`` : expected values;
    ``scale`` : factors that make a value rad at the joint's usual torque, or a share of the usual moment; ``group`` :
    group of σ of each value; ``factor_sigma`` : σ of a factor that all moments have in common."""

    expected: np.ndarray
    scale: np.ndarray
    group: np.ndarray
    factor_sigma: float = 0.0

    def away(self, chain: Chain) -> np.ndarray:
        """Returns the deviations of the chain's elasticity from the expected values, in rad or shares."""
        assert chain.elasticity is not None
        values = elasticity_values(chain.elasticity, HYSTERESIS in self.group)
        return self._apart((values - self.expected) * self.scale)

    def jacobian(self) -> np.ndarray:
        """Returns the derivative of :meth:`away` by the values."""
        return self._apart(np.diag(self.scale))

    def _apart(self, shares: np.ndarray) -> np.ndarray:
        """Returns the shares made independent, with σ 1.

        Moments err by these shares and, all together, by the factor. The inverse root of their covariance 1 + σ² m mᵀ
        shortens the component along m, the usual moments, and leaves the others.
        """
        if not self.factor_sigma:
            return shares
        along = np.where(self.group == MOMENT, self.expected * self.scale, 0.0)
        size = np.linalg.norm(along)
        along = along / size
        less = 1 - 1 / np.sqrt(1 + (self.factor_sigma * size) ** 2)
        return shares - less * np.multiply.outer(along, along @ shares)


def usual(chain: Chain, carried: bool = False, hysteresis: bool = False) -> UsualElasticity:
    """Returns the usual elasticity of an arm with these dimensions.

    ``carried`` : known loads were carried, which show how heavy the arm itself is; ``hysteresis`` : values are (10 n,).
    """
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
    """Returns True if any row carried a mass, or, where the rows do not say, if the chain has a payload."""
    if conditions.payload_kg is None:
        return chain.elasticity is not None and chain.elasticity.payload_kg > 0
    return conditions.loaded


def bending(state: State, robot: Robot, deflection_rad: float, conditions: Conditions = USUAL) -> State:
    """Returns the state with elasticity to be adjusted.

    It starts as the robot file has it, or nearly rigid with gravity down from the base. The payload is the mass that
    all rows carried, if it was one. Hysteresis is included if rows say from which side joints came.
    """
    elasticity = state.chain.elasticity
    if elasticity is None or not elasticity.compliance.any():
        n, prior = len(state.chain), usual(state.chain)
        compliance = SOME * deflection_rad / prior.scale[: 2 * n].reshape(n, 2)
        moment = prior.expected[2 * n : 5 * n].reshape(n, 3)
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
    """Returns the usual moments (n, 3) of each link in N m, with what follows placed at the next joint, and their σ
    (n,)."""
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
    """Returns the length, in mm, of the longest way from the first joint of a branch at the base to its end; and for
    each joint (n,) the number of joints from it, itself included, to the farthest end."""
    length, above = np.zeros(len(chain)), np.ones(len(chain))
    for i, end in ends.items():
        length[i] = np.linalg.norm(end.translation)
    for i in range(len(chain) - 1, -1, -1):
        before = chain.after(i)
        if before >= 0:
            length[before] = max(length[before], np.linalg.norm(chain.translation[i]) + length[i])
            above[before] = max(above[before], 1 + above[i])
    return float(length.max()), above
