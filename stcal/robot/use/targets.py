"""Targets that a file commands, and checks that these and the nominal robot are plausible."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from stcal.errors import InputError
from stcal.explain import Candidate, explain
from stcal.geometry.arrays import Brief, freeze, require_fields
from stcal.geometry.rigid import Order, Poses, Rigid, other_axes
from stcal.io.poses.rotations import EXPLAINS, READINGS
from stcal.io.table import LENGTHS, UNIT_WORDS, Table, read_table
from stcal.robot.identification.adjustment import State, over_ranges, tips
from stcal.robot.kinematics.conditions import PAYLOAD, USUAL, Conditions, oriented, read_conditions, unread
from stcal.robot.kinematics.dh import FITS, TURNED_RAD, require_orientations
from stcal.robot.kinematics.forward import forward
from stcal.robot.kinematics.inverse import Inverse, inverse, reach_mm
from stcal.robot.kinematics.measurements import ORIENTATION, joint_values, targets_of, within
from stcal.robot.kinematics.robot_model import Robot

WHAT = "targets"
NAMES = ("pose", "image", "name", "scene", PAYLOAD)
"""Columns that name a pose. They are copied to the result if they exist."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Targets(Brief):
    """Target poses, one for each row of a file; given by joint values if the file has no poses.

    Parameters
    ----------
    where : the file, for messages.
    lines : (m,) its lines.
    tools : (m,) names.
    poses : base_from_tool, mm; None where joint values command.
    q : (m, n) array or None: commanded joint values, or those whose branch is wanted, rad or mm.
    names : of the columns :data:`NAMES` that are there, (m,) each.
    notes : on columns that were not read, and angles by their convention.
    conditions : what the flange carries.
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
        require_fields(self, "targets")
        if self.q is not None:
            freeze(self, "q", (len(self), None), "joint values")

    @classmethod
    def from_poses(
        cls, poses: Poses, q: ArrayLike | None = None, tools: Sequence[str] = (), where: str = "targets"
    ) -> "Targets":
        """Returns targets in memory.

        ``poses`` : m poses base_from_tool, mm; ``q`` : (m, n) joint values near to which the solutions are wanted, rad
        or mm; ``tools`` : (m,) names of the robot's tools; the only one if not given; ``where`` : source of the poses,
        for messages.

        Raises InputError: other numbers of joint values or tools.
        """
        m, values = len(poses), None if q is None else np.asarray(q, float)
        names = tuple(tools) or ("",) * m
        if len(names) != m or (values is not None and len(values) != m):
            raise InputError("E-NAMES-COUNT", f"{where}: {m} poses, other numbers of joint values or tools; {m} needed")
        return cls(where, range(1, m + 1), names, poses, values)

    def __len__(self) -> int:
        return len(self.lines)

    def __getitem__(self, rows: np.ndarray) -> "Targets":
        """Returns the targets of these indices."""
        return replace(
            self,
            lines=[self.lines[i] for i in rows],
            tools=tuple(self.tools[i] for i in rows),
            poses=None if self.poses is None else self.poses[rows],
            q=None if self.q is None else self.q[rows],
            names={column: tuple(own[i] for i in rows) for column, own in self.names.items()},
            conditions=self.conditions[rows],
        )

    def joints(self) -> np.ndarray:
        """Returns the commanded joint values (m, n), rad or mm. Raises an error if there are none."""
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
    """Reads commanded poses, or joint values that command them.

    Parameters
    ----------
    path : table (CSV; form: ``data_layout.md``).
    robot : the robot with the tools of the targets, and with the joints if joint values are given.
    quaternions : {"wxyz", "xyzw"}
        ``wxyz`` reads them by the names of their columns; ``xyzw`` takes x, y, z, w in the order of the columns.
    rotation : convention of angles, if their columns do not name it; see :func:`read_measurements`.
    payload_kg : mass at the flange in all rows, if there is no column ``payload_kg``.

    Returns
    -------
    Targets : base_from_tool, mm; joint values, rad or mm.

    Raises
    ------
    InputError : neither poses nor joint values, positions without orientation, angles whose convention is open, bad
        rows, masses that no arm carries; the message names the line.
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
    poses, columns, how_oriented = oriented(table, rotation) if has_poses else (None, (), ())
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
        how_oriented + unread(table, (*columns, PAYLOAD)),
        read_conditions(table, payload_kg),
    )


def poses_of(robot: Robot, targets: Targets, q: np.ndarray) -> Poses:
    """Returns base_from_tool of joint values (m, n), with each row's tool and load."""
    arm = State(replace(robot, world_from_base=Rigid()).chain(), {name: robot.tool(name) for name in targets.tools})
    return tips(arm, q, targets.tools, targets.conditions)


def joints_of(robot: Robot, targets: Targets, poses: Poses, near: np.ndarray | None) -> Inverse:
    """Returns joint values that bring each row's tool to ``poses``, near to ``near`` (m, n)."""
    m, mass = len(poses), targets.conditions.payload_kg
    alike: dict[tuple[str, float | None], list[int]] = {}
    for row, pair in enumerate(zip(targets.tools, [None] * m if mass is None else mass.tolist(), strict=True)):
        alike.setdefault(pair, []).append(row)
    q, status = np.empty((m, len(robot.rows))), np.empty(m, object)
    error_mm, error_rad = np.empty(m), np.empty(m)
    for (name, kg), own in alike.items():
        rows = np.array(own)
        part = inverse(robot, poses[rows], None if near is None else near[rows], name, kg)
        q[rows], status[rows] = part.q, part.status
        error_mm[rows], error_rad[rows] = part.error_mm, part.error_rad
    return Inverse(q, tuple(status), error_mm, error_rad)


UNITS = ("m", "in")
"""Possible units of columns of mm. In micrometres no arm would reach a pose, and cm differ by a factor of ten only."""
USUAL_SHARE = 0.01
"""Usual error as a share of the reach: ten times the manufacturing tolerance, or all zeros off by half a degree."""
SAMPLE = 50
"""Number of joint vectors at which two robots are compared."""
DOUBTED, LEAST, TRIED = 0.25, 4, 8
"""Share and number of targets out of reach from which others are tried, and number that these must all reach."""
INVERSE = "poses were inverse (base seen from the tool); give the tool in the base's frame"


def robots_apart(identified: Robot, nominal: Robot) -> str:
    """Returns a note if two files may be of different robots, by their flanges over the joints' ranges. Arms are made
    to a thousandth of their reach. Raises InputError: they cannot be of one robot."""
    ends = [""] if identified.tree is None else list(identified.tree.carriers)
    identified, nominal = (replace(each, tools=dict.fromkeys(ends, Rigid())) for each in (identified, nominal))
    q = over_ranges(identified, SAMPLE, ends[0])
    off = [forward(identified, q, end).translation - forward(nominal, q, end).translation for end in ends]
    apart, reach = max(map(_rms, off)), max(reach_mm(each, ends) for each in (identified, nominal))
    if apart <= USUAL_SHARE * reach:
        return ""
    said = (
        f"nominal robot {nominal.name} and identified robot {identified.name} are {apart:.4g} mm apart at the same "
        "joint values (RMS)"
    )
    if apart > FITS * reach:
        raise InputError(
            "E-ROBOT-MISMATCH",
            f"{said}, {FITS * reach:.3g} mm allowed, {FITS:.0%} of the reach: files of the same robot needed; check "
            "units, D-H rows, convention and coupling of both",
        )
    return (
        f"{said}, more than arms are off their drawing ({USUAL_SHARE:.0%} of the reach): are both files of this robot?"
    )


def on_targets(robot: Robot, targets: Targets) -> tuple[bool, tuple[str, ...]]:
    """Returns whether joint values beside the poses confirm them, and doubts about the poses of ``robot``.

    Raises InputError: joint values lead to the poses in another unit, convention or order of rows; the message says
    which.
    """
    if targets.poses is None:
        return True, ()
    if targets.q is None:
        return False, _near_base(robot, targets, targets.poses)
    reached, reach = poses_of(robot, targets, targets.q), reach_mm(robot, set(targets.tools))
    own = _rms(reached.translation - targets.poses.translation)
    if own <= FITS * reach:
        require_orientations(targets.where, targets.tools, reached.rotation, targets.poses.rotation, many=False)
    else:
        _explain(robot, targets, targets.poses, targets.q, own, reach)
    notes = _elsewhere(targets, targets.poses.difference(reached), reach)
    return not notes, notes + (_near_base(robot, targets, targets.poses) if notes else ())


def position_misfit_mm(robot: Robot, targets: Targets) -> float:
    """Returns the RMS distance between the positions that joint values reach and those of the poses of their rows."""
    if targets.poses is None:
        raise InputError("E-TARGETS-NO-POSES", f"{targets.where}: joint values without poses; columns x_mm … qz needed")
    return _rms(poses_of(robot, targets, targets.joints()).translation - targets.poses.translation)


def _rms(shift: np.ndarray) -> float:
    """Returns the RMS length of vectors (m, 3)."""
    return float(np.sqrt((shift**2).sum(axis=1).mean()))


def _explain(robot: Robot, targets: Targets, poses: Poses, q: np.ndarray, own: float, reach: float) -> None:
    """Refuses poses that joint values reach but for a frequent mistake; chance is 10⁻⁶ a row."""

    def misfit(case: tuple[Poses, np.ndarray]) -> float:
        off = case[0].difference(poses_of(robot, targets, case[1]))
        return np.inf if _rms(off[:, :3]) >= TURNED_RAD else _rms(off[:, 3:])

    for best, left in explain(_mistakes(robot, poses, q), misfit, min(FITS * reach, EXPLAINS * own))[:1]:
        raise InputError(
            "E-ROBOT-MISMATCH",
            f"{targets.where}: joint values of robot {robot.name} lead {own:.4g} mm (RMS) away from their poses, "
            f"{FITS * reach:.3g} mm allowed, {FITS:.0%} of the reach; but {left:.3g} mm if {best.words}",
        )


def _mistakes(robot: Robot, poses: Poses, q: np.ndarray) -> Iterator[Candidate]:
    """Yields frequent mistakes with the poses and the joint values that were meant."""
    turned = q * np.where(robot.prismatic, 1.0, np.degrees(1.0))  # degrees in columns of radians: told where read
    meant = [(f"lengths were {UNIT_WORDS[u]}; call the columns x_{u} …", LENGTHS[u] * poses.translation) for u in UNITS]
    meant += [
        (f"x, y, z were {names}; correct order and signs of the columns of positions", places)
        for names, places in other_axes(poses.translation)
    ]
    for words, places in meant:
        yield Candidate(words, partial(tuple, (Poses(poses.rotation, places), q)))
    yield Candidate(INVERSE, lambda: (poses.inverse(), q))
    radians = "joint values were radians in columns of degrees; call the columns q1_rad …"
    yield Candidate(radians, lambda: (poses, turned))


def _elsewhere(targets: Targets, off: np.ndarray, reach: float) -> tuple[str, ...]:
    """Returns a note on joint values that miss poses by (m, 6), unless they only choose a branch."""
    mm, rad = np.linalg.norm(off[:, 3:], axis=1), np.linalg.norm(off[:, :3], axis=1)
    away = (mm > FITS * reach) | (rad > TURNED_RAD)
    if not away.any() or targets.q is None or (len(off) > 1 and not np.ptp(targets.q, axis=0).any()):
        return ()
    return (
        f"joint values of {away.sum()} of {len(off)} rows, first line {targets.lines[int(away.argmax())]}, lead "
        f"elsewhere than their poses, by {np.median(mm[away]):.4g} mm and {np.degrees(np.median(rad[away])):.3g}° "
        "(median): they only choose the branch; if they are those of the poses, check order, units and conventions; if "
        "the poses are of the nominal robot's tool, give that robot with --nominal",
    )


def _near_base(robot: Robot, targets: Targets, poses: Poses) -> tuple[str, ...]:
    """Returns a note if all poses are so near the base's origin that metres or inches would also be within reach."""
    far = float(np.linalg.norm(poses.translation, axis=1).max())
    first_joint = replace(robot, world_from_base=Rigid()).chain().translation[0]
    reach = reach_mm(robot, set(targets.tools)) + float(np.linalg.norm(first_joint))
    fitting = [unit for unit in UNITS if 0 < far * LENGTHS[unit] <= reach]
    if not fitting:
        return ()
    unit = fitting[0]
    return (
        f"all targets lie within {far:.3g} mm of the base's origin, where no arm works that reaches {reach:.4g} mm: if "
        f"the unit of x, y, z is {UNIT_WORDS[unit]}, call the columns x_{unit} …",
    )


def out_of_reach(robot: Robot, targets: Targets, inverse: Inverse) -> tuple[str, ...]:
    """Returns a note if many poses are out of reach, and a sample of them is within reach in another convention."""
    lost = np.flatnonzero(~inverse.usable)
    if targets.poses is None or len(lost) < max(LEAST, DOUBTED * len(inverse)):
        return ()
    some = lost[np.unique(np.linspace(0, len(lost) - 1, TRIED).astype(int))]
    poses = targets.poses[some]
    guesses = {f"quaternions were {each.held}; {each.remedy}": each.poses(poses) for each in READINGS}
    guesses[INVERSE] = poses.inverse()
    for reason, meant in guesses.items():  # most fail at once: a pose out of reach takes a third of a second
        tried = (joints_of(robot, targets[some[[i]]], meant[[i]], inverse.q[some[[i]]]) for i in range(len(some)))
        if all(each.usable[0] for each in tried):
            return (
                f"{len(lost)} of {len(inverse)} poses are out of reach; {len(some)} of {len(some)} of these that were "
                f"tried would be within if {reason}",
            )
    return ()
