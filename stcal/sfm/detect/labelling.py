"""Labels of all circles: what a pattern may be is decided by its image, its group, and all groups.

1. An image offers readings (:mod:`.sightings`): of a face that it names one, of a pattern that fits several faces one
   each, of a board one for each numbering. A pattern in view twice has none: one of the two may be a reflection.
2. A group decides (:mod:`.group_geometry`): its faces and board are rigid to one another. From the most reliable images
   arrangements are grown, and the one that explains most circles holds. A reading that fits it gives its labels. One
   that does not, or of which several fit, gives a note. A face that is turned by more than ``FAR_DEG`` from its rough
   pose, against most others, is not that face.
3. All groups decide: faces have the same poses in all of them. A face that most groups have elsewhere goes out.
4. A second look (:mod:`.predict`) measures circles that must be in view and have no label. What is not as large as
   its plane asks for, or not where its group has it, goes out. So does a face that one image alone reads, and others,
   which must show it, do not.

In photographs of the board alone, the camera's motion numbers a plain board, which looks the same after half a turn.
The numbering of a group's first image is a convention. The corners of printed faces name themselves.
"""

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, fields
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from stcal.boards.board_designs import CornerBoard
from stcal.boards.board_file import board_of
from stcal.boards.target_file import target_of
from stcal.design import BoardDesign, TargetDesign
from stcal.geometry.arrays import ByValue, require_arguments
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid
from stcal.io.cameras.camera_model import CameraModel
from stcal.io.cameras.read import camera_model
from stcal.io.images import grey_of
from stcal.labels import BOARD, Label
from stcal.sfm.data.group_model import BOARD_LEFT_OUT, ELSEWHERE, FAR_DEG, SINGLE, Centres, ImageObservations, Note
from stcal.sfm.data.patterns import MAX_TILT_RAD, Pattern, patterns_of
from stcal.sfm.detect.circles.candidates import EllipseOptions
from stcal.sfm.detect.defocus import Focus, correct_defocus
from stcal.sfm.detect.detect_files import DetectedImage, DetectionResult, look_again
from stcal.sfm.detect.group_geometry import (
    MAX_SHIFT_PITCHES,
    Arrangement,
    across_groups,
    arrange,
    as_drawn,
    outlying_circles,
)
from stcal.sfm.detect.image import detect_image
from stcal.sfm.detect.predict import (
    PredictedCircles,
    SecondLook,
    contradicted_notes,
    contradictions,
    missed_notes,
    predict_circles,
)
from stcal.sfm.detect.sightings import ImageDetection, PlaneView, Readings, likely_views, open_face_note, readings_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Named = tuple[str, str, ImageDetection]
"""Name and group of an image, and what it shows."""
MIN_EXPECTED = 6
"""Least number of circles that other images must show for their absence to count: as many as identify a face."""
STEEP_RAD = np.radians(85)
"""Largest tilt of circles of the first look that are compared with their places."""
MIN_CONFIRMED = 0.2
"""Least share of these circles that must be found. A face of which two images show less could not be mapped either."""


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


def unlabelled(name: str, group: str, detection: ImageDetection, *notes: str) -> LabelledImage:
    """Returns the image without circles, with the notes of its detection and further ones."""
    return labelled_image(name, group, (), detection.centres.select(np.zeros(0, int)), [*detection.notes, *notes])


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
    circles, labelled = target.with_faces(printed=False), unlabelled("image", "", found)
    if circles.faces or board is not None:
        focal_px = float(np.sqrt(camera.focal.prod()))
        labelled = label_groups([[("image", "", found)]], circles, board, focal_px)[0][0][0]
    sharp = without_defocus([_with_corners(labelled, found, target)], camera, patterns_of(target, board))[0]
    seen = sharp.observations
    return Detection(seen.labels, seen.centre_px, seen.covariance_px2, sharp.notes)


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


def label_single(name: str, group: str, detection: ImageDetection, target: TargetDesign) -> LabelledImage:
    """Returns the faces of a single image, for a target that may move from image to image."""
    labels, rows = detection.labelled_rows(target)
    unnamed = [open_face_note(len(faces[0].rows), (each.face for each in faces)) for faces in detection.open_faces]
    return labelled_image(
        name, group, labels, detection.centres.select(rows), [*detection.notes, *unnamed, *_repeated(detection)]
    )


def label_images(
    detection: DetectionResult,
    target: TargetDesign,
    board: BoardDesign | None,
    options: EllipseOptions,
    cache: Path,
    workers: int | None = None,
) -> list[LabelledImage]:
    """Returns the labelled circles and corners of all images, in the order of their groups."""
    circles, groups = target.with_faces(printed=False), _groups(detection)
    files = {image.file.name: image for image in detection.images}
    if circles.faces or board is not None:
        labelled = _in_two_looks(files, groups, detection.camera, circles, board, options, cache, workers)
    else:
        labelled = [unlabelled(*image) for images in groups for image in images]
    return [_with_corners(image, files[image.observations.name].detection, target) for image in labelled]


def _with_corners(image: LabelledImage, detection: ImageDetection, target: TargetDesign) -> LabelledImage:
    """Returns the image with the corners of its printed faces."""
    labels = [label for each in detection.printed for label in each.labels(target.face(each.face))]
    rows = [each.rows for each in detection.printed]
    return image.plus(labels, detection.centres.select(np.concatenate(rows)), ()) if rows else image


def _in_two_looks(
    files: Mapping[str, DetectedImage],
    groups: Sequence[Sequence[Named]],
    camera: Camera,
    target: TargetDesign,
    board: BoardDesign | None,
    options: EllipseOptions,
    cache: Path,
    workers: int | None,
) -> list[LabelledImage]:
    """Returns the labelled circles of all images, in the order of their groups."""
    board = in_scale(groups, target, board)
    focal_px, patterns = float(np.sqrt(camera.focal.prod())), patterns_of(target, board)
    dots = None if isinstance(board, CornerBoard) else board  # corners are not searched at predicted places
    sought = patterns_of(target, dots)
    first_looks: list[tuple[list[LabelledImage], Arrangement]] = []
    jobs: list[tuple[DetectedImage, PredictedCircles]] = []
    for labelled in label_groups(groups, target, board, focal_px):
        group, arrangement = _without_outlying(*labelled, patterns, focal_px)
        for i, pose in arrangement.camera_from_group.items():
            seen, planes = group[i].observations, arrangement.group_from_plane
            predicted, steep = (
                predict_circles(pose, planes, seen.labels, sought, camera, tilt) for tilt in (MAX_TILT_RAD, STEEP_RAD)
            )
            wrong = contradictions(steep, seen, camera)
            group[i] = group[i].without(wrong, contradicted_notes(wrong))
            if predicted.wanted.any():
                jobs.append((files[seen.name], predicted))
        first_looks.append((group, arrangement))
    looks = look_again(jobs, camera, options, cache, workers)
    second = [_without_outlying(_second(group, looks), known, patterns, focal_px)[0] for group, known in first_looks]
    return without_defocus([image for group in second for image in group], camera, patterns)


def label_once(detection: DetectionResult, target: TargetDesign, board: BoardDesign | None) -> list[LabelledImage]:
    """Labels all images as :func:`label_images`, without a second look."""
    groups, focal_px = _groups(detection), float(np.sqrt(detection.camera.focal.prod()))
    board = in_scale(groups, target, board)
    return [each for found, _ in label_groups(groups, target, board, focal_px) for each in found]


def _groups(detection: DetectionResult) -> list[list[Named]]:
    groups: dict[str, list[Named]] = {}
    for image in detection.images:
        groups.setdefault(image.file.group, []).append((image.file.name, image.file.group, image.detection))
    return list(groups.values())


def _without_outlying(
    group: list[LabelledImage], arrangement: Arrangement, patterns: dict[str, Pattern], focal_px: float
) -> tuple[list[LabelledImage], Arrangement]:
    """Removes circles that contradict the others of the group, and adjusts the arrangement without them."""
    arrangement, outlying = outlying_circles(arrangement, [each.observations for each in group], patterns, focal_px)
    reasons = [outlying.get(i, {}) for i in range(len(group))]
    return [e.without(r, contradicted_notes(r)) for e, r in zip(group, reasons, strict=True)], arrangement


def _second(group: list[LabelledImage], looks: dict[str, SecondLook]) -> list[LabelledImage]:
    """Adds the circles of the second look, and removes faces of a single image that others must show and do not."""
    faces = [image.observations.face_ids() for image in group]
    own = [looks.get(image.observations.name) for image in group]
    images = [
        image if look is None else image.plus(look.labels, look.centres, missed_notes(look.missed))
        for image, look in zip(group, own, strict=True)
    ]
    for face in [face for face, count in Counter(chain.from_iterable(faces)).items() if count == 1]:
        others = [look for shown, look in zip(faces, own, strict=True) if look is not None and face not in shown]
        found = sum(label.plane == face for look in others for label in look.labels)
        expected = found + sum(label.plane == face for look in others for label in look.missed)
        if expected < MIN_EXPECTED or found >= MIN_CONFIRMED * expected:
            continue
        read = f"face {face}: read in one image of the group alone, {found} of {expected} of its circles found"
        note = f"{read} that other images must show; left out, it is a reflection or another object, or hidden there"
        for i, image in enumerate(images):
            labels_of_face = [label for label in image.observations.labels if label.plane == face]
            images[i] = image.without(labels_of_face, [Note(note, SINGLE, face)])
    return images


OTHER_SIZE, CLEARER = 0.005, 3.0
"""Relative difference of the board's size from what the faces say, and by how many times it must put the board better
at one place against each face, for images to be labelled with it."""


def in_scale(groups: Sequence[Sequence[Named]], target: TargetDesign, board: BoardDesign | None) -> BoardDesign | None:
    """Returns the board in the size at which its middle stays at one place against each face of a group. With another
    size, it seems to move from image to image; that the drawing has another is for the checks to say."""
    if board is None:
        return None
    middle, board_ways, face_ways = board.xy_mm().mean(0), [], []
    for images in groups:
        places: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
        for _, _, detection in images:
            views = [] if detection.mirrored else [each[0] for each in readings_of(detection, target, board) if each]
            on_board = [view.camera_from_plane @ np.append(middle, 0.0) for view in views if view.plane == BOARD]
            for view in (each for each in views if each.plane != BOARD and each.named):
                turn, place = view.camera_from_plane.rotation.T, view.camera_from_plane.translation
                places.setdefault(view.plane, []).extend((turn @ seen, turn @ place) for seen in on_board[:1])
        for seen in (each for each in places.values() if len(each) > 1):
            first, second = np.triu_indices(len(seen), 1)
            for ways, each in zip((board_ways, face_ways), np.swapaxes(seen, 0, 1), strict=True):
                ways.extend(each[first] - each[second])
    if not board_ways:
        return board
    way, wanted = np.array(board_ways), np.array(face_ways)
    square = np.maximum((way**2).sum(1), np.finfo(float).tiny)  # the camera may not have moved
    each = (way * wanted).sum(1) / square
    order = np.argsort(each)
    factor = float(each[order][np.searchsorted(np.cumsum(square[order]), square.sum() / 2)])
    before, after = (float(np.median(np.linalg.norm(size * way - wanted, axis=1))) for size in (1.0, factor))
    is_other = factor > 0 and abs(factor - 1) > OTHER_SIZE and before > CLEARER * after
    return board.scaled(factor) if is_other else board


def label_groups(
    groups: Sequence[Sequence[Named]],
    target: TargetDesign,
    board: BoardDesign | None,
    focal_px: float,
) -> list[tuple[list[LabelledImage], Arrangement]]:
    """Labels the images (name, group, detection) of all groups. Each group has the arrangement of its labels."""
    step, alone = step_mm(target, board), []
    readings = [[[] if d.mirrored else readings_of(d, target, board) for _, _, d in images] for images in groups]
    likely = [[likely_views(own) for own in group] for group in readings]
    for group, likely_ones in zip(readings, likely, strict=True):
        found = arrange(likely_ones, step, focal_px)
        if any(found.contradicted.values()):  # readings with covered dots must explain more circles
            found = max(found, arrange(group, step, focal_px), key=Arrangement.explained)
        alone.append(as_drawn(found, target.rough_poses()))
    arrangements = across_groups(alone, MAX_SHIFT_PITCHES * step)
    labelled = []
    for images, views, arrangement in zip(groups, likely, arrangements, strict=True):
        numbered = enumerate(zip(images, views, strict=True))
        labelled.append(([_labelled(*image, own, arrangement, i) for i, (image, own) in numbered], arrangement))
    return labelled


def step_mm(target: TargetDesign, board: BoardDesign | None) -> float:
    """Returns the distance between neighbouring circles: the board's pitch, or the target's median."""
    if board is not None:
        return board.pitch_mm
    steps = []
    for face in target.faces:
        apart = np.linalg.norm(face.xy_mm[:, None] - face.xy_mm, axis=2) + np.diag(np.full(len(face.ids), np.inf))
        steps += apart.min(1).tolist()
    return float(np.median(steps))


def _labelled(
    name: str, group: str, detection: ImageDetection, readings: list[Readings], arrangement: Arrangement, image: int
) -> LabelledImage:
    if detection.mirrored:
        shown = f"the image is mirrored: it shows face {', '.join(detection.mirrored)} as a mirror does"
        remedy = "left out, turn it back, or use the file that the camera wrote"
        return unlabelled(name, group, detection, f"{shown}; {remedy}")
    if image in arrangement.views:
        views = list(arrangement.views[image])
        notes = [_left_out(each, ELSEWHERE) for each in arrangement.contradicted.get(image, ())]
        notes += [_left_out(each) for each in arrangement.open.get(image, ())]
        notes += [_left_out([each], FOREIGN) for each in arrangement.foreign.get(image, ())]
    else:
        times = Counter(each[0].plane for each in readings if each[0].named)
        views = [each[0] for each in readings if len(each) == 1 and each[0].named and times[each[0].plane] == 1]
        notes = [_left_out(each) for each in readings if len(each) > 1 or not each[0].named]
    labels = [label for view in views for label in view.labels]
    rows = np.concatenate([view.rows for view in views]) if views else np.zeros(0, int)
    order = np.argsort(rows, kind="stable")
    notes = [*detection.notes, *_repeated(detection), *notes]
    return labelled_image(name, group, [labels[k] for k in order], detection.centres.select(rows[order]), notes)


def _repeated(detection: ImageDetection) -> list[str]:
    return [f"{what} found more than once; left out, one may be a reflection" for what in detection.repeated]


FOREIGN = "foreign"


def _left_out(views: Readings, why: str = "") -> str:
    """Returns the note on a pattern without labels; ``why`` : ELSEWHERE or FOREIGN; else several numberings fit."""
    view, dots = views[0], f"board of {len(views[0].rows)} dots"
    if why == FOREIGN:
        return Note(
            f"a pattern like face {view.plane}: not where other groups see that face against the others, or turned "
            f"from its rough_pose by more than {FAR_DEG:.0f}°; left out, it is a reflection or another object, "
            "the image is mirrored, or rough_pose is wrong",
            ELSEWHERE,
            view.plane,
        )
    if not view.named:
        return open_face_note(len(view.rows), (view.plane for view in views))
    if why == ELSEWHERE:
        is_board = view.plane == BOARD
        name = f"a {dots}" if is_board else f"a pattern like face {view.plane}"
        return Note(
            f"{name}: not where the group's other images see it; left out, it is a reflection or another object, or "
            "the photograph is of another group or of a body that was moved",
            BOARD_LEFT_OUT if is_board else ELSEWHERE,
            view.plane,
        )
    return Note(
        f"{dots} left out: {len(views)} numberings fit, none keeps it where the group's other images see it; show a "
        "face that they show, or check that nothing was moved",
        BOARD_LEFT_OUT,
    )


MAX_CORNER_SHIFT_PITCHES = 0.3
"""Largest distance of corners from one another under a symmetry of the board."""
CLEAR_RAD = np.radians(20.0)
"""Smallest difference of the camera's rotation between the best numbering and the next one."""
UNNUMBERED = "left out, show the whole board, or a face with it"


def is_board_alone(detection: DetectionResult) -> bool:
    """Returns whether no image has a face, and half of them too few outlines outside of boards for one."""
    images = [image.detection for image in detection.images]
    if not any(image.boards for image in images) or any(image.faces or image.open_faces for image in images):
        return False
    outside_boards = [image.candidates - sum(len(board.rows) for board in image.boards) for image in images]
    return float(np.median(outside_boards)) < MIN_EXPECTED


def label_boards(detection: DetectionResult, target: TargetDesign, board: BoardDesign) -> list[LabelledImage]:
    """Returns the labelled dots of all images, in the order of their groups."""
    labelled = []
    for images in _groups(detection):
        chosen, reasons = _numbered([_views(image, target, board) for _, _, image in images])
        for i, (name, group, found) in enumerate(images):
            notes = [*found.notes, *([reasons[i]] if i in reasons else [])]
            labels, rows = (chosen[i].labels, chosen[i].rows) if i in chosen else ((), np.zeros(0, int))
            labelled.append(labelled_image(name, group, labels, found.centres.select(rows), notes))
    return without_defocus(labelled, detection.camera, patterns_of(target, board))


def _views(detection: ImageDetection, target: TargetDesign, board: BoardDesign) -> list[PlaneView] | str:
    """Returns the symmetric numberings of the only board of an image, or why there are none."""
    if detection.board is None:
        return "board found more than once; left out" if detection.boards else ""
    boards = [each for each in likely_views(readings_of(detection, target, board)) if each and each[0].plane == BOARD]
    views = max(boards, key=lambda v: len(v[0].rows), default=[])
    if not views:
        return f"a board without a pose; {UNNUMBERED}"
    if not all(_is_symmetry(views[0].camera_from_plane.inverse() @ v.camera_from_plane, board) for v in views):
        return Note(f"board of {len(views[0].rows)} dots: {len(views)} numberings fit; {UNNUMBERED}", BOARD_LEFT_OUT)
    return views


def _is_symmetry(difference: Rigid, board: BoardDesign) -> bool:
    width, height = board.columns - 1, board.rows - 1
    xy = board.pitch_mm * board.flat(np.array([[0.0, 0], [width, 0], [0, height], [width, height]]))
    corners = np.pad(xy, ((0, 0), (0, 1)))
    away = np.linalg.norm((difference @ corners)[:, None] - corners, axis=2)
    return bool(away.min(1).max() < MAX_CORNER_SHIFT_PITCHES * board.pitch_mm)


def _numbered(views: list[list[PlaneView] | str]) -> tuple[dict[int, PlaneView], dict[int, str]]:
    """Returns the numbering of each image, and why others have none; next is what turns least from a numbered one."""
    reasons = {i: numberings for i, numberings in enumerate(views) if isinstance(numberings, str) and numberings}
    open_images = {i: numberings for i, numberings in enumerate(views) if not isinstance(numberings, str)}
    if not open_images:
        return {}, reasons
    first = max(open_images, key=lambda i: len(open_images[i][0].rows))
    numbered = {first: open_images.pop(first)[0]}
    while open_images:
        known = [view.camera_from_plane.inverse() for view in numbered.values()]
        turns = {
            (i, k): min((view.camera_from_plane @ other).angle_rad() for other in known)
            for i, numberings in open_images.items()
            for k, view in enumerate(numberings)
        }
        i, k = min(turns, key=lambda key: turns[key])
        numberings = open_images.pop(i)
        rivals = [turns[i, m] for m in range(len(numberings)) if m != k]
        if rivals and min(rivals) - turns[i, k] < CLEAR_RAD:
            turned = f"by {np.degrees(turns[i, k]):.0f}° or {np.degrees(min(rivals)):.0f}° from the nearest image"
            remedy = "left out, add views in between, or show a face"
            reasons[i] = f"board numbered from either end: the camera is turned {turned}; {remedy}"
        else:
            numbered[i] = numberings[k]
    return numbered, reasons
