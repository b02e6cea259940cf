"""Statements of a user for a budget: sizes and temperatures of board and target, and the fields of its head."""

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
"""Fields in the head of every budget, empty if not given. Other fields follow them."""
LONGEST = 500
Text = Annotated[str, Field(max_length=LONGEST)]
FieldName = Annotated[str, Field(min_length=1, max_length=60)]


class StatementFile(Strict):
    """The file of ``--statement``."""

    fields: dict[FieldName, Text] = Field(default_factory=dict)
    board: BoardSizeEntry = BoardSizeEntry()
    target: SizeEntry = SizeEntry()


@dataclass(frozen=True, slots=True)
class Statement:
    """What the user states.

    ``board``, ``target`` : their sizes; ``origin`` : the file that states a value, by ``board`` or ``target`` and key;
    ``fields`` : fields of the head by name.
    """

    board: StatedSize
    target: StatedSize
    origin: dict[tuple[str, str], str]
    fields: dict[str, str]


def statement_of(own: StatedSize, path: Path | None = None, given: Sequence[str] = ()) -> Statement:
    """Returns the statement of a run. The file overrides ``board.toml``, and NAME=VALUE overrides fields of the file.

    Parameters
    ----------
    own : StatedSize
        Sizes that the run's ``board.toml`` states.
    path : Path, optional
        File of ``--statement``.
    given : sequence of str
        Fields of ``--field``, NAME=VALUE.

    Raises
    ------
    InputError
        If the file is not a statement, or a field has no ``=`` or is given twice.
    """
    file = load_toml(path, StatementFile, "statement", "give a TOML file") if path else StatementFile()
    sizes, origin = {}, {}
    for body, first, second in (("board", own, file.board.stated()), ("target", StatedSize(), file.target.stated())):
        values = {}
        for key in (field.name for field in fields(StatedSize)):
            values[key] = getattr(second, key)
            origin[body, key] = str(path)
            if values[key] is None:
                values[key], origin[body, key] = getattr(first, key), "board.toml"
        sizes[body] = StatedSize(**values)
    named = dict.fromkeys(FIELDS, "") | file.fields | fields_of(given)
    return Statement(sizes["board"], sizes["target"], origin, named)


def fields_of(given: Sequence[str]) -> dict[str, str]:
    """Parses ``NAME=VALUE`` into a dictionary. Errors are those of :func:`statement_of`."""
    values: dict[str, str] = {}
    for text in given:
        name, sign, value = (word.strip() for word in text.partition("="))
        if not sign or not name:
            raise InputError("E-OPTION-VALUE", f"--field {text!r}: NAME=VALUE needed, such as operator='A. Smith'")
        if name in values:
            raise InputError("E-OPTION-REPEATED", f"--field {name}: given twice; give it once")
        if len(name) > 60 or len(value) > LONGEST:
            raise InputError(
                "E-OPTION-VALUE",
                f"--field {name[:20]}: {len(text)} characters; up to 60 for a name, {LONGEST} for a value",
            )
        values[name] = value
    return values
