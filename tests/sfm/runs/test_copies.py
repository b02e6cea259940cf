"""One photograph is one view, in whatever form it lies in the folder; of a run: `test_bad_input.py`."""

import cv2
import numpy as np
import pytest

from stcal.io.images import ImageFile, same_photograph
from stcal.sfm.detect.candidates import ImageDetection
from stcal.sfm.detect.detect_files import DetectedImage, _without_copies
from tests.sfm.detect.test_arrangement import centres_of

NOISE = 2.5
"""Grey values: 1 % of full scale."""


def as_jpeg(image, quality: int) -> np.ndarray:
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)


@pytest.fixture(scope="module")
def sharp(small_dataset):
    image = cv2.imread(str(small_dataset / "images" / "12" / "IMG_1000.jpg"), cv2.IMREAD_GRAYSCALE)
    return cv2.GaussianBlur(image, (0, 0), 1.0).astype(float)


def exposure(sharp, seed: int) -> np.ndarray:
    noise = NOISE * np.random.default_rng(seed).standard_normal(sharp.shape)
    return np.clip(sharp + noise, 0, 255).round().astype(np.uint8)


@pytest.mark.slow
@pytest.mark.parametrize("quality", [60, 95])
def test_a_form_with_losses_is_the_same_photograph_and_a_second_exposure_is_not(sharp, quality):
    first, second = exposure(sharp, 1), exposure(sharp, 2)
    assert same_photograph(first, as_jpeg(first, quality))
    assert same_photograph(as_jpeg(first, quality), first)
    assert not same_photograph(first, second)
    assert not same_photograph(as_jpeg(first, quality), as_jpeg(second, quality))


def test_sixteen_bits_and_a_picture_without_noise_are_the_same_photograph(sharp):
    first = exposure(sharp, 1)
    assert same_photograph(first, first.astype(np.uint16) * 200)
    smooth = sharp.round().astype(np.uint8)
    assert same_photograph(smooth, as_jpeg(smooth, 90))
    assert not same_photograph(smooth, smooth[:-1])
    assert not same_photograph(smooth, np.roll(smooth, 1, axis=1))


@pytest.mark.parametrize("content", [b"", b"not an image", None])
def test_what_cannot_be_read_again_is_no_copy(tmp_path, content):
    """A photograph that was there at its detection, and is spoiled or gone when its pixels are compared."""
    seen = ImageDetection(centres_of(np.zeros((9, 2)), np.zeros((9, 2))), ())
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((40, 60), np.uint8))
    if content is not None:
        (tmp_path / "b.jpg").write_bytes(content)
    files = [ImageFile(tmp_path / name, name, "") for name in ("a.png", "b.jpg")]
    images, skipped = _without_copies([DetectedImage(f, seen, f.name, b"", 1.0, False) for f in files], True, False)
    assert ([image.file.name for image in images], skipped) == (["a.png", "b.jpg"], [])
