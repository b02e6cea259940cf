"""Pose-error least squares: X and Z from all poses, weighted by the errors of robot and camera, with outliers named."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import chdtri, fdtri

from stcal.adjust.blocks import component_variances
from stcal.errors import InputError
from stcal.geometry.arrays import require_fields
from stcal.geometry.clusters import ByClusters, by_clusters
from stcal.geometry.least_squares import UNKEPT, NormalEquations, minimise
from stcal.geometry.normal_equations import generalised_inverse
from stcal.geometry.rigid import Rigid
from stcal.geometry.robust import robust_sigma
from stcal.handeye.data.pose_pairs import Loop, LoopState

LEAST = {"rad": 1e-9, "mm": 1e-6, "factor": 1e-2}  # lower limits of estimated σ, by kind: exact data would give 0
CAUTION = 2.0
"""Redundancies that are not counted. The variance from redundancy ν is the sum of squares over ν − 2, so that errors in
units of its root have mean square 1 (the mean of F is ν / (ν − 2)). This also keeps a component of few poses off 0, as
the penalty of Chung, Rabe-Hesketh, Dorie, Gelman & Liu (2013) does."""
MOST_RAD, MOST_MM = np.radians(10), 100.0  # largest σ of poses; beyond it poses tell nothing
FARTHEST = 7.0  # largest logarithm of the ratio between an estimated σ and its first guess: a factor of a thousand
UNKNOWNS = 12  # number of unknowns of X and Z
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

    def first(self, residuals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns first variances (f,) from the medians of residuals (m, 6), and their lower limits."""
        turn, shift = (robust_sigma(each, 3) ** 2 for each in np.linalg.norm(residuals.reshape(-1, 2, 3), axis=2).T)
        kinds = [name.rpartition("_")[2] for name in self.names]
        by_kind = {"rad": turn / max(kinds.count("rad"), 1), "mm": shift, "factor": 1.0}
        least = np.square([LEAST[kind] for kind in kinds])
        first = np.maximum([by_kind[kind] for kind in kinds], least)
        return first, np.maximum(least, LEAST_SHARE * first)


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


FALSE_ALARM = 0.01  # false-alarm probability that a set of good poses has an outlier
MOSTLY_GOOD = 2 / 3  # share of the poses that is taken to be good
LEAST_POSES = 4  # number of poses that must be left to contradict an outlier: any three poses can be fitted
ROUNDS = 30
SEEN = 1e-6
"""Share of a pose's own variance below which this pose alone determined the solution and cannot contradict it."""
SAME_RAD, SAME_MM = 2e-4, 0.05
"""Largest difference of two poses of a robot that stands still: what its encoders resolve."""
SETTLED = 1e-4  # relative change of the estimated σ between rounds below which the iteration has converged


@dataclass(frozen=True, slots=True, eq=False)
class PoseSolution:
    """Solution of a ``loop``. ``normal`` : (k, k) of X, Z (and the scale); ``residuals`` : (m, 6); ``covariance`` : (m,
    6, 6) of the residuals; ``outliers`` : (m,); ``sigma`` : the estimated σ, by name; ``variance_factor`` : mean
    squared residual in units of σ, over the ``redundancy``; ``settled`` : whether σ and outliers settled within
    :data:`ROUNDS`."""

    loop: Loop
    state: LoopState
    normal: np.ndarray
    residuals: np.ndarray
    covariance: np.ndarray
    outliers: np.ndarray
    sigma: dict[str, float]
    variance_factor: float
    redundancy: int
    settled: bool

    @property
    def inverse(self) -> np.ndarray:
        """Covariance (k, k) of X, Z (and the scale), of independent errors of the poses."""
        return generalised_inverse(self.normal)

    def misfit(self, used: np.ndarray) -> float:
        """Returns minus twice the log-likelihood of the residuals of the poses ``used``, up to a constant."""
        covariance = self.covariance[used]
        return float(_squared(self.residuals[used], covariance).sum() + np.linalg.slogdet(covariance)[1].sum())

    def without(self, out: np.ndarray) -> LoopState:
        """Returns the solution without the poses ``out``, with the σ of the solution of all."""
        used = ~self.outliers & ~np.isin(np.arange(len(self.loop)), out)
        return _solved(self.loop[used], self.state, self.covariance[used], len(self.normal))[0]

    def weighted(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Returns the derivatives (u, 6, count) of the residuals of the poses used, and these over the covariances."""
        used, (x, _, scale) = ~self.outliers, self.state
        jacobian = self.loop[used].jacobian(x, scale, count)
        return jacobian, np.linalg.solve(self.covariance[used], jacobian)

    def slope(self, by_unknown: np.ndarray) -> np.ndarray:
        """Returns the derivative (k, q) of the gradient of X, Z (and the scale) by what moves the board's poses (m, 6,
        q), which were weighed by their other errors."""
        moves = self.loop.by_camera(self.state.mount_from_camera, self.state.scale) @ by_unknown
        return np.einsum("mai,maj->ij", self.weighted(len(self.normal))[1], moves[~self.outliers])

    @property
    def scale_hint(self) -> tuple[float, float]:
        """The scale, one step from the solution, if it were solved for, and its σ."""
        jacobian, weighted = self.weighted(UNKNOWNS + 1)
        inverse = generalised_inverse(np.einsum("mai,maj->ij", jacobian, weighted))
        step = -inverse[UNKNOWNS] @ np.einsum("mai,ma->i", weighted, self.residuals[~self.outliers])
        return self.state.scale + float(step), float(np.sqrt(inverse[UNKNOWNS, UNKNOWNS]))

    def by_places(self) -> ByClusters | None:
        """Returns the covariance of X, Z (and the scale) where the robot stood several times at one place: what it errs
        there is one error, not several. None if each pose has a place of its own."""
        if (place := places(self.loop[~self.outliers])) is None:
            return None
        jacobian, weighted = self.weighted(len(self.normal))
        member = np.eye(place.max() + 1)[place]
        pull = -np.einsum("mai,ma->mi", weighted, self.residuals[~self.outliers])
        information = np.einsum("mc,mai,maj->cij", member, weighted, jacobian)
        return by_clusters(self.normal, member.T @ pull, information)


def adjust_poses(
    loop: Loop, start: LoopState, noise: Noise, with_scale: bool = False, robust: bool = True
) -> PoseSolution:
    """Returns the least-squares solution of the loop's residuals over their σ at the board's origin, from a start:
    maximum likelihood for Gaussian errors of robot and camera (Strobl & Hirzinger 2006 without the metric's free
    parameter). Raises ConvergenceError: no minimum is reached."""
    count, state, residuals = UNKNOWNS + with_scale, start, loop.residuals(*start)
    parts = components(loop, noise, state.mount_from_camera, state.scale)
    first, least = parts.first(residuals)
    variances, limits = first, (least, first * np.exp(2 * FARTHEST))
    used = _near(residuals, parts.total(variances)) if robust else np.ones(len(loop), bool)
    for round_ in range(ROUNDS):
        parts = components(loop, noise, state.mount_from_camera, state.scale)
        covariance = parts.total(variances)
        state, normal = _solved(loop[used], state, covariance[used], count)
        residuals, jacobian = loop.residuals(*state), loop.jacobian(state.mount_from_camera, state.scale, count)
        before, settled = used, True
        if parts.names:
            # Restricted maximum likelihood (Patterson & Thompson 1971).
            old, own = variances, (residuals[used], jacobian[used], parts.known[used], parts.free[:, used])
            variances = component_variances(*own, first, limits, CAUTION)
            settled = bool(np.abs(np.log(variances / old)).max() < SETTLED)
        if robust and round_ < ROUNDS // 2:  # later the set stays: a set that alternates would never settle
            used = _agreeing(residuals, jacobian, parts.total(variances), used, estimated=bool(parts.names))
        settled &= bool((used == before).all())
        if settled:
            break
    covariance = parts.total(variances)
    state, normal = _solved(loop[used], state, covariance[used], count)
    residuals, redundancy = loop.residuals(*state), max(6 * int(used.sum()) - count, 1)
    sigma = {name: float(v) for name, v in zip(parts.names, np.sqrt(variances), strict=True)}
    factor = float(_squared(residuals, covariance)[used].sum() / redundancy)
    return PoseSolution(loop, state, normal, residuals, covariance, ~used, sigma, factor, redundancy, settled)


def places(loop: Loop) -> np.ndarray | None:
    """Returns the number (m,) of the place at which the robot stood for each pose; None if each has one of its own."""
    robot, place = loop.stand_from_mount, np.arange(len(loop))
    for i in range(1, len(loop)):
        turn = Rotation.from_matrix(robot.rotation[i].T @ robot.rotation[:i]).magnitude()
        away = np.linalg.norm(robot.translation[:i] - robot.translation[i], axis=1)
        same = np.flatnonzero((turn < SAME_RAD) & (away < SAME_MM))
        place[i] = place[same[0]] if len(same) else i
    first, place = np.unique(place, return_inverse=True)
    return place if LEAST_POSES <= len(first) < len(loop) else None


def _solved(loop: Loop, start: LoopState, covariance: np.ndarray, count: int) -> tuple[LoopState, np.ndarray]:
    """Returns the least-squares state and its normal matrix."""
    weight = np.linalg.inv(np.linalg.cholesky(covariance))

    def linearise(state: LoopState) -> NormalEquations:
        white = np.einsum("mab,mb->ma", weight, loop.residuals(*state)).ravel()
        jacobian = loop.jacobian(state.mount_from_camera, state.scale, count)
        return NormalEquations.of(white, (weight @ jacobian).reshape(-1, count))

    minimum = minimise(start, linearise, LoopState.moved)
    # Derivatives neglect curvature. With rough poses, steps end where even a damped step gains nothing.
    minimum = minimum.required("hand-eye", "check the poses that fit worst", accepted=UNKEPT)
    return minimum.state, minimum.linear.normal


def _squared(residuals: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Returns squared residuals in units of σ, (m,)."""
    return np.einsum("ma,ma->m", residuals, np.linalg.solve(covariance, residuals[:, :, None])[:, :, 0])


def _near(residuals: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Returns poses to start with, by σ from medians: at least the better two thirds, so as not to select by chance."""
    squared = _squared(residuals, covariance)
    enough = min(max(int(np.ceil(MOSTLY_GOOD * len(squared))), LEAST_POSES), len(squared))
    return squared <= max(chdtri(6, FALSE_ALARM), np.sort(squared)[enough - 1])


def _agreeing(
    residuals: np.ndarray, jacobian: np.ndarray, covariance: np.ndarray, used: np.ndarray, estimated: bool
) -> np.ndarray:
    """Returns which poses, (m,), agree with the solution of all others, by squared residuals over their variance."""
    m, count = len(used), jacobian.shape[2]
    redundancy = 6 * int(used.sum()) - count - 6
    if redundancy < 6:
        return used
    chance = FALSE_ALARM / m
    limit = 6 * fdtri(6, redundancy, 1 - chance) if estimated else chdtri(6, chance)
    weight = np.linalg.inv(np.linalg.cholesky(covariance))
    white, by = np.einsum("mab,mb->ma", weight, residuals), weight @ jacobian
    solved = by @ generalised_inverse(np.einsum("mai,maj->ij", by[used], by[used])) @ np.swapaxes(by, 1, 2)
    agrees = squared_within(white, np.eye(6) + np.where(used, -1, 1)[:, None, None] * solved, SEEN) <= limit
    return agrees if agrees.sum() >= LEAST_POSES else used


def squared_within(values: np.ndarray, variance: np.ndarray, least: float) -> np.ndarray:
    """Returns squares (m,) of values (m, 6) over their variance (m, 6, 6), along directions with the ``least`` one."""
    own, axes = np.linalg.eigh(variance)
    along = np.einsum("mab,ma->mb", axes, values)
    return np.where(own > least, along**2 / np.maximum(own, least), 0).sum(1)
