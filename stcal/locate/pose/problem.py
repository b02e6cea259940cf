"""Residuals of a planar target's corners, and the descent to the poses that fit them best, several poses at once."""

from dataclasses import dataclass
from functools import partial

import numpy as np

from stcal.geometry import pose_descent
from stcal.geometry.least_squares import NormalEquations, minimise
from stcal.geometry.plane_poses import Descend, Weighed, weigh
from stcal.geometry.pose_descent import Minima, Normal, PoseStack, block_diagonal, select_rows
from stcal.geometry.rigid import Poses, skew

SETTLED = 1e-5
"""Decrease of χ² at which the descent ends. A step that lowers χ² by less moves the pose by less than σ/100."""
WEIGH_STEPS, WEIGHED = 60, 1e-6
"""Largest number of steps, and the least decrease of χ²: a step of less than σ/1000 is the last. Errors that many
corners share, such as those of the intrinsics, can move a pose by many σ due to single corners."""


@dataclass(frozen=True, slots=True, eq=False)
class PlanarProblem:
    """Measurements of n corners of a plane with their noise model, in normalised coordinates without distortion.

    ``xy`` : (n, 2) corners in {obj}, mm; ``seen`` : (n, 2) their normalised coordinates; ``noise`` : (n, 2, 2)
    covariance of ``seen``; ``px_by_seen`` : (n, 2, 2) jacobian of the lens; ``shape`` : (2n, 2n) covariance of ``xy``,
    mm²; ``common`` : (n, 2, q) derivative of ``seen`` by parameters that several corners share: shifts of each tag's
    edges and of each tag, and the intrinsics if they are not exact; ``prior`` : (q, q) covariance of these parameters.
    """

    xy: np.ndarray
    seen: np.ndarray
    noise: np.ndarray
    px_by_seen: np.ndarray
    shape: np.ndarray
    common: np.ndarray
    prior: np.ndarray

    def select(self, keep: np.ndarray) -> "PlanarProblem":
        """Returns the selected corners."""
        rows = (2 * keep[:, None] + np.arange(2)).ravel()
        points = (self.xy[keep], self.seen[keep], self.noise[keep], self.px_by_seen[keep])
        return PlanarProblem(*points, self.shape[np.ix_(rows, rows)], self.common[keep], self.prior)

    def in_px(self, residual: np.ndarray) -> np.ndarray:
        """Returns the residuals (n, 2) in the image with distortion, px."""
        return (self.px_by_seen @ residual[..., None])[..., 0]


@dataclass(frozen=True, slots=True, eq=False)
class ProjectedCorners:
    """Residuals of h poses.

    ``residual`` : (h, n, 2) measured minus projected; ``by_pose`` : (h, n, 2, 6) and ``by_corner`` : (h, n, 2, 2) its
    negative derivatives; ``before`` : (h,) whether all corners are in front of the camera.
    """

    poses: Poses | PoseStack
    residual: np.ndarray
    by_pose: np.ndarray
    by_corner: np.ndarray
    before: np.ndarray


def project(problem: PlanarProblem, poses: Poses | PoseStack) -> ProjectedCorners:
    """Returns the residuals of h poses, and their derivatives."""
    turned = np.einsum("hij,nj->hni", poses.rotation[:, :, :2], problem.xy)
    xyz = turned + poses.translation[:, None]
    depth = xyz[..., 2]
    before = (depth > 0).all(1)
    depth = np.where(np.abs(depth) > 1e-9, depth, 1e-9)
    uv = xyz[..., :2] / depth[..., None]
    by_point = np.zeros((*uv.shape, 3))
    by_point[..., 0, 0] = by_point[..., 1, 1] = 1 / depth
    by_point[..., 2] = -uv / depth[..., None]
    by_pose = np.concatenate([-by_point @ skew(turned), by_point], axis=-1)
    return ProjectedCorners(poses, problem.seen - uv, by_pose, by_point @ poses.rotation[:, None, :, :2], before)


def descent_near(problem: PlanarProblem, pose: PoseStack) -> Descend:
    """Returns the descent with residuals of single corners whitened near a pose by noise, shared and layout errors."""
    by_corner = project(problem, pose).by_corner[0]
    n = len(problem.xy)
    shape_of_corner = problem.shape.reshape(n, 2, n, 2)[np.arange(n), :, np.arange(n)]
    shared = problem.common @ problem.prior @ np.swapaxes(problem.common, 1, 2)
    full = problem.noise + shared + by_corner @ shape_of_corner @ np.swapaxes(by_corner, 1, 2)
    return partial(_descend, problem, np.linalg.inv(np.linalg.cholesky(full)))


def _descend(problem: PlanarProblem, whiten: np.ndarray, poses: PoseStack, huber: float) -> Minima:
    """Returns the minima next to h poses, with Huber's loss on residuals that are whitened by ``whiten`` (n, 2, 2)."""

    def evaluate(poses: PoseStack) -> Normal:
        view = project(problem, poses)
        return Normal.of((whiten @ view.residual[..., None])[..., 0], whiten @ view.by_pose, view.before, huber)

    return pose_descent.descend(evaluate, poses, SETTLED)


def weighed(problem: PlanarProblem, pose: PoseStack, weights: np.ndarray) -> Weighed:
    """Estimates a pose with the full covariance of its corners.

    The covariance is the sum of image noise (divided by Huber's ``weights`` (n,)), shared errors, and the layout's
    covariance.
    """
    noise = block_diagonal(problem.noise / weights[:, None, None])
    common = problem.common.reshape(2 * len(problem.xy), -1)
    noise += common @ problem.prior @ common.T
    by_corner = block_diagonal(project(problem, pose).by_corner[0])
    full = (noise + by_corner @ problem.shape @ by_corner.T)[None]

    def linearise(poses: PoseStack) -> NormalEquations:
        view = project(problem, poses)
        r, a = view.residual.reshape(1, -1, 1), view.by_pose.reshape(1, -1, 6)
        solved = np.linalg.solve(full, np.concatenate([a, r], axis=2))
        weighted = np.swapaxes(a, 1, 2) @ solved
        cost = (np.swapaxes(r, 1, 2) @ solved[..., 6:])[:, 0, 0]
        return NormalEquations(np.where(view.before, cost, np.inf), weighted[..., :6], -weighted[..., 6])

    # A second solution that is far worse need not converge: it only shows that the first one is better.
    minimum = minimise(
        pose, linearise, PoseStack.moved, select=select_rows, damping=1e-6, least_gain=WEIGHED, max_steps=WEIGH_STEPS
    ).state
    view = project(problem, minimum)
    return weigh(view.residual, view.by_pose, full, minimum)
