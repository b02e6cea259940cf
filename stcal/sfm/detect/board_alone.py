"""Photographs of the board alone: no face tells from which end a plain board is numbered, the camera's way does.

A plain board looks the same after half a turn (a square one after a quarter). Within a group its images are numbered so
that the camera turns least from each to its nearest neighbour; which end the first one starts from is a convention.
"""

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
    """Whether the photographs show the board and nothing that could be a face: no image has one, and beside boards half
    of the images have fewer outlines like circles than name one."""
    found = [each.detection for each in detection.images]
    if not any(each.boards for each in found) or any(each.faces or each.open_faces for each in found):
        return False
    others = [each.candidates - sum(len(board.rows) for board in each.boards) for each in found]
    return float(np.median(others)) < MIN_EXPECTED


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
    width, height = board.pitch_mm * (board.columns - 1), board.pitch_mm * (board.rows - 1)
    corners = np.array([[0.0, 0, 0], [width, 0, 0], [0, height, 0], [width, height, 0]])
    away = np.linalg.norm((difference @ corners)[:, None] - corners, axis=2)
    return bool(away.min(1).max() < MAX_SHIFT_PITCHES * board.pitch_mm)


def _numbered(views: list[list[PlaneView] | str]) -> tuple[dict[int, PlaneView], dict[int, str]]:
    """The numbering of each image that turns the camera least from one that is numbered, the nearest image first; and
    why others have none."""
    reasons = {i: own for i, own in enumerate(views) if isinstance(own, str) and own}
    left = {i: own for i, own in enumerate(views) if not isinstance(own, str)}
    if not left:
        return {}, reasons
    first = max(left, key=lambda i: len(left[i][0].rows))
    chosen = {first: left.pop(first)[0]}
    while left:
        turns = {
            (i, k): min(_turn_rad(view, other) for other in chosen.values())
            for i, own in left.items()
            for k, view in enumerate(own)
        }
        i, k = min(turns, key=lambda key: turns[key])
        own = left.pop(i)
        others = [turns[i, m] for m in range(len(own)) if m != k]
        if others and min(others) - turns[i, k] < CLEAR_RAD:
            reasons[i] = (
                f"board numbered from either end: the camera is turned by {np.degrees(turns[i, k]):.0f}° or "
                f"{np.degrees(min(others)):.0f}° from the nearest image; left out, add views in between, or show a face"
            )
        else:
            chosen[i] = own[k]
    return chosen, reasons


def _turn_rad(view: PlaneView, other: PlaneView) -> float:
    return (view.camera_from_plane @ other.camera_from_plane.inverse()).angle_rad()
