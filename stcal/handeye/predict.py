"""The last motions, predicted by the solution of the poses before them."""

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
    """Errors of the last k motions as predicted by the solution of the poses before them: Jin et al., eqs. 24–26.

    Parameters
    ----------
    fitted : int
        Motions that the solution rests on.
    names : tuple of (str, str)
        Poses that each motion leads from and to.
    rotation_rad, translation_mm : (k,) arrays
        Of Â = X B X⁻¹ against A.
    """

    fitted: int
    names: tuple[tuple[str, str], ...]
    rotation_rad: np.ndarray
    translation_mm: np.ndarray

    def __post_init__(self):
        for name in ("rotation_rad", "translation_mm"):
            object.__setattr__(self, name, frozen(getattr(self, name), (len(self.names),), name))


def motion_errors(mount_from_camera: Rigid, motions: Motions) -> np.ndarray:
    """Errors of Â = X B X⁻¹ against A: Jin et al., eqs. 24–26.

    Parameters
    ----------
    mount_from_camera
        X.
    motions
        k of them: A of the mount, B of the camera.

    Returns
    -------
    (k, 2) array
        Angle of the difference, rad; distance of the translations, mm.
    """
    off = (mount_from_camera @ motions.camera @ mount_from_camera.inverse()).difference(motions.mount)
    return np.column_stack([np.linalg.norm(off[:, :3], axis=1), np.linalg.norm(off[:, 3:], axis=1)])


@one_thread()
def predict_motions(
    pairs: HandEyePoses,
    setup: Setup = "eye-in-hand",
    method: str | None = None,
    views: Views | None = None,
    options: HandEyeOptions | None = None,
    count: int = 6,
) -> HeldOutMotions:
    """Solve with the poses before the last ``count`` motions from pose to pose, and predict these.

    Jin et al. do so with the last 6 of 24.

    Parameters
    ----------
    pairs, setup, method, views, options
        As of :func:`~stcal.handeye.handeye`.
    count : int
        Motions to hold out.

    Returns
    -------
    HeldOutMotions

    Raises
    ------
    InputError
        Too few poses are left.
    StcalError
        As of :func:`~stcal.handeye.handeye`.
    """
    left = len(pairs) - count
    if count < 1 or left < LEAST_LEFT:
        raise InputError(
            "E-OPTION-RANGE",
            f"--motions-held-out {count}: of {max(len(pairs) - 1, 0)} motions, 1 to {max(len(pairs) - LEAST_LEFT, 0)} "
            "can be held out; give another number, or more poses",
        )
    kept = np.arange(left)
    result = handeye(pairs[kept], setup, method, None if views is None else views[kept], options)
    errors = motion_errors(result.mount_from_camera, Motions.consecutive(Loop.of(pairs, setup))[left - 1 :])
    names = tuple(zip(pairs.names[left - 1 : -1], pairs.names[left:], strict=True))
    return HeldOutMotions(left - 1, names, errors[:, 0], errors[:, 1])
