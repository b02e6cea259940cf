"""Problem of a target's pose in one image, and the descent to the poses that fit it best, for several poses at once."""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from stcal.geometry import pose_descent
from stcal.geometry.plane_poses import Descend
from stcal.geometry.pose_descent import Minima, Normal, PoseStack, block_diagonal
from stcal.sfm.data.projection import CircleImages, project_circles

SETTLED = 1e-4
"""Decrease of χ² below which the descent ends. A smaller step moves the pose by less than a hundredth of its σ, and the
two steps that weigh the centres anew are still to come. A second solution with a large χ² needs no better accuracy."""
HOPELESS = 500.0
"""Excess in χ² that no weights can make up for."""


@dataclass(frozen=True, slots=True, eq=False)
class PoseProblem:
    """n circles with their measured centres, and what is known of everything else. The lens is taken out.

    ``xyz``, ``normal`` : (n, 3) target frame; ``radius`` : (n,); ``centre`` : (n, 2) centres of the ellipses,
    normalised coordinates; ``px_by_centre`` : (n, 2, 2) Jacobian of the lens; ``noise`` : (n, 2, 2) covariance of
    ``centre``; ``by_camera`` : (n, 2, q) derivative of ``centre`` by the intrinsics, q = 0 if they are held fixed;
    ``prior`` : (q, q) covariance of the intrinsics; ``shape`` : (3n, 3n) mm² covariance of the circles.
    """

    xyz: np.ndarray
    normal: np.ndarray
    radius: np.ndarray
    centre: np.ndarray
    px_by_centre: np.ndarray
    noise: np.ndarray
    by_camera: np.ndarray
    prior: np.ndarray
    shape: np.ndarray

    def seen(self, poses: PoseStack) -> tuple[np.ndarray, CircleImages]:
        """Returns, for h poses, measured minus projected centres (h, n, 2), and the projections with their
        derivatives."""
        image = project_circles(self.xyz, self.normal, self.radius, poses.rotation, poses.translation)
        return self.centre - image.centre, image

    def in_px(self, residual: np.ndarray) -> np.ndarray:
        """Returns residuals (n, 2) in the distorted image, px."""
        return (self.px_by_centre @ residual[..., None])[..., 0]

    def select(self, keep: np.ndarray) -> "PoseProblem":
        """Returns the problem of the selected circles only."""
        rows = (3 * keep[:, None] + np.arange(3)).ravel()
        fields_by_circle = ("xyz", "normal", "radius", "centre", "px_by_centre", "noise", "by_camera")
        return replace(
            self, **{name: getattr(self, name)[keep] for name in fields_by_circle}, shape=self.shape[np.ix_(rows, rows)]
        )


def covariance_of_centres(problem: PoseProblem, image: CircleImages, noise: np.ndarray) -> np.ndarray:
    """Returns the joint covariance (h, 2n, 2n) of all centres from noise (h, n, 2, 2), the target's circles and the
    intrinsics."""
    by_circle = block_diagonal(image.by_circle)
    full = block_diagonal(noise) + by_circle @ problem.shape @ np.swapaxes(by_circle, 1, 2)
    by_camera = problem.by_camera.reshape(full.shape[-1], -1)
    return full + by_camera @ problem.prior @ by_camera.T


def descent_near(problem: PoseProblem, pose: PoseStack) -> Descend:
    """Returns the descent near a pose, with residuals whitened centre by centre.

    The σ of a centre are those of its noise and of its own circle.
    """
    by_circle = problem.seen(pose)[1].by_circle
    n = len(problem.xyz)
    covariance_by_circle = problem.shape.reshape(n, 3, n, 3)[np.arange(n), :, np.arange(n)]
    root = np.linalg.inv(
        np.linalg.cholesky(problem.noise + by_circle @ covariance_by_circle @ np.swapaxes(by_circle, -1, -2))
    )
    return partial(_descend, problem, block_diagonal(root))


def _descend(problem: PoseProblem, whiten: np.ndarray, poses: PoseStack, huber: float) -> Minima:
    """Returns the minima next to h poses, with Huber's loss on residuals whitened by (h or 1, 2n, 2n)."""
    h, n = len(poses), len(problem.xyz)

    def evaluate(poses: PoseStack) -> Normal:
        residual, image = problem.seen(poses)
        r = (whiten @ residual.reshape(h, 2 * n, 1)).reshape(h, n, 2)
        return Normal.of(r, whiten @ image.by_pose.reshape(h, 2 * n, 6), np.all(image.depth > 0, axis=1), huber)

    return pose_descent.descend(evaluate, poses, SETTLED, HOPELESS)
