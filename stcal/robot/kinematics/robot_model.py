"""The model of a robot arm: Denavit-Hartenberg rows, joints, elasticity, tools; and an example."""

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from numbers import Real
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from stcal.errors import InputError, InputNote
from stcal.geometry.arrays import Brief, freeze, frozen, require_fields
from stcal.geometry.rigid import Poses, Rigid
from stcal.lengths import LEAST_LINK_MM, MOST_LINK_MM, Length, require_millimetres

PAYLOAD = "payload_kg"
APPROACH = "approach"
DIRECTIONS = (-1.0, 0.0, 1.0)
MOST_KG = 1e4
"""Largest mass at a flange. Arms carry up to 2.3 t."""


@dataclass(frozen=True, slots=True, eq=False)
class Conditions:
    """Payload and approach directions of m joint vectors. ``payload_kg`` : (m,) mass at the flange; ``approach`` : (m,
    n) direction in which each joint moved last: 1 upwards, −1 downwards, 0 unknown."""

    payload_kg: np.ndarray | None = None
    approach: np.ndarray | None = None

    def __post_init__(self):
        if self.approach is not None:
            freeze(self, "approach", (None, None), "approach")
            for value in self.approach[~np.isin(self.approach, DIRECTIONS)]:
                raise InputError("E-APPROACH-VALUE", f"approach is {value:g}; 1, -1 or 0 needed")
        if self.payload_kg is not None:
            freeze(self, "payload_kg", (None,), "payload")
            for value in self.payload_kg[(self.payload_kg < 0) | (self.payload_kg > MOST_KG)]:
                raise InputError("E-PAYLOAD-VALUE", f"payload is {value:g} kg; 0 … {MOST_KG:g} needed")

    def __getitem__(self, index) -> "Conditions":
        """Returns the conditions of the joint vectors selected by a mask, slice or list."""
        if self.payload_kg is None and self.approach is None:
            return self
        return Conditions(*(None if each is None else each[index] for each in (self.payload_kg, self.approach)))

    @property
    def approached(self) -> bool:
        """True if the approach direction of any joint is known."""
        return self.approach is not None and bool(self.approach.any())

    @property
    def loaded(self) -> bool:
        """True if a payload above 0 is known for any joint vector."""
        return self.payload_kg is not None and bool(self.payload_kg.any())

    def ignored(self, who: str) -> tuple[str, ...]:
        """Returns a note that the rigid arm ``who`` does not deflect under its payload; no note without payload."""
        said = f"{who} is rigid, {PAYLOAD} moves nothing (`identify --model elastic` tells what links give way by)"
        return (said,) if self.loaded else ()


USUAL = Conditions()  # default conditions: payload of the robot file, approach directions unknown


def loaded(payload_kg: ArrayLike | None, count: int) -> Conditions:
    """Returns conditions with one mass for all ``count`` joint vectors, or one for each; raises InputError."""
    if payload_kg is None:
        return USUAL
    values = np.asarray(payload_kg, float)
    if values.shape not in ((), (count,)):
        raise InputError("E-ARRAY-SHAPE", f"payload: shape {values.shape}, one number or ({count},) needed")
    return Conditions(np.broadcast_to(values, (count,)))


Convention = Literal["standard", "modified"]
JointType = Literal["revolute", "prismatic"]
MOST_RAD = 2 * np.pi + 1e-6
"""Largest angle of a row, except the joint's own, rad. A larger one is taken to be in degrees."""


MOST_TURNS = 4.0  # number of turns that joints are not expected to reach: 25 rad, where degrees were meant


def warn_of_degrees(values: np.ndarray, turns: np.ndarray, what: str) -> None:
    """Warns if values (m, n) of joints that turn, a mask (n,), are of many turns, as degrees taken for rad are."""
    largest = float(np.abs(values[:, turns]).max(initial=0.0))
    if largest > 2 * np.pi * MOST_TURNS:
        note = f"{what}: {largest:.4g} rad are {largest / (2 * np.pi):.0f} turns; if it is degrees, give np.radians(…)"
        warnings.warn(note, InputNote, stacklevel=3)


@dataclass(frozen=True, slots=True)
class DHRow:
    """One row of Denavit–Hartenberg parameters, with Hayati's β for nearly parallel axes.

    Standard: Rz(θ+q) Tz(d) Tx(a) Rx(α) Ry(β). Modified: Rx(α) Tx(a) Ry(β) Rz(θ+q) Tz(d), α and a being those before the
    joint. A prismatic joint adds its value to d in place of θ.

    Parameters
    ----------
    a : length of the common normal, mm.
    alpha : twist about it, rad.
    d : offset along the joint's axis, mm.
    theta : angle about the joint's axis where the joint's value is 0, rad.
    beta : second twist, about y, rad; 0 in rows of Denavit and Hartenberg proper.

    Raises InputError: a value that is no finite number.

    References
    ----------
    J. Denavit, R. S. Hartenberg, "A kinematic notation for lower-pair mechanisms based on matrices", J. Appl. Mech. 22,
    1955. J. J. Craig, "Introduction to Robotics", 1986 (modified). S. A. Hayati, "Robot arm geometric link parameter
    estimation", IEEE CDC 1983 (β).
    """

    a: float
    alpha: float
    d: float
    theta: float
    beta: float = 0.0

    def __post_init__(self):
        for name in ("a", "alpha", "d", "theta", "beta"):
            value = getattr(self, name)
            if not isinstance(value, Real) or not math.isfinite(value):
                raise InputError("E-ROBOT-ROW", f"row: {name} is {value!r}; a finite number needed")
            if name in ("alpha", "theta", "beta") and abs(float(value)) > MOST_RAD:
                fault = f"row: {name} is {value:g} rad, a turn is 6.28"
                raise InputError("E-ANGLE-UNIT", f"{fault}; if angles are degrees, convert them: np.radians")


@dataclass(frozen=True, slots=True)
class Joint:
    """Type of a joint, and the range of its value.

    Parameters
    ----------
    type : whether it turns about its axis or slides along it.
    lower, upper : limits of the controller's value, rad or mm; unlimited where not given.
    fixed : dimensions of the joint's row, by the names of :class:`DHRow`, that no identification changes, and why.

    Raises InputError: another type, limits that are swapped or no numbers, a dimension that no row has.
    """

    type: JointType = "revolute"
    lower: float = -np.inf
    upper: float = np.inf
    fixed: Mapping[str, str] = field(default_factory=dict, hash=False)

    def __post_init__(self):
        require_fields(self, "joint")
        if not self.lower < self.upper:
            fault = f"joint: lower {self.lower:g} is not below upper {self.upper:g}"
            raise InputError("E-ROBOT-LIMITS", f"{fault}; swap or correct them")
        for unknown in (name for name in self.fixed if name not in DHRow.__slots__):
            fault = f"joint: fixed {unknown}: no dimension of a row"
            raise InputError("E-ROBOT-FIXED", f"{fault}; use {', '.join(DHRow.__slots__)}")


@dataclass(frozen=True, slots=True, eq=False)
class Elasticity:
    """Small rotations of the links of n joints in addition to the joints' own: by gravity and by gears.

    The torque T = M × g of gravity deflects link i by the rotation c T, with one c about the joint's axis and another
    across it; M is the sum of the moments of the link and of all that it carries, as they are oriented. Gears add an
    angle with one and two periods per turn. A payload is a mass at a point of the flange, in addition to M.

    Parameters
    ----------
    compliance : (n, 2) rad/(N m): about the joint's axis, and across it
    moment : (n, 3) N m: weight of the link times the vector from the joint to its centre of mass, with all that follows
        placed at the next joint; in the frame of the joint after its motion. Poses determine only the products of
        compliance and moment.
    periodic : (n, 4) rad: of sin q, cos q, sin 2q, cos 2q of revolute joints
    gravity : (3,) its direction, of length 1: in the base of a robot, in the first joint's frame of a :class:`Chain`
    hysteresis : (n,) rad: added to the angle of revolute joints that came from below, subtracted if they came from
        above
    pivot : (n, 3) point about which each link turns when it deflects, mm, in its joint's frame: on the joint's axis for
        a revolute joint. The origin of that frame if not given; always the origin in a :class:`Chain`.
    payload_kg : mass that is carried if joint vectors do not state another
    payload_centre : (3,) its centre, mm: in the flange's frame of a robot, in that of the joint that carries it, as it
        has moved, of a :class:`Chain`

    Raises InputError: arrays of other shapes; a direction that is 0; a mass below 0, or beyond all that arms carry.
    """

    compliance: np.ndarray
    moment: np.ndarray
    periodic: np.ndarray
    gravity: np.ndarray
    payload_kg: float = 0.0
    payload_centre: np.ndarray = field(default_factory=lambda: np.zeros(3))
    hysteresis: np.ndarray = None  # type: ignore  # made below: its size is that of the joints
    pivot: np.ndarray = None  # type: ignore  # likewise

    def __post_init__(self):
        n = len(self.compliance)
        shapes = {"compliance": (n, 2), "moment": (n, 3), "periodic": (n, 4), "gravity": (3,), "payload_centre": (3,)}
        shapes |= {"hysteresis": (n,), "pivot": (n, 3)}
        loaded(self.payload_kg, 1)
        for name, shape in shapes.items():
            if getattr(self, name) is None:  # not given
                object.__setattr__(self, name, np.zeros(shape))
            freeze(self, name, shape, f"elasticity: {name}")
        length = float(np.linalg.norm(self.gravity))
        if length == 0:
            fault = "elasticity: gravity is [0, 0, 0]"
            raise InputError("E-ROBOT-ELASTICITY", f"{fault}; a direction in the base needed, such as [0, 0, -1]")
        object.__setattr__(self, "gravity", frozen(self.gravity / length, (3,), "elasticity: gravity"))

    def values(self, hysteresis: bool = False) -> np.ndarray:
        """Returns compliance, moment and periodic of all joints, row by row, (9 n,), or (10 n,) with hysteresis."""
        parts = [self.compliance.ravel(), self.moment.ravel(), self.periodic.ravel()]
        return np.concatenate([*parts, *([self.hysteresis] if hysteresis else [])])

    def with_values(self, values: np.ndarray) -> "Elasticity":
        """Returns the elasticity with other :meth:`values`, (9 n,) or (10 n,)."""
        n = len(self.moment)
        compliance, moment, periodic, hysteresis = np.split(values, [2 * n, 5 * n, 9 * n])
        compliance, moment, periodic = compliance.reshape(n, 2), moment.reshape(n, 3), periodic.reshape(n, 4)
        hysteresis = hysteresis if len(hysteresis) else self.hysteresis
        return replace(self, compliance=compliance, moment=moment, periodic=periodic, hysteresis=hysteresis)


@dataclass(frozen=True, slots=True, eq=False)
class Tree:
    """Which joint carries which, of a robot with several arms on one trunk; of a serial arm empty, and False.

    ``mounts`` : by the joint, from 0, that begins a branch: the joint that carries it (−1: the base), and where its
    first row begins at the end of the carrier's row, mm; every other joint is carried by the one before it.
    ``carriers`` : by tool the joint that carries it; the last one where a tool is not named. Raises InputError: a
    branch that is carried by a joint that does not come before it.
    """

    mounts: Mapping[int, tuple[int, Rigid]] = field(default_factory=dict)
    carriers: Mapping[str, int] = field(default_factory=dict)

    def __post_init__(self):
        for joint, (after, _) in self.mounts.items():
            if not -1 <= after < joint:
                fault = f"joint {joint + 1} is carried by joint {after + 1}"
                raise InputError("E-ROBOT-BRANCH", f"{fault}; 0 (the base) or one that comes before needed")

    def __bool__(self) -> bool:
        return bool(self.mounts or self.carriers)

    def carrier(self, joint: int) -> tuple[int, Rigid]:
        """The joint that carries ``joint`` (−1: the base), and where its first row begins at the end of that one's."""
        return self.mounts.get(joint, (joint - 1, Rigid()))

    def after(self, joint: int) -> int:
        """The joint that carries ``joint``; −1 for the base."""
        return self.carrier(joint)[0]

    def path(self, joint: int) -> tuple[int, ...]:
        """Joints from the base to ``joint``."""
        found = []
        while joint >= 0:
            found.append(joint)
            joint = self.after(joint)
        return tuple(reversed(found))


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Robot(Brief):
    """An arm of n joints, one after the other, or a tree of such arms.

    Parameters
    ----------
    name : for messages and reports.
    convention : of all rows; see :class:`DHRow`.
    rows : one for each joint, from the base; mm, rad.
    joints : one for each row: type and range.
    coupling : (n, n) kinematic joint values from the controller's, a regular matrix; the identity if not given.
    world_from_base : base in the frame of the measuring instrument, mm.
    tools : flange_from_tool by name, mm; ``""`` is the tool if none is named.
    elasticity : rigid if not given.
    tree : every joint is carried by the one before it, and tools by the last one, if not given.
    unusual_size : true if unusually long or short links are not a mistake of units.

    Raises InputError: another convention; rows and joints of other types, or of different numbers, or none; lengths
    that are not mm; a coupling matrix of another shape, or a singular one; elasticity of another number of joints.
    """

    name: str
    convention: Convention
    rows: tuple[DHRow, ...]
    joints: tuple[Joint, ...]
    coupling: np.ndarray = None  # type: ignore  # made below: its size is that of the rows
    world_from_base: Rigid = field(default_factory=lambda: Rigid())
    tools: Mapping[str, Rigid] = field(default_factory=lambda: {"": Rigid()})
    elasticity: Elasticity | None = None
    tree: Tree = field(default_factory=Tree)
    unusual_size: bool = False

    def __post_init__(self):
        where = f"robot {self.name}"
        require_fields(self, where)
        n, joints = len(self.rows), len(self.joints)
        if joints != n or n == 0:
            raise InputError("E-ROBOT-ENTRIES", f"{where}: {n} rows and {joints} joints, one row for each joint needed")
        require_millimetres(longest_link(self.rows), self.unusual_size, where)
        coupling = np.eye(n) if self.coupling is None else self.coupling  # None: not given
        object.__setattr__(self, "coupling", frozen(coupling, (n, n), f"{where}: coupling"))
        if np.linalg.cond(self.coupling) > 1e6:
            fault = f"{where}: the coupling matrix cannot be inverted"
            raise InputError("E-ROBOT-COUPLING", f"{fault}; a regular matrix needed")
        if self.elasticity is not None and (given := len(self.elasticity.moment)) != n:
            fault = f"{where}: elasticity of {given} joints, {n} needed, as many as rows"
            raise InputError("E-ROBOT-ENTRIES", fault)

    @classmethod
    def from_dh(
        cls,
        table: ArrayLike,
        convention: Convention,
        limits: ArrayLike | None = None,
        *,
        types: Sequence[JointType] = (),
        name: str = "robot",
    ) -> "Robot":
        """Returns the robot of a table of Denavit–Hartenberg parameters; warns of limits that seem to be degrees.

        ``table`` : (n, 4) a (mm), α (rad), d (mm), θ (rad) of each joint, from the base, and Hayati's β (rad);
        ``convention`` : of all rows, see :class:`DHRow`; ``limits`` : (n, 2) lowest and highest value of each joint,
        rad or mm, unlimited if not given; ``types`` : one for each joint, all revolute if not given; ``name`` : for
        messages and reports. Raises InputError: other shapes, and whatever :class:`Robot`, :class:`DHRow` and
        :class:`Joint` refuse.
        """
        where = f"robot {name}"
        rows = frozen(table, None, f"{where}: D-H table")
        if rows.ndim != 2 or rows.shape[1] not in (4, 5):
            fault = f"{where}: D-H table of shape {rows.shape}"
            raise InputError("E-ARRAY-SHAPE", f"{fault}; (n, 4) needed: a, alpha, d, theta")
        n = len(rows)
        ends = np.tile([-np.inf, np.inf], (n, 1)) if limits is None else np.asarray(limits, float)
        kinds = tuple(types) or ("revolute",) * n
        if ends.shape != (n, 2) or len(kinds) != n:
            fault = f"{where}: limits of shape {ends.shape}, types of {len(kinds)} joints"
            raise InputError("E-ARRAY-SHAPE", f"{fault}; ({n}, 2) and {n} needed")
        joints = tuple(map(Joint, kinds, *zip(*ends.tolist(), strict=True)))
        finite = np.where(np.isfinite(ends), ends, 0.0)
        warn_of_degrees(finite.T, np.array(kinds) == "revolute", f"{where}: limits")
        return cls(name, convention, tuple(DHRow(*row) for row in rows.tolist()), joints)

    @property
    def prismatic(self) -> np.ndarray:
        """(n,) of bool."""
        return np.array([joint.type == "prismatic" for joint in self.joints])

    @property
    def shown(self) -> np.ndarray:
        """(n,) factors from rad and mm to the units in which joint values are shown, degrees and mm."""
        return np.where(self.prismatic, 1.0, np.degrees(1.0))

    def limits(self) -> np.ndarray:
        """(n, 2) lowest and highest value of the controller, rad or mm."""
        return np.array([[joint.lower, joint.upper] for joint in self.joints])

    def tool(self, name: str = "") -> Rigid:
        """Returns flange_from_tool of the tool ``name``; raises InputError if there is no such tool."""
        if name not in self.tools:
            known = ", ".join(repr(t) for t in self.tools)
            raise InputError("E-ROBOT-NO-TOOL", f"robot {self.name}: no tool {name!r}; there are {known}")
        return self.tools[name]

    def loaded(self, payload_kg: float) -> "Robot":
        """Returns the robot with another mass at its flange, kg; raises InputError: a mass that no arm carries."""
        loaded(payload_kg, 1)
        if self.elasticity is None:
            return self
        return replace(self, elasticity=replace(self.elasticity, payload_kg=float(payload_kg)))

    def chain(self) -> "Chain":
        """Returns the fixed transforms in order, with the frames of joints at the pivots of the elasticity."""
        gaps, ends, elasticity = [], [], self.elasticity
        pivots = np.zeros((len(self.rows), 3)) if elasticity is None else elasticity.pivot
        for i, row in enumerate(self.rows):
            after, mount = self.tree.carrier(i)
            begin = (self.world_from_base if after < 0 else ends[after]) @ mount
            pivot = Rigid(translation=pivots[i])
            standard = self.convention == "standard"
            gaps.append(begin @ pivot if standard else begin @ across(row) @ pivot)
            ends.append(pivot.inverse() @ (along(row) @ across(row) if standard else along(row)))
        placed = Poses.of(gaps)
        chain = Chain(placed.rotation, placed.translation, tuple(ends), self.prismatic, self.coupling, None, self.tree)
        if elasticity is None:
            return chain
        first = self.world_from_base.inverse() @ gaps[0]
        moved = replace(
            elasticity,
            gravity=first.rotation.T @ elasticity.gravity,
            payload_centre=ends[chain.carrier("")] @ elasticity.payload_centre,
            pivot=np.zeros_like(pivots),
        )
        return replace(chain, elasticity=moved)


def longest_link(rows: Sequence[DHRow]) -> list[Length]:
    """Returns the longest ``a`` or ``d`` of the rows, and the longest ``a``, by which the unit of all is judged."""
    longest = []
    for names, least, most in (("ad", LEAST_LINK_MM, np.inf), ("a", 0.0, MOST_LINK_MM)):
        links = [(i, name, getattr(row, name)) for i, row in enumerate(rows, 1) for name in names]
        number, name, value = max(links, key=lambda link: abs(link[2]))
        longest.append(Length(f"the longest link, {name}_mm of joint {number},", value, least, most))
    return longest


@dataclass(frozen=True, slots=True, eq=False)
class Chain:
    """The fixed transforms of an arm, which are all that calibration changes; joints turn about or move along z.

    ``rotation``, ``translation`` : (n, 3, 3), (n, 3) of each joint's frame in that of the joint that carries it (the
    first: in the world); ``ends`` : (n,) of the rows in their joints' frames, the last one is a serial arm's flange;
    ``prismatic`` : (n,); ``coupling`` : (n, N), of all N values of the controller; ``elasticity`` : of the links;
    ``tree`` : empty of a serial arm; ``flange_joint`` : whose end is the flange, the last of a serial arm.
    """

    rotation: np.ndarray
    translation: np.ndarray
    ends: tuple[Rigid, ...]
    prismatic: np.ndarray
    coupling: np.ndarray
    elasticity: Elasticity | None = None
    tree: Tree = field(default_factory=Tree)
    flange_joint: int | None = None

    def __post_init__(self):
        n = len(self.prismatic)
        freeze(self, "rotation", (n, 3, 3), "chain")
        freeze(self, "translation", (n, 3), "chain")
        freeze(self, "prismatic", (n,), "chain", bool)
        freeze(self, "coupling", (n, None), "coupling")

    def __len__(self) -> int:
        return len(self.prismatic)

    def gap(self, i: int) -> Rigid:
        """Frame of joint ``i`` in that of the joint that carries it."""
        return Rigid(self.rotation[i], self.translation[i])

    def after(self, i: int) -> int:
        """The joint that carries joint ``i``; −1 for the world."""
        return self.tree.after(i)

    def carrier(self, target: str) -> int:
        """The joint that carries a target."""
        return self.tree.carriers.get(target, len(self) - 1)

    def carries(self, targets: Sequence[str]) -> np.ndarray:
        """(n, m) whether each joint moves each of the targets."""
        return self.behind()[:, [self.carrier(name) for name in targets]]

    def behind(self) -> np.ndarray:
        """(n, n) whether each joint carries each joint, or is it."""
        found = np.eye(len(self), dtype=bool)
        for i in range(len(self)):
            if self.after(i) >= 0:
                found[:, i] |= found[:, self.after(i)]
        return found

    def gathered(self, each: np.ndarray) -> np.ndarray:
        """Returns for every joint the sum, (n, …), over itself and the joints that it carries."""
        return np.tensordot(self.behind(), each, 1)

    def branch(self, tool: str) -> "Chain":
        """Returns the chain whose flange is the one that carries the tool; other branches stay, and bend it."""
        return replace(self, flange_joint=self.carrier(tool))

    def path(self) -> tuple[int, ...]:
        """The joints from the world to the flange; raises InputError for a tree, which has no one flange."""
        if self.flange_joint is None and self.tree:
            fault = "the robot is a tree of joints, which has no one flange"
            raise InputError("E-ROBOT-TREE", f"{fault}; a robot file of one arm needed")
        return self.tree.path(len(self) - 1 if self.flange_joint is None else self.flange_joint)

    def parameters(self) -> list[tuple[int, int]]:
        """Returns (joint, component) of the minimal parameters of the chain's axes; 0–5 are rx, ry, rz, tx, ty, tz:
        those that move the line, and of a prismatic joint its direction. With the six of one tool the set of 4 R + 2 P
        + 6 is complete, minimal and continuous (Zhuang, Roth & Hamano 1992; Okamura & Park 1996)."""
        return [(i, c) for i in range(len(self)) for c in ((0, 1) if self.prismatic[i] else (0, 1, 3, 4))]

    def moved(self, step: np.ndarray) -> "Chain":
        """Returns the chain after small motions along :meth:`parameters`, (k,)."""
        twist = np.zeros((len(self), 6))
        twist[tuple(np.array(self.parameters()).T)] = step
        turn = Rotation.from_rotvec(twist[:, :3]).as_matrix()
        translation = self.translation + np.einsum("nij,nj->ni", self.rotation, twist[:, 3:])
        rotation = self.rotation @ turn
        # One step of Newton's iteration for the polar factor removes rounding errors.
        rotation = 1.5 * rotation - 0.5 * rotation @ np.swapaxes(rotation, 1, 2) @ rotation
        return replace(self, rotation=rotation, translation=translation)


def about_z(angle: float) -> np.ndarray:
    """(3, 3) rotation about z."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def along(row: DHRow) -> Rigid:
    """Rz(θ) Tz(d)."""
    return Rigid(about_z(row.theta), [0.0, 0.0, row.d])


def across(row: DHRow) -> Rigid:
    """Tx(a) Rx(α) Ry(β) (the two first commute)."""
    ca, sa, cb, sb = np.cos(row.alpha), np.sin(row.alpha), np.cos(row.beta), np.sin(row.beta)
    tilt = np.array([[1.0, 0.0, 0.0], [0.0, ca, -sa], [0.0, sa, ca]])
    turn = np.array([[cb, 0.0, sb], [0.0, 1.0, 0.0], [-sb, 0.0, cb]])
    return Rigid(tilt @ turn, [row.a, 0.0, 0.0])


def mh80() -> Robot:
    """Returns an arm of the size and ranges of Yaskawa's Motoman MH80, from its data sheet, J3 not coupled."""
    rows = ((145, -90, 540, 0), (870, 0, 0, -90), (210, -90, 0, 0), (0, 90, 1025, 0), (0, -90, 0, 0), (0, 0, 175, 0))
    ranges = ((-180, 180), (-90, 155), (-80, 90), (-360, 360), (-125, 125), (-360, 360))
    return Robot(
        "MH80",
        "standard",
        tuple(DHRow(a, float(np.radians(alpha)), d, float(np.radians(theta))) for a, alpha, d, theta in rows),
        tuple(Joint("revolute", *np.radians(r).tolist()) for r in ranges),
    )
