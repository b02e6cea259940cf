"""HEIC and raw photographs: pixels as the sensor gave them, and what is said without the packages that read them."""

import io
import struct

import numpy as np
import pytest
from PIL import Image

from stcal.io.cameras.photograph import camera_of_photograph
from stcal.io.images import decode, find_images
from stcal.io.photographs import decoding
from tests.outcome import fails_with

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
    data = heic()
    (tmp_path / "a.HEIC").write_bytes(data)
    (file,), skipped = find_images(tmp_path)
    assert not skipped
    image = decode(file.read(), file.name)
    assert np.abs(image.astype(int) - SCENE).mean() < 3  # JPEG of this quality: 2
    np.testing.assert_allclose(centre(image), centre(SCENE), atol=0.05)


def test_a_heic_photograph_is_told_by_its_content():
    assert decode(heic(), "a.jpg").shape == (HEIGHT, WIDTH)


def test_the_turn_of_the_container_is_undone():
    """Its decoder applies it, and the camera's pixels are wanted."""
    upright = decode(heic(), "a.heic")
    for orientation in (6, 8, 3):
        data = heic(exif=exif(orientation))
        if not decoding.heic_turns(data):
            pytest.skip("this package writes no turn into the container")
        np.testing.assert_allclose(decode(data, "a.heic").astype(int), upright, atol=8)


def test_a_damaged_heic_photograph_is_refused():
    with fails_with("E-IMAGE-UNREADABLE … a.heic"):
        decode(heic()[:400], "a.heic")


def test_the_camera_of_a_heic_photograph(tmp_path):
    path = tmp_path / "a.heic"
    path.write_bytes(heic(exif=exif()))
    camera = camera_of_photograph(path).camera
    np.testing.assert_allclose(camera.focal, 26 / np.hypot(36, 24) * np.hypot(WIDTH, HEIGHT), rtol=1e-4)


@pytest.mark.parametrize("suffix", [".heic", ".dng"])
def test_a_missing_package_is_named(monkeypatch, suffix):
    monkeypatch.setattr(decoding, "find_spec", lambda _: None)
    data = b"\0\0\0\x18ftypheic" + bytes(40) if suffix == ".heic" else dng(SCENE)
    with fails_with("E-IMAGE-EXTRA … pip install 'stereo-target-calibration["):
        decode(data, f"a{suffix}")


def dng(grey: np.ndarray, orientation: int = 1) -> bytes:
    """An uncompressed DNG of 16 bit with the filter RGGB, whose colours are alike (DNG specification 1.4)."""
    pixels = (grey.astype("<u2") * 200).tobytes()
    one, text = struct.pack("<ii", 1, 1), b"stcal\0"
    nothing = struct.pack("<ii", 0, 1)
    entries = [
        (254, 4, 1, struct.pack("<I", 0)),
        (256, 4, 1, struct.pack("<I", grey.shape[1])),
        (257, 4, 1, struct.pack("<I", grey.shape[0])),
        (258, 3, 1, struct.pack("<HH", 16, 0)),
        (259, 3, 1, struct.pack("<HH", 1, 0)),
        (262, 3, 1, struct.pack("<HH", 32803, 0)),
        (271, 2, len(text), text),
        (272, 2, len(text), text),
        (273, 4, 1, b"PIXS"),
        (274, 3, 1, struct.pack("<HH", orientation, 0)),
        (277, 3, 1, struct.pack("<HH", 1, 0)),
        (278, 4, 1, struct.pack("<I", grey.shape[0])),
        (279, 4, 1, struct.pack("<I", len(pixels))),
        (33421, 3, 2, struct.pack("<HH", 2, 2)),
        (33422, 1, 4, bytes([0, 1, 1, 2])),
        (50706, 1, 4, bytes([1, 4, 0, 0])),
        (50708, 2, len(text), text),
        (50717, 4, 1, struct.pack("<I", 65535)),
        (50721, 10, 9, b"".join(one if i % 4 == 0 else nothing for i in range(9))),
        (50728, 5, 3, one * 3),
    ]
    at = 8 + 2 + 12 * len(entries) + 4
    head, more = struct.pack("<2sHIH", b"II", 42, 8, len(entries)), b""
    for tag, kind, count, value in entries:
        if len(value) > 4:
            head += struct.pack("<HHII", tag, kind, count, at + len(more))
            more += value + bytes(len(value) % 2)
        else:
            head += struct.pack("<HHI", tag, kind, count) + value
    head += struct.pack("<I", 0)
    return head.replace(b"PIXS", struct.pack("<I", at + len(more))) + more + pixels


@pytest.mark.parametrize("orientation", [1, 6])
def test_a_raw_photograph_is_proportional_to_the_light_and_not_turned(tmp_path, orientation):
    pytest.importorskip("rawpy")
    (tmp_path / "a.DNG").write_bytes(dng(SCENE, orientation))
    (file,), _ = find_images(tmp_path)
    image = decode(file.read(), file.name)
    assert (image.dtype, image.shape) == (np.uint16, SCENE.shape)
    ratio = image[8:-8, 8:-8] / SCENE[8:-8, 8:-8]
    assert np.median(np.abs(ratio / np.median(ratio) - 1)) < 0.01
    np.testing.assert_allclose(centre(image), centre(SCENE), atol=0.05)


def test_a_dng_is_told_by_its_content():
    pytest.importorskip("rawpy")
    assert decode(dng(SCENE), "a.tif").dtype == np.uint16


def test_a_damaged_raw_photograph_is_refused():
    pytest.importorskip("rawpy")
    with fails_with("E-IMAGE-UNREADABLE … a.nef … raw photograph"):
        decode(b"II*\0" + bytes(100), "a.nef")
