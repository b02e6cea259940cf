"""Mosaics of coloured pixels: told by their pixels, named, and read with the stated pattern."""

import warnings

import cv2
import numpy as np
import pytest

from stcal.errors import InputNote
from stcal.io.images import decode, find_images, image_file, mosaic_of
from stcal.io.photographs.decoding import PATTERNS, patterns_seen
from tests.outcome import fails_with

Y, X = np.mgrid[:240, :320]
GAIN = {"R": 0.55, "G": 1.0, "B": 0.7}
"""Sensitivities of a sensor without white balance."""


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


@pytest.mark.parametrize("pattern", PATTERNS)
def test_a_mosaic_is_told_and_read(tmp_path, pattern):
    cv2.imwrite(str(tmp_path / "a.png"), mosaic(pattern, scene()))
    with pytest.warns(InputNote, match=f"--bayer .*{pattern}"):
        find_images(tmp_path)
    with warnings.catch_warnings(), mosaic_of(pattern.lower()):
        warnings.simplefilter("error")
        (file,), _ = find_images(tmp_path)
    image = decode(file.read(), file.name)
    assert not patterns_seen(image)
    # Colours of one brightness: the grey image has the scene's, up to what interpolation smooths.
    flat = np.abs(cv2.Laplacian(scene(), cv2.CV_64F)) < 0.05
    ratio = (image / scene())[flat]
    assert ratio.std() / ratio.mean() < 0.03


@pytest.mark.parametrize("seed", range(8))
def test_other_images_are_no_mosaics(seed):
    rng = np.random.default_rng(seed)
    light = scene(seed)
    assert not patterns_seen(np.round(255 * light).astype(np.uint8))
    assert not patterns_seen(rng.integers(0, 255, light.shape, np.uint8))
    stripes = np.where(seed % 2 == X % 2, 200, 60).astype(np.uint8)
    assert not patterns_seen(stripes)
    assert not patterns_seen(np.zeros((40, 50), np.uint8))
    board = np.where((X // 3 + Y // 3) % 2, 255, 0).astype(np.uint8)
    assert not patterns_seen(board)


def test_a_pattern_is_one_of_four():
    with fails_with("E-OPTION-VALUE … RGBG … RGGB, BGGR, GRBG, GBRG"), mosaic_of("RGBG"):
        pass


def test_a_file_that_is_no_image_stays_one(tmp_path):
    (tmp_path / "a.png").write_bytes(b"no image")
    with mosaic_of("RGGB"):
        file = image_file(tmp_path / "a.png")
    with fails_with("E-IMAGE-UNREADABLE … a.png"):
        decode(file.read(), file.name)
