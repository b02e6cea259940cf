"""Poses in the form of other programs: static transforms of ROS, in metres, and COLMAP's ``images.txt``."""

import json
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from xml.sax.saxutils import quoteattr

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from stcal.errors import InputError
from stcal.geometry.rigid import Rigid
from stcal.io.rotations import fixed

ARGUMENTS = ("--x", "--y", "--z", "--qx", "--qy", "--qz", "--qw")
"""Arguments of ROS 2's ``static_transform_publisher``."""
METRE_DIGITS, QUATERNION_DIGITS = 12, 15
"""Digits of the arguments, which are written without exponents; the last digit of a length is 10⁻⁹ mm."""


@dataclass(frozen=True, slots=True, eq=False)
class Static:
    """A static transform in a tree of frames; ``pose`` : parent_from_child."""

    parent: str
    child: str
    pose: Rigid


def metres(pose: Rigid) -> list[float]:
    """Return the translation of a pose in metres."""
    return (pose.translation / METRE_MM).tolist()


def xyzw(pose: Rigid) -> list[float]:
    """Return the quaternion of a pose in the order of ROS, w ≥ 0."""
    return pose.as_scipy().as_quat(canonical=True).tolist()


def messages(statics: Iterable[Static]) -> str:
    """Return the YAML of ``geometry_msgs/TransformStamped``, one document for each transform."""
    documents = []
    for each in statics:
        parts = ("translation", "xyz", metres(each.pose)), ("rotation", "xyzw", xyzw(each.pose))
        transform = {part: dict(zip(axes, values, strict=True)) for part, axes, values in parts}
        head = {"header": {"frame_id": each.parent}, "child_frame_id": each.child}
        documents.append({**head, "transform": transform})
    return "---\n".join(yaml.safe_dump(each, sort_keys=False, allow_unicode=True) for each in documents)


def fixed_joint(each: Static) -> str:
    """Return a fixed joint of URDF."""
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


def ros2_launch(statics: Sequence[Static], said: Iterable[str] = ()) -> str:
    """Return a launch file of ROS 2, with lines of a comment, as MoveIt 2's calibration plugin writes it."""
    text = "".join(f"# {line}\n" for line in said)
    text += "from launch import LaunchDescription\nfrom launch_ros.actions import Node\n\n\n"
    text += "def generate_launch_description() -> LaunchDescription:\n    nodes = [\n"
    for static in statics:
        words = "".join(f"                {json.dumps(word, ensure_ascii=False)},\n" for word in _arguments(static))
        text += '        Node(\n            package="tf2_ros",\n            executable="static_transform_publisher",\n'
        text += f'            output="log",\n            arguments=[\n{words}            ],\n        ),\n'
    return text + "    ]\n    return LaunchDescription(nodes)\n"


def _arguments(each: Static) -> list[str]:
    values = zip(ARGUMENTS, _pose_words(each.pose), strict=True)
    pairs = [("--frame-id", each.parent), ("--child-frame-id", each.child), *values]
    return [word for pair in pairs for word in pair]


def _pose_words(pose: Rigid) -> list[str]:
    place = [fixed(value, METRE_DIGITS) for value in metres(pose)]
    return [*place, *(fixed(value, QUATERNION_DIGITS) for value in xyzw(pose))]


METRE_MM = 1000.0  # millimetres per metre, the unit of ROS, URDF and Universal Robots


def roll_pitch_yaw(pose: Rigid) -> np.ndarray:
    """Return roll, pitch and yaw (3,), rad, about the fixed axes X, Y, Z, in this order. Roll is computed from what
    remains after pitch and yaw, which keeps full precision at a pitch of ±90°."""
    r = pose.rotation
    pitch = np.arctan2(-r[2, 0], np.hypot(r[0, 0], r[1, 0]))
    yaw = np.arctan2(r[1, 0], r[0, 0])
    remaining = from_roll_pitch_yaw([0.0, pitch, yaw]).T @ r
    return np.array([np.arctan2(remaining[2, 1], remaining[1, 1]), pitch, yaw])


def from_roll_pitch_yaw(angles) -> np.ndarray:
    """Return the rotation (3, 3) of roll, pitch and yaw, rad: the inverse of :func:`roll_pitch_yaw`."""
    return Rotation.from_euler("xyz", angles).as_matrix()


def require_form(form: str, forms: Collection[str]) -> None:
    """Refuses a form of ``--export`` that is not one of ``forms``."""
    if form not in forms:
        raise InputError("E-OPTION-FORM", f"--export {form}: unknown; one of {', '.join(forms)} needed")


CELLS = 10
"""Cells of an image's first line: id, four of the rotation, three of the translation, camera, name."""
POINT_CELLS = 3
"""Cells of a point in an image's second line: x, y, id."""


@dataclass(frozen=True, slots=True)
class ImageLine:
    """The first line of an image, by number, and whether its second one is there: empty ones may have been removed."""

    number: int
    name: str
    followed: bool


def image_lines(text: str, where: str) -> list[ImageLine]:
    """Return the images of ``images.txt``, also of one from which empty lines were removed."""
    images: list[ImageLine] = []
    after_image = False
    for number, line in enumerate(text.splitlines(), 1):
        fault = ""
        if _is_image(line):
            images.append(ImageLine(number, line.split(maxsplit=CELLS - 1)[-1].strip(), followed=False))
        elif after_image:
            images[-1] = replace(images[-1], followed=True)
            fault = "" if _are_points(line) else f"{len(line.split())} cells, not points of `x y id` each"
        elif line.strip() and not line.lstrip().startswith("#"):
            fault = "not `id qw qx qy qz tx ty tz camera name`"
        if fault:
            raise InputError("E-MODEL-UNREADABLE", f"{where}: line {number}: {fault}; export the model anew")
        after_image = _is_image(line)
    return images


def _is_image(line: str) -> bool:
    cells = line.split(maxsplit=CELLS - 1)
    return len(cells) == CELLS and _are_numbers(cells[:9]) and not _are_points(line)


def _are_points(line: str) -> bool:
    cells = line.split()
    return len(cells) % POINT_CELLS == 0 and _are_numbers(cells)


def _are_numbers(cells: list[str]) -> bool:
    try:
        return all(float(cell) is not None for cell in cells)
    except ValueError:
        return False
