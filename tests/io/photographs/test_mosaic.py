"""Mosaics of coloured pixels: told by their pixels, and refused."""

import cv2
import numpy as np
import pytest

from stcal.io.decoding import patterns_seen
from stcal.io.images import find_images
from tests.outcome import fails_with

Y, X = np.mgrid[:240, :320]
GAIN = {"R": 0.55, "G": 1.0, "B": 0.7}  # sensitivities of a sensor without white balance


def scene(seed: int = 0) -> np.ndarray:
    """Grey discs with noise, 0 … 1."""
    rng = np.random.default_rng(seed)
    light = np.full(X.shape, 0.7)
    for _ in range(20):
        x, y, radius = rng.uniform(20, 300), rng.uniform(20, 220), rng.uniform(5, 15)
        light = np.minimum(light, 0.7 - 0.5 / (1 + np.exp((np.hypot(X - x, Y - y) - radius) * 2)))
    return light + rng.normal(0, 0.005, X.shape)


def mosaic(pattern: str, light: np.ndarray) -> np.ndarray:
    gain = np.array([GAIN[colour] for colour in pattern]).reshape(2, 2)
    return np.round(255 * light * np.tile(gain, (120, 160))).astype(np.uint8)


@pytest.mark.parametrize("pattern", ["RGGB", "BGGR", "GRBG", "GBRG"])
def test_a_mosaic_is_refused(tmp_path, pattern):
    cv2.imwrite(str(tmp_path / "a.png"), mosaic(pattern, scene()))
    with fails_with(f"E-IMAGE-MOSAIC … a.png … {pattern}"):
        find_images(tmp_path)


@pytest.mark.parametrize("seed", range(8))
def test_other_images_are_no_mosaics(seed):
    light = scene(seed)
    stripes = np.where(seed % 2 == X % 2, 200, 60)
    board = np.where((X // 3 + Y // 3) % 2, 255, 0)
    noise = np.random.default_rng(seed).integers(0, 255, light.shape)
    for image in (np.round(255 * light), noise, stripes, board, np.zeros((40, 50))):
        assert not patterns_seen(image.astype(np.uint8))
