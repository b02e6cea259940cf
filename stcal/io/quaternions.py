"""Quaternions in four columns: the order of their components, and mistakes in it."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from stcal.errors import InputError
from stcal.geometry.rigid import UNIT_WITHIN, Poses

COLUMNS = ("qw", "qx", "qy", "qz")
EXPLAINS = 0.2
"""A mistake explains a misfit if its correction reduces the misfit below this share."""


def require_unit(wxyz: np.ndarray, place: Callable[[int], str], where: str, remedy: str) -> None:
    """Refuse quaternions (m, 4) that are not of unit length.

    ``place`` : returns the place of row i in ``where``; ``remedy`` : end of the message.
    """
    with np.errstate(over="ignore"):  # quaternions that are refused
        length = np.linalg.norm(wxyz, axis=1)
    bad = np.flatnonzero(~(np.abs(length - 1) <= UNIT_WITHIN))
    if len(bad):
        suffix = f" (and {len(bad) - 1} more)" if len(bad) > 1 else ""
        raise InputError(
            "E-QUATERNION-LENGTH",
            f"{where}: {place(bad[0])}: quaternion of length {length[bad[0]]:.4g}, 1 ± {UNIT_WITHIN:g} needed{suffix}; "
            f"{remedy}",
        )


@dataclass(frozen=True, slots=True)
class Reading:
    """A hypothesis on the true content of columns that were read as w, x, y, z.

    ``held`` : True content, in words; ``remedy`` : correction, in words; ``order`` : indices of the true w, x, y, z
    among the components read; ``conjugated`` : True if the sign of the vector part is inverted.
    """

    held: str
    remedy: str
    order: tuple[int, ...] = (0, 1, 2, 3)
    conjugated: bool = False

    def rotations(self, read: np.ndarray) -> np.ndarray:
        """Return the rotations (m, 3, 3) that this hypothesis makes of the rotations ``read`` (m, 3, 3)."""
        wxyz = Poses(read, np.zeros((len(read), 3))).quaternions()[:, self.order]
        corrected = Poses.from_quaternions(wxyz, np.zeros((len(read), 3))).rotation
        return np.swapaxes(corrected, 1, 2) if self.conjugated else corrected

    def poses(self, read: Poses) -> Poses:
        """Return the poses ``read`` with corrected rotations; translations are unchanged."""
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
    """Return the reading of rotations (m, 3, 3) that explains their misfit, and its misfit; None if no reading does.

    ``misfit`` : returns one number for rotations (m, 3, 3). A reading explains the misfit if it reduces it below the
    share :data:`EXPLAINS`. No reading does if all fit alike, as with the same orientation in all rows.
    """
    misfit_of = {reading: misfit(reading.rotations(read)) for reading in READINGS}
    best = min(misfit_of, key=misfit_of.__getitem__)
    return (best, misfit_of[best]) if misfit_of[best] < EXPLAINS * misfit(read) else None
