"""Poses in the form of robot controllers, written and read: KUKA, ABB, Universal Robots, FANUC, Yaskawa."""

import re
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.errors import InputError
from stcal.geometry.rigid import Poses, Rigid
from stcal.io.poses.columns import fixed, joined, without_comments

METRE_MM = 1000.0
"""Millimetres per metre, the unit of ROS, URDF and Universal Robots."""
MM_DIGITS, DEG_DIGITS, UNIT_DIGITS = 6, 9, 12
"""Digits of printed mm (to a nanometre), of degrees, and of quaternions, radians and metres."""
YASKAWA_MM_DIGITS, YASKAWA_DEG_DIGITS = 3, 4
"""Digits of the fields of a JBI file."""
REMARK = 32
"""Largest number of characters of a remark, in a FANUC program and in a JBI file."""
NUMBER = r"(-?\d+\.\d+)"


@dataclass(frozen=True, slots=True)
class PoseText:
    """The text form of a pose.

    ``write`` : returns the text of a pose; ``form`` : pattern of that text with its numbers as groups; ``pose`` :
    returns the pose of these numbers.
    """

    write: Callable[[Rigid], str]
    form: re.Pattern[str]
    pose: Callable[[Sequence[float]], Rigid]

    def read(self, text: str) -> list[Rigid]:
        """Return all poses of a text, without those in comments."""
        return [self.pose([float(v) for v in match.groups()]) for match in self.form.finditer(without_comments(text))]

    def first(self, text: str) -> Rigid:
        """Return the first pose of a text, without those in comments."""
        return self.read(text)[0]


def roll_pitch_yaw(pose: Rigid) -> np.ndarray:
    """Return roll, pitch and yaw (3,), rad, about the fixed axes X, Y, Z, in this order.

    At a pitch of ±90° only the sum or difference of roll and yaw is determined. Roll is therefore computed from the
    rotation that remains after pitch and yaw. This keeps full precision at and near ±90°, where angles computed from
    single matrix elements lose half of their digits.
    """
    r = pose.rotation
    pitch = np.arctan2(-r[2, 0], np.hypot(r[0, 0], r[1, 0]))
    yaw = np.arctan2(r[1, 0], r[0, 0])
    remaining = from_roll_pitch_yaw([0.0, pitch, yaw]).T @ r
    return np.array([np.arctan2(remaining[2, 1], remaining[1, 1]), pitch, yaw])


def from_roll_pitch_yaw(angles) -> np.ndarray:
    """Return the rotation (3, 3) of roll, pitch and yaw, rad: the inverse of :func:`roll_pitch_yaw`."""
    return Rotation.from_euler("xyz", angles).as_matrix()


def _by_angles(pose: Rigid) -> np.ndarray:
    """Return x, y, z in mm, and degrees about the fixed axes X, Y, Z in this order, (6,)."""
    return np.append(pose.translation, np.degrees(roll_pitch_yaw(pose)))


def _of_angles(values: Sequence[float]) -> Rigid:
    return Rigid(from_roll_pitch_yaw(np.radians(values[3:])), values[:3])


def _kuka(pose: Rigid) -> str:
    x, y, z, c, b, a = _by_angles(pose)
    place = [f"{axis} {fixed(v, MM_DIGITS)}" for axis, v in zip("XYZ", (x, y, z), strict=True)]
    return ",".join([*place, *(f"{axis} {fixed(v, DEG_DIGITS)}" for axis, v in zip("ABC", (a, b, c), strict=True))])


def _abb(pose: Rigid) -> str:
    turn = joined(Poses.of([pose]).quaternions()[0], UNIT_DIGITS)
    return f"[{joined(pose.translation, MM_DIGITS)}],[{turn}]"


def _of_abb(values: Sequence[float]) -> Rigid:
    *place, w, x, y, z = values
    return Rigid(Rotation.from_quat([x, y, z, w]).as_matrix(), place)


def _ur(pose: Rigid) -> str:
    return f"p[{joined([*(pose.translation / METRE_MM), *pose.log()[:3]], UNIT_DIGITS, ', ')}]"


def _of_ur(values: Sequence[float]) -> Rigid:
    return Rigid.exp([*values[3:], *(METRE_MM * v for v in values[:3])])


def _fanuc(pose: Rigid) -> str:
    values = _by_angles(pose)
    place = ",\t".join(f"{c} = {fixed(v, MM_DIGITS)}  mm" for c, v in zip("XYZ", values[:3], strict=True))
    turn = ",\t".join(f"{c} = {fixed(v, DEG_DIGITS)} deg" for c, v in zip("WPR", values[3:], strict=True))
    return f"\t{place},\n\t{turn}"


def _yaskawa(pose: Rigid) -> str:
    values = _by_angles(pose)
    return f"{joined(values[:3], YASKAWA_MM_DIGITS)},{joined(values[3:], YASKAWA_DEG_DIGITS)}"


KUKA = PoseText(
    _kuka,
    re.compile(",".join(f"{axis} {NUMBER}" for axis in "XYZABC")),
    lambda v: _of_angles([*v[:3], *reversed(v[3:])]),
)
"""Form of KUKA: mm, and degrees A about Z, B about the new Y, C about the newest X: Rz(A) Ry(B) Rx(C)."""
ABB = PoseText(_abb, re.compile(rf"\[{','.join([NUMBER] * 3)}\],\[{','.join([NUMBER] * 4)}\]"), _of_abb)
"""Form of ABB: mm, and quaternion q1 (the real part) to q4."""
UR = PoseText(_ur, re.compile(rf"p\[{', '.join([NUMBER] * 6)}\]"), _of_ur)
"""Form of Universal Robots: metres, and rotation vector in rad."""
FANUC = PoseText(_fanuc, re.compile(r",\s+".join(rf"{axis} = {NUMBER} +(?:mm|deg)" for axis in "XYZWPR")), _of_angles)
"""Form of FANUC: mm, and degrees W, P, R about the fixed X, Y, Z in this order: Rz(R) Ry(P) Rx(W)."""
YASKAWA = PoseText(_yaskawa, re.compile(rf"^C\d+={','.join([NUMBER] * 6)}$", re.MULTILINE), _of_angles)
"""Form of Yaskawa: mm, and degrees Rx, Ry, Rz as FANUC's W, P, R; one C line of a JBI file."""


def require_form(form: str, forms: Collection[str]) -> None:
    """Refuses a form of ``--export`` that is not one of ``forms``.

    Raises InputError: the form is unknown; the message names the known ones.
    """
    if form not in forms:
        raise InputError("E-OPTION-FORM", f"--export {form}: unknown; one of {', '.join(forms)} needed")
