"""Whether the poses of ``stcal-sfm measure`` and their covariances are true: labels simulated with noise, every image
with a calibrated target of its own, drawn from the covariance that a calibration gives it.

.venv/bin/python scripts/studies/measure_study.py [--images 500]

Prints for every case the mean of eᵀC⁻¹e/6 of the certain poses, whose expectation is 1, their σ (RMS along and across
the line of sight, and of the rotation), how many images are ambiguous, how many of the given poses are flipped, how
many of those are called certain, and the time of one pose.
"""

import time
from dataclasses import dataclass

import numpy as np

from scripts.runner import options_of
from stcal.geometry.camera import intrinsic_basis
from stcal.io.cameras.model import CameraPrior
from stcal.parallel import one_thread
from stcal.sfm.data.model import ImageObservations
from stcal.sfm.measurement.pose import TargetPose, pose_from_circles
from stcal.synthetic.scene import Scene, SceneOptions, make_scene
from stcal.workflows.cluster import executor_of
from tests.support.image_poses import (
    KnownTarget,
    face_view,
    faces_view,
    is_flipped,
    known_target,
    pose_error,
    see,
    view,
)

CALIBRATION_NOISE_PX = 0.02
CAMERA_SIGMA = np.array([1.0, 1.0, 0.7, 0.7, 3e-4, 1e-3, 3e-5, 3e-5])
"""σ of fx, fy, cx, cy (px), k1, k2, p1, p2 where the camera file states them."""


@dataclass(frozen=True)
class Case:
    """``faces`` : sets of faces in turn; ``tilt_deg``, ``distance_mm`` : ranges; ``camera`` : intrinsics are drawn."""

    title: str
    faces: tuple[tuple[str, ...], ...]
    noise_px: float
    tilt_deg: tuple[float, float] = (0, 65)
    distance_mm: tuple[float, float] = (600, 1500)
    camera: bool = False


ONE = tuple((face,) for face in "12345")
CASES = (
    Case("one face", ONE, 0.02),
    Case("one face, 0.1 px noise", ONE, 0.1),
    Case("one face, σ of the camera file", ONE, 0.02, camera=True),
    Case("two faces", (("1", "2"), ("1", "4"), ("1", "5"), ("2", "3")), 0.02, (0, 25)),
    Case("three faces", (("1", "4", "5"), ("1", "2", "5")), 0.02, (0, 10)),
    Case("one face, frontal, 0.1 px", ONE, 0.1, (0, 5)),
    Case("one face, to 4 m, 0.3 px", ONE, 0.3, (0, 65), (600, 4000)),
    Case("one face, frontal, to 6 m, 0.5 px", ONE, 0.5, (0, 10), (1500, 6000)),
)


def one_image(case: Case, i: int, scene: Scene, known: KnownTarget) -> tuple[TargetPose, np.ndarray, float, bool]:
    """Pose, its error, seconds, and whether it is the flipped one."""
    rng = np.random.default_rng([i, len(case.title)])
    faces = case.faces[i % len(case.faces)]
    target, camera, prior = known.measured(rng), scene.camera, None
    if case.camera:
        prior = CameraPrior(scene.camera.colmap_model, np.diag(CAMERA_SIGMA**2))
        away = intrinsic_basis(scene.camera.colmap_model) @ (CAMERA_SIGMA * rng.standard_normal(len(CAMERA_SIGMA)))
        camera = camera.with_parameters(camera.parameters() + away)
    towards = face_view(scene, faces[0]) if len(faces) == 1 else faces_view(scene, faces)
    image: ImageObservations | None = None
    while image is None or len(image) < 8 * len(faces):
        tilt, distance = np.radians(rng.uniform(*case.tilt_deg)), rng.uniform(*case.distance_mm)
        truth = view(towards, tilt, distance, rng)
        image = see(scene, truth, faces, case.noise_px, rng)
    start = time.process_time()
    pose = pose_from_circles(image.labels, image.centre_px, image.covariance_px2, target, camera, prior=prior)
    seconds = time.process_time() - start
    return pose, pose_error(pose.camera_from_target, truth), seconds, is_flipped(pose, truth, towards)


def rows_of(case: Case, images: range) -> list[tuple]:
    """What the table needs of each image."""
    scene = make_scene(SceneOptions(seed=5, width=2592, height=1728, images_per_group=6))
    known = known_target(scene, CALIBRATION_NOISE_PX)
    rows = []
    for i in images:
        pose, error, seconds, flipped = one_image(case, i, scene, known)
        square = float(error @ np.linalg.solve(pose.covariance, error) / 6)
        variance = np.diag(pose.covariance)
        sigma = (variance[5], variance[3:5].mean(), variance[:3].mean())
        rows.append((square, pose.status == "certain", flipped, seconds, *sigma))
    return rows


@one_thread()
def main() -> None:
    """Print the table."""
    given = options_of(__doc__, images=500, scheduler=str)
    count = given.images
    print(f"{count} simulated images each, 2592×1728 px, 24 mm lens; 600–1500 mm and 0–65° where nothing else is said")
    print(
        f"{'':34} normalised       σ along  across, µm  rotation          flipped,  median\n"
        f"{'':34} squared error      (RMS of certain)     mdeg  ambiguous  certain      ms"
    )
    for case in CASES:
        parts = [range(k * count // 8, (k + 1) * count // 8) for k in range(8)]
        with executor_of(given.scheduler) as pool:
            rows = np.array([r for part in pool.map(rows_of, [case] * 8, parts) for r in part])
        certain, flipped = rows[:, 1] > 0, rows[:, 2] > 0
        square = rows[certain, 0]
        along, across, turn = np.sqrt(rows[certain, 4:].mean(0))
        print(
            f"{case.title:34} {square.mean():.3f} ± {square.std() / np.sqrt(len(square)):.3f}   {1e3 * along:7.1f} "
            f"{1e3 * across:8.1f} {1e3 * np.degrees(turn):11.2f} {100 * (~certain).mean():8.1f} % "
            f"{flipped.sum():4d} {(flipped & certain).sum():4d} {1e3 * np.median(rows[:, 3]):8.2f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
