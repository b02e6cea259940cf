"""Quaternions in four columns: the order in which they stand, and what else their columns may hold."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from stcal.errors import InputError
from stcal.geometry.rigid import UNIT_WITHIN, Poses

Order = Literal["wxyz", "xyzw"]
"""``wxyz`` : as the columns are named; ``xyzw`` : x, y, z, w in the order in which the columns stand."""
COLUMNS = ("qw", "qx", "qy", "qz")
EXPLAINS = 0.2
"""A mistake explains a misfit when mending it leaves less than this share of it."""


def require_unit(wxyz: np.ndarray, place: Callable[[int], str], where: str, remedy: str) -> None:
    """Refuse quaternions (m, 4) that are not of unit length.

    ``place`` : where row i stands in ``where``; ``remedy`` : the end of the message.

    Raises
    ------
    InputError
        Names the first, its length, and how many more there are.
    """
    with np.errstate(over="ignore"):  # of what is refused
        length = np.linalg.norm(wxyz, axis=1)
    bad = np.flatnonzero(~(np.abs(length - 1) <= UNIT_WITHIN))
    if len(bad):
        more = f" (and {len(bad) - 1} more)" if len(bad) > 1 else ""
        raise InputError(
            "E-QUATERNION-LENGTH",
            f"{where}: {place(bad[0])}: quaternion of length {length[bad[0]]:.4g}, 1 ± {UNIT_WITHIN:g} needed{more}; "
            f"{remedy}",
        )


@dataclass(frozen=True, slots=True)
class Reading:
    """What columns read as w, x, y, z may hold.

    ``held`` : in words; ``remedy`` : what to do then; ``order`` : of each of w, x, y, z the place among those read;
    ``conjugated`` : whether the vector part has the other sign.
    """

    held: str
    remedy: str
    order: tuple[int, ...] = (0, 1, 2, 3)
    conjugated: bool = False

    def rotations(self, read: np.ndarray) -> np.ndarray:
        """(m, 3, 3) of rotations as they were read (m, 3, 3)."""
        wxyz = Poses(read, np.zeros((len(read), 3))).quaternions()[:, self.order]
        right = Poses.from_quaternions(wxyz, np.zeros((len(read), 3))).rotation
        return np.swapaxes(right, 1, 2) if self.conjugated else right

    def poses(self, read: Poses) -> Poses:
        """Poses that were read, places as they are."""
        return Poses(self.rotations(read.rotation), read.translation)


LAST = Reading("x, y, z, w in the order of their columns", "give --quaternions xyzw", (3, 0, 1, 2))
FIRST = Reading(
    "z, w, x, y in the columns qw, qx, qy, qz", "leave --quaternions xyzw out, or name the columns so", (1, 2, 3, 0)
)
ORDERS = (LAST, FIRST)
INVERTED = Reading("conjugated (the first frame seen from the second)", "change the sign of qw", conjugated=True)
READINGS = (
    LAST,
    FIRST,
    INVERTED,
    *(
        Reading(f"{each.held}, and conjugated", f"{each.remedy} and change the sign of qw", each.order, True)
        for each in ORDERS
    ),
)


def explaining(read: np.ndarray, misfit: Callable[[np.ndarray], float]) -> tuple[Reading, float] | None:
    """The reading of rotations (m, 3, 3) that leaves less than :data:`EXPLAINS` of their misfit, with what it leaves.

    ``misfit`` : of rotations (m, 3, 3), one number. None where no reading does: also where all fit alike, as of one
    orientation in all rows.
    """
    left = {each: misfit(each.rotations(read)) for each in READINGS}
    best = min(left, key=left.__getitem__)
    return (best, left[best]) if left[best] < EXPLAINS * misfit(read) else None
