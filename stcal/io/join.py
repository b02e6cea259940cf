"""Two tables as one: rows of the same key side by side, columns renamed to what a command reads."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stcal.errors import InputError
from stcal.io.poses.mapped import read_mapped
from stcal.io.quaternions import Order
from stcal.io.table import COVARIANCE, LENGTHS, POSE, Table, read_table

_OF_POSES = re.compile(rf"([xyz]_({'|'.join(LENGTHS)})|{'|'.join((*POSE[3:], *COVARIANCE))}|common\d+_.+)")
SHOWN = 3


@dataclass(frozen=True, slots=True, eq=False)
class Joined:
    """``table`` ; ``notes`` : rows that stand in one file alone."""

    table: Table
    notes: tuple[str, ...]


def join(
    a: str | Path | Table,
    b: str | Path | Table,
    key: str,
    prefixes: tuple[str, str] = ("", ""),
    quaternions: Order = "wxyz",
    columns: str | Path | None = None,
) -> Joined:
    """Rows of two CSV files whose ``key`` is the same.

    Parameters
    ----------
    a, b
        Files with a column ``key``, each value once; or what was read from them.
    key
        Name of the column.
    prefixes
        Put before the columns of a pose or a position of each file, ``x_mm`` to ``qz`` and covariances, unless they
        have it; other columns keep their names, those of ``a`` where both have one.
    quaternions
        As of :func:`~stcal.io.table.read_table`.
    columns
        Map of the columns of ``b``, as of :func:`~stcal.io.poses.mapped.read_mapped`.

    Returns
    -------
    Joined
        In the order of ``a``; lines are its.

    Raises
    ------
    InputError
        A file that is none, no such column, a key twice, none in common, or one column for both.
    """
    if columns and not isinstance(b, Table):
        second = read_mapped(b, columns, "table", quaternions)
    else:
        second = read_table(b, "table", quaternions)
    tables = [read_table(a, "table", quaternions), second]
    a, b = (each.where if isinstance(each, Table) else each for each in (a, b))
    places = [_places(table, key) for table in tables]
    common = [name for name in places[0] if name in places[1]]
    if not common:
        first = [next(iter(own)) for own in places]
        raise InputError(
            "E-TABLES-UNMATCHED",
            f"{a}, {b}: no {key} in common: {first[0]} … in the one, {first[1]} … in the other; correct them, or give "
            "another --key",
        )
    joined: dict[str, list[str] | np.ndarray] = {}
    for table, own, prefix in zip(tables, places, prefixes, strict=True):
        rows = [own[name] for name in common]
        for name, values in table.columns.items():
            posed = bool(_OF_POSES.fullmatch(name))
            new = prefix + name if posed else name
            if new in joined and posed:
                raise InputError(
                    "E-TABLES-BOTH",
                    f"{a}, {b}: both have {name}; positions or poses of one of them alone can be read here",
                )
            joined.setdefault(new, values[rows] if isinstance(values, np.ndarray) else [values[i] for i in rows])
    lines = [tables[0].lines[places[0][name]] for name in common]
    notes = []
    for path, own, other in ((a, places[0], places[1]), (b, places[1], places[0])):
        alone = [name for name in own if name not in other]
        if alone:
            more = ", …" if len(alone) > SHOWN else ""
            notes.append(f"{len(alone)} rows of {path} have no partner: {key} {', '.join(alone[:SHOWN])}{more}")
    where = f"{Path(a).name} with {Path(b).name}"
    return Joined(Table(where, joined, lines, tables[0].quaternions), tuple(notes))


def stack(tables: Sequence[Table], names: Sequence[str], called: dict[str, str], column: str = "set") -> Table:
    """Tables below each other, the columns that all of them have, those of ``called`` by a second name too; ``column``
    holds each one's name.

    Raises
    ------
    InputError
        A name twice.
    """
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise InputError(
            "E-TABLES-NAMES",
            f"{tables[0].where}: two files are called {twice}; rename one, {column}s are called like them",
        )
    common = [name for name in tables[0].columns if name != column and all(name in each for each in tables)]
    columns: dict[str, list[str] | np.ndarray] = {}
    for name in common:
        parts = [each.columns[name] for each in tables]
        numeric = all(isinstance(part, np.ndarray) for part in parts)
        columns[name] = np.concatenate(parts) if numeric else [v for each in tables for v in each.text(name)]
    columns |= {second: columns[first] for second, first in called.items()}
    columns[column] = [name for name, each in zip(names, tables, strict=True) for _ in range(len(each))]
    lines = [line for each in tables for line in each.lines]
    return Table(", ".join(each.where for each in tables), columns, lines, tables[0].quaternions)


def _places(table: Table, key: str) -> dict[str, int]:
    if key not in table:
        raise InputError(
            "E-TABLE-COLUMN-MISSING",
            f"{table.where}: no column {key}; the header is {table.header()}; give another --key",
        )
    found: dict[str, int] = {}
    for row, name in enumerate(table.text(key)):
        if name in found:
            raise InputError(
                "E-TABLE-ROW-REPEATED",
                f"{table.where}: line {table.lines[row]}: {key} {name} stands on line {table.lines[found[name]]} too; "
                "every one once needed",
            )
        found[name] = row
    return found
