"""Reprojection adjustment: X and Z from the corners in the images, with the errors of robot, board and camera."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import KDTree

from stcal.adjust.engine import Solution
from stcal.geometry.arrays import freeze
from stcal.geometry.camera import PARAMETER_NAMES, Camera, intrinsic_basis
from stcal.geometry.normal_equations import generalised_inverse
from stcal.geometry.rigid import Poses
from stcal.handeye.data.pairs import Loop
from stcal.handeye.data.views import Views, resect
from stcal.handeye.methods.bundle import ROBOT, Bundle, Corners, LinearArm
from stcal.handeye.methods.noise import Noise
from stcal.io.cameras.model import CameraPrior

GROSS_RAD, GROSS_SHARE = np.radians(10), 0.2
"""Residuals (rotation; translation as share of the distance) above which a pose is wrong from the start. No error of
the camera file, which is solved for here, makes so much."""
NO_PRIOR = 1e-12
"""Information that holds an unknown back by nothing, px⁻²."""
CAMERA_MODEL = "OPENCV"
"""Camera model in which errors of the camera file are looked for."""
UNKNOWN_LENS = intrinsic_basis(CAMERA_MODEL), NO_PRIOR * np.eye(intrinsic_basis(CAMERA_MODEL).shape[1])
"""Basis of the intrinsics of this model, and their prior information."""
CAMERA_GAIN = 5.0
"""Gain in cost per intrinsic above which intrinsics are wrong. Eight right ones gain 8 ± 4 together, 1 ± 0.5 each."""
SAME_DIGITS = 6
"""Decimals of a millimetre to which two places on the board agree that are one corner."""
FIRST = {"corner_px": 0.3, "robot_rad": 1e-3, "robot_mm": 0.5, "board_mm": 0.1, "arm_rad": 1e-3, "arm_mm": 0.5}
"""First guesses of the σ that are estimated."""


LEAST_SIGMA = {
    "corner_px": 1e-6,
    "robot_rad": 1e-8,
    "robot_mm": 1e-5,
    "board_mm": 1e-5,
    "arm_rad": 1e-8,
    "arm_mm": 1e-5,
}
"""Lower limits of estimated σ: exact data would give 0. The lower limit of the factors of stated camera σ is 1."""


@dataclass(frozen=True, slots=True, eq=False)
class Reprojection:
    """Results of a reprojection adjustment besides X and Z.

    Parameters
    ----------
    camera : adjusted camera, or the given one where the intrinsics were not solved for
    camera_covariance : (q, q) covariance of the intrinsics solved for, in the order of their COLMAP model
    base_from_flange : m true poses of the flange; as reported for outliers, and where the robot is exact
    designed, corners : (K, 3) the board's corners as designed, and as adjusted in the true scale, mm
    view, corner : (n,) pose and row in ``corners`` of each measured corner. Outliers have no corners.
    residuals_px : (n, 2) projected minus measured
    arm, arm_covariance : (k,) parameters of the arm, where they were solved for; rad, mm
    """

    camera: Camera
    camera_covariance: np.ndarray | None
    base_from_flange: Poses
    designed: np.ndarray
    corners: np.ndarray
    view: np.ndarray
    corner: np.ndarray
    residuals_px: np.ndarray
    arm: np.ndarray | None = None
    arm_covariance: np.ndarray | None = None

    def __post_init__(self):
        freeze(self, "designed", (None, 3), "corners")
        freeze(self, "corners", self.designed.shape, "corners")
        freeze(self, "view", (None,), "views", int)
        freeze(self, "corner", self.view.shape, "numbers of corners", int)
        freeze(self, "residuals_px", (len(self.view), 2), "residuals")

    def rms_px(self, pose: int) -> float:
        """Returns the RMS length of the residuals in one view; NaN where it has none."""
        residuals = self.residuals_px[self.view == pose]
        return float(np.sqrt((residuals**2).sum(1).mean())) if len(residuals) else float("nan")

    def board(self, xyz_board: np.ndarray) -> np.ndarray:
        """Returns the true places (k, 3) of designed corners (k, 3), mm; those not seen keep their place, scaled."""
        distance, nearest = KDTree(self.designed).query(xyz_board)
        scale = np.linalg.norm(self.corners) / np.linalg.norm(self.designed)
        return np.where((distance < 10.0**-SAME_DIGITS)[:, None], self.corners[nearest], scale * np.asarray(xyz_board))


def resected(pairs_names: tuple[str, ...], views: Views, board: Reprojection) -> Poses:
    """Returns camera_from_board of all views by the adjusted camera and board."""
    seen = tuple(view.moved(board.board(view.xyz_board)) for view in views.views)
    return resect(Views(board.camera, seen), pairs_names).camera_from_board


def problem(
    loop: Loop,
    base_from_flange: Poses,
    views: Views,
    noise: Noise,
    intrinsics: CameraPrior | None = None,
    with_scale: bool = False,
    arm: LinearArm | None = None,
    first: Mapping[str, float] = FIRST,
) -> tuple[Corners, tuple[str, ...]]:
    """Returns the problem, and the groups whose σ are to be estimated, from ``first``."""
    seen = np.round(np.concatenate([view.xyz_board for view in views.views]), SAME_DIGITS)
    designed, corner = np.unique(seen, axis=0, return_inverse=True)
    sigma, free = {}, []
    for name in ("corner_px", *ROBOT, "board_mm"):
        value = getattr(noise, name)
        if value is None:
            free.append(name)
        sigma[name] = first[name] if value is None else value
    if sigma["robot_rad"] or sigma["robot_mm"] or arm is not None:  # exact in one of them only: tiny σ there
        sigma |= {name: max(sigma[name], LEAST_SIGMA[name]) for name in ROBOT}
    robot = None
    if loop.robot_covariance is not None:
        robot = np.linalg.inv(np.linalg.cholesky(loop.robot_covariance))
        free = [name for name in free if not name.startswith("robot")]
    basis = np.zeros((len(PARAMETER_NAMES), 0)) if intrinsics is None else intrinsic_basis(intrinsics.colmap_model)
    information = np.zeros((0, 0)) if intrinsics is None else np.linalg.inv(intrinsics.covariance)
    corners = Corners(
        loop.inverted,
        base_from_flange,
        designed,
        np.repeat(np.arange(len(views)), [len(view) for view in views.views]),
        corner.ravel(),
        np.concatenate([view.xy_px for view in views.views]),
        np.concatenate([view.whitening() for view in views.views]),
        robot,
        sigma,
        views.camera,
        basis,
        information,
        with_scale,
        arm,
    )
    if arm is not None:
        sigma |= {name: first[name] for name in arm.parts()}
        free += list(arm.parts())
    factors = corners.factors()
    return replace(corners, sigma=sigma | factors), (*free, *factors)


def found_of(corners: Corners, state: Bundle, solution: Solution, reported: Poses, rows: np.ndarray) -> Reprojection:
    """Returns the results. ``rows`` : (m,) row in ``reported`` of each pose of the problem."""
    inverse = generalised_inverse(solution.normal)
    covariance = {name: inverse[at, at] for name, at in solution.places.items()}
    true = list(reported)
    for row, pose in zip(rows, state.base_from_flange, strict=True):
        true[row] = pose
    return Reprojection(
        state.camera,
        covariance.get("camera"),
        Poses.of(true),
        corners.xyz_board,
        state.scale * state.corners,
        rows[corners.view],
        corners.corner,
        corners.residuals(state),
        None if corners.arm is None else corners.arm.parameters + state.arm,
        covariance.get("arm"),
    )
