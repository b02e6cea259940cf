"""What corners of a planar target say of its pose, and the descent to the poses that fit them best, several at once."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.geometry.rigid import Poses, Rigid, skew

HUBER = 3.0
"""In σ of a corner: one honest corner in ninety is beyond."""
MAX_STEPS = 60
SETTLED = 1e-5
"""A step that lowers χ² by less moves the pose by less than a hundredth of its σ."""
WEIGH_STEPS, WEIGHED = 10, 1e-6
"""A step of under a thousandth of σ is the last. What many corners share, the intrinsics say, can move a pose by many
σ of its single corners."""
ACCEPTED = 1e-2
"""What is still settled after all steps: a tenth of σ. In a flat valley steps are many, and short."""


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


@dataclass(frozen=True, slots=True, eq=False)
class Minima:
    """h poses at their minima: ``cost`` (h,), ``normal`` (h, 6, 6), ``length`` (h, n) residuals in σ, ``settled``."""

    poses: Poses
    cost: np.ndarray
    normal: np.ndarray
    length: np.ndarray
    settled: np.ndarray


def moved(poses: Poses, step: np.ndarray) -> Poses:
    """After left perturbations (h, 6)."""
    turn = Rotation.from_rotvec(step[:, :3]).as_matrix()
    return Poses(turn @ poses.rotation, poses.translation + step[:, 3:])


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


def block_diagonal(blocks: np.ndarray) -> np.ndarray:
    """(an, bn) of (n, a, b)."""
    n, a, b = blocks.shape
    full = np.zeros((n, a, n, b))
    full[np.arange(n), :, np.arange(n)] = blocks
    return full.reshape(n * a, n * b)


def own_whitening(problem: PlanarProblem, pose: Poses) -> np.ndarray:
    """(n, 2, 2) that make each corner's residual one of σ 1, the others apart; near ``pose``, one of them."""
    by_corner = project(problem, pose).by_corner[0]
    n = len(problem.xy)
    own = problem.shape.reshape(n, 2, n, 2)[np.arange(n), :, np.arange(n)]
    shared = problem.common @ problem.prior @ np.swapaxes(problem.common, 1, 2)
    return np.linalg.inv(np.linalg.cholesky(problem.noise + shared + by_corner @ own @ np.swapaxes(by_corner, 1, 2)))


def descend(problem: PlanarProblem, poses: Poses, whiten: np.ndarray, huber: float = HUBER) -> Minima:
    """Levenberg–Marquardt from h poses at once, Huber's loss on the lengths of the whitened residuals."""
    h = len(poses)
    cost, normal, right, length = _evaluate(problem, poses, whiten, huber)
    damping, settled = np.full(h, 1e-6), np.zeros(h, bool)
    for _ in range(MAX_STEPS):
        # Metres and radians: damped by the diagonal (Marquardt), not by its mean.
        scale = np.einsum("hii->hi", normal)
        step = np.linalg.solve(normal + (damping[:, None] * scale)[:, :, None] * np.eye(6), right[..., None])[..., 0]
        gain = (step * right).sum(1)
        settled |= gain < SETTLED * np.maximum(cost, 1)
        if settled.all():
            break
        step[settled] = 0
        trial = moved(poses, step)
        new = _evaluate(problem, trial, whiten, huber)
        better = (new[0] <= cost) & ~settled
        take = better[:, None, None]
        poses = Poses(
            np.where(take, trial.rotation, poses.rotation),
            np.where(better[:, None], trial.translation, poses.translation),
        )
        cost, length = np.where(better, new[0], cost), np.where(better[:, None], new[3], length)
        normal, right = np.where(take, new[1], normal), np.where(better[:, None], new[2], right)
        damping = np.where(better, damping / 10, np.minimum(np.maximum(10 * damping, 1e-3), 1e8))
    return Minima(poses, cost, normal, length, settled | (gain < ACCEPTED))


def _evaluate(problem: PlanarProblem, poses: Poses, whiten: np.ndarray, huber: float):
    """Cost (h,), normal matrix (h, 6, 6), right-hand side (h, 6) and lengths (h, n) of the whitened residuals."""
    view = project(problem, poses)
    r = (whiten @ view.residual[..., None])[..., 0]
    a = whiten @ view.by_pose
    length = np.linalg.norm(r, axis=2)
    short = np.minimum(length, huber)
    cost = np.where(view.before, (short * (2 * length - short)).sum(1), np.inf)
    weight = short / np.maximum(length, 1e-12)
    flat = a.reshape(len(r), -1, 6)
    back = np.swapaxes((weight[..., None, None] * a).reshape(flat.shape), 1, 2)
    return cost, back @ flat, (back @ r.reshape(len(r), -1, 1))[..., 0], length


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
        pose = moved(pose, step[None])
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
