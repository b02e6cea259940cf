"""The camera that a photograph's EXIF tells, beside what COLMAP makes of it."""

import numpy as np
import pycolmap
import pytest
from PIL import ExifTags, Image

import stcal
from stcal.io.cameras.read import SIGMA_FOCAL, camera_of_photograph, is_photograph
from tests.outcome import refuses


def photograph(path, **entries):
    exif = Image.Exif()
    exif[ExifTags.Base.Make] = "any"
    own = exif.get_ifd(ExifTags.IFD.Exif)
    for name, value in entries.items():
        own[getattr(ExifTags.Base, name)] = value
    Image.new("L", (1200, 800)).save(path, exif=exif)
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
    path.write_bytes(content) if content else photograph(path, **entries)
    refuses(message, camera_of_photograph, path)
