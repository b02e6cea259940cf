"""Chains the faces of all groups into the target frame, and measures how far the ways to a face disagree."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from stcal.design import TargetDesign
from stcal.errors import MappingError
from stcal.geometry.arrays import Brief
from stcal.geometry.least_squares import UNKEPT, NormalEquations, minimise
from stcal.geometry.rigid import Rigid, skew
from stcal.labels import CircleLabel
from stcal.sfm.adjust.faces import FaceInGroup

MAX_CHAIN_STEPS = 4
MAX_CHAINS = 12
Way = tuple[tuple[str, ...], tuple[str, ...]]
"""The faces from the first to the last, and the groups that link them."""


@dataclass(frozen=True, slots=True, eq=False)
class FaceChain:
    """One way from the reference face to another face, along alternating faces and groups, and its deviation."""

    faces: tuple[str, ...]
    groups: tuple[str, ...]
    translation_mm: float
    rotation_rad: float


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class CalibratedTarget(Brief):
    """Poses of the faces and centres of the circles in the target frame; covariances may be empty or None."""

    reference_face: str
    target_from_face: dict[str, Rigid]
    circles: dict[CircleLabel, np.ndarray]  # (3,) mm, target frame
    target_from_group: dict[str, Rigid]  # of its metric frame
    # 6×6 (rad, mm), target frame, about the origin
    face_covariance: dict[str, np.ndarray] = field(default_factory=dict)
    circle_covariance: dict[CircleLabel, np.ndarray] = field(default_factory=dict)  # 3×3 mm²
    # of the distance between the origins of two faces
    distance_sigma_mm: dict[tuple[str, str], float] = field(default_factory=dict)
    scale_sigma: float | None = None  # relative, of all lengths together
    covariance_mm2: np.ndarray | None = None  # (3c, 3c) of all circles, target frame, in their order
    # by face and kind of observation, part of σ of x, y, z
    position_sources_mm: dict[str, dict[str, np.ndarray]] = field(default_factory=dict)

    def with_larger_sigma(self, factor: float) -> "CalibratedTarget":
        """Returns the target with all σ multiplied by a factor."""
        square = factor**2
        return replace(
            self,
            face_covariance={k: square * c for k, c in self.face_covariance.items()},
            circle_covariance={k: square * c for k, c in self.circle_covariance.items()},
            distance_sigma_mm={k: factor * s for k, s in self.distance_sigma_mm.items()},
            scale_sigma=None if self.scale_sigma is None else factor * self.scale_sigma,
            covariance_mm2=None if self.covariance_mm2 is None else square * self.covariance_mm2,
            position_sources_mm={
                face: {kind: factor * s for kind, s in of_kind.items()}
                for face, of_kind in self.position_sources_mm.items()
            },
        )


def chain_faces(faces: Sequence[FaceInGroup], target: TargetDesign, reference: str) -> CalibratedTarget:
    """Combines the faces of all groups into the frame of the reference face by weighted least squares."""
    chains = _ways(faces, target, reference)
    target_from_face, target_from_group = _adjust(faces, chains, reference)
    circles = _circles(faces, target_from_face, target)
    return CalibratedTarget(reference, target_from_face, circles, target_from_group)


def chain_singly(faces: Sequence[FaceInGroup], target: TargetDesign, reference: str) -> CalibratedTarget:
    """Chains each face by single transforms along its shortest way (Zhang & Wei 2017, eq. 11, inverses where they
    belong). The circles of a face are those of the last group of its way."""
    shortest = {face_id: ways[0] for face_id, ways in _ways(faces, target, reference).items()}
    target_from_face = {face_id: _along(way, faces) for face_id, way in shortest.items()}
    nearest: dict[str, FaceInGroup] = {}
    for face in sorted(faces, key=lambda face: len(shortest[face.face][1])):
        nearest.setdefault(face.group, face)
    target_from_group = {g: target_from_face[f.face] @ f.group_from_face.inverse() for g, f in nearest.items()}
    last = {face_id: groups[-1] for face_id, (_, groups) in shortest.items() if groups}
    last.setdefault(reference, next(face.group for face in faces if face.face == reference))
    faces_used = [face for face in faces if face.group == last[face.face]]
    return CalibratedTarget(
        reference, target_from_face, _circles(faces_used, target_from_face, target), target_from_group
    )


def _ways(faces: Sequence[FaceInGroup], target: TargetDesign, reference: str) -> dict[str, list[Way]]:
    """Returns the ways from the reference face to every face, by face, the shortest first."""
    target.face(reference)
    mapped = {face.face for face in faces}
    if reference not in mapped:
        raise MappingError(
            "E-FACE-REFERENCE",
            f"reference face {reference}: not mapped in any group; add a group that shows it, or choose one of "
            f"{', '.join(sorted(mapped)) or 'none'} with --reference-face",
        )
    chains = {face_id: _chains(faces, reference, face_id) for face_id in sorted(mapped)}
    unlinked = [face_id for face_id, ways in chains.items() if not ways]
    if unlinked:
        raise MappingError(
            "E-FACE-UNLINKED",
            f"face {', '.join(unlinked)}: never linked to reference face {reference}; "
            f"add a group that shows it together with {reference} or a face that is linked",
        )
    return chains


def unlinked_faces(faces: Sequence[FaceInGroup], reference: str) -> list[str]:
    """Faces that no way links to the reference face; empty if none is linked (:func:`chain_faces` raises)."""
    linked = {face.face for face in faces if face.face == reference or _chains(faces, reference, face.face)}
    return sorted({face.face for face in faces} - linked) if len(linked) > 1 else []


def measure_chains(faces: Sequence[FaceInGroup], calibrated: CalibratedTarget) -> dict[str, tuple[FaceChain, ...]]:
    """Returns all ways to every face but the reference face, with their deviations from the calibrated pose."""
    found = {}
    for face_id, pose in calibrated.target_from_face.items():
        if face_id != calibrated.reference_face:
            ways = _chains(faces, calibrated.reference_face, face_id)
            along = [_along(way, faces) for way in ways]
            found[face_id] = tuple(
                FaceChain(
                    *way,
                    float(np.linalg.norm(chained.translation - pose.translation)),
                    (chained @ pose.inverse()).angle_rad(),
                )
                for way, chained in zip(ways, along, strict=True)
            )
    return found


def _chains(faces: Sequence[FaceInGroup], start: str, goal: str) -> list[Way]:
    """Returns the simple ways from one face to another, the shortest first, and those with one face more."""
    by_group: dict[str, list[str]] = {}
    for face in faces:
        by_group.setdefault(face.group, []).append(face.face)
    queue, complete = [((start,), ())], []
    for way, groups in queue:
        if way[-1] == goal:
            complete.append((way, groups))
            if len(complete) == MAX_CHAINS:
                break
            continue
        longest = len(complete[0][0]) if complete else max(MAX_CHAIN_STEPS, len(by_group))
        if len(way) <= longest:
            queue += [
                ((*way, face_id), (*groups, group))
                for group, members in by_group.items()
                if way[-1] in members and group not in groups
                for face_id in members
                if face_id not in way
            ]
    return complete


def _along(chain, faces: Sequence[FaceInGroup]) -> Rigid:
    pose = {(face.group, face.face): face.group_from_face for face in faces}
    way, groups = chain
    result = Rigid()
    for group, a, b in zip(groups, way[:-1], way[1:], strict=True):
        result = result @ pose[group, a].inverse() @ pose[group, b]
    return result


def _adjust(faces: Sequence[FaceInGroup], chains, reference: str) -> tuple[dict[str, Rigid], dict[str, Rigid]]:
    """Estimates the poses of faces and groups in the target frame. Poses are perturbed on the right, so that the step
    of a face enters its residual with the factor −1."""
    start = {face_id: _along(ways[0], faces) for face_id, ways in chains.items()}
    groups = list(dict.fromkeys(face_in_group.group for face_in_group in faces))
    start_group = {}
    for face_in_group in sorted(faces, key=lambda f: len(chains[f.face][0][0])):
        start_group.setdefault(face_in_group.group, start[face_in_group.face] @ face_in_group.group_from_face.inverse())
    free = [face_id for face_id in start if face_id != reference]
    roots = []  # of the information of (rotation rad, translation mm) of each face frame, perturbed in that frame
    for each in faces:
        by_pose = np.concatenate([-skew(each.xyz_face), np.broadcast_to(np.eye(3), (len(each.labels), 3, 3))], axis=2)
        information = np.einsum("nki,nkl,nlj->ij", by_pose, each.information, by_pose)
        roots.append(np.linalg.cholesky(information + 1e-12 * np.eye(6)).T)

    names = [("face", f) for f in free] + [("group", g) for g in groups]
    column = {name: slice(6 * i, 6 * i + 6) for i, name in enumerate(names)}
    initial = {("face", f): start[f] for f in (reference, *free)} | {("group", g): start_group[g] for g in groups}

    def linearise(poses: dict[tuple[str, str], Rigid]) -> NormalEquations:
        jacobian, residual = np.zeros((6 * len(faces), 6 * len(column))), np.zeros(6 * len(faces))
        for k, (face_in_group, root) in enumerate(zip(faces, roots, strict=True)):
            rows, group, face = slice(6 * k, 6 * k + 6), ("group", face_in_group.group), ("face", face_in_group.face)
            residual[rows] = root @ (poses[face].inverse() @ poses[group] @ face_in_group.group_from_face).log()
            r, t = face_in_group.group_from_face.rotation.T, face_in_group.group_from_face.translation
            jacobian[rows, column[group]] = root @ np.block([[r, np.zeros((3, 3))], [-r @ skew(t), r]])
            if face_in_group.face != reference:
                jacobian[rows, column[face]] = -root
        return NormalEquations.of(residual, jacobian)

    def moved(poses: dict[tuple[str, str], Rigid], step: np.ndarray) -> dict[tuple[str, str], Rigid]:
        return poses | {name: poses[name] @ Rigid.exp(step[at]) for name, at in column.items()}

    solution = minimise(initial, linearise, moved)
    # Derivatives neglect the curvature of large residuals. If groups disagree, only damped steps lower the cost, and
    # iteration ends when they gain nothing.
    poses = solution.required("faces", "check that nothing but the camera moved in a group", accepted=UNKEPT).state
    return {f: poses["face", f] for f in (reference, *free)}, {g: poses["group", g] for g in groups}


def _circles(faces: Sequence[FaceInGroup], target_from_face: dict[str, Rigid], target: TargetDesign) -> dict:
    """Returns circle centres in the target frame: weighted means over the groups, taken in the face frame."""
    weight: dict[CircleLabel, np.ndarray] = {}
    total: dict[CircleLabel, np.ndarray] = {}
    for face_in_group in faces:
        for label, xyz, information in zip(
            face_in_group.labels, face_in_group.xyz_face, face_in_group.information, strict=True
        ):
            weight[label] = weight.get(label, 0) + information
            total[label] = total.get(label, 0) + information @ xyz
    return {
        label: target_from_face[face.id] @ np.linalg.solve(weight[label], total[label])
        for face in target.faces
        for label in face.labels()
        if label in weight
    }
