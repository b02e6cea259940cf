"""All images of a run, group by group: labels, then a second look for what the group says must be in view."""

from pathlib import Path

import numpy as np

from stcal.design import BoardDesign, TargetDesign
from stcal.sfm.detect.ellipses import EllipseOptions
from stcal.sfm.detect.files import DetectedImage, DetectionResult, look_again
from stcal.sfm.detect.labels import LabelledImage, label_groups
from stcal.sfm.detect.predict import PredictedCircles, contradicted_notes, contradictions, missed_notes, predict_circles


def label_images(
    detection: DetectionResult,
    target: TargetDesign,
    board: BoardDesign | None,
    options: EllipseOptions,
    cache: Path,
    workers: int | None = None,
) -> list[LabelledImage]:
    """Labelled circles of all images, in the order of their groups.

    ``cache`` : folder for what the second look measures.
    """
    camera = detection.camera
    groups: dict[str, list[DetectedImage]] = {}
    for image in detection.images:
        groups.setdefault(image.file.group, []).append(image)
    labelled: list[LabelledImage] = []
    jobs: list[tuple[DetectedImage, PredictedCircles]] = []
    focal_px = float(np.sqrt(camera.focal.prod()))
    named = [[(i.file.name, i.file.group, i.detection) for i in members] for members in groups.values()]
    for members, (found, arrangement) in zip(
        groups.values(), label_groups(named, target, board, focal_px), strict=True
    ):
        for i, (image, each) in enumerate(zip(members, found, strict=True)):
            predicted = predict_circles(arrangement, i, each.observations.labels, target, board, camera)
            if predicted is None:
                continue
            wrong = contradictions(predicted, each.observations, camera)
            found[i] = each.without(wrong, contradicted_notes(wrong))
            if predicted.wanted.any():
                jobs.append((image, predicted))
        labelled += found
    looks = look_again(jobs, camera, options, cache, workers)
    return [_with(each, looks) for each in labelled]


def _with(each: LabelledImage, looks) -> LabelledImage:
    look = looks.get(each.observations.name)
    return each if look is None else each.plus(look.labels, look.centres, missed_notes(look.missed))
