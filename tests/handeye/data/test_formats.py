"""The same poses, written in each format, are read as the same poses; other formats and false pairs are refused."""

from pathlib import Path

import numpy as np
import pytest

from stcal.errors import InputError
from stcal.handeye import HandEyePoses, read_poses
from stcal.handeye.data.pose_content import Said
from stcal.handeye.data.pose_files import read_robot
from stcal.handeye.data.pose_pairs import inverted
from stcal.handeye.data.pose_partners import rows_of_images
from stcal.io.table import COVARIANCE
from stcal.workflows.handeye_inputs import Files
from tests.handeye.test_cli import NOISE
from tests.handeye.written import FORMATS, REFUSED, easy_handeye, poses_file, sides_of, table
from tests.outcome import INPUT, assert_error, refuses
from tests.shared import written
from tests.support.handeye import simulated

PAIRS = simulated(np.random.default_rng(5), 7).pairs
ROUNDING = 1e-9
"""rad and mm: rotations go through quaternions and angles, lengths of a metre through metres."""


def read(arguments, path=None):
    options = {"--rotation": [], "--length-unit": [], "--poses-are": [], "--a": [], "--b": []}
    own = list(arguments)
    source = own.pop(0) if not own[0].startswith("--") else None
    for name, value in zip(own[::2], own[1::2], strict=True):
        options[name].append(value)
    said = Said.of_options(options["--rotation"], options["--length-unit"], options["--poses-are"])
    first, second = (source, None) if source is not None else (options["--a"][0], Path(options["--b"][0]))
    return Files(Path(first), second=second, statements=said).read()


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_gives_the_same_poses(name, tmp_path):
    found = read(FORMATS[name](tmp_path, PAIRS))
    for name, wanted in sides_of(PAIRS).items():
        assert np.abs(getattr(found.pairs, name).difference(wanted)).max() < ROUNDING
    assert len(found.understood) >= 2
    assert found.left_out == ()


@pytest.mark.parametrize("name", REFUSED)
def test_other_formats_are_refused_in_a_line(name, tmp_path):
    """As the robot's poses beside images, as one of two files, and as pairs."""
    path = written(tmp_path / "poses", REFUSED[name])
    np.save(tmp_path / "b.npy", np.array([pose.matrix() for pose in PAIRS.camera_from_board])[:1])
    for call in (
        lambda: read_robot(path, Said()),
        Files(path, second=tmp_path / "b.npy", statements=Said(rotation="rotvec-rad", length_unit="m")).read,
        Files(path).read,
    ):
        with pytest.raises(InputError) as caught:
            call()
        message = str(caught.value)
        assert "\n" not in message
        assert str(path) in message


def test_names_of_rows_are_those_of_images(tmp_path):
    """Without folder and ending too, where that leaves one image and one row."""
    columns = ",".join(f"base_from_flange_{c}" for c in ("x_m", "y_m", "z_m", "qw", "qx", "qy", "qz"))
    row = "0.png,0.1,0.2,0.3,1,0,0,0\n"
    twice = read_robot(written(tmp_path / "poses.csv", f"image,{columns}\n{row}g/{row}"), Said())
    refuses("E-POSE-REPEATED … line 2 and line 3 … 'g/0.png'", rows_of_images, twice, ["g/0.png"])
    np.savez(tmp_path / "r.npz", base_from_flange=np.tile(np.eye(4), (3, 1, 1)), images=["0", "1", "10"])
    found = read_robot(tmp_path / "r.npz", Said(length_unit="mm"))
    assert rows_of_images(found, ["a/0.png", "a/10.png", "a/7.png"]) == ({"a/0.png": 0, "a/10.png": 2}, ("1",), "")
    refuses("E-IMAGE-NAME-AMBIGUOUS … pose 2 … 1 … a/1.png … b/1.png", rows_of_images, found, ["a/1.png", "b/1.png"])


OWN = ",".join(f"base_from_flange_{c}" for c in ("x_mm", "y_mm", "z_mm", "qw", "qx", "qy", "qz"))
RTDE = "timestamp " + " ".join(f"actual_TCP_pose_{i}" for i in range(6))
VINS = "".join(f"14036365797635558{i:02},0.1,0.2,0.{i},0.8,0.0,0.0,0.6\n" for i in range(3))
"""Of w first and no header, where TUM's files have seconds and w last."""


@pytest.mark.parametrize(
    ("text", "rotation", "order", "names", "place", "turned"),
    [
        (f"image,{OWN}\na.png,1,2,3,0,0.8,0,0.6\n", None, "xyzw", ("a.png",), [1, 2, 3], {(0, 2): 0.96, (1, 1): 1}),
        (f"{RTDE}\n0.008 0.21 -0.2 0.3 0 0 0.5\n", None, "wxyz", ("0.008",), [210, -200, 300], {(1, 0): np.sin(0.5)}),
        (",x,y,z,qx,qy,qz,qw\n0,0.1,0.2,0.3,0,0,0.6,0.8\n", None, "wxyz", ("0",), [100, 200, 300], {(1, 0): 0.96}),
        (VINS, "wxyz", "wxyz", None, [100, 200, 0], {(1, 0): 0.96}),
        (VINS, "xyzw", "wxyz", None, [100, 200, 0], {(2, 1): 0.96}),
    ],
)
def test_tables_of_other_programs_are_read(tmp_path, text, rotation, order, names, place, turned):
    """By the order of columns, a recording of UR's RTDE, an index without a name, and VINS, by either order."""
    found = read_robot(written(tmp_path / "r.csv", text), Said(rotation=rotation), order)
    assert found.names == (names or found.names)
    assert found.poses.translation[0] == pytest.approx(place)
    for at, value in turned.items():
        assert found.poses.rotation[0][at] == pytest.approx(value)


@pytest.mark.parametrize(
    ("text", "said", "error"),
    [
        (VINS, Said(), "E-ROTATION-AMBIGUOUS … r.csv … wxyz or xyzw"),
        ("X,Y,Z,Rx,Ry,Rz\n100,200,300,10,20,35\n", Said(rotation="ur-rotvec"), "E-ANGLE-UNIT … 35 … rotvec-deg"),
    ],
)
def test_rotations_that_cannot_be_told_are_refused(tmp_path, text, said, error):
    refuses(error, read_robot, written(tmp_path / "r.csv", text), said)


QUICK = ("--method", "pose", "--splits", 0)


@pytest.fixture(scope="module")
def truth():
    return simulated(np.random.default_rng(5), 12, **NOISE)


def test_a_dry_run_says_what_it_understood_and_what_motion_is_missing_and_writes_nothing(command, tmp_path, truth):
    arguments = FORMATS["KUKA"](tmp_path, truth.pairs)
    code, shown, _ = command(*arguments, "--dry-run", "--out", tmp_path / "h.json", "--setup", "eye-in-hand")
    assert code == 0
    lines = shown.splitlines()
    for line, text in (
        (0, "robot: robot.csv: table; 12 poses; base_from_flange by default; a, b, c as Euler angles ZYX"),
        (1, "camera: camera.npy: NumPy array; 12 poses; camera_from_board by default; 4×4 matrices; mm by"),
        (2, "rows joined by their order, for neither file has names or times"),
        (3, "setup: eye-in-hand, as you say"),
        (4, "pairs: 12"),
    ):
        assert lines[line].startswith(text)
    assert "degrees; mm by the columns" in lines[0]
    assert len(lines) == 5
    assert not (tmp_path / "h.json").exists()
    code, shown, _ = command(poses_file(tmp_path / "poses.csv", truth), "--dry-run")
    assert code == 0
    assert (
        "poses.csv: table; 12 poses; base_from_flange by the columns base_from_flange_…; quaternions by name; mm"
        in shown
    )
    still = truth.pairs.base_from_flange.matrix()
    still[:, :3, :3] = still[0, :3, :3]
    np.savez(tmp_path / "p.npz", base_from_flange=still, camera_from_board=truth.pairs.camera_from_board.matrix())
    code, shown, _ = command(tmp_path / "p.npz", "--dry-run")
    assert code == 0
    assert "motions: the flange turns by 0° (RMS) between poses; rotate the flange" in shown


def test_the_setup_that_a_file_states_is_taken(command, tmp_path):
    truth = simulated(np.random.default_rng(5), 12, "eye-to-hand", **NOISE)
    arguments = easy_handeye(tmp_path, truth.pairs, "eye_on_base")
    code, shown, _ = command(*arguments, *QUICK)
    assert code == 0
    assert "flange_from_base as easy_handeye writes it of eye-to-hand" in shown
    assert "base_from_camera" in shown
    said = "of eye-to-hand, --setup eye-in-hand; leave it out"
    assert_error(command(*arguments, *QUICK, "--setup", "eye-in-hand"), INPUT, said)
    arguments = easy_handeye(tmp_path, truth.pairs, "")  # as its server leaves it: --setup tells
    assert command(*arguments, *QUICK, "--setup", "eye-to-hand")[0] == 0


EIGHT = simulated(np.random.default_rng(1), 8, camera=(1e-3, 0.3))


def test_bad_cells_and_sides_identical_poses_a_board_that_did_not_follow_and_false_matrices_are_named(tmp_path):
    for row, column, cell, error in (
        (2, 0, "nan", "E-TABLE-NUMBER … 4 … base_from_flange_x_mm … 'nan'"),
        (5, 13, "3", "E-QUATERNION-LENGTH … line 7"),
        (0, 8, "abc", "E-TABLE-NUMBER … 2 … camera_from_board_y_mm … 'abc'"),
    ):
        path = poses_file(tmp_path / "poses.csv", EIGHT, lambda rows: rows[row].__setitem__(column, cell))  # noqa: B023
        refuses(error, read_poses, path)
    flange, board = EIGHT.pairs.base_from_flange, EIGHT.pairs.camera_from_board
    every = {"base_from_flange": flange, "flange_from_base": flange.inverse(), "camera_from_board": board}
    for sides, fault in (({"base_from_flange": flange}, "no such columns … camera_from_board"), (every, "both … base")):
        refuses(f"E-TABLE-COLUMN-MISSING … {fault}", read_poses, table(tmp_path / "a.csv", sides))
    rows = [0, 1, 2, 3, 1, 5]
    same = table(tmp_path / "poses.csv", {name: poses[rows] for name, poses in sides_of(EIGHT.pairs).items()})
    refuses("E-POSES-IDENTICAL … line 3 and line 6", read_poses, same)
    refuses("E-POSES-IDENTICAL … pose 4 and pose 5", HandEyePoses, flange, board[[0, 1, 2, 3, 3, 5, 6, 7]])
    flange = [p.matrix() for p in EIGHT.pairs.base_from_flange]
    board = [p.matrix() for p in EIGHT.pairs.camera_from_board]
    same = HandEyePoses.from_matrices(flange, board)
    assert same.camera_from_board.translation == pytest.approx(EIGHT.pairs.camera_from_board.translation)
    mirrored = [m.copy() for m in board]
    mirrored[3][:3, 2] *= -1
    refuses("E-ROTATION-IMPROPER … camera_from_board", HandEyePoses.from_matrices, flange, mirrored)
    broken = [m.copy() for m in flange]
    broken[1][0, 3] = np.inf
    refuses("E-ARRAY-NOT-FINITE", HandEyePoses.from_matrices, broken, board)
    refuses("E-POSES-COUNT … 8 … 7", HandEyePoses.from_matrices, flange, board[:7])
    refuses("E-POSES-COUNT … 7 … 8", HandEyePoses.from_matrices, flange[:7], board)


def test_covariances_are_read_and_turned_over(tmp_path):
    """The inverse's covariance, given under the inverse's name, comes back as the pose's own."""
    rng = np.random.default_rng(2)
    root = rng.normal(size=(8, 6, 6)) * np.repeat([1e-3, 0.3], 3)[:, None]
    covariance = root @ np.swapaxes(root, 1, 2)
    board = EIGHT.pairs.camera_from_board
    i, j = np.triu_indices(6)
    _, inverse, _ = inverted(board, covariance, None)
    extra = {f"board_from_camera_{name}": inverse[:, i[k], j[k]] for k, name in enumerate(COVARIANCE)}
    sides = {"base_from_flange": EIGHT.pairs.base_from_flange, "board_from_camera": board.inverse()}
    pairs = read_poses(table(tmp_path / "poses.csv", sides, **extra))
    assert pairs.camera_from_board_covariance == pytest.approx(covariance, rel=1e-6, abs=1e-10)
    assert pairs.base_from_flange_covariance is None
    assert pairs[2:4].camera_from_board_covariance.shape == (2, 6, 6)
