"""Files for other programs, read back by those programs' rules."""

import xml.etree.ElementTree as ElementTree

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from stcal.errors import InputError
from stcal.geometry.rigid import Rigid
from stcal.handeye import HandEye
from stcal.handeye.report.export import opencv_yaml, ros_yaml, urdf_joint

angle, length = st.floats(-3.1, 3.1), st.floats(-3000, 3000)


def result_of(pose: Rigid, setup: str = "eye-in-hand", covariance: np.ndarray | None = None) -> HandEye:
    other = Rigid.exp([0.1, 0.2, -0.3, 900, -20, 30])
    return HandEye("pose", setup, pose, other, np.zeros((1, 6)), ("a",), np.zeros(1, bool), covariance)


def assert_same(rotation: np.ndarray, metres, pose: Rigid) -> None:
    """Text holds 17 digits: what is lost is rounding of products."""
    assert np.abs(rotation - pose.rotation).max() < 1e-12
    assert np.abs(1000 * np.asarray(metres) - pose.translation).max() < 1e-9


@given(st.tuples(angle, angle, angle, length, length, length))
@example((0, np.pi / 2, 0, 1, 2, 3))
def test_ros(twist):
    pose = Rigid.exp(twist)
    message = yaml.safe_load(ros_yaml(result_of(pose)))
    assert (message["header"]["frame_id"], message["child_frame_id"]) == ("flange", "camera_optical_frame")
    transform = message["transform"]
    rotation = Rotation.from_quat([transform["rotation"][c] for c in "xyzw"]).as_matrix()
    assert_same(rotation, [transform["translation"][c] for c in "xyz"], pose)


@given(st.tuples(angle, angle, angle, length, length, length))
@example((0, np.pi / 2, 0, 1, 2, 3))  # pitch of 90°: roll and yaw are one turn
@example((0, -np.pi / 2, 0, 1, 2, 3))
def test_urdf(twist):
    """URDF's rule: R = R_z(yaw) R_y(pitch) R_x(roll)."""
    pose = Rigid.exp(twist)
    joint = ElementTree.fromstring(urdf_joint(result_of(pose, "eye-to-hand"), child='eye "left" & <front>'))
    assert joint.get("type") == "fixed"
    assert (joint.find("parent").get("link"), joint.find("child").get("link")) == ("base", 'eye "left" & <front>')
    origin = joint.find("origin")
    roll, pitch, yaw = (float(v) for v in origin.get("rpy").split())
    turns = [Rotation.from_euler(axis, value).as_matrix() for axis, value in (("z", yaw), ("y", pitch), ("x", roll))]
    metres = [float(v) for v in origin.get("xyz").split()]
    assert np.abs(turns[0] @ turns[1] @ turns[2] - pose.rotation).max() < 1e-7  # near the pole half of the digits stay
    assert_same(pose.rotation, metres, pose)


@pytest.mark.parametrize("setup", ["eye-in-hand", "eye-to-hand"])
def test_opencv(setup, tmp_path):
    pose, covariance = Rigid.exp([0.3, -2, 1, 12.5, -900, 3]), np.diag([1e-8, 2e-8, 3e-8, 0.01, 0.02, 0.03])
    result = result_of(pose, setup, covariance)
    path = tmp_path / "handeye.yaml"
    path.write_text(opencv_yaml(result))
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    for name, transform in result.transforms.items():
        assert (file.getNode(name).mat() == transform.matrix()).all()
    camera, board = result.transforms
    assert (file.getNode(f"{camera}_covariance").mat() == covariance).all()
    assert file.getNode(f"{board}_covariance").empty()
    assert (file.getNode("setup").string(), file.getNode("unit").string()) == (setup, "mm")


def test_frames_of_the_same_name_are_refused():
    with pytest.raises(InputError, match="both 'tool0'"):
        ros_yaml(result_of(Rigid()), "tool0", "tool0")
