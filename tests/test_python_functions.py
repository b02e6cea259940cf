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
from stcal.locate.layout import layout_toml
from stcal.robot.kinematics.model import mh80
from stcal.robot.use.report import evaluation_file
from tests.commands import COMMANDS
from tests.locate.drawn_target import CAMERA, LAYOUT, photo, tilted
from tests.outcome import fails_with
from tests.support.simulated_arms import joint_vectors

PAGE = Path(__file__).resolve().parents[1] / "docs" / "howto" / "python.md"
ROW = re.compile(r"^\| `stcal([ -])([\w -]+)` \| (.+) \|$", re.MULTILINE)
TABLE = {words: cell for _, words, cell in ROW.findall(PAGE.read_text(encoding="utf-8"))}
"""Cells of the table by the words of the command, ``sfm run``."""
APART = {"sfm demo", "robot init"}
"""Commands without a function of their own; the table says why."""


def functions_of(command: str) -> dict[str, object]:
    """The functions that the table names for a command."""
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
    """Whether the module of a command uses a function or its class."""
    return id(function) in used(inspect.unwrap(command).__module__)


def test_every_command_is_in_the_table():
    assert set(TABLE) == set(COMMANDS)
    assert {command for command, cell in TABLE.items() if cell.startswith("none: ")} == APART


@pytest.mark.parametrize("command", sorted(set(COMMANDS) - APART))
def test_a_command_calls_public_functions(command):
    functions = functions_of(command)
    assert functions
    assert {name for name, function in functions.items() if not calls_it(COMMANDS[command], function)} - INSIDE == set()


INSIDE = {"sfm.detect_circles", "handeye.handeye", "robot.load_universal"}
"""Beside what the command calls: the same for one image, for arrays, and with an error for other files."""


def test_what_is_not_called_is_found():
    assert not calls_it(COMMANDS["sfm run"], stcal.sfm.plan)
    assert calls_it(COMMANDS["robot design"], robot.design)  # by its module


# --- the answers of quick ones ---


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
    with fails_with("E-OUTPUT-EXISTS … own"):
        locate.capture(source, [1.0], tmp_path / "own")
    with fails_with("E-FIELD-TYPE … count"):
        locate.exposure_times(1, 100, 2.5)


def test_compare_cameras(tmp_path):
    one = stcal.Camera(640, 480, [450.0, 450.0], [319.5, 239.5], np.zeros(8))
    two = stcal.Camera(640, 480, [455.0, 455.0], [319.5, 239.5], np.zeros(8))
    for name, camera in (("a.txt", one), ("b.txt", two)):
        stcal.save_camera(tmp_path / name, camera, "colmap")
    from stcal.report.camera import comparison_text

    found = stcal.compare_cameras(one, two)
    assert call("camera", "compare", tmp_path / "a.txt", tmp_path / "b.txt") == "\n".join(comparison_text(found)) + "\n"
    assert np.nanmax(found.lengths()) == pytest.approx(5 / 450 * np.hypot(319.5, 239.5), rel=0.02)
    with fails_with("E-FIELD-TYPE … two"):
        stcal.compare_cameras(one, tmp_path / "b.txt")


def test_evaluate_and_compensate(tmp_path):
    arm, rng = mh80(), np.random.default_rng(2)
    q = joint_vectors(arm, 12, rng)
    xyz = robot.forward(arm, q).translation + rng.normal(0, 0.05, (12, 3))
    head = [f"q{k}_deg" for k in range(1, 7)] + ["x_mm", "y_mm", "z_mm"]
    rows = [head, *np.hstack([np.degrees(q), xyz]).astype(str).tolist()]
    (tmp_path / "data.csv").write_text("".join(f"{','.join(row)}\n" for row in rows), encoding="utf-8")
    robot.save_robot(tmp_path / "arm.toml", arm)
    files = tmp_path / "data.csv", "--robot", tmp_path / "arm.toml"
    call("robot", "evaluate", *files, "--json", tmp_path / "a.json")
    data = robot.read_measurements(tmp_path / "data.csv", arm)
    found = robot.evaluate({"arm": robot.load_robot(tmp_path / "arm.toml")}, data)
    call("robot", "evaluate", *files, "--out", tmp_path / "a.csv")
    assert robot.evaluated_csv(found) == (tmp_path / "a.csv").read_text(encoding="utf-8")
    with fails_with("E-FIELD-TYPE … Evaluation"):
        robot.evaluated_csv(data)
    assert json.loads(json_text(evaluation_file(found))) == json.loads(
        (tmp_path / "a.json").read_text(encoding="utf-8")
    )
    with fails_with("E-OPTION-VALUE … refit"):
        robot.evaluate({"arm": arm}, data, "all")
    (tmp_path / "q.csv").write_text("".join(f"{','.join(row[:6])}\n" for row in rows), encoding="utf-8")
    call(
        "robot",
        "compensate",
        tmp_path / "q.csv",
        *files[1:],
        "--nominal",
        files[2],
        "--out",
        tmp_path / "sent.csv",
    )
    sent = robot.compensate(arm, robot.read_targets(tmp_path / "q.csv", arm), arm)
    assert robot.compensated_csv(sent, arm) == (tmp_path / "sent.csv").read_text(encoding="utf-8")


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
    with fails_with("E-ROBOT-FORM … none.yaml"):
        robot.load_universal(tmp_path / "none.yaml")


def test_simulated_cameras(tmp_path):
    own = stcal.Camera(640, 480, [450.0, 450.0], [319.5, 239.5], np.zeros(8))
    options = synthetic.SceneOptions(width=640, height=426, images_per_group=2, groups=(("1", "2"),), distance_mm=500)
    scene = synthetic.make_scene(options, camera=own)
    np.testing.assert_array_equal(scene.camera.focal, own.focal)
    words = "--images", 2, "--width", 640, "--distance", 500, "--groups", "12", "--fisheye", 120
    call("sfm", "simulate", tmp_path / "wide", *words)
    wide = replace(options, height=427, fisheye_deg=120.0)
    synthetic.write_dataset(tmp_path / "own", synthetic.make_scene(wide))
    assert (tmp_path / "own/cameras.txt").read_text() == (tmp_path / "wide/cameras.txt").read_text()
    with fails_with("E-OPTION-CONFLICT … two cameras"):
        synthetic.make_scene(wide, camera=own)
    with fails_with("E-OPTION-RANGE … fisheye_deg 20"):
        replace(options, fisheye_deg=20.0)


def test_goals_in_the_base(tmp_path):
    from PIL import Image

    rng = np.random.default_rng(3)
    photo_of = photo(tilted(30))
    for name in ("one", "two"):
        (tmp_path / "scenes" / name).mkdir(parents=True)
        Image.fromarray(photo_of).save(tmp_path / "scenes" / name / "1.png")
    (tmp_path / "layout.toml").write_text(layout_toml(LAYOUT), encoding="utf-8")
    stcal.save_camera(tmp_path / "camera.txt", CAMERA, "colmap")
    xyz = rng.uniform(-300, 300, (12, 3))
    mount = stcal.Rigid.exp([0.1, 0.2, 0.3, 100, 20, 500])
    (tmp_path / "points.csv").write_text(
        "\n".join(
            ["ax_mm,ay_mm,az_mm,bx_mm,by_mm,bz_mm"]
            + [",".join(map(str, row)) for row in np.hstack([xyz, mount @ xyz + rng.normal(0, 0.01, (12, 3))])]
        ),
        encoding="utf-8",
    )
    call("register", tmp_path / "points.csv", "--out", tmp_path / "register.json")
    (tmp_path / "offset.json").write_text(json.dumps({"obj_from_goal": np.eye(4).tolist()}), encoding="utf-8")
    words = "--layout", tmp_path / "layout.toml", "--camera", tmp_path / "camera.txt", "--out", tmp_path / "poses.csv"
    led = "--registration", tmp_path / "register.json", "--offset", tmp_path / "offset.json"
    call("locate", "run", tmp_path / "scenes", *words, *led)

    camera = stcal.load_camera(tmp_path / "camera.txt")
    layout = locate.load_layout(tmp_path / "layout.toml")
    results = list(locate.run(locate.find_scenes(tmp_path / "scenes"), layout, camera))
    pairs = register.read_pairs(tmp_path / "points.csv")
    chain = locate.goal_chain(registration=register.register(pairs.xyz_a, pairs.xyz_b), offset=stcal.Rigid())
    assert locate.poses_csv(results, chain) == (tmp_path / "poses.csv").read_text(encoding="utf-8")
    found = locate.goals(results, chain)
    assert (set(found.base_from_goal), found.notes) == ({"one", "two"}, ())
    assert found.covariance["one"].shape == (6, 6)

    flange = stcal.Rigid.exp([0, 0, 1, 400, 0, 300])
    moving = locate.goal_chain(mount, robot_poses={"one": flange, "two": flange})
    on_flange = locate.goals(results, moving).base_from_goal
    np.testing.assert_allclose(
        on_flange["one"].matrix(), (flange @ mount @ results[0].pose.camera_from_obj).matrix(), atol=1e-9
    )
    with fails_with("E-ROBOT-POSES-SCENE … none of scene two"):
        locate.goals(results, locate.goal_chain(mount, robot_poses={"one": flange}))
    with fails_with("E-OPTION-MISSING … registration needed"):
        locate.goal_chain()
    with fails_with("E-REGISTER-FILE … similarity"):
        locate.goal_chain(registration=register.register(pairs.xyz_a, pairs.xyz_b * 1.1, model="similarity"))


def test_a_hand_eye_result_leads_to_the_base():
    rng = np.random.default_rng(5)
    mount, board = stcal.Rigid.exp([0.1, 0.2, 0.3, 60, 20, 50]), stcal.Rigid.exp([0.3, 0, 0, 900, 0, 0])
    flange = stcal.Poses.of([stcal.Rigid.exp([*rng.normal(0, 0.5, 3), *rng.normal(300, 80, 3)]) for _ in range(12)])
    seen = (flange @ mount).inverse() @ board
    found = handeye.handeye(flange, seen, setup="eye-in-hand", method="park-martin")
    chain = locate.goal_chain(found, robot_poses={"one": flange[0]})
    assert chain.moving
    np.testing.assert_allclose(chain.mount.rigid.matrix(), mount.matrix(), atol=1e-6)
    with fails_with("E-OPTION-MISSING … the camera is on the flange"):
        locate.goal_chain(found)
