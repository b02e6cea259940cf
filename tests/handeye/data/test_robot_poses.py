"""The robot's poses by image: CSV files, and ROS-Industrial's YAML files."""

import numpy as np
import pytest

from stcal.handeye.data.robot_poses import read_robot_poses
from tests.outcome import fails_with

POSE = "x: 0.1\ny: -0.2\nz: 0.3\nqw: 0.6\nqx: 0.0\nqy: 0.8\nqz: 0\n"


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "poses").mkdir()
    for name in ("0", "1", "10"):
        (tmp_path / "poses" / f"{name}.yaml").write_text(POSE.replace("0.1", f"0.{name}"))
    return tmp_path / "poses"


def test_a_folder_of_poses_by_name(folder):
    found = read_robot_poses(folder)
    assert found.images == ("0", "1", "10")
    assert found.base_from_flange.translation == pytest.approx(
        np.array([[0, -200, 300], [100, -200, 300], [100, -200, 300]])
    )
    assert found.base_from_flange.rotation[0] == pytest.approx(
        np.array([[-0.28, 0, 0.96], [0, 1, 0], [-0.96, 0, -0.28]])
    )
    rows, missing = found.rows(["a/0.png", "a/10.png", "a/7.png"])
    assert (rows, missing) == ({"a/0.png": 0, "a/10.png": 2}, ("1",))
    with fails_with("E-IMAGE-NAME-AMBIGUOUS … 1.yaml … 1 … a/1.png … b/1.png"):
        found.rows(["a/1.png", "b/1.png"])


@pytest.mark.parametrize("under", ["", "data:\n"])
def test_a_list_of_images_and_poses(folder, under):
    path = folder.parent / "cal_data.yaml"
    path.write_text(
        under + "- {image: images/a.png, pose: poses/1.yaml}\n- {pose: poses/0.yaml, image: images/b.png}\n"
    )
    found = read_robot_poses(path)
    assert found.images == ("a.png", "b.png")
    assert found.base_from_flange.translation[:, 0] == pytest.approx([100, 0])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (POSE.replace("z: 0.3", "z: .nan"), "E-POSE-VALUE … poses … 1.yaml … nan"),
        (POSE.replace("z: 0.3\n", ""), "E-POSE-VALUE … 1.yaml … None"),
        (POSE.replace("0.8", "'0.8'"), "E-POSE-VALUE … 1.yaml … qy … '0.8'"),
        (POSE.replace("0.8", "0.9"), "E-QUATERNION-LENGTH … 1.yaml … 1.082 … 0.001"),
        ("[1, 2]", "E-POSE-VALUE … 1.yaml … None"),
        ("{", "E-YAML-INVALID … 1.yaml"),
    ],
)
def test_a_bad_pose_is_named(folder, text, message):
    (folder / "1.yaml").write_text(text)
    with fails_with(message):
        read_robot_poses(folder)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("data: 3\n", "E-ROBOT-POSES-FORM … `image:` … `pose:`"),
        ("- {image: a.png}\n", "E-ROBOT-POSES-FORM"),
        ("- {image: a.png, pose: 1.yaml}\n- {image: a.png, pose: 0.yaml}\n", "E-POSE-REPEATED … 1.yaml and 0.yaml"),
        ("- {image: a.png, pose: nowhere.yaml}\n", "E-FILE-UNREADABLE … nowhere.yaml"),
    ],
)
def test_a_bad_list_is_said(folder, text, message):
    (folder / "list.yaml").write_text(text)
    with fails_with(message):
        read_robot_poses(folder / "list.yaml")


def test_an_empty_folder_is_said(tmp_path):
    with fails_with("E-ROBOT-POSES-FORM"):
        read_robot_poses(tmp_path)


def test_two_rows_of_one_image_are_said(tmp_path):
    row = "0.1,0.2,0.3,1,0,0,0"
    header = "image," + ",".join(f"base_from_flange_{c}" for c in ("x_m", "y_m", "z_m", "qw", "qx", "qy", "qz"))
    (tmp_path / "poses.csv").write_text(f"{header}\n0.png,{row}\ng/0.png,{row}\n")
    found = read_robot_poses(tmp_path / "poses.csv")
    with fails_with("E-POSE-REPEATED … line 2 and line 3 … 'g/0.png'"):
        found.rows(["g/0.png"])


def test_the_order_of_columns_is_no_matter_of_yaml(folder):
    with fails_with("E-OPTION-NEEDS … --quaternions … xyzw"):
        read_robot_poses(folder, "xyzw")


def test_quaternions_in_the_order_of_their_columns(tmp_path):
    head = ",".join(f"base_from_flange_{c}" for c in ("x_mm", "y_mm", "z_mm", "qw", "qx", "qy", "qz"))
    (tmp_path / "r.csv").write_text(f"image,{head}\na.png,1,2,3,0,0.8,0,0.6\n")
    found = read_robot_poses(tmp_path / "r.csv", "xyzw").base_from_flange
    assert found.rotation[0] == pytest.approx(np.array([[-0.28, 0, 0.96], [0, 1, 0], [-0.96, 0, -0.28]]))
