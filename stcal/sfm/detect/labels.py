"""Labels of all circles: what each image reads by itself, held against the arrangement of its group, then a second look
for what the group says must be in view."""

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stcal.design import BoardDesign, TargetDesign
from stcal.geometry.camera import Camera
from stcal.labels import BOARD, Label
from stcal.sfm.data.model import Centres, ImageObservations
from stcal.sfm.data.patterns import Pattern, patterns_of
from stcal.sfm.detect.circles.candidates import EllipseOptions
from stcal.sfm.detect.defocus import Focus, correct_defocus
from stcal.sfm.detect.files import DetectedImage, DetectionResult, look_again
from stcal.sfm.detect.group_geometry import (
    MAX_SHIFT_PITCHES,
    Arrangement,
    across_groups,
    arrange,
    mirrored_images,
)
from stcal.sfm.detect.outliers import outlying_circles
from stcal.sfm.detect.predict import (
    PredictedCircles,
    SecondLook,
    contradicted_notes,
    contradictions,
    missed_notes,
    predict_circles,
)
from stcal.sfm.detect.sightings import ImageDetection, PlaneView, Readings, likely_views, open_face_note, readings_of

MIN_EXPECTED = 6
"""Circles that other images must show before their absence says anything: as many as name a face."""
MIN_CONFIRMED = 0.2
"""Share of them that is found at least; a face of which less is seen twice could not be mapped either."""


@dataclass(frozen=True, slots=True, eq=False)
class LabelledImage:
    """Observations of one image, and notes on what was excluded.

    ``focus`` : its blur, from which the observations are corrected; None if it has too few circles or is not corrected.
    """

    observations: ImageObservations
    notes: tuple[str, ...]
    focus: Focus | None = None

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
    observations = ImageObservations(
        name=name,
        group=group,
        labels=tuple(labels),
        centre_px=centres.centre_px,
        centre=centres.centre,
        shape=centres.shape,
        covariance_px2=centres.covariance_px2,
        uneven_px=centres.uneven_px,
        blur_px=centres.blur_px,
    )
    times = Counter(notes)
    return LabelledImage(observations, tuple(f"{note} ({n} times)" if n > 1 else note for note, n in times.items()))


def without_defocus(
    images: Sequence[LabelledImage], camera: Camera, patterns: Mapping[str, Pattern]
) -> list[LabelledImage]:
    """Returns the images with centres corrected for blur that varies across a circle, and what their blur shows."""
    corrected, focus = correct_defocus([image.observations for image in images], camera, patterns)
    by_name = {own.image: own for own in focus}
    return [
        LabelledImage(
            observations,
            (*image.notes, *([own.note] if (own := by_name.get(observations.name)) and own.note else [])),
            own,
        )
        for image, observations in zip(images, corrected, strict=True)
    ]


def label_single(name: str, group: str, detection: ImageDetection, target: TargetDesign) -> LabelledImage:
    """The faces of one image that stands for itself, where the target may move from image to image."""
    labels, rows = detection.labelled_rows(target)
    repeated = [f"{what} found more than once; left out" for what in detection.repeated]
    unnamed = [open_face_note(len(faces[0].rows), (each.face for each in faces)) for faces in detection.open_faces]
    return labelled_image(name, group, labels, detection.centres.select(rows), [*detection.notes, *unnamed, *repeated])


def label_images(
    detection: DetectionResult,
    target: TargetDesign,
    board: BoardDesign | None,
    options: EllipseOptions,
    cache: Path,
    workers: int | None = None,
) -> list[LabelledImage]:
    """Returns the labelled circles of all images, in the order of their groups.

    ``cache`` : folder for what the second look measures.
    """
    camera = detection.camera
    groups = _groups(detection)
    patterns = patterns_of(target, board)
    first: list[tuple[list[LabelledImage], Arrangement]] = []
    jobs: list[tuple[DetectedImage, PredictedCircles]] = []
    focal_px = float(np.sqrt(camera.focal.prod()))
    labelled = label_groups([named for _, named in groups], target, board, focal_px)
    for (members, _), (found, arrangement) in zip(groups, labelled, strict=True):
        found, arrangement = _without_outlying(found, arrangement, patterns, focal_px)
        for i, (image, each) in enumerate(zip(members, found, strict=True)):
            predicted = predict_circles(arrangement, i, each.observations.labels, target, board, camera)
            if predicted is None:
                continue
            wrong = contradictions(predicted, each.observations, camera)
            found[i] = each.without(wrong, contradicted_notes(wrong))
            if predicted.wanted.any():
                jobs.append((image, predicted))
        first.append((found, arrangement))
    looks = look_again(jobs, camera, options, cache, workers)
    named = [
        each
        for found, arrangement in first
        for each in _without_outlying(_second(found, looks), arrangement, patterns, focal_px)[0]
    ]
    return without_defocus(named, camera, patterns)


def label_once(detection: DetectionResult, target: TargetDesign, board: BoardDesign | None) -> list[LabelledImage]:
    """Returns the labelled circles of all images, in the order of their groups, without a second look.

    The group numbers plain boards, and readings that contradict it are excluded.
    """
    groups = [named for _, named in _groups(detection)]
    focal_px = float(np.sqrt(detection.camera.focal.prod()))
    return [each for found, _ in label_groups(groups, target, board, focal_px) for each in found]


def _groups(detection: DetectionResult) -> list[tuple[list[DetectedImage], list[tuple[str, str, ImageDetection]]]]:
    """Images of each group; and (name, group, detection) of them."""
    groups: dict[str, list[DetectedImage]] = {}
    for image in detection.images:
        groups.setdefault(image.file.group, []).append(image)
    return [(own, [(i.file.name, i.file.group, i.detection) for i in own]) for own in groups.values()]


def _without_outlying(
    group: list[LabelledImage], arrangement: Arrangement, patterns: dict[str, Pattern], focal_px: float
) -> tuple[list[LabelledImage], Arrangement]:
    """Removes circles that contradict the others of the group, and adjusts the arrangement without them."""
    arrangement, outlying = outlying_circles(arrangement, [each.observations for each in group], patterns, focal_px)
    reasons = [outlying.get(i, {}) for i in range(len(group))]
    return [e.without(r, contradicted_notes(r)) for e, r in zip(group, reasons, strict=True)], arrangement


def _second(group: list[LabelledImage], looks: dict[str, SecondLook]) -> list[LabelledImage]:
    """A group's images with what the second look found; without the faces that only one image read and that are not
    there where other images must show them."""
    images = []
    for each in group:
        look = looks.get(each.observations.name)
        images.append(each if look is None else each.plus(look.labels, look.centres, missed_notes(look.missed)))
    for face, seen, expected in _unconfirmed(group, looks):
        note = (
            f"face {face}: read in one image of the group alone, {seen} of {expected} of its circles found that other "
            "images must show; left out, it is a reflection or another object, or hidden there"
        )
        for i, each in enumerate(images):
            own = [label for label in each.observations.labels if label.plane == face]
            images[i] = each.without(own, [note])
    return images


def _unconfirmed(group: list[LabelledImage], looks: dict[str, SecondLook]) -> list[tuple[str, int, int]]:
    """Faces that one image alone reads and others contradict: (face, circles found in these, circles expected)."""
    read = Counter(face for each in group for face in each.observations.face_ids())
    found = []
    for face in [face for face, images in read.items() if images == 1]:
        others = [e.observations.name for e in group if face not in e.observations.face_ids()]
        own = [looks[name] for name in others if name in looks]
        seen = sum(label.plane == face for look in own for label in look.labels)
        expected = seen + sum(label.plane == face for look in own for label in look.missed)
        if expected >= MIN_EXPECTED and seen < MIN_CONFIRMED * expected:
            found.append((face, seen, expected))
    return found


def label_groups(
    groups: Sequence[Sequence[tuple[str, str, ImageDetection]]],
    target: TargetDesign,
    board: BoardDesign | None,
    focal_px: float,
) -> list[tuple[list[LabelledImage], Arrangement]]:
    """Label the images (name, group, detection) of all groups, each with the arrangement that its labels keep to."""
    patterns = patterns_of(target, board)
    step = step_mm(target, board)
    readings = [[[] if d.mirrored else readings_of(d, target, board) for _, _, d in images] for images in groups]
    reach = MAX_SHIFT_PITCHES * step
    alone = [_arranged(own, patterns, step, focal_px) for own in readings]
    mirrored = [mirrored_images(*each, patterns, reach) for each in zip(alone, readings, strict=True)]
    for group, gone in enumerate(mirrored):
        if gone:
            readings[group] = [[] if i in gone else each for i, each in enumerate(readings[group])]
            alone[group] = _arranged(readings[group], patterns, step, focal_px)
    found = []
    for images, own, gone, arrangement in zip(
        groups, readings, mirrored, across_groups(alone, patterns, reach), strict=True
    ):
        labelled = [
            _mirrored(*each, "the board") if i in gone else _labelled(*each, likely_views(own[i]), arrangement, i)
            for i, each in enumerate(images)
        ]
        found.append((labelled, arrangement))
    return found


def _arranged(
    readings: list[list[Readings]], patterns: dict[str, Pattern], step: float, focal_px: float
) -> Arrangement:
    """The arrangement of one group; of readings by which dots are covered only where these explain more."""
    likely = arrange([likely_views(each) for each in readings], patterns, step, focal_px)
    if not any(likely.contradicted.values()):
        return likely
    every = arrange(readings, patterns, step, focal_px)
    return every if every.explained() > likely.explained() else likely


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
    name: str,
    group: str,
    detection: ImageDetection,
    readings: list[Readings],
    arrangement: Arrangement,
    image: int,
) -> LabelledImage:
    if detection.mirrored:
        return _mirrored(name, group, detection, f"face {', '.join(detection.mirrored)}")
    notes = list(detection.notes)
    if image in arrangement.views:
        views = list(arrangement.views[image])
        notes += [_contradiction(each) for each in arrangement.contradicted.get(image, ())]
        notes += [_open(each) for each in arrangement.open.get(image, ())]
        notes += [_reflection(each) for each in arrangement.reflected.get(image, ())]
        notes += [_foreign(each) for each in arrangement.foreign.get(image, ())]
    else:
        views = [each[0] for each in readings if len(each) == 1 and each[0].named and _once(each[0], readings)]
        notes += [_open(each) for each in readings if len(each) > 1 or not each[0].named]
    labels = [label for view in views for label in view.labels]
    rows = np.concatenate([view.rows for view in views]) if views else np.zeros(0, int)
    order = np.argsort(rows, kind="stable")
    return labelled_image(name, group, [labels[k] for k in order], detection.centres.select(rows[order]), notes)


def _mirrored(name: str, group: str, detection: ImageDetection, shown: str) -> LabelledImage:
    note = (
        f"the image is mirrored: it shows {shown} as a mirror does; left out, turn it back, or use the file "
        "that the camera wrote"
    )
    return labelled_image(name, group, (), detection.centres.select(np.zeros(0, int)), [*detection.notes, note])


def _once(view: PlaneView, readings: list[Readings]) -> bool:
    return sum(each[0].plane == view.plane for each in readings if each[0].named) == 1


OF_A_BOARD, OF_A_FACE = ("a board of ", "board of "), ("a pattern ",)
"""How notes begin that leave a whole board or face out of an image."""


def leaves_a_board_out(note: str) -> bool:
    """Returns whether a note concerns a whole board, not single dots."""
    return note.startswith(OF_A_BOARD)


def leaves_a_pattern_out(note: str) -> bool:
    """Whether a note is of a whole face or board, not of single circles or of the image."""
    return note.startswith(OF_A_BOARD + OF_A_FACE)


def _contradiction(views: Readings) -> str:
    view = views[0]
    if not view.named:
        return _open(views)
    what = f"a board of {len(view.rows)} dots" if view.plane == BOARD else f"a pattern like face {view.plane}"
    return (
        f"{what}: not where the group's other images see it; left out, it is a reflection or another object, or check "
        "that nothing was moved"
    )


def _open(views: Readings) -> str:
    if not views[0].named:
        return open_face_note(len(views[0].rows), (view.plane for view in views))
    return (
        f"board of {len(views[0].rows)} dots left out: {len(views)} numberings fit, none keeps it where the group's "
        "other images see it; show a face that they show, or check that nothing was moved"
    )


def _reflection(view: PlaneView) -> str:
    return f"a pattern like face {view.plane}: the image of another face in a mirror; left out"


def _foreign(view: PlaneView) -> str:
    return (
        f"a pattern like face {view.plane}: not where other groups see that face against the others; left out, it is a "
        "reflection or another object"
    )
