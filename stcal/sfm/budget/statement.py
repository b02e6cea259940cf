"""What a user states for a budget: sizes and temperatures of board and target, and the fields of its head."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated

from pydantic import Field

from stcal.design import StatedSize
from stcal.errors import InputError
from stcal.io.design import BoardSizeEntry, SizeEntry
from stcal.io.toml import Strict, load_toml

FIELDS = ("instrument", "operator", "date", "traceability")
"""Of the head of every budget, empty where nothing is given; others come after them."""
LONGEST = 500
Text = Annotated[str, Field(max_length=LONGEST)]
FieldName = Annotated[str, Field(min_length=1, max_length=60)]


class StatementFile(Strict):
    """``--statement``."""

    fields: dict[FieldName, Text] = Field(default_factory=dict)
    board: BoardSizeEntry = BoardSizeEntry()
    target: SizeEntry = SizeEntry()


@dataclass(frozen=True, slots=True)
class Statement:
    """``board``, ``target`` : of their sizes; ``origin`` by ``board`` or ``target`` and key: the file that states it;
    ``fields`` of the head by name."""

    board: StatedSize
    target: StatedSize
    origin: dict[tuple[str, str], str]
    fields: dict[str, str]


def statement_of(own: StatedSize, path: Path | None = None, given: Sequence[str] = ()) -> Statement:
    """The statement of a run: of ``board.toml``, over that of the file, over that the fields NAME=VALUE.

    Parameters
    ----------
    own : StatedSize
        What the run's ``board.toml`` states.
    path : Path, optional
        ``--statement``.
    given : sequence of str
        ``--field``.

    Raises
    ------
    InputError
        A file that is none, a field without ``=``, or a field twice.
    """
    file = load_toml(path, StatementFile, "statement", "give a TOML file") if path else StatementFile()
    parts, origin = {}, {}
    for what, first, second in (("board", own, file.board.stated()), ("target", StatedSize(), file.target.stated())):
        values = {}
        for key in (each.name for each in fields(StatedSize)):
            values[key] = getattr(second, key)
            origin[what, key] = str(path)
            if values[key] is None:
                values[key], origin[what, key] = getattr(first, key), "board.toml"
        parts[what] = StatedSize(**values)
    named = dict.fromkeys(FIELDS, "") | file.fields | fields_of(given)
    return Statement(parts["board"], parts["target"], origin, named)


def fields_of(given: Sequence[str]) -> dict[str, str]:
    """``NAME=VALUE`` as a dictionary; errors as of :func:`statement_of`."""
    found: dict[str, str] = {}
    for text in given:
        name, sign, value = (part.strip() for part in text.partition("="))
        if not sign or not name:
            raise InputError("E-OPTION-VALUE", f"--field {text!r}: NAME=VALUE needed, such as operator='A. Smith'")
        if name in found:
            raise InputError("E-OPTION-REPEATED", f"--field {name}: given twice; give it once")
        if len(name) > 60 or len(value) > LONGEST:
            raise InputError(
                "E-OPTION-VALUE",
                f"--field {name[:20]}: {len(text)} characters; up to 60 for a name, {LONGEST} for a value",
            )
        found[name] = value
    return found
