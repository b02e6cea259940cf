"""Number the board alike in all images of a group: the board stands still against the target, so that numbering is
right which keeps board_from_face the same. What stays uncertain is left out."""

from dataclasses import dataclass

import numpy as np

from stcal.design import BoardDesign, FaceDesign, TargetDesign
from stcal.errors import ConvergenceError, DegenerateError
from stcal.geometry.plane import camera_from_plane, fit_homography, refine_planar_pose
from stcal.geometry.rigid import Rigid
from stcal.labels import DotLabel, Label
from stcal.sfm.data.observations import ImageObservations
from stcal.sfm.detect.image import ImageDetection

MAX_SHIFT_PITCHES = 0.3
"""board_from_face may differ by this much between images (pitches, at the face); a wrong numbering is one off."""
MIN_POSE_CIRCLES = 5


@dataclass(frozen=True, slots=True, eq=False)
class LabelledImage:
    """Observations of one image, and why anything seen in it was left out."""

    observations: ImageObservations
    notes: tuple[str, ...]


def label_group(
    images: list[tuple[str, str, ImageDetection]], target: TargetDesign, board: BoardDesign | None
) -> list[LabelledImage]:
    """Settle the board's numbering over the images (name, group, detection) of one group."""
    chosen: dict[int, int] = {}
    if board is not None:
        chosen = _choose([d for _, _, d in images], target, board)
    labelled = []
    for i, (name, group, detection) in enumerate(images):
        notes = list(detection.notes)
        labels: list[Label] = list(detection.target_labels)
        keep = np.arange(len(labels))
        if i in chosen:
            numbering = detection.numberings[chosen[i]]
            labels += [DotLabel(row, column) for row, column in numbering.tolist()]
            keep = np.arange(len(labels))
        elif len(detection.numberings):
            notes.append(
                f"board of {detection.numberings.shape[1]} dots left out: {len(detection.numberings)} numberings fit, "
                "none keeps it where the group's other images see it; show a face that they show, or check that "
                "nothing was moved"
            )
        centres = detection.centres.select(keep)
        observations = ImageObservations(
            name=name,
            group=group,
            labels=tuple(labels),
            centre_px=centres.centre_px,
            centre=centres.centre,
            shape=centres.shape,
            covariance_px2=centres.covariance_px2,
        )
        labelled.append(LabelledImage(observations, tuple(notes)))
    return labelled


def _choose(detections: list[ImageDetection], target: TargetDesign, board: BoardDesign) -> dict[int, int]:
    """Numbering by image."""
    faces = [_face_poses(d, target) for d in detections]
    boards = [_board_poses(d, board) for d in detections]
    open_images = {i for i, poses in enumerate(boards) if poses}
    chosen: dict[int, int] = {}
    if not open_images:
        return chosen
    # The first image that is certain of itself speaks for the group; a plain board's numbering is then by convention.
    first = min(open_images, key=lambda i: (not faces[i], len(boards[i]), -len(faces[i]), -len(detections[i].centres)))
    known: dict[str, Rigid] = {}
    queue = [(first, 0)]
    while queue:
        i, numbering = queue.pop()
        chosen[i] = numbering
        open_images.discard(i)
        for face_id, camera_from_face in faces[i].items():
            known.setdefault(face_id, boards[i][numbering].inverse() @ camera_from_face)
        for j in sorted(open_images):
            best = _best_numbering(faces[j], boards[j], known, target, board)
            if best is not None:
                queue.append((j, best))
                break
    # Where the group's numbering is no convention, one that the image alone makes certain needs no witness, unless a
    # witness contradicts it.
    for j in sorted(open_images):
        if len(boards[first]) == len(boards[j]) == 1 and not set(faces[j]) & set(known):
            chosen[j] = 0
    return chosen


def _best_numbering(faces, boards, known, target: TargetDesign, board: BoardDesign) -> int | None:
    """The one numbering that puts the faces where the others saw them; None where none or several do."""
    shared = [f for f in faces if f in known]
    if not shared:
        return None
    shifts = []
    for board_pose in boards:
        distances = []
        for face_id in shared:
            middle = np.append(target.face(face_id).xy_mm.mean(0), 0)
            distances.append(np.linalg.norm(board_pose.inverse() @ (faces[face_id] @ middle) - known[face_id] @ middle))
        shifts.append(np.median(distances) / board.pitch_mm)
    order = np.argsort(shifts)
    if shifts[order[0]] > MAX_SHIFT_PITCHES or (len(order) > 1 and shifts[order[1]] < 2 * MAX_SHIFT_PITCHES):
        return None
    return int(order[0])


def _face_poses(detection: ImageDetection, target: TargetDesign) -> dict[str, Rigid]:
    """camera_from_face by face id, from the design's positions."""
    poses = {}
    for face_id in detection.face_ids():
        face: FaceDesign = target.face(face_id)
        place = dict(zip(face.labels(), face.xy_mm, strict=True))
        rows = [i for i, label in enumerate(detection.target_labels) if label in place]
        pose = _planar_pose(np.array([place[detection.target_labels[i]] for i in rows]), detection.centres.centre[rows])
        if pose is not None:
            poses[face_id] = pose
    return poses


def _board_poses(detection: ImageDetection, board: BoardDesign) -> list[Rigid]:
    """camera_from_board by numbering; none where the dots do not fix it."""
    dots = detection.centres.centre[len(detection.target_labels) :]
    poses = [_planar_pose(board.pitch_mm * n[:, ::-1].astype(float), dots) for n in detection.numberings]
    found = [pose for pose in poses if pose is not None]
    return found if len(found) == len(poses) else []


def _planar_pose(xy_mm: np.ndarray, xy_normalised: np.ndarray) -> Rigid | None:
    if len(xy_mm) < MIN_POSE_CIRCLES:
        return None
    try:
        start = camera_from_plane(fit_homography(xy_mm, xy_normalised))
        return refine_planar_pose(start, xy_mm, xy_normalised)
    except (ConvergenceError, DegenerateError):
        return None
