"""Joins of tables: rows of the same key side by side."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stcal.errors import InputError
from stcal.geometry.arrays import ByValue, require_arguments
from stcal.geometry.rigid import Order
from stcal.io.table import COVARIANCE, LENGTHS, POSE, Table, read_table

_OF_POSES = re.compile(rf"([xyz]_({'|'.join(LENGTHS)})|{'|'.join((*POSE[3:], *COVARIANCE))}|common\d+_.+)")
SHOWN = 3


@dataclass(frozen=True, slots=True, eq=False)
class JoinedTable(ByValue):
    """Two tables in one.

    Parameters
    ----------
    table : Rows that both have, for any function that reads a table.
    notes : On the rows that occur in only one of them.
    """

    table: Table
    notes: tuple[str, ...]


@require_arguments
def load_table(path: str | Path, quaternions: Order = "wxyz", what: str = "table") -> Table:
    """Reads a table, CSV or another text file, for any function that takes one; units are in the names of its columns.

    Parameters
    ----------
    path : str or Path
    quaternions : {"wxyz", "xyzw"}
        ``wxyz`` reads them by the names of their columns; ``xyzw`` takes x, y, z, w in the order of the columns.
    what : What the file holds, for messages.

    Raises InputError: the file is no table, a column is missing, or a row has another length.
    """
    return read_table(path, what, quaternions)


@require_arguments
def join_tables(
    a: str | Path | Table,
    b: str | Path | Table,
    key: str,
    prefixes: tuple[str, str] = ("", ""),
    quaternions: Order = "wxyz",
) -> JoinedTable:
    """Returns the rows of two tables that have the same key, side by side, in the order and lines of ``a``.

    Parameters
    ----------
    a, b : Tables with a column ``key`` that holds each value once.
    key : Name of the key column; or ``image=Point Name``, that of ``a`` and that of ``b``.
    prefixes : (str, str). Prefix for the columns of a pose or a position in each table, ``x_mm`` to ``qz`` and
        covariances: ``("a", "b")`` for a registration, ``("commanded_", "")`` to verify a robot. Other columns keep
        their names; of two of one name, that of ``a`` is used.
    quaternions : As of :func:`load_table`.

    Raises InputError: a file is no table or lacks the key column, a key occurs twice, no key is common to both, or both
    files have the same pose column.
    """
    tables = [read_table(source, "table", quaternions) for source in (a, b)]
    a, b = (source.where if isinstance(source, Table) else source for source in (a, b))
    keys = keys_of(key, tables[0])
    places = [_places(table, own, i) for i, (table, own) in enumerate(zip(tables, keys, strict=True))]
    key = keys[0]
    common = [name for name in places[0] if name in places[1]]
    if not common:
        first = [next(iter(row_of_key)) for row_of_key in places]
        fault = f"{a}, {b}: no {key} in common: {first[0]} … in the one, {first[1]} … in the other"
        raise InputError("E-TABLES-UNMATCHED", f"{fault}; correct them, or give another --key")
    joined: dict[str, list[str] | np.ndarray] = {}
    for table, row_of_key, prefix in zip(tables, places, prefixes, strict=True):
        rows = [row_of_key[name] for name in common]
        for name in table.columns:
            values = table.kept(name)
            posed = bool(_OF_POSES.fullmatch(name))
            new = prefix + name if posed else name
            if new in joined and posed:
                one = "positions or poses of one of them alone can be read here"
                raise InputError("E-TABLES-BOTH", f"{a}, {b}: both have {name}; {one}")
            joined.setdefault(new, values[rows] if isinstance(values, np.ndarray) else [values[i] for i in rows])
    lines = [tables[0].lines[places[0][name]] for name in common]
    notes = []
    for path, row_of_key, rows_of_other in ((a, places[0], places[1]), (b, places[1], places[0])):
        unmatched = [name for name in row_of_key if name not in rows_of_other]
        if unmatched:
            names = ", ".join(unmatched[:SHOWN]) + ", …" * (len(unmatched) > SHOWN)
            notes.append(f"{len(unmatched)} rows of {path} have no partner: {key} {names}")
    where = f"{Path(a).name} with {Path(b).name}"
    return JoinedTable(Table(where, joined, lines, tables[0].quaternions), tuple(notes))


@require_arguments
def stack_tables(
    tables: Sequence[Table], names: Sequence[str], called: dict[str, str] | None = None, column: str = "set"
) -> Table:
    """Returns several tables below each other, with the columns that all of them have.

    Parameters
    ----------
    tables : sequence of Table
    names : Different names of the tables, written into the new column.
    called : Second names of some columns, by which copies of these are added: ``{"pose": "image"}``.
    column : Name of the new column.
    """
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        called_so = f"{tables[0].where}: two files are called {twice}"
        raise InputError("E-TABLES-NAMES", f"{called_so}; rename one, {column}s are called like them")
    common = [name for name in tables[0].columns if name != column and all(name in table for table in tables)]
    columns: dict[str, list[str] | np.ndarray] = {}
    for name in common:
        values_of_table = [table.kept(name) for table in tables]
        numeric = all(isinstance(part, np.ndarray) for part in values_of_table)
        texts = (v for table in tables for v in table.text(name))
        columns[name] = np.concatenate(values_of_table) if numeric else list(texts)
    columns |= {second: columns[first] for second, first in (called or {}).items()}
    columns[column] = [name for name, table in zip(names, tables, strict=True) for _ in range(len(table))]
    lines = [line for table in tables for line in table.lines]
    return Table(", ".join(table.where for table in tables), columns, lines, tables[0].quaternions)


def keys_of(key: str, first: Table | None = None) -> tuple[str, str]:
    """Return the names of the key columns of both tables; ``key`` : one name, or two with ``=`` between them."""
    own, equals, theirs = key.partition("=")
    if not equals or not own or not theirs or (first is not None and key in first):
        return key, key
    return own.strip(), theirs.strip()


def _places(table: Table, key: str, number: int) -> dict[str, int]:
    if key not in table:
        both = f"{key}=NAME" if number else f"NAME={key}"
        fault = f"{table.where}: no column {key}; the header is {table.header()}"
        remedy = f"give another --key, or --key {both!r} where the columns of both files have different names"
        raise InputError("E-TABLE-COLUMN-MISSING", f"{fault}; {remedy}")
    row_of: dict[str, int] = {}
    for row, name in enumerate(table.text(key)):
        if name in row_of:
            first = f"{key} {name} stands on line {table.lines[row_of[name]]} too"
            fault = f"{table.where}: line {table.lines[row]}: {first}"
            raise InputError("E-TABLE-ROW-REPEATED", f"{fault}; every one once needed")
        row_of[name] = row
    return row_of
