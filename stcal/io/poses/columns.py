"""Rotations in the columns of a table: quaternions, rotation vectors, Euler angles, matrices."""

import re
from dataclasses import dataclass

import numpy as np

from stcal.errors import InputError
from stcal.geometry.arrays import frozen
from stcal.io.poses.rotations import (
    ROTATION_VECTOR,
    Convention,
    convention_of,
    of_quaternions,
    proper,
    rotations,
    said_convention,
    turned_values,
)
from stcal.io.quaternions import COLUMNS as QUATERNION
from stcal.io.table import ANGLES, Table

TRIPLES = {
    ("rx", "ry", "rz"): {"rad": "ur-rotvec"},
    ("a", "b", "c"): {"deg": "kuka-abc"},
    ("w", "p", "r"): {"deg": "fanuc-wpr"},
    ("o", "a", "t"): {"deg": "kawasaki-oat"},
    ("roll", "pitch", "yaw"): {"deg": "rpy", "rad": "rpy"},
    ("rpy_roll", "rpy_pitch", "rpy_yaw"): {"deg": "rpy", "rad": "rpy"},
}
"""Names of three columns, and by the unit that follows them the convention that they have where none is said; with
another unit, or none, it is open."""
BY_AXIS = (("rx", "ry", "rz"), ("roll", "pitch", "yaw"), ("rpy_roll", "rpy_pitch", "rpy_yaw"))
_EULER = re.compile(r"euler_([xyz]{3}|[XYZ]{3})_1_(deg|rad)")


@dataclass(frozen=True, slots=True, eq=False)
class Turned:
    """``rotation`` : (m, 3, 3); ``words`` : how they are written; ``columns`` : in which; ``stated`` : by these,
    and by no option."""

    rotation: np.ndarray
    words: str
    columns: tuple[str, ...]
    stated: bool = True

    def __post_init__(self):
        object.__setattr__(self, "rotation", frozen(self.rotation, (len(self.rotation), 3, 3), "rotations"))


def places_of(table: Table) -> tuple[str, ...]:
    """Of each row, for messages."""
    return tuple(f"line {line}" for line in table.lines)


def find_column(table: Table, prefix: str, name: str) -> str | None:
    """A column by its name, in capital letters too."""
    return next((c for c in (f"{prefix}{name}", f"{prefix}{name.upper()}") if c in table), None)


def read_rotations(table: Table, prefix: str = "", rotation: str | None = None) -> Turned | None:
    """Rotations in the columns that begin with a prefix; None where there are none.

    ``rotation`` : name of the convention, as of ``--rotation``, for angles whose columns do not say it.

    Raises
    ------
    InputError
        Some columns of a rotation only, none that is one, or a convention that must be said.
    """
    places, where = places_of(table), table.where
    if f"{prefix}qw" in table or f"{prefix}qx" in table:
        table.has_rotation(prefix)
        standing = [c for c in table.columns if c in {prefix + q for q in QUATERNION}]
        by_order = table.quaternions != "wxyz"
        columns = [standing[3], *standing[:3]] if by_order else [prefix + q for q in QUATERNION]
        words = "quaternions x, y, z, w by the order of their columns" if by_order else "quaternions by name"
        found = of_quaternions(np.column_stack([table.numbers(c) for c in columns]), places, where)
        return Turned(found, words, tuple(columns))
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
    return _triple(table, prefix, rotation) or _four(table, prefix, rotation)


def _all(table: Table, columns: list[str]) -> np.ndarray | None:
    """(m, k) of columns; None where one of them is missing from the first on, an error where a later one is."""
    there = [column for column in columns if column in table]
    if not there:
        return None
    if len(there) < len(columns):
        missing = next(column for column in columns if column not in table)
        raise InputError(
            "E-TABLE-COLUMN-MISSING", f"{table.where}: {', '.join(there)} without {missing}; all {len(columns)} needed"
        )
    return np.column_stack([table.numbers(column) for column in columns])


def _triple(table: Table, prefix: str, rotation: str | None) -> Turned | None:
    """Three angles, or a vector, of the convention that their names say, or the user."""
    for triple, named in TRIPLES.items():
        for unit in (*ANGLES, ""):
            columns = [find_column(table, prefix, f"{name}_{unit}" if unit else name) for name in triple]
            found = tuple(column for column in columns if column is not None)
            if len(found) < len(triple):
                continue
            what = ", ".join(triple) if triple in BY_AXIS else "".join(triple)
            if rotation is None and unit in named:
                convention = convention_of(named[unit])
            else:
                convention = said_convention(rotation, what, table.where)
            if unit and convention.unit not in ("", unit) and "-" in (rotation or "") and _own_unit(rotation):
                raise InputError(
                    "E-OPTION-CONTRADICTS",
                    f"{table.where}: {found[0]} and --rotation {rotation} are of two units; correct one",
                )
            convention = Convention(convention.order, unit or convention.unit)
            values = np.column_stack([table.numbers(column) for column in found])
            turned, words = rotations(values, convention, places_of(table), table.where, triple in BY_AXIS)
            return Turned(turned, f"{', '.join(found)} as {words}", found, stated=False)
    return None


def _four(table: Table, prefix: str, rotation: str | None) -> Turned | None:
    """Quaternions of unnamed order."""
    columns = [find_column(table, prefix, f"q{i}") for i in (1, 2, 3, 4)]
    found = tuple(column for column in columns if column is not None)
    if len(found) < len(columns):
        return None
    values = np.column_stack([table.numbers(column) for column in found])
    turned, words = turned_values(values, rotation, "q1, q2, q3, q4", places_of(table), table.where)
    return Turned(turned, words, found, stated=False)


def _own_unit(rotation: str | None) -> bool:
    """Whether the user wrote a unit, and not a robot's name that has one."""
    return (rotation or "").endswith(tuple(f"-{unit}" for unit in ANGLES))
