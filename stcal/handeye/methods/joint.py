"""Reprojection adjustment of one camera or of several: X of each, one Z, one board and one robot, from all corners; and
the effect of an error of a camera file."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from operator import add

import numpy as np
from scipy.stats import f

from stcal.errors import DegenerateError
from stcal.geometry.camera import intrinsic_basis
from stcal.geometry.normal_equations import generalised_inverse
from stcal.geometry.rigid import Poses, Rigid
from stcal.handeye.data.pairs import Loop, Setup
from stcal.handeye.data.views import RigCamera, RigPoses, Views, whitened
from stcal.handeye.methods.bundle import (
    ARM_ROUNDS,
    SETTLED_MM,
    ArmModel,
    Bundle,
    LinearArm,
    RigBundle,
    RigCorners,
    camera_parts,
)
from stcal.handeye.methods.equations import Equations
from stcal.handeye.methods.noise import Noise, adjust, estimated
from stcal.handeye.methods.pose_adjustment import FALSE_ALARM, LEAST_POSES, LoopState, PoseSolution
from stcal.handeye.methods.reprojection import (
    CAMERA_GAIN,
    FIRST,
    GROSS_RAD,
    GROSS_SHARE,
    UNKNOWN_LENS,
    Reprojection,
    board_of,
    found_of,
    problem,
)  # fmt: skip
from stcal.io.cameras.model import CameraPrior

ROUNDS = 50
SETTLED = 1e-3
"""Relative change of the factors of σ below which the iteration has converged."""


@dataclass(frozen=True, slots=True, eq=False)
class CameraError:
    """``slope`` : (12, q) derivative of the gradient of X and Z by the intrinsics; ``moment`` : (q, q) second moment of
    the intrinsics' error about zero, from the prior and from the corners; ``noise`` : (12, 12) covariance of the
    gradient by all other errors, None where it equals the normal matrix. For a rig of c cameras, 6c + 6 replaces 12;
    with the scale among the unknowns, 13 does."""

    slope: np.ndarray
    moment: np.ndarray
    noise: np.ndarray | None = None

    def covariance(self, inverse: np.ndarray) -> np.ndarray:
        """Returns the covariance (12, 12) of X and Z, given their inverse normal matrix ``inverse`` (12, 12)."""
        moved = inverse @ self.slope
        without_camera = inverse if self.noise is None else inverse @ self.noise @ inverse
        return without_camera + moved @ self.moment @ moved.T


def considered(wider: RigCorners, state: RigBundle, free: tuple[str, ...]) -> CameraError:
    """Returns the effect of intrinsics that were not solved for, but are among the unknowns of ``wider``.

    Parameters that are not solved for, but are not exact either, are *considered* (Schmidt 1966; Bierman,
    "Factorization Methods for Discrete Sequential Estimation", 1977, ch. VIII): their prior covariance is carried
    through the solution. Corners that are off by the camera's error make all ``free`` σ too large. These σ are
    therefore estimated again with the intrinsics among the unknowns, linear about the state.
    """
    factors, poses = wider.factors(), wider.places()["z"].stop
    sigma = wider.sigma | estimated(wider, state, (*free, *factors))
    camera = np.arange(wider.places()["camera"].start, wider.places()["camera"].stop)
    left = wider.with_sigma(sigma).linear(state).eliminated()
    covariance = generalised_inverse(left.normal)
    error = -covariance[camera] @ left.gradient
    # Equations and gradient noise of all other observations, in units of the σ that weighted the solution.
    parts = {name: part.equations for name, part in wider.parts(state).items() if name not in factors}
    scatter = {name: (sigma[name] / wider.sigma[name]) ** 2 if name in free else 1.0 for name in parts}
    known = reduce(add, parts.values())
    noise = reduce(add, (own.times(scatter[name]) for name, own in parts.items()))
    without_board = known.eliminated()
    others = np.setdiff1d(np.arange(len(known.gradient)), camera)
    eliminated, normal = others[poses:], without_board.normal
    reduced = np.eye(poses, len(others))
    reduced[:, poses:] = -normal[np.ix_(others[:poses], eliminated)] @ generalised_inverse(
        normal[np.ix_(eliminated, eliminated)]
    )
    scattered = noise.normal
    if known.cross is not None and without_board.from_kept is not None and noise.cross is not None:
        by_corner = without_board.from_kept  # what the gradient of the others takes over from that of the corners
        mixed = np.tensordot(by_corner, noise.cross, ((0, 1), (0, 1)))
        scattered = scattered - mixed - mixed.T
        scattered = scattered + np.tensordot(by_corner, noise.block @ by_corner, ((0, 1), (0, 1)))
    return CameraError(
        slope=reduced @ normal[np.ix_(others, camera)],
        moment=covariance[np.ix_(camera, camera)] + np.outer(error, error),
        noise=reduced @ scattered[np.ix_(others, others)] @ reduced.T,
    )


def of_poses(loop: Loop, solution: PoseSolution, views: Views, prior: CameraPrior) -> CameraError:
    """Returns the camera error of an adjustment of the board's poses, each of which was found from its view with the
    camera as filed."""
    basis = intrinsic_basis(prior.colmap_model)
    by_camera, second_moment = poses_by_camera(views, loop.camera_from_board, basis, prior)
    return CameraError(_slope(loop, solution, by_camera), second_moment)


def in_common(loop: Loop, solution: PoseSolution, common: np.ndarray) -> CameraError:
    """Returns the effect of errors (m, 6, k) that the board's poses have in common, which their residuals hardly show.

    The poses were weighed by their other errors alone.
    """
    return CameraError(_slope(loop, solution, common), np.eye(common.shape[2]))


def _slope(loop: Loop, solution: PoseSolution, by_unknown: np.ndarray) -> np.ndarray:
    """Returns the derivative (12, q) of the gradient of X and Z, from that of the board's poses (m, 6, q); (13, q) with
    the scale, which takes up errors that all distances have in common, if it was solved for."""
    used = np.flatnonzero(~solution.outliers)
    state: LoopState = solution.state
    jacobian = loop.jacobian(state.mount_from_camera, state.scale)[:, :, : len(solution.normal)]
    moves = loop.by_camera(state.mount_from_camera, state.scale) @ by_unknown
    weighted = np.linalg.solve(solution.covariance[used], moves[used])
    return np.einsum("mai,maj->ij", jacobian[used], weighted)


def poses_by_camera(
    views: Views, camera_from_board: Poses, basis: np.ndarray, prior: CameraPrior
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the derivative (m, 6, q) of the board's pose in each view by the intrinsics, and the :func:`moment` (q,
    q) of the intrinsics."""
    q = basis.shape[1]
    information, gradient, cost, slopes = np.zeros((q, q)), np.zeros(q), 0.0, []
    for view, pose in zip(views.views, camera_from_board, strict=True):
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
    return np.array(slopes), moment(information / variance, gradient / variance, basis, prior)


def moment(information: np.ndarray, gradient: np.ndarray, basis: np.ndarray, prior: CameraPrior) -> np.ndarray:
    """Returns the second moment (q, q) of the intrinsics' error: squared estimate plus covariance.

    Where the corners contradict the prior, the prior σ are widened by kind, as an adjustment of the intrinsics would
    do. The factors maximise the likelihood by expectation and maximisation (Dempster, Laird & Rubin 1977).
    """
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


LEAST_VIEWS = 1
"""Least number of views of a camera. One image of a board gives the camera's place if other cameras give the
board's."""
MISSED = 3.0
"""Factor over the usual discrepancy between a view's own pose of the board and that of the others, from which the view
is doubted."""
INFLUENCE_STEPS, LEAST_DAMPING = 2, 1e-9
"""Number of steps from the solution of all poses to one without some of them, and their damping, which only keeps
directions that nothing determines."""
SEEN = 1e-3
"""Share of the robot's variance below which the corners tell nothing about the robot's error."""


@dataclass(frozen=True, slots=True, eq=False)
class Adjusted:
    """An adjustment of c cameras.

    ``loops`` : the loop of each camera, with all its views; ``rows`` : the poses of the robot that were used;
    ``corners`` : problem of these poses, ``state`` : its solution, ``linear`` : its normal equations there; ``used`` :
    which views of each camera were used; ``outliers`` : (m,) poses of the robot that contradict the others;
    ``covariance`` : (6c + 6, 6c + 6) of all X and Z; ``camera_error`` : error of the intrinsics as filed, which it does
    not hold, where their prior is known; ``sigma_scale``; ``sigma`` : by group; ``estimated`` : groups whose σ were
    estimated; ``scale_hint`` : the scale if it were solved for, and its σ; ``camera_gain`` : (c,) fall of the cost per
    parameter if a camera's intrinsics were solved for; ``found`` : results of each camera; ``settled`` : whether the
    estimated σ settled.
    """

    loops: tuple[Loop, ...]
    rows: np.ndarray
    corners: RigCorners
    state: RigBundle
    linear: Equations
    used: tuple[np.ndarray, ...]
    outliers: np.ndarray
    covariance: np.ndarray
    camera_error: CameraError | None
    sigma_scale: float | None
    sigma: dict[str, float]
    estimated: tuple[str, ...]
    scale_hint: tuple[float, float]
    camera_gain: np.ndarray
    found: tuple[Reprojection, ...]
    settled: bool

    def whole_covariance(self) -> np.ndarray:
        """Returns the covariance of all X and Z, with the errors of intrinsics as filed."""
        return self.covariance if self.camera_error is None else self.camera_error.covariance(self.covariance)

    def normal(self) -> np.ndarray:
        """Returns the normal matrix (6c + 6, 6c + 6) of all X and Z, all other unknowns eliminated."""
        normal, k = self.linear.eliminated().normal, len(self.covariance)
        return normal[:k, :k] - normal[:k, k:] @ generalised_inverse(normal[k:, k:]) @ normal[k:, :k]

    def without(self, out: np.ndarray) -> RigBundle:
        """Returns the solution without the poses ``out``, rows among all: by steps from the solution of all, with its
        σ. The error of such a step is of second order in a small change (influence: Cook & Weisberg 1982)."""
        keep = ~np.isin(self.rows, out)
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
) -> Adjusted:
    """Returns the least-squares adjustment of all corners of one camera from ``first`` X, Z, scale.

    ``loop`` holds the same poses; its poses of the board come from ``views``. Unknowns are X, Z, and, according to
    their σ, the true poses of the robot and the true places of the board's corners. Intrinsics about ``intrinsics``
    (whose σ are widened where the corners contradict them) and the board's scale are unknowns on demand. Errors of
    intrinsics that are not solved for are considered by their prior, ``camera``. The parameters of an ``arm``, which
    replaces ``base_from_flange``, are unknowns too. Corners and poses have Huber's weights; poses that contradict the
    others are then left out.

    Raises ConvergenceError: no minimum is reached. Raises DegenerateError: fewer than three poses agree.
    """
    rows, refine = np.arange(len(views)), intrinsics is not None
    one = RigCamera("", views, rows, ("",) * len(rows), intrinsics if refine else camera)

    def adjusted(loop: Loop, flange: Poses, first, *arm) -> Adjusted:
        x, z, scale = first
        poses = RigPoses(flange, (one,), where="hand-eye")
        return _adjusted(poses, [loop], ([x], z, scale), noise, refine, with_scale, *arm, each_view=False)

    if arm is None:
        return adjusted(loop, base_from_flange, first)
    parameters, sigma = np.zeros(len(arm.angles)), FIRST
    for _ in range(ARM_ROUNDS):
        linear, flange = LinearArm.about(arm, parameters), arm.poses(parameters)
        moved = replace(loop, stand_from_mount=flange.inverse() if loop.inverted else flange)
        result = adjusted(moved, flange, first, linear, sigma)
        sigma, state = FIRST | result.sigma, result.state
        parameters = parameters + state.arm
        first = (state.mount_from_camera[0], state.stand_from_board, state.scale)
        if linear.moves_mm(state.arm) < SETTLED_MM:
            return result
    return replace(result, settled=False)


def adjust_rig(
    given: RigPoses,
    setup: Setup,
    first: tuple[list[Rigid], Rigid, float],
    noise: Noise,
    refine: bool = False,
    with_scale: bool = False,
) -> Adjusted:
    """Returns the least-squares adjustment of all corners of all cameras from ``first`` X of each, Z, scale.

    It is like :func:`adjust_views`. The error of each pose of the robot is one unknown, to which all images from that
    pose contribute, and σ of the robot is estimated over all images. Poses of the robot that contradict the others are
    left out, and so is an image that contradicts the others of the same pose.

    Raises ConvergenceError: no minimum is reached. Raises DegenerateError: fewer than three poses of the robot agree,
    or no view of a camera agrees.
    """
    loops = [Loop.of(given.pairs(i), setup) for i in range(len(given.cameras))]
    return _adjusted(given, loops, first, noise, refine, with_scale)


def _adjusted(
    given: RigPoses,
    loops: Sequence[Loop],
    first: tuple[list[Rigid], Rigid, float],
    noise: Noise,
    refine: bool,
    with_scale: bool,
    arm: LinearArm | None = None,
    sigma: Mapping[str, float] = FIRST,
    each_view: bool = True,
) -> Adjusted:
    """Returns the adjustment with the arm, if there is one, linearised. ``sigma`` : first guesses of the σ that are
    estimated; ``each_view`` : whether single views are tested, besides poses of the robot."""
    used = tuple(_near(loop, x, *first[1:]) for loop, x in zip(loops, first[0], strict=True))
    outliers = np.zeros(len(given), bool)
    while True:
        rows = _rows(given, used, outliers)
        corners, free = _problem(given, loops, used, rows, noise, refine, with_scale, arm, sigma)
        cameras, one = tuple(camera.views.camera for camera in given.cameras), corners.each[0]
        no_step = np.zeros(0 if arm is None else len(arm.parameters))
        begin = RigBundle(tuple(first[0]), first[1], one.base_from_flange, one.xyz_board, cameras, first[2], no_step)
        solution = adjust(corners, begin, free)
        corners, state = solution.corners, solution.state
        inverse = solution.linear.inverse()
        bad = contradicting(corners, state, inverse)
        if bad.any() and len(rows) - bad.sum() >= LEAST_POSES:
            outliers[rows[bad]] = True
            used = tuple(u & ~outliers[c.rows] for u, c in zip(used, given.cameras, strict=True))
            continue
        worst = _worst_view(given, used, rows, corners, state) if each_view else None
        if worst is None or used[worst[0]].sum() < LEAST_POSES:
            break
        used[worst[0]][worst[1]] = False
    at = corners.places()
    results = []
    for i, camera in enumerate(given.cameras):
        columns, view = corners.columns(i)[: corners.each[i].kept()], np.full(len(given), -1)
        view[camera.rows[used[i]]] = np.flatnonzero(used[i])
        own, reported = inverse[np.ix_(columns, columns)], given.base_from_flange[camera.rows]
        results.append(found_of(corners.each[i], state.of(i), own, reported, view[rows], refine))
    return Adjusted(
        loops=tuple(loops),
        rows=rows,
        corners=corners,
        state=state,
        linear=solution.linear,
        used=used,
        outliers=outliers,
        covariance=inverse[: at["z"].stop, : at["z"].stop],
        camera_error=None if refine else _considered(given, corners, state, free),
        sigma_scale=float(np.sqrt(inverse[at["scale"], at["scale"]].item())) if with_scale else None,
        sigma={name: float(value) for name, value in corners.sigma.items() if value},
        estimated=free,
        scale_hint=_scale_hint(corners, state),
        camera_gain=np.ones(len(given.cameras)) if refine else _camera_gains(corners, state),
        found=tuple(results),
        settled=solution.settled,
    )


def contradicting(corners: RigCorners, state: Bundle | RigBundle, inverse: np.ndarray) -> np.ndarray:
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


def _scale_hint(corners: RigCorners, state: RigBundle) -> tuple[float, float]:
    """Returns the scale if it were solved for, and its σ: one step from the solution with the scale among the
    unknowns."""
    wider = replace(corners, each=tuple(replace(own, with_scale=True) for own in corners.each))
    left, at = wider.linear(state).eliminated(), wider.places()["scale"].start
    inverse = generalised_inverse(left.normal)
    return state.scale - float(inverse[at] @ left.gradient), float(np.sqrt(inverse[at, at]))


def _near(loop: Loop, x: Rigid, z: Rigid, scale: float) -> np.ndarray:
    """Returns which views (v,) are not wrong from the start."""
    miss = loop.residuals(x, z, scale)
    far = np.linalg.norm(miss[:, 3:], axis=1) > GROSS_SHARE * np.linalg.norm(loop.camera_from_board.translation, axis=1)
    return ~(far | (np.linalg.norm(miss[:, :3], axis=1) > GROSS_RAD))


def _rows(given: RigPoses, used: tuple[np.ndarray, ...], outliers: np.ndarray) -> np.ndarray:
    """Returns the poses of the robot that are used in some view."""
    for camera, good in zip(given.cameras, used, strict=True):
        if good.sum() < LEAST_VIEWS and camera.name:
            raise DegenerateError(
                "E-HANDEYE-DISAGREE",
                f"camera {camera.name}: none of {len(good)} views agrees with the other cameras; check its images, "
                "intrinsics, board and poses",
            )
    rows = np.unique(np.concatenate([camera.rows[good] for camera, good in zip(given.cameras, used, strict=True)]))
    if len(rows) < 3:
        raise DegenerateError(
            "E-HANDEYE-DISAGREE",
            f"{given.where}: {len(rows)} of {len(given) - int(outliers.sum())} poses of the robot agree, 3 needed; "
            "check that poses and images belong together, and the conventions of both",
        )
    return rows


def _problem(
    given: RigPoses,
    loops: Sequence[Loop],
    used: tuple[np.ndarray, ...],
    rows: np.ndarray,
    noise: Noise,
    refine: bool,
    with_scale: bool,
    arm: LinearArm | None,
    sigma: Mapping[str, float],
) -> tuple[RigCorners, tuple[str, ...]]:
    """Returns the problem with the poses ``rows`` of the robot, and the groups whose σ are to be estimated."""
    cameras = [camera[corners] for camera, corners in zip(given.cameras, used, strict=True)]
    board, flange = board_of([camera.views for camera in cameras]), given.base_from_flange[rows]
    problems, free = [], []
    arm = None if arm is None else arm[rows]
    for camera, loop, good in zip(cameras, loops, used, strict=True):
        at = np.searchsorted(rows, camera.rows)
        prior = camera.prior if refine else None
        corners, names = problem(
            loop[good], flange, camera.views, noise, prior, with_scale, arm, sigma, rows=at, designed=board
        )
        problems.append(corners)
        named = RigCorners((camera.name,), (corners,))
        free += [name for name in (*named.sigma, *named.factors()) if name.split(":")[0] in names]
    return RigCorners(tuple(camera.name for camera in cameras), tuple(problems)), tuple(dict.fromkeys(free))


def _considered(given: RigPoses, corners: RigCorners, state: RigBundle, free: tuple[str, ...]) -> CameraError | None:
    """Returns the effect of the intrinsics as filed; None where no prior of any camera is known."""
    known = {}
    for i, camera in enumerate(given.cameras):
        if camera.prior is not None:
            known[i] = intrinsic_basis(camera.prior.colmap_model), np.linalg.inv(camera.prior.covariance)
    return considered(corners.with_intrinsics(known), state, free) if known else None


def _camera_gains(corners: RigCorners, state: RigBundle) -> np.ndarray:
    """Returns (c,) the fall of the cost, per parameter of one camera, with its intrinsics among the unknowns as in
    :data:`UNKNOWN_LENS`. It is predicted by one step from the solution, and about 1 where the camera is right.

    The worst camera is tested alone, and the next one with the intrinsics of the worst among the unknowns, since a
    wrong camera biases the board and the robot's poses of all cameras.
    """
    wrong: list[int] = []
    gains, before = np.ones(len(corners.each)), 0.0
    while len(wrong) < len(gains):
        gain = {}
        for i in set(range(len(gains))) - set(wrong):
            wider = corners.with_intrinsics(dict.fromkeys((*wrong, i), UNKNOWN_LENS))
            gain[i] = wider.linear(state).gain() / UNKNOWN_LENS[0].shape[1] - before
            gains[i] = gain[i]
        worst = max(gain, key=gain.__getitem__)
        if gain[worst] <= CAMERA_GAIN:
            break
        wrong.append(worst)
        before += gain[worst]
    return gains


def _worst_view(
    given: RigPoses, used: tuple[np.ndarray, ...], rows: np.ndarray, corners: RigCorners, state: RigBundle
) -> tuple[int, int] | None:
    """Returns the view (camera, its number) that contradicts the others most, by the gain of its corners from a pose of
    their own; None where all agree."""
    worst, most = None, 1.0
    for i, camera in enumerate(given.cameras):
        corners_of_camera, numbers = corners.each[i], np.flatnonzero(used[i])
        white, derivatives = corners_of_camera.seen(state.of(i))
        gains = []
        for row in np.searchsorted(rows, camera.rows[numbers]):
            in_view = corners_of_camera.view == row
            slope, miss = (
                derivatives["x"][in_view].reshape(-1, 6),
                white[in_view].ravel(),
            )  # moving X is moving the board in the view
            gains.append(float(miss @ slope @ generalised_inverse(slope.T @ slope) @ slope.T @ miss))
        # An error that all views of a camera share comes from its lens or the board: a view is judged by the others.
        usual = max(1.0, float(np.median(gains)) / 6)
        limit = 6 * MISSED * usual * f.ppf(1 - FALSE_ALARM / len(gains), 6, len(white))
        k = int(np.argmax(gains))
        if gains[k] / limit > most:
            worst, most = (i, int(numbers[k])), gains[k] / limit
    return worst
