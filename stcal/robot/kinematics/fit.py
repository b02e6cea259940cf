"""Test whether measured orientations fit the robot, or would fit only in another quaternion convention."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.errors import InputError
from stcal.io.quaternions import explaining

FITS = 0.05
"""A nominal robot fits its data when its RMS error is below this share of their spread; factories err by under 1 %."""
TURNED_RAD = 0.2
"""Orientations of a robot that fits by its positions are within this of the nominal ones, RMS; the zeros of its joints,
and the base as positions have it, are off by less than half of that (:data:`FITS`)."""


def require_convention(where: str, targets: Sequence[str], flange: np.ndarray, seen: np.ndarray) -> None:
    """Refuse orientations that fit the robot only in another quaternion convention.

    Orientations that do not fit in any convention are accepted.

    Parameters
    ----------
    where : str
        Name of the file, for messages.
    targets : sequence of str
        (m,) names of the targets seen or commanded.
    flange : (m, 3, 3) array
        Rotations of the flange according to the robot model.
    seen : (m, 3, 3) array
        Rotations of the targets as read from the file.

    Raises
    ------
    InputError
        Only another convention fits; the message names it.
    """
    own = turned_rad(targets, flange, seen)
    if own < TURNED_RAD:
        return
    found = explaining(seen, lambda rotations: turned_rad(targets, flange, rotations))
    if found is not None:
        reading, left = found
        raise InputError(
            "E-ROBOT-ORIENTATIONS",
            f"{where}: orientations miss the robot by {np.degrees(own):.3g}° RMS, {np.degrees(TURNED_RAD):.2g}° "
            f"allowed; they would fit to {np.degrees(left):.2g}° if quaternions were {reading.held}; {reading.remedy}",
        )


def turned_rad(targets: Sequence[str], flange: np.ndarray, seen: np.ndarray) -> float:
    """Returns the RMS angle between orientations ``seen`` (m, 3, 3) and those of the flange with the best-fitting tool
    of each target, rad."""
    between = np.swapaxes(flange, 1, 2) @ seen
    square = 0.0
    for name in set(targets):
        own = between[[t == name for t in targets]]
        tool = Rotation.from_matrix(own).mean()
        square += float(((tool.inv() * Rotation.from_matrix(own)).magnitude() ** 2).sum())
    return float(np.sqrt(square / len(seen)))
