"""Single images of a calibrated target with known truth, as labelled centres without pixels, and a scene filmed along a
smooth path of the camera: for studies and tests."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from stcal.design import reference_target
from stcal.geometry.plane import fit_plane, mirrored
from stcal.geometry.rigid import Poses, Rigid
from stcal.labels import CircleLabel
from stcal.sfm.adjust.chain import CalibratedTarget, face_frame
from stcal.sfm.adjust.faces_file import TargetCircles
from stcal.sfm.adjust.joint import unmoved
from stcal.sfm.adjust.uncertainty import derivatives
from stcal.sfm.data.group_model import ImageObservations
from stcal.sfm.measurement.pose import TargetPose
from stcal.sfm.planning.forecast import observe, true_models
from stcal.synthetic.scene import Scene

FLATNESS_MM = 0.02  # as a run takes it by default


@dataclass(frozen=True, slots=True, eq=False)
class KnownTarget:
    """The true circles, and ``root`` : (3c, r) of the covariance that a calibration would give them."""

    truth: TargetCircles
    root: np.ndarray

    def measured(self, rng: np.random.Generator) -> TargetCircles:
        """As a calibration would have it: errors drawn from the covariance."""
        error = (self.root @ rng.standard_normal(self.root.shape[1])).reshape(-1, 3)
        t = self.truth
        return TargetCircles(t.labels, t.xyz + error, t.radius, t.covariance)


def known_target(scene: Scene, noise_px: float) -> KnownTarget:
    """The scene's target with the covariance of a calibration by its own images, centres of that noise."""
    start = CalibratedTarget(
        scene.target.faces[0].id, scene.target_from_face, scene.circles_target, dict.fromkeys(scene.groups, Rigid())
    )
    models = true_models(scene, observe(scene, noise_px, np.random.default_rng(scene.seed)))
    joint = unmoved(models, scene.board, scene.camera, FLATNESS_MM).result(1.0)
    covariance = derivatives(joint, start, scene.target, "plane").all_circles_covariance(joint.covariance_mm2)
    value, vector = np.linalg.eigh((covariance + covariance.T) / 2)
    keep = value > 1e-12 * value[-1]
    root = vector[:, keep] * np.sqrt(value[keep])
    radius = scene.target.radius_of()
    xyz = np.array([scene.circles_target[label] for label in joint.labels])
    truth = TargetCircles(joint.labels, xyz, np.array([radius[label] for label in joint.labels]), root @ root.T)
    return KnownTarget(truth, root)


def view(towards: Rigid, tilt_rad: float, distance_mm: float, rng: np.random.Generator) -> Rigid:
    """camera_from_target of a random view.

    ``towards`` : target_from_any; its origin is in the line of sight, at that distance and up to 5° off the middle of
    the image, and its Z tilted by ``tilt_rad`` from the line of sight, into any direction.
    """
    tilted = Rotation.from_euler("ZYZ", [rng.uniform(0, 2 * np.pi), tilt_rad, rng.uniform(0, 2 * np.pi)])
    off_axis = Rotation.from_rotvec([*np.radians(rng.uniform(-3.5, 3.5, 2)), 0])
    facing = np.diag([1.0, -1.0, -1.0])  # Z of what is seen points to the camera
    rotation = off_axis.as_matrix() @ facing @ tilted.as_matrix()
    return Rigid(rotation, off_axis.as_matrix()[:, 2] * distance_mm) @ towards.inverse()


def see(
    scene: Scene, camera_from_target: Rigid, faces: Sequence[str], noise_px: float, rng: np.random.Generator
) -> ImageObservations:
    """What one image shows of these faces."""
    group = replace(next(iter(scene.groups.values())), faces=tuple(faces), camera_from_target=(camera_from_target,))
    image = observe(replace(scene, groups={group.name: group}), noise_px, rng)[0]
    return image.select([i for i, label in enumerate(image.labels) if isinstance(label, CircleLabel)])


def face_view(scene: Scene, face: str) -> Rigid:
    """target_from_any amid the circles of a face, Z its normal: for :func:`view`."""
    return Rigid(scene.target_from_face[face].rotation, scene.face_circles(face).mean(0))


def faces_view(scene: Scene, faces: Sequence[str]) -> Rigid:
    """target_from_any amid several faces, Z the mean of their normals: for :func:`view`."""
    axis = np.sum([scene.target_from_face[face].rotation[:, 2] for face in faces], axis=0)
    axis = axis / np.linalg.norm(axis)
    across = np.linalg.svd(axis[None])[2][1]
    rotation = np.column_stack([across, np.cross(axis, across), axis])
    return Rigid(rotation, np.mean([scene.face_circles(face).mean(0) for face in faces], axis=0))


def pose_error(estimate: Rigid, truth: Rigid) -> np.ndarray:
    """(6,) rad and mm: the left perturbation that leads from the truth to the estimate."""
    return estimate.difference(truth)


def is_flipped(pose: TargetPose, truth: Rigid, towards: Rigid) -> bool:
    """Whether the pose is the truth's second solution, mirrored at the line of sight to ``towards``: nearer to it in
    rotation than to the truth, and off the truth by more than its own covariance explains but once in 10⁶."""
    error = pose_error(pose.camera_from_target, truth)
    if error @ np.linalg.solve(pose.covariance, error) < chi2.isf(1e-6, 6):
        return False
    second = mirrored(Poses.of([truth]), towards).rotation[0]
    off = Rigid(pose.camera_from_target.rotation @ second.T).angle_rad()
    return off < float(np.linalg.norm(error[:3]))


def true_poses(truth: dict) -> dict[str, Rigid]:
    """camera_from_target by image of a truth file; its frame is laid by the reference face's circles as a run does."""
    face = reference_target().face(truth["reference_face"])
    circles = {c: np.array(truth["circles"][f"{face.id}:{c}"]) for c in face.ids}
    frame = face_frame(face, circles, "plane", np.array([0, 0, 1.0]))
    assert fit_plane(np.array(list(circles.values()))).rms < 1e-3
    return {
        name: Rigid.from_matrix(image["camera_from_target"]) @ frame
        for group in truth["groups"].values()
        for name, image in group["images"].items()
    }


PERIOD = 50.0  # images of one swing, within a third


def filmed(
    scene: Scene, group: str, images: int, shift_mm: float = 40.0, turn_deg: float = 4.0, seed: int = 0, view: int = 0
) -> Scene:
    """The scene with one group alone, whose camera swings about its view of that number in all six degrees of freedom,
    with amplitudes ``shift_mm`` and ``turn_deg``; from image to image it moves by up to a fifth of them."""
    rng = np.random.default_rng(seed)
    period, phase = PERIOD * rng.uniform(0.67, 1.33, 6), rng.uniform(0, 2 * np.pi, 6)
    swing = np.sin(2 * np.pi * np.arange(images)[:, None] / period + phase)
    own = scene.groups[group]
    middle = own.camera_from_target[view]
    distance = float(np.linalg.norm(middle.translation))
    amplitude = np.array([np.radians(turn_deg)] * 3 + [shift_mm] * 2 + [min(shift_mm, distance / 10)])
    poses = []
    for step in swing * amplitude:
        # Turned about the target's middle, as a camera that is kept on it.
        turn = Rigid.exp([*step[:3], 0, 0, 0]).rotation
        poses.append(Rigid(turn @ middle.rotation, middle.translation + step[3:]))
    return replace(scene, groups={group: replace(own, camera_from_target=tuple(poses))})
