"""Poses in programs and point files of robot controllers, in mm and by the controller's own convention."""

import re

import numpy as np

from stcal.handeye.data.formats.record import Content, Side, Unit
from stcal.io.poses.columns import without_comments
from stcal.io.poses.rotations import turned_values

_N = r"([+-]?\d+\.?\d*(?:[eE][+-]?\d+)?)"

_ABB = r"(?:robtarget|pose)\b[^\[\n]*\[\s*\[" + r"\s*,\s*".join("NNN")


def _form(between: str, *parts: str) -> re.Pattern[str]:
    return re.compile(between.join(part.replace("N", _N) for part in parts))


PROGRAMS = {
    "points of KUKA": (_form(r"\s*,\s*", *(rf"\b{name}\s+N" for name in "XYZABC")), "kuka-abc"),
    "targets of ABB": (_form(r"\s*\]\s*,\s*\[", _ABB, r"\s*,\s*".join("NNNN")), "wxyz"),
    "positions of FANUC": (_form(r"\s*,\s*", *(rf"\b{name}\s*=\s*N\s*(?:mm|deg)" for name in "XYZWPR")), "fanuc-wpr"),
    "points of Doosan": (_form("", r"\bposx\(\s*", r"\s*,\s*".join("NNNNNN")), "ZYZ-deg"),
    "points of Epson": (_form(r"\s+", *(rf"\br{name}=N" for name in "XYZUVW")), "ZYX-deg"),
}
"""Form of a pose in a program of each controller, x, y, z first, and the convention of its rotation."""


def read_program(text: str, where: str) -> Content | None:
    """Returns the poses in a program of a controller, in their order; None for any other text.

    Raises InputError: a quaternion is not of unit length.
    """
    lines = [line if without_comments(line) else "" for line in text.splitlines()]
    plain = "\n".join(lines)
    for called, (form, rotation) in PROGRAMS.items():
        if matches := list(form.finditer(plain)):
            values = np.array([match.groups() for match in matches], float)
            places = tuple(f"line {plain.count(chr(10), 0, match.start()) + 1}" for match in matches)
            turn, words = turned_values(values[:, 3:], rotation, called, places, where)
            return Content(called, (Side(turn, values[:, :3], places, words, Unit("mm", "as in these", True)),))
    return None
