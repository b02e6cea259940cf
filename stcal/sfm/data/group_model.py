"""Data that the stages hand to each other: centres measured in an image; the model of a group, with camera poses and
labelled points; and notes, on faces that are not where the design draws them."""

import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from itertools import combinations
from typing import Self, TypeVar

import numpy as np
from scipy.spatial.distance import pdist

from stcal.design import TargetDesign
from stcal.errors import DegenerateError, StcalError
from stcal.geometry.arrays import freeze
from stcal.geometry.camera import Camera
from stcal.geometry.plane import fit_plane
from stcal.geometry.rigid import Poses, Rigid, Similarity
from stcal.io.table import csv_text
from stcal.labels import CircleLabel, Label, parse_labels

K = TypeVar("K")
ROW_SHAPES: dict[str, tuple[int, ...]] = dict.fromkeys(("centre_px", "centre", "uneven_px"), (2,))
ROW_SHAPES |= {"shape": (2, 2), "covariance_px2": (2, 2), "domes": (3,)}
"""Shape of a circle's value in each field of measured circles that is not one number."""


@dataclass(frozen=True, slots=True, eq=False)
class CircleRows:
    """Base of dataclasses whose fields are arrays with a row for each circle."""

    def select(self, keep: np.ndarray) -> Self:
        """Returns the circles of the indices or mask ``keep``."""
        return type(self)(*(getattr(self, f.name)[keep] for f in fields(self)))

    @classmethod
    def concatenate(cls, parts: Sequence[Self]) -> Self:
        """Returns the circles of all parts, one part after the other."""
        names = [f.name for f in fields(cls)]
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


class Measured:
    """Base of measurements with a covariance each."""

    __slots__ = ()
    covariance_px2: np.ndarray  # (n, 2, 2)

    def sigma_px(self) -> np.ndarray:
        """Returns the standard deviation of each measurement per axis (RMS over both axes), (n,)."""
        return np.sqrt(np.trace(self.covariance_px2, axis1=1, axis2=2) / 2)


@dataclass(frozen=True, slots=True, eq=False)
class ImageObservations(Measured):
    """n labelled circles of one image."""

    name: str
    group: str
    labels: tuple[Label, ...]
    centre_px: np.ndarray  # (n, 2) ellipse centres in the original image, OpenCV pixel origin
    centre: np.ndarray  # (n, 2) of the ideal ellipse in normalised coordinates
    shape: np.ndarray  # (n, 2, 2) of the same
    covariance_px2: np.ndarray  # (n, 2, 2) of ``centre_px``
    uneven_px: np.ndarray = None  # type: ignore[assignment]  # (n, 2) shift that uneven brightness would have caused
    blur_px: np.ndarray = None  # type: ignore[assignment]  # (n,) standard deviation across each rim, zero if unknown
    domes: np.ndarray = None  # type: ignore[assignment]  # (n, 3) as of :class:`Centres`

    def __post_init__(self):
        object.__setattr__(self, "labels", parse_labels(self.labels))
        for f in fields(self)[3:]:
            shape = (len(self.labels), *ROW_SHAPES.get(f.name, ()))
            if getattr(self, f.name) is None and f.default is None:
                object.__setattr__(self, f.name, np.zeros(shape))
            freeze(self, f.name, shape, f.name)

    def __len__(self) -> int:
        return len(self.labels)

    def face_ids(self) -> list[str]:
        """Returns the ids of the target's faces that the labels name, in order of appearance."""
        return list(dict.fromkeys(label.face for label in self.labels if isinstance(label, CircleLabel)))

    def plus(self, other: "ImageObservations") -> "ImageObservations":
        """Returns these circles followed by the circles of ``other``, observations of the same image."""
        arrays = [np.concatenate([getattr(self, f.name), getattr(other, f.name)]) for f in fields(self)[3:]]
        return ImageObservations(self.name, self.group, self.labels + other.labels, *arrays)

    def select(self, keep) -> "ImageObservations":
        """Returns the circles of the indices ``keep``."""
        arrays = {f.name: getattr(self, f.name)[keep] for f in fields(self)[3:]}
        return replace(self, labels=tuple(self.labels[i] for i in keep), **arrays)


def rows_by(keys: Iterable[K]) -> dict[K, np.ndarray]:
    """Returns the indices of each key, in order of appearance."""
    rows: dict[K, list[int]] = {}
    for i, key in enumerate(keys):
        rows.setdefault(key, []).append(i)
    return {key: np.array(own) for key, own in rows.items()}


def by_group(observations: Sequence[ImageObservations]) -> dict[str, list[ImageObservations]]:
    groups = rows_by(image.group for image in observations)
    return {group: [observations[i] for i in rows] for group, rows in groups.items()}


def detections_csv(observations: list[ImageObservations]) -> str:
    rows: list[Sequence] = [["image", "label", "x_px", "y_px", "sigma_px"]]
    for image in observations:
        for label, (x, y), sigma in zip(image.labels, image.centre_px, image.sigma_px(), strict=True):
            rows.append([image.name, label, f"{x:.5f}", f"{y:.5f}", f"{sigma:.5f}"])
    return csv_text(rows)


@dataclass(frozen=True, slots=True, eq=False)
class Centres(CircleRows, Measured):
    """n measured ellipses."""

    centre_px: np.ndarray  # (n, 2) of the ideal ellipse, distorted into the original image (OpenCV pixel origin)
    centre: np.ndarray  # (n, 2) the same in normalised ideal coordinates
    shape: np.ndarray  # (n, 2, 2) in these coordinates, rim = centre + shape @ unit circle
    covariance_px2: np.ndarray  # (n, 2, 2) of ``centre_px``
    blur_px: np.ndarray
    contrast: np.ndarray  # (n,) grey values, inside minus outside
    noise: np.ndarray  # (n,) robust σ of a pixel about the model, grey values
    rim: np.ndarray  # (n,) share of the rim that follows the model
    uneven_px: np.ndarray  # (n, 2) shift that uneven brightness would have caused
    # (n, 3) by which share of the contrast a disc is brighter in its middle than at its rim, σ of that (0: unknown),
    # and the share of its radius by which a dome of the whole contrast makes it look smaller
    domes: np.ndarray
    ok: np.ndarray  # (n,) True if the ellipse is usable

    def __post_init__(self):
        for f in fields(self):
            shape, dtype = (len(self.centre_px), *ROW_SHAPES.get(f.name, ())), bool if f.name == "ok" else float
            freeze(self, f.name, shape, f.name, dtype)

    def __len__(self) -> int:
        return len(self.centre_px)

    @classmethod
    def without_rims(
        cls, centre_px: np.ndarray, centre: np.ndarray, shape: np.ndarray, covariance_px2: np.ndarray, contrast=None
    ) -> "Centres":
        """Returns centres of which no rim is measured, as those of corners; ``contrast`` is zero if None."""
        n, zero, one = len(centre_px), np.zeros(len(centre_px)), np.ones(len(centre_px))
        contrast, uneven, domes = zero if contrast is None else contrast, np.zeros((n, 2)), np.zeros((n, 3))
        return cls(centre_px, centre, shape, covariance_px2, zero, contrast, zero, one, uneven, domes, ok=one)


_PER_OBSERVATION = ("image_index", "point_index", "keypoint", "measured_px", "shift_px", "covariance_px2")
MIN_POINTS = 6  # smallest number of labelled points that an image must observe. COLMAP's defaults expect thousands.


@dataclass(frozen=True, slots=True)
class Outlier:
    """An observation that is excluded because it contradicts all others."""

    image: str
    label: Label
    residual_px: float
    limit_px: float


@dataclass(frozen=True, slots=True, eq=False)
class GroupModel(Measured):
    """m images, p points and n observations of one group: the common base of models with and without a unit."""

    group: str
    images: tuple[str, ...]  # (m,) names
    camera_from_model: tuple[Rigid, ...]  # (m,)
    labels: tuple[Label, ...]  # (p,)
    xyz_model: np.ndarray  # (p, 3), see :class:`WorldModel` and :class:`MetricModel`
    image_index: np.ndarray  # (n,)
    point_index: np.ndarray  # (n,)
    keypoint: np.ndarray  # (n,) index among the image's observations
    measured_px: np.ndarray  # (n, 2) ellipse centres
    shift_px: np.ndarray  # (n, 2) eccentricity: ellipse centre minus image of the circle's centre, zero until known
    covariance_px2: np.ndarray  # (n, 2, 2) of the measured centres

    def __post_init__(self):
        object.__setattr__(self, "labels", parse_labels(self.labels))
        n = len(self.image_index)
        freeze(self, "xyz_model", (len(self.labels), 3), "points")
        for name, shape in (("measured_px", (n, 2)), ("shift_px", (n, 2)), ("covariance_px2", (n, 2, 2))):
            freeze(self, name, shape, name)
        for name in ("image_index", "point_index", "keypoint"):
            freeze(self, name, (n,), name, dtype=int)

    def corrected_px(self) -> np.ndarray:
        """Returns the images of the circles' centres, (n, 2): measured ellipse centres minus eccentricity."""
        return self.measured_px - self.shift_px

    def whiten(self, values_px: np.ndarray) -> np.ndarray:
        """Whitens values (n, 2) or (n, 2, k), px, by the covariances of their observations."""
        (xx, xy), (_, yy) = np.moveaxis(self.covariance_px2, (1, 2), (0, 1))
        across = np.sqrt(np.maximum(yy - xy * xy / xx, 1e-12 * yy))
        first, second = values_px[:, 0], values_px[:, 1]
        expand = (...,) if values_px.ndim == 2 else (..., None)
        slope, along, across = (xy / xx)[expand], np.sqrt(xx)[expand], across[expand]
        return np.stack([first / along, (second - slope * first) / across], axis=1)

    def rows_by_image(self) -> list[np.ndarray]:
        """Returns the indices of the observations of each image, in the order of ``images``."""
        order = np.argsort(self.image_index, kind="stable")
        return np.split(order, np.searchsorted(self.image_index[order], np.arange(1, len(self.images))))

    def seen(self) -> list[tuple[str, Label]]:
        """Returns the names of image and label of each observation."""
        rows = zip(self.image_index.tolist(), self.point_index.tolist(), strict=True)
        return [(self.images[i], self.labels[p]) for i, p in rows]

    def keypoints_px(self, image: ImageObservations, rows: np.ndarray) -> np.ndarray:
        """Returns all keypoints of one image, (k, 2): corrected if in the model (``rows``), else measured."""
        xy = image.centre_px.copy()
        xy[self.keypoint[rows]] = self.corrected_px()[rows]
        return xy

    def xyz_camera(self) -> np.ndarray:
        """Returns the observed points in the frames of the cameras that observe them, (n, 3)."""
        return Poses.of(self.camera_from_model)[self.image_index] @ self.xyz_model[self.point_index]

    def by_parameters(self, camera: Camera) -> np.ndarray:
        """Returns the derivatives of the projections (px) by the camera's parameters, (n, 2, 16)."""
        xyz = self.xyz_camera()
        return camera.parameter_jacobian(xyz[:, :2] / xyz[:, 2:])

    def residuals_px(self, camera: Camera) -> np.ndarray:
        """Returns the residuals, corrected minus projected, (n, 2)."""
        return self.corrected_px() - camera.project(self.xyz_camera())

    def _placed(self, kind: type["M"], a_from_model: Similarity) -> "M":
        """Returns the model transformed to another frame and unit, as a model of the given kind."""
        (rotation, shift), scale = (a_from_model.rigid.rotation, a_from_model.rigid.translation), a_from_model.scale
        turned = [(pose.rotation @ rotation.T, scale * pose.translation) for pose in self.camera_from_model]
        poses = tuple(Rigid(turn, translation - turn @ shift) for turn, translation in turned)
        same = {f.name: getattr(self, f.name) for f in fields(self)}
        return kind(**same | {"camera_from_model": poses, "xyz_model": a_from_model @ self.xyz_model})

    def observed(self: "M", rows: np.ndarray) -> "M":
        """Returns the model with the given observations only, but with all of its images and points."""
        return replace(self, **{name: getattr(self, name)[rows] for name in _PER_OBSERVATION})

    def plus(self: "M", other: "M") -> "M":
        """Returns the model with the images of another one of the same points."""
        both = {name: np.concatenate([getattr(self, name), getattr(other, name)]) for name in _PER_OBSERVATION}
        both["image_index"][len(self.image_index) :] += len(self.images)
        poses = self.camera_from_model + other.camera_from_model
        return replace(self, images=self.images + other.images, camera_from_model=poses, **both)

    def points_by_face(self) -> dict[str, np.ndarray]:
        """Returns the indices of the points by face; the points of the board have the key ``board``."""
        return rows_by(label.plane for label in self.labels)

    def normals(self) -> np.ndarray:
        """Returns the normal of each point's face or board, (p, 3); zero where the model has too few points of it."""
        normal = np.zeros((len(self.labels), 3))
        for members in self.points_by_face().values():
            with suppress(DegenerateError):
                normal[members] = fit_plane(self.xyz_model[members]).normal
        return normal

    def without(self: "M", drop: np.ndarray) -> "M":
        """Returns the model without the observations of mask ``drop``, then points of one image and images of five."""
        keep = ~drop
        while True:
            points = np.bincount(self.point_index[keep], minlength=len(self.labels))
            images = np.bincount(self.image_index[keep], minlength=len(self.images))
            still_kept = keep & (points[self.point_index] >= 2) & (images[self.image_index] >= MIN_POINTS)
            if (still_kept == keep).all():
                break
            keep = still_kept
        kept_points, kept_images = np.flatnonzero(points), np.flatnonzero(images)
        arrays = {name: getattr(self, name)[keep] for name in _PER_OBSERVATION}
        arrays["point_index"] = np.searchsorted(kept_points, arrays["point_index"])
        arrays["image_index"] = np.searchsorted(kept_images, arrays["image_index"])
        images, poses = (tuple(each[i] for i in kept_images) for each in (self.images, self.camera_from_model))
        labels, points = tuple(self.labels[i] for i in kept_points), self.xyz_model[kept_points]
        return replace(self, images=images, camera_from_model=poses, labels=labels, xyz_model=points, **arrays)


M = TypeVar("M", bound=GroupModel)
"""Type of a model of either kind. Functions that keep the unit of a model keep its type."""


@dataclass(frozen=True, slots=True, eq=False)
class WorldModel(GroupModel):
    """A model from the mapper. Its frame is a world of arbitrary origin, orientation and unit."""

    def moved(self, a_from_world: Similarity) -> "WorldModel":
        """Returns the model transformed to another world and unit."""
        return self._placed(WorldModel, a_from_world)

    def metric(self, a_from_world: Similarity) -> "MetricModel":
        """Returns the model in mm, in frame a."""
        return self._placed(MetricModel, a_from_world)


@dataclass(frozen=True, slots=True, eq=False)
class MetricModel(GroupModel):
    """A model in mm. Its frame is the target's if the group is chained to it, else the group's or the board's."""

    def moved(self, a_from_model: Rigid) -> "MetricModel":
        """Returns the model in another frame."""
        return self._placed(MetricModel, Similarity(1.0, a_from_model))

    def in_world(self, world_from_model: Similarity) -> "WorldModel":
        """Returns the model in a world without unit, as the mapper would have made it; for simulations."""
        return self._placed(WorldModel, world_from_model)


def assemble(
    kind: type[M],
    group: str,
    images: Sequence[ImageObservations],
    poses: Iterable[Rigid],
    xyz: Mapping[Label, np.ndarray],
) -> M:
    """Returns the model of placed images and labelled points, with all observations of these points in these images."""
    labels = sorted(xyz)
    index = {label: i for i, label in enumerate(labels)}
    every = ((i, label, k) for i, image in enumerate(images) for k, label in enumerate(image.labels))
    rows = [(i, index[label], k) for i, label, k in every if label in index]
    image_index, point_index, keypoint = np.array(rows, int).reshape(-1, 3).T
    row = np.cumsum([0, *(len(image) for image in images)])[image_index] + keypoint
    names, points = tuple(image.name for image in images), np.array([xyz[label] for label in labels]).reshape(-1, 3)
    measured_px = np.concatenate([image.centre_px for image in images])[row]
    covariance_px2 = np.concatenate([image.covariance_px2 for image in images])[row]
    observed = image_index, point_index, keypoint, measured_px, np.zeros((len(rows), 2)), covariance_px2
    return kind(group, names, tuple(poses), tuple(labels), points, *observed)


NOT_AS_DRAWN = "not-as-drawn"  # faces are not where the design, or the names of groups, have them
GROUP_LEFT_OUT = "group-left-out"
BOARD_LEFT_OUT = "board-left-out"  # A whole board in an image, not single dots
ELSEWHERE = "face-elsewhere"  # faces that were read in an image and left out: not where others see them
BEGINNINGS = {NOT_AS_DRAWN: "not as drawn: ", GROUP_LEFT_OUT: "left out whole: "}


class Note(str):
    """The sentence of a remark. ``code`` : kind of remark; ``place`` : name of the face or group that it is about;
    ``words`` and ``remedy`` : the sentence in two parts, what was found and what to do."""

    code: str
    place: str
    words: str
    remedy: str

    def __new__(cls, words: str, code: str = "", place: str = "", remedy: str = "", then: str = "; ") -> "Note":
        """Returns the note; ``then`` stands between words and remedy."""
        note = super().__new__(cls, f"{BEGINNINGS.get(code, '')}{words}{then if remedy else ''}{remedy}")
        note.code, note.place, note.words, note.remedy = code, place, words, remedy
        return note

    @property
    def note(self) -> str:
        """The whole sentence."""
        return str(self)

    @classmethod
    def of_group(cls, group: str, error: StcalError) -> "Note":
        """Returns the note on a group that an error leaves out."""
        return cls(error.fault, GROUP_LEFT_OUT, group, error.remedy)


def lost_groups(notes) -> list[str]:
    """Returns the names of the groups that were left out, of all notes of a run."""
    return [note.place for note in notes if isinstance(note, Note) and note.code == GROUP_LEFT_OUT]


MOST_TURNED_DEG = 25.0
"""Largest angle of a face to its rough pose. A rough pose is good to a few degrees; a face on the wrong side of the
body, or drawn turned, is off by far more."""
FAR_DEG = 45.0  # angle from which a face is not the one that was drawn: half of that between two sides of a box
LIKE_DRAWN = 1.3  # largest factor between distances of faces and those of their rough poses


def not_as_drawn(target_from_face: Mapping[str, Rigid], design: TargetDesign, one_folder: bool = False) -> list[Note]:
    """Returns notes on faces that are not where the rough poses of the design have them; ``one_folder``: whether
    photographs in one folder were taken to be of one setting of target and board."""
    rough = {face: pose for face, pose in design.rough_poses().items() if face in target_from_face}
    if len(rough) < 2:
        return []
    notes, found = [], {face: target_from_face[face] for face in rough}
    drawn, seen = (pdist([pose.translation for pose in of.values()]) for of in (rough, found))
    ratio = float(np.median(seen[drawn > 0] / drawn[drawn > 0])) if drawn.any() else 1.0
    if not 1 / LIKE_DRAWN < ratio < LIKE_DRAWN:
        what = f"faces are {ratio:.2g} times as far from one another as their rough_pose in target.toml has them"
        sizes = "check the sizes that it states (size_mm, radius_mm, pitch_mm), and that of the board"
        notes.append(Note(what, NOT_AS_DRAWN, remedy=sizes, then=": "))
    if not (turned := turned_faces(found, rough)):
        return notes
    what = ", ".join(f"face {face} is turned by {angle:.0f}°" for face, angle in turned.items())
    what += " against rough_pose in target.toml"
    for a, b in combinations(turned, 2):
        exchanged = rough | {a: rough[b], b: rough[a]}
        if not {a, b} & turned_faces(found, exchanged).keys():
            what += f", as if the names of faces {a} and {b} were exchanged"
            break
    folders = "put the photographs of each setting of target and board into a folder of its own; or " * one_folder
    return [*notes, Note(what, NOT_AS_DRAWN, remedy=f"{folders}correct names, ids or rough_pose", then=": ")]


def turned_faces(found: Mapping[str, Rigid], rough: Mapping[str, Rigid]) -> dict[str, float]:
    """Returns the faces that are turned against most others, with their angles, degrees."""
    off = {face: found[face].rotation @ rough[face].rotation.T for face in rough}
    turned = []  # by each face in turn taken for the anchor
    for anchor in off.values():
        angles = {face: float(np.degrees(Rigid(anchor.T @ other).angle_rad())) for face, other in off.items()}
        turned.append({face: angle for face, angle in angles.items() if angle > MOST_TURNED_DEG})
    return min(turned, key=len)


def faces_in_name(group: str, ids: Sequence[str]) -> set[str]:
    """Returns the faces, at least two, of which a group's name consists; empty if it consists of anything else."""
    for parts in (re.split("[-_+ ]", group), list(group)):
        if len(parts) > 1 and len(set(parts)) == len(parts) and set(parts) <= set(ids):
            return set(parts)
    return set()
