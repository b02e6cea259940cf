"""One photograph is one view, however often and in whatever form it lies in the folder."""

import json
import shutil

import cv2
import numpy as np
import pytest

from stcal.io.images import ImageFile, same_photograph
from stcal.sfm.detect.candidates import ImageDetection
from stcal.sfm.detect.detect_files import DetectedImage, _without_copies
from tests.conftest import SMALL
from tests.sfm.detect.test_arrangement import centres_of

pytestmark = pytest.mark.usefixtures("no_page")
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


@pytest.mark.slow
def test_png_and_jpeg_of_one_photograph_are_one_view(stcal_sfm, small_set):
    small = small_set("12")
    cv2.imwrite(str(small.image(1).with_suffix(".png")), cv2.imread(str(small.image(1)), cv2.IMREAD_GRAYSCALE))
    shutil.copy(small.image(2), small.image(2).with_name("IMG_1002 (copy).jpg"))
    shutil.copy(small.image(3), small.image(3).with_name("Copy of IMG_1003.jpg"))
    files = "--target", small.folder / "target.toml", "--board", small.folder / "board.toml"
    code, out, _ = stcal_sfm(*small.arguments(*files, "--solve", "chain"))
    assert code == 0
    assert json.loads((small.out / "report.json").read_text())["summary"]["images_mapped"] == SMALL.images_per_group
    assert "skipped 12/IMG_1001.jpg: the same image as 12/IMG_1001.png, saved in another form" in out
    assert "skipped 12/IMG_1002 (copy).jpg: the same image as 12/IMG_1002.jpg" in out
    assert "skipped 12/Copy of IMG_1003.jpg: the same image as 12/IMG_1003.jpg" in out


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
