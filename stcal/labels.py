"""Labels of circles: ``face:circle`` on the target, ``board:row:column`` on the board.

Labels are strings, and serve as text in files, tables and as keys. Only :func:`parse_label` takes them apart.
"""

from collections.abc import Iterable
from typing import TypeAlias

import numpy as np

from stcal.errors import InputError

BOARD = "board"


class CircleLabel(str):
    """Label ``face:circle`` of a circle of the target; ``face`` and ``circle`` are the two ids."""

    __slots__ = ("circle", "face")
    face: str
    circle: str

    def __new__(cls, face: str, circle: str):
        self = super().__new__(cls, f"{face}:{circle}")
        self.face, self.circle = face, circle
        return self

    def __getnewargs__(self) -> tuple[str, str]:
        return self.face, self.circle

    @property
    def plane(self) -> str:
        """Plane of the circle: its face."""
        return self.face


class DotLabel(str):
    """Label ``board:row:column`` of a dot of the board; ``row`` and ``column`` count from 0."""

    __slots__ = ("column", "row")
    row: int
    column: int

    def __new__(cls, row: int, column: int):
        self = super().__new__(cls, f"{BOARD}:{row}:{column}")
        self.row, self.column = row, column
        return self

    def __getnewargs__(self) -> tuple[int, int]:
        return self.row, self.column

    @property
    def plane(self) -> str:
        """Plane of the dot: the board."""
        return BOARD


Label: TypeAlias = CircleLabel | DotLabel
PARSED = (CircleLabel, DotLabel)
"""The types of a label as a tuple, by which ``isinstance`` tells them in a third of the time of the union."""


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
    return tuple(text if isinstance(text, PARSED) else parse_label(text) for text in texts)


def circle_labels(texts: Iterable[str]) -> tuple[CircleLabel, ...]:
    """Parses each text with :func:`parse_label`; all labels must be of circles on the target."""
    labels = []
    for label in map(parse_label, texts):
        if not isinstance(label, CircleLabel):
            raise InputError("E-LABEL-FORM", f"label {label}: face:circle needed")
        labels.append(label)
    return tuple(labels)


def dot_cells(labels: Iterable[Label]) -> np.ndarray:
    """Returns row and column of the board's dots, (n, 2) int."""
    cells = []
    for label in labels:
        if not isinstance(label, DotLabel):
            raise InputError("E-LABEL-FORM", f"label {label}: {BOARD}:row:column needed")
        cells.append((label.row, label.column))
    return np.array(cells, int).reshape(-1, 2)


def unseen_lines(labels: Iterable[Label], rows: int, columns: int) -> list[str]:
    """Returns notes on rows and columns of the board of which ``labels`` have no dot: hidden, or nonexistent."""
    cells = dot_cells(labels)
    notes = []
    for line, count, numbers in (("row", rows, cells[:, 0]), ("column", columns, cells[:, 1])):
        missing = [str(i) for i in range(count) if i not in numbers]
        if missing:
            notes.append(f"board {line} {', '.join(missing)}: not seen in any image; check {line}s in the board file")
    return notes
