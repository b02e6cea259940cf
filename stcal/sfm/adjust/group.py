"""Bundle adjustment of one group, weighted: Gauss–Newton over poses and points, the larger set eliminated (Schur).

COLMAP's adjustment gives all observations equal weight. The σ of centres differ by a factor of ten, and weighting them
improves the faces by a factor of two. Intrinsics are fixed. No board is used here, and only a vanishing damping holds
the seven free directions of the world, so that the model stays where it is.
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
"""Largest predicted decrease of the last step, as a share of χ²: corrections of nanometres must be seen."""
MAX_STEPS = 50
DAMPING = 1e-10
"""Relative damping, which holds the seven free directions of the world."""


def adjust(model: M, camera: Camera) -> M:
    """Minimises the weighted reprojection error of the corrected centres over poses and points.

    Raises
    ------
    ConvergenceError
        No minimum after ``MAX_STEPS`` steps.
    """
    minimum = minimise(
        model,
        lambda state: _Normal.of(state, camera),
        _moved,
        cost=lambda state: _cost(state, camera),
        damping=DAMPING,
        least_damping=DAMPING,
        settled=EXACTLY,
        max_steps=MAX_STEPS,
    )
    return minimum.required(f"group {model.group}: bundle adjustment", "check the camera file").state


def _cost(model: GroupModel, camera: Camera) -> float:
    if (model.xyz_camera()[:, 2] <= 0).any():
        return np.inf
    return float((model.whiten(model.residuals_px(camera)) ** 2).sum())


def projection_jacobians(model: GroupModel, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Returns the derivatives of the projections (px) by poses and by points.

    Those by the poses' left perturbation (rotation, translation) are (n, 2, 6), those by the points (n, 2, 3), in the
    world's unit.
    """
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
    """Normal equations of m poses and p points.

    They are blocks (m, 6, 6), (p, 3, 3), right-hand sides (m, 6), (p, 3), and ``cross`` (m, p, 6, 3) between poses and
    points.
    """

    cost: float
    poses: np.ndarray
    pose_right: np.ndarray
    points: np.ndarray
    point_right: np.ndarray
    cross: np.ndarray

    @classmethod
    def of(cls, model: GroupModel, camera: Camera) -> "_Normal":
        by_pose, by_point = (model.whiten(derivative) for derivative in projection_jacobians(model, camera))
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
        """Returns the step (6m + 3p,) of poses, then points, and its gain; the larger of both sets is eliminated."""
        poses, points = (block + damping * block * np.eye(block.shape[1]) for block in (self.poses, self.points))
        if self.poses.size // 6 <= self.points.size // 3:
            pose_step, point_step = _solve(poses, self.pose_right, points, self.point_right, self.cross)
        else:
            cross = self.cross.transpose(1, 0, 3, 2)
            point_step, pose_step = _solve(points, self.point_right, poses, self.pose_right, cross)
        gain = float((pose_step * self.pose_right).sum() + (point_step * self.point_right).sum())
        return np.concatenate([pose_step.ravel(), point_step.ravel()]), gain


def _moved(model: M, step: np.ndarray) -> M:
    """Returns the model after steps of its poses and points."""
    poses, points = step[: 6 * len(model.images)].reshape(-1, 6), step[6 * len(model.images) :].reshape(-1, 3)
    return replace(
        model, camera_from_model=moved_poses(model.camera_from_model, poses), xyz_model=model.xyz_model + points
    )


def moved_poses(poses: tuple[Rigid, ...], step: np.ndarray) -> tuple[Rigid, ...]:
    """Returns poses after left perturbations (m, 6)."""
    turned = Rotation.from_rotvec(step[:, :3]).as_matrix()
    return tuple(
        Rigid(turn @ pose.rotation, pose.translation + shift)
        for turn, pose, shift in zip(turned, poses, step[:, 3:], strict=True)
    )


def _solve(kept, kept_right, dropped, dropped_right, cross) -> tuple[np.ndarray, np.ndarray]:
    """Returns the steps of the kept blocks (a, i) and of the eliminated ones (b, j); ``cross`` : (a, b, i, j)."""
    a, b, i, j = cross.shape
    reduction = reduce(dropped, dropped_right, cross.transpose(1, 3, 0, 2).reshape(b, j, a * i))
    normal = -reduction.normal
    normal.reshape(a, i, a, i)[np.arange(a), :, np.arange(a)] += kept
    step = _solve_symmetric(normal, kept_right.ravel() - reduction.right)
    return step.reshape(a, i), reduction.back(step)


def _solve_symmetric(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solves by Cholesky decomposition if the damping permits it; else returns the shortest solution."""
    try:
        return cho_solve(cho_factor(matrix), right)
    except LinAlgError:
        return np.linalg.lstsq(matrix, right, rcond=1e-14)[0]
