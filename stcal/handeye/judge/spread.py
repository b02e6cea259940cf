"""The spread of a flange's poses, in words, before anything is solved."""

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.geometry.rigid import Poses
from stcal.handeye.data.loop import Loop, Setup
from stcal.handeye.judge.observability import LEAST_POSES, LEAST_TURN, Observability

MOST = 2000
"""Largest number of poses of which all pairs are compared. From more poses, this many are chosen evenly."""


def spread_text(base_from_flange: Poses, setup: Setup) -> list[str]:
    """Returns the axes about which the flange turns, its largest rotation between two poses, the box of its places, and
    the motions that are missing."""
    m = len(base_from_flange)
    if m < LEAST_POSES:
        return [f"motions: {m} poses, {LEAST_POSES} needed and 10 wanted"]
    inverted = setup == "eye-to-hand"
    stand_from_mount = base_from_flange.inverse() if inverted else base_from_flange
    observability = Observability.of(Loop(stand_from_mount, base_from_flange, inverted))
    turns = ", ".join(f"{turn:.1f}°" for turn in np.degrees(observability.turns_rad))
    axes = int((observability.turns_rad > LEAST_TURN).sum())
    some = base_from_flange.rotation[np.unique(np.linspace(0, m - 1, min(m, MOST)).astype(int))]
    largest = max(
        float(Rotation.from_matrix(some[i + 1 :] @ some[i].T).magnitude().max()) for i in range(len(some) - 1)
    )
    box = " × ".join(f"{side:.0f}" for side in np.ptp(base_from_flange.translation, axis=0))
    lines = [
        f"motions: the flange turns about {axes} {'axis' if axes == 1 else 'axes'} ({turns} RMS about its principal "
        f"ones), by up to {np.degrees(largest):.0f}° between two poses; its places lie within {box} mm"
    ]
    if observability.useless:
        lines.append(f"motions: too little to calibrate: {observability.missing()}")
    return lines
