"""Fixed transforms of a tree of frames as ROS has them: messages, and joints of URDF; lengths in metres."""

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable
from dataclasses import dataclass
from xml.sax.saxutils import quoteattr

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from stcal.geometry.rigid import Poses, Rigid
from stcal.io.poses.controllers import METRE_MM, from_roll_pitch_yaw, roll_pitch_yaw


@dataclass(frozen=True, slots=True, eq=False)
class Static:
    """A fixed transform of a tree of frames, ``parent_from_child``."""

    parent: str
    child: str
    pose: Rigid


def metres(pose: Rigid) -> list[float]:
    """Its translation."""
    return [float(v) / METRE_MM for v in pose.translation]


def xyzw(pose: Rigid) -> list[float]:
    """Its quaternion, in the order of ROS, w ≥ 0."""
    return [float(v) for v in Rotation.from_matrix(np.array(pose.rotation)).as_quat(canonical=True)]


def pose_of_metres(translation_m, quaternion_xyzw) -> Rigid:
    """Back from these."""
    turn = Rotation.from_quat([float(v) for v in quaternion_xyzw]).as_matrix()
    return Rigid(turn, [METRE_MM * float(v) for v in translation_m])


def messages(statics: Iterable[Static]) -> str:
    """YAML of ``geometry_msgs/TransformStamped``, a document for each."""
    return "---\n".join(yaml.safe_dump(_message(each), sort_keys=False, allow_unicode=True) for each in statics)


def read_messages(text: str) -> list[Static]:
    """Back from :func:`messages`."""
    found = []
    for document in yaml.safe_load_all(text):
        own = document["transform"]
        pose = pose_of_metres([own["translation"][c] for c in "xyz"], [own["rotation"][c] for c in "xyzw"])
        found.append(Static(document["header"]["frame_id"], document["child_frame_id"], pose))
    return found


def _message(each: Static) -> dict:
    w, x, y, z = (float(v) for v in Poses.of([each.pose]).quaternions()[0])
    return {
        "header": {"frame_id": each.parent},
        "child_frame_id": each.child,
        "transform": {
            "translation": dict(zip("xyz", metres(each.pose), strict=True)),
            "rotation": {"x": x, "y": y, "z": z, "w": w},
        },
    }


def fixed_joint(each: Static) -> str:
    """A joint of URDF."""
    name = quoteattr(f"{each.parent}_to_{each.child}")
    origin = " ".join(repr(v) for v in metres(each.pose))
    angles = " ".join(repr(float(v)) for v in roll_pitch_yaw(each.pose))
    return (
        f'<joint name={name} type="fixed">\n'
        f"  <parent link={quoteattr(each.parent)}/>\n"
        f"  <child link={quoteattr(each.child)}/>\n"
        f'  <origin xyz="{origin}" rpy="{angles}"/>\n'
        "</joint>\n"
    )


def static_of_joint(joint: ElementTree.Element) -> Static:
    """Back from :func:`fixed_joint`."""
    parts = {part.tag: part.attrib for part in joint}
    place, angles = ([float(v) for v in parts["origin"][key].split()] for key in ("xyz", "rpy"))
    pose = Rigid(from_roll_pitch_yaw(angles), METRE_MM * np.array(place))
    return Static(parts["parent"]["link"], parts["child"]["link"], pose)
