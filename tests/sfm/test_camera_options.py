"""``--camera-name`` of every command that reads cameras, walked over all."""

import inspect
import sys

import pytest

from stcal.cli.main import main
from stcal.errors import InputError
from stcal.io.cameras import foreign_lenses
from tests.commands import CALLS, COMMANDS, Call
from tests.fuzzing.judged import lay_out
from tests.outcome import assert_error, ended

MORE = (
    Call("sfm design", "+own --size 130,120,110 --circles 9 --images 2 --camera @data/cameras.txt"),
    Call(
        "handeye plan",
        "@handeye/images --poses @handeye/robot.csv --camera @handeye/cameras.txt --board @handeye/board.toml "
        "--count 2 --out >next.csv --workers 1",
    ),
)
"""Commands whose call elsewhere has no camera file."""
OF_CAMERAS = {each.command: each for each in (*CALLS, *MORE) if "--camera @" in each.words}


@pytest.fixture
def call(stock, tmp_path, monkeypatch, capsys):
    """Runs a call with further words, after a change of its inputs, which are below ``folder``."""

    def run(each, *more, change=lambda folder: None):
        below, written = lay_out(stock, tmp_path / "call", each, earlier=False)
        change(below)
        monkeypatch.setattr(sys, "argv", ["stcal", *each.arguments(below, written), *more])
        return ended(main, capsys)

    return run


def test_every_command_with_a_camera_chooses_one_of_several():
    for name, command in COMMANDS.items():
        options = inspect.signature(command).parameters
        assert ("camera" in options) == ("camera_name" in options), name
    assert OF_CAMERAS.keys() == {
        name for name, command in COMMANDS.items() if "camera" in inspect.signature(command).parameters
    }


def two_cameras(each):
    """Puts a second camera into the file of a call."""
    words = each.split()
    place = words[words.index("--camera") + 1].removeprefix("@")

    def change(folder):
        path = folder / place
        (line,) = [line for line in path.read_text().splitlines() if line and line[0] != "#"]
        path.write_text(f"{line}\n2 {line.split(maxsplit=1)[1]}\n")

    return change


@pytest.mark.slow
@pytest.mark.parametrize("name", OF_CAMERAS)
def test_a_camera_of_several_is_asked_for_and_taken(call, monkeypatch, name):
    each = OF_CAMERAS[name]
    error = assert_error(call(each, change=two_cameras(each)), 2, "2 cameras", "choose of 1, 2", "--camera-name")
    assert "\n" not in error
    taken = []

    def chosen(names, choice):
        taken.append(choice)
        raise InputError("E-CAMERA-SEVERAL", f"chosen: {choice}")

    monkeypatch.setattr(foreign_lenses, "one_of", chosen)
    assert_error(call(each, "--camera-name", "2", change=two_cameras(each)), 2, "chosen: 2")
    assert taken == ["2"]
