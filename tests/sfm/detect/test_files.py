"""Detections of files are kept and made again, photographs that are gone are named, and what is drawn on an overlay is
where it should be."""

import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest

from stcal.design import reference_board, reference_target
from stcal.errors import InputNote
from stcal.io.cameras.camera_model import CameraModel
from stcal.io.cameras.read import read_camera
from stcal.io.images import MAJORITY, find_images
from stcal.sfm.data.group_model import ImageObservations
from stcal.sfm.detect.candidates import EllipseOptions
from stcal.sfm.detect.detect_files import PHOTOGRAPHS, detect_files, sized_by
from stcal.sfm.detect.overlay import draw_overlay
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


def test_a_detection_is_kept_and_a_damaged_or_another_ones_made_again(detected, sample):
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


FOCAL = np.array([2000.0, 2000.0])
GREY = 90


def overlay(labels, centres, shapes, scale: float, width: int = 1600, notes: int = 0, left_out=()) -> np.ndarray:
    """Drawn on a plain image of ``width`` px, its thumbnail ``scale`` of that."""
    n = len(labels)
    size = (round(width * 0.75 * scale), round(width * scale))
    _, jpeg = cv2.imencode(".jpg", np.full((*size, 3), GREY, np.uint8))
    seen = centres, np.zeros((n, 2)), np.array(shapes) / FOCAL[:, None], np.tile(np.eye(2), (n, 1, 1))
    image = ImageObservations("12/a.jpg", "12", tuple(labels), *seen)
    drawn = draw_overlay(jpeg.tobytes(), scale, image, ["1", "2"], FOCAL, notes, left_out)
    return cv2.imdecode(np.frombuffer(drawn, np.uint8), cv2.IMREAD_COLOR).astype(float)


def coloured(picture: np.ndarray) -> np.ndarray:
    """Pixels that are not grey, (n, 2) as x, y."""
    return np.argwhere(np.ptp(picture, axis=2) > 60)[:, ::-1]


def test_overlays_draw_rims_where_ellipses_are_and_crosses_on_what_is_left_out():
    """Every sixteenth of the rim has colour within 1.5 px, and nothing inside it but the cross is coloured. White along
    the diagonals of a circle that is left out, and nowhere else beside a line of words at the bottom."""
    for scale in (1.0, 0.75):
        centre, shape = np.array([800.0, 600.0]), np.array([[100.0, 20.0], [0.0, 60.0]])
        found = coloured(overlay(["1:3"], [centre], [shape], scale))
        at = (centre + 0.5) * scale - 0.5
        angle = np.linspace(0, 2 * np.pi, 16, endpoint=False)
        rim = at + scale * np.column_stack([np.cos(angle), np.sin(angle)]) @ shape.T
        away = np.linalg.norm(rim[:, None] - found, axis=2).min(1)
        assert away.max() < 1.5
        radius = np.linalg.norm(np.linalg.solve(scale * shape, (found - at).T), axis=0)
        inside = found[(radius < 0.9) & (found[:, 1] > at[1] - 8)]  # the face's name stands above
        assert np.abs(inside - at).max() < 5
        assert np.linalg.norm(inside - at, axis=1).min() < 1
    labels, centres = ["1:3", "1:4"], [[500.0, 600.0], [1000.0, 600.0]]
    plain, crossed = (overlay(labels, centres, 2 * [60 * np.eye(2)], 1.0, left_out=x) for x in ((), ("1:4",)))
    y, x = np.nonzero(np.abs(crossed - plain).max(2) > 60)
    legend = y > 1100
    assert legend.sum() > 100
    across, up = np.abs(x - 1000)[~legend], np.abs(y - 600)[~legend]
    assert np.abs(across - up).max() < 8
    assert 60 < across.max() < 100  # as large as the circle
    assert crossed[580:590, 980:990].max() > 230
