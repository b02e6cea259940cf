"""Files of a hand-eye transform for OpenCV, Zivid's SDK, robot controllers and ROS."""

import xml.etree.ElementTree as ElementTree
from xml.sax.saxutils import quoteattr

import numpy as np
import yaml

from stcal.geometry.rigid import Rigid
from stcal.handeye.data.pairs import FRAMES
from stcal.handeye.report.export.frames import CameraFrame, said_of, tree
from stcal.handeye.result import HandEye
from stcal.io.plain_yaml import load_yaml, opencv_matrix
from stcal.io.poses.controllers import ABB, FANUC, KUKA, UR
from stcal.io.poses.static import (
    Static,
    fixed_joint,
    messages,
    metres,
    plain_numbers,
    pose_of_metres,
    static_of_joint,
    xyzw,
)


def opencv_yaml(result: HandEye) -> str:
    """Returns a file for ``cv2.FileStorage``: both transforms, 4×4, and their covariances if there are any; mm, rad."""
    covariances = (result.covariance, result.stand_covariance)
    lines = ["%YAML:1.0", "---", f'setup: "{result.setup}"', f'method: "{result.method}"', 'unit: "mm"']
    for (name, pose), covariance in zip(result.transforms.items(), covariances, strict=True):
        lines += opencv_matrix(name, pose.matrix())
        if covariance is not None:
            lines += opencv_matrix(f"{name}_covariance", covariance)
    return "\n".join(lines) + "\n"


def zivid_yaml(result: HandEye) -> str:
    """Returns a file as ``zivid.Matrix4x4`` saves and loads it: 4×4, mm."""
    head = "".join(f"# {line}\n" for line in said_of(result))
    content = {
        "__version__": {"serializer": 1, "data": 1},
        "FloatMatrix": {"Data": result.mount_from_camera.matrix().tolist()},
    }
    return head + yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=200)


def read_zivid(text: str) -> Rigid:
    """Returns the transform in a file of :func:`zivid_yaml`, mm."""
    return Rigid.from_matrix(load_yaml(text)["FloatMatrix"]["Data"])


REMARK = 32
"""Largest number of characters of a remark in a FANUC program."""


def kuka_dat(result: HandEye, name: str) -> str:
    """Returns a data list of KRL with the frame."""
    head = "".join(f"; {line}\n" for line in said_of(result))
    frame = f"DECL GLOBAL FRAME {FRAMES[result.setup].camera}={{{KUKA.write(result.mount_from_camera)}}}\n"
    return f"&ACCESS RVP\nDEFDAT {name} PUBLIC\n{head}{frame}ENDDAT\n"


def abb_module(result: HandEye, name: str) -> str:
    """Returns a module of RAPID with a ``pose``."""
    head = "".join(f"  ! {line}\n" for line in said_of(result))
    frame = f"  PERS pose {FRAMES[result.setup].camera}:=[{ABB.write(result.mount_from_camera)}];\n"
    return f"MODULE {name}\n{head}{frame}ENDMODULE\n"


def ur_script(result: HandEye) -> str:
    """Returns a pose of URScript."""
    head = "".join(f"# {line}\n" for line in said_of(result))
    return f"{head}{FRAMES[result.setup].camera} = {UR.write(result.mount_from_camera)}\n"


def fanuc_program(result: HandEye, name: str) -> str:
    """Returns a program (LS) with the frame as its position."""
    remarks = [FRAMES[result.setup].camera]
    if result.covariance is not None:
        sigma = np.sqrt(np.diag(result.covariance))
        for unit, part in (("mm", sigma[3:]), ("deg", np.degrees(sigma[:3]))):
            remarks.append(f"sigma {unit} " + " ".join(f"{v:.2g}" for v in part))
    lines = [f"/PROG  {name}", "/ATTR", 'COMMENT = "stcal handeye";', "/MN"]
    lines += [f"   {k}:  !{remark[:REMARK]} ;" for k, remark in enumerate(remarks, 1)]
    lines += ["/POS", "P[1]{", "   GP1:", "\tUF : 0, UT : 0,\t\tCONFIG : 'N U T, 0, 0, 0',"]
    return "\n".join([*lines, FANUC.write(result.mount_from_camera), "};", "/END"]) + "\n"


IN_HAND = "eye-in-hand"


def ros_yaml(result: HandEye, parent: str = "", child: str = "", camera_frame: CameraFrame = "optical") -> str:
    """Returns ``geometry_msgs/TransformStamped`` as YAML, for a static transform; lengths in metres.

    ``parent``, ``child``, ``camera_frame`` : see :func:`~stcal.handeye.report.export.frames.tree`. Each of its
    transforms becomes one document.
    """
    return messages(tree(result, parent, child, camera_frame))


def urdf_joint(result: HandEye, parent: str = "", child: str = "", camera_frame: CameraFrame = "optical") -> str:
    """Returns a fixed joint of URDF: ``origin`` in metres, and roll, pitch, yaw about the parent's axes in rad.

    For ``camera_frame`` ``link`` these are two joints with their child links, in a ``robot`` that xacro can include.
    """
    transforms = tree(result, parent, child, camera_frame)
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
