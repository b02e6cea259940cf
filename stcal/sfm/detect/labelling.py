"""Labels of all circles: what a pattern may be is decided by its image, its group, and all groups.

The score is the number of circles that a rigid arrangement of faces and board explains. Within one image the number of
planes goes before it, as a board has more dots than all faces.

1. An image offers readings, a pose each: of a face that it names one, of a pattern that fits several faces one each, of
   a board one for each numbering. A pattern in view twice has none: one of the two may be a reflection.
2. A group has one arrangement: its faces and board are rigid to one another. Arrangements are grown from the most
   reliable images, from a plane to the images that show it and to the planes that these show, and adjusted. The one of
   the best score holds. A reading that fits it gives its labels; one that does not, or of which several fit, a note.
   A face that is turned by more than ``FAR_DEG`` from its rough pose, against most others, is not that face.
3. All groups have one arrangement of the faces, grown in the same way, with groups in the place of images. A face that
   most groups have elsewhere goes out; one that other groups know is sought.
4. A second look (:mod:`.predict`) measures circles that must be in view and have no label. What is not as large as
   its plane asks for, or not where its group has it, goes out.

In photographs of the board alone, the camera's motion numbers a plain board, which looks the same after half a turn.
The numbering of a group's first image is a convention. The corners of printed faces name themselves.
"""

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import KDTree

from stcal.boards.board_designs import CornerBoard
from stcal.boards.board_file import board_of
from stcal.boards.target_file import target_of
from stcal.design import BoardDesign, TargetDesign
from stcal.geometry.arrays import ByValue, require_arguments
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Poses, Rigid
from stcal.io.cameras.camera_model import CameraModel
from stcal.io.cameras.read import camera_model
from stcal.io.images import grey_of
from stcal.labels import BOARD, DotLabel, Label
from stcal.sfm.data.group_model import BOARD_LEFT_OUT, ELSEWHERE, FAR_DEG, Centres, ImageObservations, Note
from stcal.sfm.data.patterns import MAX_TILT_RAD, Pattern, patterns_of, planar_pose
from stcal.sfm.detect.candidates import EllipseOptions, ImageDetection
from stcal.sfm.detect.defocus import Focus, correct_defocus
from stcal.sfm.detect.detect_files import DetectedImage, DetectionResult, look_again
from stcal.sfm.detect.face_patterns import MIN_NAMING
from stcal.sfm.detect.image import detect_image
from stcal.sfm.detect.predict import (
    CONTRADICTED,
    MISSED,
    PredictedCircles,
    adjusted_planes,
    contradictions,
    notes_by_plane,
    outlying_circles,
    predict_circles,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Named = tuple[str, str, ImageDetection]
"""Name and group of an image, and what it shows."""


MIN_POSE_CIRCLES = 5  # smallest number of circles for a pose. Four determine it, a fifth allows a check.


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
        return np.pad(self.xy_mm, ((0, 0), (0, 1)))

    def span_mm(self) -> np.ndarray:
        """Returns three corners of the circles' bounding box, (3, 3), in the plane's frame."""
        low, high = self.xy_mm.min(0), self.xy_mm.max(0)
        return np.array([[*low, 0.0], [high[0], low[1], 0.0], [low[0], high[1], 0.0]])


Readings = list[PlaneView]
"""Alternative readings of the same circles, of which one is right."""


def readings_of(detection: ImageDetection, target: TargetDesign, board: BoardDesign | None) -> list[Readings]:
    """Returns the readings of one image with poses; not of patterns in view twice, one of which may be a reflection."""

    def view(plane: str, labels: Sequence[Label], xy_mm: np.ndarray, rows: np.ndarray, **more: bool) -> Readings:
        xy = detection.centres.centre[rows]
        pose = planar_pose(xy_mm, xy) if len(rows) >= MIN_POSE_CIRCLES else None
        area = float(np.abs(np.linalg.det(detection.centres.shape[rows])).sum())
        return [] if pose is None else [PlaneView(plane, tuple(labels), rows, xy_mm, xy, area, pose, **more)]

    ids = [each.face for each in detection.faces]
    patterns = [((each,), True) for each in detection.faces if ids.count(each.face) == 1]
    readings: list[Readings] = []
    for sightings, named in (*patterns, *((faces, False) for faces in detection.open_faces)):
        faces = [(each, target.face(each.face)) for each in sightings]
        views = [view(f.id, each.labels(f), f.xy_mm[each.circles], each.rows, named=named) for each, f in faces]
        readings.append([*chain.from_iterable(views)])
    boards = () if board is None or BOARD in detection.repeated else detection.boards
    for each, places_mm in ((each, board.places_mm) for each in boards if board is not None):
        likely, views = len(each.numberings), []
        for k, cells in enumerate((*each.numberings, *each.unlikely)):
            labels = [DotLabel(*cell) for cell in cells.tolist()]
            views.append(view(BOARD, labels, places_mm(labels)[:, :2], each.rows, likely=k < likely))
        if all(views[:likely]):
            readings.append([*chain.from_iterable(views)])
    return [views for views in readings if views]


MAX_SHIFT_PITCHES = 0.3
"""Largest deviation of a plane from its place in an image's first pose, in steps; a wrong numbering deviates by one."""
MAX_SEEDS = 8  # largest number of start images, until one explains everything
MAX_OFF_PITCHES = 0.12
"""Largest median deviation of a reading's circles after the adjustment, in steps: 3 mm for the reference target."""


@dataclass(frozen=True, slots=True, eq=False)
class Arrangement:
    """Rigid arrangement of the planes of a group, with the poses of its images; readings by image."""

    group_from_plane: dict[str, Rigid]  # by plane
    camera_from_group: dict[int, Rigid]  # by image
    views: dict[int, tuple[PlaneView, ...]]  # accepted readings
    left: dict[int, tuple[tuple[Readings, str], ...]] = field(default_factory=dict)
    """Other readings and why they are left out: they do not fit (ELSEWHERE), several numberings fit (""), or other
    groups, or a rough pose, have their plane elsewhere (FOREIGN)."""

    def without(self, planes: Collection[str]) -> "Arrangement":
        """Returns the arrangement without some planes, whose readings are then left out as FOREIGN."""
        gone = {i: tuple(([v], FOREIGN) for v in views if v.plane in planes) for i, views in self.views.items()}
        return replace(
            self,
            group_from_plane={p: pose for p, pose in self.group_from_plane.items() if p not in planes},
            views={i: tuple(v for v in views if v.plane not in planes) for i, views in self.views.items()},
            left={i: self.left.get(i, ()) + views for i, views in gone.items()},
        )

    def moved(self, cameras: Poses, planes: Poses) -> "Arrangement":
        """Returns the arrangement with other poses, in the order of its own."""
        return replace(
            self,
            camera_from_group=dict(zip(self.camera_from_group, cameras, strict=True)),
            group_from_plane=dict(zip(self.group_from_plane, planes, strict=True)),
        )

    def explained(self) -> int:
        """Returns the score: the number of circles of the readings that fit."""
        return sum(len(view.rows) for views in self.views.values() for view in views)


def arrange(images: Sequence[list[Readings]], step_mm: float, focal_px: float) -> Arrangement:
    """Arrangement that explains most circles; ``step_mm`` between circles is the least error of a wrong reading."""
    total = sum(len(views[0].rows) for readings in images for views in readings if views[0].named)
    best = Arrangement({}, {}, {})
    for i, reading in _seeds(images):
        if any(reading is view for view in best.views.get(i, ())):
            continue  # a start with this image gives the same arrangement
        found = _checked(images, _grown(images, i, reading, MAX_SHIFT_PITCHES * step_mm), step_mm, focal_px)
        best = max(best, found, key=Arrangement.explained)
        if best.explained() >= total:
            break
    return best


def as_drawn(found: Arrangement, rough_poses: Mapping[str, Rigid]) -> Arrangement:
    """Arrangement without faces turned by more than ``FAR_DEG`` against most others from their rough poses."""
    circles = Counter(view.plane for views in found.views.values() for view in views for _ in view.rows)
    turn = {
        p: (pose @ rough_poses[p].inverse()).rotation for p, pose in found.group_from_plane.items() if p in rough_poses
    }
    agreed = {p: {q for q in turn if Rigid(turn[p].T @ turn[q]).angle_rad() <= np.radians(FAR_DEG)} for p in turn}
    most = max(agreed.values(), key=lambda planes: sum(circles[p] for p in planes), default=set())
    return found.without(turn.keys() - most)


def across_groups(groups: Sequence[Arrangement], reach_mm: float) -> list[Arrangement]:
    """Compares the arrangements, as faces have the same relative poses in all groups. A face that most groups have
    elsewhere is removed, and the last face with the others: alone it may be mirrored. A face known from other groups is
    added; the second look decides."""
    faces = [_as_faces(group) for group in groups]
    grown = (_grown(faces, i, view, reach_mm) for i, view in _seeds(faces))
    best = max((Arrangement({}, {}, {}), *grown), key=Arrangement.explained)
    settled = list(groups)
    for i, views in best.views.items():
        group, pose, agreed = groups[i], best.camera_from_group[i], {view.plane for view in views}
        others = group.group_from_plane.keys() - agreed - {BOARD}
        foreign = others or any(why == FOREIGN for _, why in chain(*group.left.values()))
        if len(agreed) == 1 < len(groups) and foreign:
            settled[i] = group.without(others | agreed)
        else:
            known = {plane: pose @ target_from_face for plane, target_from_face in best.group_from_plane.items()}
            group = group.without(others)
            settled[i] = replace(group, group_from_plane=known | group.group_from_plane)
    return settled


def _as_faces(group: Arrangement) -> list[Readings]:
    """Returns the faces of a group in the form of an image's readings, with a row for each observed circle."""
    views_of_plane: dict[str, list[PlaneView]] = {}
    for view in chain.from_iterable(group.views.values()):
        if view.plane != BOARD and view.plane in group.group_from_plane:
            views_of_plane.setdefault(view.plane, []).append(view)
    faces = []
    for plane, views in views_of_plane.items():
        first, area = max(views, key=lambda view: len(view.rows)), sum(view.area for view in views)
        rows, pose = np.concatenate([view.rows for view in views]), group.group_from_plane[plane]
        faces.append([replace(first, rows=rows, area=area, camera_from_plane=pose, named=True)])
    return faces


def _seeds(images: Sequence[list[Readings]]) -> list[tuple[int, PlaneView]]:
    """Returns readings to start from, the most reliable image first: the board of an image, or its largest face."""
    candidates = []
    for i, readings in enumerate(images):
        boards = [views for views in readings if views[0].plane == BOARD]
        faces = [views for views in readings if views[0].plane != BOARD and views[0].named]
        if boards or faces:
            first = max(boards or faces, key=lambda views: len(views[0].rows))
            circles = sum(len(views[0].rows) for views in boards + faces)
            candidates.append(((not boards, not faces, len(first), -len(faces), -circles), i, first))
    candidates.sort(key=lambda each: each[:2])
    return [(i, view) for _, i, views in candidates[:MAX_SEEDS] for view in views]


def _grown(images: Sequence[list[Readings]], seed: int, view: PlaneView, reach_mm: float) -> Arrangement:
    """Grows the arrangement from one image to all images that share planes with placed ones."""
    known = {view.plane: Rigid()}
    others = [views for views in images[seed] if not any(each is view for each in views)]
    alternatives = sum(map(len, images[seed])) - sum(map(len, others))
    # If the numbering of the first image is a convention, the board alone cannot place another image.
    by_convention = view.plane == BOARD and alternatives > 1
    while True:
        placed = {i: found for i, r in enumerate(images) if (found := _placed(r, known, reach_mm, by_convention))}
        pose = view.camera_from_plane @ known[view.plane].inverse()
        placed[seed] = pose, [view, *_agreeing(others, pose, known, reach_mm, {view.plane})[0]]
        new = _new_planes(images, placed, known, reach_mm)
        if not new:
            break
        known |= new
    poses = {i: pose for i, (pose, _) in placed.items()}
    return Arrangement(known, poses, {i: tuple(views) for i, (_, views) in placed.items()})


def _placed(readings: list[Readings], known: dict[str, Rigid], reach_mm: float, by_convention: bool):
    """Returns the pose of an image with the most planes, then faces, then circles, and the readings that agree with it;
    None if several fit."""
    best, best_score, rivals = None, (0, 0, 0), 0
    for views in readings:
        others = [v for v in readings if v is not views]
        for view in (each for each in views if each.plane in known):
            pose = view.camera_from_plane @ known[view.plane].inverse()
            agreed = [view, *_agreeing(others, pose, known, reach_mm, {view.plane})[0]]
            faces = sum(v.plane != BOARD and v.named for v in agreed)
            score = (len(agreed), faces, sum(len(v.rows) for v in agreed))
            if score > best_score:
                best, best_score, rivals = (pose, agreed), score, 0
            elif best is not None and score == best_score:  # a rival, unless both put the plane at one place
                span = best[1][0].span_mm()
                rivals += np.abs(best[0].inverse() @ pose @ span - span).max() >= reach_mm
    if best is None:
        return None
    agreed = best[1]
    of_board = by_convention and agreed[0].plane == BOARD and len(readings) > 1
    if len(agreed) == 1 and (rivals or of_board or not agreed[0].named):
        return None
    return None if rivals and not all(v.named for v in agreed) else best


def _agreeing(readings: list[Readings], camera_from_group: Rigid, known, reach_mm: float, taken: set[str]):
    """Returns the readings that agree with the arrangement, each plane once, and circles with several such readings."""
    agreed, ambiguous, ranked = [], [], []
    for views in readings:
        inside = [(k, view) for k, view in enumerate(views) if view.plane in known]
        shifts = sorted((_shift_mm(view, camera_from_group, known), k) for k, view in inside)
        if not shifts or shifts[0][0] > reach_mm:
            continue
        if len(shifts) > 1 and shifts[1][0] < 2 * reach_mm:
            ambiguous.append(views)
        else:
            ranked.append((shifts[0][0], views[shifts[0][1]]))
    for _, view in sorted(ranked, key=lambda each: each[0]):
        if view.plane not in taken:
            taken = taken | {view.plane}
            agreed.append(view)
    return agreed, ambiguous


def _shift_mm(view: PlaneView, camera_from_group: Rigid, known: dict[str, Rigid]) -> float:
    """Returns the median distance of circles from their places in the arrangement."""
    own, plane, camera = view.camera_from_plane, known[view.plane], camera_from_group
    turned = own.rotation - camera.rotation @ plane.rotation
    moved = own.translation - camera.rotation @ plane.translation - camera.translation
    return float(np.median(np.linalg.norm(view.xy_mm @ turned[:, :2].T + moved, axis=1)))


def _new_planes(images: Sequence[list[Readings]], placed, known: dict[str, Rigid], reach_mm: float) -> dict[str, Rigid]:
    """Poses of unknown planes that images name, each at the place with the largest area: a target in the background is
    smaller. Else that of the plane without a name that most images, two at least, have at one place."""
    unknown: dict[tuple[bool, str], list[tuple[int, PlaneView, Rigid]]] = {}
    for i, (pose, agreed) in placed.items():
        for views in images[i]:
            for view in () if any(view is each for view in views for each in agreed) else views:
                if view.plane not in known:
                    group_from_plane = pose.inverse() @ view.camera_from_plane
                    unknown.setdefault((view.named, view.plane), []).append((i, view, group_from_plane))
    named, others = {}, []
    for (is_named, plane), found in unknown.items():
        together, image = _together(found, reach_mm), np.array([i for i, _, _ in found])
        if is_named:
            named[plane] = found[int(np.argmax(together @ np.array([view.area for _, view, _ in found])))][2]
        else:
            support = [len(np.unique(image[row])) for row in together]
            others.append((max(support), plane, found[int(np.argmax(support))][2]))
    (most, plane, pose), *rivals = sorted(others, key=lambda each: -each[0]) or [(0, "", Rigid())]
    return named or ({plane: pose} if most >= 2 and all(rival[0] < most for rival in rivals) else {})


def _together(found: list[tuple[int, PlaneView, Rigid]], reach_mm: float) -> np.ndarray:
    """Returns the mask (n, n) of pairs of views that put their plane at the same place."""
    span = found[0][1].span_mm()
    corners = np.array([pose @ span for _, _, pose in found])
    return np.linalg.norm(corners[:, None] - corners, axis=3).max(2) < reach_mm


def _checked(images: Sequence[list[Readings]], found: Arrangement, step_mm: float, focal_px: float) -> Arrangement:
    """Adjusts the arrangement to least reprojection error over its views, and compares all readings with it."""
    order = list(found.group_from_plane)
    seen = [(a, order.index(v.plane), v) for a, views in enumerate(found.views.values()) for v in views]
    image, plane = np.repeat([each[:2] for each in seen], [len(v.rows) for *_, v in seen], axis=0).T
    xyz, xy = (np.concatenate(each) for each in zip(*((v.xyz_mm(), focal_px * v.xy) for *_, v in seen), strict=True))
    start = Poses.of(found.camera_from_group.values()), Poses.of(found.group_from_plane.values())
    found = found.moved(*adjusted_planes(*start, image, plane, xyz, xy, focal_px))
    views, left = {}, {}
    for i, pose in found.camera_from_group.items():
        agreed, ambiguous = _agreeing(images[i], pose, found.group_from_plane, MAX_SHIFT_PITCHES * step_mm, set())
        accepted = []
        for view in agreed:
            xyz = pose @ (found.group_from_plane[view.plane] @ view.xyz_mm())
            off_mm = np.linalg.norm(view.xy * xyz[:, 2:] - xyz[:, :2], axis=1)
            accepted += [view] * bool(np.median(off_mm) < MAX_OFF_PITCHES * step_mm)
        taken = {id(each) for each in (*accepted, *ambiguous)}
        elsewhere = [r for r in images[i] if taken.isdisjoint(map(id, (r, *r)))]
        views[i] = tuple(accepted)
        left[i] = (*((r, ELSEWHERE) for r in elsewhere), *((r, "") for r in ambiguous))
    return replace(found, views=views, left=left)


OTHER_SIZE, CLEARER = 0.005, 3.0
"""Relative difference of the board's size from what the faces say, and by how many times it must put the board better
at one place against each face, for images to be labelled with it."""


def in_scale(groups: Sequence[Sequence[Named]], target: TargetDesign, board: BoardDesign | None) -> BoardDesign | None:
    """Returns the board in the size at which its middle stays at one place against each face of a group. With another
    size, it seems to move from image to image; that the drawing has another is for the checks to say."""
    if board is None:
        return None
    middle, ways = np.append(board.xy_mm().mean(0), 0.0), [np.zeros((0, 2, 3))]
    for images in groups:
        places: dict[str, list[np.ndarray]] = {}  # of the board's middle, and of the camera, from each face
        for _, _, detection in images:
            views = [] if detection.mirrored else [each[0] for each in readings_of(detection, target, board)]
            for dots in [view for view in views if view.plane == BOARD][:1]:
                for view in (each for each in views if each.plane != BOARD and each.named):
                    seen = np.stack([dots.camera_from_plane @ middle, view.camera_from_plane.translation])
                    places.setdefault(view.plane, []).append(seen @ view.camera_from_plane.rotation)
        for seen in map(np.array, places.values()):
            first, second = np.triu_indices(len(seen), 1)
            ways.append(seen[first] - seen[second])
    way, wanted = np.swapaxes(np.concatenate(ways), 0, 1)
    if not len(way):
        return board
    square = np.maximum((way**2).sum(1), np.finfo(float).tiny)  # the camera may not have moved
    each = (way * wanted).sum(1) / square
    order = np.argsort(each)
    factor = float(each[order][np.searchsorted(np.cumsum(square[order]), square.sum() / 2)])
    before, after = (float(np.median(np.linalg.norm(size * way - wanted, axis=1))) for size in (1.0, factor))
    is_other = factor > 0 and abs(factor - 1) > OTHER_SIZE and before > CLEARER * after
    return board.scaled(factor) if is_other else board


@dataclass(frozen=True, slots=True, eq=False)
class LabelledImage:
    """One image with the labels of its circles."""

    observations: ImageObservations
    notes: tuple[str, ...]  # on what was excluded
    focus: Focus | None = None  # from which the observations are corrected; None if it has too few circles

    def plus(self, labels: Sequence[Label], centres: Centres, notes: Sequence[str]) -> "LabelledImage":
        """Returns the image with further circles and notes."""
        more = labelled_image(self.observations.name, self.observations.group, labels, centres, ())
        return LabelledImage(self.observations.plus(more.observations), (*self.notes, *notes))

    def without(self, labels: Collection[Label], notes: Sequence[str]) -> "LabelledImage":
        """Returns the image without the circles of ``labels``, and with further notes."""
        if not labels:
            return self
        keep = [i for i, label in enumerate(self.observations.labels) if label not in labels]
        return LabelledImage(self.observations.select(keep), (*self.notes, *notes))


def labelled_image(
    name: str, group: str, labels: Sequence[Label], centres: Centres, notes: Sequence[str]
) -> LabelledImage:
    """Returns the image of labelled circles; identical notes are merged."""
    measured = {f.name: getattr(centres, f.name) for f in fields(ImageObservations)[3:]}
    merged = [
        note if n == 1 else Note(f"{note} ({n} times)", getattr(note, "code", ""), getattr(note, "place", ""))
        for note, n in Counter(notes).items()
    ]
    return LabelledImage(ImageObservations(name, group, tuple(labels), **measured), tuple(merged))


def label_groups(
    groups: Sequence[Sequence[Named]],
    target: TargetDesign,
    board: BoardDesign | None,
    focal_px: float,
) -> list[tuple[list[LabelledImage], Arrangement]]:
    """Labels the images (name, group, detection) of all groups. Each group has the arrangement of its labels."""
    steps = np.concatenate([np.zeros(0), *(KDTree(f.xy_mm).query(f.xy_mm, k=2)[0][:, 1] for f in target.faces)])
    step_mm = board.pitch_mm if board is not None else float(np.median(steps)) if len(steps) else 0.0
    alone: list[Arrangement] = []
    readings = [[[] if d.mirrored else readings_of(d, target, board) for _, _, d in images] for images in groups]
    likely = [[[[v for v in r if v.likely] for r in own] for own in group] for group in readings]
    for group, likely_ones in zip(readings, likely, strict=True):
        found = arrange(likely_ones, step_mm, focal_px)
        if any(why == ELSEWHERE for _, why in chain.from_iterable(found.left.values())):
            # readings with covered dots must explain more circles
            found = max(found, arrange(group, step_mm, focal_px), key=Arrangement.explained)
        alone.append(as_drawn(found, target.rough_poses()))
    arrangements = across_groups(alone, MAX_SHIFT_PITCHES * step_mm)
    return [
        ([_labelled(*image, own, found, i) for i, (image, own) in enumerate(zip(images, views, strict=True))], found)
        for images, views, found in zip(groups, likely, arrangements, strict=True)
    ]


def _labelled(
    name: str, group: str, detection: ImageDetection, readings: list[Readings], arrangement: Arrangement, image: int
) -> LabelledImage:
    if detection.mirrored:
        shown = f"the image is mirrored: it shows face {', '.join(detection.mirrored)} as a mirror does"
        remedy = "left out, turn it back, or use the file that the camera wrote"
        return _of_views(name, group, detection, (), [*detection.notes, f"{shown}; {remedy}"])
    if image in arrangement.views:
        views = arrangement.views[image]
        notes = [_left_out(*each) for each in arrangement.left.get(image, ())]
    else:
        times = Counter(each[0].plane for each in readings if each[0].named)
        views = [each[0] for each in readings if len(each) == 1 and each[0].named and times[each[0].plane] == 1]
        notes = [_left_out(each) for each in readings if len(each) > 1 or not each[0].named]
    return _of_views(name, group, detection, views, [*_notes_of(detection), *notes])


def _of_views(
    name: str, group: str, detection: ImageDetection, views: Sequence[PlaneView], notes: Sequence[str]
) -> LabelledImage:
    """Returns the image with the labels of accepted readings, in the order of its centres."""
    labels = [label for view in views for label in view.labels]
    rows = np.concatenate([np.zeros(0, int), *(view.rows for view in views)])
    order = np.argsort(rows, kind="stable")
    return labelled_image(name, group, [labels[k] for k in order], detection.centres.select(rows[order]), notes)


def _notes_of(detection: ImageDetection) -> list[str]:
    repeated = [f"{what} found more than once; left out, one may be a reflection" for what in detection.repeated]
    return [*detection.notes, *repeated]


FOREIGN = "foreign"


def _left_out(views: Readings, why: str = "") -> str:
    """Returns the note on a pattern without labels; ``why`` : ELSEWHERE or FOREIGN; else several numberings fit."""
    view, dots = views[0], f"board of {len(views[0].rows)} dots"
    is_board = view.plane == BOARD
    if why == FOREIGN:
        reason = (
            f"not where other groups see that face against the others, or turned from its rough_pose by more than "
            f"{FAR_DEG:.0f}°; left out, it is a reflection or another object, the image is mirrored, or rough_pose is "
            "wrong"
        )
    elif not view.named:
        return _open_face_note(len(view.rows), [view.plane for view in views])
    elif why == ELSEWHERE:
        reason = (
            "not where the group's other images see it; left out, it is a reflection or another object, or the "
            "photograph is of another group or of a body that was moved"
        )
    else:
        return Note(
            f"{dots} left out: {len(views)} numberings fit, none keeps it where the group's other images see it; show "
            "a face that they show, or check that nothing was moved",
            BOARD_LEFT_OUT,
        )
    name = f"a {dots}" if is_board else f"a pattern like face {view.plane}"
    return Note(f"{name}: {reason}", BOARD_LEFT_OUT if is_board else ELSEWHERE, view.plane)


def _open_face_note(circles: int, faces: Collection[str]) -> str:
    return (
        f"a pattern of {circles} circles that fits face {', '.join(sorted(set(faces)))} but may be another; left out, "
        "show the circles that tell the faces apart"
    )


STEEP_RAD = np.radians(85)  # largest tilt of circles of the first look that are compared with their places


def label_images(
    detection: DetectionResult,
    target: TargetDesign,
    board: BoardDesign | None,
    options: EllipseOptions,
    cache: Path,
    workers: int | None = None,
) -> list[LabelledImage]:
    """Returns the labelled circles and corners of all images, in the order of their groups, after two looks."""
    files, camera, focal_px = {i.file.name: i for i in detection.images}, detection.camera, _focal_px(detection.camera)
    circles, groups = target.with_faces(printed=False), _groups(detection)
    board = in_scale(groups, circles, board)
    patterns = patterns_of(circles, board)
    sought = patterns_of(circles, None if isinstance(board, CornerBoard) else board)  # corners are used as found
    first_looks: list[tuple[list[LabelledImage], Arrangement]] = []
    jobs: list[tuple[DetectedImage, PredictedCircles]] = []
    for found in label_groups(groups, circles, board, focal_px):
        group, arrangement = _without_outlying(*found, patterns, focal_px)
        for i, pose in arrangement.camera_from_group.items():
            seen, planes = group[i].observations, arrangement.group_from_plane
            predicted, steep = (
                predict_circles(pose, planes, seen.labels, sought, camera, tilt) for tilt in (MAX_TILT_RAD, STEEP_RAD)
            )
            wrong = contradictions(steep, seen, camera)
            group[i] = group[i].without(wrong, notes_by_plane(wrong, CONTRADICTED))
            if predicted.wanted.any():
                jobs.append((files[seen.name], predicted))
        first_looks.append((group, arrangement))
    looks = look_again(jobs, camera, options, cache, workers)
    labelled = []
    for group, arrangement in first_looks:
        for i, image in enumerate(group):
            if look := looks.get(image.observations.name):
                group[i] = image.plus(look.labels, look.centres, notes_by_plane(look.missed, MISSED))
        labelled += _without_outlying(group, arrangement, patterns, focal_px)[0]
    sharp = without_defocus(labelled, camera, patterns)
    return [_with_corners(image, files[image.observations.name].detection, target) for image in sharp]


def label_once(detection: DetectionResult, target: TargetDesign, board: BoardDesign | None) -> list[LabelledImage]:
    """Labels all images as :func:`label_images`, without a second look."""
    groups = _groups(detection)
    board = in_scale(groups, target, board)
    labelled = label_groups(groups, target, board, _focal_px(detection.camera))
    return [each for found, _ in labelled for each in found]


def _focal_px(camera: Camera) -> float:
    return float(np.sqrt(camera.focal.prod()))


def _groups(detection: DetectionResult) -> list[list[Named]]:
    groups: dict[str, list[Named]] = {}
    for image in detection.images:
        groups.setdefault(image.file.group, []).append((image.file.name, image.file.group, image.detection))
    return list(groups.values())


def _with_corners(image: LabelledImage, detection: ImageDetection, target: TargetDesign) -> LabelledImage:
    """Returns the image with the corners of its printed faces."""
    labels = [label for each in detection.printed for label in each.labels(target.face(each.face))]
    rows = [each.rows for each in detection.printed]
    return image.plus(labels, detection.centres.select(np.concatenate(rows)), ()) if rows else image


def _without_outlying(
    group: list[LabelledImage], arrangement: Arrangement, patterns: dict[str, Pattern], focal_px: float
) -> tuple[list[LabelledImage], Arrangement]:
    """Removes circles that contradict the others of the group, and adjusts the arrangement without them."""
    cameras, planes, images = arrangement.camera_from_group, arrangement.group_from_plane, list(group)
    seen = [group[i].observations for i in cameras]
    *poses, outlying = outlying_circles(Poses.of(cameras.values()), planes, seen, patterns, focal_px)
    for i, reasons in zip(cameras, outlying, strict=True):
        images[i] = group[i].without(reasons, notes_by_plane(reasons, CONTRADICTED))
    return images, arrangement.moved(*poses)


def label_single(name: str, group: str, detection: ImageDetection, target: TargetDesign) -> LabelledImage:
    """Returns the faces of a single image, for a target that may move from image to image."""
    faces = detection.single_faces()
    labels = [label for each in faces for label in each.labels(target.face(each.face))]
    rows = np.concatenate([np.zeros(0, int), *(each.rows for each in faces)])
    unnamed = [_open_face_note(len(each[0].rows), [face.face for face in each]) for each in detection.open_faces]
    return labelled_image(name, group, labels, detection.centres.select(rows), [*_notes_of(detection), *unnamed])


def without_defocus(
    images: Sequence[LabelledImage], camera: Camera, patterns: Mapping[str, Pattern]
) -> list[LabelledImage]:
    """Returns the images with centres corrected for blur that varies across a circle, and what their blur shows."""
    corrected, focus = correct_defocus([image.observations for image in images], camera, patterns)
    by_name = {own.image: own for own in focus}
    blurs = [by_name.get(observations.name) for observations in corrected]
    return [
        LabelledImage(observations, (*image.notes, *([blur.note] if blur and blur.note else [])), blur)
        for image, observations, blur in zip(images, corrected, blurs, strict=True)
    ]


@dataclass(frozen=True, slots=True, eq=False)
class Detection(ByValue):
    """The labelled circles of one image.

    Parameters
    ----------
    labels : tuple of Label
        n labels: ``face:circle``, or ``board:row:column`` from 0.
    xy_px : (n, 2) array
        Centres of the ellipses, px, with the centre of the top-left pixel at (0, 0).
    covariance_px2 : (n, 2, 2) array
        Covariances of the centres.
    notes : tuple of str
        What was left out, and why.
    """

    labels: tuple[Label, ...]
    xy_px: np.ndarray
    covariance_px2: np.ndarray
    notes: tuple[str, ...] = ()

    @property
    def sigma_px(self) -> np.ndarray:
        """Standard deviation of each centre per axis (RMS over both axes), (n,)."""
        return np.sqrt(np.trace(self.covariance_px2, axis1=1, axis2=2) / 2)

    def __len__(self) -> int:
        return len(self.labels)

    def __repr__(self) -> str:
        planes = ", ".join(f"{plane}: {n}" for plane, n in Counter(label.plane for label in self.labels).items())
        return f"<Detection of {len(self)} circles ({planes or 'none'}), {len(self.notes)} notes>"

    def plot(self, ax: "Axes") -> None:
        """Draws the centres with their labels into axes of matplotlib, over an image shown there."""
        ax.plot(*self.xy_px.T, "+", color="tab:red")
        for label, (x, y) in zip(self.labels, self.xy_px.tolist(), strict=True):
            ax.annotate(str(label), (x, y), (3, 3), textcoords="offset points", fontsize=6, color="tab:red")


@require_arguments
def detect_circles(
    image: np.ndarray,
    camera: Camera | CameraModel | str | Path,
    target: TargetDesign | str | Path,
    board: BoardDesign | str | Path | None = None,
    options: EllipseOptions | None = None,
) -> Detection:
    """Returns the labelled circles of one image.

    A single image may leave labels open. A run decides them from all images of a group, and searches again for circles
    that were missed.

    Parameters
    ----------
    image : (height, width) or (height, width, 3) array
        Grey or RGB, 8 or 16 bit, of the camera's size.
    camera : Camera
        The camera that took the image, or its file.
    target : TargetDesign
        Design of the target, or its file.
    board : BoardDesign, optional
        The dot board, if it may be in view, or its file.
    options : EllipseOptions, optional
        Options of the search; the defaults if None.

    Returns
    -------
    Detection
        Labels, centres and covariances; empty if nothing is recognised, with notes that say why.

    Raises
    ------
    InputError
        The array is no image, or not of the camera's size.
    """
    grey = grey_of(image, "image")
    camera, target = camera_model(camera).sized(grey.shape[1], grey.shape[0]), target_of(target)
    board = None if board is None else board_of(board)
    found = detect_image(grey, camera, target, board, options or EllipseOptions())
    ((images, _),) = label_groups([[("image", "", found)]], target.with_faces(printed=False), board, _focal_px(camera))
    sharp = without_defocus([_with_corners(images[0], found, target)], camera, patterns_of(target, board))[0]
    seen = sharp.observations
    return Detection(seen.labels, seen.centre_px, seen.covariance_px2, sharp.notes)


CLEAR_RAD = np.radians(20.0)  # smallest difference of the camera's rotation between the best numbering and the next one


def is_board_alone(detection: DetectionResult) -> bool:
    """Returns whether no image has a face, and half of them too few outlines outside of boards for one."""
    images = [image.detection for image in detection.images]
    if not any(image.boards for image in images) or any(image.faces or image.open_faces for image in images):
        return False
    outside_boards = [image.candidates - sum(len(board.rows) for board in image.boards) for image in images]
    return float(np.median(outside_boards)) < MIN_NAMING


def label_boards(detection: DetectionResult, target: TargetDesign, board: BoardDesign) -> list[LabelledImage]:
    """Returns the labelled dots of all images, in the order of their groups."""
    labelled = []
    for images in _groups(detection):
        every = [[r for r in readings_of(d, target, board) if r[0].plane == BOARD] for _, _, d in images]
        largest = (max(boards, key=lambda views: len(views[0].rows), default=[]) for boards in every)
        numbered = _numbered([[view for view in views if view.likely] for views in largest])
        for (name, group, found), choice in zip(images, numbered, strict=True):
            why = "a board without a pose; left out, show the whole board, or a face with it" if found.board else ""
            note = choice if isinstance(choice, str) and choice else why
            views, notes = ([choice], []) if isinstance(choice, PlaneView) else ([], [note] if note else [])
            labelled.append(_of_views(name, group, found, views, [*_notes_of(found), *notes]))
    return without_defocus(labelled, detection.camera, patterns_of(target, board))


def _numbered(views: Sequence[Readings]) -> list[PlaneView | str]:
    """Returns the numbering of each image, or why it has none. Next is what turns least from a numbered image; the
    first has the fewest numberings and the most dots."""
    chosen: list[PlaneView | str] = [""] * len(views)
    unsettled = {i: numberings for i, numberings in enumerate(views) if numberings}
    if unsettled:
        first = min(unsettled, key=lambda i: (len(unsettled[i]), -len(unsettled[i][0].rows)))
        chosen[first] = unsettled.pop(first)[0]
    while unsettled:
        known = [view.camera_from_plane.inverse() for view in chosen if isinstance(view, PlaneView)]
        turns = {
            i: sorted((min((view.camera_from_plane @ other).angle_rad() for other in known), k) for k, view in each)
            for i, each in ((i, enumerate(numberings)) for i, numberings in unsettled.items())
        }
        i = min(turns, key=lambda i: turns[i][0][0])
        numberings, (least, k), rival = unsettled.pop(i), turns[i][0], (*turns[i][1:], (np.inf, 0))[0][0]
        chosen[i] = numberings[k]
        if rival - least < CLEAR_RAD:
            turned = (
                f"the camera is turned by {np.degrees(least):.0f}° or {np.degrees(rival):.0f}° from the nearest image"
            )
            fit = f"board of {len(numberings[0].rows)} dots: {len(numberings)} numberings fit, {turned}"
            chosen[i] = f"{fit}; left out, add views in between, show the whole board, or a face"
    return chosen
