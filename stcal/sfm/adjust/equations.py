"""Normal equations: of one group, reduced to the unknowns that all groups share, and of the joint adjustment."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from stcal.design import BoardDesign, faces_of_known_shape, known_distances
from stcal.errors import DegenerateError
from stcal.geometry.camera import Camera
from stcal.geometry.least_squares import perturbed
from stcal.geometry.normal_equations import Reduction, blocks_of, free_motions, reduce
from stcal.geometry.plane import fit_plane
from stcal.geometry.print_modes import AMPLITUDES
from stcal.geometry.rigid import Rigid, skew
from stcal.geometry.robust import huber_cost, huber_weights
from stcal.labels import CircleLabel
from stcal.sfm.adjust.faces import Shape
from stcal.sfm.adjust.refine import moved_poses, projection_jacobians
from stcal.sfm.adjust.scale import known_points
from stcal.sfm.data.model import GroupModel, MetricModel


@dataclass(frozen=True, slots=True, eq=False)
class Shared:
    """Unknowns that all groups share."""

    xyz_model: np.ndarray  # (c, 3) circles, mm
    shape_mm: np.ndarray  # (d, 3) deviation of the dots from the design common to all groups, board frame
    camera: Camera
    basis: np.ndarray  # (16, q) derivative of the camera's parameters by those that are adjusted


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """One group of the joint adjustment."""

    model: MetricModel
    model_from_board: Rigid
    design: np.ndarray  # (e, 3) of its dots, board frame
    sigma_mm: float  # of a dot about the common shape
    dots: np.ndarray  # indices of the model's points, as ``circles``
    circles: np.ndarray
    dot_place: np.ndarray  # (e,) in the common shape, empty if each group has its own
    circle_place: np.ndarray  # of each circle among all
    # (3p + q, 3p + q) normal matrix of points and intrinsics from images, if known
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
    """Normal equations over a group's outer unknowns: its circles, dots of the common shape, intrinsics."""

    normal: np.ndarray
    right: np.ndarray
    inner: Reduction  # gives the step of dots and board from that of the outer unknowns
    cameras: Reduction | None  # then gives the step of the cameras, if these are moved

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
    """Normal equations of a model's m images over p points and s other unknowns."""

    normal: np.ndarray  # (3p + s, 3p + s)
    right: np.ndarray
    block: np.ndarray  # (m, 6, 6) of the poses
    block_right: np.ndarray
    cross: np.ndarray  # (m, 6, 3p + s)


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
    residual = normalised(model, camera)
    root = np.sqrt(huber_weights(np.linalg.norm(residual, axis=1), huber))[:, None]
    by_intrinsics = np.zeros((*by_pose.shape[:2], 0))
    if basis.shape[1]:
        by_intrinsics = model.by_parameters(camera) @ basis
    a, c, e = (model.whiten(d) * root[..., None] for d in (by_pose, by_point, by_intrinsics))
    equations = equations_of_poses(model, a, c, e, residual * root)
    cameras = reduce(equations.block, equations.block_right, equations.cross)
    return equations.normal - cameras.normal, equations.right - cameras.right, cameras


def rows_of_view(
    model: GroupModel, camera: Camera, basis: np.ndarray, root: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Whitened equations (2n − 6, 3p + q) of one image over points and intrinsics, orthogonal to its pose, and the
    directions (2n, 2n − 6) of its coordinates that they are; ``root``: (2n,) of robust weights."""
    by_pose, by_point = projection_jacobians(model, camera)
    n, p = len(model.point_index), len(model.labels)
    rows = np.zeros((n, 2, 3 * p + basis.shape[1]))
    columns = 3 * model.point_index[:, None] + np.arange(3)
    rows[np.arange(n)[:, None, None], np.arange(2)[:, None], columns[:, None]] = model.whiten(by_point)
    rows[:, :, 3 * p :] = model.whiten(model.by_parameters(camera) @ basis)
    weight = (np.ones(2 * n) if root is None else root)[:, None]
    across = np.linalg.qr(weight * model.whiten(by_pose).reshape(2 * n, 6), mode="complete")[0][:, 6:]
    return across.T @ (weight * rows.reshape(2 * n, -1)), across


def _with_board(block: Block, shared: Shared, normal: np.ndarray, right: np.ndarray):
    """Appends pose of the board and common shape with the observations dot = pose · (design + shape ± σ); returns the
    indices of the eliminated unknowns (dots, pose) and of the rest (circles, shape, intrinsics) last."""
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
    full[pose, pose] += weight * flat.T @ flat if d else np.eye(6)  # without a board its pose stays
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


FREE_DIRECTIONS = 6
"""Number of free directions: a rigid motion of the world changes nothing."""


@dataclass(frozen=True, slots=True)
class Places:
    """Indices of circles, common shape and intrinsics among the shared unknowns, and the number of all of them."""

    circles: slice
    shape: slice
    intrinsics: slice
    count: int


@dataclass(frozen=True, slots=True, eq=False)
class Setting:
    """Constants of one minimisation."""

    labels: tuple[CircleLabel, ...]
    board: BoardDesign
    common: float
    flatness_mm: float  # infinite if unknown
    given: Camera
    prior: np.ndarray
    huber: float
    print_factor: float = 1.0  # on the stated σ of faces of known shape, in their plane
    bend_factor: float = 1.0  # off their plane
    print_amplitude: float = AMPLITUDES[0]  # of the smooth deviations of their prints

    def places(self, shared: Shared) -> "Places":
        """Returns the indices of the shared unknowns."""
        c = 3 * len(self.labels)
        s = c + (3 * len(shared.shape_mm) if self.common else 0)
        count = s + shared.basis.shape[1]
        return Places(slice(0, c), slice(c, s), slice(s, count), count)

    def outer(self, block: Block, shared: Shared) -> np.ndarray:
        """Returns the indices of a group's outer unknowns among all shared ones: circles, shape, intrinsics."""
        places = self.places(shared)
        circles = (3 * block.circle_place[:, None] + np.arange(3)).ravel()
        shape = places.shape.start + (3 * block.dot_place[:, None] + np.arange(3)).ravel()
        intrinsics = np.arange(places.intrinsics.start, places.intrinsics.stop)
        return np.concatenate([circles, shape, intrinsics]).astype(int)

    def own_sigma_mm(self) -> float:
        return self.board.sigma_mm * float(np.sqrt(1 - self.common))

    def shape_sigma_mm(self) -> float:
        return self.board.sigma_mm * float(np.sqrt(self.common))


@dataclass(frozen=True, slots=True, eq=False)
class JointState:
    """All unknowns of the joint adjustment."""

    blocks: tuple[Block, ...]
    shared: Shared

    def moved(self, step: np.ndarray, setting: Setting) -> "JointState":
        """Returns the state after a step, which lists the shared unknowns and then each group's own."""
        shared, places = self.shared, setting.places(self.shared)
        ends = places.count + np.cumsum([0, *(_size(b) for b in self.blocks)])
        blocks = tuple(moved(b, step[i:j]) for b, i, j in zip(self.blocks, ends[:-1], ends[1:], strict=True))
        shape = shared.shape_mm + step[places.shape].reshape(-1, 3) if setting.common else shared.shape_mm
        camera = shared.camera
        if shared.basis.shape[1]:
            camera = camera.with_parameters(camera.parameters() + shared.basis @ step[places.intrinsics])
        xyz = shared.xyz_model + step[places.circles].reshape(-1, 3)
        return JointState(blocks, Shared(xyz, shape, camera, shared.basis))


def _size(block: Block) -> int:
    """Returns the number of a group's own unknowns, including points that it shares."""
    return 3 * len(block.model.labels) + 6 * len(block.model.images) + 6


@dataclass(frozen=True, slots=True, eq=False)
class SharedEquations:
    """Normal equations over the shared unknowns, with each group's own unknowns eliminated."""

    cost: float
    state: JointState
    setting: Setting
    normal: np.ndarray
    right: np.ndarray
    groups: tuple[Reduced, ...]

    @classmethod
    def of(cls, state: JointState, setting: Setting) -> "SharedEquations":
        cost = cost_of(state.blocks, state.shared, setting)
        return cls(cost, state, setting, *normal_equations(state.blocks, state.shared, setting))

    def step(self, damping: float | np.ndarray) -> tuple[np.ndarray, float]:
        """Returns the step of the shared unknowns, then of each group's own, and its predicted gain."""
        setting, shared = self.setting, self.state.shared
        free = free_directions(len(self.normal), shared)
        held = self.normal + damping * np.diag(np.diag(self.normal))
        held += np.median(np.diag(self.normal)[: shared.xyz_model.size]) * free @ free.T
        outer = np.linalg.solve(held, self.right)
        gain = 2 * float(outer @ self.right) - float(outer @ self.normal @ outer) + sum(g.gain for g in self.groups)
        intrinsics = outer[setting.places(shared).intrinsics]
        group_steps = [
            step_of(b, g, outer[setting.outer(b, shared)], intrinsics)
            for b, g in zip(self.state.blocks, self.groups, strict=True)
        ]
        return np.concatenate([outer, *group_steps]), gain


def normal_equations(blocks: Sequence[Block], shared: Shared, setting: Setting):
    """Returns matrix and right-hand side over circles, common shape and intrinsics, and the reduced groups."""
    places = setting.places(shared)
    normal, right = np.zeros((places.count, places.count)), np.zeros(places.count)
    groups = tuple(reduced(b, shared, setting.huber) for b in blocks)
    for b, group in zip(blocks, groups, strict=True):
        place = setting.outer(b, shared)
        normal[np.ix_(place, place)] += group.normal
        right[place] += group.right
    if setting.common:
        shape = np.arange(places.shape.start, places.shape.stop)
        normal[shape, shape] += 1 / setting.shape_sigma_mm() ** 2
        right[shape] -= shared.shape_mm.ravel() / setting.shape_sigma_mm() ** 2
    add_knowledge(normal, right, shared, setting, places.intrinsics)
    return normal, right, groups


def add_knowledge(
    normal: np.ndarray, right: np.ndarray | None, shared: Shared, setting: Setting, intrinsics: slice
) -> None:
    """Adds the prior of the intrinsics and the flatness of faces; ``right`` is None if nothing is moved."""
    normal[intrinsics, intrinsics] += setting.prior
    if right is not None:
        right[intrinsics] -= setting.prior @ _away(shared, setting)
    for members, across, normal_model in planes(shared, setting):
        jacobian = across[:, :, None] * normal_model  # derivatives of distances from the plane by the circles
        flat = jacobian.reshape(len(members), -1)
        place = (3 * members[:, None] + np.arange(3)).ravel()
        normal[np.ix_(place, place)] += flat.T @ flat / setting.flatness_mm**2
        if right is not None:
            distance = across @ (shared.xyz_model[members] @ normal_model)
            right[place] -= flat.T @ distance / setting.flatness_mm**2
    for shape in shapes(shared, setting):
        place = (3 * shape.members[:, None] + np.arange(3)).ravel()
        normal[np.ix_(place, place)] += shape.normal()
        if right is not None:
            right[place] -= shape.slope()
    for members, along, off, sigma in bars(shared, setting):
        place = (3 * members[:, None] + np.arange(3)).ravel()
        row = np.concatenate([along, -along]) / sigma
        normal[np.ix_(place, place)] += np.outer(row, row)
        if right is not None:
            right[place] -= row * off / sigma


def planes(shared: Shared, setting: Setting):
    """Yields the circles of each face of more than three, the projector from heights to distances from the best plane,
    and its normal; not of faces of known shape."""
    if not np.isfinite(setting.flatness_mm):
        return
    known = {face.id for face in faces_of_known_shape(setting.board)}
    faces: dict[str, list[int]] = {}
    for i, label in enumerate(setting.labels):
        if label.face in known:
            continue
        faces.setdefault(label.face, []).append(i)
    for indices in faces.values():
        if len(indices) > 3:
            members = np.array(indices)
            xyz = shared.xyz_model[members]
            normal = fit_plane(xyz).normal
            base = np.linalg.svd(np.eye(3) - np.outer(normal, normal))[0][:, :2]
            design = np.column_stack([np.ones(len(indices)), (xyz - xyz.mean(0)) @ base])
            yield members, np.eye(len(indices)) - design @ np.linalg.pinv(design), normal


def shapes(shared: Shared, setting: Setting) -> Iterator[Shape]:
    """Yields the faces of known shape, with their stated σ; none for a state that a step has sent to infinity."""
    if not np.isfinite(shared.xyz_model).all():
        return
    off, known = setting.bend_factor * setting.flatness_mm, known_points(setting.labels, setting.board)
    # What the sizes of all prints have in common counts once: each alone may be off by more.
    alone = float(np.sqrt(len(known)))
    for face, members in known:
        design = face.places_mm(setting.labels[i].circle for i in members)
        within = setting.print_factor * (face.sigma_mm or 1.0)
        weight = np.tile([within**-2, within**-2, 0.0 if np.isinf(off) else off**-2], (len(members), 1))
        try:
            yield Shape.of(
                members,
                design,
                shared.xyz_model[members],
                weight,
                alone * face.size_sigma,
                setting.print_amplitude,
            )
        except DegenerateError:  # corners on a line
            continue


def bars(shared: Shared, setting: Setting) -> Iterator[tuple[np.ndarray, np.ndarray, float, float]]:
    """Yields the known distances: both points, the direction to the first, how much too long, and σ, mm."""
    place = {label: i for i, label in enumerate(setting.labels)}
    for known in known_distances(setting.board):
        if known.first in place and known.second in place:
            members = np.array([place[known.first], place[known.second]])
            apart = shared.xyz_model[members[0]] - shared.xyz_model[members[1]]
            length = float(np.linalg.norm(apart))
            yield members, apart / length, length - known.mm, known.sigma_mm


def _away(shared: Shared, setting: Setting) -> np.ndarray:
    """Returns adjusted minus given intrinsics, (q,)."""
    return np.linalg.pinv(shared.basis) @ (shared.camera.parameters() - setting.given.parameters())


def cost_of(blocks: Sequence[Block], shared: Shared, setting: Setting) -> float:
    cost = sum(b.cost(shared, setting.huber) for b in blocks)
    if setting.common:
        cost += float(((shared.shape_mm / setting.shape_sigma_mm()) ** 2).sum())
    if shared.basis.shape[1]:
        away = _away(shared, setting)
        cost += float(away @ setting.prior @ away)
    for members, across, normal in planes(shared, setting):
        cost += float(((across @ (shared.xyz_model[members] @ normal)) ** 2).sum()) / setting.flatness_mm**2
    cost += sum(shape.cost() for shape in shapes(shared, setting))
    return cost + sum((off / sigma) ** 2 for _, _, off, sigma in bars(shared, setting))


def free_directions(count: int, shared: Shared) -> np.ndarray:
    """Directions (count, 6) in which all circles move as one; the datum is that of smallest trace over them."""
    free = np.zeros((count, FREE_DIRECTIONS))
    free[: shared.xyz_model.size] = free_motions(shared.xyz_model, scale=False)
    return free


def is_dots_first_cheaper(blocks: Sequence[Block]) -> bool:
    """True if the cameras of all groups are fewer unknowns than the dots of the group that has most of them."""
    return 6 * sum(len(b.model.images) for b in blocks) < 3 * max(len(b.dots) for b in blocks)


def circle_equations(blocks: Sequence[Block], shared: Shared, setting: Setting) -> np.ndarray:
    """Returns the normal matrix (3c + q, 3c + q) over circles and intrinsics; no residual is down-weighted."""
    size = 3 * len(setting.labels) + shared.basis.shape[1]
    ends = size + np.cumsum([0, *(6 * len(b.model.images) + 6 for b in blocks)])
    normal = np.zeros((ends[-1], ends[-1]))
    dots = len(shared.shape_mm) if setting.common else 0
    shape = np.zeros((dots, 3, 3)) + (np.eye(3) / setting.shape_sigma_mm() ** 2 if dots else 0.0)
    by_shape = np.zeros((dots, 3, ends[-1]))
    for block, start in zip(blocks, ends[:-1].tolist(), strict=True):
        _add_group(block, shared, setting, start, normal, shape, by_shape)
    if dots:
        root = (np.linalg.inv(np.linalg.cholesky(shape)) @ by_shape).reshape(3 * dots, -1)
        normal -= root.T @ root
    add_knowledge(normal, None, shared, setting, slice(size - shared.basis.shape[1], size))
    inner, cross = normal[size:, size:], normal[size:, :size]
    return normal[:size, :size] - cross.T @ np.linalg.solve(inner, cross)


def _add_group(block: Block, shared: Shared, setting: Setting, start: int, normal, shape, by_shape) -> None:
    """Adds the equations of one group: cameras and board pose from ``start`` on, with the dots eliminated."""
    model, q, d = block.model, shared.basis.shape[1], len(block.dots)
    m, first = len(model.images), 3 * len(setting.labels)
    width = 6 * m + 6 + q  # cameras, pose, intrinsics
    parts = (slice(start, start + 6 * m + 6), slice(0, 6 * m + 6)), (slice(first, first + q), slice(6 * m + 6, width))
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
        last = slice(6 * m + 6, width)
        by_intrinsics = model.whiten(model.by_parameters(shared.camera) @ shared.basis)
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
    local[pose, pose] += weight * by_board.reshape(3 * d, 6).T @ by_board.reshape(3 * d, 6) if d else np.eye(6)
    inverse, outer = np.linalg.inv(points[block.dots] + weight * np.eye(3)), cross[block.dots]
    outer[:, :, pose] += weight * by_board
    from_outer = inverse @ outer
    local -= outer.reshape(3 * d, width).T @ from_outer.reshape(3 * d, width)
    normal[np.ix_(place, place)] += local
    if len(block.dot_place):
        to_shape = -weight * rotation
        shape[block.dot_place] += weight * np.eye(3) - to_shape.T @ inverse @ to_shape
        by_shape_reduced = -to_shape.T @ from_outer
        by_shape_reduced[:, :, pose] -= weight * rotation.T @ by_board
        for of_all, own in parts:
            by_shape[block.dot_place, :, of_all] += by_shape_reduced[:, :, own]
