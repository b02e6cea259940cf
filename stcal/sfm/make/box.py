"""A box that stands: its four sides and its top, where they are, and where on each of them circles may lie."""

from dataclasses import dataclass

import numpy as np

from stcal.errors import InputError
from stcal.geometry.rigid import Rigid

EDGE_SHARE = 0.06
"""From a rim to the edge of a plate, in parts of the plate's shorter side: room to cut, fold and glue."""


@dataclass(frozen=True, slots=True, eq=False)
class Side:
    """A side: ``width``, ``height`` of its plate, mm; ``box_from_plate`` : the plate's origin is below on the left as
    seen from outside, Y upwards, Z outwards."""

    name: str
    width: float
    height: float
    box_from_plate: Rigid

    @property
    def edge(self) -> float:
        """Free of circles, mm."""
        return EDGE_SHARE * min(self.width, self.height)

    def outline(self) -> np.ndarray:
        """Corners of its plate, (4, 2)."""
        return np.array([[0, 0], [self.width, 0], [self.width, self.height], [0, self.height]])


def sides_of(size_mm: tuple[float, float, float]) -> list[Side]:
    """Of a box of that width, height and depth, whose origin is in its middle, Z upwards."""
    w, h, d = size_mm
    x, y, z = np.eye(3)
    rows = (
        ("front", w, h, (x, z), (-w, -d, -h)),
        ("right", d, h, (y, z), (w, -d, -h)),
        ("back", w, h, (-x, z), (w, d, -h)),
        ("left", d, h, (-y, z), (-w, d, -h)),
        ("top", w, d, (x, y), (-w, -d, h)),
    )
    return [
        Side(name, width, height, Rigid(np.column_stack([across, up, np.cross(across, up)]), np.array(corner) / 2))
        for name, width, height, (across, up), corner in rows
    ]


def size_of(text: str) -> tuple[float, float, float]:
    """``W,H,D`` in mm.

    Raises
    ------
    InputError
        Not three lengths, or far from what a photograph shows.
    """
    try:
        width, height, depth = map(float, text.split(","))
    except ValueError as error:
        raise InputError("E-OPTION-VALUE", f"--size {text}: W,H,D in mm needed, such as 120,120,100") from error
    if not all(1 <= side <= 1e5 for side in (width, height, depth)):
        raise InputError("E-OPTION-RANGE", f"--size {text}: sides of 1 mm to 100 m needed")
    return width, height, depth
