"""Labels of all circles: what a pattern may be is decided by its image, its group, and all groups.

1. An image offers readings. A pattern in view twice has none: one of the two may be a reflection.
2. A group has one arrangement (:mod:`.arrangement`). A reading that fits it gives its labels; one that does not, or of
   which several fit, a note. A face that is turned by more than ``FAR_DEG`` from its rough pose, against most others,
   is not that face.
3. All groups have one arrangement of the faces, grown in the same way, with groups in the place of images. A face that
   most groups have elsewhere goes out; one that other groups know is sought.
4. A second look (:mod:`.predict`) measures circles that must be in view and have no label. What is not as large as
   its plane asks for, or not where its group has it, goes out.

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
from scipy.spatial import KDTree

from stcal.boards.board_designs import CornerBoard
from stcal.boards.board_file import board_of
from stcal.boards.target_file import target_of
from stcal.design import BoardDesign, TargetDesign
from stcal.geometry.arrays import ByValue, require_arguments
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Poses
from stcal.io.cameras.camera_model import CameraModel
from stcal.io.cameras.read import camera_model
from stcal.io.images import grey_of
from stcal.labels import BOARD, Label
from stcal.sfm.data.group_model import BOARD_LEFT_OUT, ELSEWHERE, FAR_DEG, Centres, ImageObservations, Note, rows_by
from stcal.sfm.data.patterns import MAX_TILT_RAD, Pattern, patterns_of
from stcal.sfm.detect.arrangement import (
    FOREIGN,
    Arrangement,
    Named,
    PlaneView,
    Readings,
    across_groups,
    arrange,
    as_drawn,
    read_groups,
    readings_of,
)
from stcal.sfm.detect.candidates import EllipseOptions, FaceSighting, ImageDetection
from stcal.sfm.detect.defocus import Focus, correct_defocus
from stcal.sfm.detect.detect_files import DetectedImage, DetectionResult, look_again
from stcal.sfm.detect.face_patterns import MIN_NAMING
from stcal.sfm.detect.image import detect_image
from stcal.sfm.detect.predict import (
    CONTRADICTED,
    MISSED,
    PredictedCircles,
    contradictions,
    notes_by_plane,
    outlying_circles,
    predict_circles,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True, slots=True, eq=False)
class LabelledImage:
    """One image with the labels of its circles."""

    observations: ImageObservations
    notes: tuple[str, ...]  # on what was excluded
    focus: Focus | None = None  # from which the observations are corrected; None if it has too few circles

    def plus(self, labels: Sequence[Label], centres: Centres, notes: Sequence[str]) -> "LabelledImage":
        """Returns the image with further circles and notes."""
        more = labelled_image(self.observations.name, self.observations.group, labels, centres)
        return LabelledImage(self.observations.plus(more.observations), (*self.notes, *notes))

    def without(self, reasons: Mapping[Label, Note]) -> "LabelledImage":
        """Returns the image without circles that contradict others, with notes on the ``reasons``."""
        if not reasons:
            return self
        keep = [i for i, label in enumerate(self.observations.labels) if label not in reasons]
        return LabelledImage(self.observations.select(keep), (*self.notes, *notes_by_plane(reasons, CONTRADICTED)))


def labelled_image(
    name: str, group: str, labels: Sequence[Label], centres: Centres, notes: Sequence[str] = ()
) -> LabelledImage:
    """Returns the image of labelled circles; identical notes are merged."""
    measured = {f.name: getattr(centres, f.name) for f in fields(ImageObservations)[3:]}
    merged = [
        note if n == 1 else Note(f"{note} ({n} times)", getattr(note, "code", ""), getattr(note, "place", ""))
        for note, n in Counter(notes).items()
    ]
    return LabelledImage(ImageObservations(name, group, tuple(labels), **measured), tuple(merged))


def label_groups(
    groups: Sequence[Sequence[Named]], target: TargetDesign, board: BoardDesign | None, focal_px: float
) -> tuple[list[tuple[list[LabelledImage], Arrangement]], BoardDesign | None]:
    """Labels the images (name, group, detection) of all groups. Each group has the arrangement of its labels. The board
    is in the size in which the images have it."""
    readings, board = read_groups(groups, target, board)
    steps = np.concatenate([np.zeros(0), *(KDTree(f.xy_mm).query(f.xy_mm, k=2)[0][:, 1] for f in target.faces)])
    step_mm = board.pitch_mm if board is not None else float(np.median(steps)) if len(steps) else 0.0
    alone: list[Arrangement] = []
    likely = [[[[v for v in r if v.likely] for r in own] for own in group] for group in readings]
    for group, likely_ones in zip(readings, likely, strict=True):
        found = arrange(likely_ones, step_mm, focal_px)
        if any(why == ELSEWHERE for _, why in chain.from_iterable(found.left.values())):
            # readings with covered dots must explain more circles
            found = max(found, arrange(group, step_mm, focal_px), key=Arrangement.explained)
        alone.append(as_drawn(found, target.rough_poses()))
    arrangements = across_groups(alone, step_mm)
    labelled = [
        ([_labelled(*image, own, found, i) for i, (image, own) in enumerate(zip(images, views, strict=True))], found)
        for images, views, found in zip(groups, likely, arrangements, strict=True)
    ]
    return labelled, board


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


REASONS = {
    FOREIGN: f"not where other groups see that face against the others, or turned from its rough_pose by more than "
    f"{FAR_DEG:.0f}°; left out, it is a reflection or another object, the image is mirrored, or rough_pose is wrong",
    ELSEWHERE: "not where the group's other images see it; left out, it is a reflection or another object, or the "
    "photograph is of another group or of a body that was moved",
}


def _left_out(views: Readings, why: str = "") -> str:
    """Returns the note on a pattern without labels; ``why`` : ELSEWHERE or FOREIGN; else several numberings fit."""
    view, dots = views[0], f"board of {len(views[0].rows)} dots"
    if why != FOREIGN and not view.named:
        return _open_face_note(len(view.rows), [view.plane for view in views])
    if not why:
        fit = f"{dots} left out: {len(views)} numberings fit, none keeps it where the group's other images see it"
        return Note(f"{fit}; show a face that they show, or check that nothing was moved", BOARD_LEFT_OUT)
    if view.plane == BOARD:
        return Note(f"a {dots}: {REASONS[why]}", BOARD_LEFT_OUT, BOARD)
    return Note(f"a pattern like face {view.plane}: {REASONS[why]}", ELSEWHERE, view.plane)


def _open_face_note(circles: int, faces: Collection[str]) -> str:
    fits = f"a pattern of {circles} circles that fits face {', '.join(sorted(set(faces)))} but may be another"
    return f"{fits}; left out, show the circles that tell the faces apart"


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
    labelled_groups, board = label_groups(groups, circles, board, focal_px)
    patterns = patterns_of(circles, board)
    sought = patterns_of(circles, None if isinstance(board, CornerBoard) else board)  # corners are used as found
    first_looks: list[tuple[list[LabelledImage], Arrangement]] = []
    jobs: list[tuple[DetectedImage, PredictedCircles]] = []
    for found in labelled_groups:
        group, arrangement = _without_outlying(*found, patterns, focal_px)
        for i, pose in arrangement.camera_from_group.items():
            seen, planes = group[i].observations, arrangement.group_from_plane
            predicted, steep = (
                predict_circles(pose, planes, seen.labels, sought, camera, tilt) for tilt in (MAX_TILT_RAD, STEEP_RAD)
            )
            group[i] = group[i].without(contradictions(steep, seen, camera))
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
    labelled, _ = label_groups(_groups(detection), target, board, _focal_px(detection.camera))
    return [each for found, _ in labelled for each in found]


def _focal_px(camera: Camera) -> float:
    return float(np.sqrt(camera.focal.prod()))


def _groups(detection: DetectionResult) -> list[list[Named]]:
    images = [(image.file.name, image.file.group, image.detection) for image in detection.images]
    return [[images[i] for i in rows] for rows in rows_by(group for _, group, _ in images).values()]


def _with_corners(image: LabelledImage, detection: ImageDetection, target: TargetDesign) -> LabelledImage:
    """Returns the image with the corners of its printed faces."""
    return image.plus(*_of_sightings(detection.printed, detection, target), ()) if detection.printed else image


def _of_sightings(
    sightings: Sequence[FaceSighting], detection: ImageDetection, target: TargetDesign
) -> tuple[list[Label], Centres]:
    labels: list[Label] = [label for each in sightings for label in each.labels(target.face(each.face))]
    return labels, detection.centres.select(np.concatenate([np.zeros(0, int), *(each.rows for each in sightings)]))


def _without_outlying(
    group: list[LabelledImage], arrangement: Arrangement, patterns: dict[str, Pattern], focal_px: float
) -> tuple[list[LabelledImage], Arrangement]:
    """Removes circles that contradict the others of the group, and adjusts the arrangement without them."""
    cameras, planes, images = arrangement.camera_from_group, arrangement.group_from_plane, list(group)
    seen = [group[i].observations for i in cameras]
    *poses, outlying = outlying_circles(Poses.of(cameras.values()), planes, seen, patterns, focal_px)
    for i, reasons in zip(cameras, outlying, strict=True):
        images[i] = group[i].without(reasons)
    return images, arrangement.moved(*poses)


def label_single(name: str, group: str, detection: ImageDetection, target: TargetDesign) -> LabelledImage:
    """Returns the faces of a single image, for a target that may move from image to image."""
    times = Counter(each.face for each in detection.faces)
    faces = [*(each for each in detection.faces if times[each.face] == 1), *detection.printed]
    unnamed = [_open_face_note(len(each[0].rows), [face.face for face in each]) for each in detection.open_faces]
    return labelled_image(name, group, *_of_sightings(faces, detection, target), [*_notes_of(detection), *unnamed])


def without_defocus(
    images: Sequence[LabelledImage], camera: Camera, patterns: Mapping[str, Pattern]
) -> list[LabelledImage]:
    """Returns the images with centres corrected for blur that varies across a circle, and what their blur shows."""
    corrected, focus = correct_defocus([image.observations for image in images], camera, patterns)
    return [
        LabelledImage(observations, (*image.notes, *([blur.note] if blur and blur.note else [])), blur)
        for image, observations, blur in zip(images, corrected, focus, strict=True)
    ]


@dataclass(frozen=True, slots=True, eq=False)
class Detection(ByValue):
    """The labelled circles of one image.

    Parameters
    ----------
    labels : n labels: ``face:circle``, or ``board:row:column`` from 0.
    xy_px : Centres of the ellipses, (n, 2) px, with the centre of the top-left pixel at (0, 0).
    covariance_px2 : Covariances of the centres, (n, 2, 2).
    notes : What was left out, and why.
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
    image : Grey or RGB array, (height, width) or (height, width, 3), 8 or 16 bit, of the camera's size.
    camera : The camera that took the image, or its file.
    target : Design of the target, or its file.
    board : The dot board, if it may be in view, or its file.
    options : Options of the search; the defaults if None.

    Returns
    -------
    Detection : Labels, centres and covariances; empty if nothing is recognised, with notes that say why.

    Raises
    ------
    InputError : The array is no image, or not of the camera's size.
    """
    grey = grey_of(image, "image")
    camera, target = camera_model(camera).sized(grey.shape[1], grey.shape[0]), target_of(target)
    board = None if board is None else board_of(board)
    found = detect_image(grey, camera, target, board, options or EllipseOptions())
    circles, focal_px = target.with_faces(printed=False), _focal_px(camera)
    (([labelled], _),), _ = label_groups([[("image", "", found)]], circles, board, focal_px)
    sharp = without_defocus([_with_corners(labelled, found, target)], camera, patterns_of(target, board))[0]
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
            views, notes = ([choice], []) if isinstance(choice, PlaneView) else ([], [choice] if choice else [])
            if not choice and found.board:
                notes = ["a board without a pose; left out, show the whole board, or a face with it"]
            labelled.append(_of_views(name, group, found, views, [*_notes_of(found), *notes]))
    return without_defocus(labelled, detection.camera, patterns_of(target, board))


def _numbered(views: Sequence[Readings]) -> list[PlaneView | str]:
    """Returns the numbering of each image, or why it has none: next is what turns least from a numbered image."""
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
            fit = f"board of {len(numberings[0].rows)} dots: {len(numberings)} numberings fit, the camera is turned by"
            turned = f"{fit} {np.degrees(least):.0f}° or {np.degrees(rival):.0f}° from the nearest image"
            chosen[i] = f"{turned}; left out, add views in between, show the whole board, or a face"
    return chosen
