"""Files for other programs, read back by those programs' rules."""

import xml.etree.ElementTree as ElementTree

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from stcal.cli.options import exports_of
from stcal.geometry.rigid import Rigid
from stcal.handeye import HandEye
from stcal.handeye.handeye_file import FORMS, opencv_yaml, tree, urdf_joint
from stcal.io.static_transforms import Static, messages
from tests.outcome import refuses
from tests.shared import written
from tests.support import static_transforms
from tests.support.static_transforms import pose_of_metres

angle, length = st.floats(-3.1, 3.1), st.floats(-3000, 3000)


def result_of(pose: Rigid, setup: str = "eye-in-hand", covariance: np.ndarray | None = None) -> HandEye:
    other = Rigid.exp([0.1, 0.2, -0.3, 900, -20, 30])
    return HandEye("pose", setup, pose, other, np.zeros((1, 6)), ("a",), np.zeros(1, bool), covariance)


def text_of(result: HandEye, form: str, name: str = "handeye", **frames: str) -> str:
    """The file with frames of these names."""
    transforms, own = tree(result, **frames), {"ros": messages, "urdf": urdf_joint}
    return own[form](transforms) if form in own else FORMS[form](result, transforms, name)


@pytest.mark.parametrize("setup", ["eye-in-hand", "eye-to-hand"])
def test_opencv(setup, tmp_path):
    pose, covariance = Rigid.exp([0.3, -2, 1, 12.5, -900, 3]), np.diag([1e-8, 2e-8, 3e-8, 0.01, 0.02, 0.03])
    result = result_of(pose, setup, covariance)
    path = written(tmp_path / "handeye.yaml", opencv_yaml(result))
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    for name, transform in result.transforms.items():
        assert (file.getNode(name).mat() == transform.matrix()).all()
    camera, board = result.transforms
    assert (file.getNode(f"{camera}_covariance").mat() == covariance).all()
    assert file.getNode(f"{board}_covariance").empty()
    assert (file.getNode("setup").string(), file.getNode("unit").string()) == (setup, "mm")


def read_easy(text: str) -> list[Static]:
    content = yaml.safe_load(text)
    frames, at = content["parameters"], content.get("transformation") or content["transform"]
    in_hand = frames.get("eye_on_hand") or frames.get("calibration_type") == "eye_in_hand"
    place, turn = (at.get("translation", at), at.get("rotation") or {c: at[f"q{c}"] for c in "xyzw"})
    pose = pose_of_metres([place[c] for c in "xyz"], [turn[c] for c in "xyzw"])
    mount = frames["robot_effector_frame" if in_hand else "robot_base_frame"]
    return [Static(mount, frames["tracking_base_frame"], pose)]


def read_urdf(text: str) -> list[Static]:
    """URDF's rule: R = R_z(yaw) R_y(pitch) R_x(roll)."""
    root, statics = ElementTree.fromstring(text), []
    for joint in [root] if root.tag == "joint" else root.findall("joint"):
        assert joint.get("type") == "fixed"
        metres, angles = ([float(v) for v in joint.find("origin").get(key).split()] for key in ("xyz", "rpy"))
        pose = Rigid(Rotation.from_euler("xyz", angles).as_matrix(), 1000 * np.array(metres))
        statics.append(Static(joint.find("parent").get("link"), joint.find("child").get("link"), pose))
    return statics


READERS = {
    **{"ros2": static_transforms.read_ros2_launch, "ros": static_transforms.read_messages},
    **{"easy-handeye": read_easy, "easy-handeye2": read_easy, "urdf": read_urdf},
}
COVARIANCE = np.diag([1e-8, 4e-8, 9e-8, 0.01, 0.04, 0.09])
LINK = Rigid([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], [0, 0, 0])
"""REP 103: the line of sight, Z of the optical frame, is X of the link; its X, to the right, is the link's -Y."""


@pytest.mark.slow
@pytest.mark.parametrize("setup", ["eye-in-hand", "eye-to-hand"])
@pytest.mark.parametrize("form", [*FORMS, "ros", "urdf"])
@given(st.tuples(angle, angle, angle, length, length, length))
@example((0, 0, 0, 0, 0, 0))
@example((0, -np.pi / 2, 0, 1, 2, 3))
@example((0, np.pi / 2 - 1e-8, 0, 1, 2, 3))
@example((np.pi, 0, 0, -1e-7, 2, 3))
@example((0, 0, -3.14159265358, 1, 2, 3))
def test_every_form_gives_the_transform_back(form, setup, twist):
    """At a pitch of 90° roll and yaw of URDF are one turn; beside it, the sine of the pitch is 1 to the last digit."""
    pose, parent = Rigid.exp(twist), {"ros2": "tool 0", "urdf": 'tool "0" & <1>'}.get(form, "")
    (own,) = READERS[form](text_of(result_of(pose, setup, COVARIANCE), form, parent=parent))
    mount = parent or {"eye-in-hand": "flange", "eye-to-hand": "base"}[setup]
    assert (own.parent, own.child) == (mount, "camera_optical_frame")
    off = own.pose.inverse() @ pose
    assert off.angle_rad() < (1e-12 if form == "urdf" else 3e-14)  # the last of 15 digits of a quaternion
    assert np.abs(off.translation).max() < 1e-9  # the last of 12 digits of a metre


@pytest.mark.parametrize("form", READERS)
def test_the_link_has_the_optical_frame_in_it(form):
    """One parent for each frame, and the way to the optical frame is the same."""
    pose = Rigid.exp([0.3, -2, 1, 12.5, -900, 3])
    found = READERS[form](text_of(result_of(pose), form, child="left_link", camera_frame="link"))
    assert (found[0].parent, found[0].child) == ("flange", "left_link")
    assert np.abs((found[0].pose @ LINK).matrix() - pose.matrix()).max() < 1e-8
    for fixed in found[1:]:
        assert (fixed.parent, fixed.child) == ("left_link", "left_optical_frame")
        assert np.abs(fixed.pose.matrix() - LINK.matrix()).max() < 1e-14
    assert len(found) == (1 if form.startswith("easy") else 2)


def test_names_of_frames():
    refuses("E-FRAME-NAME … 'tool0'", tree, result_of(Rigid()), "tool0", "tool0")
    refuses("E-OPTION-FORM … --export … staubli … ros2", exports_of, ["staubli=flange.txt"], FORMS)
    for setup, own, other, beyond in (
        ("eye-in-hand", "robot_effector_frame", "robot_base_frame", "base"),
        ("eye-to-hand", "robot_base_frame", "robot_effector_frame", "flange"),
    ):
        text = text_of(result_of(Rigid(), setup), "easy-handeye2", "mine", parent="tool0", child="cam")
        frames = yaml.safe_load(text)["parameters"]
        assert (frames["name"], frames[own], frames[other]) == ("mine", "tool0", beyond)


@pytest.mark.parametrize("form", FORMS)
def test_the_covariance_is_stated(form):
    text = text_of(result_of(Rigid(), covariance=COVARIANCE), form)
    assert "sigma along x y z of the flange: 0.1 0.2 0.3 mm; about them: 0.00573 0.01146 0.01719 deg" in text
    assert "9.000000e-02" in text
    assert "no covariance" in text_of(result_of(Rigid()), form)
    assert text[: text.index("axes of the flange:")].isascii()
