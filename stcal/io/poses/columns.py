"""Poses in the columns of a table: names, conventions, matrices element by element, and mappings for other programs."""

import csv
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from stcal.errors import InputError
from stcal.geometry.arrays import freeze
from stcal.geometry.rigid import Order
from stcal.io.files import TABLE_BYTES, read_bytes
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
from stcal.io.table import ANGLES, LENGTHS, Table, is_comment
from stcal.io.toml import Strict, load_toml

ROTATION, PLACE, LAST = 9, 3, 4
"""Elements of the rotation, of the translation, and of the row 0 0 0 1."""
_OPEN, _BETWEEN, _CLOSE = r"[\s_.\[({]*", r"[\s_.,;\[\](){}]*", r"[\s\])}]*"
_UNIT = rf"(?:_(?P<unit>{'|'.join(LENGTHS)}))?"
_ELEMENT = re.compile(rf"(?P<stem>.*?[A-Za-z]){_OPEN}(?P<row>[0-4]){_BETWEEN}(?P<column>[0-4]){_CLOSE}{_UNIT}")
"""``m03``, ``r14``, ``T_0_3``, ``T[0][3]``, ``T(1,4)``, ``T_03_mm``."""
_OF_VECTOR = re.compile(rf"(?P<stem>.*?[A-Za-z]){_OPEN}(?P<row>[0-3]){_CLOSE}{_UNIT}")
"""``t1``, ``t[0]``, ``tvec_2``, ``t_1_mm``."""
_TURN = re.compile(r"(?P<head>.*?)(?:r|rot|rotation|rmat)", re.IGNORECASE)
"""Name of a rotation whose translation has a name of its own, with the same beginning."""
_TRANSLATIONS = ("t", "p", "tvec", "trans", "translation", "pos", "position")


@dataclass(frozen=True, slots=True)
class MatrixColumns:
    """Columns of one matrix.

    ``stem`` : the beginning of their names; ``rotation`` : 9 columns, row by row; ``translation`` : 3 columns, or none
    where the matrices are 3×3; ``last`` : 4 columns of the row 0 0 0 1, or none; ``unit`` of the translation, empty
    where the columns do not state it.
    """

    stem: str
    rotation: tuple[str, ...]
    translation: tuple[str, ...] = ()
    last: tuple[str, ...] = ()
    unit: str = ""

    def rotations(self, table: Table) -> np.ndarray:
        """Return the rotations (m, 3, 3) as given in the table."""
        return _numbers(table, self.rotation).reshape(-1, 3, 3)

    def matrices(self, table: Table) -> np.ndarray:
        """Return the matrices (m, 4, 4) as given in the table; a missing row 0 0 0 1 is added."""
        found = np.tile(np.eye(4), (len(table), 1, 1))
        found[:, :3, :3], found[:, :3, 3] = self.rotations(table), _numbers(table, self.translation)
        if self.last:
            found[:, 3] = _numbers(table, self.last)
        return found


def find_matrices(table: Table, prefix: str = "") -> list[MatrixColumns]:
    """Return the matrices whose columns begin with a prefix, in the order of the table.

    Rows and columns count from 0 or from 1. A matrix is 4×4, 3×4, or 3×3 with the translation in columns of its own
    (``r11`` … ``r33``, ``t1`` … ``t3``) or elsewhere.

    Raises InputError: the three columns of a translation state different units.
    """
    stems: dict[str, dict[tuple[int, int], str]] = {}
    vectors: dict[str, dict[int, str]] = {}
    names: dict[str, str] = {}
    units: dict[str, str] = {}
    for column in table.columns:
        if not column.startswith(prefix):
            continue
        name = column.removeprefix(prefix)
        if element := _ELEMENT.fullmatch(name):
            names.setdefault(element["stem"].lower(), element["stem"])
            stems.setdefault(element["stem"].lower(), {})[int(element["row"]), int(element["column"])] = column
            units[column] = element["unit"] or ""
        elif part := _OF_VECTOR.fullmatch(name):
            vectors.setdefault(part["stem"].lower(), {})[int(part["row"])] = column
            units[column] = part["unit"] or ""
    found = []
    for stem, elements in ((names[lower], elements) for lower, elements in stems.items()):
        first = min(min(place) for place in elements)
        by_place = {(row - first, column - first): name for (row, column), name in elements.items()}
        matrix = _matrix(stem, by_place) or _with_vector(stem, by_place, vectors)
        if matrix is not None:
            found.append(_with_unit(matrix, units, table.where))
    return found


def _matrix(stem: str, by_place: dict[tuple[int, int], str]) -> MatrixColumns | None:
    """Return a matrix 4×4 or 3×4; None where elements are missing or left over."""
    rows = 4 if len(by_place) == ROTATION + PLACE + LAST else 3
    wanted = [(i, j) for i in range(rows) for j in range(4)]
    if set(by_place) != set(wanted):
        return None
    rotation = tuple(by_place[i, j] for i in range(3) for j in range(3))
    last = tuple(by_place[3, j] for j in range(4)) if rows == 4 else ()
    return MatrixColumns(stem, rotation, tuple(by_place[i, 3] for i in range(3)), last)


def _with_vector(
    stem: str, by_place: dict[tuple[int, int], str], vectors: dict[str, dict[int, str]]
) -> MatrixColumns | None:
    """Return a 3×3 matrix with its translation, or without one if no translation has a matching name."""
    wanted = [(i, j) for i in range(3) for j in range(3)]
    if set(by_place) != set(wanted):
        return None
    rotation, turn = tuple(by_place[place] for place in wanted), _TURN.fullmatch(stem)
    names = [f"{turn['head']}{name}".lower() for name in _TRANSLATIONS] if turn else []
    for vector in (vectors[name] for name in names if name in vectors):
        indices = sorted(vector)
        if len(indices) == PLACE and indices[-1] - indices[0] == PLACE - 1:
            return MatrixColumns(stem, rotation, tuple(vector[i] for i in indices))
    return MatrixColumns(stem, rotation)


def _with_unit(matrix: MatrixColumns, units: dict[str, str], where: str) -> MatrixColumns:
    stated = {units[column] for column in matrix.translation}
    if len(stated) > 1:
        raise InputError(
            "E-POSES-UNITS", f"{where}: {', '.join(matrix.translation)} state different units; one for all three needed"
        )
    return MatrixColumns(matrix.stem, matrix.rotation, matrix.translation, matrix.last, next(iter(stated), ""))


def _numbers(table: Table, columns: tuple[str, ...]) -> np.ndarray:
    return np.column_stack([table.numbers(column) for column in columns])


TRIPLES = {
    ("rx", "ry", "rz"): {"rad": "ur-rotvec"},
    ("a", "b", "c"): {"deg": "kuka-abc"},
    ("w", "p", "r"): {"deg": "fanuc-wpr"},
    ("o", "a", "t"): {"deg": "kawasaki-oat"},
    ("theta_x", "theta_y", "theta_z"): {"deg": "kinova"},
    ("roll", "pitch", "yaw"): {"deg": "rpy", "rad": "rpy"},
    ("rpy_roll", "rpy_pitch", "rpy_yaw"): {"deg": "rpy", "rad": "rpy"},
}
"""Default conventions of columns with these three names, by the unit that follows the names; with another unit, or
none, the convention is open."""
BY_AXIS = (
    ("rx", "ry", "rz"),
    ("theta_x", "theta_y", "theta_z"),
    ("roll", "pitch", "yaw"),
    ("rpy_roll", "rpy_pitch", "rpy_yaw"),
)
_EULER = re.compile(r"euler_([xyz]{3}|[XYZ]{3})_1_(deg|rad)")


@dataclass(frozen=True, slots=True, eq=False)
class Turned:
    """Rotations that were read from a table.

    ``rotation`` : (m, 3, 3); ``words`` : the convention; ``columns`` : names of the columns; ``stated`` : True if the
    columns alone define the convention, without an option.
    """

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
    """Return the rotations in the columns that begin with a prefix; None if there are none.

    ``rotation`` : name of the convention, from ``--rotation``, for angles whose columns leave it open.

    Raises InputError: only some columns of a rotation exist, values are no rotation, or the convention must be given.
    """
    places, where = places_of(table), table.where
    if f"{prefix}qw" in table or f"{prefix}qx" in table:
        table.has_rotation(prefix)
        quaternion_columns = [c for c in table.columns if c in {prefix + q for q in QUATERNION}]
        by_order = table.quaternions != "wxyz"
        columns = [quaternion_columns[3], *quaternion_columns[:3]] if by_order else [prefix + q for q in QUATERNION]
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
    if len(found := find_matrices(table, prefix)) == 1:
        return Turned(proper(found[0].rotations(table), places, where), "3×3 matrices", found[0].rotation)
    return _triple(table, prefix, rotation) or _four(table, prefix, rotation)


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


def _triple(table: Table, prefix: str, rotation: str | None) -> Turned | None:
    """Return rotations of three angles, or a rotation vector, by the convention of their names or of the user."""
    for triple, named in TRIPLES.items():
        for unit in (*ANGLES, ""):
            columns = [find_column(table, prefix, f"{name}_{unit}" if unit else name) for name in triple]
            names = tuple(column for column in columns if column is not None)
            if len(names) < len(triple):
                continue
            what = ", ".join(triple) if triple in BY_AXIS else "".join(triple)
            if rotation is None and unit in named:
                convention = convention_of(named[unit])
            else:
                convention = said_convention(rotation, what, table.where)
            if unit and convention.unit not in ("", unit) and "-" in (rotation or "") and _own_unit(rotation):
                raise InputError(
                    "E-OPTION-CONTRADICTS",
                    f"{table.where}: {names[0]} and --rotation {rotation} are of two units; correct one",
                )
            convention = Convention(convention.order, unit or convention.unit)
            values = np.column_stack([table.numbers(column) for column in names])
            turned, words = rotations(values, convention, places_of(table), table.where, triple in BY_AXIS)
            return Turned(turned, f"{', '.join(names)} as {words}", names, stated=False)
    return None


def _four(table: Table, prefix: str, rotation: str | None) -> Turned | None:
    """Return the rotations of quaternions q1 … q4, whose order the user must give."""
    columns = [find_column(table, prefix, f"q{i}") for i in (1, 2, 3, 4)]
    names = tuple(column for column in columns if column is not None)
    if len(names) < len(columns):
        return None
    values = np.column_stack([table.numbers(column) for column in names])
    turned, words = turned_values(values, rotation, "q1, q2, q3, q4", places_of(table), table.where)
    return Turned(turned, words, names, stated=False)


def _own_unit(rotation: str | None) -> bool:
    """Return True if the option states a unit itself, instead of a robot's name that implies one."""
    return (rotation or "").endswith(tuple(f"-{unit}" for unit in ANGLES))


def fixed(value: float, digits: int) -> str:
    """Return a number with a fixed number of digits, and no minus before zero."""
    text = f"{value:.{digits}f}"
    return text.lstrip("-") if not text.strip("-0.") else text


WHAT = "column map"
DELIMITERS = {"comma": ",", "semicolon": ";", "tab": "\t"}


class _ColumnsFile(Strict):
    delimiter: Literal["comma", "semicolon", "tab", "space"] = "comma"
    skip_lines: int = Field(default=0, ge=0, le=100_000)
    header: bool = True
    decimal_comma: bool = False
    encoding: Literal["utf-8", "utf-16", "latin-1"] = "utf-8"
    columns: dict[str, str | Annotated[int, Field(ge=1, le=10_000)]] = Field(min_length=1)


def read_mapped(path: str | Path, columns: str | Path, what: str, quaternions: Order = "wxyz") -> Table:
    """Read a table with another header, delimiter or decimal point; columns that are not mapped keep their names.

    ``columns`` : the map (TOML; form: ``data_layout.md``); ``quaternions`` : see
    :func:`~stcal.io.table.read_table`.

    Raises InputError: the file is unreadable, a column is missing, or a row has another length.
    """
    form, where = load_toml(columns, _ColumnsFile, WHAT, "give its path"), f"{what} {path}"
    try:
        text = read_bytes(path, TABLE_BYTES).decode("utf-8-sig" if form.encoding == "utf-8" else form.encoding)
    except OSError as error:
        raise InputError("E-FILE-UNREADABLE", f"{where}: {error.strerror or error}; check the path") from error
    except UnicodeDecodeError as error:
        raise InputError(
            "E-TABLE-ENCODING", f"{where}: not {form.encoding} text; give `encoding` in {columns}"
        ) from error
    used = [(i, line) for i, line in enumerate(text.splitlines(), 1) if i > form.skip_lines and line.strip()]
    used = [(i, line) for i, line in used if not is_comment(line)]
    if len(used) < 1 + form.header:
        raise InputError(
            "E-TABLE-EMPTY", f"{where}: no rows below {form.skip_lines} lines; check skip_lines in {columns}"
        )
    cells = [(i, _cells(line, form.delimiter, f"{where}: line {i}")) for i, line in used]
    names = cells[0][1] if form.header else [str(k) for k in range(1, len(cells[0][1]) + 1)]
    rows = cells[1:] if form.header else cells
    for line, row in rows:
        if len(row) != len(names):
            wrong = f"{len(row)} cells, {len(names)} needed"
            raise InputError("E-COLUMNS-FILE", f"{where}: line {line}: {wrong}; check delimiter in {columns}")
    at = {
        ours: _place(theirs, names, f"{where}: {ours} = {theirs!r} of {columns}")
        for ours, theirs in form.columns.items()
    }
    taken = {*at.values(), *(k for k, name in enumerate(names) if not form.header or not name or name in at)}
    unmapped = {name: k for k, name in enumerate(names) if k not in taken}
    cells_of = {name: [row[k] for _, row in rows] for name, k in (at | unmapped).items()}
    if form.decimal_comma:
        cells_of = {
            name: [v.replace(",", ".") if _is_decimal(v) else v for v in theirs] for name, theirs in cells_of.items()
        }
    return Table(where, dict(cells_of), [line for line, _ in rows], quaternions)


def _cells(line: str, delimiter: str, where: str) -> list[str]:
    if delimiter == "space":
        return line.split()
    try:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=DELIMITERS[delimiter]))]
    except csv.Error as error:
        raise InputError("E-TABLE-CELLS", f"{where}: {error}; correct it") from error


def _place(theirs: str | int, names: list[str], where: str) -> int:
    """Return the index of a column by its name, or by its number from 1."""
    if isinstance(theirs, int):
        if theirs > len(names):
            raise InputError("E-COLUMNS-FILE", f"{where}: there are {len(names)} columns; correct the number")
        return theirs - 1
    if names.count(theirs) != 1:
        shown = ", ".join(names)[:100]
        raise InputError(
            "E-COLUMNS-FILE",
            f"{where}: {names.count(theirs)} columns of this name, one needed, or its number; there are {shown}",
        )
    return names.index(theirs)


def _is_decimal(text: str) -> bool:
    return text.count(",") == 1 and all(c.isdigit() or c in "+-,eE" for c in text)
