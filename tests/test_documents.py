"""The documents know every option of every command."""

from pathlib import Path

import pytest
from typer.main import get_command

from stcal.cli.main import app

ROOT = Path(__file__).resolve().parents[1]
DOCUMENTS = ("README.md", "data_layout.md")


def commands(command, path=()):
    """(name, command) of all that have no commands of their own."""
    own = getattr(command, "commands", {})
    if not own:
        yield " ".join(path), command
    for name, each in own.items():
        yield from commands(each, (*path, name))


@pytest.mark.parametrize(("name", "command"), list(commands(get_command(app))))
def test_every_option_is_documented(name, command):
    text = "".join((ROOT / document).read_text(encoding="utf-8") for document in DOCUMENTS)
    options = [option for each in command.params for option in each.opts if option.startswith("--")]
    assert [option for option in options if option != "--help" and option not in text] == []
