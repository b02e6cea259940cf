"""``docs/sources.md``: each function is there, each script, each command with its options; and each command runs."""

import re
import shlex
from importlib import import_module
from pathlib import Path

import pytest
import typer.main

from stcal.cli.main import app
from tests.commands import Call
from tests.fuzzing.judged import in_process, lay_out

ROOT = Path(__file__).parents[2]
QUOTED = re.findall(r"`([^`]+)`", (ROOT / "docs" / "sources.md").read_text(encoding="utf-8"))
NAMED = sorted({each for each in QUOTED if re.match(r"stcal(-sfm)? ", each)})
FUNCTIONS = sorted({each for each in QUOTED if re.fullmatch(r"stcal(\.\w+)+", each)})
SCRIPTS = sorted({each for each in QUOTED if each.startswith("scripts/")})

_DESIGNS = "--target @data/target.toml --board @data/board.toml"
_SET = f"@data/images --camera @data/cameras.txt {_DESIGNS} --workers 1"
_PAIRS, _POSES = "@register/pairs.csv --folds 0", "@handeye/poses.csv --splits 0"
_LOCATE = "@locate/scenes --layout @locate/layout.toml --camera @locate/cameras.txt"
GIVEN = {
    "stcal-sfm init": "+design",
    "stcal-sfm run": f"{_SET} --out +run",
    "stcal-sfm detect": f"{_SET} --out +detected",
    "stcal-sfm faces": "@run/models --run @run",
    "stcal-sfm pairs": "@run",
    "stcal-sfm plan": f"--images 2 --width 800 {_DESIGNS}",
    "stcal-sfm advise": "@run --count 1",
    "stcal-sfm calibrate-camera": "@data/images --target @data/target.toml --board @data/board.toml --out +c.txt",
    "stcal robot axes": "@robot/sweeps.csv --robot @robot/robot.toml",
    "stcal robot identify": "@robot/poses.csv --robot @robot/robot.toml --folds 0",
    "stcal robot compensate": "@robot/targets.csv --robot @robot/made.toml --nominal @robot/robot.toml --out >j.csv",
    "stcal robot verify": "@robot/verify.csv",
    "stcal register": _PAIRS,
    "stcal register --robot": "@register/arm.csv --folds 0",
    "stcal handeye": _POSES,
    "stcal locate schedule": "1 100 5",
    "stcal locate capture": "+scenes --simulate @locate/scenes/a/1.png --shortest 0.5 --longest 2",
    "stcal locate calibrate": "@locate/images --camera @locate/cameras.txt --board @locate/board.toml --layout "
    "@locate/plan.toml --out >calibrated.toml",
    "stcal locate run": _LOCATE,
}
"""What each command is given besides what the document says, by its longest beginning."""
FILES = {"robot.toml": "@robot/robot.toml", "liu.html": ">liu.html"}
"""What files of the document are."""


def leaf(words: list[str]):
    """The command of the tree that words call, and those left over."""
    command = typer.main.get_command(app)
    words = ["sfm", *words[1:]] if words[0] == "stcal-sfm" else words[1:]
    while words and hasattr(command, "commands"):
        assert words[0] in command.commands, words
        command, words = command.commands[words[0]], words[1:]
    return command, words


@pytest.mark.parametrize("name", FUNCTIONS)
def test_each_function_is_there(name):
    parts = name.split(".")
    assert hasattr(import_module(".".join(parts[:-1])), parts[-1])


@pytest.mark.parametrize("name", SCRIPTS)
def test_each_script_is_there(name):
    assert (ROOT / name).is_file()


@pytest.mark.parametrize("text", NAMED)
def test_each_command_has_its_options(text):
    command, rest = leaf(shlex.split(text))
    known = {option for parameter in command.params for option in parameter.opts}
    assert {word for word in rest if word.startswith("--")} <= known


def call_of(text: str) -> Call:
    """The command of the document on the stock's data."""
    words = shlex.split(text)
    given = GIVEN[max((key for key in GIVEN if text.startswith(key)), key=len)]
    size = 2 if words[0] == "stcal-sfm" or words[1] in ("register", "handeye") else 3
    own = " ".join(FILES.get(word, word) for word in words[size:])
    if "chessboard.toml" in own:  # tests/sfm/camera/test_corners.py has one; the stock has dots
        own = ""
    if "--motions-held-out" in own:
        own = "--motions-held-out 2"
    if "--splits" in own:
        given = given.replace("--splits 0", "")
    if "--method liu2017" in own:
        given += " --sample 6 --tries 200 --threshold-mm 5 --share 0.3"
    name = " ".join(words[1:size])
    return Call(f"sfm {name}" if words[0] == "stcal-sfm" else name, f"{given} {own}")


@pytest.mark.slow
@pytest.mark.parametrize("text", NAMED)
def test_each_command_runs(stock, tmp_path, text):
    call = call_of(text)
    lay_out(stock, tmp_path, call, earlier=False)
    outcome = in_process(call, shlex.split(text)[0], tmp_path)
    assert outcome.code == 0, outcome.said + outcome.trace
