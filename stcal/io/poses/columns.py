"""Rotations in the columns of a table: names and conventions."""

import re
from dataclasses import dataclass

import numpy as np

from stcal.errors import InputError
from stcal.geometry.arrays import freeze
from stcal.io.poses.rotations import (
    ROTATION_VECTOR,
    Convention,
    convention_of,
    of_quaternions,
    proper,
    rotations,
    said_convention,
)
from stcal.io.table import ANGLES, Table

TRIPLES = {
    ("rx", "ry", "rz"): {"rad": "ur-rotvec"},
    ("a", "b", "c"): {"deg": "kuka-abc"},
    ("w", "p", "r"): {"deg": "fanuc-wpr"},
    ("o", "a", "t"): {"deg": "kawasaki-oat"},
    ("theta_x", "theta_y", "theta_z"): {"deg": "kinova"},
    ("roll", "pitch", "yaw"): {"deg": "rpy", "rad": "rpy"},
    ("rpy_roll", "rpy_pitch", "rpy_yaw"): {"deg": "rpy", "rad": "rpy"},
    ("q1", "q2", "q3", "q4"): {},
}
"""Default conventions of columns with these names, by the unit that follows the names; with another unit, or
none, the convention is open."""
NAMED_BY_AXES = [names for names in TRIPLES if names[0] in ("rx", "theta_x", "roll", "rpy_roll")]
_EULER = re.compile(r"euler_([xyz]{3}|[XYZ]{3})_1_(deg|rad)")


@dataclass(frozen=True, slots=True, eq=False)
class Turned:
    """Rotations (m, 3, 3) of a table's columns, and the convention in words; ``stated`` : True if the columns alone
    define it, without an option."""

    rotation: np.ndarray
    words: str
    columns: tuple[str, ...]
    stated: bool = True

    def __post_init__(self):
        freeze(self, "rotation", (len(self.rotation), 3, 3), "rotations")


def places_of(table: Table) -> tuple[str, ...]:
    """Return the place of each row, for messages."""
    return tuple(f"line {line}" for line in table.lines)


def find_column(table: Table, prefix: str, name: str) -> str | None:
    """Return the column of a name, also with capital letters; None if there is none."""
    wanted = f"{prefix}{name}"
    return wanted if wanted in table else next((c for c in table.columns if c.lower() == wanted.lower()), None)


def read_rotations(table: Table, prefix: str = "", rotation: str | None = None) -> Turned | None:
    """Return the rotations in the columns that begin with a prefix; None if there are none. ``rotation`` : name of the
    convention, from ``--rotation``, for angles whose columns leave it open."""
    places, where = places_of(table), table.where
    if f"{prefix}qw" in table or f"{prefix}qx" in table:
        table.has_rotation(prefix)
        columns = [prefix + name for name in table.quaternion_columns(prefix)]
        by_order = table.quaternions != "wxyz"
        words = "quaternions x, y, z, w by the order of their columns" if by_order else "quaternions by name"
        matrices = of_quaternions(np.column_stack([table.numbers(c) for c in columns]), places, where)
        return Turned(matrices, words, tuple(columns))
    for unit in ANGLES:
        columns = [f"{prefix}rotvec_{axis}_{unit}" for axis in "xyz"]
        if (values := _all(table, columns)) is not None:
            return Turned(*rotations(values, Convention(ROTATION_VECTOR, unit), places, where), tuple(columns))
    for column in table.columns:
        if column.startswith(prefix) and (euler := _EULER.fullmatch(column.removeprefix(prefix))):
            columns = [f"{prefix}euler_{euler[1]}_{i}_{euler[2]}" for i in (1, 2, 3)]
            if (values := _all(table, columns)) is not None:
                return Turned(*rotations(values, Convention(euler[1], euler[2]), places, where), tuple(columns))
    matrix = [f"{prefix}r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3)]
    if (values := _all(table, matrix)) is not None:
        return Turned(proper(values.reshape(-1, 3, 3), places, where), "3×3 matrices", tuple(matrix))
    return _by_convention(table, prefix, rotation)


def _all(table: Table, columns: list[str]) -> np.ndarray | None:
    """Return the values (m, k) of columns; None if all columns are missing, an error if only some are."""
    present = [column for column in columns if column in table]
    if not present:
        return None
    if len(present) < len(columns):
        missing = next(column for column in columns if column not in table)
        raise InputError(
            "E-TABLE-COLUMN-MISSING",
            f"{table.where}: {', '.join(present)} without {missing}; all {len(columns)} needed",
        )
    return np.column_stack([table.numbers(column) for column in columns])


def _columns(table: Table, prefix: str, names: list[str]) -> tuple[str, ...]:
    """Return the columns of these names, also with capital letters; none unless all are there."""
    columns = tuple(column for name in names if (column := find_column(table, prefix, name)) is not None)
    return columns if len(columns) == len(names) else ()


def _by_convention(table: Table, prefix: str, rotation: str | None) -> Turned | None:
    """Return rotations of three angles, a rotation vector or q1 … q4, by the convention of their names or the user."""
    for triple, stated in TRIPLES.items():
        for unit in (*ANGLES, "") if len(triple) == 3 else ("",):
            names = _columns(table, prefix, [f"{name}_{unit}" if unit else name for name in triple])
            if not names:
                continue
            what = "".join(triple) if len(triple[0]) == 1 else ", ".join(triple)
            if rotation is None and unit in stated:
                convention = convention_of(stated[unit])
            else:
                convention = said_convention(rotation, what, table.where, len(triple))
            says_unit = (rotation or "").endswith(tuple(f"-{name}" for name in ANGLES))  # a robot's name implies one
            if unit and says_unit and convention.unit not in ("", unit):
                raise InputError(
                    "E-OPTION-CONTRADICTS",
                    f"{table.where}: {names[0]} and --rotation {rotation} are of two units; correct one",
                )
            convention = Convention(convention.order, unit or convention.unit)
            values = np.column_stack([table.numbers(column) for column in names])
            turned, words = rotations(values, convention, places_of(table), table.where, triple in NAMED_BY_AXES)
            return Turned(turned, f"{', '.join(names)} as {words}", names, stated=False)
    return None


def fixed(value: float, digits: int) -> str:
    """Return a number with a fixed number of digits, and no minus before zero."""
    text = f"{value:.{digits}f}"
    return text.lstrip("-") if not text.strip("-0.") else text
