"""Readers of the static transforms that ``stcal.io.static_transforms`` writes, as the other programs read them."""

import ast
import xml.etree.ElementTree as ElementTree

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from stcal.geometry.rigid import Rigid
from stcal.io.static_transforms import ARGUMENTS, METRE_MM, Static, from_roll_pitch_yaw


def pose_of_metres(translation_m, quaternion_xyzw) -> Rigid:
    """Return the pose of a translation in metres and a quaternion; inverse of :func:`metres` and :func:`xyzw`."""
    turn = Rotation.from_quat([float(v) for v in quaternion_xyzw]).as_matrix()
    return Rigid(turn, [METRE_MM * float(v) for v in translation_m])


def read_messages(text: str) -> list[Static]:
    """Return the transforms in a text of :func:`messages`."""
    statics = []
    for document in yaml.safe_load_all(text):
        transform = document["transform"]
        pose = pose_of_metres([transform["translation"][c] for c in "xyz"], [transform["rotation"][c] for c in "xyzw"])
        statics.append(Static(document["header"]["frame_id"], document["child_frame_id"], pose))
    return statics


def static_of_joint(joint: ElementTree.Element) -> Static:
    """Return the transform of a joint of :func:`fixed_joint`."""
    parts = {part.tag: part.attrib for part in joint}
    place, angles = ([float(v) for v in parts["origin"][key].split()] for key in ("xyz", "rpy"))
    pose = Rigid(from_roll_pitch_yaw(angles), METRE_MM * np.array(place))
    return Static(parts["parent"]["link"], parts["child"]["link"], pose)


def read_ros2_launch(text: str) -> list[Static]:
    """Return the transforms in a launch file of :func:`ros2_launch`."""
    words = [node.value for node in ast.walk(ast.parse(text)) if isinstance(node, ast.keyword) and node.arg]
    lists = [ast.literal_eval(node) for node in words if isinstance(node, ast.List)]
    return [_static_of_arguments(arguments) for arguments in lists]


def _static_of_arguments(words: list[str]) -> Static:
    given = dict(zip(words[::2], words[1::2], strict=True))
    values = [given[name] for name in ARGUMENTS]
    return Static(given["--frame-id"], given["--child-frame-id"], pose_of_metres(values[:3], values[3:]))
