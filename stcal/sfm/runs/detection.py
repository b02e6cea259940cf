"""Detection in all images of a run, its first stage."""

from dataclasses import dataclass, replace
from pathlib import Path

from stcal.boards.design import CornerBoard
from stcal.design import BoardDesign, TargetDesign
from stcal.errors import InputError
from stcal.geometry.arrays import Brief
from stcal.io.cameras.model import CameraModel
from stcal.io.files import save
from stcal.io.images import ImageFiles
from stcal.parallel import Progress, counted
from stcal.sfm.data.model import detections_csv
from stcal.sfm.detect.board_alone import is_board_alone, label_boards
from stcal.sfm.detect.files import DetectionResult, detect_files, require_upright
from stcal.sfm.detect.labels import Detection, LabelledImage, label_images, label_once
from stcal.sfm.detect.published import PublishedPattern, detect_published
from stcal.sfm.runs.options import RunOptions
from stcal.sfm.runs.transaction import RunFolder


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class DetectedImages(Brief):
    """The circles and corners of all images.

    ``detection`` : what was measured, and the images ``skipped``; ``labelled`` : images with their labels, in the
    database's order; ``notes`` : on the camera, and on what no image shows.
    """

    detection: DetectionResult
    labelled: tuple[LabelledImage, ...]
    notes: tuple[str, ...]

    @property
    def images(self) -> dict[str, Detection]:
        """Labels, centres and covariances, px, by the name of the image."""
        return {
            (seen := image.observations).name: Detection(
                seen.labels, seen.centre_px, seen.covariance_px2, tuple(image.notes)
            )
            for image in self.labelled
        }


def require_no_calibration(out: str | Path) -> None:
    """Refuses a folder for detections that holds a finished calibration.

    Raises
    ------
    InputError
        It holds one.
    """
    if (Path(out) / "faces.json").exists():
        raise InputError(
            "E-OUTPUT-EXISTS", f"output folder {out}: holds a finished calibration; give another folder with --out"
        )


def require_dots(board: BoardDesign | None, option: str) -> None:
    """Refuses a board of corners for an option whose method finds dots.

    Raises
    ------
    InputError
        The board is one of corners; the message begins with the option.
    """
    if isinstance(board, CornerBoard):
        raise InputError(
            "E-OPTION-CONFLICT", f"{option}: finds boards of dots, and --board is one of squares or tags; leave it out"
        )


@dataclass(frozen=True, slots=True, eq=False)
class Task:
    """The subject of all stages of a run.

    ``files`` : the photographs; ``folder`` : the claimed folder; ``board`` : without rows where there is none.
    """

    files: ImageFiles
    folder: RunFolder
    target: TargetDesign
    board: BoardDesign
    options: RunOptions
    progress: Progress


def labelled_images(task: Task, camera: CameraModel) -> tuple[DetectionResult, list[LabelledImage]]:
    """Detects and labels the images, and writes ``detections.csv`` into the folder."""
    detection, labelled = detected_images(task, camera)
    save(task.folder.stage / "detections.csv", detections_csv([image.observations for image in labelled]))
    return detection, labelled


def detected_images(task: Task, camera: CameraModel) -> tuple[DetectionResult, list[LabelledImage]]:
    """Detects and labels the images by the rules that the options ask for."""
    (chosen, skipped), target, options, cache = task.files, task.target, task.options, task.folder.cache
    step = counted(task.progress, "detect", len(chosen))
    dots = task.board if task.board.rows else None
    published = options.solve == "paper"
    if published:
        require_dots(dots, "--solve paper")
        PublishedPattern.of(target)
    detector = detect_published if published else None
    detection = detect_files(chosen, camera, target, dots, options.ellipses, cache, options.workers, step, detector)
    detection = replace(detection, skipped=(*skipped, *detection.skipped))
    require_upright(detection.images)
    if dots is not None and (options.board_only or is_board_alone(detection)):
        return detection, label_boards(detection, target, dots)
    if published:
        return detection, label_once(detection, target, dots)
    return detection, label_images(detection, target, dots, options.ellipses, cache, options.workers)
