"""Errors of robot and camera: σ as stated, or estimated in rounds as variance components."""

from dataclasses import dataclass

import numpy as np

from stcal.adjust.blocks import component_variances
from stcal.errors import InputError
from stcal.geometry.arrays import require_fields
from stcal.geometry.rigid import Rigid
from stcal.geometry.robust import robust_sigma
from stcal.handeye.data.pose_pairs import Loop

LEAST = {"rad": 1e-9, "mm": 1e-6, "factor": 1e-2}
"""Lower limits of estimated σ, by kind: exact data would give 0."""
CAUTION = 2.0
"""Redundancies that are not counted. The variance from redundancy ν is the sum of squares over ν − 2, so that errors in
units of its root have mean square 1 (the mean of F is ν / (ν − 2)). This also keeps a component of few poses off 0, as
the penalty of Chung, Rabe-Hesketh, Dorie, Gelman & Liu (2013) does."""
MOST_RAD, MOST_MM = np.radians(10), 100.0
"""Largest σ of poses; beyond it poses tell nothing."""
FARTHEST = 7.0
"""Largest logarithm of the ratio between an estimated σ and its first guess: a factor of a thousand."""
UNKNOWNS = 12
"""Number of unknowns of X and Z."""
LEAST_SHARE = 1e-3
"""Lower limit of an estimated variance as a share of its first guess. Less makes no difference to the weights, but a
few poses that fit by chance would pull all others to themselves."""


@dataclass(frozen=True, slots=True)
class Noise:
    """σ of one coordinate. None where it is to be estimated from the residuals, 0 for what is exact.

    Parameters
    ----------
    robot_rad, robot_mm : σ of base_from_flange, in the axes of the base, about the flange
    camera_rad, camera_mm : σ of camera_from_board, about the board's origin. If nothing is known of either side,
        ``robot_mm`` is taken to be 0: shifts of the two look alike, and the estimate of ``camera_mm`` holds both.
    corner_px : σ of a corner in the image, or the factor of the stated covariances of corners. Never 0.
    board_mm : σ of a corner's place on the board
    """

    robot_rad: float | None = None
    robot_mm: float | None = None
    camera_rad: float | None = None
    camera_mm: float | None = None
    corner_px: float | None = None
    board_mm: float | None = None

    def __post_init__(self):
        require_fields(self, "noise")
        for side in ("robot", "camera"):
            pair = getattr(self, f"{side}_rad"), getattr(self, f"{side}_mm")
            if (pair[0] is None) != (pair[1] is None):
                said = f"noise: one of σ_rot and σ_trans of the {side} is given"
                raise InputError("E-SIGMA-INCOMPLETE", f"{said}; both or none needed")
            if pair[0] is not None and not (0 <= pair[0] <= MOST_RAD and 0 <= pair[1] <= MOST_MM):
                said = f"noise: σ of the {side} is {np.degrees(pair[0]):g}° and {pair[1]:g} mm"
                raise InputError("E-SIGMA-VALUE", f"{said}; 0 to {np.degrees(MOST_RAD):g}° and {MOST_MM:g} mm possible")
        for name, least in (("corner_px", 1e-9), ("board_mm", 0.0)):
            value = getattr(self, name)
            if value is not None and not (least <= value <= MOST_MM):
                more = "more than 0, up to" if least else "0 to"
                raise InputError("E-SIGMA-VALUE", f"noise: {name} is {value:g}, {more} {MOST_MM:g} needed")
        for unit, word in (("rad", "σ_rot"), ("mm", "σ_trans")):
            if getattr(self, f"robot_{unit}") == getattr(self, f"camera_{unit}") == 0:
                raise InputError("E-SIGMA-VALUE", f"noise: {word} of robot and camera are both 0; one of them must err")


@dataclass(frozen=True, slots=True, eq=False)
class LoopComponents:
    """Covariances (m, 6, 6) of residuals: ``known``, plus each of ``free``, (f, m, 6, 6), σ ``names`` of
    :class:`Noise`, times its variance."""

    known: np.ndarray
    free: np.ndarray
    names: tuple[str, ...]

    def total(self, variances: np.ndarray) -> np.ndarray:
        """Returns the covariances (m, 6, 6) for these variances (f,)."""
        return self.known + np.tensordot(variances, self.free, 1)

    def of(self, used: np.ndarray) -> "LoopComponents":
        """Returns the components of the poses ``used``."""
        return LoopComponents(self.known[used], self.free[:, used], self.names)

    def first(self, residuals: np.ndarray) -> np.ndarray:
        """Returns first variances (f,) from the medians of residuals (m, 6), on which bad poses have little effect."""
        turn, shift = (robust_sigma(each, 3) ** 2 for each in np.linalg.norm(residuals.reshape(-1, 2, 3), axis=2).T)
        turns = max(sum(name.endswith("_rad") for name in self.names), 1)
        by_kind = {"rad": turn / turns, "mm": shift, "factor": 1.0}
        return np.maximum([by_kind[name.rpartition("_")[2]] for name in self.names], self.least())

    def least(self) -> np.ndarray:
        """Returns the lower limits (f,) of the variances."""
        return np.square([LEAST[name.rpartition("_")[2]] for name in self.names])


def components(loop: Loop, noise: Noise, mount_from_camera: Rigid, scale: float = 1.0) -> LoopComponents:
    """Returns the components at an estimate of X. Covariances of the camera's poses hold the images' noise up to a
    factor, as the intrinsics' errors have the same weak directions; it is estimated where the robot's σ are too."""
    known, free = np.zeros((len(loop), 6, 6)), {}
    for side, jacobian, stated, rad, mm in (
        ("robot", loop.by_robot(mount_from_camera, scale), loop.robot_covariance, noise.robot_rad, noise.robot_mm),
        ("camera", loop.by_camera(mount_from_camera, scale), loop.camera_covariance, noise.camera_rad, noise.camera_mm),
    ):
        of_images = stated is not None
        if stated is None and rad is not None and mm is not None:
            stated = np.tile(np.diag([rad**2] * 3 + [mm**2] * 3), (len(loop), 1, 1))
        if stated is None:
            for name, columns in ((f"{side}_rad", slice(0, 3)), (f"{side}_mm", slice(3, 6))):
                free[name] = jacobian[:, :, columns] @ np.swapaxes(jacobian[:, :, columns], 1, 2)
            continue
        carried = jacobian @ stated @ np.swapaxes(jacobian, 1, 2)
        if side == "camera" and of_images and "robot_rad" in free:
            free["camera_factor"] = carried
        else:
            known = known + carried
    if len(free) == 4:  # shifts of robot and camera move the board alike
        del free["robot_mm"]
    if 6 * len(loop) - UNKNOWNS <= CAUTION * len(free):  # three poses determine one component less
        if "camera_factor" in free:
            known = known + free.pop("camera_factor")
        else:
            del free["robot_rad"]
    return LoopComponents(known, np.array(list(free.values())).reshape(-1, len(loop), 6, 6), tuple(free))


def variance_components(
    parts: LoopComponents, residuals: np.ndarray, jacobian: np.ndarray, first: np.ndarray
) -> np.ndarray:
    """Returns restricted maximum-likelihood variances (f,) of the free components from residuals (m, 6) and their
    jacobian (m, 6, k) near a solution (Patterson & Thompson 1971), from a ``first`` guess; :data:`CAUTION` is
    subtracted."""
    least = np.maximum(parts.least(), LEAST_SHARE * first)
    most = np.maximum(first, least) * np.exp(2 * FARTHEST)
    return component_variances(residuals, jacobian, parts.known, parts.free, first, (least, most), CAUTION)
