"""Simulation of new exposures of a real photograph: exposure time, uneven light, glare, and a camera's response."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from stcal.errors import InputError

DARKEST = 1e-3
"""Least grey value, as a share of white. The photograph holds no information below."""


@dataclass(frozen=True, slots=True)
class Sensor:
    """Sensor of a camera.

    ``gamma`` : the response is light to the power of 1/gamma; ``full_well`` : electrons at full scale, whose shot noise
    is the root of their number; ``read_noise`` : read noise in electrons; ``bits`` : 8 or 16.
    """

    gamma: float = 1.0
    full_well: float = 10_000.0
    read_noise: float = 8.0
    bits: int = 8

    def __post_init__(self):
        if self.gamma <= 0 or self.full_well <= 0 or self.read_noise < 0 or self.bits not in (8, 16):
            raise InputError(
                "E-SIMULATE-OPTIONS",
                "sensor: gamma and full well positive, read noise not negative, 8 or 16 bits needed",
            )


@dataclass(frozen=True, slots=True)
class Light:
    """Light on a scene in addition to the light in its photograph.

    ``stops`` : gradient in powers of two per width of the image, in direction ``angle_rad``; the light is unchanged at
    ``pivot`` (x, y), in image widths; ``glare`` : light added in the middle of a spot, in units of the photograph's
    white; ``glare_at``, ``glare_radius`` : place (x, y) and Gaussian radius of the spot, in image widths.
    """

    stops: float = 0.0
    angle_rad: float = 0.0
    pivot: tuple[float, float] = (0.5, 0.5)
    glare: float = 0.0
    glare_at: tuple[float, float] = (0.5, 0.5)
    glare_radius: float = 0.1


def expose(
    photograph: np.ndarray,
    times: Sequence[float],
    sensor: Sensor | None = None,
    light: Light | None = None,
    seed: int = 0,
) -> list[np.ndarray]:
    """Exposes the scene of an 8-bit photograph (height, width) at other times; time 1 keeps its brightness.

    Saturated pixels of the photograph are taken to have the light of white. The noise of the exposures is independent.
    """
    if photograph.dtype != np.uint8 or photograph.ndim != 2:
        raise InputError(
            "E-IMAGE-TYPE", f"photograph: {photograph.dtype} of shape {photograph.shape}; 8-bit grey needed"
        )
    if not all(time > 0 for time in times):
        raise InputError("E-EXPOSURES-VALUE", "exposure times: positive numbers needed")
    sensor, light = sensor or Sensor(), light or Light()
    rng = np.random.default_rng(seed)
    # The light within one grey level is unknown. It is spread evenly, or a darker exposure would show the levels.
    grey = (photograph + rng.random(photograph.shape, np.float32)) / np.float32(256)
    scene = lit(np.maximum(grey, DARKEST) ** np.float32(sensor.gamma), light)
    top = 2**sensor.bits - 1
    exposures = []
    for time in times:
        electrons = scene * np.float32(time * sensor.full_well)
        noise = np.sqrt(electrons + np.float32(sensor.read_noise**2)) * rng.standard_normal(scene.shape, np.float32)
        share = np.clip((electrons + noise) / np.float32(sensor.full_well), 0, 1)
        value = np.rint(top * share ** np.float32(1 / sensor.gamma))
        exposures.append(value.astype(np.uint8 if sensor.bits == 8 else np.uint16))
    return exposures


def lit(scene: np.ndarray, light: Light) -> np.ndarray:
    """Returns the light of a scene (height, width) with gradient and glare."""
    height, width = scene.shape
    x, y = np.meshgrid(np.arange(width, dtype=np.float32) / width, np.arange(height, dtype=np.float32) / width)
    if light.stops:
        towards = np.float32(np.cos(light.angle_rad)), np.float32(np.sin(light.angle_rad))
        along = (x - np.float32(light.pivot[0])) * towards[0] + (y - np.float32(light.pivot[1])) * towards[1]
        scene = scene * np.exp2(np.float32(light.stops) * along)
    if light.glare:
        squared_distance = (x - np.float32(light.glare_at[0])) ** 2 + (y - np.float32(light.glare_at[1])) ** 2
        scene = scene + np.float32(light.glare) * np.exp(-squared_distance / np.float32(2 * light.glare_radius**2))
    return scene


def moved(photograph: np.ndarray, shift_px: tuple[float, float]) -> np.ndarray:
    """Returns the photograph shifted in the image, as if the camera had turned a little."""
    matrix = np.array([[1, 0, shift_px[0]], [0, 1, shift_px[1]]], float)
    return cv2.warpAffine(
        photograph, matrix, photograph.shape[::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT
    )
