"""Labels for photographs of the board alone: the camera's motion numbers a plain board, which looks the same after half
a turn. The numbering of a group's first image is a convention."""

import numpy as np

from stcal.design import BoardDesign, TargetDesign
from stcal.geometry.rigid import Rigid
from stcal.labels import BOARD
from stcal.sfm.data.patterns import patterns_of
from stcal.sfm.detect.files import DetectedImage, DetectionResult
from stcal.sfm.detect.labels import MIN_EXPECTED, LabelledImage, labelled_image, without_defocus
from stcal.sfm.detect.sightings import PlaneView, likely_views, readings_of

MAX_SHIFT_PITCHES = 0.3
"""Largest distance of corners from one another under a symmetry of the board."""
CLEAR_RAD = np.radians(20.0)
"""Smallest difference of the camera's rotation between the best numbering and the next one."""
UNNUMBERED = "left out, show the whole board, or a face with it"


def is_board_alone(detection: DetectionResult) -> bool:
    """Returns whether no image has a face, and half of them too few outlines outside of boards for one."""
    detections = [detection_of_image.detection for detection_of_image in detection.images]
    if not any(detection_of_image.boards for detection_of_image in detections) or any(
        detection_of_image.faces or detection_of_image.open_faces for detection_of_image in detections
    ):
        return False
    outside_boards = [
        detection_of_image.candidates - sum(len(board.rows) for board in detection_of_image.boards)
        for detection_of_image in detections
    ]
    return float(np.median(outside_boards)) < MIN_EXPECTED


def label_boards(detection: DetectionResult, target: TargetDesign, board: BoardDesign) -> list[LabelledImage]:
    """Returns the labelled dots of all images, in the order of their groups."""
    groups: dict[str, list[DetectedImage]] = {}
    for image in detection.images:
        groups.setdefault(image.file.group, []).append(image)
    found = [each for images in groups.values() for each in _label_group(images, target, board)]
    return without_defocus(found, detection.camera, patterns_of(target, board))


def _label_group(images: list[DetectedImage], target: TargetDesign, board: BoardDesign) -> list[LabelledImage]:
    views = [_views(image, target, board) for image in images]
    chosen, reasons = _numbered(views)
    found = []
    for i, image in enumerate(images):
        notes = [*image.detection.notes, *([reasons[i]] if i in reasons else [])]
        view = chosen.get(i)
        labels = () if view is None else view.labels
        rows = np.zeros(0, int) if view is None else view.rows
        found.append(
            labelled_image(image.file.name, image.file.group, labels, image.detection.centres.select(rows), notes)
        )
    return found


def _views(image: DetectedImage, target: TargetDesign, board: BoardDesign) -> list[PlaneView] | str:
    """Returns the symmetric numberings of the only board of an image, or why there are none."""
    if not image.detection.boards:
        return ""
    if image.detection.board is None:
        return "board found more than once; left out"
    readings = likely_views(readings_of(image.detection, target, board))
    views = max(
        (each for each in readings if each and each[0].plane == BOARD), key=lambda v: len(v[0].rows), default=[]
    )
    if not views:
        return f"a board without a pose; {UNNUMBERED}"
    if not all(_is_symmetry(views[0].camera_from_plane.inverse() @ v.camera_from_plane, board) for v in views):
        return f"board of {len(views[0].rows)} dots: {len(views)} numberings fit; {UNNUMBERED}"
    return list(views)


def _is_symmetry(difference: Rigid, board: BoardDesign) -> bool:
    width, height = board.columns - 1, board.rows - 1
    xy = board.pitch_mm * board.flat(np.array([[0.0, 0], [width, 0], [0, height], [width, height]]))
    corners = np.pad(xy, ((0, 0), (0, 1)))
    away = np.linalg.norm((difference @ corners)[:, None] - corners, axis=2)
    return bool(away.min(1).max() < MAX_SHIFT_PITCHES * board.pitch_mm)


def _numbered(views: list[list[PlaneView] | str]) -> tuple[dict[int, PlaneView], dict[int, str]]:
    """Returns the numbering of each image, and why others have none; next is what turns least from a numbered one."""
    reasons = {i: numberings for i, numberings in enumerate(views) if isinstance(numberings, str) and numberings}
    open_images = {i: numberings for i, numberings in enumerate(views) if not isinstance(numberings, str)}
    if not open_images:
        return {}, reasons
    first = max(open_images, key=lambda i: len(open_images[i][0].rows))
    numbered = {first: open_images.pop(first)[0]}
    while open_images:
        turns = {
            (i, k): min(_turn_rad(view, other) for other in numbered.values())
            for i, numberings in open_images.items()
            for k, view in enumerate(numberings)
        }
        i, k = min(turns, key=lambda key: turns[key])
        numberings = open_images.pop(i)
        rivals = [turns[i, m] for m in range(len(numberings)) if m != k]
        if rivals and min(rivals) - turns[i, k] < CLEAR_RAD:
            reasons[i] = (
                f"board numbered from either end: the camera is turned by {np.degrees(turns[i, k]):.0f}° or "
                f"{np.degrees(min(rivals)):.0f}° from the nearest image; left out, add views in between, or show a face"
            )
        else:
            numbered[i] = numberings[k]
    return numbered, reasons


def _turn_rad(view: PlaneView, other: PlaneView) -> float:
    return (view.camera_from_plane @ other.camera_from_plane.inverse()).angle_rad()
