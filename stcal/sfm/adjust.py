"""Weighted bundle adjustment of one group: Gauss–Newton over poses and points, the points eliminated (Schur).

COLMAP's adjustment weighs all observations alike; centres differ in σ by a factor of ten, and that is worth a factor
of two in the faces. Intrinsics are fixed. The seven free directions of the world (no board is used here) are left to
a vanishing damping, so that the model stays where it is.
"""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.errors import ConvergenceError
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid, skew
from stcal.sfm.model import GroupModel

MAX_STEPS = 50
SETTLED_PX = 1e-8
"""The largest move of any projection in the last step: far below what a correction may change."""
DAMPING = 1e-10
MAX_DAMPING = 1e8


def adjust(model: GroupModel, camera: Camera) -> GroupModel:
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
    return float(((model.residuals_px(camera) / model.sigma_px[:, None]) ** 2).sum())


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


def _step(model: GroupModel, camera: Camera, damping: float) -> tuple[GroupModel, float]:
    """One step, and the largest move of a projection in px."""
    m, p, n = len(model.images), len(model.labels), len(model.image_index)
    by_pose, by_point = projection_jacobians(model, camera)
    weight = 1 / model.sigma_px[:, None]
    a, b = by_pose * weight[..., None], by_point * weight[..., None]
    residual = model.residuals_px(camera) * weight
    pose_block, point_block = np.zeros((m, 6, 6)), np.zeros((p, 3, 3))
    pose_right, point_right = np.zeros((m, 6)), np.zeros((p, 3))
    np.add.at(pose_block, model.image_index, np.swapaxes(a, 1, 2) @ a)
    np.add.at(point_block, model.point_index, np.swapaxes(b, 1, 2) @ b)
    np.add.at(pose_right, model.image_index, np.einsum("nki,nk->ni", a, residual))
    np.add.at(point_right, model.point_index, np.einsum("nki,nk->ni", b, residual))
    pose_block += damping * pose_block * np.eye(6)
    point_block += damping * point_block * np.eye(3)
    cross = np.zeros((m, p, 6, 3))
    np.add.at(cross, (model.image_index, model.point_index), np.swapaxes(a, 1, 2) @ b)
    inverse = np.linalg.inv(point_block)
    weighted = cross @ inverse
    reduced = -np.einsum("apij,bpkj->aibk", weighted, cross, optimize=True)
    reduced[np.arange(m), :, np.arange(m)] += pose_block
    right = pose_right - np.einsum("apij,pj->ai", weighted, point_right)
    pose_step = np.linalg.lstsq(reduced.reshape(6 * m, 6 * m), right.ravel(), rcond=1e-14)[0].reshape(m, 6)
    point_step = np.einsum("pij,pj->pi", inverse, point_right - np.einsum("apij,ai->pj", cross, pose_step))
    move = np.einsum("nij,nj->ni", by_pose, pose_step[model.image_index])
    move += np.einsum("nij,nj->ni", by_point, point_step[model.point_index])
    turned = Rotation.from_rotvec(pose_step[:, :3]).as_matrix()
    poses = tuple(
        Rigid(turn @ pose.rotation, pose.translation + step[3:])
        for turn, pose, step in zip(turned, model.camera_from_world, pose_step, strict=True)
    )
    moved = replace(model, camera_from_world=poses, xyz_world=model.xyz_world + point_step)
    return moved, float(np.abs(move).max()) if n else 0.0
