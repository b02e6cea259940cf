"""The same poses, written in each format, are read as the same poses; other formats are refused."""

from pathlib import Path

import numpy as np
import pytest

from stcal.errors import InputError
from stcal.handeye.data.pose_content import Said
from stcal.handeye.data.pose_files import read_robot
from stcal.handeye.data.pose_partners import rows_of_images
from stcal.workflows.handeye_inputs import Files
from tests.handeye.test_cli import NOISE
from tests.handeye.written import FORMATS, REFUSED, easy_handeye, matrices, poses_file
from tests.outcome import INPUT, assert_error, fails_with
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
    for wanted, got in (
        (PAIRS.base_from_flange, found.pairs.base_from_flange),
        (PAIRS.camera_from_board, found.pairs.camera_from_board),
    ):
        assert np.abs(got.difference(wanted)).max() < ROUNDING
    assert len(found.understood) >= 2
    assert found.left_out == ()


@pytest.mark.parametrize("name", REFUSED)
def test_other_formats_are_refused_in_a_line(name, tmp_path):
    """As the robot's poses beside images, as one of two files, and as pairs."""
    path = tmp_path / "poses"
    path.write_text(REFUSED[name])
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


def test_two_rows_of_one_image_are_said(tmp_path):
    row = "0.1,0.2,0.3,1,0,0,0"
    header = "image," + ",".join(f"base_from_flange_{c}" for c in ("x_m", "y_m", "z_m", "qw", "qx", "qy", "qz"))
    (tmp_path / "poses.csv").write_text(f"{header}\n0.png,{row}\ng/0.png,{row}\n")
    found = read_robot(tmp_path / "poses.csv", Said())
    with fails_with("E-POSE-REPEATED … line 2 and line 3 … 'g/0.png'"):
        rows_of_images(found, ["g/0.png"])


def test_quaternions_in_the_order_of_their_columns(tmp_path):
    head = ",".join(f"base_from_flange_{c}" for c in ("x_mm", "y_mm", "z_mm", "qw", "qx", "qy", "qz"))
    (tmp_path / "r.csv").write_text(f"image,{head}\na.png,1,2,3,0,0.8,0,0.6\n")
    found = read_robot(tmp_path / "r.csv", Said(), "xyzw").poses
    assert found.rotation[0] == pytest.approx(np.array([[-0.28, 0, 0.96], [0, 1, 0], [-0.96, 0, -0.28]]))


def test_names_without_folder_and_ending(tmp_path):
    np.savez(tmp_path / "r.npz", base_from_flange=np.tile(np.eye(4), (3, 1, 1)), images=["0", "1", "10"])
    found = read_robot(tmp_path / "r.npz", Said(length_unit="mm"))
    assert rows_of_images(found, ["a/0.png", "a/10.png", "a/7.png"]) == ({"a/0.png": 0, "a/10.png": 2}, ("1",), "")
    with fails_with("E-IMAGE-NAME-AMBIGUOUS … pose 2 … 1 … a/1.png … b/1.png"):
        rows_of_images(found, ["a/1.png", "b/1.png"])


def test_a_recording_of_rtde_is_read(tmp_path):
    """Metres, and rotation vectors in radians."""
    names = " ".join(f"actual_TCP_pose_{i}" for i in range(6))
    values = "\n".join(f"{i}.008 0.{i}1 -0.2 0.3 0 0 0.5" for i in range(3))
    (tmp_path / "r.csv").write_text(f"timestamp {names}\n{values}\n")
    found = read_robot(tmp_path / "r.csv", Said())
    assert found.names == ("0.008", "1.008", "2.008")
    assert found.poses.translation[2] == pytest.approx([210, -200, 300])
    assert found.poses.rotation[0, 0] == pytest.approx([np.cos(0.5), -np.sin(0.5), 0])


def test_an_index_without_a_name_names_rows(tmp_path):
    (tmp_path / "p.csv").write_text(",x,y,z,qx,qy,qz,qw\n0,0.1,0.2,0.3,0,0,0.6,0.8\n1,0.2,0.2,0.3,0,0,0.6,0.8\n")
    found = read_robot(tmp_path / "p.csv", Said())
    assert found.names == ("0", "1")
    assert found.poses.translation[0] == pytest.approx([100, 200, 300])


def test_quaternions_after_nanoseconds_have_an_open_order(tmp_path):
    """VINS writes w first and no header, where TUM's files have seconds and w last."""
    path = tmp_path / "vio.csv"
    path.write_text("".join(f"14036365797635558{i:02},0.1,0.2,0.{i},0.8,0.0,0.0,0.6\n" for i in range(3)))
    with fails_with("E-ROTATION-AMBIGUOUS … vio.csv … wxyz or xyzw"):
        read_robot(path, Said())
    for order, place in (("wxyz", (1, 0)), ("xyzw", (2, 1))):  # sin of the turn about Z, about X
        found = read_robot(path, Said(rotation=order)).poses.rotation[0]
        assert found[place] == pytest.approx(0.96)


def test_more_than_a_turn_in_radians_is_refused(tmp_path):
    (tmp_path / "p.csv").write_text("X,Y,Z,Rx,Ry,Rz\n100,200,300,10,20,30\n110,200,300,-10,20,35\n")
    with fails_with("E-ANGLE-UNIT … 35 … rotvec-deg"):
        read_robot(tmp_path / "p.csv", Said(rotation="ur-rotvec"))


QUICK = ("--method", "pose", "--splits", 0)


@pytest.fixture(scope="module")
def truth():
    return simulated(np.random.default_rng(5), 12, **NOISE)


def test_a_dry_run_says_what_it_understood_and_writes_nothing(command, tmp_path, truth):
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


def test_a_dry_run_says_what_motion_is_missing(command, tmp_path, truth):
    still = matrices(truth.pairs.base_from_flange)
    still[:, :3, :3] = still[0, :3, :3]
    np.savez(tmp_path / "p.npz", base_from_flange=still, camera_from_board=matrices(truth.pairs.camera_from_board))
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
