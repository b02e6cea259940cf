"""Tables, numbers and poses as text."""

import math
import textwrap
from collections.abc import Iterable, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.geometry.rigid import Rigid
from stcal.io.rotations import fixed

NONE = "–"
WIDTH = 100  # largest number of characters of a line of sentences


def number(value: float | None, digits: int) -> str:
    """Return a number with a fixed number of digits and no minus before zero; a dash if it is None or not finite."""
    if value is None or not math.isfinite(value):
        return NONE
    return fixed(value, digits)


def significant(value: float | None) -> str:
    """Return a number with two significant digits, as uncertainties are stated (JCGM 100:2008, 7.2.6)."""
    decimals = 1 - int(f"{value:.1e}".partition("e")[2]) if value and math.isfinite(value) else 2
    return number(value and round(value, decimals), max(decimals, 0))


def cells(row: dict, spec: str) -> list:
    """Return the values of a row that ``spec`` names, in words ``key``, or ``key:digits`` for numbers."""
    keys = [word.partition(":") for word in spec.split()]
    return [number(row[key], int(digits)) if digits else row[key] for key, _, digits in keys]


def join(values: Iterable) -> str:
    return ", ".join(str(value) for value in values) or NONE


def wrapped(line: str) -> list[str]:
    """Return a sentence in lines of a limited width, the further ones indented; a row of a table stays whole."""
    if len(line) <= WIDTH or "  " in line.lstrip():
        return [line]
    indent = line[: len(line) - len(line.lstrip())] + "    "
    return textwrap.wrap(line, WIDTH, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)


def text_table(rows: Iterable[Sequence[str]], least: Sequence[int] = (), gap: int = 2) -> list[str]:
    """Return the lines of a table without rules or colours, alike on any terminal; no cell is wrapped. ``rows`` :
    cells, the heads first; ``<`` before one aligns its column to the left; ``least`` : smallest width of each column;
    ``gap`` : between columns, in characters."""
    from rich.cells import cell_len

    heads, *body = rows
    table, columns = [[head.removeprefix("<") for head in heads], *body], []
    for k, head in enumerate(heads):
        cells = [row[k] for row in table]
        width = max(least[k] if least else 0, *map(cell_len, cells))
        room = [" " * (width - cell_len(cell)) for cell in cells]
        pairs = zip(cells, room, strict=True) if head.startswith("<") else zip(room, cells, strict=True)
        columns.append(map("".join, pairs))
    return [(" " * gap).join(cells).rstrip() for cells in zip(*columns, strict=True)]


HEADS = ("", "mm", "± σ", "rotation vector °", "± σ")
"""Heads of the columns of :func:`transform_rows`."""


def transform_rows(pose: Rigid, covariance: np.ndarray | None) -> list[list[str]]:
    """Return a row for each of x, y, z: translation in mm and rotation vector in degrees, each with σ."""
    turn = np.degrees(Rotation.from_matrix(np.array(pose.rotation)).as_rotvec())
    sigma = [None] * 6 if covariance is None else pose.log_sigma(covariance)
    sigma = [*(None if s is None else np.degrees(s) for s in sigma[:3]), *sigma[3:]]
    columns = zip("xyz", pose.translation, sigma[3:], turn, sigma[:3], strict=True)
    return [[a, number(t, 4), number(s, 4), number(r, 4), number(d, 4)] for a, t, s, r, d in columns]
