"""What one image says of a target's pose, and the descent to the poses that fit it best, several at once."""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from stcal.geometry import pose_descent
from stcal.geometry.plane_poses import Descend
from stcal.geometry.pose_descent import Minima, Normal, PoseStack, block_diagonal
from stcal.sfm.data.projection import CircleImages, project_circles

SETTLED = 1e-4
"""A step that lowers χ² by less moves the pose by less than a hundredth of its σ, and the two steps that weigh the
centres anew are still to come; a second solution with a large χ² need not be better known than that, relatively."""
HOPELESS = 500.0
"""In χ²: what whatever weights cannot make up for."""


@dataclass(frozen=True, slots=True, eq=False)
class PoseProblem:
    """n circles, what was measured of them, and what is known of everything else; the lens taken out.

    ``xyz``, ``normal`` : (n, 3) target frame; ``radius`` : (n,); ``centre`` : (n, 2) of the ellipses, normalised
    coordinates; ``px_by_centre`` : (n, 2, 2) jacobian of the lens; ``noise`` : (n, 2, 2) covariance of ``centre``;
    ``by_camera`` : (n, 2, q) derivative of ``centre`` by the intrinsics, q = 0 where they are held, ``prior`` : (q, q)
    their covariance; ``shape`` : (3n, 3n) mm² covariance of the circles.
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
        """Measured minus projected (h, n, 2), and the projections with their derivatives, for h poses."""
        image = project_circles(self.xyz, self.normal, self.radius, poses.rotation, poses.translation)
        return self.centre - image.centre, image

    def in_px(self, residual: np.ndarray) -> np.ndarray:
        """Residuals (n, 2) in the image as it is, px."""
        return (self.px_by_centre @ residual[..., None])[..., 0]

    def select(self, keep: np.ndarray) -> "PoseProblem":
        """Those circles only."""
        rows = (3 * keep[:, None] + np.arange(3)).ravel()
        own = ("xyz", "normal", "radius", "centre", "px_by_centre", "noise", "by_camera")
        return replace(self, **{name: getattr(self, name)[keep] for name in own}, shape=self.shape[np.ix_(rows, rows)])


def covariance_of_centres(problem: PoseProblem, image: CircleImages, noise: np.ndarray) -> np.ndarray:
    """(h, 2n, 2n) of all centres together: noise (h, n, 2, 2), the target's circles, and the intrinsics."""
    by_circle = block_diagonal(image.by_circle)
    full = block_diagonal(noise) + by_circle @ problem.shape @ np.swapaxes(by_circle, 1, 2)
    by_camera = problem.by_camera.reshape(full.shape[-1], -1)
    return full + by_camera @ problem.prior @ by_camera.T


def descent_near(problem: PoseProblem, pose: PoseStack) -> Descend:
    """The descent with each centre's residual, near a pose, one of σ 1: noise and its own circle's σ."""
    by_circle = problem.seen(pose)[1].by_circle
    n = len(problem.xyz)
    own = problem.shape.reshape(n, 3, n, 3)[np.arange(n), :, np.arange(n)]
    root = np.linalg.inv(np.linalg.cholesky(problem.noise + by_circle @ own @ np.swapaxes(by_circle, -1, -2)))
    return partial(_descend, problem, block_diagonal(root))


def _descend(problem: PoseProblem, whiten: np.ndarray, poses: PoseStack, huber: float) -> Minima:
    """The minima next to h poses, Huber's loss on the residuals whitened by (h or 1, 2n, 2n)."""
    h, n = len(poses), len(problem.xyz)

    def evaluate(poses: PoseStack) -> Normal:
        residual, image = problem.seen(poses)
        r = (whiten @ residual.reshape(h, 2 * n, 1)).reshape(h, n, 2)
        return Normal.of(r, whiten @ image.by_pose.reshape(h, 2 * n, 6), np.all(image.depth > 0, axis=1), huber)

    return pose_descent.descend(evaluate, poses, SETTLED, HOPELESS)
