"""Reprojection adjustment: X and Z from the corners in the images, with the errors of robot, board and camera."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial import KDTree
from scipy.special import fdtri

from stcal.adjust.blocks import Vector
from stcal.adjust.engine import Solution
from stcal.errors import ConvergenceError, DegenerateError
from stcal.geometry.arrays import freeze
from stcal.geometry.camera import PARAMETER_NAMES, Camera, intrinsic_basis
from stcal.geometry.normal_equations import generalised_inverse
from stcal.geometry.rigid import Poses
from stcal.handeye.data.corner_views import Views, resect, whitened
from stcal.handeye.data.pose_pairs import Loop, LoopState
from stcal.handeye.methods.bundle import ROBOT, Bundle, Corners, camera_parts, errors
from stcal.handeye.methods.pose_adjustment import (
    CAUTION,
    FALSE_ALARM,
    FARTHEST,
    LEAST_POSES,
    UNKNOWNS,
    Noise,
    PoseSolution,
)
from stcal.io.cameras.camera_model import CameraPrior

GROSS_RAD, GROSS_SHARE = np.radians(10), 0.2
"""Residuals (rotation; translation as share of the distance) above which a pose is wrong from the start. No error of
the camera file, which is solved for here, makes so much."""
UNKNOWN_LENS = intrinsic_basis("OPENCV"), 1e-12 * np.eye(intrinsic_basis("OPENCV").shape[1])
"""Basis of the intrinsics in which errors of the camera file are looked for, and their negligible information, px⁻²."""
CAMERA_GAIN = 5.0
"""Gain in cost per intrinsic above which intrinsics are wrong. Eight right ones gain 8 ± 4 together, 1 ± 0.5 each."""
SAME_DIGITS = 6
"""Decimals of a millimetre to which two places on the board agree that are one corner."""
FIRST = {"corner_px": 0.3, "robot_rad": 1e-3, "robot_mm": 0.5, "board_mm": 0.1}
"""First guesses of the σ that are estimated."""
LEAST_SIGMA = {kind: {"px": 1e-6, "rad": 1e-8, "mm": 1e-5}[kind.rpartition("_")[2]] for kind in FIRST}
"""Lower limits of estimated σ: exact data would give 0. The lower limit of the factors of stated camera σ is 1."""
ROUNDS, SETTLED = 50, 1e-3
"""Rounds in which factors of σ are estimated, and their relative change below which the iteration has converged."""
ADJUST_ROUNDS, ROUGHLY = 20, 1e-6
"""Rounds of σ, and relative fall of the cost below which the minimisation within a round ends."""
INFLUENCE_STEPS, LEAST_DAMPING = 2, 1e-9
"""Steps from the solution of all poses to one without some; damping of directions that nothing determines."""
SEEN = 1e-3
"""Share of the robot's variance below which the corners tell nothing about the robot's error."""
WORST = "check the poses that fit worst"


@dataclass(frozen=True, slots=True, eq=False)
class Reprojection:
    """Results of a reprojection adjustment besides X and Z.

    ``camera`` : adjusted camera, or the given one where the intrinsics were not solved for; ``camera_covariance`` : (q,
    q) covariance of the intrinsics solved for, in the order of their COLMAP model; ``base_from_flange`` : m true poses
    of the flange; as reported for outliers, and where the robot is exact; ``designed``, ``corners`` : (K, 3) the
    board's corners as designed, and as adjusted in the true scale, mm; ``view``, ``corner`` : (n,) pose and row in
    ``corners`` of each measured corner. Outliers have no corners; ``residuals_px`` : (n, 2) projected minus measured.
    """

    camera: Camera
    camera_covariance: np.ndarray | None
    base_from_flange: Poses
    designed: np.ndarray
    corners: np.ndarray
    view: np.ndarray
    corner: np.ndarray
    residuals_px: np.ndarray

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


def resected(names: tuple[str, ...], views: Views, board: Reprojection) -> Poses:
    """Returns camera_from_board of all views by the adjusted camera and board."""
    seen = tuple(view.moved(board.board(view.xyz_board)) for view in views.views)
    return resect(Views(board.camera, seen), names)[0]


def problem(
    loop: Loop,
    base_from_flange: Poses,
    views: Views,
    noise: Noise,
    intrinsics: CameraPrior | None = None,
    with_scale: bool = False,
) -> tuple[Corners, tuple[str, ...]]:
    """Returns the problem, and the groups whose σ are to be estimated, from :data:`FIRST`."""
    seen = np.round(np.concatenate([view.xyz_board for view in views.views]), SAME_DIGITS)
    designed, corner = np.unique(seen, axis=0, return_inverse=True)
    stated = {name: getattr(noise, name) for name in ("corner_px", *ROBOT, "board_mm")}
    sigma = {name: FIRST[name] if value is None else value for name, value in stated.items()}
    free = [name for name, value in stated.items() if value is None]
    if sigma["robot_rad"] or sigma["robot_mm"]:  # exact in one of them only: tiny σ there
        sigma |= {name: max(sigma[name], LEAST_SIGMA[name]) for name in ROBOT}
    robot = None
    if loop.robot_covariance is not None:
        robot = np.linalg.inv(np.linalg.cholesky(loop.robot_covariance))
        free = [name for name in free if not name.startswith("robot")]
    basis = np.zeros((len(PARAMETER_NAMES), 0)) if intrinsics is None else intrinsic_basis(intrinsics.colmap_model)
    information = np.zeros((0, 0)) if intrinsics is None else np.linalg.inv(intrinsics.covariance)
    corners = Corners(
        inverted=loop.inverted,
        base_from_flange=base_from_flange,
        xyz_board=designed,
        view=np.repeat(np.arange(len(views)), [len(view) for view in views.views]),
        corner=corner.ravel(),
        xy_px=np.concatenate([view.xy_px for view in views.views]),
        weight=np.concatenate([view.whitening() for view in views.views]),
        robot=robot,
        sigma=sigma,
        camera=views.camera,
        basis=basis,
        information=information,
        with_scale=with_scale,
    )
    factors = corners.factors()
    return replace(corners, sigma=sigma | factors), (*free, *factors)


@dataclass(frozen=True, slots=True, eq=False)
class CameraError:
    """``slope`` : (12, q) derivative of the gradient of X and Z by the intrinsics; ``moment`` : (q, q) second moment of
    the intrinsics' error about zero, from the prior and from the corners; ``noise`` : (12, 12) covariance of the
    gradient by all other errors, None where it equals the normal matrix. With the scale among the unknowns, 13 replaces
    12."""

    slope: np.ndarray
    moment: np.ndarray
    noise: np.ndarray | None = None

    def covariance(self, inverse: np.ndarray) -> np.ndarray:
        """Returns the covariance (12, 12) of X and Z, given their inverse normal matrix (12, 12)."""
        moved = inverse @ self.slope
        without_camera = inverse if self.noise is None else inverse @ self.noise @ inverse
        return without_camera + moved @ self.moment @ moved.T


def adjust(corners: Corners, values: dict[str, Any], free: tuple[str, ...]) -> tuple[Corners, Solution, bool]:
    """Solves, and estimates the σ of the ``free`` kinds, in rounds: returns the problem with these σ, its solution, and
    whether σ settled; raises ConvergenceError: no minimum is reached."""
    if not np.isfinite(corners.problem().cost(values)):
        raise ConvergenceError("E-NO-MINIMUM", f"hand-eye: corners lie behind the camera at the start; {WORST}")
    settled = not free
    for _ in range(ADJUST_ROUNDS if free else 0):
        solution = corners.problem().minimum(values, settled=ROUGHLY).required("hand-eye", WORST).linear
        values, before = solution.values, corners.sigma
        corners = replace(corners, sigma=before | estimated(corners, solution, free))
        settled = bool(max(abs(np.log(corners.sigma[name] / before[name])) for name in free) < SETTLED)
        if settled:
            break
    return corners, corners.problem().minimum(values).required("hand-eye", WORST).linear, settled


def estimated(corners: Corners, solution: Solution, free: tuple[str, ...]) -> dict[str, float]:
    """Returns restricted maximum-likelihood σ of the ``free`` kinds, all else linear."""
    present = [name for name in free if any(name in factor.kinds for factor in solution.problem.factors)]
    least = np.log([LEAST_SIGMA.get(name, 1.0) / corners.sigma[name] for name in present])
    caution = np.array([CAUTION if name in LEAST_SIGMA else 0.0 for name in present])
    farthest = np.full(len(present), FARTHEST)
    likelihood = solution.components(present, caution)
    best = likelihood.best(np.maximum(least, -farthest), farthest, [np.zeros(len(present))])
    return {name: float(corners.sigma[name] * np.exp(x)) for name, x in zip(present, best, strict=True)}


def considered(wider: Corners, values: dict[str, Any], free: tuple[str, ...]) -> CameraError:
    """Returns the effect of intrinsics that were not solved for, but are among the unknowns of ``wider``: they are
    *considered* (Schmidt 1966; Bierman 1977, ch. VIII), that is, their prior covariance is carried through. ``free`` σ,
    too large by the camera's error, are estimated again with them, linear about the state."""
    values = values | {"camera": Vector(np.zeros((1, wider.basis.shape[1])))}
    factors, linear = wider.factors(), wider.problem().at(values)
    sigma = wider.sigma | estimated(wider, linear, (*free, *factors))
    again = replace(wider, sigma=sigma).problem().at(values)
    covariance = generalised_inverse(again.normal)
    camera = np.arange(covariance.shape[0])[linear.places["camera"]]
    error = covariance[camera] @ again.right
    # What each kind of observation tells, in units of the σ that weighted the solution.
    kinds = {kind for factor in linear.problem.factors for kind in factor.kinds} - set(factors)
    told = {kind: linear.equations((kind,)).told(linear.reduction.from_kept) for kind in kinds}
    normal = np.sum(list(told.values()), axis=0)
    scattered = sum((sigma[kind] / wider.sigma[kind]) ** 2 * own if kind in free else own for kind, own in told.items())
    others = np.setdiff1d(np.arange(len(normal)), camera)
    poses, eliminated = others[:UNKNOWNS], others[UNKNOWNS:]
    reduced = np.zeros((UNKNOWNS, len(normal)))
    reduced[:, poses] = np.eye(UNKNOWNS)
    inverse = generalised_inverse(normal[np.ix_(eliminated, eliminated)])
    reduced[:, eliminated] = -normal[np.ix_(poses, eliminated)] @ inverse
    second_moment = covariance[np.ix_(camera, camera)] + np.outer(error, error)
    return CameraError(reduced @ normal[:, camera], second_moment, reduced @ scattered @ reduced.T)


def of_poses(loop: Loop, solution: PoseSolution, views: Views, prior: CameraPrior) -> CameraError:
    """Returns the error of intrinsics as filed, by which the board's poses were computed from ``views``."""
    basis = intrinsic_basis(prior.colmap_model)
    q = basis.shape[1]
    information, gradient, cost, slopes = np.zeros((q, q)), np.zeros(q), 0.0, []
    for view, pose in zip(views.views, loop.camera_from_board, strict=True):
        white, by_pose = whitened(view, views.camera, pose)
        point = pose @ view.xyz_board
        by_own = view.whitening() @ views.camera.parameter_jacobian(point[:, :2] / point[:, 2:]) @ basis
        by_own = by_own.reshape(-1, q)
        slopes.append(-np.linalg.lstsq(by_pose, by_own)[0])
        reduced = by_own + by_pose @ slopes[-1]
        information += reduced.T @ reduced
        gradient += reduced.T @ white
        cost += float(white @ white)
    gain = float(gradient @ generalised_inverse(information) @ gradient)
    redundancy = 2 * views.corners() - 6 * len(views) - q
    variance = (cost - gain) / redundancy if redundancy > 0 else 1.0
    second_moment = moment(information / variance, gradient / variance, basis, prior)
    return CameraError(_slope(loop, solution, np.array(slopes)), second_moment)


def in_common(loop: Loop, solution: PoseSolution, common: np.ndarray) -> CameraError:
    """Returns the effect of errors (m, 6, k) that the board's poses have in common; they were weighed by the others."""
    return CameraError(_slope(loop, solution, common), np.eye(common.shape[2]))


def _slope(loop: Loop, solution: PoseSolution, by_unknown: np.ndarray) -> np.ndarray:
    """Returns the derivative (12, q), or (13, q) with the scale, of the gradient, from the board's poses (m, 6, q)."""
    used = np.flatnonzero(~solution.outliers)
    x, _, scale = solution.state
    jacobian, moves = loop.jacobian(x, scale, len(solution.normal)), loop.by_camera(x, scale) @ by_unknown
    weighted = np.linalg.solve(solution.covariance[used], moves[used])
    return np.einsum("mai,maj->ij", jacobian[used], weighted)


def moment(information: np.ndarray, gradient: np.ndarray, basis: np.ndarray, prior: CameraPrior) -> np.ndarray:
    """Returns the second moment (q, q) of the intrinsics' error: squared estimate plus covariance. Where corners
    contradict the prior, its σ are widened by kind, by maximum likelihood (EM: Dempster, Laird & Rubin 1977)."""
    known = np.linalg.inv(prior.covariance)
    parts = [rows for _, rows in camera_parts(basis, known)]
    squared = np.ones(len(parts))
    for _ in range(ROUNDS):
        scaled = known.copy()
        for rows, value in zip(parts, squared, strict=True):
            scaled[np.ix_(rows, rows)] /= value
        covariance = np.linalg.inv(information + scaled)
        error = -covariance @ gradient
        second = covariance + np.outer(error, error)
        new = [max(float(np.trace(known[np.ix_(r, r)] @ second[np.ix_(r, r)])) / len(r), 1.0) for r in parts]
        settled = np.abs(np.log(new / squared)).max() < SETTLED
        squared = np.array(new)
        if settled:
            break
    return second


@dataclass(frozen=True, slots=True, eq=False)
class AdjustedCorners:
    """An adjustment of corners.

    ``loop`` : with all poses; ``used`` : (m,) which of them were used; ``corners`` : problem of these poses,
    ``solution`` : its solution, ``state`` : the same as what is sought; ``covariance`` : (12, 12) of X and Z;
    ``camera_error`` : error of the intrinsics as filed, which it does not hold, where their prior is known;
    ``estimated`` : kinds whose σ were estimated; ``scale_hint`` : the scale if it were solved for, and its σ;
    ``camera_gain`` : fall of the cost per parameter if the intrinsics were solved for; ``settled`` : whether σ settled.
    """

    loop: Loop
    used: np.ndarray
    corners: Corners
    solution: Solution
    state: Bundle
    covariance: np.ndarray
    camera_error: CameraError | None
    sigma_scale: float | None
    estimated: tuple[str, ...]
    scale_hint: tuple[float, float]
    camera_gain: float
    found: Reprojection
    settled: bool

    @property
    def sigma(self) -> dict[str, float]:
        """The σ by kind that are not 0."""
        return {name: float(value) for name, value in self.corners.sigma.items() if value}

    @property
    def outliers(self) -> np.ndarray:
        """The poses (m,) that were not used."""
        return ~self.used

    def normal(self) -> np.ndarray:
        """Returns the normal matrix (12, 12) of X and Z, all other unknowns eliminated."""
        normal, k = self.solution.normal, len(self.covariance)
        return normal[:k, :k] - normal[:k, k:] @ generalised_inverse(normal[k:, k:]) @ normal[k:, :k]

    def without(self, out: np.ndarray) -> Bundle:
        """Returns the solution without the poses ``out``, rows among all: by steps from the solution of all, with its
        σ. The error of such a step is of second order in a small change (influence: Cook & Weisberg 1982)."""
        keep = ~np.isin(np.flatnonzero(self.used), out)
        corners, values = self.corners.only(keep), dict(self.solution.values)
        if "robot" in values:
            values["robot"] = values["robot"][keep]
        problem = corners.problem()
        for _ in range(INFLUENCE_STEPS):
            if not np.isfinite(problem.cost(values)):
                break
            values = problem.moved(values, problem.at(values).step(LEAST_DAMPING)[0])
        return corners.bundle(values)


def adjust_views(
    loop: Loop,
    base_from_flange: Poses,
    views: Views,
    first: LoopState,
    noise: Noise,
    intrinsics: CameraPrior | None = None,
    with_scale: bool = False,
    camera: CameraPrior | None = None,
) -> AdjustedCorners:
    """Returns the least-squares adjustment of all corners from ``first`` X, Z, scale.

    ``loop`` holds the same poses; its poses of the board come from ``views``. Unknowns are X, Z, and, according to
    their σ, the true poses of the robot and the true places of the board's corners. Intrinsics about ``intrinsics``
    (whose σ are widened where the corners contradict them) and the board's scale are unknowns on demand. Errors of
    intrinsics that are not solved for are considered by their prior, ``camera``. Corners and poses have Huber's
    weights; poses that contradict the others are then left out.

    Raises ConvergenceError: no minimum is reached. Raises DegenerateError: fewer than three poses agree.
    """
    used, good = _near(loop, first), len(loop)
    while True:
        rows = np.flatnonzero(used)
        if len(rows) < 3:
            said = f"hand-eye: {len(rows)} of {good} poses of the robot agree, 3 needed; check that poses and images "
            said += "belong together, and the conventions of both"
            raise DegenerateError("E-HANDEYE-DISAGREE", said)
        corners, free = problem(loop[rows], base_from_flange[rows], views[rows], noise, intrinsics, with_scale)
        corners, solution, settled = adjust(corners, corners.start(*first), free)
        inverse = generalised_inverse(solution.normal)
        bad = contradicting(corners, solution, inverse)
        if not bad.any() or len(rows) - bad.sum() < LEAST_POSES:
            break
        used[rows[bad]] = False
        good -= int(bad.sum())
    state = corners.bundle(solution.values)
    values, camera_error, gain = solution.values, None, 1.0
    if intrinsics is None:
        if camera is not None:
            known = intrinsic_basis(camera.colmap_model), np.linalg.inv(camera.covariance)
            camera_error = considered(corners.with_intrinsics(*known), values, free)
        # By one step from the solution; about 1 where the camera is right.
        wider, unknown = corners.with_intrinsics(*UNKNOWN_LENS), UNKNOWN_LENS[0].shape[1]
        step = wider.problem().at(values | {"camera": Vector(np.zeros((1, unknown)))})
        gain = (float(step.right @ generalised_inverse(step.normal) @ step.right) + step.reduction.gain) / unknown
    covariance, true = {name: inverse[at, at] for name, at in solution.places.items()}, list(base_from_flange)
    for row, pose in zip(rows, state.base_from_flange, strict=True):
        true[row] = pose
    found = Reprojection(
        state.camera,
        covariance.get("camera"),
        Poses.of(true),
        corners.xyz_board,
        state.scale * state.corners,
        rows[corners.view],
        corners.corner,
        corners.residuals(state),
    )
    sigma_scale = float(np.sqrt(covariance["scale"].item())) if with_scale else None
    hint, of_loop = _scale_hint(corners, values), inverse[:UNKNOWNS, :UNKNOWNS]
    more = (camera_error, sigma_scale, free, hint, gain, found, settled)
    return AdjustedCorners(loop, used, corners, solution, state, of_loop, *more)


def contradicting(corners: Corners, solution: Solution, inverse: np.ndarray) -> np.ndarray:
    """Returns which poses (m,) have a robot error that is not by chance, by the variance of its estimate."""
    m, at = len(corners.base_from_flange), solution.places.get("robot")
    if at is None:
        return np.zeros(m, bool)
    weight = corners.robot
    if weight is None:
        weight = np.tile(np.diag(1 / np.repeat([corners.sigma[name] for name in ROBOT], 3)), (m, 1, 1))
    white = np.einsum("mab,mb->ma", weight, errors(solution.values["robot"]))
    covariance = inverse[at, at].reshape(m, 6, m, 6)[np.arange(m), :, np.arange(m)]
    # For Gaussian knowledge δ ~ N(0, Σ) with posterior covariance C, the estimate of δ scatters by Σ − C.
    value, vector = np.linalg.eigh(np.eye(6) - weight @ covariance @ np.swapaxes(weight, 1, 2))
    turned = np.einsum("mab,ma->mb", vector, white)
    squared = np.where(value > SEEN, turned**2 / np.maximum(value, SEEN), 0).sum(1)
    redundancy = max(6 * (m - 1) - at.start + (not corners.with_scale), 6)
    return squared > 6 * fdtri(6, redundancy, 1 - FALSE_ALARM / m)


def _scale_hint(corners: Corners, values: dict[str, Any]) -> tuple[float, float]:
    """Returns the scale, one step from the solution, if it were solved for, and its σ."""
    wider = replace(corners, with_scale=True).problem().at(values)
    inverse, at = generalised_inverse(wider.normal), wider.places["scale"].start
    step = float(inverse[at] @ wider.right)
    return float(values["scale"].array[0, 0]) + step, float(np.sqrt(inverse[at, at]))


def _near(loop: Loop, first: LoopState) -> np.ndarray:
    """Returns which poses (m,) are not wrong from the start."""
    miss = loop.residuals(*first)
    far = np.linalg.norm(miss[:, 3:], axis=1) > GROSS_SHARE * np.linalg.norm(loop.camera_from_board.translation, axis=1)
    return ~(far | (np.linalg.norm(miss[:, :3], axis=1) > GROSS_RAD))
