"""Reader of CSV files with columns of other programs: Euler angles, rotation vectors, exports of ROS bags."""

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stcal.errors import InputError
from stcal.handeye.data.formats.keys import role_of
from stcal.handeye.data.formats.record import (
    EVERY_FRAME,
    FRAMES,
    Content,
    Frames,
    Role,
    Said,
    Side,
    Unit,
    require_each_once,
)
from stcal.handeye.data.formats.single import ROS
from stcal.io.poses.columns import find_column, places_of, read_rotations
from stcal.io.poses.rotations import of_quaternions
from stcal.io.table import LENGTHS, Table

TABLE = "table"
NAMES = (
    *("image", "image_name", "filename", "file", "name", "pose"),
    *("field.header.stamp", "header.stamp", "header_stamp", "timestamp", "stamp", "%time", "__time", "time_s", "time"),
)
"""Columns that name a row, in order of preference."""
_MESSAGE = re.compile(r"(?P<of>.*?)[./_]?(?:position|translation)[./_]x", re.IGNORECASE)
_STAMP = (("secs", "nsecs"), ("sec", "nanosec"))


def todays(table: Table) -> bool:
    """True if the columns are those of the package's own tables: a place with its unit, and a quaternion."""
    prefixes = ("", *(f"{name}_" for name in EVERY_FRAME))
    return any(table.has(f"{prefix}x", LENGTHS) and f"{prefix}qw" in table for prefix in prefixes)


def read_columns(table: Table, text: str, key: str, said: Said) -> Content | None:
    """Returns the poses in the columns of a table; None where it has none.

    Raises
    ------
    InputError
        Some columns of a pose are missing, rotations are missing, one file holds several topics, or the convention must
        be stated.
    """
    messages = _messages(table)
    if messages:
        return _of_messages(table, messages, _row_names(table, text, key))
    names = _row_names(table, text, key)
    sides = []
    for frame in EVERY_FRAME:
        side = _side(table, f"{frame}_", Frames(frame, f"by the columns {frame}_…"), names, said)
        if side is not None:
            sides.append(side)
    if not sides:
        side = _side(table, "", None, names, said)
        sides = [side] if side is not None else []
    if not sides:
        return None
    roles = [side.frames.role for side in sides if side.frames is not None]
    if len(set(roles)) < len(roles):
        both = ", ".join(side.frames.name for side in sides if side.frames is not None)
        raise InputError(
            "E-POSES-MIXED", f"{table.where}: columns of {both}; one of each side needed, take the others out"
        )
    return Content(TABLE, tuple(sides))


def _row_names(table: Table, text: str, key: str) -> tuple[str, ...]:
    """Returns the image or time of each row as text, since nanoseconds have more digits than a float; empty where no
    column names the rows."""
    column = next((name for name in (key, *NAMES) if name in table), None)
    if column is None:
        lower = {name.lower(): name for name in table.columns}
        column = next((lower[name] for name in NAMES if name in lower), None)
    if column is not None:
        return _cells(text, column, table)
    for prefix in ("field.header.stamp.", "header.stamp.", "stamp."):
        for seconds, fractions in _STAMP:
            if f"{prefix}{seconds}" in table and f"{prefix}{fractions}" in table:
                whole, nanoseconds = (_cells(text, f"{prefix}{field}", table) for field in (seconds, fractions))
                return tuple(f"{s}.{n.zfill(9)}" for s, n in zip(whole, nanoseconds, strict=True))
    return ()


def _cells(text: str, column: str, table: Table) -> tuple[str, ...]:
    rows = [row for row in text.splitlines() if row.strip() and not row.lstrip().startswith("#")]
    cells = list(csv.reader(rows))
    at = [name.strip() for name in cells[0]].index(column)
    values = tuple(row[at].strip() for row in cells[1:])
    require_each_once(values, places_of(table), table.where)
    return values


@dataclass(frozen=True, slots=True)
class _Message:
    """``of`` : topic or field of the message; ``place``, ``turn`` : its columns, x, y, z and w, x, y, z."""

    of: str
    place: tuple[str, ...]
    turn: tuple[str, ...]


def _messages(table: Table) -> list[_Message]:
    """Returns the poses and transforms of ROS among the columns, as ``rostopic echo -p``, PlotJuggler and pandas name
    them."""
    messages = []
    for column in table.columns:
        match = _MESSAGE.fullmatch(column)
        if not match:
            continue
        place = tuple(f"{column[:-1]}{axis}" for axis in "xyz")
        stem = column[:-1].lower()
        for at, turn in (("position", "orientation"), ("translation", "rotation")):
            if at in stem:
                start = stem.rindex(at)
                head = column[:start] + turn + column[start + len(at) : -1]
                turned = tuple(f"{head}{axis}" for axis in "wxyz")
                missing = [name for name in (*place, *turned) if name not in table]
                if missing:
                    raise InputError(
                        "E-TABLE-COLUMN-MISSING", f"{table.where}: {column} without {missing[0]}; export the whole pose"
                    )
                messages.append(_Message(match["of"], place, turned))
    return messages


def _of_messages(table: Table, messages: Sequence[_Message], names: tuple[str, ...]) -> Content:
    sides = []
    for message in messages:
        role: Role | None = None
        if len(messages) > 1:
            said_by: list[Role | None] = [role_of(word) for word in re.split(r"[./]+", message.of) if word]
            role = next((named_role for named_role in said_by if named_role is not None), None)
        frames = Frames(FRAMES[role][0], f"by the topic {message.of}", False) if role else None
        places = places_of(table)
        rotation = of_quaternions(np.column_stack([table.numbers(c) for c in message.turn]), places, table.where)
        at = np.column_stack([table.numbers(c) for c in message.place])
        sides.append(Side(rotation, at, places, "quaternions x, y, z, w by name", ROS, frames, names))
    roles = [side.frames.role if side.frames else None for side in sides]
    if len(sides) > 1 and (None in roles or len(set(roles)) < len(roles)):
        topics = ", ".join(message.of for message in messages)
        raise InputError(
            "E-POSES-MIXED",
            f"{table.where}: poses of {len(messages)} topics, {topics}; export the robot's and the camera's each to a "
            "file of its own, and give --a and --b",
        )
    for column in ("field.header.frame_id", "header.frame_id", "field.child_frame_id", "child_frame_id"):
        if column in table and len(named_role := sorted(set(table.text(column)))) > 1:
            raise InputError(
                "E-POSES-MIXED",
                f"{table.where}: {column} is {', '.join(named_role[:3])}; export the rows of one of them alone",
            )
    return Content("ROS bag export", tuple(sides))


def _side(table: Table, prefix: str, frames: Frames | None, names: tuple[str, ...], said: Said) -> Side | None:
    """Returns the poses in the columns that begin with a prefix; None where place or rotation is missing."""
    place = _place(table, prefix)
    if place is None:
        return None
    at, unit = place
    turned = read_rotations(table, prefix, said.rotation)
    if turned is None:
        return None
    covariance = table.pose_covariances(prefix)
    return Side(turned.rotation, at, places_of(table), turned.words, unit, frames, names, covariance=covariance)


def _place(table: Table, prefix: str) -> tuple[np.ndarray, Unit | None] | None:
    for form in ("{}", "t{}", "p{}", "pos_{}", "{}_pos"):
        for unit in LENGTHS:
            columns = [find_column(table, prefix, f"{form.format(axis)}_{unit}") for axis in "xyz"]
            present = [column for column in columns if column is not None]
            if len(present) == len("xyz"):
                values = np.column_stack([table.numbers(column) for column in present])
                return values, Unit(unit, "by the columns", True)
            if present and form == "{}":
                raise InputError(
                    "E-TABLE-COLUMN-MISSING",
                    f"{table.where}: {', '.join(present)} alone; x, y and z in one unit needed",
                )
        columns = [find_column(table, prefix, form.format(axis)) for axis in "xyz"]
        present = [column for column in columns if column is not None]
        if len(present) == len("xyz"):
            return np.column_stack([table.numbers(column) for column in present]), None
    return None
