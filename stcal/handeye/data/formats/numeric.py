"""Reader of lines of numbers: 4×4 matrices, TUM's trajectories, rows of place and rotation."""

import re
from collections import Counter
from dataclasses import dataclass

import numpy as np

from stcal.errors import InputError
from stcal.handeye.data.formats.record import MATRICES, Content, Said, Side, Unit, of_matrices, require_each_once
from stcal.io.poses.rotations import of_quaternions, require_finite, turned_values

_SEPARATORS = re.compile(r"[\s,;]+")
_BRACKETS = str.maketrans("[]()", "    ")
_QUATERNION = re.compile(r"(?<![a-z])q[a-z_]*?([wxyz])\b")
TUM, MATRIX = 8, 16
"""Numbers in a line that holds a whole pose."""


@dataclass(frozen=True, slots=True)
class Line:
    """``number`` of the line in the file; ``label`` before the numbers; ``values``; ``first`` : first number as
    text."""

    number: int
    label: str
    values: list[float]
    first: str


def read_numbers(text: str, said: Said, where: str) -> Content | None:
    """Returns the poses in lines of numbers, each with or without a name before them; None for any other text.

    Raises
    ------
    InputError
        Lines of unequal length, 3×4 matrices, no rotations, or a convention that must be stated.
    """
    lines, comments = [], []
    for i, raw in enumerate(text.splitlines(), 1):
        stripped = raw.strip()
        if stripped.startswith(("#", "//", "%")):
            comments.append(stripped)
        elif stripped:
            line = _line(i, stripped)
            if line is None:
                return None
            lines.append(line)
    if not any(line.values for line in lines):
        return None
    labels_alone = [line for line in lines if not line.values]
    widths = Counter(len(line.values) for line in lines if line.values)
    width = widths.most_common(1)[0][0]
    odd = next((line for line in lines if line.values and len(line.values) != width), None)
    if odd is not None:
        raise InputError(
            "E-MATRIX-ROWS",
            f"{where}: line {odd.number}: {len(odd.values)} numbers, {width} in most other lines; correct it",
        )
    if width == 4:
        return _blocks(lines, where)
    if labels_alone:
        return None
    if width in (12, 3):
        raise InputError(
            "E-MATRIX-ROWS", f"{where}: {width} numbers in a line, as of a matrix 3×4 or 3×3; 4×4 needed: add 0 0 0 1"
        )
    if width not in (6, 7, TUM, MATRIX):
        return None
    values, places = np.array([line.values for line in lines]), tuple(f"line {line.number}" for line in lines)
    require_finite(values, places, where)
    names = tuple(line.label for line in lines) if all(line.label for line in lines) else ()
    if width == TUM:
        return _tum(values, lines, places, comments, where)
    require_each_once(names, places[: len(names)], where)
    if width == MATRIX:
        rotation, translation = of_matrices(values.reshape(-1, 4, 4), places, where)
        return Content("4×4 matrices, a row each", (Side(rotation, translation, places, MATRICES, names=names),))
    rotation, words = turned_values(values[:, 3:], said.rotation, "the numbers after x, y, z", places, where)
    return Content("rows of numbers", (Side(rotation, values[:, :3], places, words, names=names),))


def _line(number: int, text: str) -> Line | None:
    """Returns a line of numbers, a name alone, or a name and numbers; None for any other text."""
    robot = re.fullmatch(r"p?\s*\[(.*)\]", text)  # as UR writes poses: p[x, y, z, rx, ry, rz]
    tokens = [t for t in _SEPARATORS.split((robot[1] if robot else text).translate(_BRACKETS)) if t]
    if not tokens:
        return Line(number, "", [], "")
    values = [_number(token) for token in tokens]
    label = ""
    if values[0] is None:
        label, values = tokens[0], values[1:]
        if label.endswith(":") or label == "-" or not (values or "." in label):  # a line of YAML, or a word
            return None
    numbers = [value for value in values if value is not None]
    return Line(number, label, numbers, tokens[0]) if len(numbers) == len(values) else None


def _number(token: str) -> float | None:
    try:
        return float(token)
    except ValueError:
        return None


def _blocks(lines: list[Line], where: str) -> Content | None:
    """Returns matrices of four lines each, with or without a name before each."""
    names, rows, starts = [], [], []
    for line in lines:
        if line.label:
            names.append(line.label)
        if line.values:
            if len(rows) % 4 == 0:
                starts.append(line.number)
            rows.append(line.values)
        if line.label and len(rows) % 4 > (1 if line.values else 0):
            raise InputError(
                "E-MATRIX-ROWS", f"{where}: line {line.number}: a name after {len(rows) % 4} rows of a matrix, 4 needed"
            )
    if len(rows) % 4:
        three = "; matrices 3×4 need a row 0 0 0 1 each" if len(rows) % 3 == 0 else ""
        raise InputError(
            "E-MATRIX-ROWS", f"{where}: {len(rows)} rows of 4 numbers, 4 for each matrix needed{three}; correct them"
        )
    if names and len(names) != len(starts):
        raise InputError(
            "E-NAMES-COUNT", f"{where}: {len(starts)} matrices and {len(names)} names; one each needed, or none"
        )
    places = tuple(f"line {number}" for number in starts)
    require_each_once(names, places[: len(names)], where)
    rotation, translation = of_matrices(np.array(rows).reshape(-1, 4, 4), places, where)
    return Content("4×4 matrices as text", (Side(rotation, translation, places, MATRICES, names=tuple(names)),))


def _tum(values: np.ndarray, lines: list[Line], places: tuple[str, ...], comments: list[str], where: str) -> Content:
    """Returns poses from lines of timestamp tx ty tz qx qy qz qw. A comment may state another order of the quaternion,
    as in EuRoC."""
    order = next((letters for c in comments if len(letters := _QUATERNION.findall(c.lower())) == 4), list("xyzw"))
    if sorted(order) != sorted("wxyz"):
        order = list("xyzw")
    names = tuple(line.first for line in lines)
    require_each_once(names, places, where)
    wxyz = values[:, 4:][:, [order.index(component) for component in "wxyz"]]
    rotation = of_quaternions(wxyz, places, where)
    turned = f"quaternions {', '.join(order)}"
    side = Side(rotation, values[:, 1:4], places, turned, Unit("m", "as in TUM"), names=names, trajectory=True)
    return Content("TUM trajectory (timestamp, place, quaternion)", (side,))
