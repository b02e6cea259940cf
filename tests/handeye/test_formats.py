"""``stcal handeye`` of files of other programs, as a user types it."""

import json

import numpy as np
import pytest
from markupsafe import escape

from stcal.geometry.rigid import Poses
from stcal.report.document import sentence
from tests.boards.drawn import chessboard_mm
from tests.handeye.photographed import looks, photographs
from tests.handeye.test_cli import EXACT, INPUT, NOISE, command, poses_file  # noqa: F401
from tests.handeye.written import FORMATS, MODEL_MM, colmap_text, easy_handeye, matrices, zivid
from tests.support.handeye import simulated

QUICK = ("--method", "pose", "--splits", 0)


@pytest.fixture(scope="module")
def truth():
    return simulated(np.random.default_rng(5), 12, **NOISE)


@pytest.mark.slow
@pytest.mark.parametrize("name", FORMATS)
def test_every_format_gives_the_same_answer(command, tmp_path, truth, name):  # noqa: F811
    own, other = tmp_path / "own.json", tmp_path / "other.json"
    assert command(poses_file(tmp_path / "poses.csv", truth), *QUICK, "--out", own)[0] == 0
    (tmp_path / "in").mkdir()
    code, shown, _ = command(*FORMATS[name](tmp_path / "in", truth.pairs), *QUICK, "--out", other)
    assert code == 0
    wanted, found = (json.loads(path.read_text()) for path in (own, other))
    # Rounded in another place: what the descent, which ends at 1e-9 of σ or so, makes of it is far below a nanometre.
    assert np.array(found["flange_from_camera"]) == pytest.approx(np.array(wanted["flange_from_camera"]), abs=1e-6)
    assert "understood" not in wanted
    assert len(found["understood"]) >= 2
    assert shown.splitlines()[: len(found["understood"])] == found["understood"]


def test_the_report_says_what_files_were_taken_for(command, tmp_path, truth):  # noqa: F811
    page = tmp_path / "report.html"
    code, shown, _ = command(*FORMATS["KUKA"](tmp_path, truth.pairs), *QUICK, "--report", page)
    assert code == 0
    assert f"<li>{escape(sentence(shown.splitlines()[0]))}</li>" in page.read_text()


def test_a_dry_run_says_what_it_understood_and_writes_nothing(command, tmp_path, truth):  # noqa: F811
    arguments = FORMATS["KUKA"](tmp_path, truth.pairs)
    code, shown, _ = command(*arguments, "--dry-run", "--out", tmp_path / "h.json", "--setup", "eye-in-hand")
    assert code == 0
    lines = shown.splitlines()
    assert lines[0].startswith(
        "robot: robot.csv: table; 12 poses; base_from_flange by default; a, b, c as Euler angles ZYX"
    )
    assert "degrees; mm by the columns" in lines[0]
    assert lines[1].startswith(
        "camera: camera.npy: NumPy array; 12 poses; camera_from_board by default; 4×4 matrices; mm by"
    )
    assert lines[2:5] == [
        "rows joined by their order, for neither file has names or times",
        "setup: eye-in-hand, as you say",
        "pairs: 12",
    ]
    assert lines[5].startswith("motions: the flange turns about 3 axes (")
    assert not (tmp_path / "h.json").exists()
    code, shown, _ = command(poses_file(tmp_path / "poses.csv", truth), "--dry-run")
    assert code == 0
    assert "poses.csv: table; 12 poses; base_from_flange by its columns; quaternions by name; mm" in shown


def test_a_dry_run_says_what_motion_is_missing(command, tmp_path, truth):  # noqa: F811
    still = matrices(truth.pairs.base_from_flange)
    still[:, :3, :3] = still[0, :3, :3]
    np.savez(tmp_path / "p.npz", base_from_flange=still, camera_from_board=matrices(truth.pairs.camera_from_board))
    code, shown, _ = command(tmp_path / "p.npz", "--dry-run")
    assert code == 0
    assert "turns about 0 axes" in shown
    assert "too little to calibrate: " in shown


def test_the_setup_that_a_file_states_is_taken(command, tmp_path):  # noqa: F811
    truth = simulated(np.random.default_rng(5), 12, "eye-to-hand", **NOISE)
    arguments = easy_handeye(tmp_path, truth.pairs, "eye_on_base")
    code, shown, _ = command(*arguments, *QUICK)
    assert code == 0
    assert "flange_from_base as easy_handeye writes it of eye-to-hand" in shown
    assert "base_from_camera" in shown
    code, _, err = command(*arguments, *QUICK, "--setup", "eye-in-hand")
    assert code == INPUT
    assert "of a setup eye-to-hand, --setup eye-in-hand; leave the option out" in err
    arguments = easy_handeye(tmp_path, truth.pairs, "")  # as its server leaves it: --setup tells
    assert command(*arguments, *QUICK, "--setup", "eye-to-hand")[0] == 0


def test_the_unit_of_a_model_is_solved_for(command, tmp_path, truth):  # noqa: F811
    arguments = [
        each for each in colmap_text(tmp_path, truth.pairs, MODEL_MM) if each not in ("--length-unit", "camera=m")
    ]
    out = tmp_path / "h.json"
    code, shown, _ = command(*arguments, "--splits", 0, "--out", out)
    assert code == 0
    assert "the model has no unit: --with-scale is implied" in shown
    board = json.loads(out.read_text())["board"]
    sigma = MODEL_MM * board["scale_sigma"]
    assert abs(board["unit_mm"] - MODEL_MM) < 4 * sigma < 0.5
    assert f"model: its unit is {board['unit_mm']:.6g} ± {sigma:.2g} mm" in shown


def test_options_that_a_table_does_not_need(command, tmp_path, truth):  # noqa: F811
    code, _, err = command(poses_file(tmp_path / "poses.csv", truth), "--length-unit", "m")
    assert code == INPUT
    assert "the names of columns state unit and rotation; leave --length-unit out" in err


@pytest.mark.slow
def test_a_folder_of_zivid_beside_images(command, tmp_path):  # noqa: F811
    seen = looks(np.random.default_rng(11), 3, np.array([70, 50]), 0.4)
    toml = 'type = "chessboard"\nrows = 6\ncolumns = 8\nsquare_mm = 20\n'
    files = photographs(tmp_path, *chessboard_mm(6, 8, 20.0), seen, toml)
    own = tmp_path / "own.json"
    camera = ("--camera", files.camera, "--board", files.board, "--workers", 1, "--splits", 0, *EXACT)
    assert command(files.images, "--poses", files.poses, *camera, "--method", "pose", "--out", own)[0] == 0
    rows = [line.split(",") for line in files.poses.read_text().splitlines()[1:]]
    numbers = np.array([row[1:] for row in rows], float)
    (tmp_path / "zivid").mkdir()
    for row, m in zip(rows, matrices(Poses.from_quaternions(numbers[:, 3:], numbers[:, :3])), strict=True):
        (tmp_path / "zivid" / f"pos0{row[0].split('.')[0]}.yaml").write_text(zivid(m))
    out = tmp_path / "h.json"
    code, shown, _ = command(files.images, "--poses", tmp_path / "zivid", *camera, "--method", "pose", "--out", out)
    assert code == 0
    assert (
        "robot: zivid: folder of Zivid pose file; 3 poses; base_from_flange by default; 4×4 matrices; mm as in Zivid"
        in shown
    )
    assert "images matched by the number at the end of each name, like pos00 and 0.png" in shown
    wanted, found = (np.array(json.loads(path.read_text())["flange_from_camera"]) for path in (own, out))
    assert found == pytest.approx(wanted, abs=1e-6)
    (tmp_path / "zivid" / "pos07.yaml").write_text((tmp_path / "zivid" / "pos00.yaml").read_text())
    code, shown, _ = command(files.images, "--poses", tmp_path / "zivid", *camera, "--dry-run")
    assert code == 0
    assert "images: 3 of 3 with a pose of the robot; the board was not looked for" in shown
    assert "left out pos07: no such image, in a row of zivid" in shown
    np.save(tmp_path / "stack.npy", matrices(Poses.from_quaternions(numbers[:, 3:], numbers[:, :3])))
    code, shown, _ = command(files.images, "--poses", tmp_path / "stack.npy", *camera, "--dry-run")
    assert "images matched by order, for the poses have no names: pose 1 is of 0.png" in shown
