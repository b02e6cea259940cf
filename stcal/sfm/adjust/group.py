"""Weighted bundle adjustment of one group: Gauss–Newton over poses and points, the more numerous eliminated (Schur).

COLMAP's adjustment weighs all observations alike; centres differ in σ by a factor of ten, and that is worth a factor
of two in the faces. Intrinsics are fixed. The seven free directions of the world (no board is used here) are left to
a vanishing damping, so that the model stays where it is.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.linalg import LinAlgError
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial.transform import Rotation

from stcal.geometry.camera import Camera
from stcal.geometry.least_squares import minimise
from stcal.geometry.normal_equations import blocks_of, reduce
from stcal.geometry.rigid import Rigid, skew
from stcal.sfm.data.model import GroupModel, M

EXACTLY = 1e-15
"""Share of χ² that the last step may promise: corrections of nanometres are to be seen."""
MAX_STEPS = 50
DAMPING = 1e-10
"""What holds the seven free directions of the world."""


def adjust(model: M, camera: Camera) -> M:
    """Minimise the weighted reprojection error of the corrected centres over poses and points.

    Raises
    ------
    ConvergenceError
        No minimum after ``MAX_STEPS`` steps.
    """
    found = minimise(
        model,
        lambda state: _Normal.of(state, camera),
        _moved,
        cost=lambda state: _cost(state, camera),
        damping=DAMPING,
        least_damping=DAMPING,
        settled=EXACTLY,
        max_steps=MAX_STEPS,
    )
    return found.required(f"group {model.group}: bundle adjustment", "check the camera file").state


def _cost(model: GroupModel, camera: Camera) -> float:
    if (model.xyz_camera()[:, 2] <= 0).any():
        return np.inf
    return float((model.whiten(model.residuals_px(camera)) ** 2).sum())


def projection_jacobians(model: GroupModel, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives of the projections (px) by the poses' left perturbation (rotation, translation), (n, 2, 6), and by
    the points, (n, 2, 3), in the world's unit."""
    xyz = model.xyz_camera()
    ideal = xyz[:, :2] / xyz[:, 2:]
    by_ideal = camera.distort_jacobian(ideal)[1] * camera.focal[:, None]
    by_camera = np.concatenate([by_ideal, -by_ideal @ ideal[..., None]], axis=2) / xyz[:, 2, None, None]
    translation = np.stack([pose.translation for pose in model.camera_from_model])[model.image_index]
    by_pose = np.concatenate([-by_camera @ skew(xyz - translation), by_camera], axis=2)
    rotation = np.stack([pose.rotation for pose in model.camera_from_model])[model.image_index]
    return by_pose, by_camera @ rotation


@dataclass(frozen=True, slots=True, eq=False)
class _Normal:
    """Normal equations of m poses and p points: their blocks (m, 6, 6), (p, 3, 3) and right-hand sides (m, 6), (p, 3),
    and ``cross`` (m, p, 6, 3) between them."""

    cost: float
    poses: np.ndarray
    pose_right: np.ndarray
    points: np.ndarray
    point_right: np.ndarray
    cross: np.ndarray

    @classmethod
    def of(cls, model: GroupModel, camera: Camera) -> "_Normal":
        by_pose, by_point = (model.whiten(each) for each in projection_jacobians(model, camera))
        residual = model.whiten(model.residuals_px(camera))
        m, p = len(model.images), len(model.labels)
        cross = np.zeros((m, p, 6, 3))
        cross[model.image_index, model.point_index] = np.swapaxes(by_pose, 1, 2) @ by_point
        return cls(
            _cost(model, camera),
            *blocks_of(by_pose, residual, model.image_index, m),
            *blocks_of(by_point, residual, model.point_index, p),
            cross,
        )

    def step(self, damping: float | np.ndarray) -> tuple[np.ndarray, float]:
        """(6m + 3p,) of poses, then points; of the two the more numerous are reduced away."""
        poses, points = (block + damping * block * np.eye(block.shape[1]) for block in (self.poses, self.points))
        if self.poses.size // 6 <= self.points.size // 3:
            pose_step, point_step = _solve(poses, self.pose_right, points, self.point_right, self.cross)
        else:
            cross = self.cross.transpose(1, 0, 3, 2)
            point_step, pose_step = _solve(points, self.point_right, poses, self.pose_right, cross)
        gain = float((pose_step * self.pose_right).sum() + (point_step * self.point_right).sum())
        return np.concatenate([pose_step.ravel(), point_step.ravel()]), gain


def _moved(model: M, step: np.ndarray) -> M:
    """The model after steps of its poses and points."""
    poses, points = step[: 6 * len(model.images)].reshape(-1, 6), step[6 * len(model.images) :].reshape(-1, 3)
    return replace(
        model, camera_from_model=moved_poses(model.camera_from_model, poses), xyz_model=model.xyz_model + points
    )


def moved_poses(poses: tuple[Rigid, ...], step: np.ndarray) -> tuple[Rigid, ...]:
    """Poses after left perturbations (m, 6)."""
    turned = Rotation.from_rotvec(step[:, :3]).as_matrix()
    return tuple(
        Rigid(turn @ pose.rotation, pose.translation + shift)
        for turn, pose, shift in zip(turned, poses, step[:, 3:], strict=True)
    )


def _solve(kept, kept_right, dropped, dropped_right, cross) -> tuple[np.ndarray, np.ndarray]:
    """Steps of the kept blocks (a, i) and of the reduced ones (b, j); ``cross`` : (a, b, i, j)."""
    a, b, i, j = cross.shape
    away = reduce(dropped, dropped_right, cross.transpose(1, 3, 0, 2).reshape(b, j, a * i))
    normal = -away.normal
    normal.reshape(a, i, a, i)[np.arange(a), :, np.arange(a)] += kept
    step = _solve_symmetric(normal, kept_right.ravel() - away.right)
    return step.reshape(a, i), away.back(step)


def _solve_symmetric(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """By Cholesky where the damping makes it possible, else the shortest solution."""
    try:
        return cho_solve(cho_factor(matrix), right)
    except LinAlgError:
        return np.linalg.lstsq(matrix, right, rcond=1e-14)[0]
