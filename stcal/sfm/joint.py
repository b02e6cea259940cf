"""One adjustment over all groups: one target, one board shape with a pose for each group, all cameras.

Board positions are observations with their stated σ, so scale is part of the estimate. Cameras are eliminated image
by image and boards group by group (Helmert blocking), which leaves one small normal matrix over the target's circles
however many images there are; its inverse is the marginal covariance of the circles, everything else accounted for.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.design import BoardDesign, TargetDesign
from stcal.errors import ConvergenceError
from stcal.geometry.align import align_rigid
from stcal.geometry.arrays import frozen
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid, skew
from stcal.sfm.adjust import projection_jacobians
from stcal.sfm.chain import CalibratedTarget
from stcal.sfm.faces import FrameKind, face_frame
from stcal.sfm.model import GroupModel
from stcal.sfm.observations import face_of, is_board

MAX_STEPS = 30
MAX_HALVINGS = 8
SETTLED_PX = 1e-7
FREE_DIRECTIONS = 6
"""The world may be anywhere: a rigid motion of everything changes nothing."""


@dataclass(frozen=True, slots=True, eq=False)
class JointResult:
    """The adjusted models, in one metric world.

    ``models`` : one for each group, mm; ``world_from_board`` by group; ``labels`` : (c,) of the target's circles;
    ``xyz_world`` : (c, 3) mm; ``covariance_mm2`` : (3c, 3c) marginal, in the datum of smallest trace, scaled by
    ``sigma0``²; ``sigma0`` : residuals against the centres' own σ; ``board_residuals_mm`` by group: (n, 3), board
    frame; ``redundancy`` : degrees of freedom.
    """

    models: tuple[GroupModel, ...]
    world_from_board: dict[str, Rigid]
    labels: tuple[str, ...]
    xyz_world: np.ndarray
    covariance_mm2: np.ndarray
    sigma0: float
    board_residuals_mm: dict[str, np.ndarray]
    redundancy: int

    def __post_init__(self):
        c = len(self.labels)
        object.__setattr__(self, "xyz_world", frozen(self.xyz_world, (c, 3), "circles"))
        object.__setattr__(self, "covariance_mm2", frozen(self.covariance_mm2, (3 * c, 3 * c), "covariance"))


@dataclass(frozen=True, slots=True, eq=False)
class _Block:
    """One group: its model and board, and which of its points are which circles of the target."""

    model: GroupModel
    board: Rigid
    design: np.ndarray
    sigma_mm: float
    dots: np.ndarray
    circles: np.ndarray
    place: np.ndarray

    def board_residual(self) -> np.ndarray:
        """Reconstructed minus design, (d, 3), board frame, mm."""
        return self.board.inverse() @ self.model.xyz_world[self.dots] - self.design

    def cost(self, camera: Camera) -> float:
        if (self.model.xyz_camera()[:, 2] <= 0).any():
            return np.inf
        image = (self.model.residuals_px(camera) / self.model.sigma_px[:, None]) ** 2
        return float(image.sum() + ((self.board_residual() / self.sigma_mm) ** 2).sum())


def adjust_jointly(models: list[GroupModel], board: BoardDesign, camera: Camera) -> JointResult:
    """Adjust metric models that share one world (mm), all observations weighted by their σ.

    Raises
    ------
    ConvergenceError
        No minimum is reached.
    """
    labels = sorted({label for model in models for label in model.labels if not is_board(label)})
    blocks = [_block(model, board, labels) for model in models]
    xyz = _shared_circles(blocks, len(labels))
    blocks = [replace(b, model=_with_circles(b, xyz)) for b in blocks]
    cost = sum(b.cost(camera) for b in blocks)
    move = np.inf
    for _ in range(MAX_STEPS):
        normal, right, condensed = _condense(blocks, camera, len(labels))
        step = (_inverse(normal) @ right).reshape(-1, 3)
        for halving in range(MAX_HALVINGS):
            trial = [_moved(b, c, step, 0.5**halving) for b, c in zip(blocks, condensed, strict=True)]
            trial_cost = sum(b.cost(camera) for b in trial)
            if trial_cost <= cost * (1 + 1e-9):
                break
        move = max(_largest_move(old, new, camera) for old, new in zip(blocks, trial, strict=True))
        if trial_cost <= cost * (1 + 1e-9):
            blocks, xyz, cost = trial, xyz + 0.5**halving * step, trial_cost
        if move < SETTLED_PX or halving == MAX_HALVINGS - 1:
            break
    if move > 1e3 * SETTLED_PX:
        raise ConvergenceError(
            f"joint adjustment: projections still move by {move:.1g} px after {MAX_STEPS} steps; "
            "compare with --solve chain and look at the outliers"
        )
    return _result(blocks, labels, xyz, camera)


def _block(model: GroupModel, board: BoardDesign, labels: list[str]) -> _Block:
    place = {label: i for i, label in enumerate(labels)}
    dots = np.array([i for i, label in enumerate(model.labels) if is_board(label)])
    circles = np.array([i for i, label in enumerate(model.labels) if not is_board(label)])
    cells = np.array([[int(v) for v in model.labels[i].split(":")[1:]] for i in dots])
    design = np.column_stack([board.pitch_mm * cells[:, ::-1], np.zeros(len(cells))])
    return _Block(
        model,
        align_rigid(model.xyz_world[dots], design),
        design,
        board.sigma_mm,
        dots,
        circles,
        np.array([place[model.labels[i]] for i in circles], int),
    )


def _shared_circles(blocks: list[_Block], count: int) -> np.ndarray:
    """Start values: the mean over the groups."""
    total, seen = np.zeros((count, 3)), np.zeros(count)
    for b in blocks:
        np.add.at(total, b.place, b.model.xyz_world[b.circles])
        np.add.at(seen, b.place, 1)
    return total / seen[:, None]


def _with_circles(block: _Block, xyz: np.ndarray) -> GroupModel:
    points = block.model.xyz_world.copy()
    points[block.circles] = xyz[block.place]
    return replace(block.model, xyz_world=points)


@dataclass(frozen=True, slots=True, eq=False)
class _Condensed:
    """What brings a step of the circles back to the board and the cameras of one group."""

    inner_inverse: np.ndarray
    inner_right: np.ndarray
    inner_from_circles: np.ndarray
    camera_inverse: np.ndarray
    camera_right: np.ndarray
    camera_from_points: np.ndarray


def _condense(blocks: list[_Block], camera: Camera, count: int):
    """Normal equations over all circles, the rest eliminated."""
    normal, right = np.zeros((count, 3, count, 3)), np.zeros((count, 3))
    condensed = []
    for b in blocks:
        each, small, small_right = _condense_group(b, camera)
        k = len(b.place)
        normal[np.ix_(b.place, range(3), b.place, range(3))] += small.reshape(k, 3, k, 3)
        right[b.place] += small_right.reshape(k, 3)
        condensed.append(each)
    return normal.reshape(3 * count, 3 * count), right.ravel(), condensed


def _condense_group(b: _Block, camera: Camera) -> tuple[_Condensed, np.ndarray, np.ndarray]:
    model = b.model
    m, p = len(model.images), len(model.labels)
    by_pose, by_point = projection_jacobians(model, camera)
    weight = 1 / model.sigma_px[:, None]
    a, c = by_pose * weight[..., None], by_point * weight[..., None]
    residual = model.residuals_px(camera) * weight
    camera_block, camera_right = np.zeros((m, 6, 6)), np.zeros((m, 6))
    np.add.at(camera_block, model.image_index, np.swapaxes(a, 1, 2) @ a)
    np.add.at(camera_right, model.image_index, np.einsum("nki,nk->ni", a, residual))
    cross = np.zeros((m, p, 6, 3))
    np.add.at(cross, (model.image_index, model.point_index), np.swapaxes(a, 1, 2) @ c)
    cross = np.moveaxis(cross, 2, 1).reshape(m, 6, 3 * p)
    point_block, right = np.zeros((p, 3, 3)), np.zeros((p, 3))
    np.add.at(point_block, model.point_index, np.swapaxes(c, 1, 2) @ c)
    np.add.at(right, model.point_index, np.einsum("nki,nk->ni", c, residual))

    inverse = np.linalg.inv(camera_block)
    eliminated = inverse @ cross
    normal = -np.tensordot(cross, eliminated, axes=([0, 1], [0, 1])).reshape(p, 3, p, 3)
    normal[np.arange(p), :, np.arange(p)] += point_block
    right = right.ravel() - np.tensordot(eliminated, camera_right, axes=([0, 1], [0, 1]))

    full, full_right = _add_board(b, normal.reshape(3 * p, 3 * p), right)
    outer = (3 * b.circles[:, None] + np.arange(3)).ravel()
    inner = np.setdiff1d(np.arange(len(full)), outer)
    inner_inverse = np.linalg.inv(full[np.ix_(inner, inner)])
    coupling = full[np.ix_(inner, outer)]
    back = inner_inverse @ coupling
    condensed = _Condensed(inner_inverse, full_right[inner], back, inverse, camera_right, eliminated)
    return condensed, full[np.ix_(outer, outer)] - coupling.T @ back, full_right[outer] - back.T @ full_right[inner]


def _add_board(b: _Block, normal: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Append the board's pose (rotation, translation) and the observations dot = pose · (design ± σ)."""
    size, d = len(right), len(b.dots)
    full, full_right = np.zeros((size + 6, size + 6)), np.zeros(size + 6)
    full[:size, :size], full_right[:size] = normal, right
    turned = b.design @ b.board.rotation.T
    gap = b.model.xyz_world[b.dots] - (turned + b.board.translation)
    by_pose = np.concatenate([skew(turned), -np.broadcast_to(np.eye(3), (d, 3, 3))], axis=2)
    weight = 1 / b.sigma_mm**2
    rows = (3 * b.dots[:, None] + np.arange(3)).ravel()
    flat = by_pose.reshape(3 * d, 6)
    full[rows, rows] += weight
    full[size:, size:] += weight * flat.T @ flat
    full[rows, size:] += weight * flat
    full[size:, rows] += weight * flat.T
    full_right[rows] -= weight * gap.ravel()
    full_right[size:] -= weight * flat.T @ gap.ravel()
    return full, full_right


def _inverse(normal: np.ndarray) -> np.ndarray:
    """Inverse on the complement of the free directions (inner constraints: the datum of smallest trace)."""
    value, vector = np.linalg.eigh(normal)
    return (vector[:, FREE_DIRECTIONS:] / value[FREE_DIRECTIONS:]) @ vector[:, FREE_DIRECTIONS:].T


def _moved(b: _Block, condensed: _Condensed, circle_step: np.ndarray, factor: float) -> _Block:
    """The group after a step of the circles, everything else following."""
    model = b.model
    p = len(model.labels)
    outer_step = circle_step[b.place].ravel()
    inner_step = condensed.inner_inverse @ condensed.inner_right - condensed.inner_from_circles @ outer_step
    outer = (3 * b.circles[:, None] + np.arange(3)).ravel()
    full = np.zeros(3 * p + 6)
    full[outer] = outer_step
    full[np.setdiff1d(np.arange(3 * p + 6), outer)] = inner_step
    poses = np.einsum("mij,mj->mi", condensed.camera_inverse, condensed.camera_right)
    poses = factor * (poses - condensed.camera_from_points @ full[: 3 * p])
    turned = Rotation.from_rotvec(poses[:, :3]).as_matrix()
    cameras = tuple(
        Rigid(turn @ pose.rotation, pose.translation + step[3:])
        for turn, pose, step in zip(turned, model.camera_from_world, poses, strict=True)
    )
    board_step = factor * full[3 * p :]
    board = Rigid(
        Rotation.from_rotvec(board_step[:3]).as_matrix() @ b.board.rotation, b.board.translation + board_step[3:]
    )
    xyz = model.xyz_world + factor * full[: 3 * p].reshape(p, 3)
    return replace(b, model=replace(model, camera_from_world=cameras, xyz_world=xyz), board=board)


def _largest_move(old: _Block, new: _Block, camera: Camera) -> float:
    return float(np.abs(new.model.residuals_px(camera) - old.model.residuals_px(camera)).max(initial=0.0))


def _result(blocks: list[_Block], labels: list[str], xyz: np.ndarray, camera: Camera) -> JointResult:
    normal, _, _ = _condense(blocks, camera, len(labels))
    cost = sum(b.cost(camera) for b in blocks)
    observations = sum(2 * len(b.model.image_index) + 3 * len(b.dots) for b in blocks)
    unknowns = 3 * len(labels) + sum(6 * len(b.model.images) + 3 * len(b.dots) + 6 for b in blocks)
    redundancy = observations - unknowns + FREE_DIRECTIONS
    sigma0 = float(np.sqrt(cost / max(redundancy, 1)))
    return JointResult(
        tuple(b.model for b in blocks),
        {b.model.group: b.board for b in blocks},
        tuple(labels),
        xyz,
        sigma0**2 * _inverse(normal),
        sigma0,
        {b.model.group: b.board_residual() for b in blocks},
        redundancy,
    )


def calibrated_target(
    result: JointResult, start: CalibratedTarget, target: TargetDesign, kind: FrameKind
) -> CalibratedTarget:
    """Faces and circles of the adjusted target in the target frame, with their marginal covariances.

    ``start`` tells the reference face and to which side each face looks. Poses and circles in the target frame are
    functions of all circles, whatever the datum; covariances are propagated by central differences.
    """
    step = 1e-3
    own = _frames(result, result.xyz_world, start, target, kind)
    origin = _in_target_frame(own, result.xyz_world, start)
    twists, circles = [], []
    for i, label in enumerate(result.labels):
        for axis in range(3):
            ends = []
            for sign in (1, -1):
                xyz = result.xyz_world.copy()
                xyz[i, axis] += sign * step
                moved = _frames(result, xyz, start, target, kind, only=face_of(label))
                ends.append(_in_target_frame(own | moved, xyz, start))
            ahead, behind = ends
            twists.append({f: _perturbation(ahead[0][f], behind[0][f]) / (2 * step) for f in own})
            circles.append((ahead[1] - behind[1]) / (2 * step))
    by_circle = np.stack(circles, axis=-1)
    covariance = result.covariance_mm2
    face_covariance = {}
    for face_id in origin[0]:
        jacobian = np.column_stack([twist[face_id] for twist in twists])
        face_covariance[face_id] = jacobian @ covariance @ jacobian.T
    blocks = np.einsum("cip,pq,cjq->cij", by_circle, covariance, by_circle, optimize=True)
    reference_from_world = origin[2]
    return CalibratedTarget(
        start.reference_face,
        origin[0],
        dict(zip(result.labels, origin[1], strict=True)),
        dict.fromkeys(start.target_from_group, reference_from_world),
        face_covariance,
        dict(zip(result.labels, blocks, strict=True)),
    )


def _perturbation(ahead: Rigid, behind: Rigid) -> np.ndarray:
    """Rotation (rad) and translation (mm) between two close poses, in the frame they lead to, about the origin of b."""
    rotation = Rotation.from_matrix(ahead.rotation @ behind.rotation.T).as_rotvec()
    return np.concatenate([rotation, ahead.translation - behind.translation])


def _frames(
    result: JointResult, xyz_world, start: CalibratedTarget, target: TargetDesign, kind: FrameKind, only=None
) -> dict[str, Rigid]:
    """world_from_face of all faces, or of one."""
    frames = {}
    for face in target.faces:
        if face.id in start.target_from_face and only in (None, face.id):
            own = {
                label.split(":", 1)[1]: xyz
                for label, xyz in zip(result.labels, xyz_world, strict=True)
                if face_of(label) == face.id
            }
            frames[face.id] = face_frame(face, own, kind, start.target_from_face[face.id].rotation[:, 2])
    return frames


def _in_target_frame(world_from_face: dict[str, Rigid], xyz_world: np.ndarray, start: CalibratedTarget):
    """target_from_face, circles (c, 3) in the target frame, and target_from_world."""
    target_from_world = world_from_face[start.reference_face].inverse()
    return (
        {face_id: target_from_world @ pose for face_id, pose in world_from_face.items()},
        target_from_world @ xyz_world,
        target_from_world,
    )
