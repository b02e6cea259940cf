"""Photographs: the camera that EXIF tells, beside COLMAP's; HEIC, with pixels as the sensor gave them; raw ones and
mosaics of coloured pixels, which are refused."""

import io

import cv2
import numpy as np
import pycolmap
import pytest
from PIL import ExifTags, Image

import stcal
from stcal.io import decoding
from stcal.io.cameras.read import SIGMA_FOCAL, camera_of_photograph, is_photograph
from stcal.io.decoding import patterns_seen
from stcal.io.images import decode, find_images
from tests.outcome import fails_with, refuses
from tests.shared import written


def exif_of(orientation: int = 1, **entries) -> Image.Exif:
    exif = Image.Exif()
    exif[ExifTags.Base.Make], exif[ExifTags.Base.Orientation] = "any", orientation
    exif.get_ifd(ExifTags.IFD.Exif).update({getattr(ExifTags.Base, name): v for name, v in entries.items()})
    return exif


def photograph(path, **entries):
    Image.new("L", (1200, 800)).save(path, exif=exif_of(**entries))
    return path


PLANE = {"FocalLength": 35.0, "FocalPlaneXResolution": 500.0, "FocalPlaneResolutionUnit": 3}
"""24 mm across 1200 px."""
BIGGER = PLANE | {"FocalPlaneXResolution": 2500.0, "ExifImageWidth": 6000, "ExifImageHeight": 4000}
ENTRIES = {
    "35 mm film": ({"FocalLengthIn35mmFilm": 28}, 28 / 36 * 1200),
    "pixels": (PLANE, 35 / 24 * 1200),
    "pixels of a larger image": (BIGGER, 35 / 24 * 1200),
    "inches": (PLANE | {"FocalPlaneXResolution": 1270.0, "FocalPlaneResolutionUnit": 2}, 35 / 24 * 1200),
}


@pytest.mark.parametrize("case", ENTRIES)
@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_the_focal_length_is_that_of_exif(tmp_path, case, suffix):
    entries, focal_px = ENTRIES[case]
    path = photograph(tmp_path / f"p{suffix}", **entries)
    assert is_photograph(path)
    camera, told = camera_of_photograph(path)
    np.testing.assert_allclose(camera.focal, focal_px, rtol=1e-4)
    np.testing.assert_array_equal(camera.centre, [599.5, 399.5])
    sigma = np.sqrt(np.diag(camera.covariance))
    np.testing.assert_allclose(sigma[:2], SIGMA_FOCAL * focal_px, rtol=1e-3)
    assert np.linalg.eigvalsh(camera.covariance).min() > 0
    assert ("sensor of 24×16 mm" in told) == ("FocalLength" in entries)
    if (case, suffix) == ("35 mm film", ".jpg"):
        by_colmap = pycolmap.infer_camera_from_image(path)
        assert by_colmap.has_prior_focal_length
        np.testing.assert_allclose(camera.focal, by_colmap.mean_focal_length(), rtol=1e-3)


def test_a_lens_is_loaded_from_a_photograph_too(tmp_path):
    path = photograph(tmp_path / "p.jpg", FocalLengthIn35mmFilm=28)
    found = stcal.load_lens(path)
    camera, told = camera_of_photograph(path)
    assert found.camera.same_as(camera)
    assert (found.told, found.fitted) == (told, None)
    stcal.save_camera(tmp_path / "c.txt", found.camera, "colmap")
    assert stcal.load_lens(tmp_path / "c.txt").camera.same_as(found.camera)
    refuses("E-FIELD-TYPE … size", stcal.load_lens, path, size="1200x800")


@pytest.mark.parametrize(
    ("entries", "content", "message"),
    [
        ({}, None, "E-CAMERA-EXIF"),
        ({"FocalLengthIn35mmFilm": 0}, None, "E-CAMERA-EXIF"),
        ({"FocalLength": 35.0}, None, "E-CAMERA-EXIF … 35 mm, but no size of its pixels"),
        ({"FocalLengthIn35mmFilm": 36, "DigitalZoomRatio": 2.0}, None, "E-CAMERA-EXIF … zoom of 2 … 1200 or 2400 px"),
        (None, b"\xff\xd8\xff\xe0\x00\x10JFIF", "E-CAMERA-UNREADABLE"),
    ],
)
def test_a_photograph_that_tells_nothing_is_refused(tmp_path, entries, content, message):
    path = tmp_path / "p.jpg"
    refuses(message, camera_of_photograph, written(path, content) if content else photograph(path, **entries))


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


def test_a_heic_photograph_is_read(tmp_path):
    """Told by its content where its name says otherwise; with the camera of its EXIF."""
    path = written(tmp_path / "a.HEIC", heic(exif=exif_of(FocalLengthIn35mmFilm=26).tobytes()))
    camera, _ = camera_of_photograph(path)
    np.testing.assert_allclose(camera.focal, 26 / np.hypot(36, 24) * np.hypot(WIDTH, HEIGHT), rtol=1e-4)
    (file,), skipped = find_images(tmp_path)
    assert not skipped
    image = decode(file.read(), "a.jpg")
    assert np.abs(image.astype(int) - SCENE).mean() < 3  # JPEG of this quality: 2
    np.testing.assert_allclose(centre(image), centre(SCENE), atol=0.05)


def test_the_turn_of_the_container_is_undone():
    """Its decoder applies it, and the camera's pixels are wanted."""
    upright = decode(heic(), "a.heic")
    for orientation in (6, 8, 3):
        data = heic(exif=exif_of(orientation).tobytes())
        if not decoding.heic_turns(data):
            pytest.skip("this package writes no turn into the container")
        np.testing.assert_allclose(decode(data, "a.heic").astype(int), upright, atol=8)


def test_a_damaged_heic_photograph_is_refused_and_a_missing_package_named(monkeypatch):
    monkeypatch.setattr("PIL.ImageFile.LOAD_TRUNCATED_IMAGES", True)  # as WeasyPrint leaves it
    refuses("E-IMAGE-UNREADABLE … a.heic", decode, heic()[:400], "a.heic")
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
