"""Weighted bundle adjustment of one group: Gauss–Newton over poses and points, the more numerous eliminated (Schur).

COLMAP's adjustment weighs all observations alike; centres differ in σ by a factor of ten, and that is worth a factor
of two in the faces. Intrinsics are fixed. The seven free directions of the world (no board is used here) are left to
a vanishing damping, so that the model stays where it is.
"""

from dataclasses import replace

import numpy as np
from numpy.linalg import LinAlgError
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial.transform import Rotation

from stcal.errors import ConvergenceError
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid, skew
from stcal.sfm.data.model import GroupModel, M

MAX_STEPS = 50
SETTLED_PX = 1e-8
"""The largest move of any projection in the last step: far below what a correction may change."""
DAMPING = 1e-10
MAX_DAMPING = 1e8


def adjust(model: M, camera: Camera) -> M:
    """Minimise the weighted reprojection error of the corrected centres over poses and points.

    Raises
    ------
    ConvergenceError
        No minimum after ``MAX_STEPS`` steps.
    """
    damping = DAMPING
    cost = _cost(model, camera)
    for _ in range(MAX_STEPS):
        while True:
            trial, move = _step(model, camera, damping)
            trial_cost = _cost(trial, camera)
            if trial_cost <= cost * (1 + 1e-12) or move < SETTLED_PX:
                break
            damping = max(damping, 1e-8) * 100
            if damping > MAX_DAMPING:
                raise ConvergenceError(
                    f"group {model.group}: bundle adjustment finds no better model; check the camera file"
                )
        damping = max(damping / 100, DAMPING)
        model, cost = trial, min(cost, trial_cost)
        if move < SETTLED_PX:
            return model
    raise ConvergenceError(
        f"group {model.group}: bundle adjustment still moves projections by {move:.1g} px after {MAX_STEPS} steps, "
        f"{SETTLED_PX:g} needed; check the camera file"
    )


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
    translation = np.stack([pose.translation for pose in model.camera_from_world])[model.image_index]
    by_pose = np.concatenate([-by_camera @ skew(xyz - translation), by_camera], axis=2)
    rotation = np.stack([pose.rotation for pose in model.camera_from_world])[model.image_index]
    return by_pose, by_camera @ rotation


def _step(model: M, camera: Camera, damping: float) -> tuple[M, float]:
    """One step, and the largest move of a projection in px."""
    m, p, n = len(model.images), len(model.labels), len(model.image_index)
    by_pose, by_point = projection_jacobians(model, camera)
    a, b = model.whiten(by_pose), model.whiten(by_point)
    residual = model.whiten(model.residuals_px(camera))
    poses = _normal_blocks(a, residual, model.image_index, m, damping)
    points = _normal_blocks(b, residual, model.point_index, p, damping)
    cross = np.zeros((m, p, 6, 3))
    cross[model.image_index, model.point_index] = np.swapaxes(a, 1, 2) @ b
    if 6 * m <= 3 * p:
        pose_step, point_step = _solve(*poses, *points, cross)
    else:
        point_step, pose_step = _solve(*points, *poses, cross.transpose(1, 0, 3, 2))
    move = np.einsum("nij,nj->ni", by_pose, pose_step[model.image_index])
    move += np.einsum("nij,nj->ni", by_point, point_step[model.point_index])
    turned = Rotation.from_rotvec(pose_step[:, :3]).as_matrix()
    moved_poses = tuple(
        Rigid(turn @ pose.rotation, pose.translation + step[3:])
        for turn, pose, step in zip(turned, model.camera_from_world, pose_step, strict=True)
    )
    moved = replace(model, camera_from_world=moved_poses, xyz_world=model.xyz_world + point_step)
    return moved, float(np.abs(move).max()) if n else 0.0


def _normal_blocks(jacobian, residual, index, count: int, damping: float) -> tuple[np.ndarray, np.ndarray]:
    """Diagonal blocks (count, k, k) of the normal matrix, damped, and right-hand side (count, k)."""
    k = jacobian.shape[2]
    block, right = np.zeros((count, k, k)), np.zeros((count, k))
    np.add.at(block, index, np.swapaxes(jacobian, 1, 2) @ jacobian)
    np.add.at(right, index, np.einsum("nki,nk->ni", jacobian, residual))
    return block + damping * block * np.eye(k), right


def _solve(kept, kept_right, dropped, dropped_right, cross) -> tuple[np.ndarray, np.ndarray]:
    """Steps of the kept blocks (a, i) and the dropped ones (b, j), the latter eliminated; ``cross`` : (a, b, i, j)."""
    a, b, i, j = cross.shape
    inverse = np.linalg.inv(dropped)
    flat = cross.transpose(0, 2, 1, 3).reshape(a * i, b * j)
    weighted = (cross @ inverse).transpose(0, 2, 1, 3).reshape(a * i, b * j)
    reduced = -weighted @ flat.T
    blocks = reduced.reshape(a, i, a, i)
    blocks[np.arange(a), :, np.arange(a)] += kept
    right = kept_right.ravel() - weighted @ dropped_right.ravel()
    step = _solve_symmetric(reduced, right)
    back = np.einsum("bij,bj->bi", inverse, dropped_right - (flat.T @ step).reshape(b, j))
    return step.reshape(a, i), back


def _solve_symmetric(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """By Cholesky where the damping makes it possible, else the shortest solution."""
    try:
        return cho_solve(cho_factor(matrix), right)
    except LinAlgError:
        return np.linalg.lstsq(matrix, right, rcond=1e-14)[0]
