"""The calibrated target of a joint adjustment with its marginal covariances."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.design import TargetDesign
from stcal.geometry.rigid import Rigid
from stcal.sfm.adjust.chain import CalibratedTarget
from stcal.sfm.adjust.faces import (
    FrameKind,
    face_frame,
    missing_frame_circles,
    placement_sigma_mm,
    with_unmapped,
)
from stcal.sfm.adjust.joint import JointResult


@dataclass(frozen=True, slots=True, eq=False)
class Derivatives:
    """The target in its own frame, and what moves it: derivatives by the circles in the models' frame, mm.

    ``target_from_face`` by face; ``xyz_target`` : (c, 3); ``target_from_model`` ; ``faces`` by face: (6, 3c) rotation
    (rad) and translation (mm), perturbation in the target frame; ``circles`` : (c, 3, 3c); ``face_designed`` by face:
    (6, d) and ``circles_designed`` : (c, 3, d) by the places in their plane of frame circles that were not mapped, and
    ``designed_sigma_mm`` of these.
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
        """6×6 by face, of the circles' (3c, 3c), whatever their datum."""
        variance = self.designed_sigma_mm**2
        return {
            face_id: jacobian @ covariance_mm2 @ jacobian.T
            + variance * self.face_designed[face_id] @ self.face_designed[face_id].T
            for face_id, jacobian in self.faces.items()
        }

    def distance_sigma_mm(self, covariance_mm2: np.ndarray) -> dict[tuple[str, str], float]:
        """σ of the distance between the origins of every two faces."""
        sigma = {}
        for a, b in combinations(self.target_from_face, 2):
            way = self.target_from_face[b].translation - self.target_from_face[a].translation
            along = way / np.linalg.norm(way)
            gradient = along @ (self.faces[b][3:] - self.faces[a][3:])
            designed = self.designed_sigma_mm * along @ (self.face_designed[b][3:] - self.face_designed[a][3:])
            sigma[a, b] = float(np.sqrt(max(gradient @ covariance_mm2 @ gradient, 0.0) + designed @ designed))
        return sigma

    def circle_covariance(self, covariance_mm2: np.ndarray) -> np.ndarray:
        """(c, 3, 3) mm², target frame, of the circles' (3c, 3c)."""
        own = np.einsum("cip,pq,cjq->cij", self.circles, covariance_mm2, self.circles, optimize=True)
        designed = self.designed_sigma_mm * self.circles_designed
        return own + designed @ np.swapaxes(designed, 1, 2)

    def all_circles_covariance(self, covariance_mm2: np.ndarray) -> np.ndarray:
        """(3c, 3c) mm², target frame, of all circles together; singular, since they carry the frame."""
        flat = self.circles.reshape(-1, self.circles.shape[-1])
        designed = self.designed_sigma_mm * self.circles_designed.reshape(len(flat), -1)
        return flat @ covariance_mm2 @ flat.T + designed @ designed.T


def calibrated_target(
    result: JointResult, start: CalibratedTarget, target: TargetDesign, kind: FrameKind
) -> CalibratedTarget:
    """Faces and circles of the adjusted target in the target frame, with their marginal covariances.

    ``start`` tells the reference face and to which side each face looks.
    """
    own = derivatives(result, start, target, kind)
    return CalibratedTarget(
        reference_face=start.reference_face,
        target_from_face=own.target_from_face,
        circles=dict(zip(result.labels, own.xyz_target, strict=True)),
        target_from_group=dict.fromkeys(start.target_from_group, own.target_from_model),
        face_covariance=own.face_covariance(result.covariance_mm2),
        circle_covariance=dict(zip(result.labels, own.circle_covariance(result.covariance_mm2), strict=True)),
        distance_sigma_mm=own.distance_sigma_mm(result.covariance_mm2),
        scale_sigma=scale_sigma(result.xyz_model, result.covariance_mm2),
        covariance_mm2=own.all_circles_covariance(result.covariance_mm2),
    )


def scale_sigma(xyz_model: np.ndarray, covariance_mm2: np.ndarray) -> float:
    """Relative σ of the scale of the circles: of the similarity's scale between them as adjusted and as they are."""
    middle = xyz_model - xyz_model.mean(0)
    gradient = (middle / (middle**2).sum()).ravel()
    return float(np.sqrt(gradient @ covariance_mm2 @ gradient))


def derivatives(result: JointResult, start: CalibratedTarget, target: TargetDesign, kind: FrameKind) -> Derivatives:
    """Poses and circles in the target frame are functions of all circles; derivatives by central differences."""
    step = 1e-3
    own = _frames(result, result.xyz_model, start, target, kind)
    origin = _in_target_frame(own, result.xyz_model, start)

    def by(changes: list[Callable[[float], tuple]]) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Derivatives by some parameters: ``change(±step)`` gives the faces' frames that one moves, and the circles."""
        ahead, behind = (
            [_in_target_frame(own | frames, xyz, start) for frames, xyz in (change(move) for change in changes)]
            for move in (step, -step)
        )
        if not changes:
            return {f: np.zeros((6, 0)) for f in own}, np.zeros((len(result.labels), 3, 0))
        twists = {f: _perturbations([a[0][f] for a in ahead], [b[0][f] for b in behind]) / (2 * step) for f in own}
        moved = [(a[1] - b[1]) / (2 * step) for a, b in zip(ahead, behind, strict=True)]
        return twists, np.stack(moved, axis=-1)

    def circle(i: int, axis: int, move: float):
        xyz = result.xyz_model.copy()
        xyz[i, axis] += move
        return _frames(result, xyz, start, target, kind, only=result.labels[i].face), xyz

    def designed(face_id: str, circle: str, axis: int, move: float):
        shift = move * own[face_id].rotation[:, axis]
        return _frames(result, result.xyz_model, start, target, kind, face_id, {circle: shift}), result.xyz_model

    mapped = {face_id: [x.circle for x in result.labels if x.face == face_id] for face_id in own}
    places = [(f, c, axis) for f in own for c in missing_frame_circles(target.face(f), mapped[f]) for axis in range(2)]
    by_circle = by([partial(circle, i, axis) for i in range(len(result.labels)) for axis in range(3)])
    by_place = by([partial(designed, *place) for place in places])
    sigma = placement_sigma_mm(target, dict(zip(result.labels, result.xyz_model, strict=True))) if places else 0.0
    return Derivatives(*origin, *by_circle, *by_place, sigma)


def _perturbations(ahead: Sequence[Rigid], behind: Sequence[Rigid]) -> np.ndarray:
    """Rotation (rad) and translation (mm), (6, n), between each two close poses, in the frame they lead to, about the
    origin of b."""
    turns = np.array([a.rotation @ b.rotation.T for a, b in zip(ahead, behind, strict=True)])
    shifts = np.array([a.translation - b.translation for a, b in zip(ahead, behind, strict=True)])
    return np.hstack([Rotation.from_matrix(turns).as_rotvec(), shifts]).T.copy()


def _frames(
    result: JointResult,
    xyz_model,
    start: CalibratedTarget,
    target: TargetDesign,
    kind: FrameKind,
    only: str | None = None,
    shifts: dict[str, np.ndarray] | None = None,
) -> dict[str, Rigid]:
    """model_from_face of all faces, or of one; ``shifts`` (3,) by id move circles that were not mapped."""
    frames = {}
    for face in target.faces:
        if face.id in start.target_from_face and only in (None, face.id):
            own = {
                label.circle: xyz for label, xyz in zip(result.labels, xyz_model, strict=True) if label.face == face.id
            }
            own = with_unmapped(face, own)
            for circle, shift in (shifts or {}).items():
                own = own | {circle: own[circle] + shift}
            frames[face.id] = face_frame(face, own, kind, start.target_from_face[face.id].rotation[:, 2])
    return frames


def _in_target_frame(model_from_face: dict[str, Rigid], xyz_model: np.ndarray, start: CalibratedTarget):
    """target_from_face, circles (c, 3) in the target frame, and target_from_model."""
    target_from_model = model_from_face[start.reference_face].inverse()
    return (
        {face_id: target_from_model @ pose for face_id, pose in model_from_face.items()},
        target_from_model @ xyz_model,
        target_from_model,
    )
