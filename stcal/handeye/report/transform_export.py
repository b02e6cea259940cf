"""Export of a hand-eye transform to files of other programs."""

from collections.abc import Callable
from typing import Literal
from xml.sax.saxutils import quoteattr

import numpy as np
import yaml

import stcal
from stcal.errors import InputError
from stcal.geometry.rigid import Rigid
from stcal.handeye.data.pose_pairs import FRAMES, Setup
from stcal.handeye.handeye_result import HandEye
from stcal.io.static_transforms import (
    Static,
    fixed_joint,
    metres,
    plain_numbers,
    require_form,
    ros1_launch,
    ros2_commands,
    ros2_launch,
    xyzw,
)
from stcal.io.toml import opencv_matrix

OPTICAL = "_optical_frame"
CAMERA_FRAME = f"camera{OPTICAL}"
"""Name in ROS of a camera frame with Z along the line of sight and X to the right, as in stcal."""
CAMERA_LINK = "camera_link"
"""Name in ROS of a camera frame with X along the line of sight, Y to the left and Z up."""
LINK_FROM_OPTICAL = Rigid([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], [0, 0, 0])
"""Rotation between both frames, which share their origin: REP 103, suffix frames."""
CameraFrame = Literal["optical", "link"]
MOVE_GROUP = {"freehand_robot_movement": True, "move_group": "manipulator", "move_group_namespace": "/"}
"""What easy_handeye's files hold beside frames and transform, as its own dialogue writes it."""


def tree(result: HandEye, parent: str = "", child: str = "", camera_frame: CameraFrame = "optical") -> list[Static]:
    """Returns the transforms that add the camera to a tree of frames, of the names of :func:`frame_names`.

    Raises InputError: a name is invalid, or the names are not all different.
    """
    mount, first, *below = frame_names(result.setup, parent, child, camera_frame)
    if not below:
        return [Static(mount, first, result.mount_from_camera)]
    mount_from_link = result.mount_from_camera @ LINK_FROM_OPTICAL.inverse()
    return [Static(mount, first, mount_from_link), Static(first, below[0], LINK_FROM_OPTICAL)]


def frame_names(setup: Setup, parent: str, child: str, camera_frame: CameraFrame) -> tuple[str, ...]:
    """Returns the names of the frames from the root; NAME_link has the child NAME_optical_frame. Empty names: flange or
    base, and :data:`CAMERA_FRAME` or :data:`CAMERA_LINK`.

    Raises InputError: a name has a control character, or occurs twice.
    """
    link = child or CAMERA_LINK
    below = [child or CAMERA_FRAME] if camera_frame == "optical" else [link, f"{link.removesuffix('_link')}{OPTICAL}"]
    names = [parent or FRAMES[setup].mount, *below]
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


def urdf_joint(transforms: list[Static]) -> str:
    """Returns fixed joints of URDF (m; fixed-axis roll, pitch, yaw, rad); of several ones, in a ``robot`` for
    xacro."""
    joints = [fixed_joint(each) for each in transforms]
    if len(joints) == 1:
        return joints[0]
    links = [f"<link name={quoteattr(each.child)}/>\n" for each in transforms]
    return "<robot>\n" + "".join(link + joint for link, joint in zip(links, joints, strict=True)) + "</robot>\n"


def easy_handeye(result: HandEye, transforms: list[Static], name: str) -> str:
    """Returns the file ``~/.ros/easy_handeye/NAME.yaml`` of ROS 1's easy_handeye."""
    turn, place, frames = _parts(result, transforms[0])
    named = {"eye_on_hand": result.setup == "eye-in-hand", **MOVE_GROUP, "namespace": f"/{name}/", **frames}
    transform = {f"q{axis}": value for axis, value in turn.items()} | place
    return _commented_yaml(result, transforms, {"parameters": named, "transformation": transform})


def easy_handeye2(result: HandEye, transforms: list[Static], name: str) -> str:
    """Returns the file ``~/.ros2/easy_handeye2/calibrations/NAME.calib`` of ROS 2's easy_handeye2."""
    turn, place, frames = _parts(result, transforms[0])
    kind = "eye_in_hand" if result.setup == "eye-in-hand" else "eye_on_base"
    named = {"name": name, "calibration_type": kind, **frames, **MOVE_GROUP}
    content = {"parameters": named, "transform": {"translation": place, "rotation": turn}}
    return _commented_yaml(result, transforms, content)


def _parts(result: HandEye, first: Static) -> tuple[dict[str, float], dict[str, float], dict[str, str]]:
    """Returns quaternion, place, and the names of all frames. The frame of the board, and the robot's frame without the
    camera, are unused."""
    frames = FRAMES[result.setup]
    carries = {frames.mount: first.parent, frames.stand: frames.stand}
    robot = {"robot_base_frame": carries["base"], "robot_effector_frame": carries["flange"]}
    tracking = {"tracking_base_frame": first.child, "tracking_marker_frame": "board"}
    turn, place = dict(zip("xyzw", xyzw(first.pose), strict=True)), dict(zip("xyz", metres(first.pose), strict=True))
    return turn, place, robot | tracking


def _commented_yaml(result: HandEye, transforms: list[Static], content: dict) -> str:
    lines = said_of(result)
    for each in transforms[1:]:
        words = " ".join(plain_numbers(xyzw(each.pose), 3))
        lines.append(f"{each.child} is not in this file: in {each.parent} at 0 0 0, quaternion x y z w {words}")
    return "".join(f"# {line}\n" for line in lines) + yaml.safe_dump(content, sort_keys=False, allow_unicode=True)


FORMS: dict[str, Callable[[HandEye, list[Static], str], str]] = {
    "ros2": lambda result, transforms, _: ros2_commands(transforms, said_of(result)),
    "moveit": lambda result, transforms, _: ros1_launch(transforms, said_of(result)),
    "moveit2": lambda result, transforms, _: ros2_launch(transforms, said_of(result)),
    "easy-handeye": easy_handeye,
    "easy-handeye2": easy_handeye2,
}
"""Writers of all formats, by the word of ``--export``."""


def exported(result: HandEye, transforms: list[Static], form: str, name: str = "handeye") -> str:
    """Returns the text of ``transforms``, of :func:`tree`, in one of :data:`FORMS`; ``name`` : the file's stem, which
    easy_handeye holds. Raises InputError: the format is unknown, or cannot hold the name of a frame."""
    require_form(form, FORMS)
    return FORMS[form](result, transforms, name)
