"""Normal equations of the joint adjustment over circles and intrinsics, with the dots eliminated before the cameras.

This order suits boards of many dots in few images: each dot, with its place in the common shape, is a small set of
unknowns that no other dot shares, and only the cameras remain. (:mod:`stcal.sfm.adjust.equations` uses the opposite
order, for many images.)
"""

from collections.abc import Sequence

import numpy as np

from stcal.geometry.normal_equations import blocks_of
from stcal.geometry.rigid import skew
from stcal.sfm.adjust.blocks import Block, Shared
from stcal.sfm.adjust.equations import Setting, add_knowledge
from stcal.sfm.adjust.group import projection_jacobians


def is_cheaper(blocks: Sequence[Block]) -> bool:
    """True if the cameras of all groups are fewer unknowns than the dots of the group that has most of them."""
    return 6 * sum(len(b.model.images) for b in blocks) < 3 * max(len(b.dots) for b in blocks)


def circle_equations(blocks: Sequence[Block], shared: Shared, setting: Setting) -> np.ndarray:
    """Returns the normal matrix (3c + q, 3c + q) over circles and intrinsics, with all other unknowns eliminated.

    No residual is down-weighted.
    """
    size = 3 * len(setting.labels) + shared.basis.shape[1]
    ends = size + np.cumsum([0, *(6 * len(b.model.images) + 6 for b in blocks)])
    normal = np.zeros((ends[-1], ends[-1]))
    dots = len(shared.shape_mm) if setting.common else 0
    shape = np.zeros((dots, 3, 3)) + (np.eye(3) / setting.shape_sigma_mm() ** 2 if dots else 0.0)
    by_shape = np.zeros((dots, 3, ends[-1]))
    for block, start in zip(blocks, ends[:-1].tolist(), strict=True):
        _add_group(block, shared, setting, start, normal, shape, by_shape)
    if dots:
        root = np.linalg.solve(np.linalg.cholesky(shape), by_shape).reshape(3 * dots, -1)
        normal -= root.T @ root
    add_knowledge(normal, None, shared, setting, slice(size - shared.basis.shape[1], size))
    inner, cross = normal[size:, size:], normal[size:, :size]
    return normal[:size, :size] - cross.T @ np.linalg.solve(inner, cross)


def _add_group(block: Block, shared: Shared, setting: Setting, start: int, normal, shape, by_shape) -> None:
    """Adds the equations of one group: cameras and board pose from ``start`` on, with the dots eliminated."""
    model, q, d = block.model, shared.basis.shape[1], len(block.dots)
    m, first = len(model.images), 3 * len(setting.labels)
    width = 6 * m + 6 + q  # cameras, pose, intrinsics
    place = np.concatenate([np.arange(start, start + 6 * m + 6), np.arange(first, first + q)])
    local = np.zeros((width, width))
    cross = np.zeros((len(model.labels), 3, width))
    by_pose, by_point = (model.whiten(derivative) for derivative in projection_jacobians(model, shared.camera))
    zeros = np.zeros(by_point.shape[:2])
    points, _ = blocks_of(by_point, zeros, model.point_index, len(model.labels))
    cameras, _ = blocks_of(by_pose, zeros, model.image_index, m)
    columns = 6 * model.image_index[:, None] + np.arange(6)
    cross[model.point_index[:, None, None], np.arange(3)[:, None], columns[:, None]] = (
        np.swapaxes(by_point, 1, 2) @ by_pose
    )
    index = 6 * np.arange(m)[:, None] + np.arange(6)
    local[index[:, :, None], index[:, None]] = cameras
    if q:
        xyz, last = model.xyz_camera(), slice(6 * m + 6, width)
        by_intrinsics = model.whiten(shared.camera.parameter_jacobian(xyz[:, :2] / xyz[:, 2:]) @ shared.basis)
        np.add.at(cross[:, :, last], model.point_index, np.swapaxes(by_point, 1, 2) @ by_intrinsics)
        coupled = np.zeros((m, 6, q))
        np.add.at(coupled, model.image_index, np.swapaxes(by_pose, 1, 2) @ by_intrinsics)
        local[: 6 * m, last] = coupled.reshape(6 * m, q)
        local[last, : 6 * m] = local[: 6 * m, last].T
        flat = by_intrinsics.reshape(-1, q)
        local[last, last] = flat.T @ flat

    circles = (3 * block.circle_place[:, None] + np.arange(3)).ravel()
    index = 3 * block.circle_place[:, None] + np.arange(3)
    normal[index[:, :, None], index[:, None]] += points[block.circles]
    coupled = cross[block.circles].reshape(-1, width)
    normal[np.ix_(circles, place)] += coupled
    normal[np.ix_(place, circles)] += coupled.T

    rotation, weight = block.model_from_board.rotation, 1 / block.sigma_mm**2
    turned = block.expected_dots(shared) @ rotation.T
    by_board = np.concatenate([skew(turned), -np.broadcast_to(np.eye(3), (d, 3, 3))], axis=2)
    pose = slice(6 * m, 6 * m + 6)
    local[pose, pose] += weight * by_board.reshape(3 * d, 6).T @ by_board.reshape(3 * d, 6)
    inner, outer = points[block.dots] + weight * np.eye(3), cross[block.dots]
    outer[:, :, pose] += weight * by_board
    from_outer = np.linalg.solve(inner, outer)
    local -= outer.reshape(3 * d, width).T @ from_outer.reshape(3 * d, width)
    normal[np.ix_(place, place)] += local
    if len(block.dot_place):
        to_shape = -weight * rotation
        shape[block.dot_place] += weight * np.eye(3) - to_shape.T @ np.linalg.solve(
            inner, np.broadcast_to(to_shape, (d, 3, 3))
        )
        by_shape_reduced = -to_shape.T @ from_outer
        by_shape_reduced[:, :, pose] -= weight * rotation.T @ by_board
        by_shape[block.dot_place[:, None, None], np.arange(3)[:, None], place] += by_shape_reduced
