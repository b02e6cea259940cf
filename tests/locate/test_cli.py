"""``stcal locate`` from files to files."""

import json

import cv2
import numpy as np
import pytest

from stcal.geometry.rigid import Rigid
from stcal.io.table import POSE, pose_cells, read_table
from stcal.locate.layout import load_layout
from tests.fuzzing.stock import write_tags
from tests.locate.drawn_target import LAYOUT, PER_MM, SHEET_MM, sheet, tilted
from tests.outcome import program
from tests.shared import write_rows, written

locate = program("stcal", "locate")


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """The stock's scene ``a``, another one without tags, and five photographs of the target above a board of dots."""
    root = tmp_path_factory.mktemp("locate") / "tags"
    write_tags(root, np.random.default_rng(1), with_dots(), 5)
    (root / "scenes/empty").mkdir()
    cv2.imwrite(str(root / "scenes/empty/1.png"), np.full((900, 1200), 99, np.uint8))
    flange = pose_cells(Rigid.exp([1, 0, 0, 400, 0, 300]))
    write_rows(root / "robot.csv", ["scene", *POSE], [[name, *flange] for name in ("a", "empty")])
    return root


@pytest.fixture
def run(locate, files):
    target = ["--layout", files / "layout.toml", "--camera", files / "cameras.txt"]
    return lambda scenes, *options: locate("run", files / "scenes" / scenes, *target, *options)


def test_run_writes_accepted_poses(run, files, tmp_path):
    out, record, report = tmp_path / "poses.csv", tmp_path / "all.json", tmp_path / "page.html"
    robot = ["--hand-eye", files / "handeye.json", "--robot-poses", files / "robot.csv"]
    code, shown, _ = run("", *robot, "--out", out, "--json", record, "--report", report)
    assert code == 0
    (row,) = (line.split() for line in shown.splitlines() if line.startswith("a ") and "accept" in line)
    assert row[:4] == ["a", "accept", "6", "2"]
    assert "no tag of" in shown
    table = read_table(out, "poses")
    assert table.text("scene") == ["a"]
    seen, goal = table.poses()[0], table.poses("base_from_goal_")[0]
    assert np.linalg.norm((seen @ tilted(30).inverse()).log()[:3]) < np.radians(0.2)
    chain = Rigid.exp([1, 0, 0, 400, 0, 300]) @ Rigid.exp([0, 0, 1, 0, 0, 50]) @ seen
    assert np.abs(goal.matrix() - chain.matrix()).max() < 1e-6
    assert (np.linalg.eigvalsh(table.pose_covariances("base_from_goal_")[0]) > 0).all()
    assert "# empty: reject: no tag of" in out.read_text()
    scenes = {scene["name"]: scene for scene in json.loads(record.read_text())["scenes"]}
    assert scenes["empty"]["verdict"]["decision"] == "reject"
    assert scenes["empty"]["camera_from_obj"] is None
    assert all(check["passed"] for check in scenes["a"]["verdict"]["checks"])
    assert len(scenes["a"]["pose"]["residuals_px"]) == 24
    page = report.read_text()
    assert page.count("<svg") == 3  # of each image
    assert "http://" not in page.replace("http://www.w3.org", "")


@pytest.mark.slow
def test_limits_are_options(run):
    image = "a/1.png"
    assert run(image)[0] == 0
    patent = ("error 0.", "area px²", "det J 1/mm²", "kept", "patent: assumed where the text has no formula")
    for options, parts in [
        (("--min-foreshortening", 0.9), ("foreshortening 0.87",)),
        (("--max-sigma-mm", 0.001), ("sigma of position",)),
        (("--method", "patent", "--e-lim-px", 0.001), ("no pose accepted in 1 scene", *patent)),
    ]:
        code, shown, _ = run(image, *options)
        assert code == 3
        assert [part for part in parts if part not in shown] == []


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["--robot-poses", "x.csv"], "neither of --hand-eye"),
        (["--offset", "x.json"], "neither of --hand-eye and --registration"),
        (["--hand-eye", "x.json", "--registration", "y.json"], "both of --hand-eye and --registration"),
        (["--flip-odds", "2"], "odds between 0 and 1"),
        (["--s-dis", "3"], "S_dis 3"),
        (["--moved-px", "-1"], "moved_px -1"),
    ],
)
def test_options_that_make_no_sense(run, arguments, reason):
    code, _, error = run("", *arguments)
    assert code == 2
    assert reason in error
    assert error.count("\n") == 1


BOARD = 'rows = 4\ncolumns = 9\npitch_mm = 20.0\nradius_mm = 6.0\npolarity = "dark"\n'


def with_dots() -> np.ndarray:
    """The target above a board of dots, on one sheet 220 × 320 mm; the board's origin at (30, 230) mm."""
    printed = np.full((320 * PER_MM, int(SHEET_MM[0]) * PER_MM), 255, np.uint8)
    printed[: sheet().shape[0]] = sheet()
    for row in range(4):
        for column in range(9):
            # the middle of a pixel stands for a place half a pixel on
            middle = [int(16 * (mm * PER_MM - 0.5)) for mm in (30 + 20 * column, 230 + 20 * row)]
            cv2.circle(printed, middle, 16 * 6 * PER_MM, 0, -1, cv2.LINE_AA, shift=4)
    return printed


@pytest.mark.slow
def test_calibrate_with_a_board_of_dots(locate, files, tmp_path):
    out, record, board = (tmp_path / name for name in ("calibrated.toml", "calibrated.json", "board.toml"))
    code, shown, _ = locate(
        *("calibrate", files / "images", "--camera", files / "cameras.txt", "--board", written(board, BOARD)),
        *("--layout", files / "plan.toml", "--out", out, "--json", record, "--workers", 1),
    )
    assert code == 0
    assert "5 images, 6 tags" in shown
    layout = load_layout(out)
    # Drawn to a sixth of a millimetre and seen with 2 pixels a millimetre.
    assert np.abs(layout.corners_mm - LAYOUT.corners_mm).max() < 0.15
    middle = np.array(json.loads(record.read_text())["board_from_obj"])[:3, 3]
    there = SHEET_MM / 2 - [30, 230]
    half_turn = np.array([160, 60]) - there
    assert min(np.abs(middle[:2] - there).max(), np.abs(middle[:2] - half_turn).max()) < 0.15
