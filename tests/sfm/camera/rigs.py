"""Simulated rigs: views of one board by several cameras at the same instants, without pixels."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.geometry.camera import Camera
from stcal.geometry.plane import circle_image_offset
from stcal.geometry.rigid import Rigid
from stcal.sfm.camera.calibrate import CameraCalibration
from stcal.sfm.camera.checks import projection_sigma
from stcal.sfm.camera.intrinsics import adjust_intrinsics, closed_form, start_camera
from stcal.sfm.data.model import ImageObservations
from tests.sfm.camera.test_intrinsics import BOARD, MIDDLE_MM, TRUE

CAMERAS = (
    (TRUE, "OPENCV"),
    (replace(TRUE, focal=[2400.0, 2400.0], centre=[1290.0, 868.0], distortion=[-0.1, *[0.0] * 7]), "SIMPLE_RADIAL"),
    (Camera(1600, 1200, [1300.0, 1300.0], [803.0, 597.0], [0.02, -0.004, *[0.0] * 6], True), "RADIAL_FISHEYE"),
)
SITS = (
    Rigid(),
    Rigid.exp([0.02, -0.15, 0.01, -90.0, 3.0, 8.0]),
    Rigid.exp([-0.1, 0.05, 0.4, 40.0, -60.0, -5.0]),
)
"""camera_from_first."""
NOISE_PX = 0.02


@dataclass(frozen=True)
class Seen:
    """``views`` by camera; ``sits`` : camera_from_first, the truth."""

    cameras: tuple[Camera, ...]
    models: tuple[str, ...]
    sits: tuple[Rigid, ...]
    views: list[list[ImageObservations]]


def seen_by_rig(rng, count: int = 2, instants: int = 14, noise_px: float = NOISE_PX) -> Seen:
    """Views named by their instants; an instant may be one camera's alone."""
    made = np.column_stack([BOARD.xy_mm(), np.zeros(63)]) + BOARD.sigma_mm * rng.standard_normal((63, 3))
    views: list[list[ImageObservations]] = [[] for _ in range(count)]
    while min(map(len, views)) < instants:
        angles = [rng.uniform(-180, 180), *rng.uniform(-35, 35, 2)]
        turn = Rotation.from_euler("zxy", angles, degrees=True).as_matrix()
        depth = rng.uniform(350, 600)
        place = np.append(rng.uniform(-0.3, 0.3, 2) * [0.9, 0.6] * depth, depth)
        first_from_board = Rigid(turn, place - turn @ MIDDLE_MM)
        name = f"{max(map(len, views)) + sum(map(len, views)):04}.png"
        for k in range(count):
            view = _view(rng, name, CAMERAS[k][0], SITS[k] @ first_from_board, made, noise_px)
            if view is not None:
                views[k].append(view)
    cameras, models = zip(*CAMERAS[:count], strict=True)
    return Seen(cameras, models, SITS[:count], views)


def _view(rng, name, camera: Camera, camera_from_board: Rigid, made, noise_px) -> ImageObservations | None:
    xyz = camera_from_board @ made
    normal = np.tile(camera_from_board.rotation[:, 2], (len(made), 1))
    xy = camera.project(circle_image_offset(xyz, normal, BOARD.radii_mm()))
    inside = ((xy > 20) & (xy < np.array([camera.width, camera.height]) - 20)).all(1)
    if inside.sum() < 30:
        return None
    labels = tuple(label for label, own in zip(BOARD.labels(), inside, strict=True) if own)
    n = len(labels)
    xy = xy[inside] + noise_px * rng.standard_normal((n, 2))
    shape, covariance = np.tile(np.eye(2), (n, 1, 1)), np.tile(noise_px**2 * np.eye(2), (n, 1, 1))
    return ImageObservations(name, ".", labels, xy, np.zeros((n, 2)), shape, covariance)


def calibrated_alone(camera: Camera, model: str, views) -> CameraCalibration:
    """As ``calibrate_camera`` ends, but for its checks."""
    start = closed_form(views, BOARD, start_camera(camera.width, camera.height, model))
    result = adjust_intrinsics(views, BOARD, start, model)
    return CameraCalibration(result, tuple(views), (), 1, projection_sigma(result), None, None, ())


def alone(seen: Seen, names=("left", "right", "wide")) -> dict[str, CameraCalibration]:
    """Each camera by itself."""
    each = zip(names, seen.cameras, seen.models, seen.views, strict=False)
    return {name: calibrated_alone(camera, model, views) for name, camera, model, views in each}
