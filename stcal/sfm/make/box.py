"""The four sides and the top of a box that stands: where they are, and where circles may lie on each of them."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stcal.errors import InputError
from stcal.geometry.rigid import Rigid

EDGE_SHARE = 0.06
"""Width of the margin along the rim of a plate that stays free of circles, as a share of the plate's shorter side. It
leaves room to cut, fold and glue."""


@dataclass(frozen=True, slots=True, eq=False)
class Side:
    """A side of the box.

    ``width``, ``height`` : size of its plate, mm; ``box_from_plate`` : pose of the plate. The plate's origin is at the
    lower left as seen from outside, Y points upwards, Z outwards.
    """

    name: str
    width: float
    height: float
    box_from_plate: Rigid

    @property
    def edge(self) -> float:
        """Width of the margin without circles, mm."""
        return EDGE_SHARE * min(self.width, self.height)

    def outline(self) -> np.ndarray:
        """Returns the corners of the plate, (4, 2), mm."""
        return np.array([[0, 0], [self.width, 0], [self.width, self.height], [0, self.height]])


NAMES = ("front", "right", "back", "left", "top")
"""Names of the sides that may have circles."""


def sides_of(size_mm: tuple[float, float, float], names: tuple[str, ...] = NAMES) -> list[Side]:
    """Returns the sides with these names, in this order, of a box of this width, height and depth. The origin is in the
    middle of the box, Z points upwards."""
    w, h, d = size_mm
    x, y, z = np.eye(3)
    rows = (
        ("front", w, h, (x, z), (-w, -d, -h)),
        ("right", d, h, (y, z), (w, -d, -h)),
        ("back", w, h, (-x, z), (w, d, -h)),
        ("left", d, h, (-y, z), (-w, d, -h)),
        ("top", w, d, (x, y), (-w, -d, h)),
    )
    side_of = {
        name: Side(name, width, height, Rigid(np.column_stack([x, y, np.cross(x, y)]), np.array(corner) / 2))
        for name, width, height, (x, y), corner in rows
    }
    return [side_of[name] for name in names]


def faces_of(text: str) -> tuple[str, ...]:
    """Parses ``front,right,top`` into the names of sides; all of them if the text is empty."""
    names = tuple(name.strip().lower() for name in text.split(",")) if text else NAMES
    require_sides(names, text)
    return names


def require_sides(names: Sequence[str], text: str) -> None:
    """Refuses names of sides on which circles cannot lie together; ``text`` : the names in the message.

    Raises InputError if a name is unknown or occurs twice, or if no two of the sides are neighbours.
    """
    for name in names:
        if name not in NAMES:
            raise InputError("E-OPTION-VALUE", f"--faces {text}: {name!r} is no side; use some of {', '.join(NAMES)}")
        if names.count(name) > 1:
            raise InputError("E-OPTION-REPEATED", f"--faces {text}: {name} occurs twice; name each side once")
    if len(names) < 2 or set(names) in ({"front", "back"}, {"left", "right"}):
        raise InputError(
            "E-OPTION-VALUE",
            f"--faces {text}: two sides with a common edge needed, so that one photograph shows both; "
            "use such as front,right,top",
        )


def size_of(text: str) -> tuple[float, float, float]:
    """Parses ``W,H,D``, or ``WxHxD``, into width, height and depth in mm.

    Raises InputError if the text is not three lengths.
    """
    try:
        width, height, depth = map(float, re.split("[,x×]", text))
    except ValueError as error:
        raise InputError("E-OPTION-VALUE", f"--size {text}: W,H,D in mm needed, such as 120,120,100") from error
    require_size((width, height, depth), text)
    return width, height, depth


def require_size(size_mm: Sequence[float], text: str) -> None:
    """Refuses sides outside 1 mm to 100 m; ``text`` : the size in the message."""
    if not all(1 <= side <= 1e5 for side in size_mm):
        raise InputError("E-OPTION-RANGE", f"--size {text}: sides of 1 mm to 100 m needed")
