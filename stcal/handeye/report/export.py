"""A hand-eye transform in the files of other programs: ROS, URDF, OpenCV."""

import warnings
from xml.sax.saxutils import quoteattr

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from stcal.errors import InputError
from stcal.geometry.rigid import Poses, Rigid
from stcal.handeye.data.loop import FRAMES
from stcal.handeye.result import HandEye

METRE_MM = 1000.0
"""ROS and URDF have metres."""
CAMERA_FRAME = "camera_optical_frame"
"""What ROS calls a frame whose Z looks along the line of sight and X to the right, as ours does."""


def ros_yaml(result: HandEye, parent: str = "", child: str = "") -> str:
    """``geometry_msgs/TransformStamped`` as YAML, for a static transform; lengths in metres.

    ``parent``, ``child`` : names of the frames; flange or base, and :data:`CAMERA_FRAME`, where none are given.
    """
    parent, child = _frames(result, parent, child)
    pose = result.mount_from_camera
    w, x, y, z = (float(v) for v in Poses.of([pose]).quaternions()[0])
    content = {
        "header": {"frame_id": parent},
        "child_frame_id": child,
        "transform": {
            "translation": dict(zip("xyz", _metres(pose), strict=True)),
            "rotation": {"x": x, "y": y, "z": z, "w": w},
        },
    }
    return yaml.safe_dump(content, sort_keys=False, allow_unicode=True)


def urdf_joint(result: HandEye, parent: str = "", child: str = "") -> str:
    """A fixed joint of URDF: ``origin`` in metres, and roll, pitch, yaw about the parent's axes in rad."""
    parent, child = _frames(result, parent, child)
    name = quoteattr(f"{parent}_to_{child}")
    origin = " ".join(repr(v) for v in _metres(result.mount_from_camera))
    angles = " ".join(repr(float(v)) for v in roll_pitch_yaw(result.mount_from_camera))
    return (
        f'<joint name={name} type="fixed">\n'
        f"  <parent link={quoteattr(parent)}/>\n"
        f"  <child link={quoteattr(child)}/>\n"
        f'  <origin xyz="{origin}" rpy="{angles}"/>\n'
        "</joint>\n"
    )


def opencv_yaml(result: HandEye) -> str:
    """A file for ``cv2.FileStorage``: both transforms, 4×4, and their covariances where there are any; mm, rad."""
    covariances = (result.covariance, result.stand_covariance)
    lines = ["%YAML:1.0", "---", f'setup: "{result.setup}"', f'method: "{result.method}"', 'unit: "mm"']
    for (name, pose), covariance in zip(result.transforms.items(), covariances, strict=True):
        lines += _matrix(name, pose.matrix())
        if covariance is not None:
            lines += _matrix(f"{name}_covariance", covariance)
    return "\n".join(lines) + "\n"


def roll_pitch_yaw(pose: Rigid) -> np.ndarray:
    """(3,) rad, about the fixed axes X, Y, Z, in this order."""
    with warnings.catch_warnings():
        # At a pitch of ±90° roll and yaw are one turn; scipy says so, and gives it to the yaw: the rotation is right.
        warnings.filterwarnings("ignore", "Gimbal lock")
        return Rotation.from_matrix(np.array(pose.rotation)).as_euler("xyz")


def require_frame_names(*names: str) -> None:
    """Refuse names of frames that are none, or not all different; empty ones stand for the usual.

    Raises
    ------
    InputError
        A character that no file and no terminal shows, or a name twice.
    """
    given = [name for name in names if name]
    for name in given:
        if not name.isprintable():
            raise InputError(f"frames: {name!r} has control characters; give a name in letters")
        if given.count(name) > 1:
            raise InputError(f"frames: parent and child are both {name!r}; two names needed")


def _frames(result: HandEye, parent: str, child: str) -> tuple[str, str]:
    names = parent or FRAMES[result.setup].mount, child or CAMERA_FRAME
    require_frame_names(*names)
    return names


def _metres(pose: Rigid) -> list[float]:
    return [float(v) / METRE_MM for v in pose.translation]


def _matrix(name: str, values: np.ndarray) -> list[str]:
    rows, columns = values.shape
    numbers = ",\n       ".join(", ".join(repr(float(v)) for v in row) for row in values)
    return [
        f"{name}: !!opencv-matrix",
        f"   rows: {rows}",
        f"   cols: {columns}",
        "   dt: d",
        f"   data: [ {numbers} ]",
    ]
