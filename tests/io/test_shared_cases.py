"""Camera files that were reported (``../shared/cases``): each projects as OpenCV, NumPy or pycolmap does with the
numbers that stand in it. Those that are refused: `test_cases_as_typed`."""

import numpy as np
import pycolmap
import pytest
from scipy.io import loadmat

from stcal.io.cameras.read import camera_of_photograph, read_lens
from tests.io import camera_files
from tests.io.camera_files import project
from tests.outcome import refuses
from tests.shared import written

RAYS = np.column_stack([np.random.default_rng(8).uniform(-0.5, 0.5, (40, 2)), np.ones(40)])
RATIONAL = [0.41, -2.66, 0.0006, -0.0002, 1.52, 0.29, -2.48, 1.45]
PLUMB = [-0.0306, 0.0352, -0.00013, -0.00014, -0.012, 0, 0, 0]
SAMPLES = (911.5, 910.25, 639, 359), [-0.2, 0.05, 0.001, -0.0005, 0.01]
OPENCV = [1502, 1501, 960, 540, -0.1, 0.02, 0.0001, 0.0002]
ROS = 610.2, 610.5, 640.3, 401.7


def perspective(lens, k) -> np.ndarray:
    return camera_files.perspective(k, lens, rays=RAYS)


def metashape() -> np.ndarray:
    k, p, centre = (0.11, -0.32, 0.21), (0.0012, -0.0031), (4032 / 2 - 44.5 - 0.5, 3024 / 2 + 12.25 - 0.5)
    return camera_files.metashape(RAYS[:, :2], 3268.25, (1.5, 0), k, p, (0.85, -0.44), centre)


CASES = {
    ("stereo_yml/intrinsics.yml", "1"): lambda: perspective(*SAMPLES),
    ("stereo_yml/intrinsics.yml", "2"): lambda: perspective(*SAMPLES),
    ("metashape_p3p4/cal.xml", ""): metashape,
    ("name_choice/cameras.txt", "2"): lambda: camera_files.colmap(
        "OPENCV", [1502, 1501, 960, 540, -0.1, 0.02, 0.0001, 0.0002], RAYS, (1920, 1080)
    ),
    ("name_choice/cams.xml", "Cam B (35mm)"): lambda: perspective(
        (8196.7, 8196.7, 3000 + 15.4 - 0.5, 2000 + 16.1 - 0.5), [-0.04, 0.02, 0, 0]
    ),
    ("ros_coefficients/kb.yaml", ""): lambda: camera_files.equidistant([0.1, 0.1, 0, 0], ROS, RAYS),
    ("ros_coefficients/zeros5.yaml", ""): lambda: perspective(ROS, [0.0] * 4),
    ("ros_coefficients/plumb8.yaml", ""): lambda: perspective(ROS, PLUMB),
    ("ros_coefficients/rat8.yaml", ""): lambda: perspective(ROS, RATIONAL),
    ("ros_coefficients/thin12.yaml", ""): lambda: perspective(ROS, [*PLUMB, 0.0011, -0.0004, 0.0009, 0.0003]),
    ("ros_coefficients/tilt14.yaml", ""): lambda: perspective(ROS, [*PLUMB, 0, 0, 0, 0, 0.01, -0.02]),
}
"""File and name of the camera, and the pixels of RAYS; others are shown in `test_cases_as_typed`."""


@pytest.mark.parametrize(("place", "name"), CASES)
def test_a_reported_file_projects_as_its_numbers_say(shared_case, place, name):
    np.testing.assert_allclose(project(read_lens(shared_case(place), name), RAYS), CASES[place, name](), atol=1e-8)


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
        np.testing.assert_allclose(
            project(read_lens(path, f"stereoParams.{name}"), RAYS), perspective(lens, k), atol=1e-8
        )


def test_the_reported_database_with_its_log_is_pycolmaps(shared_case, tmp_path):
    path = shared_case("wal/db.db")
    with pycolmap.Database.open(written(tmp_path / "db.db", path.read_bytes())) as database:
        (theirs,) = database.read_all_cameras()
    wanted = np.array([theirs.img_from_cam(ray) for ray in RAYS]) - 0.5
    np.testing.assert_allclose(project(read_lens(path), RAYS), wanted, atol=1e-9)


EXIF = {
    "phone.jpg": 26 / np.hypot(36, 24) * np.hypot(4032, 3024),
    "portrait_rotated.jpg": 26 / np.hypot(36, 24) * np.hypot(4032, 3024),
    "dslr.jpg": 35 / (25.4 / 6485.106382978724),
    "dslr_zoomcrop.jpg": 35 / (25.4 / 6485.106382978724) / 2,
    "f35zero.jpg": "5.7 mm, but no size of its pixels",
    "phone_zoom2.jpg": "digital zoom of 2",
}
"""Focal length of a photograph, px: of 35 mm film (CIPA DCG-001), or by its pixels; or why it has none."""


@pytest.mark.parametrize("name", EXIF)
def test_a_reported_photograph_has_the_focal_length_of_its_exif_or_is_refused(shared_case, name):
    path, told = shared_case("exif") / name, EXIF[name]
    if isinstance(told, str):
        refuses(f"E-CAMERA-EXIF … {name} … {told}", camera_of_photograph, path)
    else:
        np.testing.assert_allclose(camera_of_photograph(path)[0].focal, told, rtol=1e-5)
