"""Frames of an exported transform: their names, ROS's two frames of a camera, and comments on the result."""

from typing import Literal

import numpy as np

import stcal
from stcal.errors import InputError
from stcal.geometry.rigid import Rigid
from stcal.handeye.data.pairs import FRAMES, Setup
from stcal.handeye.result import HandEye
from stcal.io.poses.static import Static

CAMERA_FRAME = "camera_optical_frame"
"""Name in ROS of a camera frame with Z along the line of sight and X to the right, as in stcal."""
CAMERA_LINK = "camera_link"
"""Name in ROS of a camera frame with X along the line of sight, Y to the left and Z up."""
LINK_FROM_OPTICAL = Rigid([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], [0, 0, 0])
"""Rotation between both frames, which share their origin: REP 103, suffix frames."""
CameraFrame = Literal["optical", "link"]


def tree(result: HandEye, parent: str = "", child: str = "", camera_frame: CameraFrame = "optical") -> list[Static]:
    """Returns the transforms that add the camera to a tree of frames, in which each frame has one parent.

    ``parent``, ``child`` : names of the frames. If empty: flange or base, and :data:`CAMERA_FRAME` or
    :data:`CAMERA_LINK`. ``camera_frame`` : ``optical``: the camera's own frame; ``link``: the link, and the optical
    frame in it.

    Raises InputError: a name is invalid, or the names are not all different.
    """
    mount, *names = frame_names(result.setup, parent, child, camera_frame)
    require_frame_names(mount, *names)
    if camera_frame == "optical":
        return [Static(mount, names[0], result.mount_from_camera)]
    link, optical = names
    mount_from_link = result.mount_from_camera @ LINK_FROM_OPTICAL.inverse()
    return [Static(mount, link, mount_from_link), Static(link, optical, LINK_FROM_OPTICAL)]


def frame_names(setup: Setup, parent: str, child: str, camera_frame: CameraFrame) -> tuple[str, ...]:
    """Returns the names of the frames of :func:`tree` from the root; NAME_link has the child NAME_optical_frame."""
    mount = parent or FRAMES[setup].mount
    if camera_frame == "optical":
        return mount, child or CAMERA_FRAME
    link = child or CAMERA_LINK
    return mount, link, f"{link.removesuffix('_link')}_optical_frame"


def require_frame_names(*names: str) -> None:
    """Checks that names of frames are printable and all different; empty names stand for the defaults.

    Raises InputError: a name has a control character, or occurs twice.
    """
    given = [name for name in names if name]
    for name in given:
        if not name.isprintable():
            raise InputError("E-FRAME-NAME", f"frames: {name!r} has control characters; give a name in letters")
        if given.count(name) > 1:
            raise InputError("E-FRAME-NAME", f"frames: parent and child are both {name!r}; two names needed")


def said_of(result: HandEye) -> list[str]:
    """Returns lines for comments: the transform's name, σ, and covariance. ASCII only, for robot controllers."""
    frames = FRAMES[result.setup]
    lines = [f"stcal {stcal.__version__}: {frames.camera}, {result.setup}, {result.method}, {len(result.names)} poses"]
    if result.covariance is None:
        return [*lines, f"no covariance: method {result.method} gives none"]
    sigma = np.sqrt(np.diag(result.covariance))
    turn, shift = (" ".join(f"{v:.4g}" for v in part) for part in (np.degrees(sigma[:3]), sigma[3:]))
    lines.append(f"sigma along x y z of the {frames.mount}: {shift} mm; about them: {turn} deg")
    lines.append(f"covariance, rotation about x y z (rad), then shift along x y z (mm), axes of the {frames.mount}:")
    return lines + ["  " + " ".join(f"{v:.6e}" for v in row) for row in result.covariance]
