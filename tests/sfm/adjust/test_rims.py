"""Rims in front of circles, from the change of their radii with tilt, and faces of the surface behind them."""

from dataclasses import replace

import numpy as np
import pytest

from stcal.boards.board_file import board_toml, load_board
from stcal.boards.target_file import load_target, target_toml
from stcal.sfm.adjust.joint import adjusted
from stcal.sfm.adjust.rims import RadiusViews, Rim, _rim, find_rims, lost_radius_mm
from stcal.sfm.checks.board_checks import rim_check
from stcal.sfm.detect.candidates import EllipseOptions
from stcal.sfm.detect.image import detect_image
from stcal.sfm.detect.labelling import label_single
from stcal.sfm.planning.forecast import observe, true_models
from stcal.sfm.runs.run_options import RunOptions
from stcal.synthetic.render import RenderOptions, render
from tests.levels import sampled
from tests.outcome import fails_with


@pytest.fixture(scope="module")
def scene(small_scene):
    return small_scene


def rim_of(short, tangent, radius, blur, image) -> Rim:
    """The rim of 240 circles whose light is even."""
    none, index = np.zeros(240), np.arange(240)
    return _rim(RadiusViews(index, image, radius, 1 + short / radius, none, blur, tangent, np.zeros((240, 2)), none))


def rims_of(scene, rim_mm, **look):
    images = []
    for i in range(4):
        picture = render(scene, "12", i, RenderOptions(seed=5, rim_mm=rim_mm, clutter=False, **look))
        found = detect_image(picture, scene.camera, scene.target, None, EllipseOptions())
        images.append(label_single(f"12/{i:04d}", "12", found, scene.target).observations)
    radius = scene.target.radius_of() | scene.board.radius_of()
    return find_rims(true_models(scene, images), images, radius, scene.camera)


@pytest.mark.parametrize("rim_mm", sampled([0.3, 0.15]))
def test_the_height_of_a_rim_is_found(scene, rim_mm):
    """Within 10 %, as the area of the lens-shaped image is that of an ellipse to second order alone, and within 3 σ."""
    rim = rims_of(scene, rim_mm)["circles"]
    assert rim.height_mm == pytest.approx(rim_mm, abs=0.1 * rim_mm + 3 * rim.sigma_mm)
    assert rim.height_mm > 4 * rim.sigma_mm
    check = rim_check({"circles": rim}, 0.002, {})
    assert check.verdict == "suspicious"
    assert "in front of the luminous surface" in check.reason
    assert rim_check({"circles": rim}, 0.002, {"circles": rim_mm}).verdict == "passed"


@pytest.mark.parametrize("look", sampled([{}, {"fade": 0.25}, {"fade": 0.25, "blur_px": 1.2}], kept=(2,)))
def test_no_rim_is_found_where_there_is_none(scene, look):
    """Nor where discs have a quarter less light at their rim, which makes them look smaller."""
    rims = rims_of(scene, 0.0, **look)
    assert abs(rims["circles"].height_mm) < 3 * rims["circles"].sigma_mm
    assert rim_check(rims, 0.002, {}).verdict == "passed"


def test_rims_that_harm_nothing_are_no_fault_need_the_joint_adjustment_and_are_stated_by_designs(scene, tmp_path):
    """It is seen with certainty, and moves faces by less than their σ."""
    assert rim_check({}, 0.002, {}).verdict == "not possible"
    assert rim_check({"circles": Rim(0.02, 0.001, 500)}, 0.02, {}).verdict == "passed"
    assert rim_check({"circles": Rim(0.02, 0.001, 500)}, 0.002, {}).verdict == "suspicious"
    for options, refusal in (
        ({"solve": "chain", "rim": True}, "E-RIM-SOLVE … --solve joint"),
        ({"solve": "paper", "rim": True}, "E-RIM-SOLVE … --solve joint"),
        ({"solve": "chain", "refine_camera": True}, "E-OPTION-NEEDS … --solve"),
    ):
        with fails_with(refusal):
            RunOptions(**options).settled(scene.target)
        assert RunOptions(rim=True).settled(scene.target).rim
    face = scene.target.faces[0]
    heights = np.where(np.arange(len(face.ids)) == 2, -0.1, 0.25)
    target = replace(scene.target, faces=(replace(face, rim_mm=heights), *scene.target.faces[1:]))
    (tmp_path / "target.toml").write_text(target_toml(target), encoding="utf-8")
    read = load_target(tmp_path / "target.toml")
    np.testing.assert_array_equal(read.faces[0].rim_mm, heights)
    assert read.faces[1].rim_mm is None
    assert read.rim_of() == dict(zip(face.labels(), heights.tolist(), strict=True))
    board = replace(scene.board, rim_mm=0.3)
    (tmp_path / "board.toml").write_text(board_toml(board), encoding="utf-8")
    assert load_board(tmp_path / "board.toml").rim_mm == 0.3
    rims = {"dots": Rim(0.31, 0.01, 500)}
    assert "the board lies 0.155 mm in front of" in rim_check(rims, 0.002, {}).reason
    passed = rim_check(rims, 0.002, {"dots": board.rim_mm})
    assert passed.verdict == "passed"
    assert "0.3 mm stated" in passed.reason


def test_a_rim_hides_what_is_not_in_common_of_two_discs_and_rims_of_dots_move_the_board_alone(scene):
    """Of the radius by area. That of the fit, which follows the rim, is less by up to 2 %."""
    apart = np.array([0.05, 0.1, 0.15])
    area = 2 * np.arccos(apart / 2) - apart / 2 * np.sqrt(4 - apart**2)
    np.testing.assert_allclose(lost_radius_mm(0.1, 10 * 5.0 * apart, 5.0) / 5.0, 1 - np.sqrt(area / np.pi), rtol=0.02)
    models = true_models(scene, observe(scene, 0.01, np.random.default_rng(0)))
    seen, surface = (adjusted(models, replace(scene.board, rim_mm=h), scene.camera).result() for h in (0.0, 0.3))
    np.testing.assert_allclose(surface.xyz_model, seen.xyz_model, atol=1e-6)
    moved = surface.model_from_board["12"].translation - seen.model_from_board["12"].translation
    np.testing.assert_allclose(moved, 0.15 * seen.model_from_board["12"].rotation[:, 2], atol=1e-6)


def test_a_blur_corrected_by_too_little_is_no_rim_and_errors_common_to_an_image_are_in_sigma():
    """Radii that blur makes smaller, by a fifth more than is put back, in views of other tilts and distances. Then
    twelve images of one tilt each, of 20 circles: a common error as large as that of single circles. With σ of
    independent circles, and the least σ of a rim, the mean square is 2.6."""
    for height_mm in (0.0, 0.05):
        rng = np.random.default_rng(3)
        tangent, distance = rng.uniform(0.1, 2.0, 240), rng.uniform(0.8, 1.4, 240)
        radius = np.where(np.arange(240) % 2, 4.0, 8.0)
        blur = 0.02 * distance**2 / radius * 6 * np.sqrt(1 + tangent**2)
        noise = rng.normal(0, 0.003, 240)
        short = noise + 0.2 * blur - lost_radius_mm(height_mm, tangent, radius)
        rim = rim_of(short, tangent, radius, blur, np.arange(240))
        assert rim.height_mm == pytest.approx(height_mm, abs=2.5 * rim.sigma_mm)
        assert 0.003 < rim.sigma_mm < 0.0125  # of 0.05 mm at four σ
    rng, normed = np.random.default_rng(5), []
    for _ in range(100):
        image = np.repeat(np.arange(12), 20)
        tangent, common = rng.uniform(0.1, 2.0, 12)[image], rng.normal(0, 0.003, 12)[image]
        rim = rim_of(common + rng.normal(0, 0.003, 240), tangent, np.full(240, 8.0), np.zeros(240), image)
        normed.append(rim.height_mm / rim.sigma_mm)
    assert 0.5 < np.mean(np.square(normed)) < 2.0
    assert np.mean(np.abs(normed) > 4) <= 0.01
