"""Contents of one image before comparison with its group, and circles of a face that also fit another face."""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np

from stcal.design import BoardDesign, FaceDesign, TargetDesign
from stcal.geometry.rigid import Rigid
from stcal.labels import BOARD, CircleLabel, DotLabel, Label
from stcal.lookalikes import common_circles, mirrored_circles, whole_likeness
from stcal.sfm.data.group_model import Centres
from stcal.sfm.data.patterns import planar_pose

SECOND_BOARD_SHARE = 0.8
"""Smallest number of dots of a second board, as a share of the dots of the first."""
MIN_NAMING = 6
"""Smallest number of circles that can name a face: four determine a homography, two more confirm it."""
MIN_POSE_CIRCLES = 5
"""Smallest number of circles for a pose. Four determine it, a fifth allows a check."""


@dataclass(frozen=True, slots=True, eq=False)
class FaceSighting:
    """A face in an image."""

    face: str
    rows: np.ndarray  # (n,) indices of its circles among the image's centres
    circles: np.ndarray  # (n,) their indices in the design

    def labels(self, design: FaceDesign) -> tuple[CircleLabel, ...]:
        """Returns the labels of its circles."""
        labels = design.labels()
        return tuple(labels[i] for i in self.circles)


OpenFace = tuple[FaceSighting, ...]
"""A pattern that the image alone cannot name: all faces that it may be."""


def open_face_note(circles: int, faces: Iterable[str]) -> str:
    """Returns the note for a pattern of the given number of circles that stays without a name."""
    return (
        f"a pattern of {circles} circles that fits face {', '.join(sorted(set(faces)))} but may be another; left out, "
        "show the circles that tell the faces apart"
    )


@dataclass(frozen=True, slots=True, eq=False)
class BoardSighting:
    """A board in an image."""

    rows: np.ndarray  # (n,) indices of its dots among the image's centres
    numberings: np.ndarray  # (k, n, 2) row and column of each dot in each numbering, the likeliest first
    # (u, n, 2) that require covered dots inside the image; the group may confirm them
    unlikely: np.ndarray = field(default_factory=lambda: np.zeros((0, 0, 2), int))


@dataclass(frozen=True, slots=True, eq=False)
class ImageDetection:
    """Result of detection in one image; a face or the board may occur more than once."""

    centres: Centres
    faces: tuple[FaceSighting, ...]
    boards: tuple[BoardSighting, ...] = ()  # the one with the most dots first
    mirrored: tuple[str, ...] = ()  # ids of faces
    notes: tuple[str, ...] = ()  # exclusions with reasons
    candidates: int = field(default=0)  # number of outlines
    open_faces: tuple[OpenFace, ...] = ()  # patterns without a name
    # faces with a board or tags, whose corners are among the centres, without extent
    printed: tuple[FaceSighting, ...] = ()

    @property
    def repeated(self) -> tuple[str, ...]:
        """Names of the faces, and of the board, that are in view more than once."""
        ids = [sighting.face for sighting in self.faces]
        boards = self.boards[1:2] and len(self.boards[1].rows) >= SECOND_BOARD_SHARE * len(self.boards[0].rows)
        return (BOARD,) * bool(boards) + tuple(f"face {i}" for i in sorted(set(ids)) if ids.count(i) > 1)

    @property
    def board(self) -> BoardSighting | None:
        """The only board of the image; None if there is none, or a second one of similar size."""
        return None if not self.boards or BOARD in self.repeated else self.boards[0]

    def single_faces(self) -> tuple[FaceSighting, ...]:
        """Returns the faces that are in view exactly once."""
        ids = [sighting.face for sighting in self.faces]
        return (*(sighting for sighting in self.faces if ids.count(sighting.face) == 1), *self.printed)

    def labelled_rows(self, target: TargetDesign) -> tuple[list[CircleLabel], np.ndarray]:
        """Returns the labels of the circles of :meth:`single_faces`, and their indices among the centres."""
        faces = self.single_faces()
        labels = [label for each in faces for label in each.labels(target.face(each.face))]
        return labels, np.concatenate([each.rows for each in faces]) if faces else np.zeros(0, int)


@dataclass(frozen=True, slots=True, eq=False)
class PlaneView:
    """One reading of n circles of an image as circles of one plane."""

    plane: str  # face id or ``board``
    labels: tuple[Label, ...]
    rows: np.ndarray  # (n,) indices among the image's centres
    xy_mm: np.ndarray  # (n, 2) in the plane
    xy: np.ndarray  # (n, 2) measured, normalised
    area: float  # sum of the ellipses' areas over π, normalised
    camera_from_plane: Rigid  # from these circles alone
    named: bool = True  # whether the image alone identifies the plane
    likely: bool = True  # whether missing circles are outside of the image rather than covered

    def xyz_mm(self) -> np.ndarray:
        """Returns the circles' centres, (n, 3), in the plane's frame."""
        return np.column_stack([self.xy_mm, np.zeros(len(self.xy_mm))])

    def span_mm(self) -> np.ndarray:
        """Returns three corners of the circles' bounding box, (3, 3), in the plane's frame."""
        low, high = self.xy_mm.min(0), self.xy_mm.max(0)
        return np.array([[*low, 0.0], [high[0], low[1], 0.0], [low[0], high[1], 0.0]])


Readings = list[PlaneView]
"""Alternative readings of the same circles, of which one is right."""


def readings_of(detection: ImageDetection, target: TargetDesign, board: BoardDesign | None) -> list[Readings]:
    """Returns the readings of one image with poses; not of patterns in view twice, one of which may be a reflection."""
    ids = [each.face for each in detection.faces]
    patterns = [((each,), True) for each in detection.faces if ids.count(each.face) == 1]
    readings: list[Readings] = []
    for faces, named in (*patterns, *((faces, False) for faces in detection.open_faces)):
        views = [_face_view(each, target, detection, named) for each in faces]
        readings.append([view for view in views if view is not None])
    boards = () if board is None or BOARD in detection.repeated else detection.boards
    for each, places_mm in ((each, board.places_mm) for each in boards if board is not None):
        views = []
        for k, cells in enumerate((*each.numberings, *each.unlikely)):
            labels = tuple(DotLabel(*cell) for cell in cells.tolist())
            view = _view(BOARD, labels, each.rows, places_mm(labels)[:, :2], detection)
            views.append(view and replace(view, likely=k < len(each.numberings)))
        if all(views[: len(each.numberings)]):
            readings.append([view for view in views if view is not None])
    return [views for views in readings if views]


def likely_views(readings: list[Readings]) -> list[Readings]:
    """Returns the readings without those that require covered circles."""
    return [[view for view in views if view.likely] for views in readings]


def _face_view(each: FaceSighting, target: TargetDesign, detection: ImageDetection, named: bool) -> PlaneView | None:
    face = target.face(each.face)
    return _view(face.id, each.labels(face), each.rows, face.xy_mm[each.circles], detection, named)


def _view(
    plane: str, labels, rows: np.ndarray, xy_mm: np.ndarray, detection: ImageDetection, named: bool = True
) -> PlaneView | None:
    xy = detection.centres.centre[rows]
    pose = planar_pose(xy_mm, xy) if len(rows) >= MIN_POSE_CIRCLES else None
    area = float(np.abs(np.linalg.det(detection.centres.shape[rows])).sum())
    return None if pose is None else PlaneView(plane, labels, rows, xy_mm, xy, area, pose, named)


def confusable(face: FaceDesign, target: TargetDesign) -> set[frozenset[int]]:
    """Returns the sets of a face's circles that another reading explains as well; such a set names no face."""
    return set().union(
        *(common_circles(face.xy_mm, face.radius_mm, o.xy_mm, o.radius_mm, o.id == face.id) for o in target.faces)
    )


def in_common(face: FaceDesign, other: FaceDesign, mirrored: bool = False) -> int:
    """Returns the largest number of circles that coincide with another face, or with the own after a turn; 0 below
    ``MIN_COMMON``. The face is moved rigidly or, if ``mirrored``, turned over."""
    xy = np.asarray(face.xy_mm) * [-1 if mirrored else 1, 1]
    same = face.id == other.id and not mirrored
    found = common_circles(xy, face.radius_mm, other.xy_mm, other.radius_mm, same)
    return max(map(len, found), default=0)


def is_named(face: FaceDesign, found: np.ndarray, target: TargetDesign) -> bool:
    """Returns whether the circles found (mask) name the face, as no other reading explains them all."""
    circles = frozenset(np.flatnonzero(found).tolist())
    return not any(circles <= rival for rival in confusable(face, target))


def likeness_notes(target: TargetDesign) -> list[str]:
    """Returns notes about faces that only one circle distinguishes, and mirror images; tags name themselves."""
    target = target.with_faces(printed=False)
    near = [telling for face in target.faces for other in target.faces for telling in _telling(face, other)]
    notes = []
    if near:
        gap, face, other, circle = min(near)
        faces = [each.id for each in target.faces if any(each.id in telling[1:3] for telling in near)]
        rival = "the same face turned" if face == other else f"face {other}"
        notes.append(
            f"target {target.name}: face{'s' * (len(faces) > 1)} {', '.join(faces)}: one circle tells each from "
            f"another, or from itself turned (the least is {face}:{circle} against {rival}, {gap:.1f} mm); where it is "
            "hidden, the face has no name"
        )
    alike = mirror_images(target)
    if pairs := {tuple(sorted((face, other))) for face, others in alike.items() for other in others}:
        listed = ", ".join(f"{a} of itself" if a == b else f"{a} and {b}" for a, b in sorted(pairs))
        notes.append(f"target {target.name}: faces are mirror images: {listed}; a reflection passes for a face")
    partly = [
        (len(pairs), face.id, other.id, len(other.ids))
        for face, other in product(target.faces, target.faces)
        if other.id not in alike.get(face.id, ())
        for pairs in mirrored_as(face, other)
        if len(pairs) >= MIN_NAMING and is_named(other, np.isin(np.arange(len(other.ids)), pairs[:, 1]), target)
    ]
    if partly:
        common, face, other, count = max(partly)
        notes.append(
            f"target {target.name}: a reflection of face {face} shows {common} of the {count} circles of "
            f"{'that face' if face == other else f'face {other}'} itself; where the others are hidden, it passes for it"
        )
    return notes


def _telling(face: FaceDesign, other: FaceDesign) -> list[tuple[float, str, str, str]]:
    """Returns single circles that distinguish a face from another one: distance in mm, both faces, and the circle."""
    rival = other.xy_mm, other.radius_mm
    telling = []
    for common in common_circles(face.xy_mm, face.radius_mm, *rival, same=face is other):
        if len(common) != len(face.ids) - 1:
            continue
        shared = np.array(sorted(common))
        like = whole_likeness(face.xy_mm[shared], face.radius_mm[shared], *rival, shared if face is other else None)
        if like is not None:
            (alone,) = set(range(len(face.ids))) - common
            gap = np.linalg.norm(like.moved(face.xy_mm[alone]) - other.xy_mm, axis=1).min()
            telling.append((float(gap), face.id, other.id, face.ids[alone]))
    return telling


def mirror_images(target: TargetDesign) -> dict[str, tuple[str, ...]]:
    """Returns by face the faces that its mirror image looks like, whole and with its radii; others have no entry."""
    found: dict[str, tuple[str, ...]] = {}
    for face, other in product(target.faces, target.faces):
        if any(len(face.ids) == len(other.ids) == len(pairs) for pairs in mirrored_as(face, other)):
            found[face.id] = (*found.get(face.id, ()), other.id)
    return found


def mirrored_as(face: FaceDesign, other: FaceDesign) -> list[np.ndarray]:
    """Returns the circles of a face's mirror image that pass for circles of another."""
    return mirrored_circles(face.xy_mm, face.radius_mm, other.xy_mm, other.radius_mm)
