"""Prediction of the last motions by the solution from the poses before them."""

from dataclasses import dataclass

import numpy as np

from stcal.errors import InputError
from stcal.geometry.arrays import frozen
from stcal.geometry.rigid import Rigid
from stcal.handeye.data.loop import Loop, Setup
from stcal.handeye.data.motions import Motions
from stcal.handeye.data.pairs import HandEyePoses
from stcal.handeye.data.views import Views
from stcal.handeye.solve import HandEyeOptions, handeye
from stcal.handeye.validate import LEAST_LEFT
from stcal.parallel import one_thread


@dataclass(frozen=True, slots=True, eq=False)
class HeldOutMotions:
    """Errors of the last k motions, predicted by the solution from the poses before them: Jin et al., eqs. 24–26.

    Parameters
    ----------
    fitted : int
        Number of motions that the solution uses.
    names : tuple of (str, str)
        Names of the poses from which and to which each motion leads.
    rotation_rad, translation_mm : (k,) arrays
        Errors of Â = X B X⁻¹ against A.
    """

    fitted: int
    names: tuple[tuple[str, str], ...]
    rotation_rad: np.ndarray
    translation_mm: np.ndarray

    def __post_init__(self):
        for name in ("rotation_rad", "translation_mm"):
            object.__setattr__(self, name, frozen(getattr(self, name), (len(self.names),), name))


def motion_errors(mount_from_camera: Rigid, motions: Motions) -> np.ndarray:
    """Returns the errors of Â = X B X⁻¹ against A: Jin et al., eqs. 24–26.

    Parameters
    ----------
    mount_from_camera
        X.
    motions
        The k motions: A of the mount, B of the camera.

    Returns
    -------
    (k, 2) array
        Angle of the difference, rad; distance of the translations, mm.
    """
    difference = (mount_from_camera @ motions.camera @ mount_from_camera.inverse()).difference(motions.mount)
    return np.column_stack([np.linalg.norm(difference[:, :3], axis=1), np.linalg.norm(difference[:, 3:], axis=1)])


@one_thread()
def predict_motions(
    pairs: HandEyePoses,
    setup: Setup = "eye-in-hand",
    method: str | None = None,
    views: Views | None = None,
    options: HandEyeOptions | None = None,
    count: int = 6,
) -> HeldOutMotions:
    """Solves with the poses before the last ``count`` motions from pose to pose, and predicts these motions.

    Jin et al. hold out the last 6 of 24 motions.

    Parameters
    ----------
    pairs, setup, method, views, options
        See :func:`~stcal.handeye.handeye`.
    count : int
        Number of motions to hold out.

    Returns
    -------
    HeldOutMotions

    Raises
    ------
    InputError
        Too few poses are left.
    StcalError
        The solution fails; see :func:`~stcal.handeye.handeye`.
    """
    remaining = len(pairs) - count
    if count < 1 or remaining < LEAST_LEFT:
        raise InputError(
            "E-OPTION-RANGE",
            f"--motions-held-out {count}: of {max(len(pairs) - 1, 0)} motions, 1 to {max(len(pairs) - LEAST_LEFT, 0)} "
            "can be held out; give another number, or more poses",
        )
    first_poses = np.arange(remaining)
    result = handeye(pairs[first_poses], setup, method, None if views is None else views[first_poses], options)
    errors = motion_errors(result.mount_from_camera, Motions.consecutive(Loop.of(pairs, setup))[remaining - 1 :])
    names = tuple(zip(pairs.names[remaining - 1 : -1], pairs.names[remaining:], strict=True))
    return HeldOutMotions(remaining - 1, names, errors[:, 0], errors[:, 1])
