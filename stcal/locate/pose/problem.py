"""What corners of a planar target say of its pose, and the descent to the poses that fit them best, several at once."""

from dataclasses import dataclass
from functools import partial

import numpy as np

from stcal.geometry import pose_descent
from stcal.geometry.least_squares import NormalEquations, minimise
from stcal.geometry.plane_poses import Descend, Weighed, weigh
from stcal.geometry.pose_descent import Minima, Normal, PoseStack, block_diagonal, select_rows
from stcal.geometry.rigid import Poses, skew

SETTLED = 1e-5
"""A step that lowers χ² by less moves the pose by less than a hundredth of its σ."""
WEIGH_STEPS, WEIGHED = 60, 1e-6
"""A step of under a thousandth of σ is the last. What many corners share, the intrinsics say, can move a pose by many
σ of its single corners."""


@dataclass(frozen=True, slots=True, eq=False)
class PlanarProblem:
    """n corners of a plane, what was measured of them, and what is known of everything else; the lens taken out.

    ``xy`` : (n, 2) mm in {obj}; ``seen`` : (n, 2) normalised coordinates; ``noise`` : (n, 2, 2) their covariance;
    ``px_by_seen`` : (n, 2, 2) jacobian of the lens; ``shape`` : (2n, 2n) mm² covariance of ``xy``; ``common`` :
    (n, 2, q) derivative of ``seen`` by what several corners share, the edges of each tag and the intrinsics, where
    these are not held, and ``prior`` : (q, q) its covariance.
    """

    xy: np.ndarray
    seen: np.ndarray
    noise: np.ndarray
    px_by_seen: np.ndarray
    shape: np.ndarray
    common: np.ndarray
    prior: np.ndarray

    def select(self, keep: np.ndarray) -> "PlanarProblem":
        """Those corners only."""
        rows = (2 * keep[:, None] + np.arange(2)).ravel()
        own = (self.xy[keep], self.seen[keep], self.noise[keep], self.px_by_seen[keep])
        return PlanarProblem(*own, self.shape[np.ix_(rows, rows)], self.common[keep], self.prior)

    def in_px(self, residual: np.ndarray) -> np.ndarray:
        """Residuals (n, 2) in the image as it is, px."""
        return (self.px_by_seen @ residual[..., None])[..., 0]


@dataclass(frozen=True, slots=True, eq=False)
class ProjectedCorners:
    """h poses and what they show: ``residual`` (h, n, 2) measured minus projected; its negative derivatives ``by_pose``
    (h, n, 2, 6) and ``by_corner`` (h, n, 2, 2); ``before`` : (h,) whether all corners lie before the camera."""

    poses: Poses | PoseStack
    residual: np.ndarray
    by_pose: np.ndarray
    by_corner: np.ndarray
    before: np.ndarray


def project(problem: PlanarProblem, poses: Poses | PoseStack) -> ProjectedCorners:
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
    return ProjectedCorners(poses, problem.seen - uv, by_pose, by_point @ poses.rotation[:, None, :, :2], before)


def descent_near(problem: PlanarProblem, pose: PoseStack) -> Descend:
    """The descent with each corner's residual, near a pose, one of σ 1: noise, what corners share, and the layout's."""
    by_corner = project(problem, pose).by_corner[0]
    n = len(problem.xy)
    own = problem.shape.reshape(n, 2, n, 2)[np.arange(n), :, np.arange(n)]
    shared = problem.common @ problem.prior @ np.swapaxes(problem.common, 1, 2)
    full = problem.noise + shared + by_corner @ own @ np.swapaxes(by_corner, 1, 2)
    return partial(_descend, problem, np.linalg.inv(np.linalg.cholesky(full)))


def _descend(problem: PlanarProblem, whiten: np.ndarray, poses: PoseStack, huber: float) -> Minima:
    """The minima next to h poses, Huber's loss on the residuals whitened by (n, 2, 2)."""

    def evaluate(poses: PoseStack) -> Normal:
        view = project(problem, poses)
        return Normal.of((whiten @ view.residual[..., None])[..., 0], whiten @ view.by_pose, view.before, huber)

    return pose_descent.descend(evaluate, poses, SETTLED)


def weighed(problem: PlanarProblem, pose: PoseStack, weights: np.ndarray) -> Weighed:
    """A pose by the whole covariance of its corners: the image's noise (over Huber's ``weights`` (n,)), what corners
    share, and the layout's covariance add up."""
    noise = block_diagonal(problem.noise / weights[:, None, None])
    common = problem.common.reshape(2 * len(problem.xy), -1)
    noise += common @ problem.prior @ common.T
    by_corner = block_diagonal(project(problem, pose).by_corner[0])
    full = (noise + by_corner @ problem.shape @ by_corner.T)[None]

    def linearise(poses: PoseStack) -> NormalEquations:
        view = project(problem, poses)
        r, a = view.residual.reshape(1, -1, 1), view.by_pose.reshape(1, -1, 6)
        solved = np.linalg.solve(full, np.concatenate([a, r], axis=2))
        back = np.swapaxes(a, 1, 2) @ solved
        cost = (np.swapaxes(r, 1, 2) @ solved[..., 6:])[:, 0, 0]
        return NormalEquations(np.where(view.before, cost, np.inf), back[..., :6], -back[..., 6])

    # A second solution that is far worse may end anywhere near: what it says is that the first one is better.
    found = minimise(
        pose, linearise, PoseStack.moved, select=select_rows, damping=1e-6, least_gain=WEIGHED, max_steps=WEIGH_STEPS
    ).state
    view = project(problem, found)
    return weigh(view.residual, view.by_pose, full, found)
