"""HEIC photographs: pixels as the sensor gave them; raw ones, and mosaics of coloured pixels, which are refused."""

import io

import cv2
import numpy as np
import pytest
from PIL import Image

from stcal.io import decoding
from stcal.io.cameras.read import camera_of_photograph
from stcal.io.decoding import patterns_seen
from stcal.io.images import decode, find_images
from tests.outcome import fails_with, refuses

HEIGHT, WIDTH = 96, 128
Y, X = np.mgrid[:HEIGHT, :WIDTH]
SCENE = (60 + 150 / (1 + np.exp((np.hypot(X - 40.3, Y - 30.7) - 15) * 1.5))).astype(np.uint8)
"""A bright disc left of and above the middle: a turned or mirrored image shows."""


def centre(image: np.ndarray) -> np.ndarray:
    """Centroid (x, y) of what is brighter than its surroundings."""
    weight = np.clip(image.astype(float) - np.median(image), 0, None)
    return np.array([(X * weight).sum(), (Y * weight).sum()]) / weight.sum()


def heic(**options) -> bytes:
    pillow_heif = pytest.importorskip("pillow_heif")
    stream = io.BytesIO()
    try:
        pillow_heif.from_pillow(Image.fromarray(np.dstack([SCENE] * 3))).save(stream, quality=95, **options)
    except RuntimeError as error:  # built without an encoder
        pytest.skip(str(error))
    return stream.getvalue()


def exif(orientation: int = 1) -> bytes:
    """Focal length of 26 mm in 35 mm film, and how the camera was held."""
    made = Image.Exif()
    made[0x0112] = orientation
    made.get_ifd(0x8769)[0xA405] = 26
    return made.tobytes()


def test_a_heic_photograph_is_read(tmp_path):
    """Told by its content where its name says otherwise."""
    (tmp_path / "a.HEIC").write_bytes(heic())
    (file,), skipped = find_images(tmp_path)
    assert not skipped
    image = decode(file.read(), "a.jpg")
    assert np.abs(image.astype(int) - SCENE).mean() < 3  # JPEG of this quality: 2
    np.testing.assert_allclose(centre(image), centre(SCENE), atol=0.05)


def test_the_turn_of_the_container_is_undone():
    """Its decoder applies it, and the camera's pixels are wanted."""
    upright = decode(heic(), "a.heic")
    for orientation in (6, 8, 3):
        data = heic(exif=exif(orientation))
        if not decoding.heic_turns(data):
            pytest.skip("this package writes no turn into the container")
        np.testing.assert_allclose(decode(data, "a.heic").astype(int), upright, atol=8)


def test_a_damaged_heic_photograph_is_refused(monkeypatch):
    monkeypatch.setattr("PIL.ImageFile.LOAD_TRUNCATED_IMAGES", True)  # as WeasyPrint leaves it
    refuses("E-IMAGE-UNREADABLE … a.heic", decode, heic()[:400], "a.heic")


def test_the_camera_of_a_heic_photograph(tmp_path):
    path = tmp_path / "a.heic"
    path.write_bytes(heic(exif=exif()))
    camera, _ = camera_of_photograph(path)
    np.testing.assert_allclose(camera.focal, 26 / np.hypot(36, 24) * np.hypot(WIDTH, HEIGHT), rtol=1e-4)


def test_a_missing_package_is_named(monkeypatch):
    monkeypatch.setattr(decoding, "find_spec", lambda _: None)
    with fails_with("E-IMAGE-EXTRA … pip install 'stereo-target-calibration["):
        decode(b"\0\0\0\x18ftypheic" + bytes(40), "a.heic")


@pytest.mark.parametrize("name", ["a.nef", "a.tif"])
def test_a_raw_photograph_is_refused(name):
    """Told by its suffix, or by the tag of a DNG, which OpenCV would read as the grey image that it is not."""
    stream = io.BytesIO()
    Image.fromarray(SCENE).save(stream, "TIFF", tiffinfo={decoding.DNG_VERSION: bytes([1, 4, 0, 0])})
    refuses(f"E-IMAGE-TYPE … {name} … TIFF or PNG", decode, stream.getvalue(), name)


ROW, COLUMN = np.mgrid[:240, :320]
GAIN = {"R": 0.55, "G": 1.0, "B": 0.7}  # sensitivities of a sensor without white balance


def scene(seed: int = 0) -> np.ndarray:
    """Grey discs with noise, 0 … 1."""
    rng = np.random.default_rng(seed)
    light = np.full(COLUMN.shape, 0.7)
    for _ in range(20):
        x, y, radius = rng.uniform(20, 300), rng.uniform(20, 220), rng.uniform(5, 15)
        light = np.minimum(light, 0.7 - 0.5 / (1 + np.exp((np.hypot(COLUMN - x, ROW - y) - radius) * 2)))
    return light + rng.normal(0, 0.005, COLUMN.shape)


def mosaic(pattern: str, light: np.ndarray) -> np.ndarray:
    gain = np.array([GAIN[colour] for colour in pattern]).reshape(2, 2)
    return np.round(255 * light * np.tile(gain, (120, 160))).astype(np.uint8)


@pytest.mark.parametrize("pattern", ["RGGB", "BGGR", "GRBG", "GBRG"])
def test_a_mosaic_is_refused(tmp_path, pattern):
    cv2.imwrite(str(tmp_path / "a.png"), mosaic(pattern, scene()))
    refuses(f"E-IMAGE-MOSAIC … a.png … {pattern}", find_images, tmp_path)


@pytest.mark.parametrize("seed", range(4))
def test_other_images_are_no_mosaics(seed):
    light = scene(seed)
    stripes = np.where(seed % 2 == COLUMN % 2, 200, 60)
    board = np.where((COLUMN // 3 + ROW // 3) % 2, 255, 0)
    noise = np.random.default_rng(seed).integers(0, 255, light.shape)
    for image in (np.round(255 * light), noise, stripes, board, np.zeros((40, 50))):
        assert not patterns_seen(image.astype(np.uint8))
