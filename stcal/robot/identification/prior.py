"""Prior knowledge of an arm as observations: nominal D-H rows, and the elasticity expected of it."""

from dataclasses import asdict, astuple, dataclass, replace
from typing import Literal

import numpy as np
from scipy.linalg import block_diag

from stcal.errors import InputError
from stcal.geometry.rigid import Poses, Rigid
from stcal.robot.identification.adjustment import Kind, State, sigma_of
from stcal.robot.kinematics.dh import PARALLEL_RAD, robot_from_chain
from stcal.robot.kinematics.forward import GRAVITY_M_S2
from stcal.robot.kinematics.robot_model import USUAL, Chain, Conditions, Elasticity, Robot

AXIS, ACROSS, PERIODIC, HYSTERESIS, MOMENT = 3, 4, 5, 6, 7
"""Groups of σ, after those of the dimensions; the σ of moments, and of groups after it, are not estimated."""
MASS_KG = 100.0  # usual mass of an arm of one metre; a factor of 3 does no harm, as compliances compensate it
BESIDE = 0.15
"""Typical distance of a link's centre of mass from the middle of its two joints, as a share of the arm's length."""
HEAVIER = 0.5  # σ of the factor by which an arm is heavier than usual, which the torques of known masses show
DOWN = np.array([0.0, 0.0, -1.0])
SOME = 0.1  # share of a σ at which compliances start; at 0 moments would move nothing


@dataclass(frozen=True, slots=True, eq=False)
class UsualElasticity:
    """Prior of :meth:`Elasticity.values`. ``scale`` : factors to rad at the usual torque, or shares of the usual
    moment; ``group`` : of σ of each value; ``apart`` : (p, p) that makes the scaled deviations independent, of σ 1 in
    the group of moments."""

    expected: np.ndarray
    scale: np.ndarray
    group: np.ndarray
    apart: np.ndarray


def usual(chain: Chain, carried: bool = False, hysteresis: bool = False) -> UsualElasticity:
    """Returns the usual elasticity of an arm of these dimensions; ``carried`` : known loads show its mass, and all
    moments may be wrong by one factor: 1 + σ² m mᵀ is the covariance of their shares, m being the usual ones."""
    n = len(chain)
    gears = np.array([PERIODIC] * (4 * n) + [HYSTERESIS] * (n if hysteresis else 0))
    moment, beside = _moments(chain)
    torque = chain.gathered(np.linalg.norm(moment, axis=1) + beside)
    expected = np.concatenate([np.zeros(2 * n), moment.ravel(), np.zeros(len(gears))])
    scale = np.concatenate([np.repeat(torque, 2), np.repeat(1 / beside, 3), np.ones(len(gears))])
    group = np.concatenate([np.tile([AXIS, ACROSS], n), np.full(3 * n, MOMENT), gears])
    apart = np.eye(len(group))
    if carried:
        along = np.where(group == MOMENT, expected * scale, 0.0)
        size = np.linalg.norm(along)
        apart -= (1 - 1 / np.sqrt(1 + (HEAVIER * size) ** 2)) * np.outer(along / size, along / size)
    return UsualElasticity(expected, scale, group, apart)


def bending(state: State, robot: Robot, deflection_rad: float, conditions: Conditions = USUAL) -> State:
    """Returns the state with elasticity to be adjusted, that of the robot file, or nearly rigid with gravity down."""
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
    """Returns each link's usual moment (n, 3) N m, with what follows at the next joint, and its σ (n,)."""
    n = len(chain)
    following = [[k for k in range(n) if chain.after(k) == i] for i in range(n)]
    ends = {i: chain.ends[i].translation for i in range(n) if not following[i]}
    length, above = np.array([np.linalg.norm(ends.get(i, np.zeros(3))) for i in range(n)]), np.ones(n)
    for i in range(n - 1, -1, -1):  # the longest way from base to an end, and the joints from each to its farthest end
        before = chain.after(i)
        if before >= 0:
            length[before] = max(length[before], np.linalg.norm(chain.translation[i]) + length[i])
            above[before] = max(above[before], 1 + above[i])
    length_m = 1e-3 * max(float(length.max()), 1.0)
    weight = GRAVITY_M_S2 * MASS_KG * length_m**2 * (above - 0.5) / (0.5 * above.max() ** 2)
    whole = chain.gathered(weight)
    moment = np.zeros((n, 3))
    for i, after in enumerate(following):
        next_mm = chain.translation[after] if after else ends[i][None]
        moment[i] = next_mm.mean(0) * weight[i] / 2 + whole[after] @ next_mm[: len(after)]
    return 1e-3 * moment, BESIDE * length_m * whole


DIFFERENCE_MM = 1e-4  # step of the derivatives by differences, in mm of movement of the tool
DOUBT = 1.0  # σ of the logarithm of the deviations' σ, which are known of makes of robots within a factor of about e
COAXIAL_MM = 100.0
"""Distance of parallel axes below which an error of 0.5 mm across them turns θ by more than zero positions err."""
LENGTH, TWIST, ZERO = 0, 1, 2
FIXED_LENGTH, FIXED_ANGLE = 8, 9
FIXED_MM, FIXED_RAD = 1e-4, 1e-7  # σ of dimensions that are not adjusted: a ten-thousandth of a millimetre at 1 m
Adjusted = Literal["all", "geometry", "zeros", "base,tool"]
KEPT: dict[Adjusted, tuple[int, ...]] = {
    "all": (),
    "geometry": (ZERO,),
    "zeros": (LENGTH, TWIST),
    "base,tool": (LENGTH, TWIST, ZERO),
}
"""Groups of dimensions that stay nominal; base and tools are always adjusted."""
DIMENSIONS = ("a", "alpha", "d", "theta", "beta")
SHOWN = np.array([1.0, 180 / np.pi, 1.0, 180 / np.pi, 180 / np.pi])
"""Factors from mm and rad to the units, mm and degrees, in which dimensions are shown."""


def adjusted(text: str) -> Adjusted:
    """Returns the option for ``text``, names with commas; raises InputError: an unknown name."""
    words = {word.strip() for word in text.split(",")}
    if not words <= {"base", "tool", "zeros", "geometry", "all"}:
        raise InputError("E-OPTION-VALUE", f"--adjust {text}: base,tool, zeros, geometry or all needed")
    if "all" in words or {"zeros", "geometry"} <= words:
        return "all"
    return "zeros" if "zeros" in words else "geometry" if "geometry" in words else "base,tool"


@dataclass(frozen=True, slots=True)
class Deviations:
    """σ of a robot about nominal, before the data are seen: lengths (mm), twists (rad), zeros of joints (rad, mm), and
    links' deflection at the usual torque about the joints' axes and across them, gears, hysteresis (rad)."""

    length_mm: float = 0.5
    twist_rad: float = 1e-3
    zero_rad: float = 5e-3
    axis_rad: float = 3e-4
    across_rad: float = 1e-4
    periodic_rad: float = 1e-4
    hysteresis_rad: float = 1e-4

    def of(self, groups: np.ndarray) -> dict[str, float | None]:
        """Returns the σ by name; None for groups in which the robot has no dimensions."""
        return {name: sigma if g in groups else None for g, (name, sigma) in enumerate(asdict(self).items())}


def dh_values(robot: Robot) -> np.ndarray:
    """Returns a, alpha, d, theta, beta of the rows, (n, 5)."""
    return np.array([astuple(row) for row in robot.rows], float)


@dataclass(frozen=True, slots=True, eq=False)
class NominalRows:
    """The nominal dimensions as observations of the parameters.

    Dimensions are the rows' a, alpha, d, theta, beta; for coaxial joints the offset along and across the nominal x
    replaces a and theta, its polar form. ``coaxial`` : (row of theta, row of the a that follows it) of each pair of
    coaxial joints; ``jacobian`` : (n, 5, k) by the parameters of the axes (tools move no row), computed once, as it
    hardly changes over factory deviations; ``free`` : (n, 5) mask of the dimensions that any parameter moves;
    ``group`` : (n, 5) group of σ of each dimension; ``elasticity`` : the prior of the elasticity if it is unknown.
    """

    nominal: Robot
    coaxial: tuple[tuple[int, int], ...]
    jacobian: np.ndarray
    free: np.ndarray
    group: np.ndarray
    elasticity: UsualElasticity | None = None

    @property
    def groups(self) -> np.ndarray:
        """Group of σ (p,) of each observation that :meth:`held` makes."""
        own = self.group[self.free]
        return own if self.elasticity is None else np.append(own, self.elasticity.group)

    @classmethod
    def about(
        cls, state: State, units: np.ndarray, nominal: Robot, adjust: Adjusted = "all", carried: bool = False
    ) -> "NominalRows":
        """Returns the rows with their derivatives at ``state``. ``units`` : (k,) steps that move the tool by 1 mm;
        ``adjust`` : other dimensions are conditions; ``carried`` : known loads were carried."""
        coaxial = _coaxial(nominal)

        def values(step: np.ndarray) -> np.ndarray:
            robot = robot_from_chain(state.chain.moved(step), state.tools, nominal)
            return _dimensions(robot, nominal, coaxial)

        units = units[: len(state.chain.parameters())]
        reference, steps = values(np.zeros(len(units))), DIFFERENCE_MM * np.diag(units)
        jacobian = np.stack([(values(step) - reference) / step.max() for step in steps], axis=2)
        group = np.tile([LENGTH, TWIST, LENGTH, ZERO, TWIST], (len(jacobian), 1))
        group[nominal.prismatic, 3] = TWIST  # the zero position of a prismatic joint is d
        group[[turn for turn, _ in coaxial], 3] = LENGTH
        fixed = np.isin(group, KEPT[adjust])
        fixed |= [[name in joint.fixed for name in DIMENSIONS] for joint in nominal.joints]
        group[fixed] = np.where(group[fixed] == LENGTH, FIXED_LENGTH, FIXED_ANGLE)
        elasticity = usual(nominal.chain(), carried, state.hysteresis) if state.elastic else None
        return cls(nominal, coaxial, jacobian, np.abs(jacobian * units).max(axis=2) > 1e-9, group, elasticity)

    def held(self, state: State, deviations: Deviations, kind: Kind) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns the nominal dimensions as prior knowledge about ``state``: values (p,) and their derivatives (p, k),
        over σ, and a mask (p,) of those that are not adjusted."""
        robot = robot_from_chain(state.chain, state.tools, self.nominal)
        away = _dimensions(robot, self.nominal, self.coaxial) - _dimensions(self.nominal, self.nominal, self.coaxial)
        jacobian = self.jacobian[self.free]
        others = len(state.parameter_names(kind)) - jacobian.shape[1]
        derivative, value, usual_ = np.pad(jacobian, ((0, 0), (0, others))), away[self.free], self.elasticity
        if usual_ is not None and state.chain.elasticity is not None:
            apart = state.chain.elasticity.values(state.hysteresis) - usual_.expected
            derivative = np.asarray(block_diag(derivative, usual_.apart * usual_.scale))
            value = np.append(value, usual_.apart @ (apart * usual_.scale))
        sigma = np.array([*astuple(deviations), 1.0, FIXED_MM, FIXED_RAD])[self.groups]
        return value / sigma, derivative / sigma[:, None], self.groups >= FIXED_LENGTH

    @property
    def fixed(self) -> np.ndarray:
        """Mask (n, 5) of the dimensions that could be adjusted but are not."""
        return (self.group >= FIXED_LENGTH) & self.free

    def notes(self, robot: Robot) -> tuple[str, ...]:
        """Returns notes on the rows of ``robot``."""
        reasons = [
            f"{name} of row {i} ({reason})"
            for i, joint in enumerate(self.nominal.joints, 1)
            for name, reason in joint.fixed.items()
        ]
        fixed = (f"kept as the robot file has them: {', '.join(reasons)}",) if reasons else ()
        return fixed + tuple(
            f"joints {turn + 1} and {turn + 2} lie nearly on one line: theta of row {turn + 1} is the direction of the "
            f"{robot.rows[reach].a:.3g} mm between them, not a zero position"
            for turn, reach in self.coaxial
        )

    def sigma(self, robot: Robot, covariance: np.ndarray) -> np.ndarray:
        """Returns σ (n, 5) of the rows of ``robot`` from the parameters' covariance (k, k)."""
        jacobian = self.by_parameters(robot)
        k = jacobian.shape[2]
        return np.where(self.fixed, 0.0, sigma_of(jacobian, covariance[:k, :k]))

    def by_parameters(self, robot: Robot) -> np.ndarray:
        """Returns the derivatives (n, 5, k) of the rows of ``robot`` (a, alpha, d, theta, beta) by the parameters."""
        jacobian = self.jacobian.copy()
        for turn, reach in self.coaxial:
            angle = robot.rows[turn].theta - self.nominal.rows[turn].theta
            along, across = self.jacobian[reach, 0], self.jacobian[turn, 3]
            jacobian[reach, 0] = np.cos(angle) * along + np.sin(angle) * across
            offset = max(abs(robot.rows[reach].a), 1e-9)
            jacobian[turn, 3] = (np.cos(angle) * across - np.sin(angle) * along) / offset
        return jacobian


def _dimensions(robot: Robot, nominal: Robot, coaxial: tuple[tuple[int, int], ...]) -> np.ndarray:
    """Returns a, alpha, d, theta, beta (n, 5), or the offsets along and across the nominal x for coaxial joints."""
    values = dh_values(robot)
    for turn, reach in coaxial:
        angle, offset = values[turn, 3] - nominal.rows[turn].theta, values[reach, 0]
        values[turn, 3], values[reach, 0] = offset * np.sin(angle), offset * np.cos(angle)
    return values


def _coaxial(nominal: Robot) -> tuple[tuple[int, int], ...]:
    """Returns (row of theta, row of a) of each pair of consecutive joints on nearly one line."""
    pairs = []
    for i in range(1, len(nominal.rows)):
        reach = i - 1 if nominal.convention == "standard" else i
        row = nominal.rows[reach]
        parallel = abs(np.cos(row.alpha) * np.cos(row.beta)) > np.cos(PARALLEL_RAD)
        if i not in nominal.tree.mounts and parallel and abs(row.a) < COAXIAL_MM and not nominal.prismatic[i]:
            pairs.append((i - 1, reach))
    return tuple(pairs)


@dataclass(frozen=True, slots=True, eq=False)
class PlacedFrame:
    """The pose of the base in the instrument's frame, a tool in the flange's, a station in the first one's, or the
    start of a branch. ``sigma`` : (6,) of its rotation (rad, about the outer frame's axes) and translation (mm); nan
    where it was not fitted."""

    name: str
    pose: Rigid
    sigma: np.ndarray


def placed(
    state: State, kind: Kind, covariance: np.ndarray, units: np.ndarray, nominal: Robot
) -> tuple[PlacedFrame, ...]:
    """Returns base, tools, stations and starts of branches with σ; nan where the observations do not tell them."""

    def poses(at: State) -> Poses:
        robot = robot_from_chain(at.chain, at.tools, nominal)
        stations = [station.inverse() for station in list(at.stations.values())[1:]]
        mounts = (pose for _, pose in robot.tree.mounts.values())
        return Poses.of([robot.world_from_base, *robot.tools.values(), *stations, *mounts])

    def slope(step: np.ndarray) -> np.ndarray:
        ahead, behind = poses(state.moved(step, kind)), poses(state.moved(-step, kind))
        return ahead.difference(behind) / (2 * step.max())

    state = replace(state, elastic=False)
    derivative = np.stack([slope(step) for step in DIFFERENCE_MM * np.diag(units)], axis=2)
    sigma = sigma_of(derivative, covariance)
    if kind != "pose":
        sigma[1 : 1 + len(state.tools), :3] = np.nan
    if kind == "distance":
        sigma[0] = np.nan
    tools = (f"tool {name}".rstrip() for name in state.tools)
    names = ["base", *tools, *(f"station {name}" for name in list(state.stations)[1:])]
    names += [
        f"mount of joint {i + 1} behind {'the base' if after < 0 else f'joint {after + 1}'}"
        for i, (after, _) in nominal.tree.mounts.items()
    ]
    return tuple(PlacedFrame(*each) for each in zip(names, poses(state), sigma, strict=True))
