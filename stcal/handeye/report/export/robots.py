"""A hand-eye transform as frames of robot controllers: KUKA, ABB, Universal Robots, FANUC.

Each file has a reader here. Comments are ASCII, which controllers need.
"""

import re

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.geometry.rigid import Poses, Rigid
from stcal.handeye.data.loop import FRAMES
from stcal.handeye.report.export.frames import METRE_MM, from_roll_pitch_yaw, roll_pitch_yaw, said_of
from stcal.handeye.result import HandEye
from stcal.report.text import number

MM_DIGITS, DEG_DIGITS, UNIT_DIGITS = 6, 9, 12
"""Printed of mm (nanometres), degrees, and of quaternions, radians and metres."""
REMARK = 32
"""Characters of a remark in a FANUC program."""
_NUMBER = r"(-?\d+\.\d+)"


def kuka_dat(result: HandEye, name: str) -> str:
    """A data list of KRL with the frame: mm, and degrees A about Z, B about the new Y, C about the newest X."""
    roll, pitch, yaw = np.degrees(roll_pitch_yaw(result.mount_from_camera))
    place = [
        f"{axis} {number(v, MM_DIGITS)}" for axis, v in zip("XYZ", result.mount_from_camera.translation, strict=True)
    ]
    turn = [f"{axis} {number(v, DEG_DIGITS)}" for axis, v in zip("ABC", (yaw, pitch, roll), strict=True)]
    head = "".join(f"; {line}\n" for line in said_of(result))
    frame = ",".join([*place, *turn])
    return (
        f"&ACCESS RVP\nDEFDAT {name} PUBLIC\n{head}"
        f"DECL GLOBAL FRAME {FRAMES[result.setup].camera}={{{frame}}}\nENDDAT\n"
    )


def read_kuka(text: str) -> Rigid:
    """Back from it: Rz(A) Ry(B) Rx(C)."""
    x, y, z, a, b, c = _values(text, [f"{axis} {_NUMBER}" for axis in "XYZABC"])
    return Rigid(from_roll_pitch_yaw(np.radians([c, b, a])), [x, y, z])


def abb_module(result: HandEye, name: str) -> str:
    """A module of RAPID with a ``pose``: mm, and quaternion q1 (the real part) to q4."""
    place = _joined(result.mount_from_camera.translation, MM_DIGITS)
    turn = _joined(Poses.of([result.mount_from_camera]).quaternions()[0], UNIT_DIGITS)
    head = "".join(f"  ! {line}\n" for line in said_of(result))
    frame = f"  PERS pose {FRAMES[result.setup].camera}:=[[{place}],[{turn}]];\n"
    return f"MODULE {name}\n{head}{frame}ENDMODULE\n"


def read_abb(text: str) -> Rigid:
    """Back from it."""
    numbers = ",".join([_NUMBER] * 3), ",".join([_NUMBER] * 4)
    *place, w, x, y, z = _values(text, [rf":=\[\[{numbers[0]}\],\[{numbers[1]}\]\]"])
    return Rigid(Rotation.from_quat([x, y, z, w]).as_matrix(), place)


def ur_script(result: HandEye) -> str:
    """A pose of URScript: metres, and rotation vector in rad."""
    pose = result.mount_from_camera
    values = _joined([*(pose.translation / METRE_MM), *pose.log()[:3]], UNIT_DIGITS, ", ")
    head = "".join(f"# {line}\n" for line in said_of(result))
    return f"{head}{FRAMES[result.setup].camera} = p[{values}]\n"


def read_ur(text: str) -> Rigid:
    """Back from it."""
    values = np.array(_values(text, [r"p\[" + ", ".join([_NUMBER] * 6)]))
    return Rigid.exp([*values[3:], *(METRE_MM * values[:3])])


def fanuc_program(result: HandEye, name: str) -> str:
    """A program (LS) with the frame as its position: mm, and degrees W, P, R about the fixed X, Y, Z in this order."""
    place = result.mount_from_camera.translation
    w, p, r = np.degrees(roll_pitch_yaw(result.mount_from_camera))
    remarks = [FRAMES[result.setup].camera]
    if result.covariance is not None:
        sigma = np.sqrt(np.diag(result.covariance))
        for unit, part in (("mm", sigma[3:]), ("deg", np.degrees(sigma[:3]))):
            remarks.append(f"sigma {unit} " + " ".join(f"{v:.2g}" for v in part))
    lines = [f"/PROG  {name}", "/ATTR", 'COMMENT = "stcal handeye";', "/MN"]
    lines += [f"   {k}:  !{remark[:REMARK]} ;" for k, remark in enumerate(remarks, 1)]
    lines += ["/POS", "P[1]{", "   GP1:", "\tUF : 0, UT : 0,\t\tCONFIG : 'N U T, 0, 0, 0',"]
    lines.append(
        "\t" + ",\t".join(f"{c} = {number(v, MM_DIGITS)}  mm" for c, v in zip("XYZ", place, strict=True)) + ","
    )
    lines.append("\t" + ",\t".join(f"{c} = {number(v, DEG_DIGITS)} deg" for c, v in zip("WPR", (w, p, r), strict=True)))
    return "\n".join([*lines, "};", "/END"]) + "\n"


def read_fanuc(text: str) -> Rigid:
    """Back from it: Rz(R) Ry(P) Rx(W)."""
    x, y, z, w, p, r = _values(text, [f"{axis} = {_NUMBER}" for axis in "XYZWPR"])
    return Rigid(from_roll_pitch_yaw(np.radians([w, p, r])), [x, y, z])


def program_name(stem: str) -> str:
    """The file's name as far as a controller takes it for that of a module: letters, digits and ``_``, 24 at most, not
    begun by a digit."""
    word = re.sub(r"\W", "_", stem, flags=re.ASCII)[:24]
    return word if re.match(r"[A-Za-z]", word) else f"stcal_{word}"[:24].rstrip("_")


def _values(text: str, patterns: list[str]) -> list[float]:
    """Numbers of the first match of each pattern below the comments."""
    below = "\n".join(line for line in text.splitlines() if not line.lstrip().startswith((";", "!", "#")))
    found = [re.search(pattern, below) for pattern in patterns]
    return [float(v) for match in found if match for v in match.groups()]


def _joined(values, digits: int, between: str = ",") -> str:
    return between.join(number(v, digits) for v in values)
