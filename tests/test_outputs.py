"""No command writes over what it was given to read: walked over all commands and all their options."""

import inspect
from pathlib import Path
from typing import get_args

import pytest
from typer.models import ParameterInfo

from stcal.cli.main import main
from stcal.cli.options import ALWAYS_NEW
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


@pytest.mark.parametrize(
    ("command", "output"),
    [
        pytest.param(c, o, id=f"{c.__name__}-{o}")
        for c in EVERY
        for o in sorted(c.outputs)
        if c.__name__ not in ALWAYS_NEW
    ],
)
def test_no_output_replaces_a_file_in_silence(command, output, tmp_path):
    """One rule for every file that any command writes, before its work; links, to nothing too, are files."""
    place, link = tmp_path / "earlier", tmp_path / "link"
    place.write_text("a better one")
    link.symlink_to(tmp_path / "nothing")
    given = dict.fromkeys(paths_of(command))
    for each in (place, link):
        with pytest.raises(InputError, match=f"{each}: exists; give another name, or --overwrite to replace it"):
            command(**given | {output: each})
    assert place.read_text() == "a better one"
    assert "overwrite" in inspect.signature(command).parameters


def test_overwrite_replaces_what_is_there(tmp_path, monkeypatch, capsys):
    """The table of an earlier call, and only with the option."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "b.toml").write_text("mine")

    def init(*more):
        monkeypatch.setattr("sys.argv", ["stcal", "robot", "init", "b.toml", *more])
        with pytest.raises(SystemExit) as end:
            main()
        return end.value.code, capsys.readouterr().err

    code, error = init()
    assert (code, error) == (2, "error: b.toml: exists; give another name, or --overwrite to replace it\n")
    assert (tmp_path / "b.toml").read_text() == "mine"
    assert init("--overwrite") == (0, "")
    assert "[[joint]]" in (tmp_path / "b.toml").read_text()


def test_calls_that_write_nothing_ask_for_nothing(tmp_path, monkeypatch):
    """`measure --serve` beside an earlier poses.csv; the file of the camera is what is refused."""
    monkeypatch.chdir(tmp_path)
    Path("poses.csv").write_text("an earlier table")
    given = {"camera": tmp_path / "none.txt", "faces": tmp_path / "none.json", "out": Path("poses.csv")}
    with pytest.raises(InputError, match=r"--out poses\.csv: exists"):
        COMMANDS["sfm measure"](**given, images=tmp_path / "images")
    with pytest.raises(InputError, match=r"none\.json"):
        COMMANDS["sfm measure"](
            **given, target=None, board=None, sigma_factor=None, json_file=None, report=None, joints=None,
            previous=False, sequence=False, scheduler=None, send_images=False, strict=False, serve=True,
            min_diameter=None, max_diameter=450.0, host="127.0.0.1", port=0, max_megabytes=1.0, workers=1,
        )  # fmt: skip


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
