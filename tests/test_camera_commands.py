"""``stcal camera``: files of other programs shown, converted and compared."""

import re

import numpy as np
import pytest
from typer.testing import CliRunner

from stcal import Camera, compare_cameras
from stcal.cli.instruments import camera_app as app
from stcal.io.cameras.read import read_camera, save_camera
from stcal.report.camera_figures import shown
from tests.outcome import lines_of, refuses

CAMERA = Camera(1280, 960, [900.0, 905.0], [640.0, 475.0], [-0.1, 0.03, 1e-3, -2e-3, 0, 0, 0, 0])


@pytest.fixture
def folder(tmp_path):
    sigma = np.array([0.1, 0.1, 0.2, 0.2, 1e-4, 1e-3, 1e-5, 1e-5])
    save_camera(tmp_path / "a.txt", Camera.of(CAMERA, "OPENCV", np.diag(sigma**2)))
    return tmp_path


def called(*words):
    result = CliRunner().invoke(app, list(map(str, words)), catch_exceptions=False)
    assert result.exit_code == 0
    return result


def call(*words):
    return called(*words).output


def test_a_camera_goes_to_kalibr_and_back(folder):
    said = call("convert", folder / "a.txt", folder / "chain.yaml", "--form", "kalibr", "--name", "cam3")
    assert "chain.yaml: σ and correlations of the parameters" in said
    assert (folder / "chain.yaml").read_text().startswith("cam3:")
    call("convert", folder / "chain.yaml", folder / "b.txt")
    assert read_camera(folder / "b.txt").calibrated(0, 0).same_as(CAMERA)


RIG = """
cam0: {camera_model: pinhole, intrinsics: [900, 905, 640, 475], distortion_model: radtan,
  distortion_coeffs: [-0.1, 0.03, 0.001, -0.002], resolution: [1280, 960], rostopic: /left}
cam1: {camera_model: pinhole, intrinsics: [900, 905, 640, 475], distortion_model: radtan, rostopic: /right,
  distortion_coeffs: [-0.1, 0.03, 0.001, -0.002], resolution: [1280, 960], timeshift_cam_imu: 0.0,
  T_cn_cnm1: [[1, 0, 0, 0.1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}
"""
ROS = """
{image_width: 1280, image_height: 960, distortion_model: plumb_bob,
camera_matrix: {rows: 3, cols: 3, data: [900, 0, 640, 0, 905, 475, 0, 0, 1]},
distortion_coefficients: {rows: 1, cols: 5, data: [-0.1, 0.03, 0.001, -0.002, 0]},
rectification_matrix: {rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]},
projection_matrix: {rows: 3, cols: 4, data: [900, 0, 640, -90, 0, 905, 475, 0, 0, 0, 1, 0]},
camera_matrix_std: [0.1, 0.1, 0.2, 0.2]}
"""
MRCAL = """{'lensmodel': 'LENSMODEL_OPENCV4', 'intrinsics': [900, 905, 640, 475, -0.1, 0.03, 0.001, -0.002],
'extrinsics': [0, 0, 0, 0.1, 0, 0], 'imagersize': [1280, 960], 'valid_intrinsics_region': [[9, 9], [99, 9], [9, 99]]}"""


@pytest.mark.parametrize(
    ("stated", "choice", "lost"),
    [
        (RIG, ("--name", "cam1"), ["the other camera, cam0", "T_cn_cnm1"]),
        (RIG, ("--name", "cam0"), ["the other camera, cam1"]),
        (ROS, (), ["projection_matrix, camera_matrix_std"]),
        (MRCAL, (), ["extrinsics", "valid_intrinsics_region"]),
        ("1 OPENCV 1280 960 900 905 640.5 475.5 -0.1 0.03 0.001 -0.002\n", (), []),
    ],
)
def test_what_a_conversion_drops_is_named_in_one_line(tmp_path, stated, choice, lost):
    """All of these are the same camera. Names, rotations by nothing and zeros are not missed."""
    (tmp_path / "in").write_text(stated)
    result = called("convert", tmp_path / "in", tmp_path / "out.txt", *choice)
    assert "not in" not in result.stdout
    assert result.stderr == (f"warning: not in {tmp_path / 'out.txt'}: {'; '.join(lost)}\n" if lost else "")
    assert read_camera(tmp_path / "out.txt").calibrated(0, 0).same_as(CAMERA)


def test_the_sigma_of_a_lens_that_is_fitted_is_missed(tmp_path):
    """Metashape's b2 has no place here: its lens is fitted, and the covariance of its parameters is of no use then."""
    (tmp_path / "in.xml").write_text(
        "<document><chunk><sensors><sensor id='0' label='a'><calibration class='adjusted'><resolution width='1280' "
        "height='960'/><f>900</f><b2>0.5</b2></calibration><covariance><params>f</params><coeffs>0.01</coeffs>"
        "</covariance></sensor></sensors><cameras><camera id='0'><transform>1</transform></camera></cameras></chunk>"
        "</document>"
    )
    lost = "poses of the photographs; σ and correlations of the parameters"
    said = lines_of(called("convert", tmp_path / "in.xml", tmp_path / "b.txt").stderr)
    assert said == [f"warning: not in {tmp_path / 'b.txt'}: {lost}"]


def test_a_size_that_the_file_does_not_state_is_asked_for_and_two_sizes_are_refused(folder):
    (folder / "i.yaml").write_text("K: [900, 0, 640, 0, 905, 475, 0, 0, 1]\nD: [0, 0, 0, 0]\n")
    refuses("E-CAMERA-SIZE … --size", call, "show", folder / "i.yaml")
    assert "1280×960" in call("show", folder / "i.yaml", "--size", "1280x960")
    refuses("E-OPTION-SIZE … --size … 12", call, "show", folder / "i.yaml", "--size", "12")
    refuses("E-OPTION-FORM … .json … --form", call, "convert", folder / "a.txt", folder / "b.json")
    save_camera(folder / "b.txt", Camera.of(Camera(640, 480, [450, 450], [320, 240], np.zeros(8)), "PINHOLE"))
    refuses("E-CAMERA-SIZES-DIFFER … 1280 … 960 … 640 … 480", call, "compare", folder / "a.txt", folder / "b.txt")


@pytest.mark.slow
def test_what_is_shown_is_the_cameras(folder):
    """Field of view of a lens without distortion: 2 atan(640 / 900) across."""
    plain = Camera(1280, 960, [900.0, 900.0], [639.5, 479.5], np.zeros(8))
    save_camera(folder / "p.txt", Camera.of(plain, "PINHOLE"))
    said = call("show", folder / "p.txt", "--plot", folder / "p.svg")
    assert f"field of view: {2 * np.degrees(np.arctan(640 / 900)):.2f}° across" in said
    assert "moves points by up to 0.00 px" in said
    assert (folder / "p.svg").stat().st_size > 5000
    assert re.search(r"cx +640\.0000 +0\.2000", call("show", folder / "a.txt"))


def test_a_principal_point_is_mostly_a_turn_and_a_focal_length_is_not():
    other = Camera(1280, 960, CAMERA.focal * 1.001, CAMERA.centre, CAMERA.distortion)
    assert compare_cameras(CAMERA, CAMERA).lengths().max() < 1e-9
    found = compare_cameras(CAMERA, other)
    # a thousandth of the way from the middle, to 720 px in the corner; p1, p2 and the turn take a part of it
    assert np.nanmax(found.lengths()) == pytest.approx(0.001 * np.hypot(640, 480), rel=0.1)
    shifted = Camera(1280, 960, CAMERA.focal, CAMERA.centre + np.array([5.0, 0.0]), CAMERA.distortion)
    moved = compare_cameras(CAMERA, shifted)
    assert np.nanmax(moved.lengths()) < 2.5  # mostly a turn
    assert moved.second_from_first.angle_rad() == pytest.approx(5 / 900, rel=0.2)


@pytest.mark.slow
@pytest.mark.filterwarnings("error")
def test_a_camera_whose_image_has_no_ray_is_shown_with_that():
    """A principal point far from the image: nothing is said of points that the lens moves, and no warning of NumPy."""
    camera = Camera(64, 48, [65.0, 65.0], [32.0, 1e8], [-0.1, 0.01, 0, 0, 0, 0, 0, 0], False, "OPENCV")
    assert shown(camera)[-1].startswith("warning: 100.0% of the image has no ray")
