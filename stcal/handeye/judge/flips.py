"""Poses of a flat target that are tilted the other way: its second pose, which explains an image nearly as well."""

from dataclasses import replace

import numpy as np

from stcal.geometry.least_squares import PoseStack
from stcal.geometry.plane import mirrored
from stcal.geometry.rigid import Poses, Rigid
from stcal.handeye.data.pairs import Loop
from stcal.handeye.judge.remarks import Aside, spoken

PUT_RIGHT = 0.2
"""Largest share of a pose's error of rotation that is left when it is tilted the other way. Of errors of any direction
0.2³, one in a hundred, seem to be flips."""


def tilted(poses: Poses) -> Poses:
    """Returns camera_from_board with the depths about the board's origin mirrored along the line of sight."""
    other = mirrored(PoseStack(np.asarray(poses.rotation), np.asarray(poses.translation)), Rigid())
    return Poses(other.rotation, np.asarray(poses.translation))


def flipped(loop: Loop, x: Rigid, z: Rigid, outliers: np.ndarray) -> np.ndarray:
    """Returns a mask (m,) of the ``outliers`` that agree with the solution when they are tilted the other way."""
    other = replace(loop, camera_from_board=tilted(loop.camera_from_board))
    before, after = (np.linalg.norm(each.residuals(x, z)[:, :3], axis=1) for each in (loop, other))
    return outliers & (after < PUT_RIGHT * before)


def note_of(names: tuple[str, ...], flips: np.ndarray) -> tuple[str, ...]:
    """Returns a note on the poses that are flipped, (m,)."""
    if not flips.any():
        return ()
    shown = ", ".join(spoken(name) for name, flip in zip(names, flips, strict=True) if flip)
    return (
        Aside(
            f"{flips.sum()} of the poses left out agree when tilted the other way, as the second pose of a flat target "
            f"is, which its image hardly excludes: {shown}; --undo-flips takes that one, or give images"
        ),
    )
