"""The two poses that a plane seen from afar leaves: both minima of its residuals over the pose, and which one holds.

A plane seen from afar looks the same tilted to either side of the line of sight (Oberkampf, DeMenthon & Davis 1996,
Iterative pose estimation using coplanar feature points, CVIU 63; Schweighofer & Pinz 2006, Robust pose estimation from
a planar target, IEEE TPAMI 28): the reprojection error has two minima. Both are found here, by the residuals of single
points with Huber's loss, and compared in σ.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.errors import ConvergenceError
from stcal.geometry.pose_descent import Minima, PoseStack
from stcal.geometry.rigid import Rigid
from stcal.geometry.robust import HUBER, huber_weights, robust_sigma

OUTLIER = 6.0
"""In σ, or the residuals' robust σ if that is larger: by chance one point in 6·10⁷ (Rayleigh)."""
MAX_OUTLIER_SHARE = 1 / 3
"""Of what was seen: beyond it, the rest is no majority that could be believed."""
SAME = 1.0
"""Minima nearer than this, in σ, are one: its covariance covers both."""
WIDER = 1.1
"""Residuals whose robust σ is larger by this factor change what Huber's loss damps: the descent is repeated."""
MAX_SIGMA_RAD = 0.5
"""A rotation whose σ is larger is none: linear propagation says nothing any more."""
Descend = Callable[[PoseStack, float], Minima]
"""From h poses and the limit of Huber's loss, in σ, to the h minima next to them."""


@dataclass(frozen=True, slots=True, eq=False)
class PlaneMinima:
    """The distinct minima by single points.

    ``minima`` : one or two, the better one first; ``robust_sigma`` : of the residuals, in units of their stated σ, 1 or
    more.
    """

    minima: Minima
    robust_sigma: float

    @property
    def outlier_limit(self) -> float:
        """Length, in stated σ, of a residual that contradicts the others."""
        return OUTLIER * self.robust_sigma


def mirrored(poses: PoseStack, target_from_plane: Rigid) -> PoseStack:
    """h poses camera_from_target mirrored at the line of sight to the plane's origin: its depths change their sign."""
    middle = poses.rotation @ target_from_plane.translation + poses.translation
    sight = middle / np.linalg.norm(middle, axis=1, keepdims=True)
    mirror = np.eye(3) - 2 * sight[:, :, None] * sight[:, None, :]
    axis = target_from_plane.rotation[:, 2]
    rotation = mirror @ poses.rotation @ (np.eye(3) - 2 * np.outer(axis, axis))
    return PoseStack(rotation, middle - rotation @ target_from_plane.translation)


def step_between(pose: PoseStack, second: PoseStack) -> np.ndarray:
    """(6,) left perturbation, rad and mm, that leads from the one pose to the second, stacks of one each."""
    turn = Rotation.from_matrix(second.rotation[0] @ pose.rotation[0].T).as_rotvec()
    return np.concatenate([turn, second.translation[0] - pose.translation[0]])


def distinct(poses: PoseStack, normal: np.ndarray, robust_sigma: float = 1.0) -> bool:
    """Whether the second of two poses is another than the first.

    Parameters
    ----------
    poses : two of them
    normal : (6, 6) normal matrix of the first, by the stated σ
    robust_sigma : of the residuals, in stated σ. Where it is more than 1, the stated σ are too small, and so is the
        pose's: two minima that the residuals themselves cannot tell apart would count as two.
    """
    step = step_between(poses[[0]], poses[[1]])
    return bool(step @ normal @ step > (SAME * robust_sigma) ** 2)


def two_minima(
    descend_near: Callable[[PoseStack], Descend],
    start: PoseStack,
    target_from_plane: Rigid,
    failure: str,
    planar: bool = True,
) -> PlaneMinima:
    """One or two distinct minima of the residuals of single points.

    Parameters
    ----------
    descend_near : the descent with residuals whitened near a stack of one pose, the same for both minima, so that
        their costs compare
    start : one pose, to which its mirror image is added, or two, the likelier one first
    target_from_plane : origin in the middle of the points, Z the plane's normal
    failure : what a ConvergenceError says
    planar : whether all points lie in the plane. If so, and the two starts end in one minimum, they may have been on
        one side, and the minimum's own mirror image is tried.

    Raises
    ------
    ConvergenceError
        No minimum is reached.
    """
    poses = start.plus(mirrored(start, target_from_plane)) if len(start) == 1 else start
    sigma = 1.0
    for _ in range(2):  # the second time with the residuals' robust σ, if that is larger
        descend = descend_near(poses[[0]])
        found = _ordered(descend(poses, HUBER * sigma))
        poses = found.poses
        wider = robust_sigma(found.length[0], 2)
        if wider <= WIDER * sigma:
            break
        sigma = wider
    if not np.isfinite(found.cost[0]) or not found.settled[0]:
        raise ConvergenceError("E-NO-MINIMUM", failure)
    two = distinct(found.poses, found.normal[0], sigma)
    if planar and not two:
        again = descend(mirrored(found.poses[[0]], target_from_plane), HUBER * sigma)
        found = _ordered(found.rows([0]).plus(again))
        two = distinct(found.poses, found.normal[0], sigma)
    return PlaneMinima(found if two and np.isfinite(found.cost[1]) else found.rows([0]), sigma)


def _ordered(found: Minima) -> Minima:
    return found.rows(np.argsort(found.cost, kind="stable"))


def weights_of(length: np.ndarray) -> np.ndarray:
    """Huber's weights of points, same shape, whose residuals have these lengths in σ."""
    return huber_weights(length, HUBER)


def deciding_delta(flip_odds: float, sigma_margin: float, variance_factor: float) -> float:
    """Δχ² of the second solution that decides for the first: −2 ln of the odds, times the variance factor to allow for.

    Parameters
    ----------
    flip_odds : at most these odds of the second solution, for Gaussian errors
    sigma_margin : by which all σ may be too small without that becoming untrue
    variance_factor : χ² over redundancy, which counts where it is more than the margin's square
    """
    return -2 * float(np.log(flip_odds)) * max(sigma_margin**2, variance_factor)


def covariance_of_both(covariance: np.ndarray, away: np.ndarray, delta_chi2: float) -> np.ndarray:
    """Second moment (6, 6) about a pose when the second solution, ``away`` (6,) from it, may hold too."""
    odds = np.exp(-delta_chi2 / 2)
    return covariance + odds / (1 + odds) * np.outer(away, away)


@dataclass(frozen=True, slots=True, eq=False)
class Weighed:
    """One step of generalised least squares from h poses: the ``poses`` after it, ``residual`` (h, n, 2) that it leaves
    to first order, ``normal`` (h, 6, 6), ``chi2`` (h,); ``moved2`` : (h,) square of the step in σ."""

    poses: PoseStack
    residual: np.ndarray
    normal: np.ndarray
    chi2: np.ndarray
    moved2: np.ndarray


def weigh(residual: np.ndarray, by_pose: np.ndarray, covariance: np.ndarray, poses: PoseStack) -> Weighed:
    """The step that weighs the points of h poses by the whole covariance of their residuals.

    Parameters
    ----------
    residual : (h, n, 2) measured minus projected
    by_pose : (h, n, 2, 6) minus their derivative by left perturbations
    covariance : (h, 2n, 2n)
    """
    h = len(residual)
    r, a = residual.reshape(h, -1, 1), by_pose.reshape(h, -1, 6)
    solved = np.linalg.solve(covariance, np.concatenate([a, r], axis=2))
    back = np.swapaxes(a, 1, 2) @ solved
    normal, right = back[..., :6], back[..., 6:]
    step = np.linalg.solve(normal, right)[..., 0]
    square = (np.swapaxes(r, 1, 2) @ solved[..., 6:])[:, 0, 0]
    gain = (step * right[..., 0]).sum(1)
    left = residual - (a @ step[..., None]).reshape(residual.shape)
    return Weighed(poses.moved(step), left, normal, square - gain, gain)
