"""No command writes over what it was given to read: walked over all commands and all their options."""

import inspect
from pathlib import Path
from typing import get_args

import pytest
from typer.models import ParameterInfo

from stcal.cli.main import main
from stcal.cli.options import ALWAYS_NEW
from stcal.io.files import RUN_ENTRIES, RUN_MARKER, keep_apart
from tests.commands import CALLS, COMMANDS, paths_of
from tests.outcome import assert_error, ended, fails_with, refuses

FOLDERS = {(name, "out") for name in ("run", "detect", "demo", "from_photos", "export_model", "capture")}
FOLDERS |= {(name, "folder") for name in ("init", "design", "simulate")}
"""New ones, which replace nothing, or those of `tests/sfm/runs/test_transaction.py`."""
WRITES = ("Write ", "Also write ", "Draw ", "Keep ")
EVERY = list(COMMANDS.values())
PAIRS = [
    (command, output, read)
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


def test_no_output_replaces_an_input(tmp_path):
    """The file itself, by another way to it, and a file in a folder that is read."""
    own = tmp_path / "given"
    own.write_text("mine")
    another_way = tmp_path / "." / "x" / ".." / "given"
    for command, output, read in PAIRS:
        given = dict.fromkeys(paths_of(command))
        for paths in ({read: own, output: own}, {read: own, output: another_way}, {read: tmp_path, output: own}):
            refuses("E-OUTPUT-IS-INPUT … given", command, **given | paths)
    assert own.read_text() == "mine"


def test_no_output_replaces_a_file_in_silence(tmp_path):
    """One rule for every file that any command writes, before its work; links, to nothing too, are files."""
    place, link = tmp_path / "earlier", tmp_path / "link"
    place.write_text("a better one")
    link.symlink_to(tmp_path / "nothing")
    for command in EVERY:
        for output in command.outputs if command.__name__ not in ALWAYS_NEW else ():
            for path in (place, link):
                with fails_with(f"E-OUTPUT-EXISTS … {path} … --overwrite"):
                    command(**dict.fromkeys(paths_of(command)) | {output: path})
            assert "overwrite" in inspect.signature(command).parameters
    assert place.read_text() == "a better one"


def test_overwrite_replaces_what_is_there(tmp_path, monkeypatch, capsys):
    """The table of an earlier call, and only with the option."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "b.toml").write_text("mine")

    def init(*more):
        monkeypatch.setattr("sys.argv", ["stcal", "robot", "init", "b.toml", *more])
        return ended(main, capsys)

    assert_error(init(), 2, "E-OUTPUT-EXISTS", "error: b.toml: exists; give another name, or --overwrite to replace it")
    assert (tmp_path / "b.toml").read_text() == "mine"
    assert init("--overwrite")[::2] == (0, "")
    assert "[[joint]]" in (tmp_path / "b.toml").read_text()


def test_calls_that_write_nothing_ask_for_nothing(tmp_path, monkeypatch):
    """`measure --serve` beside an earlier poses.csv; the file of the camera is what is refused."""
    monkeypatch.chdir(tmp_path)
    Path("poses.csv").write_text("an earlier table")
    given = {"camera": tmp_path / "none.txt", "faces": tmp_path / "none.json", "out": Path("poses.csv")}
    refuses("E-OUTPUT-EXISTS … --out poses.csv", COMMANDS["sfm measure"], **given, images=tmp_path / "images")
    with fails_with("E-FILE-UNREADABLE … none.json"):
        COMMANDS["sfm measure"](
            **given, target=None, board=None, sigma_factor=None, json_file=None, report=None, joints=None,
            previous=False, sequence=False, scheduler=None, send_images=False, strict=False, serve=True,
            min_diameter=None, max_diameter=450.0, host="127.0.0.1", port=0, max_megabytes=1.0, workers=None,
        )  # fmt: skip


def test_a_file_beside_a_runs_own_is_written_again(tmp_path):
    for name in (RUN_MARKER, "advice.json", "faces.json"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("{}")
    keep_apart([("--json", tmp_path / "advice.json")], [("run", tmp_path)])
    for name in RUN_ENTRIES:
        (tmp_path / name).touch()
        refuses("E-OUTPUT-IS-INPUT … run", keep_apart, [("--json", tmp_path / name)], [("run", tmp_path)])


def test_outputs_are_kept_apart_and_from_every_path_of_a_list(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    refuses("E-OUTPUT-TWICE … --out", keep_apart, [("--out", tmp_path / "a"), ("--json", tmp_path / "a")], [])
    refuses("E-OUTPUT-FOLDER … --out", keep_apart, [("--out", tmp_path)], [])
    for out in (tmp_path / "a", Path("a")):
        with fails_with(f"E-OUTPUT-IS-INPUT … --out {out}"):
            keep_apart([("--out", out)], [("sources", tmp_path / "a"), ("sources", tmp_path / "b")])


@pytest.mark.parametrize("name", ["poses.csv", "a.json", "b.HTML", "figure.svg"])
def test_a_result_in_a_folder_of_images_is_written_again(tmp_path, name):
    """No command reads one from there."""
    (tmp_path / name).write_text("an earlier table")
    for out in (name, "new.json"):
        keep_apart([("--out", tmp_path / out)], [("images", tmp_path)])
    for read in ("a.jpg", "cameras.txt", "points3D.bin", "database.db", "drawing.png"):
        (tmp_path / read).write_text("mine")
        refuses("E-OUTPUT-IS-INPUT … images", keep_apart, [("--out", tmp_path / read)], [("images", tmp_path)])


def test_numbers_have_both_ends():
    """A width of 1e20 px, or a distance of 1e308 mm, ends in the numerics; options without a range, and σ of
    hand-eye, are judged by the stage that they go to."""
    for command, function in COMMANDS.items():
        for name, parameter in inspect.signature(function, eval_str=True).parameters.items():
            info = next(each for each in get_args(parameter.annotation) if isinstance(each, ParameterInfo))
            if command == "handeye" and name.startswith("sigma"):
                continue
            assert (info.min is None) == (info.max is None), f"{command}: {name}"
