"""What corners of a planar target say of its pose, and the descent to the poses that fit them best, several at once."""

from dataclasses import dataclass

import numpy as np

from stcal.geometry import pose_descent
from stcal.geometry.pose_descent import Minima, Normal, block_diagonal
from stcal.geometry.rigid import Poses, Rigid, skew

HUBER = 3.0
"""In σ of a corner: one honest corner in ninety is beyond."""
SETTLED = 1e-5
"""A step that lowers χ² by less moves the pose by less than a hundredth of its σ."""
WEIGH_STEPS, WEIGHED = 10, 1e-6
"""A step of under a thousandth of σ is the last. What many corners share, the intrinsics say, can move a pose by many
σ of its single corners."""


@dataclass(frozen=True, slots=True, eq=False)
class PlanarProblem:
    """n corners of a plane, what was measured of them, and what is known of everything else; the lens taken out.

    ``xy`` : (n, 2) mm in {obj}; ``seen`` : (n, 2) normalised coordinates; ``noise`` : (n, 2, 2) their covariance;
    ``slope`` : (n, 2, 2) px by those; ``shape`` : (2n, 2n) mm² covariance of ``xy``; ``common`` : (n, 2, q)
    derivative of ``seen`` by what several corners share, the edges of each tag and the intrinsics, where these are not
    held, and ``prior`` : (q, q) its covariance.
    """

    xy: np.ndarray
    seen: np.ndarray
    noise: np.ndarray
    slope: np.ndarray
    shape: np.ndarray
    common: np.ndarray
    prior: np.ndarray

    def select(self, keep: np.ndarray) -> "PlanarProblem":
        """Those corners only."""
        rows = (2 * keep[:, None] + np.arange(2)).ravel()
        own = (self.xy[keep], self.seen[keep], self.noise[keep], self.slope[keep])
        return PlanarProblem(*own, self.shape[np.ix_(rows, rows)], self.common[keep], self.prior)

    def in_px(self, residual: np.ndarray) -> np.ndarray:
        """Residuals (n, 2) in the image as it is, px."""
        return (self.slope @ residual[..., None])[..., 0]


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """h poses and what they show: ``residual`` (h, n, 2) measured minus projected; its negative derivatives ``by_pose``
    (h, n, 2, 6) and ``by_corner`` (h, n, 2, 2); ``before`` : (h,) whether all corners lie before the camera."""

    poses: Poses
    residual: np.ndarray
    by_pose: np.ndarray
    by_corner: np.ndarray
    before: np.ndarray


def project(problem: PlanarProblem, poses: Poses) -> Views:
    """Residuals of h poses, and their derivatives."""
    turned = np.einsum("hij,nj->hni", poses.rotation[:, :, :2], problem.xy)
    at = turned + poses.translation[:, None]
    depth = at[..., 2]
    before = (depth > 0).all(1)
    depth = np.where(np.abs(depth) > 1e-9, depth, 1e-9)
    uv = at[..., :2] / depth[..., None]
    by_point = np.zeros((*uv.shape, 3))
    by_point[..., 0, 0] = by_point[..., 1, 1] = 1 / depth
    by_point[..., 2] = -uv / depth[..., None]
    by_pose = np.concatenate([-by_point @ skew(turned), by_point], axis=-1)
    return Views(poses, problem.seen - uv, by_pose, by_point @ poses.rotation[:, None, :, :2], before)


def own_whitening(problem: PlanarProblem, pose: Poses) -> np.ndarray:
    """(n, 2, 2) that make each corner's residual one of σ 1, the others apart; near ``pose``, one of them."""
    by_corner = project(problem, pose).by_corner[0]
    n = len(problem.xy)
    own = problem.shape.reshape(n, 2, n, 2)[np.arange(n), :, np.arange(n)]
    shared = problem.common @ problem.prior @ np.swapaxes(problem.common, 1, 2)
    return np.linalg.inv(np.linalg.cholesky(problem.noise + shared + by_corner @ own @ np.swapaxes(by_corner, 1, 2)))


def descend(problem: PlanarProblem, poses: Poses, whiten: np.ndarray, huber: float = HUBER) -> Minima:
    """The minima next to h poses, Huber's loss on the residuals whitened by (n, 2, 2)."""

    def evaluate(poses: Poses) -> Normal:
        view = project(problem, poses)
        return Normal.of((whiten @ view.residual[..., None])[..., 0], whiten @ view.by_pose, view.before, huber)

    return pose_descent.descend(evaluate, poses, SETTLED)


@dataclass(frozen=True, slots=True, eq=False)
class Weighed:
    """A pose by the whole covariance of its corners: ``residual`` (n, 2) that it leaves; ``chi2``; ``covariance``
    (6, 6)."""

    pose: Poses
    residual: np.ndarray
    chi2: float
    covariance: np.ndarray


def weigh(problem: PlanarProblem, pose: Poses, weights: np.ndarray) -> Weighed:
    """Generalised least squares from one pose: the image's noise (over Huber's ``weights`` (n,)), what corners share
    and the layout's covariance add up."""
    noise = block_diagonal(problem.noise / weights[:, None, None])
    common = problem.common.reshape(2 * len(problem.xy), -1)
    noise += common @ problem.prior @ common.T
    by_corner = block_diagonal(project(problem, pose).by_corner[0])
    full = noise + by_corner @ problem.shape @ by_corner.T
    for _ in range(WEIGH_STEPS):
        view = project(problem, pose)
        a, r = view.by_pose[0].reshape(-1, 6), view.residual[0].ravel()
        solved = np.linalg.solve(full, np.column_stack([a, r]))
        normal = a.T @ solved[:, :6]
        step = np.linalg.solve(normal, a.T @ solved[:, 6])
        pose = pose.moved(step[None])
        if step @ normal @ step < WEIGHED:
            break
    left = r - a @ step
    chi2 = float(left @ (solved[:, 6] - solved[:, :6] @ step))
    covariance = np.linalg.inv(normal)
    return Weighed(pose, left.reshape(-1, 2), chi2, (covariance + covariance.T) / 2)


def mirrored(pose: Rigid, middle_obj: np.ndarray) -> Rigid:
    """Mirrored at the line of sight to a point of the plane (2,): the plane's depths about it change their sign."""
    point = np.append(middle_obj, 0.0)
    middle = pose @ point
    sight = middle / np.linalg.norm(middle)
    mirror = np.eye(3) - 2 * np.outer(sight, sight)
    rotation = mirror @ pose.rotation @ np.diag([1.0, 1.0, -1.0])
    return Rigid(rotation, middle - rotation @ point)
