"""Two real data sets, from photographs: the acceptance figures; and the published experiment in simulation."""

import numpy as np
import pytest
import yaml

from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Poses
from stcal.handeye import METHODS, HandEyeOptions, View, Views, pairs_of_views
from stcal.io.cameras.camera_model import camera_prior
from tests.scripts import load_script
from tests.support.handeye import handeye

MEAN_MM = 0.85
"""3-D error at the board that poses held out may have in the mean. It is 0.756 mm (0.73 to 0.77 with corners refined in
other windows), with a standard error of 0.05 over the 15 splits; published for these data, in sample: 0.96 mm."""
SHEET_PITCH_MM = 24.8
"""In all images the dots' sheet is 17.4 by 11.3 pitches: the sides of an 11 × 17 in sheet (431.8 × 279.4 mm) ask for
24.8 and 24.7 mm. The label says 20, the data set's own file 25.4."""


@pytest.fixture(scope="module")
def script():
    return load_script("handeye_shared")


@pytest.mark.full
def test_charuco_photographs(script, shared_data, tmp_path):
    data = shared_data("charuco_handeye").parent
    splits = script.SPLITS | {"workers": 1}
    ours, text = script.charuco(data, tmp_path / "a", splits)
    park, _ = script.charuco(data, tmp_path / "b", splits, "park-martin")
    errors, others = script.by_split(ours), script.by_split(park)
    assert (len(ours["poses"]), ours["outliers"], ours["left_out"]) == (16, [], [])
    assert len(errors) == 15
    assert 0.3 < errors.mean() <= MEAN_MM
    assert (errors < others).all()
    assert ours["method"] == "reprojection"
    assert "3-D at the board" in text
    assert 0.5 < ours["sigma"]["corner_px"] < 1.5  # factor on the corners' own σ


@pytest.mark.full
def test_the_pitch_of_the_dots_is_found(script, shared_data, tmp_path):
    found, text = script.dots(shared_data("dotgrid_handeye").parent, tmp_path, {"repeats": 0, "workers": 1})
    board = found["board"]
    sigma_mm = 20 * board["scale_sigma"]
    assert len(found["poses"]) == 15
    assert len(found["outliers"]) <= 1
    assert abs(board["pitch_mm"] - SHEET_PITCH_MM) < 3 * sigma_mm < 0.5
    assert abs(board["pitch_mm"] - 20) > 10 * sigma_mm
    assert f"pitch {board['pitch_mm']:.4f} ± {sigma_mm:.4f} mm, stated 20 mm" in text
    # Turned by about a quarter about the optical axis, as the data set's first guess has it.
    rotation = np.array(found["flange_from_camera"])[:3, :3]
    guess = np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1.0]])
    assert np.degrees(np.arccos((np.trace(guess.T @ rotation) - 1) / 2)) < 10


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


@pytest.mark.slow
def test_a_seed_and_a_trial(capsys):
    study = load_script("reproduce_handeye")
    found = study.trial(3)
    for method in METHODS:
        motions, (mm, rad) = found[method]
        assert motions.shape == (6, 2)
        # 0.1 mm, 0.3 mrad and 0.1 px: 0.1 to 0.5 mm; the convex method is worse, evolution as published random.
        assert mm < {"de": 200, "zhao": 10, "li": 3}.get(method, 1.5)
        assert method == "de" or rad < np.radians(0.2)
    ratios = found["ratios"]
    assert all(value == pytest.approx(1, rel=1e-6) for name, value in ratios.items() if name.endswith("polished"))
    # Where it ends depends on the last bits of sums, hence on the machine: the order alone holds for each seed.
    unknown, *drawing, closed = (ratio for name, ratio in ratios.items() if not name.endswith("polished"))
    assert unknown > max(drawing) > closed
    assert closed < 1.001
    study.print_tables([found])
    assert "| about the closed form: ±10°, ±20 mm |" in capsys.readouterr().out
    trial, method = load_script("handeye_study").camera_trial, "reprojection, camera solved for"
    # The square of six numbers of σ 1 is below 34 but once in 10⁵.
    by_sigma, off_mm2 = trial(method, "eye-to-hand", "camera ≈ robot", 1.0, 3)
    assert 0.1 < by_sigma < 34
    assert off_mm2 > 0
