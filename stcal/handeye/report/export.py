"""Export of a hand-eye transform to files of other programs; each file is read back and compared."""

import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal
from xml.sax.saxutils import quoteattr

import numpy as np
import yaml

import stcal
from stcal.errors import InputError, StcalError
from stcal.geometry.rigid import Poses, Rigid
from stcal.handeye.data.pairs import FRAMES, Setup
from stcal.handeye.result import HandEye
from stcal.io.poses.programs import (
    Static,
    fixed_joint,
    metres,
    plain_numbers,
    pose_of_metres,
    read_ros1_launch,
    read_ros2_commands,
    read_ros2_launch,
    require_form,
    ros1_launch,
    ros2_commands,
    ros2_launch,
    static_of_joint,
    xyzw,
)
from stcal.io.table import require_poses_written
from stcal.io.toml import load_yaml, opencv_matrix

CAMERA_FRAME = "camera_optical_frame"
"""Name in ROS of a camera frame with Z along the line of sight and X to the right, as in stcal."""
CAMERA_LINK = "camera_link"
"""Name in ROS of a camera frame with X along the line of sight, Y to the left and Z up."""
LINK_FROM_OPTICAL = Rigid([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], [0, 0, 0])
"""Rotation between both frames, which share their origin: REP 103, suffix frames."""
CameraFrame = Literal["optical", "link"]


def tree(result: HandEye, parent: str = "", child: str = "", camera_frame: CameraFrame = "optical") -> list[Static]:
    """Returns the transforms that add the camera to a tree of frames. Empty names: flange or base, and
    :data:`CAMERA_FRAME` or :data:`CAMERA_LINK`. ``camera_frame`` : ``optical``, or ``link`` with the optical frame in
    it.

    Raises InputError: a name is invalid, or the names are not all different.
    """
    mount, *names = frame_names(result.setup, parent, child, camera_frame)
    if camera_frame == "optical":
        return [Static(mount, names[0], result.mount_from_camera)]
    link, optical = names
    mount_from_link = result.mount_from_camera @ LINK_FROM_OPTICAL.inverse()
    return [Static(mount, link, mount_from_link), Static(link, optical, LINK_FROM_OPTICAL)]


def frame_names(setup: Setup, parent: str, child: str, camera_frame: CameraFrame) -> tuple[str, ...]:
    """Returns the names of the frames of :func:`tree` from the root; NAME_link has the child NAME_optical_frame.

    Raises InputError: a name has a control character, or occurs twice.
    """
    names = [parent or FRAMES[setup].mount]
    if camera_frame == "optical":
        names.append(child or CAMERA_FRAME)
    else:
        link = child or CAMERA_LINK
        names += [link, f"{link.removesuffix('_link')}_optical_frame"]
    for name in names:
        if not name.isprintable():
            raise InputError("E-FRAME-NAME", f"frames: {name!r} has control characters; give a name in letters")
        if names.count(name) > 1:
            raise InputError("E-FRAME-NAME", f"frames: parent and child are both {name!r}; two names needed")
    return tuple(names)


def said_of(result: HandEye) -> list[str]:
    """Returns lines for comments: the transform's name, σ, and covariance."""
    frames = FRAMES[result.setup]
    lines = [f"stcal {stcal.__version__}: {frames.camera}, {result.setup}, {result.method}, {len(result.names)} poses"]
    if result.covariance is None:
        return [*lines, f"no covariance: method {result.method} gives none"]
    sigma = np.sqrt(np.diag(result.covariance))
    turn, shift = (" ".join(f"{v:.4g}" for v in part) for part in (np.degrees(sigma[:3]), sigma[3:]))
    lines.append(f"sigma along x y z of the {frames.mount}: {shift} mm; about them: {turn} deg")
    lines.append(f"covariance, rotation about x y z (rad), then shift along x y z (mm), axes of the {frames.mount}:")
    return lines + ["  " + " ".join(f"{v:.6e}" for v in row) for row in result.covariance]


def opencv_yaml(result: HandEye) -> str:
    """Returns a file for ``cv2.FileStorage``: both transforms, 4×4, and their covariances if there are any; mm, rad."""
    covariances = (result.covariance, result.stand_covariance)
    lines = ["%YAML:1.0", "---", f'setup: "{result.setup}"', f'method: "{result.method}"', 'unit: "mm"']
    for (name, pose), covariance in zip(result.transforms.items(), covariances, strict=True):
        lines += opencv_matrix(name, pose.matrix())
        if covariance is not None:
            lines += opencv_matrix(f"{name}_covariance", covariance)
    return "\n".join(lines) + "\n"


def named(result: HandEye) -> list[Static]:
    """Returns both transforms of a result."""
    return [_static(name, pose) for name, pose in result.transforms.items()]


def _static(name: str, pose: Rigid) -> Static:
    parent, _, child = name.partition("_from_")
    return Static(parent, child, pose)


def read_opencv(text: str) -> list[Static]:
    """Returns the transforms in a text of :func:`opencv_yaml`."""
    content = load_yaml(text)
    frames = FRAMES[content["setup"]]
    matrices = {name: np.reshape(content[name]["data"], (4, 4)) for name in (frames.camera, frames.board)}
    return [_static(name, Rigid.from_matrix(matrix)) for name, matrix in matrices.items()]


IN_HAND = "eye-in-hand"


def urdf_joint(transforms: list[Static]) -> str:
    """Returns fixed joints of URDF (m; fixed-axis roll, pitch, yaw, rad); of several ones, in a ``robot`` for
    xacro."""
    joints = [fixed_joint(each) for each in transforms]
    if len(joints) == 1:
        return joints[0]
    links = [f"<link name={quoteattr(each.child)}/>\n" for each in transforms]
    return "<robot>\n" + "".join(link + joint for link, joint in zip(links, joints, strict=True)) + "</robot>\n"


def read_urdf(text: str) -> list[Static]:
    """Returns the transforms in a text of :func:`urdf_joint`."""
    root = ElementTree.fromstring(text)
    return [static_of_joint(joint) for joint in ([root] if root.tag == "joint" else root.findall("joint"))]


def easy_handeye(result: HandEye, transforms: list[Static], name: str) -> str:
    """Returns the file ``~/.ros/easy_handeye/NAME.yaml`` of ROS 1's easy_handeye."""
    first = transforms[0]
    turn = dict(zip(("qx", "qy", "qz", "qw"), xyzw(first.pose), strict=True))
    content = {
        "parameters": {
            "eye_on_hand": result.setup == IN_HAND,
            "freehand_robot_movement": True,
            "move_group": "manipulator",
            "move_group_namespace": "/",
            "namespace": f"/{name}/",
            **_robot_frames(result, first),
        },
        "transformation": turn | dict(zip("xyz", metres(first.pose), strict=True)),
    }
    return _commented_yaml(result, transforms, content)


def read_easy_handeye(text: str) -> list[Static]:
    """Returns the transform in a text of :func:`easy_handeye`."""
    content = load_yaml(text)
    numbers, frames = content["transformation"], content["parameters"]
    pose = pose_of_metres([numbers[c] for c in "xyz"], [numbers[f"q{c}"] for c in "xyzw"])
    return [_static_of_frames(frames, frames["eye_on_hand"], pose)]


def easy_handeye2(result: HandEye, transforms: list[Static], name: str) -> str:
    """Returns the file ``~/.ros2/easy_handeye2/calibrations/NAME.calib`` of ROS 2's easy_handeye2."""
    first = transforms[0]
    content = {
        "parameters": {
            "name": name,
            "calibration_type": "eye_in_hand" if result.setup == IN_HAND else "eye_on_base",
            **_robot_frames(result, first),
            "freehand_robot_movement": True,
            "move_group_namespace": "/",
            "move_group": "manipulator",
        },
        "transform": {
            "translation": dict(zip("xyz", metres(first.pose), strict=True)),
            "rotation": dict(zip("xyzw", xyzw(first.pose), strict=True)),
        },
    }
    return _commented_yaml(result, transforms, content)


def read_easy_handeye2(text: str) -> list[Static]:
    """Returns the transform in a text of :func:`easy_handeye2`."""
    content = load_yaml(text)
    numbers, frames = content["transform"], content["parameters"]
    pose = pose_of_metres([numbers["translation"][c] for c in "xyz"], [numbers["rotation"][c] for c in "xyzw"])
    return [_static_of_frames(frames, frames["calibration_type"] == "eye_in_hand", pose)]


def _robot_frames(result: HandEye, first: Static) -> dict[str, str]:
    """Returns the names of all frames. The frame of the board, and the robot's frame without the camera, are unused."""
    frames = FRAMES[result.setup]
    carries = {frames.mount: first.parent, frames.stand: frames.stand}
    return {
        "robot_base_frame": carries["base"],
        "robot_effector_frame": carries["flange"],
        "tracking_base_frame": first.child,
        "tracking_marker_frame": "board",
    }


def _static_of_frames(frames: dict, in_hand: bool, pose: Rigid) -> Static:
    return Static(
        frames["robot_effector_frame" if in_hand else "robot_base_frame"], frames["tracking_base_frame"], pose
    )


def _commented_yaml(result: HandEye, transforms: list[Static], content: dict) -> str:
    lines = said_of(result)
    for each in transforms[1:]:
        words = " ".join(plain_numbers(xyzw(each.pose), 3))
        lines.append(f"{each.child} is not in this file: in {each.parent} at 0 0 0, quaternion x y z w {words}")
    return "".join(f"# {line}\n" for line in lines) + yaml.safe_dump(content, sort_keys=False, allow_unicode=True)


SAME_MM, SAME_RAD = 1e-6, 1e-9
"""Largest deviations of a transform that is read back; the digits printed cause less."""


@dataclass(frozen=True, slots=True)
class Form:
    """``write`` : text of a result, its named transforms and the file's stem; ``read`` : the transforms of a text."""

    write: Callable[[HandEye, list[Static], str], str]
    read: Callable[[str], list[Static]]


FORMS = {
    "ros2": Form(lambda result, transforms, _: ros2_commands(transforms, said_of(result)), read_ros2_commands),
    "moveit": Form(lambda result, transforms, _: ros1_launch(transforms, said_of(result)), read_ros1_launch),
    "moveit2": Form(lambda result, transforms, _: ros2_launch(transforms, said_of(result)), read_ros2_launch),
    "easy-handeye": Form(easy_handeye, read_easy_handeye),
    "easy-handeye2": Form(easy_handeye2, read_easy_handeye2),
}
"""All formats, by the word of ``--export``."""


def exported(result: HandEye, transforms: list[Static], form: str, name: str = "handeye") -> str:
    """Returns the text of ``transforms``, of :func:`tree`, in one of :data:`FORMS`, read back and compared; ``name`` :
    the file's stem, which easy_handeye holds. Raises InputError: the format is unknown, or cannot hold the name of a
    frame."""
    require_form(form, FORMS)
    text = FORMS[form].write(result, transforms, name)
    for static, wanted in zip(FORMS[form].read(text), transforms, strict=False):
        difference = static.pose.inverse() @ wanted.pose
        same_names = (static.parent, static.child) == (wanted.parent, wanted.child)
        if not same_names or difference.angle_rad() > SAME_RAD or np.abs(difference.translation).max() > SAME_MM:
            raise StcalError(
                "E-EXPORT-READ-BACK", f"--export {form}: the file does not give the transform back; use another form"
            )
    return text


def require_export_written(path: Path, read: Callable[[str], list[Static]], transforms: list[Static]) -> None:
    """Reads a written file again, and requires the poses of ``transforms``."""

    def again() -> Poses:
        return Poses.of(each.pose for each in read(path.read_text(encoding="utf-8")))

    require_poses_written(path, again, Poses.of(each.pose for each in transforms))
