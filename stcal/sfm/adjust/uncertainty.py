"""The calibrated target of a joint adjustment, with its marginal covariances."""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from stcal.design import FaceDesign, TargetDesign
from stcal.geometry.rigid import Poses, Rigid
from stcal.sfm.adjust.chain import CalibratedTarget
from stcal.sfm.adjust.faces import (
    FrameKind,
    face_frames,
    missing_frame_circles,
    placement_sigma_mm,
    with_unmapped,
)
from stcal.sfm.adjust.joint import JointResult

STEP_MM = 1e-3
"""Step of the central differences, in mm."""


@dataclass(frozen=True, slots=True, eq=False)
class Derivatives:
    """The target in its own frame, and its derivatives by the circles in the models' frame, mm.

    ``target_from_face`` : by face; ``xyz_target`` : (c, 3); ``target_from_model`` ; ``faces`` : by face, (6, 3c)
    rotation (rad) and translation (mm), perturbation in the target frame; ``circles`` : (c, 3, 3c); ``face_designed`` :
    by face, (6, d), and ``circles_designed`` : (c, 3, d), derivatives by the in-plane positions of frame circles that
    were not mapped; ``designed_sigma_mm`` : σ of these positions.
    """

    target_from_face: dict[str, Rigid]
    xyz_target: np.ndarray
    target_from_model: Rigid
    faces: dict[str, np.ndarray]
    circles: np.ndarray
    face_designed: dict[str, np.ndarray]
    circles_designed: np.ndarray
    designed_sigma_mm: float

    def face_covariance(self, covariance_mm2: np.ndarray) -> dict[str, np.ndarray]:
        """Returns 6×6 by face from the covariance (3c, 3c) of the circles, in any datum."""
        variance = self.designed_sigma_mm**2
        return {
            face_id: jacobian @ covariance_mm2 @ jacobian.T
            + variance * self.face_designed[face_id] @ self.face_designed[face_id].T
            for face_id, jacobian in self.faces.items()
        }

    def distance_sigma_mm(self, covariance_mm2: np.ndarray) -> dict[tuple[str, str], float]:
        """Returns σ of the distance between the origins of every two faces."""
        sigma = {}
        for a, b in combinations(self.target_from_face, 2):
            offset = self.target_from_face[b].translation - self.target_from_face[a].translation
            along = offset / np.linalg.norm(offset)
            gradient = along @ (self.faces[b][3:] - self.faces[a][3:])
            designed = self.designed_sigma_mm * along @ (self.face_designed[b][3:] - self.face_designed[a][3:])
            sigma[a, b] = float(np.sqrt(max(gradient @ covariance_mm2 @ gradient, 0.0) + designed @ designed))
        return sigma

    def circle_covariance(self, covariance_mm2: np.ndarray) -> np.ndarray:
        """Returns (c, 3, 3) mm², target frame, from the covariance (3c, 3c) of the circles."""
        mapped = np.einsum("cip,pq,cjq->cij", self.circles, covariance_mm2, self.circles, optimize=True)
        designed = self.designed_sigma_mm * self.circles_designed
        return mapped + designed @ np.swapaxes(designed, 1, 2)

    def all_circles_covariance(self, covariance_mm2: np.ndarray) -> np.ndarray:
        """Returns (3c, 3c) mm², target frame, of all circles together; singular, since they carry the frame."""
        flat = self.circles.reshape(-1, self.circles.shape[-1])
        designed = self.designed_sigma_mm * self.circles_designed.reshape(len(flat), -1)
        return flat @ covariance_mm2 @ flat.T + designed @ designed.T


def calibrated_target(
    result: JointResult, start: CalibratedTarget, target: TargetDesign, kind: FrameKind
) -> CalibratedTarget:
    """Returns faces and circles of the adjusted target in the target frame, with their marginal covariances.

    ``start`` gives the reference face and the side to which each face looks.
    """
    target_derivatives = derivatives(result, start, target, kind)
    return CalibratedTarget(
        reference_face=start.reference_face,
        target_from_face=target_derivatives.target_from_face,
        circles=dict(zip(result.labels, target_derivatives.xyz_target, strict=True)),
        target_from_group=dict.fromkeys(start.target_from_group, target_derivatives.target_from_model),
        face_covariance=target_derivatives.face_covariance(result.covariance_mm2),
        circle_covariance=dict(
            zip(result.labels, target_derivatives.circle_covariance(result.covariance_mm2), strict=True)
        ),
        distance_sigma_mm=target_derivatives.distance_sigma_mm(result.covariance_mm2),
        scale_sigma=scale_sigma(result.xyz_model, result.covariance_mm2),
        covariance_mm2=target_derivatives.all_circles_covariance(result.covariance_mm2),
    )


def scale_sigma(xyz_model: np.ndarray, covariance_mm2: np.ndarray) -> float:
    """Returns the relative σ of the scale of the circles.

    The scale is that of the similarity between the circles as adjusted and as they are.
    """
    middle = xyz_model - xyz_model.mean(0)
    gradient = (middle / (middle**2).sum()).ravel()
    return float(np.sqrt(gradient @ covariance_mm2 @ gradient))


def derivatives(result: JointResult, start: CalibratedTarget, target: TargetDesign, kind: FrameKind) -> Derivatives:
    """Computes the derivatives of poses and circles in the target frame by all circles, by central differences."""
    designs = [face for face in target.faces if face.id in start.target_from_face]
    faces = [_MovedFace.of(face, result, start.target_from_face[face.id].rotation[:, 2], kind) for face in designs]
    poses = {moved.face.id: moved.frames(np.zeros((1, len(moved.rows), 3)))[0] for moved in faces}
    target_from_model = poses[start.reference_face].inverse()
    by_circle = _Moves.none(poses, len(result.labels), 3 * len(result.labels))
    by_place = [_Moves.none(poses, len(result.labels), 0)]
    for moved in faces:
        moves = np.eye(3 * len(moved.rows)).reshape(-1, len(moved.rows), 3)
        by_circle.put(
            _moves(moved, moves, None, poses, start, result), (3 * moved.rows[:, None] + np.arange(3)).ravel()
        )
        if moved.placed:  # in the plane of the face, where the design gives their places
            shifts = np.einsum("pq,ja->pjqa", np.eye(len(moved.placed)), poses[moved.face.id].rotation[:, :2].T)
            shifts = shifts.reshape(-1, len(moved.placed), 3)
            no_moves = np.zeros((len(shifts), len(moved.rows), 3))
            by_place.append(_moves(moved, no_moves, shifts, poses, start, result))
    sigma = 0.0
    if len(by_place) > 1:
        sigma = placement_sigma_mm(target, dict(zip(result.labels, result.xyz_model, strict=True)))
    return Derivatives(
        {face_id: target_from_model @ pose for face_id, pose in poses.items()},
        target_from_model @ result.xyz_model,
        target_from_model,
        by_circle.faces,
        by_circle.circles,
        {face_id: np.hstack([moved.faces[face_id] for moved in by_place]) for face_id in poses},
        np.concatenate([moved.circles for moved in by_place], axis=2),
        sigma,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Moves:
    """Derivatives by k parameters: ``faces`` (6, k) each, rotation and translation, and ``circles`` (c, 3, k)."""

    faces: dict[str, np.ndarray]
    circles: np.ndarray

    @classmethod
    def none(cls, faces: Iterable[str], circles: int, count: int) -> "_Moves":
        return cls({face_id: np.zeros((6, count)) for face_id in faces}, np.zeros((circles, 3, count)))

    def put(self, other: "_Moves", columns: np.ndarray) -> None:
        """Copies the derivatives by other parameters into ``columns``."""
        self.circles[:, :, columns] = other.circles
        for face_id, jacobian in other.faces.items():
            self.faces[face_id][:, columns] = jacobian


@dataclass(frozen=True, slots=True, eq=False)
class _MovedFace:
    """A face with its m circles, which its frame follows when they move.

    ``rows`` : (m,) places of the circles among all; ``xyz`` : (m, 3); ``placed`` : frame circles that were not mapped.
    """

    face: FaceDesign
    rows: np.ndarray
    circles: tuple[str, ...]
    xyz: np.ndarray
    placed: tuple[str, ...]
    kind: FrameKind
    towards: np.ndarray

    @classmethod
    def of(cls, face: FaceDesign, result: JointResult, towards: np.ndarray, kind: FrameKind) -> "_MovedFace":
        rows = np.array([i for i, label in enumerate(result.labels) if label.face == face.id], int)
        circles = tuple(result.labels[i].circle for i in rows)
        placed = missing_frame_circles(face, circles)
        return cls(face, rows, circles, result.xyz_model[rows], placed, kind, towards)

    def frames(self, moves: np.ndarray, shifts: np.ndarray | None = None) -> Poses:
        """Returns model_from_face after k sets of moves (k, m, 3), and of shifts (k, p, 3) of the placed circles,
        mm."""
        xyz = self.xyz + moves
        if not self.placed:
            return face_frames(self.face, self.circles, xyz, self.kind, self.towards)
        sets = [with_unmapped(self.face, dict(zip(self.circles, centres, strict=True))) for centres in xyz]
        completed = np.array([list(centres.values()) for centres in sets])
        names = tuple(sets[0])
        if shifts is not None:
            completed[:, [names.index(circle) for circle in self.placed]] += shifts
        return face_frames(self.face, names, completed, self.kind, self.towards)


def _moves(
    moved: _MovedFace,
    moves: np.ndarray,
    shifts: np.ndarray | None,
    own: dict[str, Rigid],
    start: CalibratedTarget,
    result: JointResult,
) -> _Moves:
    """Returns derivatives by k parameters that move circles of one face, (k, m, 3), or its placed ones, (k, p, 3)."""
    derivative = _Moves.none(own, len(result.labels), len(moves))
    ahead, behind = (
        moved.frames(sign * STEP_MM * moves, None if shifts is None else sign * STEP_MM * shifts) for sign in (1, -1)
    )
    if moved.face.id != start.reference_face:
        target_from_model = own[start.reference_face].inverse()
        twist = (target_from_model @ ahead).difference(target_from_model @ behind)
        derivative.faces[moved.face.id][:] = twist.T / (2 * STEP_MM)
        derivative.circles[moved.rows] = np.transpose(moves @ target_from_model.rotation.T, (1, 2, 0))
        return derivative
    ahead, behind = ahead.inverse(), behind.inverse()
    for face_id, pose in own.items():
        if face_id != moved.face.id:
            derivative.faces[face_id][:] = (ahead @ pose).difference(behind @ pose).T / (2 * STEP_MM)
    for sign, target_from_model in ((1, ahead), (-1, behind)):
        xyz = np.tile(result.xyz_model, (len(moves), 1, 1))
        xyz[:, moved.rows] += sign * STEP_MM * moves
        placed = xyz @ np.swapaxes(target_from_model.rotation, 1, 2) + target_from_model.translation[:, None]
        derivative.circles[:] += sign * np.transpose(placed, (1, 2, 0)) / (2 * STEP_MM)
    return derivative
