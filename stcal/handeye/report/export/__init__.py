"""A hand-eye transform in the files of other programs, each read back as it is made."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from stcal.errors import InputError, StcalError
from stcal.geometry.rigid import Rigid
from stcal.handeye.report.export import robots, ros
from stcal.handeye.report.export.frames import (
    CameraFrame,
    frame_names,
    require_frame_names,
    said_of,
    tree,
)
from stcal.handeye.report.export.opencv import opencv_yaml, read_zivid, zivid_yaml
from stcal.handeye.report.export.ros import ros_yaml, urdf_joint
from stcal.handeye.result import HandEye
from stcal.io.poses.controllers import ABB, FANUC, KUKA, UR
from stcal.io.poses.static import (
    Static,
    read_ros1_launch,
    read_ros2_commands,
    read_ros2_launch,
    ros1_launch,
    ros2_commands,
    ros2_launch,
)
from stcal.io.poses.text import program_name

__all__ = [
    "FORMS",
    "ROS_FORMS",
    "Form",
    "Static",
    "exported",
    "frame_names",
    "opencv_yaml",
    "require_form",
    "require_frame_names",
    "ros_yaml",
    "tree",
    "urdf_joint",
]

SAME_MM, SAME_RAD = 1e-6, 1e-9
"""A file read back is off by no more than the digits printed."""


@dataclass(frozen=True, slots=True)
class Form:
    """``write`` : text from the result, its transforms by name, and the file's name without its ending; ``read`` : the
    transforms, or the one pose, back from the text."""

    write: Callable[[HandEye, list[Static], str], str]
    read: Callable[[str], "list[Static] | Rigid"]


ROS_FORMS = {
    "ros2": Form(lambda result, transforms, _: ros2_commands(transforms, said_of(result)), read_ros2_commands),
    "moveit": Form(lambda result, transforms, _: ros1_launch(transforms, said_of(result)), read_ros1_launch),
    "moveit2": Form(lambda result, transforms, _: ros2_launch(transforms, said_of(result)), read_ros2_launch),
    "easy-handeye": Form(ros.easy_handeye, ros.read_easy_handeye),
    "easy-handeye2": Form(ros.easy_handeye2, ros.read_easy_handeye2),
}
"""With names of frames, and the camera's link on demand."""
FORMS = ROS_FORMS | {
    "zivid": Form(lambda result, *_: zivid_yaml(result), read_zivid),
    "kuka": Form(lambda result, _, name: robots.kuka_dat(result, program_name(name)), KUKA.first),
    "abb": Form(lambda result, _, name: robots.abb_module(result, program_name(name)), ABB.first),
    "ur": Form(lambda result, *_: robots.ur_script(result), UR.first),
    "fanuc": Form(lambda result, _, name: robots.fanuc_program(result, program_name(name)), FANUC.first),
}
"""By the word of ``--export``."""


def require_form(form: str) -> None:
    """Refuse a form that is none.

    Raises
    ------
    InputError
        With those there are.
    """
    if form not in FORMS:
        raise InputError("E-OPTION-FORM", f"--export {form}: unknown; one of {', '.join(FORMS)} needed")


def exported(
    result: HandEye,
    form: str,
    name: str = "handeye",
    parent: str = "",
    child: str = "",
    camera_frame: CameraFrame = "optical",
) -> str:
    """The file's text, read back and found to be the transform.

    Parameters
    ----------
    form : str
        Of :data:`FORMS`.
    name : str
        The file's, without its ending: easy_handeye and controllers of robots have it inside too.
    parent, child, camera_frame
        Of :data:`ROS_FORMS`, as of :func:`~stcal.handeye.report.export.frames.tree`.

    Raises
    ------
    InputError
        No such form, or a name of a frame that it cannot hold.
    """
    require_form(form)
    transforms = tree(result, parent, child, camera_frame)
    text = FORMS[form].write(result, transforms, name)
    found = FORMS[form].read(text)
    if isinstance(found, Rigid):
        found, transforms = [Static("", "", found)], [Static("", "", result.mount_from_camera)]
    for own, wanted in zip(found, transforms, strict=False):
        off = own.pose.inverse() @ wanted.pose
        same_names = (own.parent, own.child) == (wanted.parent, wanted.child)
        if not same_names or off.angle_rad() > SAME_RAD or np.abs(off.translation).max() > SAME_MM:
            raise StcalError(
                "E-EXPORT-READ-BACK", f"--export {form}: the file does not give the transform back; use another form"
            )
    return text
