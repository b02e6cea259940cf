"""Chain the faces of all groups into the target frame, and say how far the ways to a face disagree."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from stcal.design import TargetDesign
from stcal.errors import MappingError
from stcal.geometry.least_squares import UNKEPT, NormalEquations, minimise
from stcal.geometry.rigid import Rigid, skew
from stcal.labels import CircleLabel
from stcal.sfm.adjust.faces import FaceInGroup

MAX_CHAIN_STEPS = 4
MAX_CHAINS = 12
Way = tuple[tuple[str, ...], tuple[str, ...]]
"""Faces from the first to the last, and the groups between them."""


@dataclass(frozen=True, slots=True, eq=False)
class FaceChain:
    """One way from the reference face to another: faces and groups in turn, and how far it is off the combination."""

    faces: tuple[str, ...]
    groups: tuple[str, ...]
    translation_mm: float
    rotation_rad: float


@dataclass(frozen=True, slots=True, eq=False)
class CalibratedTarget:
    """The result.

    ``target_from_face`` by face; ``circles`` : label → (3,) mm in the target frame; ``target_from_group`` : metric
    group frames; ``face_covariance`` : 6×6 by face (rotation rad, translation mm; perturbation in the target frame
    about the face's origin), ``circle_covariance`` : 3×3 mm² by label, ``distance_sigma_mm`` : of the distance between
    the origins of two faces, ``scale_sigma`` : relative, of all lengths together, and ``covariance_mm2`` : (3c, 3c) of
    all circles together, target frame, in their order; empty and None where none was computed.
    """

    reference_face: str
    target_from_face: dict[str, Rigid]
    circles: dict[CircleLabel, np.ndarray]
    target_from_group: dict[str, Rigid]
    face_covariance: dict[str, np.ndarray] = field(default_factory=dict)
    circle_covariance: dict[CircleLabel, np.ndarray] = field(default_factory=dict)
    distance_sigma_mm: dict[tuple[str, str], float] = field(default_factory=dict)
    scale_sigma: float | None = None
    covariance_mm2: np.ndarray | None = None


def chain_faces(faces: Sequence[FaceInGroup], target: TargetDesign, reference: str) -> CalibratedTarget:
    """Combine the faces of all groups into the target frame, that of the reference face.

    Every group states the pose of its faces against one another; a least-squares adjustment over all groups, weighted
    by how well each face is fixed in each group, gives one pose for each face.

    Raises
    ------
    InputError
        The reference face is not of the design.
    MappingError
        The reference face is not mapped, or a face is not linked to it.
    """
    chains = _ways(faces, target, reference)
    target_from_face, target_from_group = _adjust(faces, chains, reference)
    circles = _circles(faces, target_from_face, target)
    return CalibratedTarget(reference, target_from_face, circles, target_from_group)


def chain_singly(faces: Sequence[FaceInGroup], target: TargetDesign, reference: str) -> CalibratedTarget:
    """The faces by single transforms, each by its shortest way through the groups: Zhang & Wei (2017), eq. 11 with the
    inverses where they belong. Other ways to a face are not used; circles are those of the way's last group.

    Raises
    ------
    InputError
        The reference face is not of the design.
    MappingError
        The reference face is not mapped, or a face is not linked to it.
    """
    shortest = {face_id: found[0] for face_id, found in _ways(faces, target, reference).items()}
    target_from_face = {face_id: _along(way, faces) for face_id, way in shortest.items()}
    nearest: dict[str, FaceInGroup] = {}
    for each in sorted(faces, key=lambda each: len(shortest[each.face][1])):
        nearest.setdefault(each.group, each)
    target_from_group = {g: target_from_face[f.face] @ f.group_from_face.inverse() for g, f in nearest.items()}
    last = {face_id: groups[-1] for face_id, (_, groups) in shortest.items() if groups}
    last.setdefault(reference, next(each.group for each in faces if each.face == reference))
    own = [each for each in faces if each.group == last[each.face]]
    return CalibratedTarget(reference, target_from_face, _circles(own, target_from_face, target), target_from_group)


def _ways(faces: Sequence[FaceInGroup], target: TargetDesign, reference: str) -> dict[str, list[Way]]:
    """From the reference to every face, the shortest first, by face."""
    target.face(reference)
    seen = {each.face for each in faces}
    if reference not in seen:
        raise MappingError(
            "E-FACE-REFERENCE",
            f"reference face {reference}: not mapped in any group; add a group that shows it, or choose one of "
            f"{', '.join(sorted(seen)) or 'none'} with --reference-face",
        )
    chains = {face_id: _chains(faces, reference, face_id) for face_id in sorted(seen)}
    unlinked = [face_id for face_id, found in chains.items() if not found]
    if unlinked:
        raise MappingError(
            "E-FACE-UNLINKED",
            f"face {', '.join(unlinked)}: never linked to reference face {reference}; "
            f"add a group that shows it together with {reference} or a face that is linked",
        )
    return chains


def unlinked_faces(faces: Sequence[FaceInGroup], reference: str) -> list[str]:
    """Faces that no way through the groups links to the reference face, where another face is linked; else none: then
    nothing would be left, and :func:`chain_faces` says so."""
    linked = {each.face for each in faces if each.face == reference or _chains(faces, reference, each.face)}
    return sorted({each.face for each in faces} - linked) if len(linked) > 1 else []


def measure_chains(faces: Sequence[FaceInGroup], calibrated: CalibratedTarget) -> dict[str, tuple[FaceChain, ...]]:
    """All ways to every face but the reference, with their distance from the calibrated pose."""
    return {
        face_id: tuple(_measure(way, faces, pose) for way in _chains(faces, calibrated.reference_face, face_id))
        for face_id, pose in calibrated.target_from_face.items()
        if face_id != calibrated.reference_face
    }


def _chains(faces: Sequence[FaceInGroup], start: str, goal: str) -> list[Way]:
    """Simple ways from one face to another, the shortest first: (faces, groups)."""
    by_group: dict[str, list[str]] = {}
    for each in faces:
        by_group.setdefault(each.group, []).append(each.face)
    queue, found = [((start,), ())], []
    for way, groups in queue:
        if way[-1] == goal:
            found.append((way, groups))
            if len(found) == MAX_CHAINS:
                break
            continue
        if found and len(way) > len(found[0][0]):
            break
        if len(way) <= max(MAX_CHAIN_STEPS, len(by_group)):
            queue += [
                ((*way, face_id), (*groups, group))
                for group, members in by_group.items()
                if way[-1] in members and group not in groups
                for face_id in members
                if face_id not in way
            ]
    return found


def _measure(chain, faces: Sequence[FaceInGroup], combined: Rigid) -> FaceChain:
    way, groups = chain
    difference = _along(chain, faces) @ combined.inverse()
    shift = _along(chain, faces).translation - combined.translation
    return FaceChain(way, groups, float(np.linalg.norm(shift)), difference.angle_rad())


def _along(chain, faces: Sequence[FaceInGroup]) -> Rigid:
    """reference_from_face along one chain."""
    pose = {(each.group, each.face): each.group_from_face for each in faces}
    way, groups = chain
    result = Rigid()
    for group, a, b in zip(groups, way[:-1], way[1:], strict=True):
        result = result @ pose[group, a].inverse() @ pose[group, b]
    return result


def _pose_information(each: FaceInGroup) -> np.ndarray:
    """6×6 information of (rotation rad, translation mm) of a face frame, perturbed in the face frame."""
    jacobian = np.concatenate([-skew(each.xyz_face), np.broadcast_to(np.eye(3), (len(each.labels), 3, 3))], axis=2)
    return np.einsum("nki,nkl,nlj->ij", jacobian, each.information, jacobian)


def _adjust(faces: Sequence[FaceInGroup], chains, reference: str) -> tuple[dict[str, Rigid], dict[str, Rigid]]:
    """Poses of faces and groups in the target frame by weighted least squares over all (group, face).

    Poses are perturbed on the right, so that a face's own step is minus its residual.
    """
    start = {face_id: _along(found[0], faces) for face_id, found in chains.items()}
    groups = list(dict.fromkeys(each.group for each in faces))
    start_group = {}
    for each in sorted(faces, key=lambda f: len(chains[f.face][0][0])):
        start_group.setdefault(each.group, start[each.face] @ each.group_from_face.inverse())
    free = [face_id for face_id in start if face_id != reference]
    roots = [np.linalg.cholesky(_pose_information(each) + 1e-12 * np.eye(6)).T for each in faces]

    names = [("face", f) for f in free] + [("group", g) for g in groups]
    column = {name: slice(6 * i, 6 * i + 6) for i, name in enumerate(names)}
    begin = {("face", f): start[f] for f in (reference, *free)} | {("group", g): start_group[g] for g in groups}

    def linearise(poses: dict[tuple[str, str], Rigid]) -> NormalEquations:
        jacobian, residual = np.zeros((6 * len(faces), 6 * len(column))), np.zeros(6 * len(faces))
        for k, (each, root) in enumerate(zip(faces, roots, strict=True)):
            rows, group, face = slice(6 * k, 6 * k + 6), ("group", each.group), ("face", each.face)
            residual[rows] = root @ (poses[face].inverse() @ poses[group] @ each.group_from_face).log()
            r, t = each.group_from_face.rotation.T, each.group_from_face.translation
            jacobian[rows, column[group]] = root @ np.block([[r, np.zeros((3, 3))], [-r @ skew(t), r]])
            if each.face != reference:
                jacobian[rows, column[face]] = -root
        return NormalEquations.of(residual, jacobian)

    def moved(poses: dict[tuple[str, str], Rigid], step: np.ndarray) -> dict[tuple[str, str], Rigid]:
        return poses | {name: poses[name] @ Rigid.exp(step[at]) for name, at in column.items()}

    found = minimise(begin, linearise, moved)
    # Derivatives leave out how large residuals bend: where groups disagree, steps end where a damped one gains nothing.
    poses = found.required("faces", "check that nothing but the camera moved in a group", accepted=UNKEPT).state
    return {f: poses["face", f] for f in (reference, *free)}, {g: poses["group", g] for g in groups}


def _circles(faces: Sequence[FaceInGroup], target_from_face: dict[str, Rigid], target: TargetDesign) -> dict:
    """Circle centres in the target frame: weighted means over the groups, in the face frame."""
    weight: dict[CircleLabel, np.ndarray] = {}
    total: dict[CircleLabel, np.ndarray] = {}
    for each in faces:
        for label, xyz, information in zip(each.labels, each.xyz_face, each.information, strict=True):
            weight[label] = weight.get(label, 0) + information
            total[label] = total.get(label, 0) + information @ xyz
    return {
        label: target_from_face[face.id] @ np.linalg.solve(weight[label], total[label])
        for face in target.faces
        for label in face.labels()
        if label in weight
    }
