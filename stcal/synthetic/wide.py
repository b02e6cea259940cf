"""Scene seen by an equidistant wide-angle lens whose axis points past the target."""

from dataclasses import replace

import numpy as np

from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid
from stcal.io.cameras.model import CalibratedCamera
from stcal.synthetic.scene import Scene, SceneOptions

PLACED_FOCAL = 0.39
"""Focal length, in image widths, of the perspective lens by which views are placed: 104° across."""
DISTORTION = (0.02, -0.008, 0.0, 0.0, 0.001, -0.0003, 0.0, 0.0)
PAST = (0.42, 0.24)
"""Largest turn of the axis away from the target, to either side and up or down, as a share of half the field."""


def wide_options(options: SceneOptions) -> SceneOptions:
    """Returns the options by which the views are placed."""
    return replace(options, focal_px=PLACED_FOCAL * options.width)


def seen_wide(scene: Scene, field_deg: float, seed: int) -> Scene:
    """Returns the scene with turned cameras whose lens covers ``field_deg`` over the image's diagonal.

    Target, boards and camera centres stay the same. The camera model is COLMAP's OPENCV_FISHEYE.

    Parameters
    ----------
    scene : Scene
        Scene made with :func:`wide_options`.
    field_deg : float
        Field of view over the diagonal, without distortion.
    seed : int
        Seed of the random turns.
    """
    original, rng = scene.camera, np.random.default_rng([seed, 9])
    half = np.radians(field_deg) / 2
    focal = np.hypot(original.width, original.height) / 2 / half
    camera = Camera(
        original.width, original.height, np.array([focal, focal]), original.centre, np.array(DISTORTION), True
    )
    groups = {}
    for name, group in scene.groups.items():
        angles = rng.uniform(-1, 1, (len(group.camera_from_target), 2)) * half * PAST
        turns = [Rigid.exp([up, aside, 0, 0, 0, 0]) for aside, up in angles]
        views = tuple(turn @ pose for turn, pose in zip(turns, group.camera_from_target, strict=True))
        groups[name] = replace(group, camera_from_target=views)
    return replace(scene, camera=CalibratedCamera.of(camera, "OPENCV_FISHEYE"), groups=groups)
