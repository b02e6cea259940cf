"""Readers of tables with named columns, of the package and of other programs."""

from dataclasses import replace

import numpy as np

from stcal.errors import InputError
from stcal.handeye.data.formats.record import EVERY_FRAME, Content, Frames, Said, Side, Unit, require_each_once
from stcal.io.poses.columns import find_column, places_of, read_rotations
from stcal.io.table import LENGTHS, Table

TABLE = "table"
NAMES = (
    *("image", "image_name", "filename", "file", "name", "pose"),
    *("field.header.stamp", "header.stamp", "header_stamp", "timestamp", "stamp", "%time", "__time", "time_s", "time"),
)
"""Columns that name a row, in order of preference."""
NUMBERS = ("nr", "no", "number", "index", "id", "#")
"""Columns that name a row where no value occurs twice: elsewhere they number something else, such as the board."""


def todays(table: Table) -> bool:
    """True if the columns are those of the package's own tables: a place with its unit, and a quaternion."""
    prefixes = ("", *(f"{name}_" for name in EVERY_FRAME))
    placed = [prefix for prefix in prefixes if table.has(f"{prefix}x", LENGTHS)]
    return bool(placed) and all(f"{prefix}qw" in table for prefix in placed)


def read_columns(table: Table, key: str, statements: Said) -> Content | None:
    """Returns the poses in the columns of a table; None where it has none."""
    names, sides = _row_names(table, key), []
    for frame in EVERY_FRAME:
        side = _side(table, f"{frame}_", Frames(frame, f"by the columns {frame}_…"), names, statements)
        if side is not None:
            sides.append(side)
    if not sides:
        side = _side(table, "", None, names, statements)
        sides = [side] if side is not None else []
    if not sides:
        return None
    roles = [side.frames.role for side in sides if side.frames is not None]
    if len(set(roles)) < len(roles):
        both = ", ".join(side.frames.name for side in sides if side.frames is not None)
        raise InputError(
            "E-POSES-MIXED", f"{table.where}: columns of {both}; one of each side needed, take the others out"
        )
    return Content(f"{TABLE} ({table.form})" if table.form else TABLE, tuple(sides))


def _row_names(table: Table, key: str) -> tuple[str, ...]:
    """Returns image or time of each row, as text: nanoseconds have more digits than a float; empty without a column."""
    lower = {name.lower(): name for name in table.columns}
    column = next((name for name in (key, *NAMES) if name in table), None)
    column = column or next((lower[name] for name in NAMES if name in lower), None)
    if column is not None:
        values = tuple(table.text(column))
        require_each_once(values, places_of(table), table.where)
        return values
    number = next((lower[name] for name in NUMBERS if name in lower), None)
    if number is not None and len(set(table.text(number))) == len(table):
        return tuple(table.text(number))
    return ()


def _side(table: Table, prefix: str, frames: Frames | None, names: tuple[str, ...], statements: Said) -> Side | None:
    """Returns the poses in the columns that begin with a prefix; None where place or rotation is missing."""
    place = _place(table, prefix)
    if place is None:
        return None
    turned = read_rotations(table, prefix, statements.rotation)
    if turned is None:
        return None
    at, unit = place
    covariance = table.pose_covariances(prefix)
    side = Side(turned.rotation, at, places_of(table), turned.words, unit, frames, names)
    return replace(side, covariance=covariance, common=table.common_errors(covariance, prefix))


def _place(table: Table, prefix: str) -> tuple[np.ndarray, Unit | None] | None:
    for form in ("{}", "t{}", "p{}", "pos_{}", "{}_pos"):
        for unit in (*LENGTHS, ""):
            columns = [
                find_column(table, prefix, f"{form.format(axis)}_{unit}" if unit else form.format(axis))
                for axis in "xyz"
            ]
            present = [column for column in columns if column is not None]
            if len(present) == len("xyz"):
                values = np.column_stack([table.numbers(column) for column in present])
                return values, Unit(unit, "by the columns", True) if unit else None
            if present and unit and form == "{}":
                raise InputError(
                    "E-TABLE-COLUMN-MISSING",
                    f"{table.where}: {', '.join(present)} alone; x, y and z in one unit needed",
                )
    return None
