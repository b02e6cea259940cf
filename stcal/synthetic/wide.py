"""A made scene as an equidistant lens sees it, which looks past the target."""

from dataclasses import replace

import numpy as np

from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid
from stcal.io.cameras.model import CalibratedCamera
from stcal.synthetic.scene import Scene, SceneOptions

PLACED_FOCAL = 0.39
"""In widths, of the perspective lens by which views are placed: 104° across."""
DISTORTION = (0.02, -0.008, 0.0, 0.0, 0.001, -0.0003, 0.0, 0.0)
PAST = (0.42, 0.24)
"""Of half the field: how far the axis is turned away from the target to either side, and up or down."""


def wide_options(options: SceneOptions) -> SceneOptions:
    """To place the views by."""
    return replace(options, focal_px=PLACED_FOCAL * options.width)


def seen_wide(scene: Scene, field_deg: float, seed: int) -> Scene:
    """The same target, boards and places of the camera, which is turned, with a lens of ``field_deg`` over the image's
    diagonal (COLMAP's OPENCV_FISHEYE).

    Parameters
    ----------
    scene : Scene
        Made with :func:`wide_options`.
    field_deg : float
        Over the diagonal, without distortion.
    seed : int
        Of the turns.
    """
    own, rng = scene.camera, np.random.default_rng([seed, 9])
    half = np.radians(field_deg) / 2
    focal = np.hypot(own.width, own.height) / 2 / half
    camera = Camera(own.width, own.height, np.array([focal, focal]), own.centre, np.array(DISTORTION), True)
    groups = {}
    for name, group in scene.groups.items():
        away = rng.uniform(-1, 1, (len(group.camera_from_target), 2)) * half * PAST
        turns = [Rigid.exp([up, aside, 0, 0, 0, 0]) for aside, up in away]
        views = tuple(turn @ pose for turn, pose in zip(turns, group.camera_from_target, strict=True))
        groups[name] = replace(group, camera_from_target=views)
    return replace(scene, camera=CalibratedCamera.of(camera, "OPENCV_FISHEYE"), groups=groups)
