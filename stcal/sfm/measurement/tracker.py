"""Tracker of a calibrated target from image to image, which measures circles at their predicted places."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from threadpoolctl import ThreadpoolController

from stcal.design import BoardDesign
from stcal.errors import InputError, StcalError
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid, align_rigid
from stcal.io.cameras.model import CameraModel, CameraPrior
from stcal.io.cameras.read import camera_model
from stcal.io.images import grey_8bit, grey_fine, require_grey
from stcal.labels import Label
from stcal.sfm.data.model import ImageObservations
from stcal.sfm.data.patterns import MAX_TILT_RAD, patterns_of
from stcal.sfm.detect.circles.candidates import EllipseOptions
from stcal.sfm.detect.defocus import correct_defocus
from stcal.sfm.detect.group_geometry import Arrangement
from stcal.sfm.detect.image import detect_target
from stcal.sfm.detect.labels import LabelledImage, label_single, labelled_image
from stcal.sfm.detect.predict import (
    PredictedCircles,
    common_shift,
    contradicted_notes,
    contradictions,
    measure_near,
    measure_predicted,
    missed_notes,
    predict_circles,
)
from stcal.sfm.measurement.known_target import TargetCircles
from stcal.sfm.measurement.pose import PoseOptions, TargetPose, fit_verdict, measured_pose, resolved

MIN_SHARE = 0.5
"""Least share of the expected circles that must be found near their predicted places. With fewer, the whole image is
searched."""
MIN_FOUND = 6
"""Least number of circles found: as many as identify a face."""
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
    target : TargetCircles
        Calibrated target with its design: :meth:`stcal.sfm.RunResult.circles`, or :func:`stcal.sfm.read_target`.
    camera : Camera
        Camera from :func:`stcal.load_camera`, or of the run: ``result.refined_camera or result.camera``. Its
        covariance, if any, is part of the poses' covariances.
    board : BoardDesign, optional
        A dot board that may be in view, so that its dots are not taken for circles of the target.
    pose : PoseOptions, optional
        The defaults if None.
    ellipses : EllipseOptions, optional
        Options of the search; the defaults if None.

    Attributes
    ----------
    notes : tuple of str
        Circles of the last image that were left out, with reasons.
    searched : bool
        Whether the last image was searched as a whole.
    recent : tuple of Rigid
        camera_from_target of the last one or two images, from which the next is predicted; empty before the first image
        and after a cut. Another tracker of the same target continues the sequence if its ``recent`` is set to them.

    Raises
    ------
    InputError
        If the target has no design.
    """

    def __init__(
        self,
        target: TargetCircles,
        camera: Camera | CameraModel,
        board: BoardDesign | None = None,
        pose: PoseOptions | None = None,
        ellipses: EllipseOptions | None = None,
    ):
        if not isinstance(target, TargetCircles):
            raise InputError(
                "E-FACES-DESIGN",
                f"target: {type(target).__name__}; give the circles of a run, result.circles(), or those that "
                "stcal.sfm.read_target reads",
            )
        if target.design is None:
            raise InputError("E-FACES-DESIGN", "target: circles without a design; read it with stcal.sfm.read_target")
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
        image : (height, width) array, uint8 or uint16
            Grey values of the unprocessed image.
        name : str
            Name of the image, for messages.

        Returns
        -------
        TargetPose
            Pose in mm, with its (6, 6) covariance in rad and mm, left perturbation in the camera frame.

        Raises
        ------
        InputError
            If the image is not grey, or not of the camera's size.
        DetectionError
            If no face of the target is seen.
        StcalError
            If the circles give no pose. The next image is then searched as a whole.
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
        predicted = predicted.shifted(common_shift(grey_8bit(image), predicted))
        labels, centres = measure_near(grey_fine(image), camera, predicted)
        if len(labels) < max(MIN_FOUND, MIN_SHARE * len(predicted.labels)):
            return None
        labelled = labelled_image(name, "", labels, centres, ())
        pose = self._pose(labelled.observations, camera)
        if isinstance(pose, StcalError):
            return None
        first, labelled = labelled, self._completed(image, camera, labelled, pose)
        if labelled.observations is not first.observations:
            pose = self._pose(labelled.observations, camera)
        if isinstance(pose, StcalError) or fit_verdict(pose) == "failed":
            return None
        return labelled, pose

    def _completed(self, image: np.ndarray, camera: Camera, seen: LabelledImage, pose: TargetPose) -> LabelledImage:
        """Adds the circles that the first pose puts into view, and removes those that contradict it."""
        labels, pose_now = seen.observations.labels, pose.camera_from_target
        wrong = contradictions(self._predicted(pose_now, camera, labels, MAX_TRIED_TILT_RAD), seen.observations, camera)
        seen = seen.without(wrong, contradicted_notes(wrong))
        predicted = self._predicted(pose_now, camera, labels, MAX_TILT_RAD)
        if not predicted.wanted.any():
            return seen
        measured = measure_predicted(image, camera, predicted, self.ellipses)
        missed = missed_notes(measured.missed)
        if not measured.labels:
            return replace(seen, notes=(*seen.notes, *missed))
        return seen.plus(measured.labels, measured.centres, missed)

    def _predicted(self, pose: Rigid, camera: Camera, seen: Sequence[Label], max_tilt_rad: float) -> PredictedCircles:
        arrangement = Arrangement(self._planes, {0: pose}, {})
        predicted = predict_circles(arrangement, 0, seen, self.design, None, camera, max_tilt_rad)
        assert predicted is not None  # the arrangement has this image
        return predicted

    def _pose(self, seen: ImageObservations, camera: Camera) -> TargetPose | StcalError:
        sharp = correct_defocus([seen], camera, self._patterns)[0][0]
        return measured_pose(sharp, camera, self.target, self.pose_options, self.prior)
