"""Corners of a ChArUco board on a real robot, static camera: the camera file has no distortion, and the board is 0.5 %
larger than stated. Errors on poses held out are those of its photographs, in ``test_shared_sets``."""

import numpy as np
import pytest
import yaml

from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Poses
from stcal.handeye import HandEyeOptions, View, Views, pairs_of_views
from stcal.io.cameras.camera_model import camera_prior
from tests.support.handeye import handeye


@pytest.fixture(scope="module")
def charuco(shared_data):
    folder = shared_data("charuco_handeye")
    k = yaml.safe_load((folder / "test_set_charuco" / "cal_data.yaml").read_text())["intrinsics"]
    camera = Camera(1600, 1200, [k["fx"], k["fy"]], [k["cx"], k["cy"]], np.zeros(8))
    rows = np.genfromtxt(folder / "charuco_corners_opencv4.14.csv", delimiter=",", names=True)
    image, u, v = rows["image"], rows["u_px"], rows["v_px"]
    xyz, px = 1000 * np.column_stack([rows["X_m"], rows["Y_m"], 0 * u]), np.column_stack([u, v])
    views = Views(camera, tuple(View(xyz[image == i], px[image == i]) for i in range(16)))
    files = [yaml.safe_load((folder / "test_set_charuco" / "poses" / f"{i}.yaml").read_text()) for i in range(16)]
    poses = np.array([[pose[c] for c in ("qw", "qx", "qy", "qz", "x", "y", "z")] for pose in files])
    flange = Poses.from_quaternions(poses[:, :4], 1000 * poses[:, 4:])
    prior = camera_prior(Camera.of(camera, "OPENCV"))
    return pairs_of_views(flange, views, tuple(f"{i}.png" for i in range(16))), views, prior


@pytest.mark.slow
def test_what_is_wrong_with_the_data_is_said(charuco):
    pairs, views, prior = charuco
    plain = handeye(pairs, "eye-to-hand", views=views)
    assert any("camera file does not fit" in note for note in plain.notes)
    found = handeye(pairs, "eye-to-hand", views=views, options=HandEyeOptions(intrinsics=prior, with_scale=True))
    assert found.scale == pytest.approx(1.005, abs=0.002)
    assert 5 * found.sigma_scale < found.scale - 1
    assert found.reprojection.camera.distortion[0] == pytest.approx(-0.125, abs=0.03)  # a fit of corners alone: −0.12
    assert found.sigma["corner_px"] < 0.1
    assert 0.1 < found.sigma["board_mm"] < 0.3
    assert not found.outliers.any()
    assert any("σ were widened" in note for note in found.notes)
