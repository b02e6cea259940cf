"""Values as text, and tables for the terminal."""

import io
import math
from collections.abc import Iterable, Sequence

NONE = "–"
WIDEST = 10_000
"""Characters of a line: none is ever wrapped, whatever the terminal."""


def number(value: float | None, digits: int) -> str:
    """Fixed digits; a dash where there is no value, and no minus before zero."""
    if value is None or not math.isfinite(value):
        return NONE
    text = f"{value:.{digits}f}"
    return text.lstrip("-") if not text.strip("-0.") else text


def cells(row: dict, spec: str) -> list:
    """Values of a row by words of ``key``, or ``key:digits`` for numbers."""
    found = [word.partition(":") for word in spec.split()]
    return [number(row[key], int(digits)) if digits else row[key] for key, _, digits in found]


def join(values: Iterable) -> str:
    return ", ".join(str(value) for value in values) or NONE


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
