"""A scene filmed: images that follow each other, along a smooth path of the camera about one view."""

from dataclasses import replace

import numpy as np

from stcal.geometry.rigid import Rigid
from stcal.synthetic.scene import Scene

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
