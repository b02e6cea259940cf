"""Labels of circles: ``face:circle`` on the target, ``board:row:column`` on the board.

Labels are strings, and serve as text in files, tables and as keys. Only :func:`parse_label` takes them apart.
"""

from collections.abc import Iterable
from typing import TypeAlias, TypeVar

import numpy as np

from stcal.errors import InputError

BOARD = "board"


class CircleLabel(str):
    """Label ``face:circle`` of a circle of the target; ``face`` and ``circle`` are ids, ``plane`` is the face."""

    __slots__ = ("circle", "face", "plane")
    face: str
    circle: str
    plane: str

    def __new__(cls, face: str, circle: str):
        self = super().__new__(cls, f"{face}:{circle}")
        self.face, self.circle, self.plane = face, circle, face
        return self

    def __getnewargs__(self) -> tuple[str, str]:
        return self.face, self.circle


class DotLabel(str):
    """Label ``board:row:column`` of a dot of the board, its ``plane``; ``row`` and ``column`` count from 0."""

    __slots__ = ("column", "row")
    row: int
    column: int
    plane = BOARD

    def __new__(cls, row: int, column: int):
        self = super().__new__(cls, f"{BOARD}:{row}:{column}")
        self.row, self.column = row, column
        return self

    def __getnewargs__(self) -> tuple[int, int]:
        return self.row, self.column


Label: TypeAlias = CircleLabel | DotLabel
L = TypeVar("L", CircleLabel, DotLabel)


def parse_label(text: str) -> Label:
    """Parses the text of a label."""
    if isinstance(text, Label):
        return text
    plane, _, name = text.partition(":")
    if plane == BOARD:
        row, _, column = name.partition(":")
        if row.isdecimal() and column.isdecimal():
            label = DotLabel(int(row), int(column))
            if label == text:  # no leading zeros
                return label
    elif plane and name:
        return CircleLabel(plane, name)
    raise InputError("E-LABEL-FORM", f"label {text}: face:circle or {BOARD}:row:column needed")


def parse_labels(texts: Iterable[str]) -> tuple[Label, ...]:
    """Parses each text with :func:`parse_label`."""
    return tuple(map(parse_label, texts))


def circle_labels(texts: Iterable[str]) -> tuple[CircleLabel, ...]:
    """Parses each text with :func:`parse_label`; all labels must be of circles on the target."""
    return tuple(_of_kind(label, CircleLabel, "face:circle") for label in map(parse_label, texts))


def dot_cells(labels: Iterable[Label]) -> np.ndarray:
    """Returns row and column of the board's dots, (n, 2) int."""
    dots = (_of_kind(label, DotLabel, f"{BOARD}:row:column") for label in labels)
    return np.array([(dot.row, dot.column) for dot in dots], int).reshape(-1, 2)


def _of_kind(label: Label, kind: type[L], form: str) -> L:
    if not isinstance(label, kind):
        raise InputError("E-LABEL-FORM", f"label {label}: {form} needed")
    return label


def unseen_lines(labels: Iterable[Label], rows: int, columns: int) -> list[str]:
    """Returns notes on rows and columns of the board of which ``labels`` have no dot: hidden, or nonexistent."""
    lines = zip(("row", "column"), (rows, columns), dot_cells(labels).T, strict=True)
    unseen = [(line, ", ".join(str(i) for i in range(count) if i not in numbers)) for line, count, numbers in lines]
    said = "board {0} {1}: not seen in any image; check {0}s in the board file"
    return [said.format(line, missing) for line, missing in unseen if missing]
