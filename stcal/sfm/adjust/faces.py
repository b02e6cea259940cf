"""Face frames from circle centres, the faces of one group, and points of a face of known shape against its design."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from stcal.design import FaceDesign, TargetDesign
from stcal.errors import DegenerateError
from stcal.geometry.arrays import freeze
from stcal.geometry.camera import Camera
from stcal.geometry.normal_equations import generalised_inverse
from stcal.geometry.plane import fit_planes
from stcal.geometry.print_modes import AMPLITUDES, PrintModes, Told
from stcal.geometry.rigid import Poses, Rigid, align_rigid, best_rotations, skew
from stcal.labels import CircleLabel
from stcal.sfm.adjust.refine import projection_jacobians
from stcal.sfm.data.group_model import MetricModel

SHAPE_STEPS, SHAPE_SETTLED = 20, 1e-13
"""Most steps of a design that is laid over points, and the step (rad, mm) at which they end."""


@dataclass(frozen=True, slots=True, eq=False)
class Shape:
    """The n points of a face of known shape against its design, which is laid over them with their weights."""

    members: np.ndarray  # (n,) indices among the circles
    rotation: np.ndarray  # (3, 3) model_from_face
    off_mm: np.ndarray  # (n, 3) points minus design, face frame
    weight: np.ndarray  # (n, 3) 1/σ²
    # (3n, k) derivative of ``off_mm`` by the pose, the relative size of the print if it is free, and the print's modes
    by_pose: np.ndarray
    prior: np.ndarray  # (k,) weights of these unknowns about 0
    value: np.ndarray  # (k - 6,) size, minus 1, and modes
    sized: bool  # whether the size is free

    @classmethod
    def of(
        cls,
        members: np.ndarray,
        design: np.ndarray,
        xyz: np.ndarray,
        weight: np.ndarray,
        size_sigma: float,
        amplitude: float = AMPLITUDES[0],
    ) -> "Shape":
        """Lays the design (n, 3) over points (n, 3); ``size_sigma`` : relative σ of its size; ``amplitude`` : of the
        smooth deviations of its print."""
        modes = PrintModes.of(design[:, :2])
        unit = np.broadcast_to(np.eye(3), (len(xyz), 3, 3))
        smooth = -modes.modes.reshape(len(xyz), 3, -1)
        others = np.concatenate([-design[:, :, None], smooth], axis=2) if size_sigma else smooth
        prior = np.concatenate(
            [np.zeros(6), [size_sigma**-2] if size_sigma else [], (amplitude * modes.spread_mm) ** -2.0]
        )
        pose, value = align_rigid(xyz, design), np.zeros(len(prior) - 6)
        for _ in range(SHAPE_STEPS):
            in_face = (xyz - pose.translation) @ pose.rotation
            off = in_face - design + others @ value
            by_pose = np.concatenate([skew(in_face), -unit, others], axis=2).reshape(len(weight) * 3, -1)
            weighted = weight.reshape(-1, 1) * by_pose
            normal, right = by_pose.T @ weighted + np.diag(prior), weighted.T @ off.ravel()
            right[6:] += prior[6:] * value
            scale = 1 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
            step = -scale * np.linalg.lstsq(normal * scale[:, None] * scale, scale * right, rcond=1e-12)[0]
            if np.abs(step).max() < SHAPE_SETTLED:
                break
            pose, value = pose @ Rigid.exp(step[:6]), value + step[6:]
        return cls(members, pose.rotation, off, weight, by_pose, prior, value, bool(size_sigma))

    def cost(self) -> float:
        """Returns the squared deviations over σ²."""
        return float((self.weight * self.off_mm**2).sum() + self.prior[6:] @ self.value**2)

    def _to_pose(self) -> tuple[np.ndarray, np.ndarray]:
        """The unknowns by the deviations (k, 3n), and their covariance (k, k)."""
        weighted = self.weight.reshape(-1, 1) * self.by_pose
        inverse = generalised_inverse(self.by_pose.T @ weighted + np.diag(self.prior))
        return inverse @ weighted.T, inverse

    def slope(self) -> np.ndarray:
        """Returns half the gradient of the cost by the points, (3n,), model frame."""
        return ((self.weight * self.off_mm) @ self.rotation.T).ravel()

    def normal(self) -> np.ndarray:
        """Returns the normal matrix (3n, 3n) over the points, model frame, with pose, size and modes eliminated."""
        n = len(self.members)
        weighted = self.weight.reshape(-1, 1) * self.by_pose
        inner = np.diag(self.weight.ravel()) - weighted @ self._to_pose()[0]
        blocks = inner.reshape(n, 3, n, 3)
        return np.einsum("ai,minj,bj->manb", self.rotation, blocks, self.rotation, optimize=True).reshape(3 * n, 3 * n)

    def by_size(self) -> np.ndarray:
        """Returns the right-hand side (3n,) that a stated size one σ off brings, model frame; 0 for an exact size."""
        if not self.sized:
            return np.zeros(self.off_mm.size)
        weighted = self.weight.reshape(-1, 1) * self.by_pose
        force = weighted @ self._to_pose()[1][:, 6] * np.sqrt(self.prior[6])
        return (force.reshape(-1, 3) @ self.rotation.T).ravel()

    def _in_face(self, covariance_mm2: np.ndarray) -> np.ndarray:
        n = len(self.members)
        turned = covariance_mm2.reshape(n, 3, n, 3)
        turned = np.einsum("ai,manb,bj->minj", self.rotation, turned, self.rotation, optimize=True)
        return turned.reshape(3 * n, 3 * n)

    def leverage(self, covariance_mm2: np.ndarray) -> np.ndarray:
        """Variance of adjusted deviations, by that of the points, over the stated one, (n, 3), at most 1."""
        turned = self._in_face(covariance_mm2)
        to_pose, of_pose = self._to_pose()
        left = np.eye(len(turned)) - self.by_pose @ to_pose
        variance = np.einsum("ij,jk,ik->i", left, turned, left, optimize=True)
        variance = variance + np.einsum("ij,jk,ik->i", self.by_pose, of_pose, self.by_pose)
        return self.weight * variance.reshape(-1, 3)

    def told(self, covariance_mm2: np.ndarray, amplitude: float) -> Told:
        """Returns what the adjusted points tell about the modes of the print; ``covariance_mm2``: (3n, 3n) of these."""
        to_pose, of_pose = self._to_pose()
        of_points = to_pose @ self._in_face(covariance_mm2) @ to_pose.T
        modes = slice(6 + self.sized, len(self.prior))
        spread = 1 / np.sqrt(self.prior[modes]) / amplitude
        return Told(self.value[self.sized :], (of_pose + of_points)[modes, modes], np.zeros_like(spread), spread)


FrameKind = Literal["plane", "three-point"]
MIN_KNOWN = 3  # smallest number of points of a face of known shape that place it
MIN_PLACING = 4
"""Smallest number of mapped circles that can place the others of their face. Three determine the placement, a fourth
shows how good it is."""


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


def missing_frame_circles(face: FaceDesign, mapped: Collection[str]) -> tuple[str, ...]:
    """Returns the circles of the face's frame that are not mapped; none for a face of known shape."""
    if face.sigma_mm is not None:
        return ()
    return tuple(circle for circle in (face.origin, face.x, face.y) if circle not in mapped)


def with_unmapped(
    face: FaceDesign, xyz: Mapping[str, np.ndarray], known: Mapping[str, np.ndarray] | None = None
) -> dict[str, np.ndarray]:
    """Returns the circles (3,) by id, unmapped ones of the frame by a rigid fit to the design or ``known`` places."""
    missing = missing_frame_circles(face, xyz)
    if not missing:
        return dict(xyz)
    known = dict(zip(face.ids, face.places_mm(face.ids), strict=True)) if known is None else known
    common = [circle for circle in xyz if circle in known]
    names = " and ".join(f"{face.id}:{circle}" for circle in missing)
    if len(common) < MIN_PLACING:
        raise DegenerateError(
            "E-FACE-FRAME-CIRCLES",
            f"face {face.id}: frame circle {names} not mapped, and {len(common)} other circles, {MIN_PLACING} needed; "
            "add views that show it",
        )
    try:
        model_from_known = align_rigid(np.array([xyz[c] for c in common]), np.array([known[c] for c in common]))
    except DegenerateError as error:
        raise DegenerateError(
            "E-FACE-FRAME-CIRCLES", f"face {face.id}: frame circle {names} not mapped; add views that show it"
        ) from error
    return dict(xyz) | {circle: model_from_known @ known[circle] for circle in missing}


def placement_sigma_mm(target: TargetDesign, xyz: dict[CircleLabel, np.ndarray]) -> float:
    """Returns the in-plane σ per axis of circles (3,) about the design, pooled over rigid fits of the faces."""
    square, redundancy = 0.0, 0
    for face in target.faces:
        centres = {label.circle: place for label, place in xyz.items() if label.face == face.id}
        if len(centres) < MIN_PLACING:
            continue
        mapped, design = np.array(list(centres.values())), face.places_mm(centres)
        try:
            away = align_rigid(mapped, design).inverse() @ mapped - design
        except DegenerateError:
            continue
        square += float((away[:, :2] ** 2).sum())
        redundancy += 2 * len(centres) - 3
    return float(np.sqrt(square / redundancy)) if redundancy else 0.0


def face_frame(face: FaceDesign, xyz: dict[str, np.ndarray], kind: FrameKind, towards: np.ndarray) -> Rigid:
    """Returns model_from_face, computed from circle centres by Gram–Schmidt (Zhang & Wei, eqs. 8–10). ``kind``:
    ``three-point`` as in the paper; ``plane``: Z from the plane of all circles; ``towards``: direction to the side from
    which the face is seen."""
    if missing := missing_frame_circles(face, xyz):
        names = " and ".join(f"{face.id}:{circle}" for circle in missing)
        raise DegenerateError(
            "E-FACE-FRAME-CIRCLES", f"face {face.id}: frame circle {names} not mapped; add views that show it"
        )
    return face_frames(face, tuple(xyz), np.array(list(xyz.values()))[None], kind, towards)[0]


def face_frames(
    face: FaceDesign, circles: Sequence[str], xyz: np.ndarray, kind: FrameKind, towards: np.ndarray
) -> Poses:
    """Returns :func:`face_frame` of k sets of centres, (k, n, 3). The frame of a face of known shape is that of the
    design, laid over all of its points by least squares."""
    if face.sigma_mm is not None:
        return _fitted(face, circles, xyz)
    corners = np.stack([xyz[:, list(circles).index(circle)] for circle in (face.origin, face.x, face.y)])
    if kind == "plane":
        normal, offset, _ = fit_planes(xyz, towards)
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


def _fitted(face: FaceDesign, circles: Sequence[str], xyz: np.ndarray) -> Poses:
    design = face.places_mm(circles)
    spread = np.linalg.svd(design - design.mean(0), compute_uv=False) if len(design) >= MIN_KNOWN else np.zeros(2)
    if spread[1] <= 1e-6 * spread[0]:
        raise DegenerateError(
            "E-FACE-FRAME-CIRCLES",
            f"face {face.id}: {len(design)} of its corners mapped, {MIN_KNOWN} needed that are not on one "
            "line; add views that show it",
        )
    middle = xyz.mean(1)
    rotation, _ = best_rotations(np.einsum("kni,nj->kij", xyz - middle[:, None], design - design.mean(0)))
    return Poses(rotation, middle - rotation @ design.mean(0))


def faces_of_group(
    model: MetricModel,
    camera: Camera,
    target: TargetDesign,
    kind: FrameKind,
    known: Mapping[str, Mapping[str, np.ndarray] | None] | None = None,
) -> tuple[list[FaceInGroup], list[str]]:
    """Returns the frames of all faces of one group, and the reasons why other faces have none; frame circles of
    ``known`` faces may be placed by their other circles."""
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
            if known is not None and face.id in known:
                place = with_unmapped(face, place, known[face.id])
            frame = face_frame(face, place, kind, cameras[seen_by].mean(0) - xyz[members].mean(0))
        except DegenerateError as error:
            notes.append(f"group {model.group}: {error}")
            continue
        r = frame.rotation
        faces.append(
            FaceInGroup(
                model.group,
                face.id,
                frame,
                tuple(model.labels[i] for i in members),
                frame.inverse() @ xyz[members],
                r.T @ information[members] @ r,
                len(seen_by),
            )
        )
    if not faces and not notes:
        notes.append(
            f"group {model.group}: no face mapped (two images must see it); add views that show faces and board"
        )
    return faces, notes
