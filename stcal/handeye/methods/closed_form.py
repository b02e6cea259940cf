"""The closed-form methods that OpenCV has, by their authors' names.

Andreff, Daniilidis and Li mix rotation and translation in one equation. Lengths are therefore passed to OpenCV in a
unit in which both weigh alike, so that the unit of the input makes no difference.
"""

import cv2
import numpy as np

from stcal.errors import ConvergenceError
from stcal.geometry.rigid import Poses, Rigid
from stcal.handeye.data.loop import Loop
from stcal.handeye.methods.start import mean_pose

AX_XB = {
    "tsai-lenz": cv2.CALIB_HAND_EYE_TSAI,
    "park-martin": cv2.CALIB_HAND_EYE_PARK,
    "horaud": cv2.CALIB_HAND_EYE_HORAUD,
    "andreff": cv2.CALIB_HAND_EYE_ANDREFF,
    "daniilidis": cv2.CALIB_HAND_EYE_DANIILIDIS,
}
"""Tsai & Lenz 1989, Park & Martin 1994, Horaud & Dornaika 1995, Andreff et al. 1999, Daniilidis 1999."""
AX_ZB = {"shah": cv2.CALIB_ROBOT_WORLD_HAND_EYE_SHAH, "li": cv2.CALIB_ROBOT_WORLD_HAND_EYE_LI}
"""Shah 2013, Li, Wang & Wu 2010."""


def closed_form(loop: Loop, method: str, unit_mm: float = 1000.0) -> tuple[Rigid, Rigid]:
    """Returns X and Z by one of :data:`AX_XB` or :data:`AX_ZB`; ``unit_mm`` is the length that weighs like one radian.

    AX = XB does not contain Z: Z is then the mean of the chains.

    Raises
    ------
    ConvergenceError
        OpenCV fails, or its result is not a rigid transform.
    """
    hand, eye = loop.stand_from_mount, loop.camera_from_board
    try:
        if method in AX_XB:
            r, t = cv2.calibrateHandEye(*_split(hand, unit_mm), *_split(eye, unit_mm), method=AX_XB[method])
            x = _rigid(r, t, unit_mm, method)
            return x, mean_pose(loop.chain(x))
        mount_from_stand = hand.inverse()
        r_z, t_z, r_x, t_x = cv2.calibrateRobotWorldHandEye(
            *_split(eye, unit_mm), *_split(mount_from_stand, unit_mm), method=AX_ZB[method]
        )
    except cv2.error as error:
        raise ConvergenceError(
            "E-HANDEYE-METHOD-FAILS", f"hand-eye: {method} fails in OpenCV ({error.err}); use another method"
        ) from error
    return _rigid(r_x, t_x, unit_mm, method).inverse(), _rigid(r_z, t_z, unit_mm, method).inverse()


def _split(poses: Poses, unit_mm: float) -> tuple[list[np.ndarray], list[np.ndarray]]:
    return list(poses.rotation), list(poses.translation / unit_mm)


def _rigid(rotation: np.ndarray, translation: np.ndarray, unit_mm: float, method: str) -> Rigid:
    if not (np.isfinite(rotation).all() and np.isfinite(translation).all() and np.linalg.det(rotation) > 0):
        raise ConvergenceError(
            "E-HANDEYE-METHOD-FAILS",
            f"hand-eye: {method} returns no transform; the motions are too small or too alike for it",
        )
    u, _, vt = np.linalg.svd(rotation)
    return Rigid(u @ vt, unit_mm * translation.ravel())
