"""Values as text, and tables for the terminal."""

import io
import math
from collections.abc import Iterable, Sequence

from stcal.io.poses.text import fixed

NONE = "–"
WIDEST = 10_000
"""Characters of a line: none is ever wrapped, whatever the terminal."""


def number(value: float | None, digits: int) -> str:
    """Fixed digits; a dash where there is no value, and no minus before zero."""
    if value is None or not math.isfinite(value):
        return NONE
    return fixed(value, digits)


def cells(row: dict, spec: str) -> list:
    """Values of a row by words of ``key``, or ``key:digits`` for numbers."""
    found = [word.partition(":") for word in spec.split()]
    return [number(row[key], int(digits)) if digits else row[key] for key, _, digits in found]


def join(values: Iterable) -> str:
    return ", ".join(str(value) for value in values) or NONE


def telling_names(names: Sequence[str], most: int = 14) -> list[str]:
    """Short names that tell things apart: without what all begin and end with, words and numbers whole; of longer ones
    both ends, or what stands between, with an ellipsis for the rest; numbers from 1 where that does not do.

    ``most`` : characters
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
    own = [name[start : len(name) - end] for name in names]
    if not all(own):
        own = [name[start:] for name in names] if all(name[start:] for name in names) else list(names)
    for head in (most // 2, 2, most - 3):
        short = [_shortened(name, most, head) for name in own]
        if len(set(short)) == len(set(names)):
            return short
    windows = [[_window(name, at, most) for name in own] for at in range(1, max(map(len, own)) - most + 2)]
    different = [short for short in windows if all(short) and len(set(short)) == len(set(names))]
    return different[len(different) // 2] if different else [str(i) for i in range(1, len(names) + 1)]


def _window(name: str, at: int, most: int) -> str:
    """What stands from there on, between ellipses where there is more."""
    part = name[at : at + most - 2]
    return name if len(name) <= most else f"…{part}{'…' * (at + len(part) < len(name))}" if part else ""


def _common(names: Sequence[str]) -> int:
    """Characters with which all begin."""
    first, last = min(names), max(names)
    return next((i for i, (a, b) in enumerate(zip(first, last, strict=False)) if a != b), min(len(first), len(last)))


def _within_word(text: str, at: int) -> bool:
    """Whether a cut before this character would go through a word or a number."""
    pair = text[max(at - 1, 0) : at + 1]
    return 0 < at < len(text) and (pair.isdigit() or pair.isalpha())


def _shortened(name: str, most: int, head: int | None = None) -> str:
    if len(name) <= most:
        return name
    head = most // 2 if head is None else head
    return f"{name[:head]}…{name[len(name) - (most - 1 - head) :]}"


def text_table(rows: Iterable[Sequence[str]], least: Sequence[int] = (), gap: int = 2) -> list[str]:
    """Lines of a table without rules or colours; the same on any terminal, and no cell is wrapped.

    Parameters
    ----------
    rows : cells; the first row has the heads, and ``<`` in front of one aligns its column to the left
    least : least width of each column, characters; none where empty
    gap : characters between columns
    """
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    heads, *others = rows
    shown = Table(box=None, show_header=False, pad_edge=False, padding=(0, gap, 0, 0))
    for k, head in enumerate(heads):
        left = "left" if head.startswith("<") else "right"
        shown.add_column(justify=left, no_wrap=True, min_width=least[k] if least else None)
    for row in [[head.removeprefix("<") for head in heads], *others]:
        shown.add_row(*(Text(cell) for cell in row))
    stream = io.StringIO()
    Console(file=stream, width=WIDEST, color_system=None, legacy_windows=False).print(shown, crop=False)
    return [line.rstrip() for line in stream.getvalue().splitlines()]
