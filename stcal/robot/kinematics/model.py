"""What a robot is: Denavit–Hartenberg rows, joints with limits and coupling, base and tools.

Both conventions and Hayati's extension are one chain: a fixed transform to the frame of each joint, in which the
joint turns about z or moves along it, and a fixed transform from the last joint to the flange.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from stcal.errors import InputError
from stcal.geometry.arrays import frozen
from stcal.geometry.rigid import Rigid

Convention = Literal["standard", "modified"]
JointType = Literal["revolute", "prismatic"]


@dataclass(frozen=True, slots=True)
class DHRow:
    """One row of Denavit–Hartenberg parameters, with Hayati's β for nearly parallel axes.

    Standard: Rz(θ+q) Tz(d) Tx(a) Rx(α) Ry(β). Modified: Rx(α) Tx(a) Ry(β) Rz(θ+q) Tz(d), α and a being those before the
    joint. A prismatic joint adds its value to d in place of θ.

    Parameters
    ----------
    a : float
        Length of the common normal, mm.
    alpha : float
        Twist about it, rad.
    d : float
        Offset along the joint's axis, mm.
    theta : float
        Angle about the joint's axis where the joint's value is 0, rad.
    beta : float
        Second twist, about y, rad; 0 in rows of Denavit and Hartenberg proper.

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


@dataclass(frozen=True, slots=True)
class Joint:
    """Type of a joint, and the range of its value.

    Parameters
    ----------
    type : {"revolute", "prismatic"}
        Whether it turns about its axis or slides along it.
    lower, upper : float
        Limits of the controller's value, rad or mm; unlimited where not given.
    fixed : mapping of str to str
        Dimensions of the joint's row, by the names of :class:`DHRow`, that no identification changes, and why.
    """

    type: JointType = "revolute"
    lower: float = -np.inf
    upper: float = np.inf
    fixed: Mapping[str, str] = field(default_factory=dict, hash=False)


@dataclass(frozen=True, slots=True, eq=False)
class Elasticity:
    """What turns the links of n joints by a little more than the joints do: gravity, and gears.

    What joint i carries pulls with the torque T = M × g about its place, M being the sum of the moments of its link and
    of all links after it, each as it is turned. The link gives way by the rotation c T, with one c about the joint's
    axis and another across it. Gears add an angle with one and two periods a turn of the joint.

    Parameters
    ----------
    compliance : (n, 2) array
        rad/(N m): about the joint's axis, and across it.
    moment : (n, 3) array
        N m: weight of the link times the vector from the joint to its centre of mass, what follows being put at the
        next joint; in the frame of the joint that has moved. Of compliance and moment, poses show the products alone.
    periodic : (n, 4) array
        rad: of sin q, cos q, sin 2q, cos 2q of revolute joints.
    gravity : (3,) array
        Its direction, of length 1: in the base of a robot, in the first joint's frame of a :class:`Chain`.

    Raises
    ------
    InputError
        Arrays of other shapes; a direction that is 0.
    """

    compliance: np.ndarray
    moment: np.ndarray
    periodic: np.ndarray
    gravity: np.ndarray

    def __post_init__(self):
        n = len(self.compliance)
        for name, shape in (("compliance", (n, 2)), ("moment", (n, 3)), ("periodic", (n, 4)), ("gravity", (3,))):
            object.__setattr__(self, name, frozen(getattr(self, name), shape, f"elasticity: {name}"))
        length = float(np.linalg.norm(self.gravity))
        if length == 0:
            raise InputError("elasticity: gravity is [0, 0, 0]; a direction in the base needed, such as [0, 0, -1]")
        object.__setattr__(self, "gravity", frozen(self.gravity / length, (3,), "elasticity: gravity"))


@dataclass(frozen=True, slots=True, eq=False)
class Robot:
    """A serial arm of n joints.

    Parameters
    ----------
    name : str
        For messages and reports.
    convention : {"standard", "modified"}
        Of all rows; see :class:`DHRow`.
    rows : tuple of DHRow
        One for each joint, from the base; mm, rad.
    joints : tuple of Joint
        One for each row: type and range.
    coupling : (n, n) array, optional
        Kinematic joint values from the controller's, a regular matrix; the identity if not given.
    world_from_base : Rigid
        Base in the frame of the measuring instrument, mm.
    tools : mapping of str to Rigid
        flange_from_tool by name, mm; ``""`` is the one meant where none is named.
    elasticity : Elasticity, optional
        Rigid if not given.

    Raises
    ------
    InputError
        Rows and joints differ in number, or there are none; a coupling matrix of another shape, or a singular one.
    """

    name: str
    convention: Convention
    rows: tuple[DHRow, ...]
    joints: tuple[Joint, ...]
    coupling: np.ndarray = None  # pyright: ignore[reportAssignmentType]  # made below: its size is that of the rows
    world_from_base: Rigid = field(default_factory=lambda: Rigid())
    tools: Mapping[str, Rigid] = field(default_factory=lambda: {"": Rigid()})
    elasticity: Elasticity | None = None

    def __post_init__(self):
        n = len(self.rows)
        if len(self.joints) != n or n == 0:
            raise InputError(
                f"robot {self.name}: {n} rows and {len(self.joints)} joints, one row for each joint needed"
            )
        coupling = np.eye(n) if self.coupling is None else self.coupling  # None: not given
        object.__setattr__(self, "coupling", frozen(coupling, (n, n), f"robot {self.name}: coupling"))
        if np.linalg.cond(self.coupling) > 1e6:
            raise InputError(f"robot {self.name}: the coupling matrix cannot be inverted; a regular matrix needed")
        if self.elasticity is not None and len(self.elasticity.moment) != n:
            raise InputError(
                f"robot {self.name}: elasticity of {len(self.elasticity.moment)} joints, {n} needed, as many as rows"
            )

    @property
    def prismatic(self) -> np.ndarray:
        """(n,) of bool."""
        return np.array([joint.type == "prismatic" for joint in self.joints])

    def limits(self) -> np.ndarray:
        """(n, 2) lowest and highest value of the controller, rad or mm."""
        return np.array([[joint.lower, joint.upper] for joint in self.joints])

    def tool(self, name: str = "") -> Rigid:
        """flange_from_tool of the tool ``name``; InputError where there is none."""
        if name not in self.tools:
            known = ", ".join(repr(t) for t in self.tools)
            raise InputError(f"robot {self.name}: no tool {name!r}; there are {known}")
        return self.tools[name]

    def chain(self) -> "Chain":
        """The fixed transforms in order."""
        n = len(self.rows)
        gaps = [self.world_from_base]
        for i, row in enumerate(self.rows):
            if self.convention == "modified":
                gaps[i] = gaps[i] @ across(row)
                gaps.append(along(row))
            else:
                gaps.append(along(row) @ across(row))
        rotation, translation = np.array([g.rotation for g in gaps]), np.array([g.translation for g in gaps])
        elasticity = self.elasticity
        if elasticity is not None:
            first = self.world_from_base.inverse() @ gaps[0]
            elasticity = replace(elasticity, gravity=first.rotation.T @ elasticity.gravity)
        return Chain(rotation[:n], translation[:n], gaps[n], self.prismatic, self.coupling, elasticity)


@dataclass(frozen=True, slots=True, eq=False)
class Chain:
    """Fixed transforms of a serial arm: everything that calibration changes.

    ``rotation``, ``translation`` : (n, 3, 3), (n, 3) of each joint's frame in the one before (the first: in the world);
    ``last_from_flange`` : flange in the frame of the last joint; ``prismatic`` : (n,); ``coupling`` : (n, n).
    Joint values turn about, or move along, z of the joint's frame; ``elasticity`` : what links give way by.
    """

    rotation: np.ndarray
    translation: np.ndarray
    last_from_flange: Rigid
    prismatic: np.ndarray
    coupling: np.ndarray
    elasticity: Elasticity | None = None

    def __post_init__(self):
        n = len(self.prismatic)
        object.__setattr__(self, "rotation", frozen(self.rotation, (n, 3, 3), "chain"))
        object.__setattr__(self, "translation", frozen(self.translation, (n, 3), "chain"))
        object.__setattr__(self, "prismatic", frozen(self.prismatic, (n,), "chain", bool))
        object.__setattr__(self, "coupling", frozen(self.coupling, (n, n), "coupling"))

    def __len__(self) -> int:
        return len(self.prismatic)

    def gap(self, i: int) -> Rigid:
        """Frame of joint ``i`` in the one before."""
        return Rigid(self.rotation[i], self.translation[i])


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
