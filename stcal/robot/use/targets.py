"""Target poses commanded by a file, and the robot's poses and joint values for them, each row with its own tool."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from stcal.errors import InputError
from stcal.geometry.arrays import freeze
from stcal.geometry.rigid import Poses
from stcal.io.quaternions import Order
from stcal.io.table import LENGTHS, Table, read_table
from stcal.robot.kinematics.conditions import PAYLOAD, USUAL, Conditions, oriented, read_conditions, unread
from stcal.robot.kinematics.forward import forward
from stcal.robot.kinematics.inverse import Inverse, inverse
from stcal.robot.kinematics.measurements import ORIENTATION, joint_values, targets_of, within
from stcal.robot.kinematics.model import Robot

WHAT = "targets"
NAMES = ("pose", "image", "name", "scene", PAYLOAD)
"""Columns that say which pose a row is of, where they are there: kept in what is computed of it."""


@dataclass(frozen=True, slots=True, eq=False)
class Targets:
    """Target poses, one for each row of a file; given by joint values if the file has no poses.

    Parameters
    ----------
    where : str
        The file, for messages.
    lines : sequence of int
        (m,) its lines.
    tools : tuple of str
        (m,) names.
    poses : Poses or None
        base_from_tool, mm; None where joint values command.
    q : (m, n) array or None
        Commanded joint values, or those whose branch is wanted, rad or mm.
    names : dict
        Of the columns :data:`NAMES` that are there, (m,) each.
    notes : tuple of str
        On columns that were not read, and angles by their convention.
    conditions : Conditions
        What the flange carries.
    """

    where: str
    lines: Sequence[int]
    tools: tuple[str, ...]
    poses: Poses | None
    q: np.ndarray | None
    names: dict[str, tuple[str, ...]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    conditions: Conditions = USUAL

    def __post_init__(self):
        if self.q is not None:
            freeze(self, "q", (len(self), None), "joint values")

    def __len__(self) -> int:
        return len(self.lines)

    def __getitem__(self, rows: np.ndarray) -> "Targets":
        """Some of them, by their indices."""
        return Targets(
            self.where,
            [self.lines[i] for i in rows],
            tuple(self.tools[i] for i in rows),
            None if self.poses is None else self.poses[rows],
            None if self.q is None else self.q[rows],
            {column: tuple(own[i] for i in rows) for column, own in self.names.items()},
            self.notes,
            self.conditions[rows],
        )

    def joints(self) -> np.ndarray:
        """(m, n) commanded joint values, rad or mm; refused where there are none."""
        if self.q is None:
            raise InputError(
                "E-TARGETS-NO-JOINTS", f"{self.where}: poses without joint values; columns q1_deg … needed"
            )
        return self.q


def read_targets(
    path: str | Path | Table,
    robot: Robot,
    quaternions: Order = "wxyz",
    rotation: str | None = None,
    payload_kg: float | None = None,
) -> Targets:
    """Read commanded poses, or joint values that command them.

    Parameters
    ----------
    path : str or Path or Table
        Table (CSV; form: ``data_layout.md``).
    robot : Robot
        Whose tools they are of; its joints, where joint values are given.
    quaternions : {"wxyz", "xyzw"}
        As their columns are named, or x, y, z, w in the order in which these stand.
    rotation : str, optional
        Convention of angles whose columns do not say it, as of :func:`read_measurements`.
    payload_kg : float, optional
        Mass at the flange in all rows, where no column ``payload_kg`` says it.

    Returns
    -------
    Targets
        base_from_tool, mm; joint values, rad or mm.

    Raises
    ------
    InputError
        Neither poses nor joint values, positions without orientation, angles whose convention is open, bad rows, masses
        that no arm carries; the message names the line.
    """
    table = read_table(path, WHAT, quaternions)
    has_joints = any(name.startswith("q1_") for name in table.columns)
    has_poses = table.has("x", LENGTHS)
    if not has_poses and not has_joints:
        raise InputError(
            "E-TARGETS-NO-POSES",
            f"{table.where}: neither poses x_mm … qz nor joint values q1_deg …; commanded poses are needed; "
            f"the header is {table.header()}",
        )
    poses, columns, said = oriented(table, rotation) if has_poses else (None, (), ())
    if rotation is not None and not has_poses:
        raise InputError(
            "E-OPTION-NEEDS", f"{table.where}: --rotation {rotation}, but no positions with angles; leave it out"
        )
    if has_poses and poses is None:
        raise InputError(
            "E-TARGETS-NO-ORIENTATION", f"{table.where}: positions without orientation; {ORIENTATION} needed"
        )
    tools = targets_of(table)
    for line, tool in zip(table.lines, tools, strict=True):
        if tool not in robot.tools:
            known = ", ".join(repr(name) for name in robot.tools)
            raise InputError(
                "E-ROBOT-NO-TOOL",
                f"{table.where}: line {line}: target {tool!r} is not in robot {robot.name}; there are {known}",
            )
    if poses is not None:
        within(table, "position", poses.translation, "mm")
    return Targets(
        table.where,
        table.lines,
        tools,
        poses,
        joint_values(table, robot) if has_joints else None,
        {column: tuple(table.text(column)) for column in NAMES if column in table},
        said + unread(table, (*columns, PAYLOAD)),
        read_conditions(table, payload_kg),
    )


def rows_by_tool(targets: Targets) -> list[tuple[str, np.ndarray]]:
    """Names of tools, each with its rows."""
    names = np.array(targets.tools, dtype=object)
    return [(name, np.flatnonzero(names == name)) for name in dict.fromkeys(targets.tools)]


def rows_alike(targets: Targets) -> list[tuple[str, float | None, np.ndarray]]:
    """Names of tools and masses at the flange (None: the robot's), each two with their rows."""
    mass = targets.conditions.payload_kg
    if mass is None:
        return [(name, None, rows) for name, rows in rows_by_tool(targets)]
    return [
        (name, value, rows[mass[rows] == value])
        for name, rows in rows_by_tool(targets)
        for value in np.unique(mass[rows]).tolist()
    ]


def poses_of(robot: Robot, targets: Targets, q: np.ndarray) -> Poses:
    """base_from_tool of joint values (m, n), with each row's tool and load."""
    rotation, translation = np.empty((len(q), 3, 3)), np.empty((len(q), 3))
    for name, mass, rows in rows_alike(targets):
        part = forward(robot, q[rows], name, mass)
        rotation[rows], translation[rows] = part.rotation, part.translation
    return Poses(rotation, translation)


def joints_of(robot: Robot, targets: Targets, poses: Poses, near: np.ndarray | None) -> Inverse:
    """Joint values that bring each row's tool to ``poses``, near to ``near`` (m, n)."""
    m = len(poses)
    q, status = np.empty((m, len(robot.rows))), np.empty(m, object)
    error_mm, error_rad = np.empty(m), np.empty(m)
    for name, mass, rows in rows_alike(targets):
        part = inverse(robot, poses[rows], None if near is None else near[rows], name, mass)
        q[rows], status[rows] = part.q, part.status
        error_mm[rows], error_rad[rows] = part.error_mm, part.error_rad
    return Inverse(q, tuple(status), error_mm, error_rad)
