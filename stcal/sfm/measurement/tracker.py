"""A calibrated target followed from image to image: its circles are measured where the poses before put them."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from threadpoolctl import ThreadpoolController

from stcal.design import BoardDesign, TargetDesign
from stcal.errors import InputError, StcalError
from stcal.geometry.align import align_rigid
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid
from stcal.io.cameras.model import CameraModel, CameraPrior
from stcal.io.images import grey_8bit, grey_fine
from stcal.labels import Label
from stcal.sfm.data.model import ImageObservations
from stcal.sfm.data.patterns import MAX_TILT_RAD, patterns_of
from stcal.sfm.detect.circles.candidates import EllipseOptions
from stcal.sfm.detect.defocus import correct_defocus
from stcal.sfm.detect.group_geometry import Arrangement
from stcal.sfm.detect.image import detect_image
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
from stcal.sfm.measurement.pose import PoseOptions, TargetPose, fit_verdict, measured_pose, resolved
from stcal.sfm.measurement.target import TargetCircles

MIN_SHARE = 0.5
"""Of the circles that should be in view, found near their predicted places at least; with fewer the target is searched
for in the whole image, as if it had not been seen before."""
MIN_FOUND = 6
"""As many as name a face."""
MAX_TRIED_TILT_RAD = np.radians(80.0)
"""A face seen so obliquely may be found by its pattern; beyond 70° none is missed that is not."""


class Tracker:
    """Poses of a calibrated target in images that follow each other, as those of a live camera.

    The pose is predicted from those of the two images before, at an even motion; the common shift of the circles from
    there is found in a small picture, and every circle is measured where it then must be, with its whole rim, as in a
    single image. Where too few are found, or the fit fails, the target is searched for in the whole image. Both ways
    measure the same circles; what their centres differ by, since the band of pixels lies about another start, is a part
    of their σ. A pose takes nothing else from the one before but the choice between two that fit alike.

    Parameters
    ----------
    target : TargetCircles
        The calibrated target, as :func:`stcal.sfm.read_target` gives it, with its design.
    camera : CameraModel
        As :func:`stcal.io.cameras.read.read_camera` returns it; its covariance, if it has one, goes into the poses'.
    board : BoardDesign, optional
        A dot board that may be in view, so that its dots are not taken for circles of the target.
    pose : PoseOptions, optional
        The defaults where None.
    ellipses : EllipseOptions, optional
        Of the search; the defaults where None.

    Attributes
    ----------
    notes : tuple of str
        What was seen and left out in the last image, and why.
    searched : bool
        Whether the last image was searched as a whole.
    recent : tuple of Rigid
        camera_from_target of the one or two images before, from which the next is predicted; none before the first and
        after a cut. Where they are put back, another tracker of the same target goes on.

    Raises
    ------
    InputError
        The target has no design.
    """

    def __init__(
        self,
        target: TargetCircles,
        camera: CameraModel,
        board: BoardDesign | None = None,
        pose: PoseOptions | None = None,
        ellipses: EllipseOptions | None = None,
    ):
        if target.design is None:
            raise InputError("E-FACES-DESIGN", "target: circles without a design; read it with stcal.sfm.read_target")
        self.target, self.design, self.board = target, target.design, board
        self.model, self.pose_options, self.ellipses = camera, pose or PoseOptions(), ellipses or EllipseOptions()
        self.prior = None if camera.covariance is None else CameraPrior(camera.colmap_model, camera.covariance)
        self.camera: Camera | None = None
        self.notes: tuple[str, ...] = ()
        self.searched = False
        self._planes = _target_from_face(target, self.design)
        self._patterns = patterns_of(self.design, None)
        self.recent: tuple[Rigid, ...] = ()
        self._threads = ThreadpoolController()  # looked up once: it takes 2 ms

    def forget(self) -> None:
        """Search the next image as a whole, as after a cut."""
        self.recent = ()

    def locate(self, image: np.ndarray, name: str = "image") -> TargetPose:
        """camera_from_target in the next image.

        Parameters
        ----------
        image : (height, width) array, uint8 or uint16
            Grey values, as the camera took them.
        name : str
            Of the image, for messages.

        Returns
        -------
        TargetPose
            mm, with its (6, 6) covariance in rad and mm, left perturbation in the camera frame.

        Raises
        ------
        InputError
            Not a grey image, or not of the camera's size.
        DetectionError
            No face of the target is seen.
        StcalError
            What was seen gives no pose; the next image is searched as a whole then.
        """
        with self._threads.limit(limits=1):
            seen, pose = self.observe(image, name)
        self.notes = seen.notes
        if isinstance(pose, StcalError):
            raise pose
        return pose

    def observe(self, image: np.ndarray, name: str = "image") -> tuple[LabelledImage, TargetPose | StcalError]:
        """The labelled circles of the next image, and its pose or why there is none; see :meth:`locate`."""
        camera = self._camera_of(image, name)
        found = self._follow(image, camera, name) if self.recent else None
        self.searched = found is None
        seen, pose = found or self._search(image, camera, name)
        if isinstance(pose, StcalError):
            self.forget()
            return seen, pose
        if self.recent:
            pose = resolved(pose, self.recent[-1])
        one_before = () if self.searched else self.recent[-1:]  # no motion is known across a search
        self.recent = (*one_before, pose.camera_from_target) if pose.status != "ambiguous" else ()
        return seen, pose

    def _camera_of(self, image: np.ndarray, name: str) -> Camera:
        if image.ndim != 2 or image.dtype not in (np.uint8, np.uint16):
            raise InputError(
                "E-IMAGE-TYPE", f"{name}: {image.dtype} of shape {image.shape}; a grey image of 8 or 16 bits needed"
            )
        height, width = image.shape
        if self.camera is None:
            if not (self.model.width and self.model.height):
                self.model.require_inside(width, height, name)
            self.camera = self.model.sized(width, height)
        if (width, height) != (self.camera.width, self.camera.height):
            raise InputError(
                "E-IMAGE-SIZE",
                f"{name}: {width}×{height} px, camera {self.camera.width}×{self.camera.height} px; "
                "give images as the camera took them",
            )
        return self.camera

    def _search(self, image: np.ndarray, camera: Camera, name: str) -> tuple[LabelledImage, TargetPose | StcalError]:
        detection = detect_image(image, camera, self.design, self.board, self.ellipses)
        seen = label_single(name, "", detection, self.design)
        return seen, self._pose(seen.observations, camera)

    def _follow(self, image: np.ndarray, camera: Camera, name: str) -> tuple[LabelledImage, TargetPose] | None:
        """None where the target is not near its predicted place."""
        last = self.recent[-1]
        expected = last @ self.recent[0].inverse() @ last if len(self.recent) == 2 else last
        predicted = self._predicted(expected, camera, (), MAX_TRIED_TILT_RAD)
        if len(predicted.labels) < MIN_FOUND:
            return None
        predicted = predicted.shifted(common_shift(grey_8bit(image), predicted))
        labels, centres = measure_near(grey_fine(image), camera, predicted)
        if len(labels) < max(MIN_FOUND, MIN_SHARE * len(predicted.labels)):
            return None
        seen = labelled_image(name, "", labels, centres, ())
        pose = self._pose(seen.observations, camera)
        if isinstance(pose, StcalError):
            return None
        again = self._completed(image, camera, seen, pose)
        if again.observations is not seen.observations:
            pose = self._pose(again.observations, camera)
        seen = again
        if isinstance(pose, StcalError) or fit_verdict(pose) == "failed":
            return None
        return seen, pose

    def _completed(self, image: np.ndarray, camera: Camera, seen: LabelledImage, pose: TargetPose) -> LabelledImage:
        """With what the first pose puts into view too, and without what contradicts it."""
        labels, pose_now = seen.observations.labels, pose.camera_from_target
        wrong = contradictions(self._predicted(pose_now, camera, labels, MAX_TRIED_TILT_RAD), seen.observations, camera)
        seen = seen.without(wrong, contradicted_notes(wrong))
        predicted = self._predicted(pose_now, camera, labels, MAX_TILT_RAD)
        if not predicted.wanted.any():
            return seen
        look = measure_predicted(image, camera, predicted, self.ellipses)
        if not look.labels:
            return replace(seen, notes=(*seen.notes, *missed_notes(look.missed)))
        return seen.plus(look.labels, look.centres, missed_notes(look.missed))

    def _predicted(self, pose: Rigid, camera: Camera, seen: Sequence[Label], max_tilt_rad: float) -> PredictedCircles:
        arrangement = Arrangement(self._planes, {0: pose}, {})
        predicted = predict_circles(arrangement, 0, seen, self.design, None, camera, max_tilt_rad)
        assert predicted is not None  # the arrangement has this image
        return predicted

    def _pose(self, seen: ImageObservations, camera: Camera) -> TargetPose | StcalError:
        sharp = correct_defocus([seen], camera, self._patterns)[0][0]
        return measured_pose(sharp, camera, self.target, self.pose_options, self.prior)


def _target_from_face(target: TargetCircles, design: TargetDesign) -> dict[str, Rigid]:
    """Place of each face's design amid its calibrated circles."""
    found = {}
    for face in design.faces:
        if face.id in target.target_from_plane:
            own = [i for i, label in enumerate(face.labels()) if label in target.place]
            flat = np.column_stack([face.xy_mm[own], np.zeros(len(own))])
            found[face.id] = align_rigid(target.xyz[[target.place[face.labels()[i]] for i in own]], flat)
    return found
