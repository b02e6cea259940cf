"""Normal equations of one group, reduced to the unknowns that all groups share (Helmert blocking).

Unknowns of a group: cameras, dots, the board's pose. Shared: the target's circles, the board's shape, the intrinsics.
Cameras are eliminated image by image, then dots and pose at once, so that the size of the rest does not grow with the
number of images.
"""

from dataclasses import dataclass, replace

import numpy as np

from stcal.geometry.camera import Camera
from stcal.geometry.least_squares import perturbed
from stcal.geometry.normal_equations import Reduction, blocks_of, reduce
from stcal.geometry.rigid import Rigid, skew
from stcal.geometry.robust import huber_cost, huber_weights
from stcal.sfm.adjust.refine import moved_poses, projection_jacobians
from stcal.sfm.data.model import GroupModel, MetricModel


@dataclass(frozen=True, slots=True, eq=False)
class Shared:
    """Unknowns that all groups share.

    ``xyz_model`` : (c, 3) circles, mm; ``shape_mm`` : (d, 3) deviation of the dots from the design that all groups have
    in common, board frame; ``camera`` ; ``basis`` : (16, q) derivative of the camera's parameters by those that are
    adjusted.
    """

    xyz_model: np.ndarray
    shape_mm: np.ndarray
    camera: Camera
    basis: np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """One group of the joint adjustment.

    ``model_from_board`` ; ``design`` : (e, 3) designed positions of its dots, board frame; ``sigma_mm`` : σ of a dot
    about the common shape; ``dots``, ``circles`` : indices of the model's points that are dots and circles;
    ``dot_place`` : (e,) index of each dot in the common shape, empty if each group has its own; ``circle_place`` :
    index of each circle among all; ``photographs`` : (3p + q, 3p + q) normal matrix of its points and the intrinsics
    from all of its images, if it is known.
    """

    model: MetricModel
    model_from_board: Rigid
    design: np.ndarray
    sigma_mm: float
    dots: np.ndarray
    circles: np.ndarray
    dot_place: np.ndarray
    circle_place: np.ndarray
    photographs: np.ndarray | None = None

    def expected_dots(self, shared: Shared) -> np.ndarray:
        """Returns the sum of design and common shape, (e, 3), board frame."""
        return self.design + shared.shape_mm[self.dot_place] if len(self.dot_place) else self.design

    def board_residual(self) -> np.ndarray:
        """Returns the adjusted dots minus the design, (e, 3), board frame, mm."""
        return self.model_from_board.inverse() @ self.model.xyz_model[self.dots] - self.design

    def cost(self, shared: Shared, huber: float) -> float:
        """Returns squared residuals over σ², Huber's cost beyond ``huber``; infinite for a point behind a camera."""
        residual = self.board_residual() + self.design - self.expected_dots(shared)
        return image_cost(self.model, shared.camera, huber) + float(((residual / self.sigma_mm) ** 2).sum())


@dataclass(frozen=True, slots=True, eq=False)
class Reduced:
    """Normal equations of a group after elimination of its own unknowns.

    ``normal``, ``right`` : over the group's outer unknowns (its circles, dots of the common shape, intrinsics);
    ``inner`` : gives the step of dots and board from that of the outer unknowns; ``cameras`` : then gives the step of
    the cameras, if these are moved.
    """

    normal: np.ndarray
    right: np.ndarray
    inner: Reduction
    cameras: Reduction | None

    @property
    def gain(self) -> float:
        """Decrease of the cost by the eliminated unknowns alone."""
        return self.inner.gain + (self.cameras.gain if self.cameras else 0.0)


def normalised(model: GroupModel, camera: Camera) -> np.ndarray:
    """Returns the residuals over σ, (n, 2)."""
    return model.whiten(model.residuals_px(camera))


def image_cost(model: GroupModel, camera: Camera, huber: float) -> float:
    """Returns squared residuals over σ², Huber's cost beyond ``huber``; infinite for a point behind a camera."""
    if (model.xyz_camera()[:, 2] <= 0).any():
        return np.inf
    return float(huber_cost(np.linalg.norm(normalised(model, camera), axis=1), huber).sum())


def robust_weights(model: GroupModel, camera: Camera, huber: float) -> np.ndarray:
    """Returns Huber's weights, (n,), for the lengths of the residuals over σ."""
    return huber_weights(np.linalg.norm(normalised(model, camera), axis=1), huber)


def reduced(block: Block, shared: Shared, huber: float) -> Reduced:
    """Eliminates cameras, dots and the board's pose."""
    if block.photographs is None:
        normal, right, cameras = without_cameras(block.model, shared.camera, shared.basis, huber)
    else:  # for the covariance alone: nothing is moved
        normal, right, cameras = block.photographs, np.zeros(len(block.photographs)), None
    full, full_right, inner, outer = _with_board(block, shared, normal, right)
    reduction = reduce(full[np.ix_(inner, inner)][None], full_right[None, inner], full[np.ix_(inner, outer)][None])
    return Reduced(
        full[np.ix_(outer, outer)] - reduction.normal, full_right[outer] - reduction.right, reduction, cameras
    )


@dataclass(frozen=True, slots=True, eq=False)
class PoseEquations:
    """Normal equations of a model's m images.

    ``normal``, ``right`` : over p points and s other unknowns, (3p + s); ``block`` : (m, 6, 6), ``block_right`` :
    (m, 6), of the poses; ``cross`` : (m, 6, 3p + s) between the poses and the rest.
    """

    normal: np.ndarray
    right: np.ndarray
    block: np.ndarray
    block_right: np.ndarray
    cross: np.ndarray


def equations_of_poses(
    model: GroupModel, by_pose: np.ndarray, by_point: np.ndarray, by_others: np.ndarray, residual: np.ndarray
) -> PoseEquations:
    """Returns the equations for derivatives (n, 2, 6), (n, 2, 3), (n, 2, s) and residuals (n, 2), all over σ."""
    m, p, s = len(model.images), len(model.labels), by_others.shape[2]
    at = np.swapaxes(by_pose, 1, 2)
    cross = np.zeros((m, 6, 3 * p + s))
    columns = 3 * model.point_index[:, None] + np.arange(3)
    cross[model.image_index[:, None, None], np.arange(6)[:, None], columns[:, None]] = at @ by_point
    normal, right = np.zeros((3 * p + s, 3 * p + s)), np.zeros(3 * p + s)
    blocks, rights = blocks_of(by_point, residual, model.point_index, p)
    place = 3 * np.arange(p)[:, None] + np.arange(3)
    normal[place[:, :, None], place[:, None]] = blocks
    right[: 3 * p] = rights.ravel()
    if s:
        np.add.at(cross[:, :, 3 * p :], model.image_index, at @ by_others)
        coupled = np.zeros((p, 3, s))
        np.add.at(coupled, model.point_index, np.swapaxes(by_point, 1, 2) @ by_others)
        normal[: 3 * p, 3 * p :] = coupled.reshape(3 * p, s)
        normal[3 * p :, : 3 * p] = normal[: 3 * p, 3 * p :].T
        normal[3 * p :, 3 * p :] = np.einsum("nki,nkj->ij", by_others, by_others)
        right[3 * p :] = np.einsum("nki,nk->i", by_others, residual)
    return PoseEquations(normal, right, *blocks_of(by_pose, residual, model.image_index, m), cross)


def without_cameras(
    model: GroupModel, camera: Camera, basis: np.ndarray, huber: float
) -> tuple[np.ndarray, np.ndarray, Reduction]:
    """Returns normal equations over points (3p) and intrinsics (q), and the reduction that gives the cameras."""
    by_pose, by_point = projection_jacobians(model, camera)
    root = np.sqrt(robust_weights(model, camera, huber))[:, None]
    by_intrinsics = np.zeros((*by_pose.shape[:2], 0))
    if basis.shape[1]:
        xyz = model.xyz_camera()
        by_intrinsics = camera.parameter_jacobian(xyz[:, :2] / xyz[:, 2:]) @ basis
    a, c, e = (model.whiten(d) * root[..., None] for d in (by_pose, by_point, by_intrinsics))
    equations = equations_of_poses(model, a, c, e, normalised(model, camera) * root)
    cameras = reduce(equations.block, equations.block_right, equations.cross)
    return equations.normal - cameras.normal, equations.right - cameras.right, cameras


def rows_of_view(model: GroupModel, camera: Camera, basis: np.ndarray) -> np.ndarray:
    """Returns the whitened equations of a model of one image with its pose eliminated, (2n − 6, 3p + q).

    The rows are over the points and the intrinsics, for n observations, and orthogonal to the pose. Their squares give
    the normal matrix of :func:`without_cameras`.
    """
    by_pose, by_point = projection_jacobians(model, camera)
    n, p = len(model.point_index), len(model.labels)
    rows = np.zeros((n, 2, 3 * p + basis.shape[1]))
    columns = 3 * model.point_index[:, None] + np.arange(3)
    rows[np.arange(n)[:, None, None], np.arange(2)[:, None], columns[:, None]] = model.whiten(by_point)
    xyz = model.xyz_camera()
    rows[:, :, 3 * p :] = model.whiten(camera.parameter_jacobian(xyz[:, :2] / xyz[:, 2:]) @ basis)
    across = np.linalg.qr(model.whiten(by_pose).reshape(2 * n, 6), mode="complete")[0][:, 6:]
    return across.T @ rows.reshape(2 * n, -1)


def _with_board(block: Block, shared: Shared, normal: np.ndarray, right: np.ndarray):
    """Appends pose of the board and common shape with the observations dot = pose · (design + shape ± σ).

    The last two results are the indices of the eliminated unknowns (dots, pose) and of the rest (circles, shape,
    intrinsics).
    """
    p, q, d = len(block.model.labels), shared.basis.shape[1], len(block.dots)
    s = 3 * len(block.dot_place)
    size = 3 * p + q
    full, full_right = np.zeros((size + 6 + s, size + 6 + s)), np.zeros(size + 6 + s)
    full[:size, :size], full_right[:size] = normal, right
    rotation, weight = block.model_from_board.rotation, 1 / block.sigma_mm**2
    turned = block.expected_dots(shared) @ rotation.T
    gap = block.model.xyz_model[block.dots] - (turned + block.model_from_board.translation)
    # Each dot has three rows of its own: derivatives by the dot (1), the pose, and the common shape (−rotation).
    dot_index, pose = 3 * block.dots[:, None] + np.arange(3), slice(size, size + 6)
    by_pose = np.concatenate([skew(turned), -np.broadcast_to(np.eye(3), (d, 3, 3))], axis=2)
    full[dot_index, dot_index] += weight
    full_right[dot_index] -= weight * gap
    full[dot_index, pose] += weight * by_pose
    full[pose, dot_index.ravel()] = full[dot_index.ravel(), pose].T
    flat = by_pose.reshape(3 * d, 6)
    full[pose, pose] += weight * flat.T @ flat
    full_right[pose] -= weight * gap.ravel() @ flat
    if s:
        place = size + 6 + np.arange(s).reshape(d, 3)
        full[dot_index[:, :, None], place[:, None]] = -weight * rotation
        full[place[:, :, None], dot_index[:, None]] = -weight * rotation.T
        full[place, place] += weight
        full_right[place] += weight * gap @ rotation
        full[place, pose] = -weight * rotation.T @ by_pose
        full[pose, place.ravel()] = full[place.ravel(), pose].T
    dots = (3 * block.dots[:, None] + np.arange(3)).ravel()
    circles = (3 * block.circles[:, None] + np.arange(3)).ravel()
    inner = np.concatenate([dots, size + np.arange(6)])
    outer = np.concatenate([circles, size + 6 + np.arange(s), 3 * p + np.arange(q)]).astype(int)
    return full, full_right, inner, outer


def step_of(block: Block, reduced: Reduced, outer: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """Returns the step (3p + 6m + 6,) of the group's points, cameras and board for a step of its outer unknowns."""
    points, d = np.zeros((len(block.model.labels), 3)), len(block.dots)
    (inner,) = reduced.inner.back(outer)
    points[block.circles] = outer[: 3 * len(block.circles)].reshape(-1, 3)
    points[block.dots] = inner[: 3 * d].reshape(-1, 3)
    assert reduced.cameras is not None, "the normal matrix of the photographs alone moves no camera"
    cameras = reduced.cameras.back(np.concatenate([points.ravel(), intrinsics]))
    return np.concatenate([points.ravel(), cameras.ravel(), inner[3 * d :]])


def moved(block: Block, step: np.ndarray) -> Block:
    """Returns the group after a step of :func:`step_of`."""
    model, p = block.model, 3 * len(block.model.labels)
    cameras = moved_poses(model.camera_from_model, step[p:-6].reshape(-1, 6))
    points = model.xyz_model + step[:p].reshape(-1, 3)
    changed = replace(model, camera_from_model=cameras, xyz_model=points)
    return replace(block, model=changed, model_from_board=perturbed(block.model_from_board, step[-6:]))
