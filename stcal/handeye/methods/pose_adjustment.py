"""Pose-error least squares: X and Z from all poses, weighted by the errors of robot and camera, with outliers named."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2, f

from stcal.geometry.clusters import ByClusters, by_clusters
from stcal.geometry.least_squares import UNKEPT, NormalEquations, minimise
from stcal.geometry.normal_equations import generalised_inverse
from stcal.geometry.rigid import Rigid
from stcal.handeye.data.pose_pairs import Loop
from stcal.handeye.methods.noise import Noise, components, variance_components

FALSE_ALARM = 0.01
"""False-alarm probability that a set of good poses has an outlier."""
MOSTLY_GOOD = 2 / 3
"""Share of the poses that is taken to be good."""
LEAST_POSES = 4
"""Number of poses that must be left to contradict an outlier: any three poses can be fitted."""
ROUNDS = 30
SEEN = 1e-6
"""Share of a pose's own variance below which this pose alone determined the solution and cannot contradict it."""
SAME_RAD, SAME_MM = 2e-4, 0.05
"""Largest difference of two poses of a robot that stands still: what its encoders resolve."""
SETTLED = 1e-4
"""Relative change of the estimated σ between rounds below which the iteration has converged."""


@dataclass(frozen=True, slots=True, eq=False)
class LoopState:
    """The unknowns: X, Z and the board's scale."""

    mount_from_camera: Rigid
    stand_from_board: Rigid
    scale: float = 1.0

    def moved(self, step: np.ndarray) -> "LoopState":
        """Returns the state after left perturbations of X and Z and a change of the scale, (12,) or (13,)."""
        x, z = (a.moved(s) for a, s in ((self.mount_from_camera, step[:6]), (self.stand_from_board, step[6:12])))
        return LoopState(x, z, self.scale + (step[12] if len(step) > 12 else 0.0))


@dataclass(frozen=True, slots=True, eq=False)
class PoseSolution:
    """``normal`` : (k, k) of X, Z (and the scale); ``residuals`` : (m, 6); ``covariance`` : (m, 6, 6) of the residuals;
    ``outliers`` : (m,); ``sigma`` : the estimated σ, by name; ``variance_factor`` : mean squared residual in units of
    σ, over the ``redundancy``; ``scale_hint`` : the scale if it were solved for, and its σ; ``settled`` : whether σ and
    outliers settled within :data:`ROUNDS`."""

    state: LoopState
    normal: np.ndarray
    residuals: np.ndarray
    covariance: np.ndarray
    outliers: np.ndarray
    sigma: dict[str, float]
    variance_factor: float
    redundancy: int
    scale_hint: tuple[float, float]
    settled: bool

    def misfit(self, used: np.ndarray) -> float:
        """Returns minus twice the log-likelihood of the residuals of the poses ``used``, up to a constant."""
        covariance = self.covariance[used]
        return float(_squared(self.residuals[used], covariance).sum() + np.linalg.slogdet(covariance)[1].sum())

    def without(self, loop: Loop, out: np.ndarray) -> LoopState:
        """Returns the solution of the same ``loop`` without the poses ``out``, with the σ of the solution of all."""
        used = ~self.outliers & ~np.isin(np.arange(len(loop)), out)
        return _solved(loop[used], self.state, self.covariance[used], len(self.normal))[0]


def adjust_poses(
    loop: Loop, start: LoopState, noise: Noise, with_scale: bool = False, robust: bool = True
) -> PoseSolution:
    """Returns the least-squares solution of the loop's residuals over their σ at the board's origin, from a start:
    maximum likelihood for Gaussian errors of robot and camera (Strobl & Hirzinger 2006 without the metric's free
    parameter). Raises ConvergenceError: no minimum is reached."""
    count = 13 if with_scale else 12
    state = start
    residuals = _residuals(loop, state)
    parts = components(loop, noise, state.mount_from_camera, state.scale)
    variances = first = parts.first(residuals)
    used = _near(residuals, parts.total(variances)) if robust else np.ones(len(loop), bool)
    for round_ in range(ROUNDS):
        parts = components(loop, noise, state.mount_from_camera, state.scale)
        covariance = parts.total(variances)
        state, normal = _solved(loop[used], state, covariance[used], count)
        residuals, jacobian = _residuals(loop, state), _jacobian(loop, state, count)
        before, settled = used, True
        if parts.names:
            old = variances
            variances = variance_components(parts.of(used), residuals[used], jacobian[used], first)
            settled = bool(np.abs(np.log(variances / old)).max() < SETTLED)
        if robust and round_ < ROUNDS // 2:  # later the set stays: a set that alternates would never settle
            used = _agreeing(residuals, jacobian, parts.total(variances), used, estimated=bool(parts.names))
        settled &= bool((used == before).all())
        if settled:
            break
    covariance = parts.total(variances)
    state, normal = _solved(loop[used], state, covariance[used], count)
    residuals = _residuals(loop, state)
    sigma = {name: float(v) for name, v in zip(parts.names, np.sqrt(variances), strict=True)}
    redundancy = max(6 * int(used.sum()) - count, 1)
    return PoseSolution(
        state=state,
        normal=normal,
        residuals=residuals,
        covariance=covariance,
        outliers=~used,
        sigma=sigma,
        variance_factor=float(_squared(residuals, covariance)[used].sum() / redundancy),
        redundancy=redundancy,
        scale_hint=_scale_hint(loop[used], state, residuals[used], covariance[used]),
        settled=settled,
    )


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


def by_places(loop: Loop, solution: PoseSolution) -> ByClusters | None:
    """Returns the covariance of X, Z (and the scale) where the robot stood several times at one place: what it errs
    there is one error, not several. None if each pose has a place of its own."""
    used = ~solution.outliers
    own = loop[used]
    place = places(own)
    if place is None:
        return None
    jacobian = _jacobian(own, solution.state, len(solution.normal))
    weighted, member = np.linalg.solve(solution.covariance[used], jacobian), np.eye(place.max() + 1)[place]
    pull = -np.einsum("mai,ma->mi", weighted, solution.residuals[used])
    information = np.einsum("mc,mai,maj->cij", member, weighted, jacobian)
    return by_clusters(solution.normal, member.T @ pull, information)


def _scale_hint(loop: Loop, state: LoopState, residuals: np.ndarray, covariance: np.ndarray) -> tuple[float, float]:
    """Returns the scale, one step from the solution, if it were solved for, and its σ."""
    jacobian = _jacobian(loop, state, 13)
    weighted = np.linalg.solve(covariance, jacobian)
    inverse = generalised_inverse(np.einsum("mai,maj->ij", jacobian, weighted))
    step = -inverse[12] @ np.einsum("mai,ma->i", weighted, residuals)
    return state.scale + float(step), float(np.sqrt(inverse[12, 12]))


def _residuals(loop: Loop, state: LoopState) -> np.ndarray:
    return loop.residuals(state.mount_from_camera, state.stand_from_board, state.scale)


def _jacobian(loop: Loop, state: LoopState, count: int) -> np.ndarray:
    return loop.jacobian(state.mount_from_camera, state.scale)[:, :, :count]


def _solved(loop: Loop, start: LoopState, covariance: np.ndarray, count: int) -> tuple[LoopState, np.ndarray]:
    """Returns the least-squares state and its normal matrix."""
    weight = np.linalg.inv(np.linalg.cholesky(covariance))

    def linearise(state: LoopState) -> NormalEquations:
        white = np.einsum("mab,mb->ma", weight, _residuals(loop, state)).ravel()
        return NormalEquations.of(white, (weight @ _jacobian(loop, state, count)).reshape(-1, count))

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
    return squared <= max(chi2.ppf(1 - FALSE_ALARM, 6), np.sort(squared)[enough - 1])


def _agreeing(
    residuals: np.ndarray, jacobian: np.ndarray, covariance: np.ndarray, used: np.ndarray, estimated: bool
) -> np.ndarray:
    """Returns which poses, (m,), agree with the solution of all others."""
    m, count = len(used), jacobian.shape[2]
    redundancy = 6 * int(used.sum()) - count - 6
    if redundancy < 6:
        return used
    level = 1 - FALSE_ALARM / m
    limit = 6 * f.ppf(level, 6, redundancy) if estimated else chi2.ppf(level, 6)
    agrees = against_others(residuals, jacobian, covariance, used) <= limit
    return agrees if agrees.sum() >= LEAST_POSES else used


def against_others(residuals: np.ndarray, jacobian: np.ndarray, covariance: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Returns squared residuals (m,) over their own variance, χ² of 6 degrees of freedom: less than the pose's for
    poses that took part, plus the solution's for the others."""
    weight = np.linalg.inv(np.linalg.cholesky(covariance))
    white, by = np.einsum("mab,mb->ma", weight, residuals), weight @ jacobian
    solved = by @ generalised_inverse(np.einsum("mai,maj->ij", by[used], by[used])) @ np.swapaxes(by, 1, 2)
    value, vector = np.linalg.eigh(np.eye(6) + np.where(used, -1, 1)[:, None, None] * solved)
    turned = np.einsum("mab,ma->mb", vector, white)
    return np.where(value > SEEN, turned**2 / np.maximum(value, SEEN), 0).sum(1)
