"""Matrices in the columns of a table: a column for each element, named by its row and column."""

import re
from dataclasses import dataclass

import numpy as np

from stcal.errors import InputError
from stcal.io.table import LENGTHS, Table

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
