"""The scripts of docs/howto/python.md run, from public names alone, and type checkers know what they use."""

import ast
import json
import os
import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

import stcal
from stcal import robot, sfm, synthetic
from stcal.geometry.rigid import Poses, Rigid
from stcal.robot.kinematics.model import mh80
from stcal.synthetic.dataset import write_dataset
from tests.levels import FULL, SLOW
from tests.locate.test_arrays import CAMERA, LAYOUT, TRUTH
from tests.support.areas import homography, rendered

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "howto" / "python.md"
BLOCK = re.compile(r"^## (\d+)\. .*?^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)
SCRIPTS = {int(number): code for number, code in BLOCK.findall(PAGE.read_text(encoding="utf-8"))}
MOST_LINES = 15
SMALL = synthetic.SceneOptions(seed=3, width=1296, height=864, images_per_group=4, groups=(("1", "2"), ("1", "4")))
FLANGE_FROM_CAMERA = Rigid.exp([0.1, 0.2, -0.3, 30.0, -20.0, 90.0])
B_FROM_A = Rigid.exp([0.3, -0.2, 0.5, 1000.0, 50.0, -200.0])
WRONG = (4, 11)
"""Rows of ``points.npz`` that are off by 20 mm."""


def code_lines(code: str) -> list[str]:
    return [line for line in code.splitlines() if line.strip()]


def private_names(code: str) -> list[str]:
    """Names of stcal in a script that no ``__all__`` lists."""
    tree, found, systems = ast.parse(code), [], {"stcal": stcal}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found += [each.name for each in node.names if each.name.startswith("stcal.")]
        elif isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "stcal":
            found += [node.module] if node.module != "stcal" else []
            found += [each.name for each in node.names if each.name not in stcal.__all__]
            systems |= {e.name: import_module(f"stcal.{e.name}") for e in node.names if e.name in stcal.__all__}
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in systems:
            found += [] if node.attr in systems[node.value.id].__all__ else [f"{node.value.id}.{node.attr}"]
    return found


def test_twelve_scripts_are_short_and_use_public_names():
    assert sorted(SCRIPTS) == list(range(1, 13))
    assert {k: n for k, code in SCRIPTS.items() if (n := len(code_lines(code))) > MOST_LINES} == {}
    assert {k: names for k, code in SCRIPTS.items() if (names := private_names(code))} == {}


def test_private_names_are_found():
    assert private_names("from stcal.sfm import pipeline") == ["stcal.sfm", "pipeline"]
    assert private_names("from stcal import sfm\nsfm.pipeline.run()") == ["sfm.pipeline"]
    assert private_names("import stcal\nstcal.io.toml") == ["stcal.io"]


def write_inputs(folder: Path) -> None:
    """Writes the files that the page names, small ones."""
    scene = synthetic.make_scene(SMALL)
    write_dataset(folder / "demo" / "data", scene)
    sfm.run(folder / "demo/data/images", scene.camera, folder / "demo" / "run")
    rng = np.random.default_rng(5)
    stcal.save_camera(folder / "camchain.yaml", scene.camera, "kalibr", "cam0")
    hand = Poses.of(
        Rigid.exp([*turn, *shift])
        for turn, shift in zip(rng.uniform(-0.8, 0.8, (12, 3)), rng.uniform(-200, 200, (12, 3)), strict=True)
    )
    board = FLANGE_FROM_CAMERA.inverse() @ hand.inverse() @ Rigid.exp([0.1, 3.0, 0.2, 700.0, 100.0, -300.0])
    noisy = board.moved(rng.normal(0, [2e-4] * 3 + [0.1] * 3, (12, 6)))
    metres = {
        name: np.array([[1, 1, 1, 1e-3]] * 3 + [[1, 1, 1, 1]]) * poses.matrix()
        for name, poses in (("base_from_flange", hand), ("camera_from_board", noisy))
    }
    np.savez(folder / "poses.npz", **metres)
    xyz_a = rng.uniform(-500, 500, (20, 3))
    xyz_b = B_FROM_A @ xyz_a + rng.normal(0, 0.05, (20, 3))
    xyz_b[list(WRONG)] += [20.0, 0.0, 0.0]
    np.savez(folder / "points.npz", xyz_a=xyz_a, xyz_b=xyz_b)
    arm = mh80()
    dh = np.array([[row.a, row.alpha, row.d, row.theta] for row in arm.rows])
    limits = arm.limits()
    q = rng.uniform(*(0.7 * limits.T), (40, 6))
    true = robot.Robot.from_dh(dh + rng.normal(0, [0.3, 1e-3, 0.3, 1e-3], dh.shape), "standard", limits)
    xyz = robot.forward(true, q).translation + rng.normal(0, 0.03, (40, 3))
    np.savez(folder / "arm.npz", dh=dh, limits=limits, q=q, xyz=xyz)
    (folder / "arm.urdf").write_text(robot.robot_urdf(arm), encoding="utf-8")
    place = homography(np.array([[500.0, 0, 159.5], [0, 500.0, 119.5], [0, 0, 1]]), TRUTH.rotation, TRUTH.translation)
    from PIL import Image

    Image.fromarray(rendered(LAYOUT, place, (320, 240), np.random.default_rng(1))).save(folder / "scene.png")
    stcal.save_camera(folder / "scene-camera.txt", CAMERA)


@pytest.fixture(scope="module")
def inputs(once):
    return once.folder("howto-python", write_inputs)


def off(pose: Rigid, truth: Rigid) -> tuple[float, float]:
    """Angle in rad, and distance in mm."""
    between = truth.inverse() @ pose
    return between.angle_rad(), float(np.linalg.norm(between.translation))


def judge_scripts(number: int, found: dict) -> None:
    """Asserts what a script's variables hold, where its inputs have a known truth."""
    if number == 1:
        assert len(found["seen"]) > 60
        assert 0.001 < np.median(found["seen"].sigma_px) < 0.05
    if number == 2:
        assert set(found["table"].columns) >= {"image", "label", "residual_x_px"}
        assert 0.001 < found["table"].residual_x_px.std() < 0.05
    if number == 3:
        angle, apart = off(
            found["result"].target.target_from_face["2"], found["scene"].target_from_face["2"]
        )  # frames through planes and through three circles, which are placed to 0.02 mm
        assert angle < 1e-3
        assert apart < 0.1
    if number == 4:
        assert found["pose"].status == "certain"
        assert found["tracker"].searched  # after the black frame
    if number == 5:
        assert found["same"].same_as(found["camera"])
        assert stcal.load_camera("camera.yaml").same_as(stcal.load_camera("again.yaml"))
    if number == 6:
        angle, apart = off(found["found"].mount_from_camera, FLANGE_FROM_CAMERA)
        assert angle < 5e-4  # 2e-4 rad and 0.1 mm of noise in 12 poses
        assert apart < 0.3
    if number == 7:
        assert sorted(found["found"].outliers.tolist()) == list(WRONG)
        angle, apart = off(found["found"].b_from_a, B_FROM_A)
        assert apart < 0.1
    if number == 8:
        assert 0.02 < found["found"].held_out.position_mm.mean() < 0.15  # length of 0.03 mm on three axes, grown
    if number == 9:
        assert found["found"].verdict.decision == "accept"
        assert found["found"].pose.covariance.shape == (6, 6)
    if number == 10:
        assert found["result"].checks[-1].verdict == "passed"
    if number == 11:
        assert Path("circles.png").stat().st_size > 10_000


@SLOW
@pytest.mark.parametrize("number", sorted(SCRIPTS))
def test_a_script_runs(number, inputs, tmp_path, monkeypatch):
    import matplotlib

    for entry in inputs.iterdir():
        (tmp_path / entry.name).symlink_to(entry)
    monkeypatch.chdir(tmp_path)
    matplotlib.use("agg")
    before = {entry.name for entry in tmp_path.iterdir()}
    if number == 2:
        pytest.importorskip("pandas")
    if number == 12:  # its processes load the program, which must therefore be a file
        program = tmp_path.with_suffix(".py")
        program.write_text(SCRIPTS[number], encoding="utf-8")
        words, setting = [sys.executable, program], os.environ | {"PYTHONPATH": str(ROOT)}
        ended = subprocess.run(words, capture_output=True, text=True, check=True, env=setting)
        assert ended.stdout.count("may I use it? ") == 5
        assert set(re.findall("note|Note|Traceback|leaked", ended.stderr)) <= {"Note"}  # those of the pool
    else:
        found = {"__name__": f"task_{number}"}
        exec(compile(SCRIPTS[number], f"task {number}", "exec"), found)
        judge_scripts(number, found)
    made = {5: {"camera.yaml", "again.yaml"}, 11: {"circles.png"}}
    assert {entry.name for entry in tmp_path.iterdir()} - before == made.get(number, set())


@pytest.fixture(scope="module")
def typed(tmp_path_factory):
    folder = tmp_path_factory.mktemp("typed")
    for number, code in SCRIPTS.items():
        (folder / f"task_{number}.py").write_text(code, encoding="utf-8")
    return folder


@FULL  # basedpyright, which holds the same in `.ci/run`, takes a fifth of its time
def test_mypy_is_strict_about_the_scripts(typed):
    pytest.importorskip("mypy")
    words = [
        sys.executable,
        "-m",
        "mypy",
        "--strict",
        "--cache-dir",
        typed / "cache",
        *typed.glob("*.py"),
    ]
    ended = subprocess.run(words, cwd=typed, capture_output=True, text=True, check=False)
    assert "checked" in ended.stdout or "no issues" in ended.stdout, ended.stdout + ended.stderr
    # In a clone mypy is strict about stcal's own modules, too; an installed package is not looked into.
    assert [line for line in ended.stdout.splitlines() if "task_" in line.partition(":")[0]] == []


ANY = {f"report{kind}" for kind in ("Any", "UnknownMemberType", "UnknownVariableType", "UnknownArgumentType")}
"""Rules of basedpyright about types that are Any, or partly unknown."""


OF_OTHERS = re.compile(r"^(table|ax|figure|np)\b|as_quat\(\)$")
"""Expressions of pandas, matplotlib, numpy and SciPy, which are not all typed."""


def segment(diagnostic: dict, lines: list[str]) -> str:
    """The expression that a diagnostic is about."""
    start, end = diagnostic["range"]["start"], diagnostic["range"]["end"]
    return lines[start["line"]][start["character"] : end["character"]]


@SLOW
def test_basedpyright_finds_no_any_of_stcal(typed):
    settings = {"typeCheckingMode": "standard", "extraPaths": [str(ROOT)], **dict.fromkeys(ANY, "warning")}
    (typed / "pyrightconfig.json").write_text(json.dumps(settings), encoding="utf-8")
    program = Path(sys.executable).parent / "basedpyright"
    ended = subprocess.run(
        [program, "--outputjson", "--pythonpath", sys.executable, "-p", typed],
        capture_output=True,
        text=True,
        check=False,
    )
    found = json.loads(ended.stdout)["generalDiagnostics"]
    assert [each["message"] for each in found if each["severity"] == "error"] == []
    lines = {path.name: path.read_text(encoding="utf-8").splitlines() for path in typed.glob("*.py")}
    segments = [segment(each, lines[Path(each["file"]).name]) for each in found]
    assert len(segments) > 10  # elements of arrays are Any to it, which are numpy's
    assert [each for each in segments if "." in each and not OF_OTHERS.search(each)] == []
