"""The robot's poses by image."""

import numpy as np
import pytest

from stcal.handeye.data.record import Said
from stcal.workflows.handeye_inputs import read_robot_poses
from tests.outcome import fails_with


def test_two_rows_of_one_image_are_said(tmp_path):
    row = "0.1,0.2,0.3,1,0,0,0"
    header = "image," + ",".join(f"base_from_flange_{c}" for c in ("x_m", "y_m", "z_m", "qw", "qx", "qy", "qz"))
    (tmp_path / "poses.csv").write_text(f"{header}\n0.png,{row}\ng/0.png,{row}\n")
    found = read_robot_poses(tmp_path / "poses.csv")
    with fails_with("E-POSE-REPEATED … line 2 and line 3 … 'g/0.png'"):
        found.rows(["g/0.png"])


def test_quaternions_in_the_order_of_their_columns(tmp_path):
    head = ",".join(f"base_from_flange_{c}" for c in ("x_mm", "y_mm", "z_mm", "qw", "qx", "qy", "qz"))
    (tmp_path / "r.csv").write_text(f"image,{head}\na.png,1,2,3,0,0.8,0,0.6\n")
    found = read_robot_poses(tmp_path / "r.csv", "xyzw").base_from_flange
    assert found.rotation[0] == pytest.approx(np.array([[-0.28, 0, 0.96], [0, 1, 0], [-0.96, 0, -0.28]]))


def test_names_without_folder_and_ending(tmp_path):
    np.savez(tmp_path / "r.npz", base_from_flange=np.tile(np.eye(4), (3, 1, 1)), images=["0", "1", "10"])
    found = read_robot_poses(tmp_path / "r.npz", statements=Said(length_unit="mm"))
    assert found.rows(["a/0.png", "a/10.png", "a/7.png"]) == ({"a/0.png": 0, "a/10.png": 2}, ("1",))
    with fails_with("E-IMAGE-NAME-AMBIGUOUS … pose 2 … 1 … a/1.png … b/1.png"):
        found.rows(["a/1.png", "b/1.png"])


def test_a_recording_of_rtde_is_read(tmp_path):
    """Metres, and rotation vectors in radians."""
    names = " ".join(f"actual_TCP_pose_{i}" for i in range(6))
    values = "\n".join(f"{i}.008 0.{i}1 -0.2 0.3 0 0 0.5" for i in range(3))
    (tmp_path / "r.csv").write_text(f"timestamp {names}\n{values}\n")
    found = read_robot_poses(tmp_path / "r.csv")
    assert found.images == ("0.008", "1.008", "2.008")
    assert found.base_from_flange.translation[2] == pytest.approx([210, -200, 300])
    assert found.base_from_flange.rotation[0, 0] == pytest.approx([np.cos(0.5), -np.sin(0.5), 0])


def test_an_index_without_a_name_names_rows(tmp_path):
    (tmp_path / "p.csv").write_text(",x,y,z,qx,qy,qz,qw\n0,0.1,0.2,0.3,0,0,0.6,0.8\n1,0.2,0.2,0.3,0,0,0.6,0.8\n")
    found = read_robot_poses(tmp_path / "p.csv")
    assert found.images == ("0", "1")
    assert found.base_from_flange.translation[0] == pytest.approx([100, 200, 300])


def test_quaternions_after_nanoseconds_have_an_open_order(tmp_path):
    """VINS writes w first and no header, where TUM's files have seconds and w last."""
    path = tmp_path / "vio.csv"
    path.write_text("".join(f"14036365797635558{i:02},0.1,0.2,0.{i},0.8,0.0,0.0,0.6\n" for i in range(3)))
    with fails_with("E-ROTATION-AMBIGUOUS … vio.csv … wxyz or xyzw"):
        read_robot_poses(path)
    for order, place in (("wxyz", (1, 0)), ("xyzw", (2, 1))):  # sin of the turn about Z, about X
        found = read_robot_poses(path, statements=Said(rotation=order)).base_from_flange.rotation[0]
        assert found[place] == pytest.approx(0.96)


def test_more_than_a_turn_in_radians_is_refused(tmp_path):
    (tmp_path / "p.csv").write_text("X,Y,Z,Rx,Ry,Rz\n100,200,300,10,20,30\n110,200,300,-10,20,35\n")
    with fails_with("E-ANGLE-UNIT … 35 … rotvec-deg"):
        read_robot_poses(tmp_path / "p.csv", statements=Said(rotation="ur-rotvec"))
