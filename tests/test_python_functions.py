"""Every command calls a public function, as the table of docs/howto/python.md says, and the two have one answer.

Those of a run: `tests/sfm/test_functions.py`; of photographs that come: `tests/sfm/runs/`.
"""

import ast
import inspect
import json
import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from importlib import import_module
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from typer.testing import CliRunner

import stcal
from stcal import handeye, locate, register, robot, synthetic
from stcal.cli.main import app
from stcal.io.files import json_text
from stcal.robot.kinematics.robot_model import mh80
from tests.commands import COMMANDS
from tests.locate.drawn_target import CAMERA, LAYOUT, photo, tilted
from tests.outcome import refuses

PAGE = Path(__file__).resolve().parents[1] / "docs" / "howto" / "python.md"
ROW = re.compile(r"^\| `stcal([ -])([\w -]+)` \| (.+) \|$", re.MULTILINE)
TABLE = {words: cell for _, words, cell in ROW.findall(PAGE.read_text(encoding="utf-8"))}
"""Cells of the table by the words of the command, ``sfm run``."""
APART = {"sfm demo", "robot init"}  # commands without a function of their own; the table says why


def functions_of(command: str) -> dict[str, object]:
    found = {}
    for name in re.findall(r"`((?:\w+\.)+\w+)`", TABLE[command]):
        path = name.removeprefix("stcal.").split(".")
        holder = stcal if len(path) == 1 else getattr(stcal, path[0])
        assert path[-1] in holder.__all__, name
        found[name] = getattr(holder, path[-1])
    return found


@cache
def used(module: str) -> frozenset[int]:
    """Identities of what a module imports by name, wherever in it, and of what the workflows that it imports do."""
    tree, names, found = ast.parse(inspect.getsource(import_module(module))), {}, set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("stcal"):
            for each in node.names:
                holder = import_module(node.module)
                value = getattr(holder, each.name, None) or import_module(f"{node.module}.{each.name}")
                names[each.asname or each.name] = value
                found.add(id(value))
            if node.module.startswith("stcal.workflows"):
                found |= used(node.module)
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            holder = names.get(node.value.id)
            found |= {id(getattr(holder, node.attr, None))} if isinstance(holder, ModuleType) else set()
    return frozenset(found)


def calls_it(command: Callable, function: object) -> bool:
    return id(function) in used(inspect.unwrap(command).__module__)


def test_every_command_is_in_the_table():
    assert set(TABLE) == set(COMMANDS)
    assert {command for command, cell in TABLE.items() if cell.startswith("none: ")} == APART


@pytest.mark.parametrize("command", sorted(set(COMMANDS) - APART))
def test_a_command_calls_public_functions(command):
    functions = functions_of(command)
    assert functions
    assert {name for name, function in functions.items() if not calls_it(COMMANDS[command], function)} - INSIDE == set()


INSIDE = {"sfm.detect_circles", "handeye.handeye", "robot.load_universal", "workflows.read_handeye"}
"""Beside what the command calls: the same for one image, for arrays, with an error for other files, and at once."""


def test_what_is_not_called_is_found():
    assert not calls_it(COMMANDS["sfm run"], stcal.sfm.plan)
    assert calls_it(COMMANDS["robot design"], robot.design)  # by its module


def call(*words) -> str:
    result = CliRunner().invoke(app, list(map(str, words)), catch_exceptions=False)
    assert result.exit_code == 0
    return result.output


def test_exposure_times_and_capture(tmp_path):
    times = locate.exposure_times(1, 100, 5)
    assert [float(line) for line in call("locate", "schedule", 1, 100, 5).splitlines()] == pytest.approx(
        times, rel=1e-5
    )
    from PIL import Image

    Image.fromarray(np.tile(np.arange(0, 250, dtype=np.uint8), (40, 1))).save(tmp_path / "scene.png")
    shown = "--simulate", tmp_path / "scene.png", "--shortest", "0.5", "--longest", "2", "--count", "3"
    call("locate", "capture", tmp_path / "scenes", *shown)
    source = stcal.SimulatedSource(tmp_path / "scene.png")
    taken = locate.capture(source, locate.exposure_times(0.5, 2, 3), tmp_path / "own")
    answer = json.loads((tmp_path / "scenes/scene-1/capture.json").read_text(encoding="utf-8"))
    assert json.loads(json_text(taken)) == answer
    refuses("E-OUTPUT-EXISTS … own", locate.capture, source, [1.0], tmp_path / "own")
    refuses("E-FIELD-TYPE … count", locate.exposure_times, 1, 100, 2.5)


def test_arguments_of_other_types_are_refused(tmp_path):
    """Answers are held in the tests of each system."""
    camera = stcal.Camera(640, 480, [450.0, 450.0], [319.5, 239.5], np.zeros(8))
    arm = mh80()
    data = robot.Measurements.from_arrays(np.zeros((3, 6)), np.zeros((3, 3)))
    refuses("E-FIELD-TYPE … two", stcal.compare_cameras, camera, tmp_path / "b.txt")
    refuses("E-FIELD-TYPE … Evaluation", robot.evaluated_csv, data)
    refuses("E-OPTION-VALUE … refit", robot.evaluate, {"arm": arm}, data, "all")


def test_load_universal(tmp_path):
    lists = {"theta": 6 * [1e-4], "a": 6 * [1e-5], "d": 6 * [2e-5], "alpha": 6 * [-1e-4]}
    lines = [f"delta_{key} = {values}" for key, values in lists.items()]
    lines += ["a = [0, -0.425, -0.392, 0, 0, 0]", "d = [0.089, 0, 0, 0.109, 0.095, 0.082]"]
    lines += ["alpha = [1.5707963, 0, 0, 1.5707963, -1.5707963, 0]"]
    (tmp_path / "calibration.conf").write_text("\n".join(lines), encoding="utf-8")
    call("robot", "convert", tmp_path / "calibration.conf", tmp_path / "arm.toml")
    found = robot.load_universal(tmp_path / "calibration.conf")
    q = np.full((1, 6), 0.3)
    written = robot.load_robot(tmp_path / "arm.toml")
    np.testing.assert_allclose(robot.forward(found.robot, q).matrix(), robot.forward(written, q).matrix(), atol=1e-6)
    (tmp_path / "none.yaml").write_text("a: 1\n", encoding="utf-8")
    refuses("E-ROBOT-FORM … none.yaml", robot.load_universal, tmp_path / "none.yaml")


def test_simulated_cameras(tmp_path):
    own = stcal.Camera(640, 480, [450.0, 450.0], [319.5, 239.5], np.zeros(8))
    options = synthetic.SceneOptions(width=324, height=216, images_per_group=2, groups=(("1", "2"),), distance_mm=500)
    scene = synthetic.make_scene(options, camera=own)
    np.testing.assert_array_equal(scene.camera.focal, own.focal)
    words = "--images", 2, "--width", 324, "--distance", 500, "--groups", "12", "--fisheye", 120, "--workers", 1
    call("sfm", "simulate", tmp_path / "wide", *words)
    wide = replace(options, fisheye_deg=120.0)
    synthetic.write_dataset(tmp_path / "own", synthetic.make_scene(wide), workers=1)
    assert (tmp_path / "own/cameras.txt").read_text() == (tmp_path / "wide/cameras.txt").read_text()
    refuses("E-OPTION-CONFLICT … two cameras", synthetic.make_scene, wide, camera=own)
    refuses("E-OPTION-RANGE … fisheye_deg 20", replace, options, fisheye_deg=20.0)


def test_goals_in_the_base(tmp_path):
    from PIL import Image

    rng = np.random.default_rng(3)
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        Image.fromarray(photo(tilted(30))).save(tmp_path / name / "1.png")
    results = list(locate.run(locate.find_scenes(tmp_path), LAYOUT, CAMERA))
    mount = stcal.Rigid.exp([0.1, 0.2, 0.3, 100, 20, 500])
    xyz_a = rng.uniform(-300, 300, (12, 3))
    xyz_b = mount @ xyz_a + rng.normal(0, 0.01, (12, 3))
    chain = locate.goal_chain(registration=register.register(xyz_a, xyz_b), offset=stcal.Rigid())
    found = locate.goals(results, chain)
    assert (set(found.base_from_goal), found.notes) == ({"one", "two"}, ())
    assert found.covariance["one"].shape == (6, 6)
    assert [line.split(",")[0] for line in locate.poses_csv(results, chain).splitlines()[1:]] == ["one", "two"]
    flange = stcal.Rigid.exp([0, 0, 1, 400, 0, 300])
    moving = locate.goal_chain(mount, robot_poses={"one": flange, "two": flange})
    on_flange = locate.goals(results, moving).base_from_goal
    np.testing.assert_allclose(
        on_flange["one"].matrix(), (flange @ mount @ results[0].pose.camera_from_obj).matrix(), atol=1e-9
    )
    one, similar = {"one": flange}, register.register(xyz_a, xyz_b * 1.1, model="similarity")
    refuses("E-ROBOT-POSES-SCENE … none of scene two", locate.goals, results, locate.goal_chain(mount, robot_poses=one))
    refuses("E-OPTION-MISSING … neither … registration", locate.goal_chain)
    refuses("E-REGISTER-FILE … similarity", locate.goal_chain, registration=similar)


def test_a_hand_eye_result_leads_to_the_base():
    rng = np.random.default_rng(5)
    mount, board = stcal.Rigid.exp([0.1, 0.2, 0.3, 60, 20, 50]), stcal.Rigid.exp([0.3, 0, 0, 900, 0, 0])
    flange = stcal.Poses.of([stcal.Rigid.exp([*rng.normal(0, 0.5, 3), *rng.normal(300, 80, 3)]) for _ in range(12)])
    seen = (flange @ mount).inverse() @ board
    found = handeye.handeye(base_from_flange=flange, camera_from_board=seen, method="park-martin")
    chain = locate.goal_chain(found, robot_poses={"one": flange[0]})
    assert chain.moving
    np.testing.assert_allclose(chain.mount.rigid.matrix(), mount.matrix(), atol=1e-6)
    refuses("E-OPTION-MISSING … the camera is on the flange", locate.goal_chain, found)
