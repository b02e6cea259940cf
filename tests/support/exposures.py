"""New exposures of a photograph, under other light."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

DARKEST = 1e-3  # least grey value, as a share of white. The photograph holds no information below.
FULL_WELL, READ_NOISE = 10_000.0, 8.0
"""Electrons of a sensor at full scale, whose shot noise is the root of their number, and read noise in electrons."""


@dataclass(frozen=True, slots=True)
class Light:
    """Light on a scene in addition to the light in its photograph; places and radii in image widths."""

    stops: float = 0.0  # gradient in powers of two per width of the image
    angle_rad: float = 0.0  # direction of the gradient
    pivot: tuple[float, float] = (0.5, 0.5)  # (x, y) at which the light is unchanged
    glare: float = 0.0  # light added in the middle of a spot, in units of the photograph's white
    glare_at: tuple[float, float] = (0.5, 0.5)
    glare_radius: float = 0.1  # of a Gaussian


def expose(
    photograph: np.ndarray, times: Sequence[float], light: Light | None = None, seed: int = 0
) -> list[np.ndarray]:
    """Exposes the scene of an 8-bit photograph (height, width) at other times; time 1 keeps its brightness.
    Saturated pixels of the photograph are taken to have the light of white. The noise of the exposures is
    independent."""
    rng, exposures = np.random.default_rng(seed), []
    # The light within one grey level is unknown. It is spread evenly, or a darker exposure would show the levels.
    grey = (photograph + rng.random(photograph.shape, np.float32)) / np.float32(256)
    scene, light = np.maximum(grey, np.float32(DARKEST)), light or Light()
    height, width = scene.shape
    x, y = np.meshgrid(np.arange(width, dtype=np.float32) / width, np.arange(height, dtype=np.float32) / width)
    if light.stops:
        towards = np.float32(np.cos(light.angle_rad)), np.float32(np.sin(light.angle_rad))
        along = (x - np.float32(light.pivot[0])) * towards[0] + (y - np.float32(light.pivot[1])) * towards[1]
        scene = scene * np.exp2(np.float32(light.stops) * along)
    if light.glare:
        squared_distance = (x - np.float32(light.glare_at[0])) ** 2 + (y - np.float32(light.glare_at[1])) ** 2
        scene = scene + np.float32(light.glare) * np.exp(-squared_distance / np.float32(2 * light.glare_radius**2))
    for time in times:
        electrons = scene * np.float32(time * FULL_WELL)
        noise = np.sqrt(electrons + np.float32(READ_NOISE**2)) * rng.standard_normal(scene.shape, np.float32)
        exposures.append(np.rint(255 * np.clip((electrons + noise) / np.float32(FULL_WELL), 0, 1)).astype(np.uint8))
    return exposures
