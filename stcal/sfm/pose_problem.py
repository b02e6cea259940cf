"""What one image says of a target's pose, and the descent to the poses that fit it best, several at once."""

from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.geometry.rigid import Rigid
from stcal.sfm.circle_projection import CircleImages, project_circles

MAX_STEPS = 60
SETTLED = 1e-4
"""A step that lowers χ² by less moves the pose by less than a hundredth of its σ, and the two steps that weigh the
centres anew are still to come; a rival with a large χ² need not be better known than that, relatively."""
ACCEPTED = 1e-2
"""What is still settled after all steps: a tenth of σ. In a flat valley steps are many, and short."""
HOPELESS = 500.0
SLOW = 0.01
"""A rival worse by so much in χ², which a step promises to improve by less than this share, is not followed further:
with large residuals the last steps are many, and short."""


@dataclass(frozen=True, slots=True, eq=False)
class PoseStack:
    """h poses: (h, 3, 3) and (h, 3)."""

    rotation: np.ndarray
    translation: np.ndarray

    def moved(self, step: np.ndarray) -> "PoseStack":
        """After left perturbations (h, 6)."""
        turn = Rotation.from_rotvec(step[:, :3]).as_matrix()
        return PoseStack(turn @ self.rotation, self.translation + step[:, 3:])

    def __getitem__(self, rows) -> "PoseStack":
        return PoseStack(self.rotation[rows], self.translation[rows])

    def plus(self, other: "PoseStack") -> "PoseStack":
        return PoseStack(
            np.concatenate([self.rotation, other.rotation]), np.vstack([self.translation, other.translation])
        )


@dataclass(frozen=True, slots=True, eq=False)
class PoseProblem:
    """n circles, what was measured of them, and what is known of everything else; the lens taken out.

    ``xyz``, ``normal`` : (n, 3) target frame; ``radius`` : (n,); ``centre`` : (n, 2) of the ellipses, normalised
    coordinates; ``slope`` : (n, 2, 2) px by those; ``noise`` : (n, 2, 2) covariance of ``centre``; ``by_camera`` :
    (n, 2, q) derivative of ``centre`` by the intrinsics, q = 0 where they are held, ``prior`` : (q, q) their
    covariance; ``shape`` : (3n, 3n) mm² covariance of the circles.
    """

    xyz: np.ndarray
    normal: np.ndarray
    radius: np.ndarray
    centre: np.ndarray
    slope: np.ndarray
    noise: np.ndarray
    by_camera: np.ndarray
    prior: np.ndarray
    shape: np.ndarray

    def seen(self, poses: "PoseStack") -> tuple[np.ndarray, CircleImages]:
        """Measured minus projected (h, n, 2), and the projections with their derivatives, for h poses."""
        image = project_circles(self.xyz, self.normal, self.radius, poses.rotation, poses.translation)
        return self.centre - image.centre, image

    def in_px(self, residual: np.ndarray) -> np.ndarray:
        """Residuals (n, 2) in the image as it is, px."""
        return (self.slope @ residual[..., None])[..., 0]

    def select(self, keep: np.ndarray) -> "PoseProblem":
        """Those circles only."""
        rows = (3 * keep[:, None] + np.arange(3)).ravel()
        own = (self.xyz, self.normal, self.radius, self.centre, self.slope, self.noise, self.by_camera)
        return PoseProblem(*(a[keep] for a in own), self.prior, self.shape[np.ix_(rows, rows)])


@dataclass(frozen=True, slots=True, eq=False)
class Minima:
    """h poses at their minima: ``cost`` (h,), ``normal`` (h, 6, 6), ``length`` (h, n) residuals in σ, ``settled``."""

    poses: PoseStack
    cost: np.ndarray
    normal: np.ndarray
    length: np.ndarray
    settled: np.ndarray


def rigid_of(poses: PoseStack, row: int) -> Rigid:
    """camera_from_target of one of them."""
    return Rigid(poses.rotation[row], poses.translation[row])


def step_between(pose: PoseStack, other: PoseStack) -> np.ndarray:
    """(6,) left perturbation that leads from the one pose to the other, stacks of one each."""
    turn = Rotation.from_matrix(other.rotation[0] @ pose.rotation[0].T).as_rotvec()
    return np.concatenate([turn, other.translation[0] - pose.translation[0]])


def block_diagonal(blocks: np.ndarray) -> np.ndarray:
    """(h, an, bn) of (h, n, a, b)."""
    h, n, a, b = blocks.shape
    full = np.zeros((h, n, a, n, b))
    full[:, np.arange(n), :, np.arange(n)] = np.moveaxis(blocks, 1, 0)
    return full.reshape(h, n * a, n * b)


def covariance_of_centres(problem: PoseProblem, image: CircleImages, noise: np.ndarray) -> np.ndarray:
    """(h, 2n, 2n) of all centres together: noise (h, n, 2, 2), the target's circles, and the intrinsics."""
    by_circle = block_diagonal(image.by_circle)
    full = block_diagonal(noise) + by_circle @ problem.shape @ np.swapaxes(by_circle, 1, 2)
    by_camera = problem.by_camera.reshape(full.shape[-1], -1)
    return full + by_camera @ problem.prior @ by_camera.T


def whitening_by_centre(problem: PoseProblem, poses: PoseStack) -> np.ndarray:
    """(h, 2n, 2n) that make each centre's residual one of σ 1, the others apart: noise and its own circle's σ."""
    by_circle = problem.seen(poses)[1].by_circle
    n = len(problem.xyz)
    own = problem.shape.reshape(n, 3, n, 3)[np.arange(n), :, np.arange(n)]
    root = np.linalg.inv(np.linalg.cholesky(problem.noise + by_circle @ own @ np.swapaxes(by_circle, -1, -2)))
    return block_diagonal(root)


def descend(problem: PoseProblem, poses: PoseStack, whiten: np.ndarray, huber: float) -> Minima:
    """Levenberg–Marquardt from h poses at once, Huber's loss on the lengths of the whitened residuals."""
    h = len(poses.rotation)
    evaluate = partial(_evaluate, problem, whiten, huber)
    cost, normal, right, length = evaluate(poses)
    damping = np.full(h, 1e-6)
    settled = np.zeros(h, bool)
    for _ in range(MAX_STEPS):
        scale = np.einsum("hii->hi", normal)
        damped = normal + (damping[:, None] * scale)[:, :, None] * np.eye(6)
        step = np.linalg.solve(damped, right[..., None])[..., 0]
        gain, behind = (step * right).sum(1), cost - cost.min()
        settled |= (gain < SETTLED * np.maximum(cost, 1)) | ((behind > HOPELESS) & (gain < SLOW * behind))
        if settled.all():
            break
        step[settled] = 0
        trial = poses.moved(step)
        new = evaluate(trial)
        better = (new[0] <= cost) & ~settled
        take = better[:, None, None]
        poses = PoseStack(
            np.where(take, trial.rotation, poses.rotation),
            np.where(better[:, None], trial.translation, poses.translation),
        )
        cost, length = np.where(better, new[0], cost), np.where(better[:, None], new[3], length)
        normal, right = np.where(take, new[1], normal), np.where(better[:, None], new[2], right)
        damping = np.where(better, damping / 10, np.minimum(np.maximum(10 * damping, 1e-3), 1e8))
    return Minima(poses, cost, normal, length, settled | (gain < ACCEPTED))


def _evaluate(problem: PoseProblem, whiten: np.ndarray, huber: float, poses: PoseStack):
    """Cost (h,), normal matrix (h, 6, 6), right-hand side (h, 6) and lengths (h, n) of the whitened residuals."""
    h, n = len(poses.rotation), len(problem.xyz)
    residual, image = problem.seen(poses)
    r = (whiten @ residual.reshape(h, 2 * n, 1))[..., 0]
    a = whiten @ image.by_pose.reshape(h, 2 * n, 6)
    length = np.sqrt((r.reshape(h, n, 2) ** 2).sum(2))
    short = np.minimum(length, huber)
    cost = np.where((image.depth > 0).all(1), (short * (2 * length - short)).sum(1), np.inf)
    weighted = a * np.repeat(short / np.maximum(length, 1e-12), 2, axis=1)[..., None]
    back = np.swapaxes(weighted, 1, 2)
    return cost, back @ a, (back @ r[..., None])[..., 0], length
