"""Every command calls a public function, as the table of docs/howto/python.md says, and the two have one answer: those
of a run in `tests/sfm/test_functions.py`, of photographs that come in `tests/sfm/runs/`. The scripts of that page run,
from public names alone, and a type checker knows what they use."""

import ast
import inspect
import json
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from importlib import import_module
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

import stcal
from stcal import Camera, Poses, Rigid, handeye, locate, register, robot, synthetic
from stcal.boards.board_designs import TagLayout
from stcal.cli.main import app
from stcal.io.files import json_text
from stcal.robot.kinematics.robot_model import mh80
from tests.commands import COMMANDS
from tests.levels import FULL, SLOW
from tests.locate.drawn_target import CAMERA, LAYOUT, photo, tilted
from tests.outcome import refuses
from tests.support.areas import homography, rendered

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "howto" / "python.md"
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


def test_every_command_is_in_the_table_and_calls_public_functions():
    assert set(TABLE) == set(COMMANDS)
    assert {command for command, cell in TABLE.items() if cell.startswith("none: ")} == APART
    assert not calls_it(COMMANDS["sfm run"], stcal.sfm.plan)
    assert calls_it(COMMANDS["robot design"], robot.design)  # by its module
    for command in sorted(set(COMMANDS) - APART):
        functions = functions_of(command)
        assert functions
        others = {name for name, function in functions.items() if not calls_it(COMMANDS[command], function)}
        assert others <= INSIDE, command


INSIDE = {"sfm.detect_circles", "handeye.handeye", "robot.load_universal", "workflows.read_handeye"}
"""Beside what the command calls: the same for one image, for arrays, with an error for other files, and at once."""


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


BLOCK = re.compile(r"^## (\d+)\. .*?^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)
SCRIPTS = dict(BLOCK.findall(PAGE.read_text(encoding="utf-8")))
SCENE_CAMERA = Camera(320, 240, [500.0, 500.0], [159.5, 119.5], np.zeros(8))
TWO_TAGS = TagLayout.from_tags("4X4_50", [3, 7], [[0.0, 0.0], [50.0, 0.0]], [30.0, 25.0], [0.0, 90.0])
TRUTH = Rigid.exp([0.3, 0.2, 0.1, -25.0, 5.0, 300.0])
FLANGE_FROM_CAMERA = Rigid.exp([0.1, 0.2, -0.3, 30.0, -20.0, 90.0])
B_FROM_A = Rigid.exp([0.3, -0.2, 0.5, 1000.0, 50.0, -200.0])
WRONG = [4, 11]  # rows of `points.npz` that are off by 20 mm
HOLDS = {
    "1": lambda found: len(found["seen"]) > 60,
    "2": lambda found: 0.001 < np.std([x for _, _, x, _ in found["rows"]]) < 0.05,
    "4": lambda found: found["pose"].status == "certain",
    "5": lambda found: found["same"].same_as(found["camera"]),
    "6": lambda found: (FLANGE_FROM_CAMERA.inverse() @ found["found"].mount_from_camera).angle_rad() < 5e-4,
    "7": lambda found: sorted(found["found"].outliers.tolist()) == WRONG,
    "8": lambda found: 0.02 < found["found"].held_out.position_mm.mean() < 0.15,  # 0.03 mm on each of three axes
    "9": lambda found: found["found"].verdict.decision == "accept",
    "10": lambda found: found["result"].checks[-1].verdict == "passed",
    "11": lambda found: np.abs(found["s"].values["places"].array - found["true"]).max() < 0.05,  # σ 0.012 mm
}
"""What the variables of a script hold in the end, where its inputs have a known truth."""


def test_scripts_are_short_and_names_public():
    assert list(SCRIPTS) == [str(k) for k in range(1, 12)]
    assert [k for k, code in SCRIPTS.items() if len(code.replace("\n\n", "\n").splitlines()) > 15] == []
    for number in SCRIPTS:
        systems = {"stcal": stcal}
        for node in ast.walk(ast.parse(SCRIPTS[number])):
            if isinstance(node, ast.ImportFrom) and node.module == "stcal":
                systems |= {each.name: import_module(f"stcal.{each.name}") for each in node.names}
            elif isinstance(node, ast.Import | ast.ImportFrom):
                assert "stcal." not in ast.unparse(node)
        used = [node for node in ast.walk(ast.parse(SCRIPTS[number])) if isinstance(node, ast.Attribute)]
        own = [(node.value.id, node.attr) for node in used if isinstance(node.value, ast.Name)]
        assert [each for each in own if each[0] in systems and each[1] not in systems[each[0]].__all__] == []


def write_inputs(folder: Path) -> None:
    """Writes the files that the page names, small ones, but for its ``demo``."""
    rng = np.random.default_rng(5)
    stcal.save_camera(folder / "camchain.yaml", SCENE_CAMERA, "kalibr", "cam0")
    stcal.save_camera(folder / "scene-camera.txt", SCENE_CAMERA)
    place = homography(np.array([[500.0, 0, 159.5], [0, 500.0, 119.5], [0, 0, 1]]), TRUTH.rotation, TRUTH.translation)
    Image.fromarray(rendered(TWO_TAGS, place, (320, 240), rng)).save(folder / "scene.png")
    turns, shifts = rng.uniform(-0.8, 0.8, (12, 3)), rng.uniform(-200, 200, (12, 3))
    hand = Poses.of(Rigid.exp([*turn, *shift]) for turn, shift in zip(turns, shifts, strict=True))
    board = FLANGE_FROM_CAMERA.inverse() @ hand.inverse() @ Rigid.exp([0.1, 3.0, 0.2, 700.0, 100.0, -300.0])
    board = board.moved(rng.normal(0, [2e-4] * 3 + [0.1] * 3, (12, 6)))
    metres = np.array([[1, 1, 1, 1e-3]] * 3 + [[1, 1, 1, 1]])
    np.savez(folder / "poses.npz", base_from_flange=metres * hand.matrix(), camera_from_board=metres * board.matrix())
    xyz_a = rng.uniform(-500, 500, (20, 3))
    xyz_b = B_FROM_A @ xyz_a + rng.normal(0, 0.05, (20, 3))
    xyz_b[WRONG] += [20.0, 0.0, 0.0]
    np.savez(folder / "points.npz", xyz_a=xyz_a, xyz_b=xyz_b)
    arm, limits = mh80(), mh80().limits()
    dh = np.array([[row.a, row.alpha, row.d, row.theta] for row in arm.rows])
    true = robot.Robot.from_dh(dh + rng.normal(0, [0.3, 1e-3, 0.3, 1e-3], dh.shape), "standard", limits)
    q = rng.uniform(*(0.7 * limits.T), (40, 6))
    xyz = robot.forward(true, q).translation + rng.normal(0, 0.03, (40, 3))
    np.savez(folder / "arm.npz", dh=dh, limits=limits, q=q, xyz=xyz)
    (folder / "arm.urdf").write_text(robot.robot_urdf(arm), encoding="utf-8")


@SLOW
@pytest.mark.parametrize("number", SCRIPTS)
def test_a_script_runs(number, once, small_dataset, small_run, tmp_path, monkeypatch):
    for entry in once.folder("howto-python", write_inputs).iterdir():
        (tmp_path / entry.name).symlink_to(entry)
    (tmp_path / "demo").mkdir()
    (tmp_path / "demo/data").symlink_to(small_dataset)
    (tmp_path / "demo/run").symlink_to(small_run)
    monkeypatch.chdir(tmp_path)
    before = {entry.name for entry in tmp_path.iterdir()}
    found = {"__name__": f"task_{number}"}
    exec(compile(SCRIPTS[number], f"task {number}", "exec"), found)
    assert HOLDS.get(number, bool)(found)
    made = {"camera.yaml", "again.yaml"} if number == "5" else set()
    assert {entry.name for entry in tmp_path.iterdir()} - before == made


@FULL
def test_a_type_checker_knows_what_the_scripts_use(tmp_path):
    for number, code in SCRIPTS.items():
        (tmp_path / f"task_{number}.py").write_text(code, encoding="utf-8")
    program = Path(sys.executable).parent / "pyrefly"
    words = [program, "check", "--preset", "default", "--python-interpreter-path", sys.executable]
    words += ["--search-path", ROOT, tmp_path]
    ended = subprocess.run(words, capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stdout) == (0, "")
