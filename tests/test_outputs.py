"""No command writes over what it was given to read: walked over all commands and all their options."""

import inspect
from pathlib import Path
from typing import get_args

import pytest
from typer.models import ParameterInfo

from stcal.errors import InputError
from stcal.io.saving import RUN_ENTRIES, RUN_MARKER, keep_apart
from tests.commands import CALLS, COMMANDS, paths_of

FOLDERS = {
    ("run", "out"),
    ("detect", "out"),
    ("init", "folder"),
    ("design", "folder"),
    ("simulate", "folder"),
    ("demo", "out"),
    ("watch", "out"),
    ("from_photos", "out"),
}
FOLDERS |= {("export_model", "out"), ("capture", "out"), ("capture", "images")}
"""New ones, which replace nothing, or those of `tests/sfm/run/test_transaction.py`."""
WRITES = ("Write ", "Also write ", "Draw ", "Keep ")
EVERY = list(COMMANDS.values())


PAIRS = [
    pytest.param(command, output, read, id=f"{command.__name__}-{output}-{read}")
    for command in EVERY
    for output in sorted(command.outputs)
    for read in paths_of(command)
    if read not in command.outputs and (command.__name__, read) not in FOLDERS
]


def test_every_command_has_a_call_that_goes_through():
    assert {call.command for call in CALLS} == set(COMMANDS)


def test_every_option_that_writes_is_known():
    for command in EVERY:
        for name, says in paths_of(command).items():
            writes = name in command.outputs or (command.__name__, name) in FOLDERS
            assert writes == says.startswith(WRITES), (command.__name__, name, says)
    assert len(PAIRS) > 60


@pytest.mark.parametrize(("command", "output", "read"), PAIRS)
def test_no_output_replaces_an_input(command, output, read, tmp_path):
    """The file itself, by another way to it, and a file in a folder that is read."""
    own = tmp_path / "given"
    own.write_text("mine")
    given = dict.fromkeys(paths_of(command))
    for place in (own, tmp_path / "." / "x" / ".." / "given"):
        with pytest.raises(InputError, match="is an input of this command; give another name"):
            command(**given | {read: own, output: place})
    with pytest.raises(InputError, match="is a file of "):
        command(**given | {read: tmp_path, output: own})
    assert own.read_text() == "mine"


def test_a_file_beside_a_runs_own_is_written_again(tmp_path):
    for name in (RUN_MARKER, "doctor.json", "faces.json"):
        (tmp_path / name).write_text("{}")
    keep_apart([("--json", tmp_path / "doctor.json")], [("run", tmp_path)])
    for name in RUN_ENTRIES:
        (tmp_path / name).touch()
        with pytest.raises(InputError, match="is a file of run"):
            keep_apart([("--json", tmp_path / name)], [("run", tmp_path)])


def test_a_result_file_in_a_folder_of_images_is_written_again(tmp_path):
    (tmp_path / "poses.json").write_text('{\n "format": "stcal poses 1"\n}')
    (tmp_path / "a.jpg").write_bytes(b"x")
    keep_apart([("--json", tmp_path / "poses.json")], [("images", Path(tmp_path))])
    keep_apart([("--json", tmp_path / "new.json")], [("images", Path(tmp_path))])
    with pytest.raises(InputError, match="is a file of images"):
        keep_apart([("--out", tmp_path / "a.jpg")], [("images", tmp_path)])


def test_two_outputs_are_kept_apart(tmp_path):
    with pytest.raises(InputError, match="is also what --out writes"):
        keep_apart([("--out", tmp_path / "a"), ("--json", tmp_path / "a")], [])


def test_every_path_of_a_list_is_an_input(tmp_path):
    with pytest.raises(InputError, match="is an input of this command"):
        keep_apart([("--out", tmp_path / "a")], [("sources", tmp_path / "a"), ("sources", tmp_path / "b")])


@pytest.mark.parametrize("name", ["poses.csv", "a.json", "b.HTML", "figure.svg"])
def test_a_table_in_a_folder_of_images_is_written_again(tmp_path, name):
    """No command reads one from there."""
    (tmp_path / name).write_text("an earlier table")
    keep_apart([("--out", tmp_path / name)], [("images", tmp_path)])
    for read in ("a.jpg", "cameras.txt", "points3D.bin", "database.db", "drawing.png"):
        (tmp_path / read).write_text("mine")
        with pytest.raises(InputError, match="is a file of images"):
            keep_apart([("--out", tmp_path / read)], [("images", tmp_path)])


def test_numbers_have_both_ends():
    """A width of 1e20 px, or a distance of 1e308 mm, ends in the numerics; options without a range, and σ of
    hand-eye, are judged by the stage that they go to."""
    for command, function in COMMANDS.items():
        for name, parameter in inspect.signature(function, eval_str=True).parameters.items():
            info = next(each for each in get_args(parameter.annotation) if isinstance(each, ParameterInfo))
            if command == "handeye" and name.startswith("sigma"):
                continue
            assert (info.min is None) == (info.max is None), f"{command}: {name}"
