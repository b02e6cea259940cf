"""Names of circles: ``face:circle`` on the target, ``board:row:column`` on the board. They are text wherever text is
wanted, in files, tables and as keys; their parts are taken apart in :func:`parse_label` alone."""

from collections.abc import Iterable
from typing import TypeAlias

import numpy as np

from stcal.errors import InputError

BOARD = "board"


class CircleLabel(str):
    """``face:circle``, a circle of the target; ``face`` and ``circle`` are the two ids."""

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
        """What it lies on: its face."""
        return self.face


class DotLabel(str):
    """``board:row:column``, a dot of the board; ``row`` and ``column`` count from 0."""

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
        """What it lies on: the board."""
        return BOARD


Label: TypeAlias = CircleLabel | DotLabel


def parse_label(text: str) -> Label:
    """The label that a text is.

    Raises
    ------
    InputError
        It is neither ``face:circle`` nor ``board:row:column``.
    """
    if isinstance(text, Label):
        return text
    plane, _, rest = text.partition(":")
    if plane == BOARD:
        row, _, column = rest.partition(":")
        if row.isdecimal() and column.isdecimal():
            label = DotLabel(int(row), int(column))
            if label == text:  # no leading zeros
                return label
    elif plane and rest:
        return CircleLabel(plane, rest)
    raise InputError("E-LABEL-FORM", f"label {text}: face:circle or {BOARD}:row:column needed")


def parse_labels(texts: Iterable[str]) -> tuple[Label, ...]:
    """:func:`parse_label` of each."""
    return tuple(map(parse_label, texts))


def circle_labels(texts: Iterable[str]) -> tuple[CircleLabel, ...]:
    """:func:`parse_label` of each, all on the target.

    Raises
    ------
    InputError
        A text is no ``face:circle``.
    """
    labels = []
    for label in map(parse_label, texts):
        if not isinstance(label, CircleLabel):
            raise InputError("E-LABEL-FORM", f"label {label}: face:circle needed")
        labels.append(label)
    return tuple(labels)


def dot_cells(labels: Iterable[Label]) -> np.ndarray:
    """Row and column of the board's dots, (n, 2) int.

    Raises
    ------
    InputError
        A label is that of a circle.
    """
    cells = []
    for label in labels:
        if not isinstance(label, DotLabel):
            raise InputError("E-LABEL-FORM", f"label {label}: {BOARD}:row:column needed")
        cells.append((label.row, label.column))
    return np.array(cells, int).reshape(-1, 2)
