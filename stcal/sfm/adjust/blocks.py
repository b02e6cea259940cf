"""Normal equations of one group in the joint adjustment, condensed to what all groups share (Helmert blocking).

Unknowns of a group: cameras, dots, the board's pose. Shared: the target's circles, the board's shape, the intrinsics.
Cameras are eliminated image by image, then dots and pose at once, so that what remains does not grow with the images.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid, skew
from stcal.sfm.adjust.group import projection_jacobians
from stcal.sfm.data.model import GroupModel, MetricModel


@dataclass(frozen=True, slots=True, eq=False)
class Shared:
    """What all groups share.

    ``xyz_world`` : (c, 3) circles, mm; ``shape_mm`` : (d, 3) deviation of the dots from the design that all groups
    have in common, board frame; ``camera`` ; ``basis`` : (12, q) derivative of the camera's parameters by those that
    are adjusted.
    """

    xyz_world: np.ndarray
    shape_mm: np.ndarray
    camera: Camera
    basis: np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """One group.

    ``world_from_board`` ; ``design`` : (e, 3) its dots, board frame; ``sigma_mm`` of a dot about the common shape;
    ``dots``, ``circles`` : points of the model that are dots and circles; ``dot_place`` : (e,) of each dot in the
    common shape, empty where each group has its own; ``circle_place`` : of each circle among all.
    """

    model: MetricModel
    world_from_board: Rigid
    design: np.ndarray
    sigma_mm: float
    dots: np.ndarray
    circles: np.ndarray
    dot_place: np.ndarray
    circle_place: np.ndarray

    def expected_dots(self, shared: Shared) -> np.ndarray:
        """Design and common shape, (e, 3), board frame."""
        return self.design + shared.shape_mm[self.dot_place] if len(self.dot_place) else self.design

    def board_residual(self) -> np.ndarray:
        """Adjusted minus design, (e, 3), board frame, mm."""
        return self.world_from_board.inverse() @ self.model.xyz_world[self.dots] - self.design

    def cost(self, shared: Shared, huber: float) -> float:
        """Squared residuals over σ², Huber's beyond ``huber``; infinite behind a camera."""
        own = self.board_residual() + self.design - self.expected_dots(shared)
        return image_cost(self.model, shared.camera, huber) + float(((own / self.sigma_mm) ** 2).sum())


@dataclass(frozen=True, slots=True, eq=False)
class Condensed:
    """``normal``, ``right`` over the group's outer unknowns (its circles, dots of the common shape, intrinsics), and
    what brings a step of those back to the others."""

    normal: np.ndarray
    right: np.ndarray
    inner_step: np.ndarray
    inner_from_outer: np.ndarray
    camera_step: np.ndarray
    camera_from_kept: np.ndarray


def normalised(model: GroupModel, camera: Camera) -> np.ndarray:
    """Residuals over σ, (n, 2)."""
    return model.whiten(model.residuals_px(camera))


def image_cost(model: GroupModel, camera: Camera, huber: float) -> float:
    """Squared residuals over σ², Huber's beyond ``huber``; infinite behind a camera."""
    if (model.xyz_camera()[:, 2] <= 0).any():
        return np.inf
    length = np.linalg.norm(normalised(model, camera), axis=1)
    short = np.minimum(length, huber)
    return float((short * (2 * length - short)).sum())


def robust_weights(model: GroupModel, camera: Camera, huber: float) -> np.ndarray:
    """Huber's weights, (n,), of the lengths of the residuals over σ."""
    length = np.linalg.norm(normalised(model, camera), axis=1)
    return np.minimum(1.0, huber / np.maximum(length, 1e-12))


def condense(block: Block, shared: Shared, huber: float) -> Condensed:
    """Eliminate cameras, dots and the board's pose."""
    normal, right, camera_step, camera_from_kept = without_cameras(block.model, shared.camera, shared.basis, huber)
    full, full_right, inner, outer = _with_board(block, shared, normal, right)
    inverse = np.linalg.inv(full[np.ix_(inner, inner)])
    coupling = full[np.ix_(inner, outer)]
    back = inverse @ coupling
    return Condensed(
        full[np.ix_(outer, outer)] - coupling.T @ back,
        full_right[outer] - back.T @ full_right[inner],
        inverse @ full_right[inner],
        back,
        camera_step,
        camera_from_kept,
    )


def without_cameras(model: GroupModel, camera: Camera, basis: np.ndarray, huber: float):
    """Normal equations over points (3p) and intrinsics (q), and the way back to the cameras."""
    m, p, q = len(model.images), len(model.labels), basis.shape[1]
    by_pose, by_point = projection_jacobians(model, camera)
    root = np.sqrt(robust_weights(model, camera, huber))[:, None]
    a, c = model.whiten(by_pose) * root[..., None], model.whiten(by_point) * root[..., None]
    residual = normalised(model, camera) * root
    at = np.swapaxes(a, 1, 2)
    camera_block, camera_right = np.zeros((m, 6, 6)), np.zeros((m, 6))
    np.add.at(camera_block, model.image_index, at @ a)
    np.add.at(camera_right, model.image_index, np.einsum("nki,nk->ni", a, residual))
    cross = np.zeros((m, 6, 3 * p + q))
    columns = 3 * model.point_index[:, None] + np.arange(3)
    cross[model.image_index[:, None, None], np.arange(6)[:, None], columns[:, None]] = at @ c
    normal, right = np.zeros((3 * p + q, 3 * p + q)), np.zeros(3 * p + q)
    blocks, rights = np.zeros((p, 3, 3)), np.zeros((p, 3))
    np.add.at(blocks, model.point_index, np.swapaxes(c, 1, 2) @ c)
    np.add.at(rights, model.point_index, np.einsum("nki,nk->ni", c, residual))
    place = 3 * np.arange(p)[:, None] + np.arange(3)
    normal[place[:, :, None], place[:, None]] = blocks
    right[: 3 * p] = rights.ravel()
    if q:
        xyz = model.xyz_camera()
        by_intrinsics = camera.parameter_jacobian(xyz[:, :2] / xyz[:, 2:]) @ basis
        e = model.whiten(by_intrinsics) * root[..., None]
        np.add.at(cross[:, :, 3 * p :], model.image_index, at @ e)
        coupled = np.zeros((p, 3, q))
        np.add.at(coupled, model.point_index, np.swapaxes(c, 1, 2) @ e)
        normal[: 3 * p, 3 * p :] = coupled.reshape(3 * p, q)
        normal[3 * p :, : 3 * p] = normal[: 3 * p, 3 * p :].T
        normal[3 * p :, 3 * p :] = np.einsum("nki,nkj->ij", e, e)
        right[3 * p :] = np.einsum("nki,nk->i", e, residual)
    inverse = np.linalg.inv(camera_block)
    eliminated = inverse @ cross
    flat, weighted = cross.reshape(6 * m, -1), eliminated.reshape(6 * m, -1)
    normal -= flat.T @ weighted
    right -= weighted.T @ camera_right.ravel()
    return normal, right, np.einsum("mij,mj->mi", inverse, camera_right), eliminated


def _with_board(block: Block, shared: Shared, normal: np.ndarray, right: np.ndarray):
    """Append pose of the board and common shape with the observations dot = pose · (design + shape ± σ); indices of
    what is eliminated (dots, pose) and of what stays (circles, shape, intrinsics)."""
    p, q, d = len(block.model.labels), shared.basis.shape[1], len(block.dots)
    s = 3 * len(block.dot_place)
    size = 3 * p + q
    full, full_right = np.zeros((size + 6 + s, size + 6 + s)), np.zeros(size + 6 + s)
    full[:size, :size], full_right[:size] = normal, right
    rotation = block.world_from_board.rotation
    turned = block.expected_dots(shared) @ rotation.T
    gap = block.model.xyz_world[block.dots] - (turned + block.world_from_board.translation)
    jacobian = np.zeros((3 * d, size + 6 + s))
    rows = np.arange(3 * d).reshape(d, 3)
    jacobian[rows, 3 * block.dots[:, None] + np.arange(3)] = 1
    by_pose = np.concatenate([skew(turned), -np.broadcast_to(np.eye(3), (d, 3, 3))], axis=2)
    jacobian[:, size : size + 6] = by_pose.reshape(3 * d, 6)
    if s:
        jacobian[rows[:, :, None], (size + 6 + rows)[:, None]] = -rotation
    full += jacobian.T @ jacobian / block.sigma_mm**2
    full_right -= jacobian.T @ gap.ravel() / block.sigma_mm**2
    dots = (3 * block.dots[:, None] + np.arange(3)).ravel()
    circles = (3 * block.circles[:, None] + np.arange(3)).ravel()
    inner = np.concatenate([dots, size + np.arange(6)])
    outer = np.concatenate([circles, size + 6 + np.arange(s), 3 * p + np.arange(q)]).astype(int)
    return full, full_right, inner, outer


def moved(block: Block, condensed: Condensed, outer_step: np.ndarray, intrinsics_step: np.ndarray, factor: float):
    """The group after a step of its outer unknowns, everything else following."""
    model = block.model
    p, d = len(model.labels), len(block.dots)
    inner_step = condensed.inner_step - condensed.inner_from_outer @ outer_step
    points = np.zeros((p, 3))
    points[block.circles] = outer_step[: 3 * len(block.circles)].reshape(-1, 3)
    points[block.dots] = inner_step[: 3 * d].reshape(-1, 3)
    kept = np.concatenate([points.ravel(), intrinsics_step])
    poses = factor * (condensed.camera_step - condensed.camera_from_kept @ kept)
    turned = Rotation.from_rotvec(poses[:, :3]).as_matrix()
    cameras = tuple(
        Rigid(turn @ pose.rotation, pose.translation + step[3:])
        for turn, pose, step in zip(turned, model.camera_from_world, poses, strict=True)
    )
    board_step = factor * inner_step[3 * d :]
    board = Rigid(
        Rotation.from_rotvec(board_step[:3]).as_matrix() @ block.world_from_board.rotation,
        block.world_from_board.translation + board_step[3:],
    )
    changed = replace(model, camera_from_world=cameras, xyz_world=model.xyz_world + factor * points)
    return replace(block, model=changed, world_from_board=board)
