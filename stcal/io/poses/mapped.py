"""Tables of instruments such as laser trackers, read by a file that maps their columns to the package's names."""

import csv
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from stcal.errors import InputError
from stcal.io.files import TABLE_BYTES, read_bytes
from stcal.io.quaternions import Order
from stcal.io.table import Table
from stcal.io.toml import Strict, load_toml

WHAT = "column map"
DELIMITERS = {"comma": ",", "semicolon": ";", "tab": "\t"}


class _ColumnsFile(Strict):
    delimiter: Literal["comma", "semicolon", "tab", "space"] = "comma"
    skip_lines: int = Field(default=0, ge=0, le=100_000)
    header: bool = True
    decimal_comma: bool = False
    encoding: Literal["utf-8", "utf-16", "latin-1"] = "utf-8"
    columns: dict[str, str | Annotated[int, Field(ge=1, le=10_000)]] = Field(min_length=1)


def read_mapped(path: str | Path, columns: str | Path, what: str, quaternions: Order = "wxyz") -> Table:
    """Read a table with another header, delimiter or decimal point; columns that are not mapped keep their names.

    ``columns`` : the map (TOML; form: ``data_layout.md``); ``quaternions`` : see
    :func:`~stcal.io.table.read_table`.

    Raises
    ------
    InputError
        The file is unreadable, a column is missing, or a row has another length.
    """
    form, where = load_toml(columns, _ColumnsFile, WHAT, "give its path"), f"{what} {path}"
    try:
        text = read_bytes(path, TABLE_BYTES).decode("utf-8-sig" if form.encoding == "utf-8" else form.encoding)
    except OSError as error:
        raise InputError("E-FILE-UNREADABLE", f"{where}: {error.strerror or error}; check the path") from error
    except UnicodeDecodeError as error:
        raise InputError(
            "E-TABLE-ENCODING", f"{where}: not {form.encoding} text; give `encoding` in {columns}"
        ) from error
    used = [(i, line) for i, line in enumerate(text.splitlines(), 1) if i > form.skip_lines and line.strip()]
    used = [(i, line) for i, line in used if not line.lstrip().startswith(("#", "//"))]
    if len(used) < 1 + form.header:
        raise InputError(
            "E-TABLE-EMPTY", f"{where}: no rows below {form.skip_lines} lines; check skip_lines in {columns}"
        )
    cells = [(i, _cells(line, form.delimiter, f"{where}: line {i}")) for i, line in used]
    names = cells[0][1] if form.header else [str(k) for k in range(1, len(cells[0][1]) + 1)]
    rows = cells[1:] if form.header else cells
    for line, row in rows:
        if len(row) != len(names):
            wrong = f"{len(row)} cells, {len(names)} needed"
            raise InputError("E-COLUMNS-FILE", f"{where}: line {line}: {wrong}; check delimiter in {columns}")
    at = {
        ours: _place(theirs, names, f"{where}: {ours} = {theirs!r} of {columns}")
        for ours, theirs in form.columns.items()
    }
    taken = {*at.values(), *(k for k, name in enumerate(names) if not form.header or not name or name in at)}
    unmapped = {name: k for k, name in enumerate(names) if k not in taken}
    cells_of = {name: [row[k] for _, row in rows] for name, k in (at | unmapped).items()}
    if form.decimal_comma:
        cells_of = {
            name: [v.replace(",", ".") if _is_decimal(v) else v for v in theirs] for name, theirs in cells_of.items()
        }
    return Table(where, dict(cells_of), [line for line, _ in rows], quaternions)


def _cells(line: str, delimiter: str, where: str) -> list[str]:
    if delimiter == "space":
        return line.split()
    try:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=DELIMITERS[delimiter]))]
    except csv.Error as error:
        raise InputError("E-TABLE-CELLS", f"{where}: {error}; correct it") from error


def _place(theirs: str | int, names: list[str], where: str) -> int:
    """Return the index of a column by its name, or by its number from 1."""
    if isinstance(theirs, int):
        if theirs > len(names):
            raise InputError("E-COLUMNS-FILE", f"{where}: there are {len(names)} columns; correct the number")
        return theirs - 1
    if names.count(theirs) != 1:
        shown = ", ".join(names)[:100]
        raise InputError(
            "E-COLUMNS-FILE",
            f"{where}: {names.count(theirs)} columns of this name, one needed, or its number; there are {shown}",
        )
    return names.index(theirs)


def _is_decimal(text: str) -> bool:
    return text.count(",") == 1 and all(c.isdigit() or c in "+-,eE" for c in text)
