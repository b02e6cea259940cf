"""All commands of both programs, found in the tree, and for each a call that goes through."""

import inspect
import shlex
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

import typer
from typer.models import OptionInfo

from stcal.cli.main import app, main, main_sfm
from stcal.cli.sfm import app as sfm

PROGRAMS = {"stcal": (app, main), "stcal-sfm": (sfm, main_sfm)}
"""The application and the entry point of each program."""


def command_tree(application: typer.Typer, above: str = "") -> dict[str, Callable]:
    found = {}
    for command in application.registered_commands:
        assert command.callback is not None
        found[above + (command.name or command.callback.__name__.replace("_", "-"))] = command.callback
    for group in application.registered_groups:
        inner = f"{above}{group.name} " if isinstance(group.name, str) else above
        found |= command_tree(group.typer_instance, inner)
    return found


COMMANDS = command_tree(app)
PLACES = dict.fromkeys(COMMANDS, "stcal") | {f"sfm {name}": "stcal-sfm" for name in command_tree(sfm)}
"""Shortest program that has a command: those of ``stcal sfm`` are ``stcal-sfm``'s."""


def paths_of(command: Callable) -> dict[str, str]:
    """Parameters that are paths, with their help."""
    return {
        name: get_args(parameter.annotation)[1].help
        for name, parameter in inspect.signature(command, eval_str=True).parameters.items()
        if "Path" in str(parameter.annotation)
    }


def options_of(command: str) -> list[str]:
    """Options that take a number or a word."""
    found = []
    for name, parameter in inspect.signature(COMMANDS[command], eval_str=True).parameters.items():
        kind, info = get_args(parameter.annotation)[:2]
        if isinstance(info, OptionInfo) and kind is not bool and "Path" not in str(kind):
            # With Annotated, Typer takes an option's first name for its default.
            names = [each for each in (info.default, *(info.param_decls or ())) if isinstance(each, str)]
            found.append(names[0] if names else f"--{name.replace('_', '-')}")
    return found


@dataclass(frozen=True, slots=True)
class Call:
    """A call that goes through, with inputs of :mod:`tests.fuzzing.stock`.

    ``words`` : in them ``@place`` is an input, a file or folder of the stock; ``>name`` a file that is written, also
    over an earlier one; ``+name`` one that must be new; ``~place`` a copy of the stock's folder to write to;
    ``seconds`` : processor time that it takes about; ``code`` : exit code.
    """

    command: str
    words: str
    seconds: float = 0.3
    code: int = 0

    def split(self) -> list[str]:
        return shlex.split(self.words.replace("~", "\\~"))

    @property
    def inputs(self) -> list[str]:
        return [word[1:] for word in self.split() if word[0] == "@"]

    @property
    def outputs(self) -> list[str]:
        return [word[1:] for word in self.split() if word[0] == ">"]

    @property
    def folders(self) -> list[str]:
        return [word[1:] for word in self.split() if word[0] == "~"]

    def arguments(self, read: Path, written: Path) -> list[str]:
        """The command's words with inputs below one folder and outputs below another."""
        places = {"@": read, ">": written, "+": written, "~": written}
        return [
            *self.command.split(),
            *(str(places[word[0]] / word[1:]) if word[0] in places else word for word in self.split()),
            *(["--overwrite"] if self.outputs else []),
        ]


_DESIGNS = "--target @data/target.toml --board @data/board.toml"
_SET = f"@data/images --camera @data/cameras.txt {_DESIGNS} --workers 1"
_LOCATE = "--layout @locate/layout.toml --camera @locate/cameras.txt"
_ALL = "--json >all.json --report >page.html"
_SHOTS = "@shots --camera @data/cameras.txt --faces @run/faces.json"
_ROBOT, _POSES = "--robot @robot/robot.toml", "@handeye/poses.csv"
_EYE = "@handeye/images --poses @handeye/robot.csv --camera @handeye/cameras.txt --board @handeye"
_FORMS, _REFINED = "--ros >h.yaml --urdf >h.urdf --opencv >h.yml", "--camera-out >cameras.txt"
_ARM = "--partial --targets @robot/targets.csv --out +arm"
_TARGETS = "@robot/targets.csv --robot @robot/made.toml --nominal @robot/robot.toml"
_CAMERA = "@data/images --camera @data/cameras.txt --faces @run/faces.json"
CALLS = (
    Call("sfm run", f"{_SET} --out ~run", 3.5),
    Call("sfm run", f"{_SET} --out +new", 9.0),
    Call("sfm run", f"{_SET} --out ~run --board-only --no-strict", 3.0),
    Call("sfm run", f"{_SET} --out ~run --solve paper --no-strict", 4.0),
    Call("sfm run", f"{_SET} --out ~run --compare paper", 6.0),
    Call("sfm detect", f"{_SET} --out ~detected", 1.5),
    Call("sfm detect", f"{_SET} --out ~detected --solve paper", 2.0),
    Call("sfm init", "+design"),
    Call("sfm design", "+own --size 130,120,110 --faces front,right --circles 9 --images 2 --width 1296", 3.0),
    Call("sfm design", "+body --tags cube --size 50 --distance-mm 300 --width 900 --images 10", 1.0),
    Call("sfm draw", "@data/target.toml --out >target.pdf", 2.0),
    Call("sfm draw", "@own.toml --out >net.svg --net"),
    Call("sfm draw", "@data/board.toml --out >board.svg --margin-mm 5"),
    Call("sfm simulate", "+set --width 324 --images 2 --workers 1", 3.0),
    Call("sfm simulate", f"+set {_DESIGNS} --camera @data/cameras.txt --groups 12 --images 2 --workers 1", 3.0),
    Call("sfm demo", "--out +demo --workers 1", 40.0),
    Call("sfm compare", "@run @data/truth.json --json >errors.json"),
    Call("sfm compare", "@run/faces.json @data/truth.json --json >errors.json"),
    Call("sfm report", "~run --pdf", 5.0),
    Call("sfm report", "@run --out >page.html", 3.0),
    Call("sfm export-database", "@run +copy.db --schema 3.8"),
    *(Call("sfm export-model", f"@run +model --format {kind}") for kind in ("colmap-bin", "colmap-txt")),
    *(Call("sfm export", f"@run +box.{suffix} --name box") for suffix in ("urdf", "xacro", "yaml", "yml", "csv")),
    Call("sfm export", "@run +box.txt --form ros2"),
    Call("sfm crosscheck", "@run --colmap @no-colmap", code=2),
    Call("sfm faces", "@run/colmap/models --run @run --out +faces.json", 1.0),
    Call("sfm faces", "@run/colmap/models --run @run --out +faces.json --solve paper", 1.0),
    Call("sfm faces", "@model-txt --run @run --out +faces.json", 1.0),
    Call("sfm plan", f"--images 2 --width 800 {_DESIGNS} --json >plan.json", 4.0),
    Call("sfm plan", "--images 2 --camera @data/cameras.txt --run @run --json >plan.json", 4.0),
    Call("sfm plan", "--images 2 --faces @faces.json --target @data/target.toml", 3.0),
    Call("sfm budget", "@run --field operator=A --lengths @run --json >budget.json --report >page.html", 2.5),
    Call("sfm advise", "@run --count 1 --json >advice.json", 10.0),
    Call("sfm calibrate-camera", f"@data/images {_DESIGNS} --out +cameras.txt --workers 1 --report >page.html", 15.0),
    Call("sfm measure", f"{_SHOTS} --target @data/target.toml --sequence --out >poses.csv --workers 1", 3.0),
    Call("sfm measure", f"{_SHOTS} {_DESIGNS} --joints @joints.csv --out >poses.csv --workers 1 {_ALL}", 1.5),
    Call("camera show", "@cameras/sigma.txt --plot >camera.svg", 1.0),
    Call("camera convert", "@cameras/opencv.xml >camera.yaml --form kalibr"),
    Call("camera convert", "@cameras/ros.yaml >camera.cameramodel"),
    Call("camera convert", "@cameras/matlab.mat >camera.mat"),
    Call("camera convert", "@cameras/cameras.bin >camera.xml"),
    *(Call("camera show", f"@cameras/{name}") for name in ("camchain.yaml", "camera.cameramodel", "metashape.xml")),
    Call("camera compare", "@cameras/sigma.txt @cameras/opencv.yaml --plot >camera.svg", 1.0),
    Call("robot init", "+robot.toml"),
    Call("robot convert", "@robot/made.toml >robot.urdf"),
    Call("robot axes", f"@robot/sweeps.csv --robot @robot/robot.toml --out >axes.toml {_ALL}", 2.0),
    Call("robot identify", f"@robot/poses.csv {_ROBOT} --folds 2 --out >r.toml --offsets >offsets.csv {_ALL}", 4.0),
    Call("robot identify", "@robot/sweeps.csv --robot @robot/robot.toml --observe distance --partial --folds 0", 1.0),
    Call("robot identify", "@robot/loaded.csv --robot @robot/elastic.toml --folds 0 --out >r.toml", 2.0),
    Call("robot evaluate", "@robot/loaded.csv --robot @robot/elastic.toml --refit none", 1.0),
    Call("robot evaluate", f"@robot/poses.csv {_ROBOT} --robot @robot/made.toml --out >rows.csv {_ALL}", 2.0),
    Call("robot compensate", f"{_TARGETS} --payload-kg 12 --out >joints.csv {_ALL}", 1.2),
    Call("robot from-photos", f"{_CAMERA} --joints @held.csv {_ROBOT} {_DESIGNS} {_ARM} --workers 1", 6.0),
    Call("robot verify", f"@robot/verify.csv --plot >errors.svg {_ALL}", 0.5),
    Call("robot design", f"--robot @robot/robot.toml --count 20 --candidates 60 --out >poses.csv {_ALL}", 1.5),
    Call("handeye", f"{_POSES} --splits 2 --out >h.json {_FORMS} --motions-held-out 2 --workers 1 {_ALL}", 1.2),
    Call("handeye", f"{_POSES} --splits 0 --method de --de-bounds-deg closed-form,10 --de-bounds-mm closed-form,20"),
    *(Call("handeye", f"{_POSES} --splits 0 --method {name}") for name in ("de-polished", "tsai-lenz", "zhao")),
    Call("handeye", f"{_EYE}/checker.yaml --splits 0 --refine-camera {_REFINED} --out >h.json --workers 1", 3.0),
    Call("handeye", f"{_EYE}/boards.toml --dry-run"),
    Call("handeye plan", "@handeye/poses.csv --count 2 --seed 1 --out >next.csv --json >all.json"),
    Call("locate schedule", "1 100 5"),
    Call("locate capture", "+scenes --simulate @locate/scenes/a/1.png --shortest 0.5 --longest 2 --count 3"),
    Call(
        "locate calibrate",
        "@locate/images --camera @locate/cameras.txt --board @locate/board.toml --layout @locate/plan.toml "
        "--out >calibrated.toml --json >all.json --workers 1",
        4.0,
    ),
    Call(
        "locate run",
        f"@locate/scenes {_LOCATE} --hand-eye @locate/handeye.json --robot-poses @locate/robot.csv "
        f"--offset @locate/offset.json --out >poses.csv --workers 1 {_ALL}",
        1.0,
    ),
    Call("locate run", f"@locate/scenes {_LOCATE} --method patent --workers 1", 1.0),
    Call("register", "@register/pairs.csv --folds 2 --out >all.json --report >page.html", 1.5),
    Call("register", "@register/pairs.csv --model similarity --method least-squares --folds 0"),
    Call("register", "@register/pairs.csv --model affine --method least-squares --folds 0"),
    Call(
        "register",
        "@register/pairs.csv --folds 0 --method liu2017 --sample 6 --tries 200 --threshold-mm 5 --share 0.3 "
        "--orthogonality 0.01 --report >liu.html",
        1.0,
    ),
    Call("register", "@register/arm.csv --robot @robot/robot.toml --identified >r.toml --out >all.json --folds 0", 2.0),
)
