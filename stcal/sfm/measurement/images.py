"""Measurement of camera_from_target in each image of a folder, with a calibrated target."""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from stcal.boards.on_faces import why_unseen
from stcal.boards.target_file import target_of
from stcal.design import BoardDesign, TargetDesign
from stcal.errors import ConvergenceError, DetectionError, StcalError
from stcal.geometry.arrays import Brief, frozen, require_arguments, require_fields
from stcal.geometry.camera import Camera
from stcal.io.cameras.model import CameraModel, CameraPrior
from stcal.io.cameras.read import camera_model, read_camera
from stcal.io.image_jobs import run_on_images
from stcal.io.images import ImageFile, Skipped, find_images
from stcal.parallel import Progress, counted, one_thread, scratch_folder
from stcal.sfm.data.model import ImageObservations, by_group
from stcal.sfm.data.patterns import patterns_of
from stcal.sfm.detect.circles.candidates import EllipseOptions
from stcal.sfm.detect.files import copy_of, detect_files, load_image, sized_by
from stcal.sfm.detect.image import detect_target
from stcal.sfm.detect.labelling import label_single, without_defocus
from stcal.sfm.measurement.pose import PoseOptions, TargetPose, common_errors, measured_pose, resolved
from stcal.sfm.measurement.target import TargetCircles, read_target
from stcal.sfm.measurement.tracker import Tracker


@dataclass(frozen=True, slots=True)
class MeasureOptions:
    """Options of :func:`measure`.

    Parameters
    ----------
    pose : PoseOptions
        Options of the pose of a single image.
    previous : bool
        Whether an ambiguous pose is decided by that of the image before, by name and in the same folder.
    sequence : bool
        Whether the images of each folder follow each other, by name. The target is then looked for at its predicted
        place, and in the whole image only if it is not there; see :class:`stcal.sfm.measurement.tracker.Tracker`. An
        ambiguous pose is decided by the one before.
    ellipses : EllipseOptions
        Options of detection.
    workers : int, optional
        Number of processes; one per core if None.
    """

    pose: PoseOptions = field(default_factory=PoseOptions)
    previous: bool = False
    sequence: bool = False
    ellipses: EllipseOptions = field(default_factory=EllipseOptions)
    workers: int | None = None

    def __post_init__(self):
        require_fields(self, "options", workers=1)


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredImage:
    """An image with its pose. ``notes`` : circles that were seen in it and left out, with reasons."""

    name: str
    pose: TargetPose
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class MeasureResult(Brief):
    """Result of :func:`measure`."""

    images: tuple[MeasuredImage, ...]  # those with a pose, in order of name
    left_out: tuple[Skipped, ...]  # the others, with reasons
    notes: tuple[str, ...]  # what the covariances lack
    sigma_factor: float  # on the centres' own σ
    intrinsics_held: bool  # whether the intrinsics were taken as exact
    common: np.ndarray  # (m, 6, r) of the poses, see :func:`stcal.sfm.measurement.pose.common_errors`
    searched: int | None = None  # number of images of a sequence that were searched as a whole

    def __post_init__(self):
        object.__setattr__(self, "common", frozen(self.common, (len(self.images), 6, None), "common errors"))


@require_arguments
@one_thread()
def measure(
    images: str | Path,
    camera: Camera | CameraModel | str | Path,
    target: TargetCircles | str | Path,
    design: TargetDesign | str | Path | None = None,
    board: BoardDesign | None = None,
    options: MeasureOptions | None = None,
    progress: Progress | None = None,
) -> MeasureResult:
    """Measures the pose of a calibrated target in each image of a folder and of its subfolders.

    A face seen alone can have two minima (Schweighofer & Pinz 2006). If its circles cannot decide between them, both
    are stated.

    Parameters
    ----------
    images : path
        Folder of photographs, with its subfolders.
    camera : Camera or path
        Camera from :func:`stcal.load_camera`, its file, or of the run: ``result.refined_camera or result.camera``. Its
        covariance, if any, is part of the poses' covariances.
    target : TargetCircles or path
        Circles of the target, target frame, mm; see :func:`read_target`; or the ``faces.json`` of a run.
    design : TargetDesign or path, optional
        Design with radii and polarity, for detection and labels, or its ``target.toml``; that of the circles, or the
        reference design, if None.
    board : BoardDesign, optional
        A dot board that may be in view, so that its dots are not taken for circles of the target.
    options : MeasureOptions, optional
        The defaults if None.
    progress : callable, optional
        Called with (stage, done, total).

    Returns
    -------
    MeasureResult
        camera_from_target of every image that has a pose, mm, with (6, 6) covariances in rad and mm, left perturbation
        in the camera frame; and the images left out, with reasons.

    Raises
    ------
    InputError
        If no image is usable, or the camera file does not belong to the images.
    DetectionError
        If no image shows a face.
    """
    options, progress = options or MeasureOptions(), progress or (lambda *_: None)
    if design is None and isinstance(target, TargetCircles):
        design = target.design
    design = target_of(design)
    target = read_target(target, design) if isinstance(target, str | Path) else target
    camera = read_camera(camera) if isinstance(camera, str | Path) else camera_model(camera)
    prior = None if camera.covariance is None else CameraPrior(camera.colmap_model, camera.covariance)
    files, unreadable = find_images(images)
    step = counted(progress, "detect", len(files))
    shown = True
    if options.sequence:
        outcomes, searched = _followed(files, camera, replace(target, design=design), board, options, step)
        result = replace(result_of(outcomes, target, options, prior), searched=searched)
    else:
        with scratch_folder("measure") as cache:
            inputs = files, camera, design, board, options.ellipses, cache, options.workers, step, detect_target
            detection = detect_files(*inputs, forms=False, pictures=False)
        labelled = [label_single(i.file.name, i.file.group, i.detection, design) for i in detection.images]
        labelled = without_defocus(labelled, detection.camera, patterns_of(design, None))
        shown = any(len(image.observations) for image in labelled)
        notes = {image.observations.name: image.notes for image in labelled}
        observations = [image.observations for image in labelled]
        result = measure_labelled(observations, detection.camera, target, options, prior)
        measured = tuple(replace(image, notes=notes[image.name]) for image in result.images)
        result = replace(result, images=measured, left_out=(*detection.skipped, *result.left_out))
    result = replace(result, left_out=(*unreadable, *result.left_out))
    if not result.images:
        last = result.left_out[-1]
        printed = design.with_faces(printed=True).faces
        if printed and not shown:
            raise DetectionError("E-TARGET-UNSEEN", why_unseen(files, printed))
        raise DetectionError(
            "E-MEASURE-NONE",
            f"no face of the target measured in {len(files)} images, first {last.name}: "
            f"{last.reason}; check target.toml (radii, polarity), faces.json and the exposure",
        )
    return result


def measure_labelled(
    observations: Sequence[ImageObservations],
    camera: Camera,
    target: TargetCircles,
    options: MeasureOptions | None = None,
    prior: CameraPrior | None = None,  # covariance of the intrinsics, which are exact if None
) -> MeasureResult:
    """Returns the poses from labelled centres, without pixels."""
    options = options or MeasureOptions()
    outcomes: list[MeasuredImage | Skipped] = []
    for group in by_group(observations).values():
        before: TargetPose | None = None
        for image in sorted(group, key=lambda observation: observation.name):
            pose = measured_pose(image, camera, target, options.pose, prior)
            if options.previous and before is not None and isinstance(pose, TargetPose):
                pose = resolved(pose, before.camera_from_target)
            outcomes.append(outcome(image.name, pose, ()))
            before = pose if isinstance(pose, TargetPose) and pose.status != "ambiguous" else None
    return result_of(outcomes, target, options, prior)


def _followed(
    files: Sequence[ImageFile], camera_model: CameraModel, target, board, options, step: Callable[[object], None]
) -> tuple[list[MeasuredImage | Skipped], int]:
    """Returns the outcomes of files, each folder of which is a sequence in order of name, and the number of images that
    were searched as a whole. Folders run in parallel; ``step`` is called once for each file."""
    camera, size_from = sized_by(camera_model, list(files))
    folders: dict[str, list[ImageFile]] = {}
    for file in sorted(files, key=lambda each: each.name):
        folders.setdefault(file.group, []).append(file)
    model = replace(camera_model, width=camera.width, height=camera.height)
    jobs = [(own, model, camera, size_from, target, board, options) for own in folders.values()]
    followed: dict[int, tuple[list[MeasuredImage | Skipped], int]] = {}
    for i, found in run_on_images(_follow_folder, jobs, options.workers):
        followed[i] = found
        for file in jobs[i][0]:
            step(file.name)
    outcomes = [each for i in range(len(jobs)) for each in followed[i][0]]
    return outcomes, sum(searched for _, searched in followed.values())


def _follow_folder(
    files: Sequence[ImageFile], model: CameraModel, camera: Camera, size_from: str, target, board, options
) -> tuple[list[MeasuredImage | Skipped], int]:
    """Returns the outcome of each image of a folder, and the number of images that were searched as a whole."""
    tracker = Tracker(target, model, board, options.pose, options.ellipses)
    outcomes: list[MeasuredImage | Skipped] = []
    name_of_digest: dict[str, str] = {}
    searched = 0
    for file in files:
        loaded = load_image(file, camera, size_from)
        if isinstance(loaded, Skipped):
            outcomes.append(loaded)
            continue
        data, image = loaded
        digest = hashlib.sha256(data).hexdigest()
        if digest in name_of_digest:
            outcomes.append(copy_of(file, name_of_digest[digest]))
            continue
        name_of_digest[digest] = file.name
        try:
            labelled, pose = tracker.observe(image, file.name)
        except ConvergenceError as error:
            outcomes.append(Skipped(file.name, str(error), "distortion"))
            continue
        searched += tracker.searched
        outcomes.append(outcome(file.name, pose, labelled.notes))
    return outcomes, searched


def outcome(name: str, pose: TargetPose | StcalError, notes: tuple[str, ...]) -> MeasuredImage | Skipped:
    if isinstance(pose, StcalError):
        return Skipped(name, str(pose).removeprefix(f"{name}: "), "pose")
    return MeasuredImage(name, pose, notes)


def result_of(found: Sequence[MeasuredImage | Skipped], target: TargetCircles, options, prior) -> MeasureResult:
    measured = tuple(image for image in found if isinstance(image, MeasuredImage))
    left_out = tuple(image for image in found if isinstance(image, Skipped))
    factor = target.sigma_factor if options.pose.sigma_factor is None else options.pose.sigma_factor
    common = common_errors([image.pose for image in measured], target, prior)
    return MeasureResult(measured, left_out, target.notes, factor, prior is None, common)
