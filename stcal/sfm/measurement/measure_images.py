"""Measurement of camera_from_target with a calibrated target: image by image, in folders, and from image to image."""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
from scipy.special import chdtri
from threadpoolctl import ThreadpoolController

from stcal.boards.finders import why_unseen
from stcal.boards.target_file import target_of
from stcal.design import BoardDesign, TargetDesign
from stcal.errors import DetectionError, InputError, StcalError
from stcal.explain import Candidate, explain
from stcal.geometry.arrays import Brief, frozen, require_arguments, require_fields
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid, align_rigid
from stcal.io.cameras.camera_model import CameraModel, CameraPrior
from stcal.io.cameras.read import camera_model, read_camera
from stcal.io.images import ImageFile, Skipped, find_images, grey_8bit, grey_fine, require_grey, run_on_images
from stcal.labels import Label
from stcal.parallel import Progress, counted, one_thread, scratch_folder
from stcal.sfm.adjust.faces_file import TargetCircles, read_target
from stcal.sfm.data.group_model import ImageObservations, by_group, rows_by
from stcal.sfm.data.patterns import MAX_TILT_RAD, patterns_of
from stcal.sfm.detect import predict
from stcal.sfm.detect.candidates import EllipseOptions
from stcal.sfm.detect.defocus import correct_defocus
from stcal.sfm.detect.detect_files import copy_of, detect_files, load_image, sized_by
from stcal.sfm.detect.image import detect_target
from stcal.sfm.detect.labelling import LabelledImage, label_single, labelled_image, without_defocus
from stcal.sfm.measurement.pose import (
    FAILED,
    MIN_CIRCLES,
    PoseOptions,
    TargetPose,
    common_errors,
    fit_verdict,
    measured_pose,
    resolved,
)

MIN_SHARE = 0.5  # of the expected circles, near their predicted places; with fewer, the whole image is searched
MIN_FOUND = 6  # least number of circles found: as many as identify a face
MAX_TRIED_TILT_RAD = np.radians(80.0)
"""Largest predicted tilt of the circles that are looked for. Up to it, a face may be found by its pattern; circles
beyond 70° are not reported as missed."""


class Tracker:
    """Tracks a calibrated target through consecutive images, such as those of a live camera.

    The pose is predicted from the poses of the last two images, at constant motion. The common shift of the circles
    from there is found in a reduced image. Every circle is then measured at its shifted place, with its whole rim, as
    in a single image. If too few are found, or the fit fails, the target is searched for in the whole image. Both ways
    measure the same circles. Their centres differ by a part of their σ, since the band of pixels lies about another
    start. A target with printed faces is searched for in each whole image. The previous pose affects a pose only by
    the choice between two solutions that fit equally well.

    Parameters
    ----------
    target : Calibrated target with its design: :meth:`stcal.sfm.RunResult.circles`, or :func:`stcal.sfm.read_target`.
    camera : Camera from :func:`stcal.load_camera`, or of the run: ``result.refined_camera or result.camera``. Its
        covariance, if any, is part of the poses' covariances.
    board : A dot board that may be in view, so that its dots are not taken for circles of the target.
    pose : The defaults if None.
    ellipses : Options of the search; the defaults if None.

    Attributes
    ----------
    notes : Circles of the last image that were left out, with reasons.
    searched : Whether the last image was searched as a whole.
    recent : camera_from_target of the last one or two images, from which the next is predicted; empty before the first
        image and after a cut. Another tracker of the same target continues the sequence if its ``recent`` is set to
        them.

    Raises
    ------
    InputError : If the target has no design.
    """

    def __init__(
        self,
        target: TargetCircles,
        camera: Camera | CameraModel,
        board: BoardDesign | None = None,
        pose: PoseOptions | None = None,
        ellipses: EllipseOptions | None = None,
    ):
        if not isinstance(target, TargetCircles) or target.design is None:
            what = "circles without a design" if isinstance(target, TargetCircles) else type(target).__name__
            remedy = "give result.circles() of a run, or the circles that stcal.sfm.read_target reads"
            raise InputError("E-FACES-DESIGN", f"target: {what}; {remedy}")
        self.target, self.design, self.board = target, target.design, board
        camera = camera_model(camera)
        self.model, self.pose_options, self.ellipses = camera, pose or PoseOptions(), ellipses or EllipseOptions()
        self.prior = None if camera.covariance is None else CameraPrior(camera.colmap_model, camera.covariance)
        self.camera: Camera | None = None
        self.notes: tuple[str, ...] = ()
        self.searched = False
        planes = [face for face in self.design.faces if face.id in target.target_from_plane]
        self._planes = {face.id: align_rigid(*target.of_face(face)) for face in planes}
        self._patterns = patterns_of(self.design, None)
        self.recent: tuple[Rigid, ...] = ()
        self._threads = ThreadpoolController()  # looked up once: it takes 2 ms

    def forget(self) -> None:
        """Makes the tracker search the next image as a whole, as after a cut."""
        self.recent = ()

    def locate(self, image: np.ndarray, name: str = "image") -> TargetPose:
        """Returns camera_from_target in the next image.

        Parameters
        ----------
        image : (height, width) grey values of the unprocessed image, uint8 or uint16.
        name : Name of the image, for messages.

        Returns
        -------
        TargetPose : Pose in mm, with its (6, 6) covariance in rad and mm, left perturbation in the camera frame.

        Raises
        ------
        InputError : If the image is not grey, or not of the camera's size.
        DetectionError : If no face of the target is seen.
        StcalError : If the circles give no pose. The next image is then searched as a whole.
        """
        with self._threads.limit(limits=1):
            labelled, pose = self.observe(image, name)
        self.notes = labelled.notes
        if isinstance(pose, StcalError):
            raise pose
        return pose

    def observe(self, image: np.ndarray, name: str = "image") -> tuple[LabelledImage, TargetPose | StcalError]:
        """Returns the labelled circles of the next image, and its pose or the error; see :meth:`locate`."""
        require_grey(image, None, name)
        if self.camera is None:
            height, width = image.shape
            if not (self.model.width and self.model.height):
                self.model.require_inside(width, height, name)
            self.camera = self.model.sized(width, height)
        camera = self.camera
        require_grey(image, (camera.width, camera.height), name)
        followed = self._follow(image, camera, name) if self.recent and not self.design.has_printed else None
        self.searched = followed is None
        if followed is None:
            detection = detect_target(image, camera, self.design, self.board, self.ellipses)
            labelled = label_single(name, "", detection, self.design)
            followed = labelled, self._pose(labelled.observations, camera)
        labelled, pose = followed
        if isinstance(pose, StcalError):
            self.forget()
            return labelled, pose
        if self.recent:
            pose = resolved(pose, self.recent[-1])
        one_before = () if self.searched else self.recent[-1:]  # no motion is known across a search
        self.recent = (*one_before, pose.camera_from_target) if pose.status != "ambiguous" else ()
        return labelled, pose

    def _follow(
        self, image: np.ndarray, camera: Camera, name: str
    ) -> tuple[LabelledImage, TargetPose | StcalError] | None:
        """Returns circles and pose near the predicted place, or None if the target is not there."""
        last = self.recent[-1]
        expected = last @ self.recent[0].inverse() @ last if len(self.recent) == 2 else last
        predicted = self._predicted(expected, camera, (), MAX_TRIED_TILT_RAD)
        if len(predicted.labels) < MIN_FOUND:
            return None
        predicted = predicted.shifted(predict.common_shift(grey_8bit(image), predicted))
        labels, centres = predict.measure_near(grey_fine(image), camera, predicted)
        if len(labels) < max(MIN_FOUND, MIN_SHARE * len(predicted.labels)):
            return None
        labelled = labelled_image(name, "", labels, centres, ())
        pose = self._pose(labelled.observations, camera)
        if isinstance(pose, StcalError):
            return None
        first, labelled = labelled, self._completed(image, camera, labelled, pose)
        if labelled.observations is not first.observations:
            pose = self._pose(labelled.observations, camera)
        return None if isinstance(pose, StcalError) or fit_verdict(pose) == "failed" else (labelled, pose)

    def _completed(self, image: np.ndarray, camera: Camera, seen: LabelledImage, pose: TargetPose) -> LabelledImage:
        """Adds the circles that the first pose puts into view, and removes those that contradict it."""
        labels, pose_now = seen.observations.labels, pose.camera_from_target
        near = self._predicted(pose_now, camera, labels, MAX_TRIED_TILT_RAD)
        seen = seen.without(predict.contradictions(near, seen.observations, camera))
        predicted = self._predicted(pose_now, camera, labels, MAX_TILT_RAD)
        if not predicted.wanted.any():
            return seen
        measured = predict.measure_predicted(image, camera, predicted, self.ellipses)
        missed = predict.notes_by_plane(measured.missed, predict.MISSED)
        if not measured.labels:
            return replace(seen, notes=(*seen.notes, *missed))
        return seen.plus(measured.labels, measured.centres, missed)

    def _predicted(
        self, pose: Rigid, camera: Camera, seen: Sequence[Label], max_tilt_rad: float
    ) -> predict.PredictedCircles:
        return predict.predict_circles(pose, self._planes, seen, self._patterns, camera, max_tilt_rad)

    def _pose(self, seen: ImageObservations, camera: Camera) -> TargetPose | StcalError:
        sharp = correct_defocus([seen], camera, self._patterns)[0][0]
        return measured_pose(sharp, camera, self.target, self.pose_options, self.prior)


MOST_TRIED = 5  # largest number of images, those of most circles, in which mistakes in the camera file are looked for


@dataclass(frozen=True, slots=True)
class MeasureOptions:
    """Options of :func:`measure`.

    ``pose`` : of the pose of a single image; ``previous`` : whether an ambiguous pose is decided by that of the image
    before, by name and in the same folder; ``sequence`` : whether the images of each folder follow each other, by name:
    the target is then looked for at its predicted place, and in the whole image only if it is not there, as by
    :class:`stcal.sfm.Tracker`, and an ambiguous pose is decided by the one before; ``ellipses`` : options of detection;
    ``workers`` : number of processes; one per core if None.
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
    mistakes: tuple[str, ...] = ()  # in the camera file, each of which explains why poses do not fit

    def __post_init__(self):
        object.__setattr__(self, "common", frozen(self.common, (len(self.images), 6, None), "common errors"))

    def remedy(self, otherwise: str) -> str:
        """Returns what to correct where poses do not fit: the camera file, if that explains it."""
        return f"{' or '.join(self.mistakes)}; give that of these images" if self.mistakes else otherwise


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
    images : Folder of photographs, with its subfolders.
    camera : Camera from :func:`stcal.load_camera`, its file, or of the run: ``result.refined_camera or result.camera``.
        Its covariance, if any, is part of the poses' covariances.
    target : Circles of the target, target frame, mm; see :func:`read_target`; or the ``faces.json`` of a run.
    design : Design with radii and polarity, for detection and labels, or its ``target.toml``; that of the circles, or
        the reference design, if None.
    board : A dot board that may be in view, so that its dots are not taken for circles of the target.
    options : The defaults if None.
    progress : Called with (stage, done, total).

    Returns
    -------
    MeasureResult : camera_from_target of every image that has a pose, mm, with (6, 6) covariances in rad and mm, left
        perturbation in the camera frame; and the images left out, with reasons.

    Raises
    ------
    InputError : If no image is usable, or the camera file does not belong to the images.
    DetectionError : If no image shows a face.
    """
    options, progress = options or MeasureOptions(), progress or (lambda *_: None)
    design = target_of(target.design if design is None and isinstance(target, TargetCircles) else design)
    target = read_target(target, design) if isinstance(target, str | Path) else target
    camera = read_camera(camera) if isinstance(camera, str | Path) else camera_model(camera)
    prior = None if camera.covariance is None else CameraPrior(camera.colmap_model, camera.covariance)
    files, unreadable = find_images(images)
    step = counted(progress, "detect", len(files))
    if options.sequence:
        outcomes, searched = _followed(files, camera, replace(target, design=design), board, options, step)
        result = replace(_result_of(outcomes, target, options, prior), searched=searched)
        skipped, shown = (), True
    else:
        with scratch_folder("measure") as cache:
            inputs = files, camera, design, board, options.ellipses, cache, options.workers, step, detect_target
            detection = detect_files(*inputs, forms=False, pictures=False)
        labelled = [label_single(i.file.name, i.file.group, i.detection, design) for i in detection.images]
        labelled = without_defocus(labelled, detection.camera, patterns_of(design, None))
        result = measure_labelled(labelled, detection.camera, target, options, prior)
        skipped, shown = detection.skipped, any(len(image.observations) for image in labelled)
    result = replace(result, left_out=(*unreadable, *skipped, *result.left_out))
    if not result.images:
        last = result.left_out[-1]
        printed = design.with_faces(printed=True).faces
        if printed and not shown:
            raise DetectionError("E-TARGET-UNSEEN", why_unseen(files, printed))
        remedy = result.remedy("check target.toml (radii, polarity), camera file, faces.json and the exposure")
        fault = f"no face of the target measured in {len(files)} images, first {last.name}: {last.reason}"
        raise DetectionError("E-MEASURE-NONE", f"{fault}; {remedy}")
    return result


def measure_labelled(
    images: Sequence[LabelledImage],
    camera: Camera,
    target: TargetCircles,
    options: MeasureOptions | None = None,
    prior: CameraPrior | None = None,  # covariance of the intrinsics, which are exact if None
) -> MeasureResult:
    """Returns the poses from labelled centres, without pixels."""
    options = options or MeasureOptions()
    outcomes: list[MeasuredImage | Skipped] = []
    notes = {image.observations.name: image.notes for image in images}
    for group in by_group([image.observations for image in images]).values():
        before: TargetPose | None = None
        for image in sorted(group, key=lambda observation: observation.name):
            pose = measured_pose(image, camera, target, options.pose, prior)
            if options.previous and before is not None and isinstance(pose, TargetPose):
                pose = resolved(pose, before.camera_from_target)
            outcomes.append(_outcome(image.name, pose, notes[image.name]))
            before = pose if isinstance(pose, TargetPose) and pose.status != "ambiguous" else None
    result = _result_of(outcomes, target, options, prior)
    shown = [image.observations for image in images if len(image.observations) >= MIN_CIRCLES]
    if 2 * sum(fit_verdict(image.pose) != "failed" for image in result.images) >= len(shown):
        return result
    return replace(result, mistakes=_mistakes(sorted(shown, key=len)[-MOST_TRIED:], camera, target, options.pose))


def _mistakes(
    images: Sequence[ImageObservations], camera: Camera, target: TargetCircles, options: PoseOptions
) -> tuple[str, ...]:
    """Returns the mistakes in the camera file without which most of the images pass the test of their fit."""

    def misfit(own: Camera) -> float:
        poses = [measured_pose(image, own, target, options) for image in images]
        passed = [p.chi2 / chdtri(p.redundancy, FAILED) if isinstance(p, TargetPose) else np.inf for p in poses]
        return float(np.median(passed))

    def times(k: float) -> Camera:
        return replace(camera, focal=k * camera.focal, centre=k * (camera.centre + 0.5) - 0.5)

    middle = np.array([camera.width - 1, camera.height - 1]) / 2
    whole, other = "the camera file is of whole images, and these are cut out of them", not camera.fisheye
    kind = "fisheye" if other else "perspective"
    lens = camera.width, camera.height, camera.focal, camera.centre, camera.distortion
    candidates = [
        Candidate(whole, lambda: replace(camera, centre=middle)),
        Candidate(f"the camera file is of a {kind} lens", lambda: Camera(*lens, other), 1),
        Candidate("the distortion of the camera file is wrong", lambda: replace(camera, distortion=np.zeros(8)), 1),
        *(Candidate(f"the camera file is of images {1 / k:g} times as wide", partial(times, k), 2) for k in (0.5, 2.0)),
    ]
    return tuple(each.words for each, _ in explain(candidates, misfit, 1.0))


def measured_by(tracker: Tracker, image: np.ndarray, name: str) -> tuple[MeasureResult, np.ndarray]:
    """Returns the result of one image, and the centres (n, 2) in it, px."""
    outcome, centre_px = _observed(tracker, image, name)
    return _result_of([outcome], tracker.target, MeasureOptions(tracker.pose_options), tracker.prior), centre_px


def _followed(
    files: Sequence[ImageFile], model: CameraModel, target, board, options, step: Callable[[object], None]
) -> tuple[list[MeasuredImage | Skipped], int]:
    """Returns the outcomes of all folders, each a sequence in order of name, and the number of images searched."""
    camera, size_from = sized_by(model, list(files))
    setting = target, replace(model, width=camera.width, height=camera.height), board, options.pose, options.ellipses
    ordered = sorted(files, key=lambda each: each.name)
    folders = rows_by(file.group for file in ordered)
    jobs = [([ordered[i] for i in own], setting, camera, size_from) for own in folders.values()]
    followed: dict[int, tuple[list[MeasuredImage | Skipped], int]] = {}
    for i, found in run_on_images(_follow_folder, jobs, options.workers):
        followed[i] = found
        for file in jobs[i][0]:
            step(file.name)
    return [each for i in range(len(jobs)) for each in followed[i][0]], sum(own for _, own in followed.values())


def _follow_folder(
    files: Sequence[ImageFile], setting: tuple, camera: Camera, size_from: str
) -> tuple[list[MeasuredImage | Skipped], int]:
    tracker, searched = Tracker(*setting), 0
    outcomes: list[MeasuredImage | Skipped] = []
    name_of_digest: dict[str, str] = {}
    for file in files:
        outcome = load_image(file, camera, size_from)
        if not isinstance(outcome, Skipped):
            data, image = outcome
            first = name_of_digest.setdefault(hashlib.sha256(data).hexdigest(), file.name)
            if first == file.name:
                outcome, _ = _observed(tracker, image, file.name)
                searched += tracker.searched
            else:
                outcome = copy_of(file, first)
        outcomes.append(outcome)
    return outcomes, searched


def _observed(tracker: Tracker, image: np.ndarray, name: str) -> tuple[MeasuredImage | Skipped, np.ndarray]:
    """Returns the outcome of one image, and the centres (n, 2) in it, px."""
    try:
        labelled, pose = tracker.observe(image, name)
    except InputError:
        raise
    except StcalError as error:  # such as a distortion that cannot be inverted: the next image may do
        return Skipped(name, str(error), "distortion"), np.zeros((0, 2))
    return _outcome(name, pose, labelled.notes), labelled.observations.centre_px


def _outcome(name: str, pose: TargetPose | StcalError, notes: tuple[str, ...]) -> MeasuredImage | Skipped:
    if isinstance(pose, StcalError):
        return Skipped(name, str(pose).removeprefix(f"{name}: "), "pose")
    return MeasuredImage(name, pose, notes)


def _result_of(found: Sequence[MeasuredImage | Skipped], target: TargetCircles, options, prior) -> MeasureResult:
    measured = tuple(image for image in found if isinstance(image, MeasuredImage))
    left_out = tuple(image for image in found if isinstance(image, Skipped))
    factor = target.sigma_factor if options.pose.sigma_factor is None else options.pose.sigma_factor
    common = common_errors([image.pose for image in measured], target, prior)
    return MeasureResult(measured, left_out, target.notes, factor, prior is None, common)
