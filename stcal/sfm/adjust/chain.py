"""Face frames from circle centres, the faces of each group, and their chaining into the target frame."""

from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from stcal.adjust.engine import Adjustment
from stcal.design import FaceDesign, TargetDesign
from stcal.errors import DegenerateError, MappingError
from stcal.geometry.arrays import Brief, freeze
from stcal.geometry.camera import Camera
from stcal.geometry.least_squares import UNKEPT
from stcal.geometry.plane import fit_plane
from stcal.geometry.rigid import Poses, Rigid, align_rigid, best_rotations, skew
from stcal.labels import CircleLabel
from stcal.sfm.adjust.refine import projection_jacobians
from stcal.sfm.data.group_model import MetricModel

FrameKind = Literal["plane", "three-point"]
MIN_KNOWN = 3  # smallest number of points of a face of known shape that place it
MIN_PLACING = 4
"""Smallest number of mapped circles that can place the others of their face. Three determine the placement, a fourth
lessens the effect of their errors."""


@dataclass(frozen=True, slots=True, eq=False)
class FaceInGroup:
    """One face in the metric frame of one group."""

    group: str
    face: str
    group_from_face: Rigid
    labels: tuple[CircleLabel, ...]  # (n,) its mapped circles
    xyz_face: np.ndarray  # (n, 3) mm
    information: np.ndarray  # (n, 3, 3) inverse covariances in the face frame, given the cameras
    images: int  # number of images that show the face

    def __post_init__(self):
        n = len(self.labels)
        freeze(self, "xyz_face", (n, 3), "circles")
        freeze(self, "information", (n, 3, 3), "information")


def unmapped(face: FaceDesign, circles: Collection[str]) -> tuple[str, ...]:
    """Returns the circles of the face's frame that are not mapped; none for a face of known shape."""
    corners = () if face.sigma_mm is not None else (face.origin, face.x, face.y)
    return tuple(circle for circle in corners if circle not in circles)


def with_known(
    face: FaceDesign, xyz: Mapping[str, np.ndarray], known: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """Returns the circles (3,) by id, with frame circles that are not mapped by a rigid fit to ``known`` places."""
    missing = [c for c in unmapped(face, xyz) if c in known]
    common = [c for c in xyz if c in known]
    if not missing or len(common) < MIN_PLACING:
        return dict(xyz)
    try:
        model_from_known = align_rigid(np.array([xyz[c] for c in common]), np.array([known[c] for c in common]))
    except DegenerateError:  # on one line: that frame circles are missing is said elsewhere
        return dict(xyz)
    return dict(xyz) | {c: model_from_known @ known[c] for c in missing}


def face_frame(face: FaceDesign, xyz: dict[str, np.ndarray], kind: FrameKind, towards: np.ndarray) -> Rigid:
    """Returns model_from_face, computed from circle centres by Gram–Schmidt (Zhang & Wei, eqs. 8–10). ``kind``:
    ``three-point`` as there; ``plane``: Z from the plane of all circles; ``towards``: from where the face is seen."""
    return face_frames(face, tuple(xyz), np.array(list(xyz.values()))[None], kind, towards)[0]


def face_frames(
    face: FaceDesign,
    circles: Sequence[str],
    xyz: np.ndarray,
    kind: FrameKind,
    towards: np.ndarray,
    shifts: np.ndarray | None = None,
) -> Poses:
    """Returns :func:`face_frame` of k sets of centres, (k, n, 3). The frame of a face of known shape is that of the
    design, laid over all of its points by least squares; this also places the p frame circles that are not mapped, if
    they have ``shifts`` (k, p, 3), mm, against the design."""
    if face.sigma_mm is not None:
        return _fitted(face, circles, xyz)
    if missing := unmapped(face, circles):
        if shifts is None:
            names = " and ".join(f"{face.id}:{circle}" for circle in missing)
            words = f"face {face.id}: frame circle {names} not mapped; add views that show it"
            raise DegenerateError("E-FACE-FRAME-CIRCLES", words)
        design = _fitted(face, circles, xyz)
        placed = np.einsum("kij,kpj->kpi", design.rotation, face.places_mm(missing) + shifts)
        circles, xyz = (*circles, *missing), np.concatenate([xyz, placed + design.translation[:, None]], axis=1)
    corners = np.stack([xyz[:, list(circles).index(circle)] for circle in (face.origin, face.x, face.y)])
    if kind == "plane":
        normal, offset, _ = fit_plane(xyz, towards)
        corners = corners - ((corners * normal).sum(2) - offset)[..., None] * normal
    origin, along_x, along_y = corners[0], corners[1] - corners[0], corners[2] - corners[0]
    axis_x = along_x / np.linalg.norm(along_x, axis=1, keepdims=True)
    across = along_y - (along_y * axis_x).sum(1, keepdims=True) * axis_x
    length = np.linalg.norm(across, axis=1, keepdims=True)
    if (length[:, 0] < 1e-6 * np.linalg.norm(along_y, axis=1)).any():
        raise DegenerateError(
            "E-FACE-COLLINEAR", f"face {face.id}: its frame circles are mapped on one line; check their labels"
        )
    axis_y = across / length
    return Poses(np.stack([axis_x, axis_y, np.cross(axis_x, axis_y)], axis=2), origin)


def off_design_mm(target: TargetDesign, labels: Sequence[CircleLabel], xyz: np.ndarray) -> float:
    """Returns the in-plane σ per axis of circles (c, 3) about the design, pooled over fits of the faces."""
    square, redundancy = 0.0, 0
    for face in target.faces:
        rows = [i for i, label in enumerate(labels) if label.face == face.id]
        circles = [labels[i].circle for i in rows]
        with suppress(DegenerateError):
            away = _fitted(face, circles, xyz[None, rows])[0].inverse() @ xyz[rows] - face.places_mm(circles)
            square += float((away[:, :2] ** 2).sum())
            redundancy += 2 * len(rows) - 3
    return float(np.sqrt(square / redundancy)) if redundancy else 0.0


def _fitted(face: FaceDesign, circles: Sequence[str], xyz: np.ndarray) -> Poses:
    design = face.places_mm(circles)
    spread = np.linalg.svd(design - design.mean(0), compute_uv=False) if len(design) >= MIN_KNOWN else np.zeros(2)
    if spread[1] <= 1e-6 * spread[0]:
        fault = f"face {face.id}: {len(design)} of its corners mapped, {MIN_KNOWN} needed that are not on one line"
        raise DegenerateError("E-FACE-FRAME-CIRCLES", f"{fault}; add views that show it")
    middle = xyz.mean(1)
    rotation, _ = best_rotations(np.einsum("kni,nj->kij", xyz - middle[:, None], design - design.mean(0)))
    return Poses(rotation, middle - rotation @ design.mean(0))


def faces_of_group(
    model: MetricModel,
    camera: Camera,
    target: TargetDesign,
    kind: FrameKind,
    known: Mapping[str, Mapping[str, np.ndarray]] | None = None,
) -> tuple[list[FaceInGroup], list[str]]:
    """Returns the frames of all faces of one group, and the reasons why other faces have none; frame circles that it
    lacks are placed by those that it has, as other groups or the design have both: ``known``, by face and circle."""
    xyz = model.xyz_model
    by_point = model.whiten(projection_jacobians(model, camera)[1])
    information = np.zeros((len(model.labels), 3, 3))  # inverse covariance of each point, given the cameras, mm⁻²
    np.add.at(information, model.point_index, np.swapaxes(by_point, 1, 2) @ by_point)
    cameras = np.stack([pose.inverse().translation for pose in model.camera_from_model])
    faces, notes = [], []
    for face in target.faces:
        members = model.points_by_face().get(face.id, np.zeros(0, int))
        if not len(members):
            continue
        place = {model.labels[i].circle: xyz[i] for i in members}
        observed = np.isin(model.point_index, members)
        seen_by = np.unique(model.image_index[observed])
        try:
            every = with_known(face, place, (known or {}).get(face.id, {}))
            frame = face_frame(face, every, kind, cameras[seen_by].mean(0) - xyz[members].mean(0))
        except DegenerateError as error:
            notes.append(f"group {model.group}: {error}")
            continue
        labels, own = tuple(model.labels[i] for i in members), frame.inverse() @ xyz[members]
        turned = frame.rotation.T @ information[members] @ frame.rotation
        faces.append(FaceInGroup(model.group, face.id, frame, labels, own, turned, len(seen_by)))
    if not faces and not notes:
        notes.append(
            f"group {model.group}: no face mapped (two images must see it); add views that show faces and board"
        )
    return faces, notes


MAX_CHAINS = 12
Way = tuple[tuple[str, ...], tuple[str, ...]]  # the faces from the first to the last, and the groups that link them


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
        def times(by: float, values: Any) -> Any:
            if isinstance(values, dict):
                return {key: times(by, own) for key, own in values.items()}
            return None if values is None else by * values

        grown = dict.fromkeys(("distance_sigma_mm", "scale_sigma", "position_sources_mm"), factor)
        grown |= dict.fromkeys(("face_covariance", "circle_covariance", "covariance_mm2"), factor**2)
        return replace(self, **{name: times(by, getattr(self, name)) for name, by in grown.items()})


def chain_faces(
    faces: Sequence[FaceInGroup], target: TargetDesign, reference: str, singly: bool = False
) -> CalibratedTarget:
    """Combines the faces of all groups into the frame of the reference face by weighted least squares; ``singly``: each
    along its shortest way (Zhang & Wei 2017, eq. 11, inverses where they belong), circles as of its last group."""
    target.face(reference)
    mapped = {face.face for face in faces}
    if reference not in mapped:
        fault, others = f"reference face {reference}: not mapped in any group", ", ".join(sorted(mapped)) or "none"
        remedy = f"add a group that shows it, or choose one of {others} with --reference-face"
        raise MappingError("E-FACE-REFERENCE", f"{fault}; {remedy}")
    shortest = {face_id: next(iter(_chains(faces, reference, face_id)), None) for face_id in sorted(mapped)}
    ways = {face_id: way for face_id, way in shortest.items() if way}
    if len(ways) < len(mapped):
        fault = f"face {', '.join(sorted(shortest.keys() - ways))}: never linked to reference face {reference}"
        remedy = f"add a group that shows it together with {reference} or a face that is linked"
        raise MappingError("E-FACE-UNLINKED", f"{fault}; {remedy}")
    from_face, from_group = {face_id: _along(way, faces) for face_id, way in ways.items()}, {}
    for face in sorted(faces, key=lambda face: len(ways[face.face][1])):
        from_group.setdefault(face.group, from_face[face.face] @ face.group_from_face.inverse())
    if singly:
        last = {face_id: groups[-1] for face_id, (_, groups) in ways.items() if groups}
        last.setdefault(reference, next(face.group for face in faces if face.face == reference))
        faces = [face for face in faces if face.group == last[face.face]]
    else:
        from_face, from_group = _adjust(faces, from_face, from_group, reference)
    return CalibratedTarget(reference, from_face, _circles(faces, from_face, target), from_group)


def unlinked_faces(faces: Sequence[FaceInGroup], reference: str) -> list[str]:
    """Faces that no way links to the reference face; empty if none is linked (:func:`chain_faces` raises)."""
    linked = {face.face for face in faces if face.face == reference or _chains(faces, reference, face.face)}
    return sorted({face.face for face in faces} - linked) if len(linked) > 1 else []


def measure_chains(faces: Sequence[FaceInGroup], calibrated: CalibratedTarget) -> dict[str, tuple[FaceChain, ...]]:
    """Returns all ways to every face but the reference face, with their deviations from the calibrated pose."""
    found = {}
    for face_id, pose in calibrated.target_from_face.items():
        if face_id != calibrated.reference_face:
            chains = []
            for way in _chains(faces, calibrated.reference_face, face_id):
                chained = _along(way, faces)
                apart_mm = float(np.linalg.norm(chained.translation - pose.translation))
                chains.append(FaceChain(*way, apart_mm, (chained @ pose.inverse()).angle_rad()))
            found[face_id] = tuple(chains)
    return found


def _chains(faces: Sequence[FaceInGroup], start: str, goal: str) -> list[Way]:
    """Returns the simple ways from one face to another, the shortest first, and those with one face more."""
    by_group: dict[str, list[str]] = defaultdict(list)
    for face in faces:
        by_group[face.group].append(face.face)
    queue, complete = [((start,), ())], []
    for way, groups in queue:
        if way[-1] == goal:
            complete.append((way, groups))
            if len(complete) == MAX_CHAINS:
                break
            continue
        longest = len(complete[0][0]) if complete else max(4, len(by_group))
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


def _adjust(
    faces: Sequence[FaceInGroup], from_face: dict[str, Rigid], from_group: dict[str, Rigid], reference: str
) -> tuple[dict[str, Rigid], dict[str, Rigid]]:
    """Estimates poses of faces and groups in the target frame; what a group sees of a face ties one of either."""
    roots = []  # of the information of (rotation rad, translation mm) of each face frame, perturbed in that frame
    for own in faces:
        by_pose = np.concatenate([-skew(own.xyz_face), np.broadcast_to(np.eye(3), (len(own.labels), 3, 3))], axis=2)
        information = np.einsum("nki,nkl,nlj->ij", by_pose, own.information, by_pose)
        roots.append(np.linalg.cholesky(information + 1e-12 * np.eye(6)).T)
    ids, names, seen = list(from_face), list(from_group), Poses.of(own.group_from_face for own in faces)
    face, group = np.array([(ids.index(own.face), names.index(own.group)) for own in faces]).T
    a = Adjustment()
    on_faces = a.block("faces", Poses.of(from_face.values()), fixed=[ids.index(reference)])
    on_groups = a.block("groups", Poses.of(from_group.values()))

    def apart(of_faces: Poses, of_groups: Poses) -> np.ndarray:
        chained = of_faces[face].inverse() @ of_groups[group] @ seen
        return np.array([pose.log() for pose in chained])

    a.factor(apart, [(on_faces, face), (on_groups, group)], root=np.array(roots))
    # If groups disagree, only damped steps lower the cost, and iteration ends when they gain nothing.
    minimum = a.minimum().required("faces", "check that nothing but the camera moved in a group", accepted=UNKEPT)
    poses = minimum.state
    return dict(zip(ids, poses["faces"], strict=True)), dict(zip(names, poses["groups"], strict=True))


def _circles(faces: Sequence[FaceInGroup], target_from_face: dict[str, Rigid], target: TargetDesign) -> dict:
    """Returns circle centres in the target frame: weighted means over the groups, taken in the face frame."""
    weight: dict[CircleLabel, np.ndarray] = defaultdict(lambda: np.zeros((3, 3)))
    total: dict[CircleLabel, np.ndarray] = defaultdict(lambda: np.zeros(3))
    for own in faces:
        for label, xyz, information in zip(own.labels, own.xyz_face, own.information, strict=True):
            weight[label] += information
            total[label] += information @ xyz
    return {
        label: target_from_face[face.id] @ np.linalg.solve(weight[label], total[label])
        for face in target.faces
        for label in face.labels()
        if label in weight
    }
