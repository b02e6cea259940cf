"""Reprojection adjustment: X and Z from the corners in the images, with the errors of robot, board and camera."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial import KDTree
from scipy.stats import f

from stcal.errors import DegenerateError
from stcal.geometry.arrays import frozen
from stcal.geometry.camera import Camera
from stcal.geometry.normal_equations import generalised_inverse
from stcal.geometry.rigid import Poses, Rigid
from stcal.handeye.data.loop import Loop
from stcal.handeye.data.views import Views, resect
from stcal.handeye.methods.arm import ROUNDS, SETTLED_MM, ArmModel, LinearArm
from stcal.handeye.methods.bundle import Bundle, Corners
from stcal.handeye.methods.camera_error import CameraError, of_corners
from stcal.handeye.methods.noise import Noise
from stcal.handeye.methods.pose_adjustment import FALSE_ALARM, LEAST_POSES
from stcal.handeye.methods.rounds import LEAST, Problem, adjust
from stcal.io.cameras.model import PARAMETER_NAMES, CameraPrior, intrinsic_basis

GROSS_RAD, GROSS_SHARE = np.radians(10), 0.2
"""A pose that misses by more (rotation; translation in shares of the distance) is wrong from the start: no error of the
camera file, which is solved for here, makes so much."""
NO_PRIOR = 1e-12
"""Information that keeps nothing back, px⁻²."""
CAMERA_MODEL = "OPENCV"
"""Model of the camera in which is looked for errors of the camera file."""
UNKNOWN_LENS = intrinsic_basis(CAMERA_MODEL), NO_PRIOR * np.eye(intrinsic_basis(CAMERA_MODEL).shape[1])
"""Basis of its intrinsics, and what is known of them."""
CAMERA_GAIN = 5.0
"""Eight intrinsics that are right gain 8 ± 4 in cost, 1 ± 0.5 each; eight that gain 5 each are wrong."""
SAME_DIGITS = 6
"""Decimals of a millimetre in which places on the board that are one corner agree."""
SEEN = 1e-3
"""A share of the robot's variance below which the corners say nothing of its error."""
FIRST = {"corner_px": 0.3, "robot_rad": 1e-3, "robot_mm": 0.5, "board_mm": 0.1, "arm_rad": 1e-3, "arm_mm": 0.5}
"""Where the estimate of σ starts."""


@dataclass(frozen=True, slots=True, eq=False)
class Reprojection:
    """What a reprojection adjustment finds besides X and Z.

    Parameters
    ----------
    camera : Camera
        As adjusted, or as given where the intrinsics were not solved for.
    camera_covariance : (q, q) array, optional
        Of the intrinsics solved for, in the order of their COLMAP model.
    base_from_flange : Poses
        m; where the flange really was. As reported for outliers, and where the robot is exact.
    designed, corners : (K, 3) arrays
        The board's corners as designed, and as adjusted in the true scale, mm.
    view, corner : (n,) int arrays
        Of each measured corner: which pose, and which of ``corners``. Outliers have none.
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
        """RMS length of the residuals in one view; NaN where it has none."""
        own = self.residuals_px[self.view == pose]
        return float(np.sqrt((own**2).sum(1).mean())) if len(own) else float("nan")

    def board(self, xyz_board: np.ndarray) -> np.ndarray:
        """Where corners of the design (k, 3) really are, mm; those that were not seen keep their place, scaled."""
        distance, nearest = KDTree(self.designed).query(xyz_board)
        scale = np.linalg.norm(self.corners) / np.linalg.norm(self.designed)
        return np.where((distance < 10.0**-SAME_DIGITS)[:, None], self.corners[nearest], scale * np.asarray(xyz_board))


@dataclass(frozen=True, slots=True, eq=False)
class AdjustedViews:
    """``loop`` : that was adjusted; ``state`` : of the poses used; ``outliers`` : (m,); ``normal`` : (12, 12) of X and
    Z, all else eliminated; ``covariance`` : its inverse; ``sigma_scale``; ``sigma`` : by group; ``estimated`` : which;
    ``scale_hint`` : what the scale would become if it were solved for, and its σ;
    ``camera_gain`` : by how much the cost would fall, per parameter, if intrinsics were; ``camera_error`` : of those as
    filed, where something is known of them; ``found``; ``settled`` : whether the estimated σ did."""

    loop: Loop
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
    """Least squares of all corners from ``first`` X, Z, scale; ``loop`` holds the same poses, the board's by them.

    Unknowns: X, Z, and by their σ where the robot really was and where the board's corners really are; intrinsics about
    ``intrinsics`` (whose σ are widened where the corners contradict them) and the board's scale on demand. Errors of
    intrinsics that are not solved for are considered by what is known of them, ``camera``. Of an ``arm``, which then
    makes the poses in place of ``base_from_flange``, the parameters are unknowns too. Corners and poses have Huber's
    weights; then poses that contradict the others are left out.

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
        found = _adjusted(moved, flange, views, first, noise, intrinsics, with_scale, camera, linear, sigma)
        sigma = FIRST | found.sigma
        parameters = parameters + found.state.arm
        first = (found.state.mount_from_camera, found.state.stand_from_board, found.state.scale)
        if linear.moves_mm(found.state.arm) < SETTLED_MM:
            return found
    return replace(found, settled=False)


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
    """With the arm linear, if there is one; ``sigma`` : where those that are estimated start."""
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
        own = None if arm is None else arm[rows]
        given = (loop[rows], base_from_flange[rows], views[rows], noise, intrinsics, with_scale)
        corners, free = problem(*given, arm=own, first=sigma)
        begin = Bundle(x, z, corners.base_from_flange, corners.xyz_board, views.camera, scale, corners.no_step())
        solution = adjust(corners, begin, free)
        corners, state, normal = solution.corners, solution.state, solution.normal
        inverse = generalised_inverse(normal)
        bad = contradicting(corners, state, inverse)
        if not bad.any() or used.sum() - bad.sum() < LEAST_POSES:
            break
        used[rows[bad]] = False
    at = corners.places()
    sigma_scale = float(np.sqrt(inverse[at["scale"], at["scale"]].item())) if with_scale else None
    sigma = {name: float(value) for name, value in corners.sigma.items() if value}
    found = found_of(corners, state, inverse, base_from_flange, rows, intrinsics is not None)
    rest = generalised_inverse(normal[12:, 12:])
    own = normal[:12, :12] - normal[:12, 12:] @ rest @ normal[12:, :12]
    return AdjustedViews(
        loop=loop,
        state=state,
        outliers=~used,
        normal=own,
        covariance=inverse[:12, :12],
        sigma_scale=sigma_scale,
        sigma=sigma,
        estimated=free,
        scale_hint=scale_hint(corners, state),
        camera_gain=_camera_gain(corners, state),
        camera_error=of_corners(corners, state, camera, free) if camera is not None and intrinsics is None else None,
        found=found,
        settled=solution.settled,
    )


def resected(pairs_names: tuple[str, ...], views: Views, board: Reprojection) -> Poses:
    """camera_from_board of all views by the adjusted camera and board."""
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
    """The problem, and which groups' σ are to be estimated, from ``first``.

    ``rows`` : (v,) which of base_from_flange each view is of, one each in their order where None; ``designed`` :
    (K, 3) the board's corners, of :func:`board_of`, those of the views where None.
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
    if sigma["robot_rad"] or sigma["robot_mm"] or arm is not None:  # exact in one of the two only: nearly
        sigma |= {name: max(sigma[name], LEAST[name]) for name in ("robot_rad", "robot_mm")}
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
    """All corners (K, 3) that any view shows, mm, each once."""
    seen = [view.xyz_board for views in every for view in views.views]
    return np.unique(np.round(np.concatenate(seen), SAME_DIGITS), axis=0)


def contradicting(corners: Problem, state: Any, inverse: np.ndarray) -> np.ndarray:
    """Poses (m,) of which the robot's error is not by chance: its estimate against the variance that it should have."""
    m = len(corners.base_from_flange)
    at = corners.places()["robot"]
    if at.stop == at.start:
        return np.zeros(m, bool)
    off = state.base_from_flange.difference(corners.base_from_flange)
    weight = corners.robot_weight()
    white = np.einsum("mab,mb->ma", weight, off)
    own = inverse[at, at].reshape(m, 6, m, 6)[np.arange(m), :, np.arange(m)]
    # Of Gaussian knowledge δ ~ N(0, Σ) with posterior covariance C, the estimate of δ scatters by Σ − C.
    value, vector = np.linalg.eigh(np.eye(6) - weight @ own @ np.swapaxes(weight, 1, 2))
    turned = np.einsum("mab,ma->mb", vector, white)
    squared = np.where(value > SEEN, turned**2 / np.maximum(value, SEEN), 0).sum(1)
    redundancy = max(6 * (m - 1) - corners.places()["board"].start, 6)
    return squared > 6 * f.ppf(1 - FALSE_ALARM / m, 6, redundancy)


def scale_hint(corners: Problem, state: Any) -> tuple[float, float]:
    """One step from the solution with the scale among the unknowns."""
    wider = corners.with_board_scale()
    linear, at = wider.linear(state), wider.places()["scale"].start
    inverse = generalised_inverse(linear.normal)
    return state.scale - float(inverse[at] @ linear.gradient), float(np.sqrt(inverse[at, at]))


def _camera_gain(corners: Corners, state: Bundle) -> float:
    if corners.basis.shape[1]:
        return 1.0
    return camera_gain(corners.with_intrinsics(*UNKNOWN_LENS), state)


def camera_gain(wider: Problem, state: Any) -> float:
    """By how much the cost would fall, per parameter of one camera, with intrinsics among the unknowns as of
    :data:`UNKNOWN_LENS`: predicted by one step from the solution; about 1 where the camera is right."""
    linear = wider.linear(state)
    return float(linear.gradient @ generalised_inverse(linear.normal) @ linear.gradient) / UNKNOWN_LENS[0].shape[1]


def found_of(
    corners: Corners, state: Bundle, inverse: np.ndarray, reported: Poses, rows: np.ndarray, with_camera: bool
) -> Reprojection:
    """``rows`` : (m,) which of ``reported`` each pose of the problem is, -1 for one that this camera did not see."""
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
