"""Least-squares adjustment of the poses of planes and of the cameras that see them."""

from dataclasses import dataclass

import numpy as np

from stcal.geometry.least_squares import PoseStack, minimise
from stcal.geometry.normal_equations import blocks_of, reduce
from stcal.geometry.rigid import skew
from stcal.geometry.robust import huber_cost, huber_weights

HUBER_PX = 1.5
"""Residual beyond which an observation loses weight.

Such residuals are deviations of printed planes, not of centres.
"""
SETTLED = 1e-4
"""Relative decrease of χ² at convergence. A prediction to a fraction of a pixel is sufficient."""
MAX_STEPS = 30


@dataclass(frozen=True, slots=True, eq=False)
class PlaneBundle:
    """Points of planes: ``image``, ``plane`` (n,); ``xyz`` (n, 3) in the plane; ``seen`` (n, 2) measured, ideal px."""

    image: np.ndarray
    plane: np.ndarray
    xyz: np.ndarray
    seen: np.ndarray
    focal_px: float

    def adjusted(self, poses: PoseStack, planes: PoseStack) -> tuple[PoseStack, PoseStack]:
        """Returns the poses camera_from_world of the m images and world_from_plane of the planes; the first plane is
        fixed.

        Without convergence the last state is returned: its predictions are verified anyway.
        """

        def moved(state, step: np.ndarray):
            own = step[6 * len(poses) :].reshape(-1, 6)
            return state[0].moved(step[: 6 * len(poses)].reshape(-1, 6)), state[1].moved(
                np.vstack([np.zeros((1, 6)), own])
            )

        return minimise(
            (poses, planes),
            lambda state: self._linearised(*state),
            moved,
            settled=SETTLED,
            max_steps=MAX_STEPS,
            damping=1e-3,
        ).state

    def _linearised(self, poses: PoseStack, planes: PoseStack) -> "_Linear":
        m, k = len(poses), 6 * (len(planes) - 1)
        turned = np.einsum("nij,nj->ni", planes.rotation[self.plane], self.xyz)
        rotation = poses.rotation[self.image]
        placed = np.einsum("nij,nj->ni", rotation, turned + planes.translation[self.plane])
        xyz = placed + poses.translation[self.image]
        if (xyz[:, 2] <= 0).any():
            return _Linear(np.inf, np.zeros((m, 6, 6)), np.zeros((m, 6)), np.eye(k), np.zeros(k), np.zeros((m, 6, k)))
        ideal = xyz[:, :2] / xyz[:, 2:]
        residual = self.seen - self.focal_px * ideal
        length = np.linalg.norm(residual, axis=1)
        root = np.sqrt(huber_weights(length, HUBER_PX))
        by_point = np.zeros((len(xyz), 2, 3))
        by_point[:, 0, 0] = by_point[:, 1, 1] = 1
        by_point[:, :, 2] = -ideal
        by_point *= (root * self.focal_px / xyz[:, 2])[:, None, None]
        by_pose = np.concatenate([-by_point @ skew(placed), by_point], axis=2)
        by_group = by_point @ rotation
        by_plane = np.concatenate([-by_group @ skew(turned), by_group], axis=2)
        residual = residual * root[:, None]
        blocks, right = blocks_of(by_pose, residual, self.image, m)
        own, own_right = blocks_of(by_plane, residual, self.plane, len(planes))
        normal = np.zeros((k, k))
        for b in range(1, len(planes)):
            at = slice(6 * b - 6, 6 * b)
            normal[at, at] = own[b]
        cross = np.zeros((m, len(planes), 6, 6))
        np.add.at(cross, (self.image, self.plane), np.swapaxes(by_pose, 1, 2) @ by_plane)
        return _Linear(
            float(huber_cost(length, HUBER_PX).sum()),
            blocks,
            right,
            normal,
            own_right[1:].ravel(),
            cross[:, 1:].transpose(0, 2, 1, 3).reshape(m, 6, k),
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Linear:
    """Normal equations of the images' poses, which are eliminated, and of all planes except the first."""

    cost: float
    poses: np.ndarray
    pose_right: np.ndarray
    planes: np.ndarray
    plane_right: np.ndarray
    cross: np.ndarray

    def step(self, damping: float | np.ndarray) -> tuple[np.ndarray, float]:
        """Returns the step of the images (6m,) and planes, and the predicted gain."""
        damped = self.poses * (1 + damping * np.eye(6))
        damped[~self.poses.any(axis=(1, 2))] = np.eye(6)  # an image without points keeps its pose
        away = reduce(damped, self.pose_right, self.cross)
        k = len(self.plane_right)
        own = self.planes * (1 + damping * np.eye(k)) - away.normal
        planes = np.linalg.lstsq(own, self.plane_right - away.right, rcond=1e-12)[0] if k else np.zeros(0)
        poses = away.back(planes)
        gain = float((poses * self.pose_right).sum() + planes @ self.plane_right)
        return np.concatenate([poses.ravel(), planes]), gain
