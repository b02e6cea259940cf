"""Detections are kept by content and settings; what was damaged is detected again."""

import shutil
from dataclasses import replace

import numpy as np
import pytest

from stcal.design import reference_board, reference_target
from stcal.errors import InputNote
from stcal.io.cameras.camera_model import CameraModel
from stcal.io.cameras.read import read_camera
from stcal.io.images import MAJORITY, find_images
from stcal.sfm.detect.candidates import EllipseOptions
from stcal.sfm.detect.detect_files import PHOTOGRAPHS, detect_files, sized_by
from tests.outcome import refuses

IMAGE = "12/IMG_1000.jpg"


@pytest.fixture
def detected(sample, tmp_path):
    """Function that detects in a folder of one photograph: (result, names of files that were reported done)."""
    folder = tmp_path / "images"
    (folder / "12").mkdir(parents=True)
    shutil.copy(sample / "images" / IMAGE, folder / IMAGE)
    camera = read_camera(sample / "cameras.txt")

    def detect():
        done, how = [], (reference_target(), reference_board(), EllipseOptions(), tmp_path / "cache", 1)
        return detect_files(find_images(folder)[0], camera, *how, done.append), done

    return detect, folder, tmp_path / "cache"


def test_a_detection_is_kept_and_a_damaged_one_made_again(detected):
    detect, _, cache = detected
    (first,) = detect()[0].images
    (again,), done = detect()[0].images, detect()[1]
    assert (first.reused, again.reused) == (False, True)
    assert done == [IMAGE]
    np.testing.assert_array_equal(first.detection.centres.centre_px, again.detection.centres.centre_px)
    (file,) = cache.glob("*.npz")
    for spoilt in (b"", file.read_bytes()[: file.stat().st_size // 2]):
        file.write_bytes(spoilt)
        (repaired,) = detect()[0].images
        assert not repaired.reused
        assert [each.face for each in repaired.detection.faces] == [each.face for each in first.detection.faces]
        np.testing.assert_array_equal(repaired.detection.centres.centre_px, first.detection.centres.centre_px)


def test_a_detection_of_another_image_is_not_used(detected, sample):
    detect, folder, cache = detected
    detect()
    (file,) = cache.glob("*.npz")
    other = "12/IMG_1001.jpg"
    shutil.copy(sample / "images" / other, folder / other)
    own = detect()[0].images[1].detection.centres.centre_px
    (second,) = set(cache.glob("*.npz")) - {file}
    shutil.copy(file, second)
    with pytest.warns(InputNote, match=f"{second.name} is made from other inputs"):
        found = detect()[0]
    assert [image.reused for image in found.images] == [True, False]
    assert found.skipped == ()
    np.testing.assert_array_equal(found.images[1].detection.centres.centre_px, own)


@pytest.mark.parametrize("in_its_place", ["nothing", "a folder", "a file for its folder"])
def test_a_photograph_that_is_gone_is_an_error(detected, sample, monkeypatch, in_its_place):
    """It was there when the folder was looked at: a result without it would be another one."""
    detect, folder, _ = detected
    listed = find_images(folder)
    monkeypatch.setattr(f"{__name__}.find_images", lambda _: listed)
    (folder / IMAGE).unlink()
    if in_its_place == "a folder":
        (folder / IMAGE).mkdir()
    elif in_its_place != "nothing":
        shutil.rmtree((folder / IMAGE).parent)
        (folder / IMAGE).parent.write_bytes(b"x")
    refuses(f"E-IMAGES-GONE … {IMAGE}", detect)


def test_a_camera_found_in_the_photographs_is_not_called_a_file():
    found = CameraModel(np.full(2, 800.0), np.array([29.5, 19.5]), np.zeros(12), "PINHOLE", 60, 40, PHOTOGRAPHS)
    assert sized_by(found, [])[1] == MAJORITY
    assert sized_by(replace(found, source="cameras.txt"), [])[1] == "the camera file"
