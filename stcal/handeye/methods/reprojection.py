"""Reprojection adjustment: X and Z from the corners in the images, with the errors of robot, board and camera."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial import KDTree
from scipy.stats import f

from stcal.errors import DegenerateError
from stcal.geometry.arrays import frozen
from stcal.geometry.camera import PARAMETER_NAMES, Camera, intrinsic_basis
from stcal.geometry.normal_equations import generalised_inverse
from stcal.geometry.rigid import Poses, Rigid
from stcal.handeye.data.pairs import Loop
from stcal.handeye.data.views import Views, resect
from stcal.handeye.methods.arm import ROUNDS, SETTLED_MM, ArmModel, LinearArm
from stcal.handeye.methods.bundle import Bundle, Corners
from stcal.handeye.methods.camera_error import CameraError, of_corners
from stcal.handeye.methods.noise import LEAST_SIGMA, Noise, Problem, adjust
from stcal.handeye.methods.pose_adjustment import FALSE_ALARM, LEAST_POSES
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
INFLUENCE_STEPS, LEAST_DAMPING = 2, 1e-9
"""Number of steps from the solution of all poses to one without some of them, and their damping, which only keeps
directions that nothing determines."""
SEEN = 1e-3
"""Share of the robot's variance below which the corners tell nothing about the robot's error."""
FIRST = {"corner_px": 0.3, "robot_rad": 1e-3, "robot_mm": 0.5, "board_mm": 0.1, "arm_rad": 1e-3, "arm_mm": 0.5}
"""First guesses of the σ that are estimated."""


@dataclass(frozen=True, slots=True, eq=False)
class Reprojection:
    """Results of a reprojection adjustment besides X and Z.

    Parameters
    ----------
    camera : Camera
        Adjusted camera, or the given one where the intrinsics were not solved for.
    camera_covariance : (q, q) array, optional
        Covariance of the intrinsics solved for, in the order of their COLMAP model.
    base_from_flange : Poses
        m true poses of the flange; as reported for outliers, and where the robot is exact.
    designed, corners : (K, 3) arrays
        The board's corners as designed, and as adjusted in the true scale, mm.
    view, corner : (n,) int arrays
        Pose and row in ``corners`` of each measured corner. Outliers have no corners.
    residuals_px : (n, 2) array
        Projected minus measured.
    arm, arm_covariance : (k,), (k, k) arrays, optional
        Parameters of the arm, where they were solved for; rad, mm.
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
        object.__setattr__(self, "designed", frozen(self.designed, (None, 3), "corners"))
        object.__setattr__(self, "corners", frozen(self.corners, self.designed.shape, "corners"))
        object.__setattr__(self, "view", frozen(self.view, (None,), "views", int))
        object.__setattr__(self, "corner", frozen(self.corner, self.view.shape, "numbers of corners", int))
        object.__setattr__(self, "residuals_px", frozen(self.residuals_px, (len(self.view), 2), "residuals"))

    def rms_px(self, pose: int) -> float:
        """Returns the RMS length of the residuals in one view; NaN where it has none."""
        residuals = self.residuals_px[self.view == pose]
        return float(np.sqrt((residuals**2).sum(1).mean())) if len(residuals) else float("nan")

    def board(self, xyz_board: np.ndarray) -> np.ndarray:
        """Returns the true places (k, 3) of corners of the design (k, 3), mm. Corners that were not seen keep their
        place, scaled."""
        distance, nearest = KDTree(self.designed).query(xyz_board)
        scale = np.linalg.norm(self.corners) / np.linalg.norm(self.designed)
        return np.where((distance < 10.0**-SAME_DIGITS)[:, None], self.corners[nearest], scale * np.asarray(xyz_board))


@dataclass(frozen=True, slots=True, eq=False)
class AdjustedViews:
    """``loop`` : the adjusted loop; ``corners`` : problem of the poses used, and ``state`` : its solution; ``outliers``
    : (m,); ``normal`` : (12, 12) of X and Z, all other unknowns eliminated; ``covariance`` : its inverse;
    ``sigma_scale``; ``sigma`` : by group; ``estimated`` : groups whose σ were estimated; ``scale_hint`` : the scale if
    it were solved for, and its σ; ``camera_gain`` : fall of the cost per parameter if intrinsics were solved for;
    ``camera_error`` : error of the intrinsics as filed, where their prior is known; ``found``; ``settled`` : whether
    the estimated σ settled."""

    loop: Loop
    corners: Corners
    state: Bundle
    outliers: np.ndarray
    normal: np.ndarray
    covariance: np.ndarray
    sigma_scale: float | None
    sigma: dict[str, float]
    estimated: tuple[str, ...]
    scale_hint: tuple[float, float]
    camera_gain: float
    camera_error: CameraError | None
    found: Reprojection
    settled: bool

    def without(self, out: np.ndarray) -> Bundle:
        """Returns the solution without the poses ``out``, rows among all: by steps from the solution of all, with its
        σ. Errors of a step from so near are squares of small moves (influence: Cook & Weisberg 1982)."""
        keep = ~np.isin(np.flatnonzero(~self.outliers), out)
        corners, state = self.corners.only(keep), self.state
        state = replace(state, base_from_flange=state.base_from_flange[keep])
        for _ in range(INFLUENCE_STEPS):
            linear = corners.linear(state)
            if not np.isfinite(linear.cost):
                break
            state = corners.moved(state, linear.step(LEAST_DAMPING)[0])
        return state


def adjust_views(
    loop: Loop,
    base_from_flange: Poses,
    views: Views,
    first: tuple[Rigid, Rigid, float],
    noise: Noise,
    intrinsics: CameraPrior | None = None,
    with_scale: bool = False,
    camera: CameraPrior | None = None,
    arm: ArmModel | None = None,
) -> AdjustedViews:
    """Returns the least-squares adjustment of all corners from ``first`` X, Z, scale.

    ``loop`` holds the same poses; its poses of the board come from ``views``. Unknowns are X, Z, and, according to
    their σ, the true poses of the robot and the true places of the board's corners. Intrinsics about ``intrinsics``
    (whose σ are widened where the corners contradict them) and the board's scale are unknowns on demand. Errors of
    intrinsics that are not solved for are considered by their prior, ``camera``. The parameters of an ``arm``, which
    replaces ``base_from_flange``, are unknowns too. Corners and poses have Huber's weights; poses that contradict the
    others are then left out.

    Raises
    ------
    ConvergenceError
        No minimum is reached.
    DegenerateError
        Fewer than three poses agree.
    """
    if arm is None:
        return _adjusted(loop, base_from_flange, views, first, noise, intrinsics, with_scale, camera)
    parameters, sigma = np.zeros(len(arm.angles)), FIRST
    for _ in range(ROUNDS):
        linear, flange = LinearArm.about(arm, parameters), arm.poses(parameters)
        moved = replace(loop, stand_from_mount=flange.inverse() if loop.inverted else flange)
        adjusted = _adjusted(moved, flange, views, first, noise, intrinsics, with_scale, camera, linear, sigma)
        sigma = FIRST | adjusted.sigma
        parameters = parameters + adjusted.state.arm
        first = (adjusted.state.mount_from_camera, adjusted.state.stand_from_board, adjusted.state.scale)
        if linear.moves_mm(adjusted.state.arm) < SETTLED_MM:
            return adjusted
    return replace(adjusted, settled=False)


def _adjusted(
    loop: Loop,
    base_from_flange: Poses,
    views: Views,
    first: tuple[Rigid, Rigid, float],
    noise: Noise,
    intrinsics: CameraPrior | None,
    with_scale: bool,
    camera: CameraPrior | None,
    arm: LinearArm | None = None,
    sigma: Mapping[str, float] = FIRST,
) -> AdjustedViews:
    """Returns the adjustment with the arm, if there is one, linearised. ``sigma`` : first guesses of the σ that are
    estimated."""
    x, z, scale = first
    miss = loop.residuals(x, z, scale)
    far = np.linalg.norm(miss[:, 3:], axis=1) > GROSS_SHARE * np.linalg.norm(loop.camera_from_board.translation, axis=1)
    used = ~(far | (np.linalg.norm(miss[:, :3], axis=1) > GROSS_RAD))
    while True:
        if used.sum() < 3:
            raise DegenerateError(
                "E-HANDEYE-DISAGREE",
                f"hand-eye: {used.sum()} of {len(used)} poses agree, 3 needed; "
                "check that poses and images belong together, and the conventions of both",
            )
        rows = np.flatnonzero(used)
        arm_used = None if arm is None else arm[rows]
        given = (loop[rows], base_from_flange[rows], views[rows], noise, intrinsics, with_scale)
        corners, free = problem(*given, arm=arm_used, first=sigma)
        begin = Bundle(x, z, corners.base_from_flange, corners.xyz_board, views.camera, scale, corners.no_step())
        solution = adjust(corners, begin, free)
        corners, state = solution.corners, solution.state
        inverse = solution.linear.inverse()
        bad = contradicting(corners, state, inverse)
        if not bad.any() or used.sum() - bad.sum() < LEAST_POSES:
            break
        used[rows[bad]] = False
    at = corners.places()
    sigma_scale = float(np.sqrt(inverse[at["scale"], at["scale"]].item())) if with_scale else None
    sigma = {name: float(value) for name, value in corners.sigma.items() if value}
    results = found_of(corners, state, inverse, base_from_flange, rows, intrinsics is not None)
    normal = solution.linear.eliminated().normal
    of_poses = normal[:12, :12] - normal[:12, 12:] @ generalised_inverse(normal[12:, 12:]) @ normal[12:, :12]
    return AdjustedViews(
        loop=loop,
        corners=corners,
        state=state,
        outliers=~used,
        normal=of_poses,
        covariance=inverse[:12, :12],
        sigma_scale=sigma_scale,
        sigma=sigma,
        estimated=free,
        scale_hint=scale_hint(corners, state),
        camera_gain=_camera_gain(corners, state),
        camera_error=of_corners(corners, state, camera, free) if camera is not None and intrinsics is None else None,
        found=results,
        settled=solution.settled,
    )


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
    rows: np.ndarray | None = None,
    designed: np.ndarray | None = None,
) -> tuple[Corners, tuple[str, ...]]:
    """Returns the problem, and the groups whose σ are to be estimated, from ``first``.

    ``rows`` : (v,) row in base_from_flange of each view; one view for each row, in order, where None; ``designed`` :
    (K, 3) the board's corners, from :func:`board_of`; those of the views where None.
    """
    designed = board_of([views]) if designed is None else designed
    every = np.concatenate([designed, *(view.xyz_board for view in views.views)])
    corner = np.unique(np.round(every, SAME_DIGITS), axis=0, return_inverse=True)[1].ravel()[len(designed) :]
    rows = np.arange(len(views)) if rows is None else rows
    sigma, free = {}, []
    for name in ("corner_px", "robot_rad", "robot_mm", "board_mm"):
        value = getattr(noise, name)
        if value is None:
            free.append(name)
        sigma[name] = first[name] if value is None else value
    if sigma["robot_rad"] or sigma["robot_mm"] or arm is not None:  # exact in one of them only: tiny σ there
        sigma |= {name: max(sigma[name], LEAST_SIGMA[name]) for name in ("robot_rad", "robot_mm")}
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
        np.repeat(rows, [len(view) for view in views.views]),
        corner,
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


def board_of(every: Sequence[Views]) -> np.ndarray:
    """Returns all corners (K, 3) that any view shows, mm, each once."""
    corners = [view.xyz_board for views in every for view in views.views]
    return np.unique(np.round(np.concatenate(corners), SAME_DIGITS), axis=0)


def contradicting(corners: Problem, state: Any, inverse: np.ndarray) -> np.ndarray:
    """Returns which poses (m,) have an error of the robot that is not by chance: its estimate is tested against the
    variance that it should have."""
    m = len(corners.base_from_flange)
    at = corners.places()["robot"]
    if at.stop == at.start:
        return np.zeros(m, bool)
    error = state.base_from_flange.difference(corners.base_from_flange)
    weight = corners.robot_weight()
    white = np.einsum("mab,mb->ma", weight, error)
    covariance = inverse[at, at].reshape(m, 6, m, 6)[np.arange(m), :, np.arange(m)]
    # For Gaussian knowledge δ ~ N(0, Σ) with posterior covariance C, the estimate of δ scatters by Σ − C.
    value, vector = np.linalg.eigh(np.eye(6) - weight @ covariance @ np.swapaxes(weight, 1, 2))
    turned = np.einsum("mab,ma->mb", vector, white)
    squared = np.where(value > SEEN, turned**2 / np.maximum(value, SEEN), 0).sum(1)
    redundancy = max(6 * (m - 1) - at.start, 6)
    return squared > 6 * f.ppf(1 - FALSE_ALARM / m, 6, redundancy)


def scale_hint(corners: Problem, state: Any) -> tuple[float, float]:
    """Returns the scale if it were solved for, and its σ: one step from the solution with the scale among the
    unknowns."""
    wider = corners.with_board_scale()
    left, at = wider.linear(state).eliminated(), wider.places()["scale"].start
    inverse = generalised_inverse(left.normal)
    return state.scale - float(inverse[at] @ left.gradient), float(np.sqrt(inverse[at, at]))


def _camera_gain(corners: Corners, state: Bundle) -> float:
    if corners.basis.shape[1]:
        return 1.0
    return camera_gain(corners.with_intrinsics(*UNKNOWN_LENS), state)


def camera_gain(wider: Problem, state: Any) -> float:
    """Returns the fall of the cost, per parameter of one camera, with intrinsics among the unknowns as in
    :data:`UNKNOWN_LENS`. It is predicted by one step from the solution, and about 1 where the camera is right."""
    return wider.linear(state).gain() / UNKNOWN_LENS[0].shape[1]


def found_of(
    corners: Corners, state: Bundle, inverse: np.ndarray, reported: Poses, rows: np.ndarray, with_camera: bool
) -> Reprojection:
    """Returns the results of one camera. ``rows`` : (m,) row in ``reported`` of each pose of the problem, -1 for a pose
    that this camera did not see."""
    at = corners.places()
    white, _ = corners.seen(state)
    residuals = corners.sigma["corner_px"] * np.linalg.solve(corners.weight, white[:, :, None])[:, :, 0]
    true = list(reported)
    for row, pose in zip(rows, state.base_from_flange, strict=True):
        if row >= 0:
            true[row] = pose
    return Reprojection(
        state.camera,
        inverse[at["camera"], at["camera"]] if with_camera else None,
        Poses.of(true),
        corners.xyz_board,
        state.scale * state.corners,
        rows[corners.view],
        corners.corner,
        residuals,
        None if corners.arm is None else corners.arm.parameters + state.arm,
        None if corners.arm is None else inverse[at["arm"], at["arm"]],
    )
