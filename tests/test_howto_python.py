"""The scripts of docs/howto/python.md run, from public names alone, and a type checker knows what they use."""

import ast
import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import stcal
from stcal import Camera, Poses, Rigid, robot
from stcal.boards.board_designs import TagLayout
from stcal.robot.kinematics.robot_model import mh80
from tests.levels import FULL, SLOW
from tests.support.areas import homography, rendered

ROOT = Path(__file__).resolve().parents[1]
BLOCK = re.compile(r"^## (\d+)\. .*?^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)
SCRIPTS = dict(BLOCK.findall((ROOT / "docs" / "howto" / "python.md").read_text(encoding="utf-8")))
CAMERA = Camera(320, 240, [500.0, 500.0], [159.5, 119.5], np.zeros(8))
LAYOUT = TagLayout.from_tags("4X4_50", [3, 7], [[0.0, 0.0], [50.0, 0.0]], [30.0, 25.0], [0.0, 90.0])
TRUTH = Rigid.exp([0.3, 0.2, 0.1, -25.0, 5.0, 300.0])
FLANGE_FROM_CAMERA = Rigid.exp([0.1, 0.2, -0.3, 30.0, -20.0, 90.0])
B_FROM_A = Rigid.exp([0.3, -0.2, 0.5, 1000.0, 50.0, -200.0])
WRONG = [4, 11]  # rows of `points.npz` that are off by 20 mm
HOLDS = {
    "1": lambda found: len(found["seen"]) > 60,
    "2": lambda found: 0.001 < found["table"].residual_x_px.std() < 0.05,
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


def test_scripts_are_short():
    assert list(SCRIPTS) == [str(k) for k in range(1, 12)]
    assert [k for k, code in SCRIPTS.items() if len(code.replace("\n\n", "\n").splitlines()) > 15] == []


@pytest.mark.parametrize("number", SCRIPTS)
def test_names_are_public(number):
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
    stcal.save_camera(folder / "camchain.yaml", CAMERA, "kalibr", "cam0")
    stcal.save_camera(folder / "scene-camera.txt", CAMERA)
    place = homography(np.array([[500.0, 0, 159.5], [0, 500.0, 119.5], [0, 0, 1]]), TRUTH.rotation, TRUTH.translation)
    Image.fromarray(rendered(LAYOUT, place, (320, 240), rng)).save(folder / "scene.png")
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
