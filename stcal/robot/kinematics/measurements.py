"""Tables of joint values: with what an instrument measured there, and with the poses that they command."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Self, cast

import numpy as np
from numpy.typing import ArrayLike

from stcal.errors import InputError
from stcal.geometry.arrays import Array, Brief, freeze, frozen, require_fields
from stcal.geometry.rigid import Order, Poses
from stcal.io.table import ANGLES, COMMON, COVARIANCE, LENGTHS, POSE, Table, read_table
from stcal.robot.kinematics.inverse import reach_mm
from stcal.robot.kinematics.robot_model import (
    APPROACH,
    DIRECTIONS,
    MOST_KG,
    MOST_TURNS,
    PAYLOAD,
    USUAL,
    Conditions,
    Robot,
    loaded,
)

WHAT = "robot data"
STATUS, AMBIGUOUS = "status", "ambiguous"
"""Column ``status`` of ``stcal-sfm measure``, and its word for an undecided pose."""
LONGEST_TOOL_MM = 10_000.0  # longest possible tool, by which a target may be farther than the arm reaches
ORIENTED_BY = "columns qw, qx, qy, qz, or angles like w_deg, p_deg, r_deg,"


class JointTable(Brief):
    """Base of tables with a row for each joint vector; ``where`` : the file, ``notes`` on all of it."""

    __slots__ = ()
    where: str
    lines: Sequence[int]

    def __len__(self) -> int:
        return len(self.lines)

    def __getitem__(self, index) -> Self:
        """Returns rows by a mask, slice or list. Distances cannot be selected, as they refer to one another."""
        if getattr(self, "distances", None) is not None:
            fault = f"{self.where}: distances refer to other rows, so that rows cannot be left out"
            raise InputError("E-MEASURED-DISTANCES", fault)
        rows = np.arange(len(self))[index]

        def of(values: Any) -> Any:
            if isinstance(values, dict):
                return {column: of(own) for column, own in values.items()}
            if isinstance(values, np.ndarray | Poses | Conditions):
                return values[rows]
            return None if values is None else tuple(values[i] for i in rows)

        names = (each.name for each in fields(cast(Any, self)) if each.name not in ("where", "notes"))
        return replace(cast(Any, self), **{name: of(getattr(self, name)) for name in names})


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Measurements(JointTable):
    """Measurements of an instrument at m joint vectors: poses, positions, or distances between positions.

    Parameters
    ----------
    where : the file, for messages.
    lines : (m,) its lines.
    q : (m, n) array: values of the controller, rad or mm.
    targets : (m,) names of the reflector or target seen.
    positions : (m, 3) of the targets in the instrument's frame, mm; None where only distances were measured.
    rotations : (m, 3, 3) array, optional: instrument_from_target, where poses were measured.
    covariance : (m, 6, 6) array, optional: of the poses, rad and mm, left perturbation.
    common : (m, 6, r) common errors, contained in ``covariance``: pose i errs by ``common[i] @ z`` with the same r
        normal numbers z of σ 1 for all, and by itself.
    distances : (m,) array, optional: where only these were measured, mm.
    from_row : (m,) array of int, optional: row, from 0, at whose position each distance starts.
    stations : (m,) names of where the instrument stood: positions are in a frame of each; one where not given.
    notes : on rows of the file that are not here, columns that were not read, and angles by their convention.
    conditions : what the flange carried, and from where joints came.

    Raises InputError: arrays of other shapes, or with values that are not finite.
    """

    where: str
    lines: Sequence[int]
    q: Array
    targets: tuple[str, ...]
    positions: np.ndarray | None = None
    rotations: np.ndarray | None = None
    covariance: np.ndarray | None = None
    common: np.ndarray | None = None
    distances: np.ndarray | None = None
    from_row: np.ndarray | None = None
    stations: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    conditions: Conditions = USUAL

    def __post_init__(self):
        require_fields(self, "measurements")
        freeze(self, "q", (None, None), "joint values")
        m = len(self.q)
        object.__setattr__(self, "stations", self.stations or ("",) * m)
        shapes = {"positions": (3,), "rotations": (3, 3), "covariance": (6, 6), "common": (6, None), "distances": ()}
        for name, shape in shapes.items():
            if getattr(self, name) is not None:
                freeze(self, name, (m, *shape), name)
        if self.from_row is not None:
            freeze(self, "from_row", (m,), "rows", int)

    @classmethod
    def from_arrays(
        cls,
        q: ArrayLike,
        positions: ArrayLike | None = None,
        rotations: ArrayLike | None = None,
        *,
        poses: Poses | None = None,
        covariance: ArrayLike | None = None,
        targets: Sequence[str] = (),
        where: str = "measurements",
    ) -> "Measurements":
        """Returns measurements in memory.

        ``q``, ``positions``, ``rotations``, ``covariance`` : as the fields; ``poses`` : instrument_from_target, in
        place of positions and rotations; ``targets`` : (m,) names of the targets seen, the robot's only one if not
        given; ``where`` : source of the data, for messages. Raises InputError: neither positions nor poses, or arrays
        of other shapes.
        """
        if poses is not None:
            positions, rotations = poses.translation, poses.rotation
        if positions is None:
            raise InputError("E-MEASURED-KIND", f"{where}: neither positions (m, 3) nor poses; give one of them")
        values = frozen(q, (None, None), f"{where}: joint values")
        m = len(values)
        if targets and len(targets) != m:
            raise InputError("E-NAMES-COUNT", f"{where}: {len(targets)} names of targets for {m} rows; one each needed")
        given = (positions, rotations, covariance)
        places, turns, spread = (None if each is None else np.asarray(each, float) for each in given)
        return cls(where, range(1, m + 1), values, tuple(targets) or ("",) * m, places, turns, spread)

    def by_station(self) -> dict[str, np.ndarray]:
        """Returns a mask (m,) of the rows of each station, by name, the one with most rows first."""
        names = np.array(self.stations)
        found = {name: names == name for name in dict.fromkeys(self.stations)}
        return dict(sorted(found.items(), key=lambda item: -item[1].sum()))

    def _held(self, values: np.ndarray | None, code: str, needed: str) -> np.ndarray:
        if values is None:
            raise InputError(code, f"{self.where}: {needed} needed")
        return values

    def own_covariance(self) -> np.ndarray:
        """Returns the covariances (m, 6, 6) of the independent errors of poses, without the common ones."""
        every = self._held(self.covariance, "E-MEASURED-NO-COVARIANCE", "columns of the covariance")
        return every if self.common is None else every - self.common @ self.common.swapaxes(1, 2)

    def points(self) -> np.ndarray:
        """Returns the measured positions (m, 3), mm."""
        return self._held(self.positions, "E-MEASURED-DISTANCES", "positions, columns x_mm, y_mm, z_mm,")

    def poses(self) -> Poses:
        """Returns the measured poses world_from_tool."""
        return Poses(self._held(self.rotations, "E-MEASURED-NO-ORIENTATION", ORIENTED_BY), self.points())

    def lengths(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns the measured distances (m,), mm, and the rows (m,) at which they start."""
        needed = "E-MEASURED-KIND", "distances, column distance_mm,"
        return self._held(self.distances, *needed), self._held(self.from_row, *needed)


def read_measurements(
    path: str | Path | Table,
    robot: Robot,
    quaternions: Order = "wxyz",
    rotation: str | None = None,
    payload_kg: float | None = None,
) -> Measurements:
    """Reads joint values with positions, poses or distances.

    Poses whose ``status`` says that another pose fits the image as well, and copies of a row, are left out with a note.
    Another note names the columns that are not read.

    ``path`` : table (CSV; form: ``data_layout.md``); ``robot`` : the robot that was measured: its number and types of
    joints are needed, and its reach, to check positions; ``quaternions`` : ``wxyz`` reads them by the names of their
    columns, ``xyzw`` takes x, y, z, w in the order of the columns; ``rotation`` : convention of angles, if their
    columns do not name it: ``kuka-abc``, ``ZYX-deg``, ``rotvec`` … (``data_layout.md``); ``payload_kg`` : mass at the
    flange in all rows, if there is no column ``payload_kg``. Returns them in the instrument's frame; mm, rad.

    Raises InputError: missing columns, bad rows, joint values of another unit or number than the robot's, angles whose
    convention is open, masses that no arm carries; the message names the line.
    """
    table = read_table(path, WHAT, quaternions)
    q, targets = joint_values(table, robot), targets_of(table)
    conditions = read_conditions(table, payload_kg, q.shape[1])
    own, base = [PAYLOAD, *approach_columns(q.shape[1])], (table.where, table.lines, q, targets)
    if table.has("x", LENGTHS):
        poses, columns, said = oriented(table, rotation)
        covariance = None if poses is None else table.pose_covariances()
        places, turns, common = table.points(), None, None
        if poses is not None:
            turns, common = poses.rotation, table.common_errors(covariance)
        stations = tuple(table.text("station")) if "station" in table else ()
        notes = said + unread(table, (*columns, *own))
        given = places, turns, covariance, common
        data = Measurements(*base, *given, stations=stations, notes=notes, conditions=conditions)
        _require_in_reach(data, robot)
        return _usable(data, table)
    if not table.has("distance", LENGTHS):
        fault = f"{table.where}: neither x_mm, y_mm, z_mm nor distance_mm; what was measured is needed"
        header = f"the header is {table.header()}{table.open_unit('x', LENGTHS)}"
        raise InputError("E-MEASURED-KIND", f"{fault}; {header}")
    distances = table.quantity("distance", LENGTHS)
    if rotation is not None:
        fault = f"{table.where}: --rotation {rotation}, but distances have no orientation"
        raise InputError("E-OPTION-NEEDS", f"{fault}; leave it out")
    rows = table.numbers("from_row") if "from_row" in table else np.ones(len(table))
    nowhere, needed = (rows != rows.astype(int)) | (rows < 1) | (rows > len(rows)), f"1 … {len(rows)} needed"
    table.refuse(nowhere, "E-MEASURED-FROM-ROW", lambda i: f"from_row is {rows[i]:g}, {needed}")
    from_row = rows.astype(int) - 1
    missing = "distances start at the first row, which is missing, or at the row that column from_row names"
    table.refuse(
        (from_row == np.arange(len(table))) & (distances > 1e-3),
        "E-MEASURED-DISTANCES",
        lambda i: f"the distance of a position from itself is {distances[i]:.4g} mm, 0 needed: {missing}",
    )
    notes = unread(table, own)
    return Measurements(*base, distances=distances, from_row=from_row, notes=notes, conditions=conditions)


def targets_of(table: Table) -> tuple[str, ...]:
    """Returns the names (m,) of column ``target``, or of the robot's only target if there is no such column."""
    return tuple(table.text("target")) if "target" in table else ("",) * len(table)


def _require_in_reach(data: Measurements, robot: Robot) -> None:
    """Refuses positions farther from the middle one of their station than arm and tool allow."""
    reach = reach_mm(robot, robot.tools)
    for seen in (data[rows] for rows in data.by_station().values()):
        away = np.linalg.norm(seen.points() - np.median(seen.points(), axis=0), axis=1)
        worst = int(away.argmax())
        if away[worst] > 2 * reach + LONGEST_TOOL_MM:
            middle = f"from the middle of all (median {np.median(away):.4g} mm)"
            fault = f"{data.where}: line {seen.lines[worst]}: position is {away[worst]:.4g} mm {middle}"
            reaches = f"robot {robot.name} reaches {reach:.4g} mm"
            raise InputError("E-MEASURED-REACH", f"{fault}, {reaches}; correct it, or the unit of x, y, z")


def _usable(data: Measurements, table: Table) -> Measurements:
    """Removes ambiguous poses and copies of rows; a copy would count as an independent measurement."""
    undecided = np.array(table.text(STATUS) if STATUS in table else [""] * len(data)) == AMBIGUOUS
    names = np.unique(data.targets, return_inverse=True)[1]
    more = [each for each in (data.rotations, data.conditions.payload_kg) if each is not None]
    every = np.column_stack([data.q, names, data.points(), *(each.reshape(len(data), -1) for each in more)])
    copies = np.ones(len(data), bool)
    copies[np.unique(every, axis=0, return_index=True)[1]] = False
    reasons = {
        f"their {STATUS} is {AMBIGUOUS} (two poses fit the image); show a second face, come nearer, or measure with "
        "--previous": undecided,
        "copies of other rows": copies & ~undecided,
    }
    notes = [
        f"{gone.sum()} of {len(data)} rows left out, first line {data.lines[int(gone.argmax())]}: {reason}"
        for reason, gone in reasons.items()
        if gone.any()
    ]
    keep = ~(undecided | copies)
    if not keep.any():
        raise InputError("E-MEASURED-REACH", f"{data.where}: {notes[0]}")
    return replace(data[keep], notes=(*notes, *data.notes)) if notes else data


def joint_values(table: Table, robot: Robot) -> np.ndarray:
    """Returns the joint values (m, n) of columns ``q1_deg`` … (``_rad``; ``_mm``, ``_m`` for prismatic joints)."""
    n = len(robot.rows)
    if any(name.startswith(f"q{n + 1}_") for name in table.columns):
        fault = f"{table.where}: a column q{n + 1}_…, but robot {robot.name} has {n} joints"
        raise InputError("E-ROBOT-MISMATCH", f"{fault}; give its own file")
    units = [LENGTHS if sliding else ANGLES for sliding in robot.prismatic]
    q = np.column_stack([table.quantity(f"q{i}", units[i - 1]) for i in range(1, n + 1)])
    in_rad = [not robot.prismatic[i] and table.unit(f"q{i + 1}", units[i]) == "rad" for i in range(n)]
    many = in_rad & (np.abs(q) > 2 * np.pi * MOST_TURNS)

    def said(row: int) -> str:
        name, value = f"q{many[row].argmax() + 1}", q[row, many[row].argmax()]
        return f"{name}_rad is {value:g}, over {MOST_TURNS:g} turns; if these are degrees call the column {name}_deg"

    table.refuse(np.asarray(many.any(axis=1)), "E-JOINT-VALUE", said)
    return q


def read_conditions(table: Table, payload_kg: float | None = None, joints: int = 0) -> Conditions:
    """Reads payload, by column ``payload_kg`` or the argument, and columns ``approach1`` …; raises InputError."""
    mass = loaded(payload_kg, len(table)).payload_kg
    if PAYLOAD in table:
        if payload_kg is not None:
            fault = f"{table.where}: a column {PAYLOAD}, and --payload-kg {payload_kg:g}"
            raise InputError("E-OPTION-CONFLICT", f"{fault}; leave one of them out")
        mass = table.numbers(PAYLOAD)
        possible = (mass >= 0) & (mass <= MOST_KG)
        table.refuse(~possible, "E-PAYLOAD-VALUE", lambda i: f"{PAYLOAD} is {mass[i]:g}; 0 … {MOST_KG:g} needed")
    names, approach = approach_columns(joints), np.zeros((len(table), joints))
    for i, name in enumerate(names):
        if name in table:
            approach[:, i] = table.numbers(name)
    wrong = ~np.isin(approach, DIRECTIONS)

    def said(row: int) -> str:
        at = int(wrong[row].argmax())
        needed = "1 (the joint came from below), -1 (from above) or 0 (not known)"
        return f"{names[at]} is {approach[row, at]:g}; {needed} needed"

    table.refuse(np.asarray(wrong.any(axis=1)), "E-APPROACH-VALUE", said)
    return Conditions(mass, approach if any(name in table for name in names) else None)


def approach_columns(joints: int) -> list[str]:
    """Returns the columns of approach directions."""
    return [f"{APPROACH}{i}" for i in range(1, joints + 1)]


_UNITS = "|".join((*ANGLES, *LENGTHS))
_KNOWN = re.compile(
    rf"q\d+_({_UNITS})|([xyz]|distance)_({'|'.join(LENGTHS)})|{'|'.join((*POSE[3:], *COVARIANCE))}|{COMMON.pattern}|"
    "target|status|from_row|pose|image|name|scene|set|line|station|faces|circles|rms_px|chi2_per_dof|error_mm|"
    "error_deg|sigma_mm|(commanded|nominal)_.*"
)
"""Columns that robot commands and ``stcal-sfm measure`` write. No command reports them as unread."""


def oriented(table: Table, rotation: str | None = None) -> tuple[Poses | None, tuple[str, ...], tuple[str, ...]]:
    """Returns m poses (None without orientations), the columns of their angles, and a note that names the convention.
    ``rotation`` : convention of angles whose columns do not state it, as for ``--rotation``. Raises InputError: columns
    of a rotation are incomplete, or the convention is missing, or given without such columns or beside their own."""
    from stcal.io.rotations import read_rotations

    turned = None if table.has_rotation() else read_rotations(table, rotation=rotation)
    if rotation is not None and (turned is None or turned.stated):
        fault = f"{table.where}: no columns of angles that --rotation {rotation} is of"
        raise InputError("E-OPTION-NEEDS", f"{fault}; leave it out")
    if turned is None:
        return table.poses() if table.has_rotation() else None, (), ()
    columns = ", ".join(turned.columns)
    words = turned.words if turned.words.startswith(columns) else f"{columns} as {turned.words}"
    return Poses(turned.rotation, table.points()), turned.columns, (f"orientation: {words}",)


def unread(table: Table, read: Iterable[str] = ()) -> tuple[str, ...]:
    """Returns one note that lists the columns that are neither known nor in ``read``; no note if there are none."""
    ignored = [name for name in table.columns if name not in {*read} and not _KNOWN.fullmatch(name)]
    return (f"column{'s' * (len(ignored) > 1)} not read: {', '.join(ignored)}",) if ignored else ()


NAMES = ("pose", "image", "name", "scene", PAYLOAD)
"""Columns that name a pose. They are copied to the result if they exist."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Targets(JointTable):
    """Target poses, one for each row of a file; given by joint values if the file has no poses.

    ``where`` : the file, for messages; ``lines`` : (m,) its lines; ``tools`` : (m,) names; ``poses`` : base_from_tool,
    mm; None where joint values command; ``q`` : (m, n) array or None: commanded joint values, or those whose branch is
    wanted, rad or mm; ``names`` : of the columns :data:`NAMES` that are there, (m,) each; ``notes`` : on columns that
    were not read, and angles by their convention; ``conditions`` : what the flange carries.
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
        for what, given in (("tools", self.tools), ("poses", self.poses)):
            if given is not None and len(given) != len(self):
                fault = f"{self.where}: {len(given)} {what} for {len(self)} lines"
                raise InputError("E-NAMES-COUNT", f"{fault}; one each needed")
        if self.q is not None:
            freeze(self, "q", (len(self), None), "joint values")

    def joints(self) -> np.ndarray:
        """Returns the commanded joint values (m, n), rad or mm. Raises an error if there are none."""
        if self.q is None:
            fault = f"{self.where}: poses without joint values"
            raise InputError("E-TARGETS-NO-JOINTS", f"{fault}; columns q1_deg … needed")
        return self.q


def read_targets(
    path: str | Path | Table,
    robot: Robot,
    quaternions: Order = "wxyz",
    rotation: str | None = None,
    payload_kg: float | None = None,
) -> Targets:
    """Reads commanded poses, or joint values that command them.

    ``path`` : table (CSV; form: ``data_layout.md``); ``robot`` : the robot with the tools of the targets, and with the
    joints if joint values are given; ``quaternions``, ``rotation``, ``payload_kg`` : as of :func:`read_measurements`.
    Returns base_from_tool, mm; joint values, rad or mm.

    Raises InputError: neither poses nor joint values, positions without orientation, angles whose convention is open,
    bad rows, masses that no arm carries; the message names the line.
    """
    table = read_table(path, "targets", quaternions)
    has_joints = any(name.startswith("q1_") for name in table.columns)
    poses, columns, how_oriented = None, (), ()
    if table.has("x", LENGTHS):
        poses, columns, how_oriented = oriented(table, rotation)
        if poses is None:
            fault = f"{table.where}: positions without orientation"
            raise InputError("E-TARGETS-NO-ORIENTATION", f"{fault}; {ORIENTED_BY} needed")
    elif not has_joints:
        fault = f"{table.where}: neither poses x_mm … qz nor joint values q1_deg …; commanded poses are needed"
        raise InputError("E-TARGETS-NO-POSES", f"{fault}; the header is {table.header()}")
    elif rotation is not None:
        fault = f"{table.where}: --rotation {rotation}, but no positions with angles"
        raise InputError("E-OPTION-NEEDS", f"{fault}; leave it out")
    tools, known = targets_of(table), ", ".join(map(repr, robot.tools))
    unknown = np.array([tool not in robot.tools for tool in tools])
    said = f"is not in robot {robot.name}; there are {known}"
    table.refuse(unknown, "E-ROBOT-NO-TOOL", lambda i: f"target {tools[i]!r} {said}")
    q = joint_values(table, robot) if has_joints else None
    names = {column: tuple(table.text(column)) for column in NAMES if column in table}
    notes, conditions = how_oriented + unread(table, (*columns, PAYLOAD)), read_conditions(table, payload_kg)
    return Targets(table.where, table.lines, tools, poses, q, names, notes, conditions)
