"""The first stages of a run: the camera with which it begins, and detection and labels in all images."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from stcal.boards.board_designs import CornerBoard
from stcal.boards.on_faces import why_unseen
from stcal.design import BoardDesign, TargetDesign, scale_reference
from stcal.errors import DegenerateError, DetectionError, InputError
from stcal.geometry.arrays import Brief
from stcal.geometry.camera import Camera
from stcal.io.cameras.camera_model import CameraModel, model_of
from stcal.io.cameras.photograph import camera_of_photograph
from stcal.io.images import ImageFile, ImageFiles, require_common_size
from stcal.parallel import Progress, counted
from stcal.sfm.camera.calibrate import camera_of_dots
from stcal.sfm.camera.intrinsics import start_camera
from stcal.sfm.data.group_model import ImageObservations
from stcal.sfm.detect.detect_files import PHOTOGRAPHS, DetectionResult, detect_files, require_upright, seen_by
from stcal.sfm.detect.labelling import Detection, LabelledImage, is_board_alone, label_boards, label_images, label_once
from stcal.sfm.detect.published import PublishedPattern, detect_published
from stcal.sfm.mapping.body import LENS, place_and_find_camera, unknown_lens
from stcal.sfm.runs.run_options import RunOptions
from stcal.sfm.runs.transaction import RunFolder

VAGUE = 0.01
"""Relative σ of a camera file's focal length above which the boards tell it better."""


@dataclass(frozen=True, slots=True, eq=False)
class Task:
    """What all stages of a run work on."""

    files: ImageFiles
    folder: RunFolder  # claimed
    target: TargetDesign
    board: BoardDesign  # without rows where there is none
    options: RunOptions
    progress: Progress
    camera: CameraModel | None = None  # as given
    photographs: Path | str = ""  # the folder that they are in

    @property
    def camera_given(self) -> bool:
        """False if the camera is found from the photographs, also where its file is only a start of that."""
        return self.camera is not None and not (self.options.refine_camera and is_vague(self.camera))

    def named(self, words: str) -> "Task":
        """Returns the task with other words for its stages, of which ``{}`` is the own name."""
        return replace(self, progress=lambda stage, *count: self.progress(words.format(stage), *count))


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class DetectedImages(Brief):
    """The circles and corners of all images.

    ``detection`` : what was measured, and the images ``skipped``; ``labelled`` : images with their labels, in the
    database's order; ``camera`` : with which they were detected; ``notes`` : on the camera, and on what no image shows.
    """

    detection: DetectionResult
    labelled: tuple[LabelledImage, ...]
    camera: CameraModel
    notes: tuple[str, ...] = ()

    def observations(self) -> list[ImageObservations]:
        """Returns the labelled centres of all images."""
        return [image.observations for image in self.labelled]

    @property
    def images(self) -> dict[str, Detection]:
        """Labels, centres and covariances, px, by the name of the image."""
        return {
            (seen := image.observations).name: Detection(
                seen.labels, seen.centre_px, seen.covariance_px2, tuple(image.notes)
            )
            for image in self.labelled
        }


def require_dots(board: BoardDesign | None, option: str) -> None:
    """Refuses a board of corners for an option whose method finds dots."""
    if isinstance(board, CornerBoard):
        raise InputError(
            "E-OPTION-CONFLICT", f"{option}: finds boards of dots, and --board is one of squares or tags; leave it out"
        )


def detect(task: Task) -> DetectedImages:
    """Detects and labels with the camera given, or with the one that printed faces, or the board's dots, determine."""
    if task.camera is None and (printed := task.target.with_faces(printed=True)).faces:
        return _detect_by_faces(task, printed)
    camera = task.camera
    if camera is None or (task.board.rows and not task.camera_given):
        camera = camera_by_dots(task, camera)
    return detect_with(task, camera)


def detect_with(task: Task, camera: CameraModel) -> DetectedImages:
    """Detects and labels the images by the rules that the options ask for."""
    (chosen, skipped), target, options, cache = task.files, task.target, task.options, task.folder.cache
    step = counted(task.progress, "detect", len(chosen))
    dots, detector = task.board if task.board.rows else None, None
    if options.solve == "paper":
        require_dots(dots, "--solve paper")
        PublishedPattern.of(target)
        detector = detect_published
    detection = detect_files(chosen, camera, target, dots, options.ellipses, cache, options.workers, step, detector)
    detection = replace(detection, skipped=(*skipped, *detection.skipped))
    require_upright(detection.images, task.board)
    if dots is not None and (options.board_only or is_board_alone(detection)):
        labelled = label_boards(detection, target, dots)
    elif detector is not None:
        labelled = label_once(detection, target, dots)
    else:
        labelled = label_images(detection, target, dots, options.ellipses, cache, options.workers)
    return DetectedImages(detection, tuple(labelled), camera)


def _detect_by_faces(task: Task, printed: TargetDesign) -> DetectedImages:
    """Finds the camera by the printed faces of the target, and labels the images with it."""
    target, options, guesses = task.target, task.options, guessed_cameras(task.files[0])
    faces_alone = replace(task, target=printed, board=scale_reference(None, printed))
    seen = detect_with(faces_alone, model_of(guesses[0], PHOTOGRAPHS))
    require_seen(task, seen.labelled)
    camera = place_and_find_camera(seen.observations(), printed.faces, guesses).camera
    if task.board.rows or len(printed.faces) < len(target.faces):
        return detect_with(task, model_of(camera, PHOTOGRAPHS))
    detection = seen_by(seen.detection, camera, target)
    labelled = label_images(detection, target, None, options.ellipses, task.folder.cache, options.workers)
    return DetectedImages(detection, tuple(labelled), model_of(camera, PHOTOGRAPHS))


def camera_by_dots(task: Task, rough: CameraModel | None) -> CameraModel:
    """Returns the camera calibrated from the dots of the board, with the weak prior of an unknown lens."""
    files = task.files[0]
    start = guessed_cameras(files)[0] if rough is None else rough.calibrated(*require_common_size(files)[0])
    seen = detect_with(task.named("{} for the camera"), model_of(start, PHOTOGRAPHS))
    return model_of(unknown_lens(camera_of_dots(files, seen.detection, task.board, start, LENS).camera), PHOTOGRAPHS)


def camera_for_a_look(task: Task) -> tuple[CameraModel, bool]:
    """Returns the camera for a detection without one, and whether dots told it; else it has a medium focal length."""
    if task.board.rows:
        with suppress(DetectionError, DegenerateError):
            return camera_by_dots(task, None), True
    return model_of(guessed_cameras(task.files[0])[0], PHOTOGRAPHS), False


def guessed_cameras(files: Sequence[ImageFile]) -> list[Camera]:
    """Returns where the search for a camera begins: at the first EXIF that states one, or a medium focal length."""
    (width, height), _ = require_common_size(list(files))
    for file in files:
        with suppress(InputError):
            camera = camera_of_photograph(file.path).camera
            if (camera.width, camera.height) == (width, height):
                return [camera]
    return [Camera.of(start_camera(width, height, LENS), LENS)]


def is_vague(model: CameraModel) -> bool:
    """Returns whether a camera file, as of EXIF, states its focal length less well than the boards tell it."""
    return model.colmap_model == LENS and focal_sigma_px(model) > VAGUE * model.focal[0]


def focal_sigma_px(model: CameraModel) -> float:
    return 0.0 if model.covariance is None else float(np.sqrt(model.covariance[0, 0]))


def unseen_faces(task: Task, labelled: Sequence[LabelledImage]) -> str:
    """Returns that no printed face of the target is seen, and which tags are; empty if one is, or none is printed."""
    printed = task.target.with_faces(printed=True).faces
    seen = {face for image in labelled for face in image.observations.face_ids()}
    return why_unseen(task.files[0], printed) if printed and seen.isdisjoint(face.id for face in printed) else ""


def require_seen(task: Task, labelled: Sequence[LabelledImage]) -> None:
    """Refuses images in which no printed face of the target is seen."""
    if unseen := unseen_faces(task, labelled):
        raise DetectionError("E-TARGET-UNSEEN", unseen)
