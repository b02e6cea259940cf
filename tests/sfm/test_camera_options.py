"""Walked over all commands: ``--camera-name`` of those that read cameras, and the page of those that write one, in a
browser: no wider than its window, a quiet console, the answer."""

import inspect
import sys

import pytest

from stcal.cli.main import main
from stcal.errors import InputError
from stcal.io.cameras import foreign_lenses
from tests.commands import CALLS, COMMANDS, Call
from tests.fuzzing.judged import OUT, in_process, lay_out
from tests.outcome import assert_error, ended
from tests.report.browser import faults, opened, show, sideways_px

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


PAGES = {call.command: call for call in reversed(CALLS) if ">page.html" in call.words}
WITHOUT_ANSWER = {"robot axes", "robot evaluate", "robot verify", "robot design"}
"""What they print is not used as a whole: each row has a verdict of its own, or none."""


@pytest.fixture(scope="module")
def chrome():
    with opened() as browser:
        yield browser


@pytest.mark.slow
@pytest.mark.parametrize("call", PAGES.values(), ids=PAGES)
def test_a_page_fits_a_phone_and_a_screen(chrome, stock, tmp_path, call: Call):
    lay_out(stock, tmp_path / "case", call, earlier=False)
    outcome = in_process(call, "stcal", tmp_path / "case")
    assert outcome.code == call.code, outcome
    for theme in ("light", "dark"):
        chrome.execute_cdp_cmd(
            "Emulation.setEmulatedMedia", {"features": [{"name": "prefers-color-scheme", "value": theme}]}
        )
        for width in (420, 1280):
            show(chrome, tmp_path / "case" / OUT / "page.html", width)
            assert (sideways_px(chrome), faults(chrome)) == (0, [])
    head = chrome.execute_script("return document.body.innerText.split('\\n\\n').slice(0, 4).join(' ')")
    assert ("use it?" in head or "used?" in head) != (call.command in WITHOUT_ANSWER), head
