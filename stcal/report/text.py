"""Tables, numbers and poses as text."""

import io
import math
import textwrap
from collections.abc import Iterable, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.geometry.rigid import Rigid
from stcal.io.poses.columns import fixed

NONE = "–"
WIDTH = 100
"""Largest number of characters of a line of sentences."""
WIDEST = 10_000
"""Largest number of characters of a line: no line is ever wrapped, whatever the terminal."""


def number(value: float | None, digits: int) -> str:
    """Return a number with a fixed number of digits and no minus before zero; a dash if it is None or not finite."""
    if value is None or not math.isfinite(value):
        return NONE
    return fixed(value, digits)


def significant(value: float | None, digits: int = 2) -> str:
    """Return a number with this many significant digits, as uncertainties are stated (JCGM 100:2008, 7.2.6)."""
    if not value or not math.isfinite(value):
        return number(value, digits)
    decimals = digits - 1 - int(f"{value:.{digits - 1}e}".partition("e")[2])
    return number(round(value, decimals), max(decimals, 0))


def cells(row: dict, spec: str) -> list:
    """Return the values of a row that ``spec`` names, in words ``key``, or ``key:digits`` for numbers."""
    keys = [word.partition(":") for word in spec.split()]
    return [number(row[key], int(digits)) if digits else row[key] for key, _, digits in keys]


def join(values: Iterable) -> str:
    return ", ".join(str(value) for value in values) or NONE


def telling_names(names: Sequence[str], most: int = 14) -> list[str]:
    """Return short names that remain distinct.

    The beginning and end that all names share are removed, but words and numbers stay whole. Names that are still too
    long keep both ends, or a part between, with an ellipsis for the rest. If the results are not distinct, they are
    numbers from 1.

    ``most`` : largest number of characters
    """
    if len(set(names)) < 2:
        return [_shortened(name, most) for name in names]
    start, end = _common(names), _common([name[::-1] for name in names])
    shortest = min(map(len, names))
    end = min(end, shortest - start) if start < shortest else 0
    # Words and numbers stay whole: 10 and 11 of a10.png and a11.png, not 0 and 1.
    while start and any(_within_word(name, start) for name in names):
        start -= 1
    while end and any(_within_word(name, len(name) - end) for name in names):
        end -= 1
    distinctive = [name[start : len(name) - end] for name in names]
    if not all(distinctive):
        distinctive = [name[start:] for name in names] if all(name[start:] for name in names) else list(names)
    for head in (most // 2, 2, most - 3):
        short = [_shortened(name, most, head) for name in distinctive]
        if len(set(short)) == len(set(names)):
            return short
    windows = [
        [_window(name, at, most) for name in distinctive] for at in range(1, max(map(len, distinctive)) - most + 2)
    ]
    different = [short for short in windows if all(short) and len(set(short)) == len(set(names))]
    return different[len(different) // 2] if different else [str(i) for i in range(1, len(names) + 1)]


def _window(name: str, at: int, most: int) -> str:
    """Return the part of a name from index ``at`` on, with ellipses for omitted characters."""
    middle = name[at : at + most - 2]
    return name if len(name) <= most else f"…{middle}{'…' * (at + len(middle) < len(name))}" if middle else ""


def _common(names: Sequence[str]) -> int:
    """Return the number of leading characters that all names share."""
    first, last = min(names), max(names)
    return next((i for i, (a, b) in enumerate(zip(first, last, strict=False)) if a != b), min(len(first), len(last)))


def _within_word(text: str, at: int) -> bool:
    """Return True if a cut before this character would split a word or a number."""
    pair = text[max(at - 1, 0) : at + 1]
    return 0 < at < len(text) and (pair.isdigit() or pair.isalpha())


def _shortened(name: str, most: int, head: int | None = None) -> str:
    if len(name) <= most:
        return name
    head = most // 2 if head is None else head
    return f"{name[:head]}…{name[len(name) - (most - 1 - head) :]}"


def wrapped(line: str, width: int = WIDTH) -> list[str]:
    """Return a sentence in lines of at most this width, the further ones indented; a row of a table stays whole."""
    start = line[: len(line) - len(line.lstrip())]
    if len(line) <= width or "  " in line.lstrip():
        return [line]
    return textwrap.wrap(line, width, subsequent_indent=f"{start}    ", break_long_words=False, break_on_hyphens=False)


def text_table(rows: Iterable[Sequence[str]], least: Sequence[int] = (), gap: int = 2) -> list[str]:
    """Return the lines of a table without rules or colours, alike on any terminal; no cell is wrapped.

    ``rows`` : cells, the heads first; ``<`` before one aligns its column to the left; ``least`` : smallest width of
    each column; ``gap`` : between columns, in characters.
    """
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    heads, *body = rows
    shown = Table(box=None, show_header=False, pad_edge=False, padding=(0, gap, 0, 0))
    for k, head in enumerate(heads):
        justification = "left" if head.startswith("<") else "right"
        shown.add_column(justify=justification, no_wrap=True, min_width=least[k] if least else None)
    for row in [[head.removeprefix("<") for head in heads], *body]:
        shown.add_row(*(Text(cell) for cell in row))
    stream = io.StringIO()
    Console(file=stream, width=WIDEST, color_system=None, legacy_windows=False).print(shown, crop=False)
    return [line.rstrip() for line in stream.getvalue().splitlines()]


HEADS = ("", "mm", "± σ", "rotation vector °", "± σ")
"""Heads of the columns of :func:`transform_rows`."""


def transform_rows(pose: Rigid, covariance: np.ndarray | None) -> list[list[str]]:
    """Return a row for each of x, y, z: translation in mm and rotation vector in degrees, each with σ."""
    turn = np.degrees(Rotation.from_matrix(np.array(pose.rotation)).as_rotvec())
    sigma = [None] * 6 if covariance is None else pose.log_sigma(covariance)
    sigma = [*(None if s is None else np.degrees(s) for s in sigma[:3]), *sigma[3:]]
    columns = zip("xyz", pose.translation, sigma[3:], turn, sigma[:3], strict=True)
    return [[a, number(t, 4), number(s, 4), number(r, 4), number(d, 4)] for a, t, s, r, d in columns]
