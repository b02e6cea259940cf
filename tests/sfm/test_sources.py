"""``docs/sources.md``: each function is there, each script, each command with its options."""

import re
import shlex
from importlib import import_module
from itertools import takewhile
from pathlib import Path

from tests.commands import CALLS

ROOT = Path(__file__).parents[2]
QUOTED = re.findall(r"`([^`]+)`", (ROOT / "docs" / "sources.md").read_text(encoding="utf-8"))
NAMED = sorted({each for each in QUOTED if re.match(r"stcal(-sfm)? ", each)})
FUNCTIONS = sorted({each for each in QUOTED if re.fullmatch(r"stcal(\.\w+)+", each)})
SCRIPTS = sorted({each for each in QUOTED if each.startswith("scripts/")})


def test_each_function_and_script_is_there():
    for name in FUNCTIONS:
        module, _, function = name.rpartition(".")
        assert hasattr(import_module(module), function), name
    assert [name for name in SCRIPTS if not (ROOT / name).is_file()] == []


def choices(words: list[str]) -> set[str]:
    """Options and words chosen with them; other numbers and files serve as well."""
    return {word for word in words if re.fullmatch(r"--[\w-]+|[a-z][a-z-]+\d*", word)}


def test_each_command_is_among_the_calls_that_go_through():
    """With all its options; they are made by `tests/sfm/test_fuzz.py`."""
    for text in NAMED:
        program, *words = shlex.split(text)
        words = ["sfm", *words] if program == "stcal-sfm" else words
        calls = [[*call.command.split(), *call.split()] for call in CALLS if call.code == 0]
        own = [call for call in calls if call[: len(call_words(words))] == call_words(words)]
        assert any(choices(words) <= choices(call) for call in own), text


def call_words(words: list[str]) -> list[str]:
    """The words before the first option: those of the command."""
    return list(takewhile(lambda word: not word.startswith("--"), words))
