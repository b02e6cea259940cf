"""Camera files that were reported (``../shared/cases``): each projects as OpenCV, NumPy or pycolmap does with the
numbers that stand in it. Those that are refused: `test_cases_as_typed`."""

import numpy as np
import pycolmap
import pytest
from scipy.io import loadmat

from stcal.io.cameras.foreign_lenses import ForeignLens
from stcal.io.cameras.read import camera_of_photograph, read_lens
from tests.io.reported_cameras import CASES, RAYS, perspective
from tests.outcome import refuses


def project(lens) -> np.ndarray:
    if isinstance(lens, ForeignLens):
        return lens.project(RAYS)
    return lens.sized(lens.width or 10_000, lens.height or 10_000).project(RAYS)


@pytest.mark.parametrize(("place", "name"), CASES)
def test_a_reported_file_projects_as_its_numbers_say(shared_case, place, name):
    np.testing.assert_allclose(project(read_lens(shared_case(place), name)), CASES[place, name](), atol=1e-8)


def test_a_reported_stereo_file_of_matlab_has_both_cameras(shared_case):
    path = shared_case("name_choice/stereo.mat")
    stereo = loadmat(path, squeeze_me=True, struct_as_record=False)["stereoParams"]
    for name in ("CameraParameters1", "CameraParameters2"):
        theirs = getattr(stereo, name)
        k = np.zeros(5)
        radial = np.atleast_1d(theirs.RadialDistortion)
        k[[0, 1, 4][: len(radial)]] = radial
        k[2:4] = theirs.TangentialDistortion
        lens = theirs.K[0, 0], theirs.K[1, 1], theirs.K[0, 2] - 1, theirs.K[1, 2] - 1  # MATLAB counts from 1
        np.testing.assert_allclose(project(read_lens(path, f"stereoParams.{name}")), perspective(lens, k), atol=1e-8)


def test_the_reported_database_with_its_log_is_pycolmaps(shared_case, tmp_path):
    path = shared_case("wal/db.db")
    (tmp_path / "db.db").write_bytes(path.read_bytes())
    with pycolmap.Database.open(tmp_path / "db.db") as database:
        (theirs,) = database.read_all_cameras()
    wanted = np.array([theirs.img_from_cam(ray) for ray in RAYS]) - 0.5
    np.testing.assert_allclose(project(read_lens(path)), wanted, atol=1e-9)


EXIF = {
    "phone.jpg": 26 / np.hypot(36, 24) * np.hypot(4032, 3024),
    "portrait_rotated.jpg": 26 / np.hypot(36, 24) * np.hypot(4032, 3024),
    "dslr.jpg": 35 / (25.4 / 6485.106382978724),
    "dslr_zoomcrop.jpg": 35 / (25.4 / 6485.106382978724) / 2,
}
"""Focal length, px, of a photograph: by its 35 mm film equivalent (CIPA DCG-001), or by its pixels on the sensor."""
NO_FOCAL = {"f35zero.jpg": "5.7 mm, but no size of its pixels", "phone_zoom2.jpg": "digital zoom of 2"}


@pytest.mark.parametrize("name", EXIF)
def test_a_reported_photograph_has_the_focal_length_of_its_exif(shared_case, name):
    camera, _ = camera_of_photograph(shared_case("exif") / name)
    np.testing.assert_allclose(camera.focal, EXIF[name], rtol=1e-5)


@pytest.mark.parametrize("name", NO_FOCAL)
def test_a_reported_photograph_without_a_focal_length_is_refused(shared_case, name):
    refuses(f"E-CAMERA-EXIF … {name} … {NO_FOCAL[name]}", camera_of_photograph, shared_case("exif") / name)
