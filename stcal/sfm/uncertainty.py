"""The calibrated target of a joint adjustment with its marginal covariances."""

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.design import TargetDesign
from stcal.geometry.rigid import Rigid
from stcal.sfm.chain import CalibratedTarget
from stcal.sfm.faces import FrameKind, face_frame
from stcal.sfm.joint import JointResult
from stcal.sfm.observations import face_of


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
