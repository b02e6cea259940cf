"""From a folder of images to camera_from_target of each: the calibrated target at work."""

import hashlib
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from stcal.design import BoardDesign, TargetDesign
from stcal.errors import ConvergenceError, DetectionError, StcalError
from stcal.geometry.arrays import frozen
from stcal.geometry.camera import Camera
from stcal.io.cameras.model import CameraModel, CameraPrior
from stcal.io.image_jobs import run_on_images
from stcal.io.images import ImageFile, Skipped, find_images
from stcal.parallel import Progress, counted, one_thread
from stcal.sfm.data.model import ImageObservations, by_group
from stcal.sfm.data.patterns import patterns_of
from stcal.sfm.detect.circles.candidates import EllipseOptions
from stcal.sfm.detect.files import DetectedImage, copy_of, detect_files, load_image, sized_by
from stcal.sfm.detect.labels import label_single, without_defocus
from stcal.sfm.measurement.pose import PoseOptions, TargetPose, common_errors, measured_pose, resolved
from stcal.sfm.measurement.target import TargetCircles
from stcal.sfm.measurement.tracker import Tracker


@dataclass(frozen=True, slots=True)
class MeasureOptions:
    """What :func:`measure` does with each image.

    Parameters
    ----------
    pose : PoseOptions
        Of the single images.
    previous : bool
        An image's own undecided pose is decided by that of the image before it, by name and in the same folder.
    sequence : bool
        The images of each folder follow each other, by name: the target is looked for where the pose before puts it,
        and in the whole image only where it is not there; see :class:`stcal.sfm.measurement.tracker.Tracker`. An
        undecided pose is decided by the one before.
    ellipses : EllipseOptions
        Of detection.
    workers : int, optional
        Processes; one per core where None.
    """

    pose: PoseOptions = field(default_factory=PoseOptions)
    previous: bool = False
    sequence: bool = False
    ellipses: EllipseOptions = field(default_factory=EllipseOptions)
    workers: int | None = None


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredImage:
    """``name`` of the image, its ``pose``, and ``notes`` on what was seen and left out in it."""

    name: str
    pose: TargetPose
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class MeasureResult:
    """``images`` that have a pose, in order of name; ``left_out`` : the others, with reasons; ``notes`` : what the
    covariances lack; ``sigma_factor`` : on the centres' own σ; ``intrinsics_held`` : whether they were taken as exact;
    ``common`` : (m, 6, r) what the poses' errors have in common, see
    :func:`stcal.sfm.measurement.pose.common_errors`; ``searched`` : images of a sequence that were searched as
    a whole, None where each stands for itself.
    """

    images: tuple[MeasuredImage, ...]
    left_out: tuple[Skipped, ...]
    notes: tuple[str, ...]
    sigma_factor: float
    intrinsics_held: bool
    common: np.ndarray
    searched: int | None = None

    def __post_init__(self):
        object.__setattr__(self, "common", frozen(self.common, (len(self.images), 6, None), "common errors"))


@one_thread()
def measure(
    images: str | Path,
    camera: CameraModel,
    target: TargetCircles,
    design: TargetDesign,
    board: BoardDesign | None = None,
    options: MeasureOptions | None = None,
    progress: Progress | None = None,
) -> MeasureResult:
    """Pose of a calibrated target in each image of a folder and of its subfolders.

    Two minima of a face seen alone are told apart where its circles can (Schweighofer & Pinz 2006), and stated both
    where they cannot.

    Parameters
    ----------
    images : path
        Folder of photographs; every folder in it too.
    camera : CameraModel
        As :func:`stcal.io.cameras.read.read_camera` returns it; its covariance, if it has one, goes into the poses'.
    target : TargetCircles
        Its circles, target frame, mm; see :func:`read_target`.
    design : TargetDesign
        Radii and polarity, for detection and labels.
    board : BoardDesign, optional
        A dot board that may be in view, so that its dots are not taken for circles of the target.
    options : MeasureOptions, optional
        The defaults where None.
    progress : callable, optional
        Called with (stage, done, total).

    Returns
    -------
    MeasureResult
        camera_from_target of every image that has a pose, mm, with (6, 6) covariances in rad and mm, left perturbation
        in the camera frame; and what was left out, with reasons.

    Raises
    ------
    InputError
        No image is usable, or the camera file does not belong to them.
    DetectionError
        No image shows a face.
    """
    options, progress = options or MeasureOptions(), progress or (lambda *_: None)
    files, other = find_images(images)
    step = counted(progress, "detect", len(files))
    if options.sequence:
        result = follow_files(files, camera, replace(target, design=design), board, options, step)
    else:
        with tempfile.TemporaryDirectory(prefix="stcal-measure-") as scratch:
            cache = Path(scratch)
            detection = detect_files(
                files, camera, design, board, options.ellipses, cache, options.workers, step, forms=False
            )
        observations, notes = _labelled(detection.images, detection.camera, design)
        prior = None if camera.covariance is None else CameraPrior(camera.colmap_model, camera.covariance)
        result = measure_labelled(observations, detection.camera, target, options, prior)
        measured = tuple(replace(each, notes=notes[each.name]) for each in result.images)
        result = replace(result, images=measured, left_out=(*detection.skipped, *result.left_out))
    result = replace(result, left_out=(*other, *result.left_out))
    if not result.images:
        last = result.left_out[-1]
        raise DetectionError(
            "E-MEASURE-NONE",
            f"no face of the target measured in {len(files)} images, first {last.name}: "
            f"{last.reason}; check target.toml (radii, polarity), faces.json and the exposure",
        )
    return result


def _labelled(images: Sequence[DetectedImage], camera: Camera, design: TargetDesign):
    """Observations of all images, and the notes on each."""
    labelled = [label_single(i.file.name, i.file.group, i.detection, design) for i in images]
    labelled = without_defocus(labelled, camera, patterns_of(design, None))
    return [each.observations for each in labelled], {each.observations.name: each.notes for each in labelled}


def measure_labelled(
    observations: Sequence[ImageObservations],
    camera: Camera,
    target: TargetCircles,
    options: MeasureOptions | None = None,
    prior: CameraPrior | None = None,
) -> MeasureResult:
    """The poses from labelled centres, without pixels; ``prior`` : of the intrinsics, exact where None.

    An image that gives no pose is among those left out.
    """
    options = options or MeasureOptions()
    found: list[MeasuredImage | Skipped] = []
    for group in by_group(observations).values():
        before: TargetPose | None = None
        for image in sorted(group, key=lambda each: each.name):
            pose = measured_pose(image, camera, target, options.pose, prior)
            if options.previous and before is not None and isinstance(pose, TargetPose):
                pose = resolved(pose, before.camera_from_target)
            found.append(outcome(image.name, pose, ()))
            before = pose if isinstance(pose, TargetPose) and pose.status != "ambiguous" else None
    return result_of(found, target, options, prior)


def follow_files(
    files: Sequence[ImageFile],
    camera_model: CameraModel,
    target: TargetCircles,
    board: BoardDesign | None,
    options: MeasureOptions,
    step: Callable[[object], None],
) -> MeasureResult:
    """The poses in files of which each folder is a sequence in order of name; folders side by side.

    ``step`` : called once for each file.
    """
    camera, size_from = sized_by(camera_model, list(files))
    folders: dict[str, list[ImageFile]] = {}
    for file in sorted(files, key=lambda each: each.name):
        folders.setdefault(file.group, []).append(file)
    model = replace(camera_model, width=camera.width, height=camera.height)
    jobs = [(own, model, camera, size_from, target, board, options) for own in folders.values()]
    followed: list[tuple[list[MeasuredImage | Skipped], int]] = [([], 0)] * len(jobs)
    for i, outcome in run_on_images(_follow_folder, jobs, options.workers):
        followed[i] = outcome
        for file in jobs[i][0]:
            step(file.name)
    prior = None if camera_model.covariance is None else CameraPrior(camera_model.colmap_model, camera_model.covariance)
    result = result_of([each for found, _ in followed for each in found], target, options, prior)
    return replace(result, searched=sum(searched for _, searched in followed))


def _follow_folder(
    files: Sequence[ImageFile], model: CameraModel, camera: Camera, size_from: str, target, board, options
) -> tuple[list[MeasuredImage | Skipped], int]:
    """What each image of a folder gives, and how many were searched as a whole."""
    tracker = Tracker(target, model, board, options.pose, options.ellipses)
    found: list[MeasuredImage | Skipped] = []
    first: dict[str, str] = {}
    searched = 0
    for file in files:
        loaded = load_image(file, camera, size_from)
        if isinstance(loaded, Skipped):
            found.append(loaded)
            continue
        data, image = loaded
        digest = hashlib.sha256(data).hexdigest()
        if digest in first:
            found.append(copy_of(file, first[digest]))
            continue
        first[digest] = file.name
        try:
            seen, pose = tracker.observe(image, file.name)
        except ConvergenceError as error:
            found.append(Skipped(file.name, str(error), "distortion"))
            continue
        searched += tracker.searched
        found.append(outcome(file.name, pose, seen.notes))
    return found, searched


def outcome(name: str, pose: TargetPose | StcalError, notes: tuple[str, ...]) -> MeasuredImage | Skipped:
    if isinstance(pose, StcalError):
        return Skipped(name, str(pose).removeprefix(f"{name}: "), "pose")
    return MeasuredImage(name, pose, notes)


def result_of(found: Sequence[MeasuredImage | Skipped], target: TargetCircles, options, prior) -> MeasureResult:
    measured = tuple(each for each in found if isinstance(each, MeasuredImage))
    left_out = tuple(each for each in found if isinstance(each, Skipped))
    factor = target.sigma_factor if options.pose.sigma_factor is None else options.pose.sigma_factor
    common = common_errors([each.pose for each in measured], target, prior)
    return MeasureResult(measured, left_out, target.notes, factor, prior is None, common)
