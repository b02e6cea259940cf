"""Export of a hand-eye transform to files of other programs; each file is read back and compared."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stcal.errors import InputError, StcalError
from stcal.geometry.rigid import Poses, Rigid
from stcal.handeye.report.export import files
from stcal.handeye.report.export.files import opencv_yaml, read_zivid, ros_yaml, urdf_joint, zivid_yaml
from stcal.handeye.report.export.frames import (
    CameraFrame,
    frame_names,
    require_frame_names,
    said_of,
    tree,
)
from stcal.handeye.result import HandEye
from stcal.io.plain_yaml import load_yaml
from stcal.io.poses.columns import program_name
from stcal.io.poses.controllers import ABB, FANUC, KUKA, UR
from stcal.io.poses.static import (
    Static,
    read_messages,
    read_ros1_launch,
    read_ros2_commands,
    read_ros2_launch,
    ros1_launch,
    ros2_commands,
    ros2_launch,
)
from stcal.io.table import require_poses_written

__all__ = [
    "FORMS",
    "ROS_FORMS",
    "Form",
    "Static",
    "exported",
    "frame_names",
    "opencv_yaml",
    "require_export_written",
    "require_form",
    "require_frame_names",
    "ros_yaml",
    "tree",
    "urdf_joint",
]

SAME_MM, SAME_RAD = 1e-6, 1e-9
"""Largest deviations of a transform that is read back; the digits printed cause less."""


@dataclass(frozen=True, slots=True)
class Form:
    """A file format.

    ``write`` : returns the text for a result, its named transforms, and the file's name without its ending; ``read`` :
    returns the transforms, or the one pose, of the text.
    """

    write: Callable[[HandEye, list[Static], str], str]
    read: Callable[[str], "list[Static] | Rigid"]


ROS_FORMS = {
    "ros2": Form(lambda result, transforms, _: ros2_commands(transforms, said_of(result)), read_ros2_commands),
    "moveit": Form(lambda result, transforms, _: ros1_launch(transforms, said_of(result)), read_ros1_launch),
    "moveit2": Form(lambda result, transforms, _: ros2_launch(transforms, said_of(result)), read_ros2_launch),
    "easy-handeye": Form(files.easy_handeye, files.read_easy_handeye),
    "easy-handeye2": Form(files.easy_handeye2, files.read_easy_handeye2),
}
"""Formats that hold names of frames, and the camera's link on demand."""
FORMS = ROS_FORMS | {
    "zivid": Form(lambda result, *_: zivid_yaml(result), read_zivid),
    "kuka": Form(lambda result, _, name: files.kuka_dat(result, program_name(name)), KUKA.first),
    "abb": Form(lambda result, _, name: files.abb_module(result, program_name(name)), ABB.first),
    "ur": Form(lambda result, *_: files.ur_script(result), UR.first),
    "fanuc": Form(lambda result, _, name: files.fanuc_program(result, program_name(name)), FANUC.first),
}
"""All formats, by the word of ``--export``."""


def require_form(form: str) -> None:
    """Checks the name of a format.

    Raises InputError: the format is unknown; the message lists all formats.
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
    """Returns the file's text, after reading it back and comparing the transform.

    ``form`` : one of :data:`FORMS`; ``name`` : name of the file without its ending; files of easy_handeye and of robot
    controllers hold it too; ``parent``, ``child``, ``camera_frame`` : frames for :data:`ROS_FORMS`; see
    :func:`~stcal.handeye.report.export.frames.tree`.

    Raises InputError: the format is unknown, or cannot hold the name of a frame.
    """
    require_form(form)
    transforms = tree(result, parent, child, camera_frame)
    text = FORMS[form].write(result, transforms, name)
    read_back = FORMS[form].read(text)
    if isinstance(read_back, Rigid):
        read_back, transforms = [Static("", "", read_back)], [Static("", "", result.mount_from_camera)]
    for static, wanted in zip(read_back, transforms, strict=False):
        difference = static.pose.inverse() @ wanted.pose
        same_names = (static.parent, static.child) == (wanted.parent, wanted.child)
        if not same_names or difference.angle_rad() > SAME_RAD or np.abs(difference.translation).max() > SAME_MM:
            raise StcalError(
                "E-EXPORT-READ-BACK", f"--export {form}: the file does not give the transform back; use another form"
            )
    return text


def require_export_written(
    path: Path,
    kind: str,
    result: HandEye,
    parent: str = "",
    child: str = "",
    camera_frame: CameraFrame = "optical",
) -> None:
    """Read a written file again, and require the transforms of ``result``.

    ``kind`` : ``json``, the result file, or ``opencv``, ``ros``, ``urdf`` of :func:`opencv_yaml`, :func:`ros_yaml` and
    :func:`urdf_joint`.
    """

    def again() -> Poses:
        text = path.read_text(encoding="utf-8")
        if kind in ("ros", "urdf"):
            return Poses.of(static.pose for static in (read_messages if kind == "ros" else files.read_urdf)(text))
        content = json.loads(text) if kind == "json" else load_yaml(text)
        matrices = [content[name] if kind == "json" else content[name]["data"] for name in result.transforms]
        return Poses.of(Rigid.from_matrix(np.reshape(matrix, (4, 4))) for matrix in matrices)

    statics = tree(result, parent, child, camera_frame) if kind in ("ros", "urdf") else ()
    require_poses_written(path, again, Poses.of([each.pose for each in statics] or result.transforms.values()))
