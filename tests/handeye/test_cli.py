"""``stcal handeye`` as a user types it."""

import json

import numpy as np
import pytest
import yaml

from stcal.design import BoardDesign
from stcal.geometry.rigid import Poses, Rigid
from stcal.handeye import METHODS
from stcal.io.cameras.read import read_camera
from stcal.io.table import pose_cells
from tests.boards.drawn import chessboard_mm
from tests.handeye.photographed import CAMERA, looks, photographs, sheet_of_dots
from tests.handeye.written import poses_file, sides_of, table
from tests.outcome import COMPUTATION, INPUT, assert_error
from tests.support.handeye import FLANGE_FROM_CAMERA, simulated

NOISE = {"robot": (2e-4, 0.1), "camera": (5e-4, 0.2)}


def in_sigmas(data: dict, name: str, true: Rigid) -> float:
    """How far a transform is off, in units of its covariance: chi of six degrees of freedom."""
    off = Poses.of([Rigid.from_matrix(data[name])]).difference(Poses.of([true]))[0]
    return float(np.sqrt(off @ np.linalg.solve(np.array(data["covariance"]), off)))


EXACT = ("--sigma-robot-deg", 0, "--sigma-robot-mm", 0, "--sigma-board-mm", 0)
"""Of drawn boards, and poses that they are drawn from."""
CHANCE = 5.8
"""Squared, over 6: F with 6 and 70 degrees of freedom (σ come from a dozen poses) exceeds it once in 10 000 times."""


@pytest.mark.slow
@pytest.mark.parametrize(("setup", "splits"), [("eye-in-hand", 2), ("eye-to-hand", 15)])
def test_a_file_of_poses(command, tmp_path, setup, splits):
    truth = simulated(np.random.default_rng(5), 12, setup, **NOISE)
    source, out = poses_file(tmp_path / "poses.csv", truth), tmp_path / "deep" / "handeye.json"
    more = ("--splits", splits) if splits != 15 else ()
    code, shown, _ = command(source, "--setup", setup, "--out", out, *more)
    assert code == 0
    data = json.loads(out.read_text())
    in_hand = setup == "eye-in-hand"
    camera, board = ("flange_from_camera", "base_from_board") if in_hand else ("base_from_camera", "flange_from_board")
    assert {camera, board} < data.keys()
    assert not {"flange_from_camera", "base_from_camera"} <= data.keys()
    assert 0.01 < in_sigmas(data, camera, truth.mount_from_camera) < CHANCE
    assert np.array(data[f"{board}_covariance"]).shape == (6, 6)
    assert [row["name"] for row in data["poses"]][:2] == ["line 2", "line 3"]
    assert data["outliers"] == []
    assert "time_offset" not in data
    # A board's pose by robot and X is off by about the noise of both, and the error of X.
    assert 0.05 < data["held_out"]["translation_mm"] < 2
    for text in (camera, board, f"held out ({splits} × 3 of 12 poses)", f"written: {out}"):
        assert text in shown


def test_outliers_are_named_by_line(command, tmp_path):
    """By σ that are stated, too."""
    truth = simulated(np.random.default_rng(5), 15, **NOISE)
    stated = ("--sigma-robot-deg", 0.012, "--sigma-robot-mm", 0.1, "--sigma-camera-deg", 0.03, "--sigma-camera-mm", 0.2)

    def edit(rows):
        rows[6][0] = repr(float(rows[6][0]) + 15)

    out = tmp_path / "h.json"
    code, shown, _ = command(poses_file(tmp_path / "poses.csv", truth, edit), *stated, "--out", out, "--splits", 0)
    data = json.loads(out.read_text())
    assert data["estimated"] == []
    assert data["sigma"]["camera_rad"] == pytest.approx(np.radians(0.03))
    assert (code, data["outliers"], data["held_out"]) == (0, ["line 8"], None)
    assert [row["name"] for row in data["poses"] if not row["used"]] == ["line 8"]
    assert "without 1 that contradicts them: line 8" in shown
    assert in_sigmas(data, "flange_from_camera", FLANGE_FROM_CAMERA) < CHANCE


@pytest.mark.slow
def test_all_methods_are_compared(command, tmp_path):
    truth = simulated(np.random.default_rng(6), 12, **NOISE)
    everything, page = tmp_path / "all.json", tmp_path / "page.html"
    code, shown, _ = command(
        poses_file(tmp_path / "poses.csv", truth),
        *("--method", "all", "--splits", 2, "--json", everything, "--report", page),
    )
    assert code == 0
    data = json.loads(everything.read_text())
    assert [row["method"] for row in data["methods"]] == [name for name in METHODS if name != "reprojection"]
    rows = {line.split()[0]: line.split()[1:] for line in shown.splitlines() if line.split()[:1] and line[0] != " "}
    for row in data["methods"]:
        assert np.shape(row["splits"]["translation_mm"]) == (2, 3)
        mean = row["held_out"]["translation_mm"]
        assert rows[row["method"]][1] == f"{mean:.3f}"
        assert row["method"] in page.read_text()
    assert data["method"] == "pose"
    assert np.shape(data["splits"]["rows"]) == (2, 3)


@pytest.fixture(scope="module")
def chessboard(tmp_path_factory):
    """Six photographs of a board that looks the same after half a turn, by a camera rolled all the way round."""
    seen = looks(np.random.default_rng(11), 6, np.array([70, 50]), np.pi)
    toml = 'type = "chessboard"\nrows = 6\ncolumns = 8\nsquare_mm = 20\n'
    return photographs(tmp_path_factory.mktemp("chess"), *chessboard_mm(6, 8, 20.0), seen, toml)


@pytest.mark.slow
def test_images_of_a_symmetric_chessboard(command, chessboard, tmp_path):
    names = ("h.json", "ros.yaml", "h.urdf", "cv.yaml", "page.html", "cameras.txt")
    out, ros, urdf, opencv, page, camera = (tmp_path / name for name in names)
    code, shown, _ = command(
        *chessboard.arguments(),
        *("--workers", 1, "--splits", 1, "--refine-camera", "--out", out, "--ros", ros, "--urdf", urdf, *EXACT),
        *("--opencv", opencv, "--parent", "tool0", "--report", page, "--camera-out", camera),
    )
    assert code == 0
    data = json.loads(out.read_text())
    # Half a turn of the board is not told by the images: Z may be of either numbering, X is the same.
    assert in_sigmas(data, "flange_from_camera", FLANGE_FROM_CAMERA) < CHANCE
    off = Rigid.from_matrix(data["flange_from_camera"]).translation - FLANGE_FROM_CAMERA.translation
    assert 1e-4 < np.linalg.norm(off) < 0.5
    assert any("numbered from another end" in note for note in data["notes"])
    assert data["held_out"]["board_mm"] < 0.1
    assert data["camera"]["model"] == "OPENCV"  # the file states no distortion: it is found to be none
    assert read_camera(camera).focal == pytest.approx(CAMERA.focal, rel=2e-3)
    assert yaml.safe_load(ros.read_text())["header"]["frame_id"] == "tool0"
    assert 'link="tool0"' in urdf.read_text()
    assert "flange_from_camera: !!opencv-matrix" in opencv.read_text()
    text = page.read_text()
    assert "Camera, as adjusted" in text
    assert text.count('alt="coverage of the image"') == 1
    # Photographs numbered from another end have their corners where the adjustment predicts them: to 0.1 px or so.
    assert 0 < max(row["corner_rms_px"] for row in data["poses"]) < 0.5
    for path in (out, ros, urdf, opencv, page, camera):
        assert f"written: {path}" in shown


@pytest.mark.slow
def test_images_of_dots_whose_size_is_wrong(command, tmp_path):
    """Dots drawn with a pitch of 20 mm; the file says 25, and radii as much too large."""
    true = BoardDesign(6, 8, 20.0, 6.0, "dark", 0.0, (0, 0), 9.0)
    sheet, first_mm = sheet_of_dots(true.xy_mm(), true.radii_mm())
    toml = 'rows = 6\ncolumns = 8\npitch_mm = 25\nradius_mm = 7.5\npolarity = "dark"\nsigma_mm = 0.1\n'
    toml += "[corner]\nrow = 0\ncolumn = 0\nradius_mm = 11.25\n"
    seen = looks(np.random.default_rng(12), 8, np.array([70, 50]), 1.0)
    files = photographs(tmp_path, sheet, first_mm, seen, toml)
    (files.images / "extra.png").write_bytes((files.images / "0.png").read_bytes())
    with files.poses.open("a") as more:
        more.write(",".join(["gone.png", *pose_cells(Rigid())]) + "\n")
    out = tmp_path / "h.json"
    code, shown, _ = command(*files.arguments(), "--workers", 1, "--splits", 0, "--with-scale", "--out", out, *EXACT)
    assert code == 0
    data = json.loads(out.read_text())
    sigma = data["board"]["scale_sigma"]
    assert abs(data["board"]["scale"] - 0.8) < 5 * sigma < 0.01
    assert data["board"]["pitch_mm"] == pytest.approx(20, abs=0.1)
    assert "stated 25 mm" in shown
    assert data["corner_px_is_factor"]
    assert {each["name"]: each["reason"] for each in data["left_out"]} == {
        "extra.png": "no row in poses.csv",
        "gone.png": "no such image, in a row of poses.csv",
    }
    assert in_sigmas(data, "flange_from_camera", FLANGE_FROM_CAMERA) < CHANCE


def test_what_images_need_is_said(command, chessboard, tmp_path):
    poses = poses_file(tmp_path / "poses.csv", simulated(np.random.default_rng(10), 12, **NOISE))
    images, camera_out = chessboard.arguments(), ("--camera-out", tmp_path / "c.txt")
    for words, said in (
        ((chessboard.images, "--poses", chessboard.poses), "--camera, --board needed with images"),
        ((tmp_path / "none.csv",), "does not exist"),
        ((poses, "--board", chessboard.board), "--board: only with a folder of images"),
        ((poses, "--refine-camera"), "--refine-camera: only with images"),
        ((*images, *camera_out), "only with --refine-camera"),
        ((*images, "--refine-camera", *camera_out, "--method", "shah"), "shah does not adjust the camera"),
    ):
        assert_error(command(*words), INPUT, said)
    header, *cells = (line.split(",", 1) for line in chessboard.poses.read_text().splitlines())
    for rows, code, parts in (
        (["a.png", "b.png"], INPUT, ["no row is of an image in"]),
        (["0.png", "1.png"], COMPUTATION, ["2 poses, 3 needed", "left out before, first 2.png: no row in poses.csv"]),
    ):
        lines = [header, *([name, own] for name, (_, own) in zip(rows, cells, strict=False))]
        poses.write_text("".join(f"{name},{own}\n" for name, own in lines))
        assert_error(command(images[0], "--poses", poses, *images[3:], "--workers", 1), code, *parts)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--export", "ros2=poses.csv"), "--export poses.csv: is an input of this command; give another name"),
        (("--export", "ros2=a", "--export", "easy-handeye=a"), "--export a: is also what --export writes"),
        (("--export", "ros2=a", "--out", "a"), "--export a: is also what --out writes"),
        (("--export", "ros2"), "--export ros2: no file; give ros2=FILE"),
        (("--export", "kuka=a"), "--export kuka: unknown; one of ros2, easy-handeye, "),
        (("--ros", "a", "--camera-frame", "link", "--parent", "camera_optical_frame"), "both 'camera_optical_frame'"),
        (("--parent", "tool0"), "--parent, --child, --camera-frame: only with --ros, --urdf or --export"),
        (("--sigma-px", 0.1), "--sigma-px, --sigma-board-mm: only with images"),
        (("--sigma-robot-mm", 0.1), "both or none needed"),
        (("--method", "de", "--de-bounds-deg", "1,2"), "--de-bounds-deg 1,2: one number, X,Y,Z,± or closed-form,±"),
        (("--method", "de", "--de-bounds-mm", "-5"), "positive half width needed"),
        (("--method", "pose", "--de-bounds-mm", 3), "only with --method de, de-polished or all"),
        (("--length-unit", "m"), "the names of columns state unit, rotation and direction; leave --length-unit out"),
        (("--time-offset",), "--time-offset needs the robot's poses as a stream with times"),
        (("--image-times", "times.csv"), "--image-times: only with a folder of images"),
    ],
)
def test_options_that_cannot_be_are_refused(command, tmp_path, monkeypatch, words, message):
    source = poses_file(tmp_path / "poses.csv", simulated(np.random.default_rng(5), 8, **NOISE))
    monkeypatch.chdir(tmp_path)
    before = source.read_text()
    assert_error(command("poses.csv", "--splits", 0, *words), INPUT, message)
    assert source.read_text() == before
    assert list(tmp_path.iterdir()) == [source]


def test_the_order_of_quaternions_is_an_option_and_evolution_begins_where_it_is_told(command, tmp_path):
    def roll(rows):
        for row in rows:
            row[3:7], row[10:14] = [*row[4:7], row[3]], [*row[11:14], row[10]]

    truth = simulated(np.random.default_rng(5), 8, **NOISE)
    path, out = poses_file(tmp_path / "poses.csv", truth, roll), tmp_path / "h.json"
    said = "x, y, z, w in the order of their columns, give --quaternions xyzw"
    assert_error(command(path, "--splits", 0), INPUT, said)
    code, _, err = command(path, "--splits", 0, "--quaternions", "xyzw", "--out", out)
    assert code == 0, err
    assert in_sigmas(json.loads(out.read_text()), "flange_from_camera", truth.mount_from_camera) < 5
    truth = simulated(np.random.default_rng(3), 12, **NOISE)
    path, out = poses_file(tmp_path / "poses.csv", truth), tmp_path / "found.json"
    words = ("--method", "de", "--splits", 0, "--out", out, "--overwrite")
    assert command(path, *words, "--de-bounds-deg", "closed-form,10", "--de-bounds-mm", "closed-form,20")[0] == 0
    near = Rigid.from_matrix(json.loads(out.read_text())["flange_from_camera"])
    assert np.linalg.norm(near.translation - FLANGE_FROM_CAMERA.translation) < 5
    assert command(path, *words, "--de-bounds-deg", "0,0,90,45", "--de-bounds-mm", 1)[0] == 0
    far = Rigid.from_matrix(json.loads(out.read_text())["flange_from_camera"])
    assert np.abs(far.matrix() - near.matrix()).max() > 1e-6


def test_an_answer_not_to_use_has_a_remedy_and_fails_where_strict(command, tmp_path):
    """Both sides inverted, as after the wrong one of two pieces of advice."""
    truth = simulated(np.random.default_rng(10), 8, **NOISE)
    sides = {name: poses.inverse() for name, poses in sides_of(truth.pairs).items()}
    quick = ("--method", "pose", "--splits", 1)
    words = (table(tmp_path / "poses.csv", sides), *quick)
    code, out, _ = command(*words)
    starts = ("May I use it?", "what to do:")
    verdict, remedy = (next(line for line in out.splitlines() if line.startswith(start)) for start in starts)
    assert (code, "No: " in verdict) == (0, True)
    assert "flange_from_base" in remedy
    assert "board_from_camera" in remedy
    assert command(*words, "--quiet") == (0, "", f"warning: {verdict}\n")
    code, _, err = command(*words, "--strict", "--out", tmp_path / "h.json")
    assert (code, (tmp_path / "h.json").exists()) == (4, True)
    assert err.splitlines()[-1].startswith("error: --strict: failed: ")
    assert command(poses_file(tmp_path / "good.csv", truth), *quick, "--strict")[0] == 0
