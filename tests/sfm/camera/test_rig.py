"""Cameras of one rig: against the truth and their own σ, instants that are none, and what is written."""

import json
from dataclasses import replace

import numpy as np
import pytest
import yaml
from scipy.stats import chi2

from stcal.design import BoardDesign
from stcal.geometry.rigid import Poses, Rigid
from stcal.io.cameras.read import read_lens
from stcal.labels import DotLabel
from stcal.sfm.adjust.refine import moved_poses
from stcal.sfm.camera.equations import Setting, derivatives
from stcal.sfm.camera.intrinsics import adjust_intrinsics, design_shapes, model_parameters
from stcal.sfm.camera.report import rig_report
from stcal.sfm.camera.rig import _sightings, _start, adjust_rig, gathered, rig_of, symmetries
from stcal.workflows.calibrate_camera import camera_names, files_of, models_of
from tests.outcome import fails_with
from tests.sfm.camera.rigs import alone, calibrated_alone, seen_by_rig
from tests.sfm.camera.test_intrinsics import BOARD


@pytest.fixture(scope="module")
def pair():
    seen = seen_by_rig(np.random.default_rng(1), 2, 8)
    return seen, alone(seen)


@pytest.fixture(scope="module")
def rig(pair):
    return rig_of(pair[1], BOARD)


def off(found: Rigid, truth: Rigid) -> np.ndarray:
    """Left perturbation that leads from the truth, (6,)."""
    return Poses.of([found]).difference(Poses.of([truth]))[0]


def squares(seen, rig) -> tuple[list[float], list[float]]:
    """χ² of each camera's place, six numbers, and of its intrinsics over their number."""
    places = [
        float(e @ np.linalg.solve(own, e))
        for found, true, own in zip(rig.camera_from_first[1:], seen.sits[1:], rig.covariance[1:], strict=True)
        for e in [off(found, true)]
    ]
    intrinsics = []
    for camera, truth in zip(rig.cameras, seen.cameras, strict=True):
        own = camera.intrinsics
        e = model_parameters(own.camera, own.colmap_model) - model_parameters(truth, own.colmap_model)
        intrinsics.append(float(e @ np.linalg.solve(own.covariance, e)) / len(e))
    return places, intrinsics


def test_two_lenses_are_where_they_are_within_their_sigma(pair, rig):
    seen, _ = pair
    places, intrinsics = squares(seen, rig)
    assert chi2.ppf(1e-4, 6) < places[0] < chi2.ppf(0.9999, 6)
    assert all(0.02 < each < chi2.ppf(0.9999, 4) / 4 for each in intrinsics)
    # Centres of 0.02 px at 0.5 m and f = 2800 px are 4 µm each: some hundred of them, in depth some times worse.
    sigma = np.sqrt(np.diag(rig.covariance[1]))
    assert (sigma[3:] > 5e-4).all()
    assert (sigma[3:] < 0.03).all()
    assert rig.factor == pytest.approx(1.0, abs=0.05)
    assert rig.covariance[0].any() == 0
    assert not rig.apart
    assert min(rig.shared) == 8


@pytest.mark.full
@pytest.mark.parametrize("count", [2, 3])
def test_errors_of_many_rigs_are_as_large_as_their_sigma(count):
    """Mean χ² of 6 rigs: over 6 numbers for each place it scatters by 0.24, of intrinsics by 0.17 with two cameras."""
    places, intrinsics = [], []
    for seed in range(6):
        seen = seen_by_rig(np.random.default_rng(100 + seed), count, 10)
        one, other = squares(seen, rig_of(alone(seen), BOARD))
        places += one
        intrinsics += other
    assert np.mean(places) / 6 == pytest.approx(1.0, abs=0.75)
    assert np.mean(intrinsics) == pytest.approx(1.0, abs=0.55)


def test_together_they_know_more_than_alone(pair, rig):
    _, cameras = pair
    for before, after in zip(cameras.values(), rig.cameras, strict=True):
        assert (after.intrinsics.sigma() < 1.02 * before.intrinsics.sigma()).all()
        assert np.median(after.projection.sigma_px) < np.median(before.projection.sigma_px)


def test_one_camera_is_adjusted_as_ever(pair):
    _, cameras = pair
    (single,) = [cameras["left"]]
    together = gathered(["left"], [single.intrinsics.camera], _sightings(0, single), BOARD)
    found = adjust_rig((single,), together, BOARD)
    views = [replace(v, covariance_px2=single.intrinsics.factors.centres**2 * v.covariance_px2) for v in single.views]
    same = adjust_intrinsics(views, BOARD, single.intrinsics.camera, "OPENCV")
    apart = model_parameters(found.state.cameras[0], "OPENCV") - model_parameters(same.camera, "OPENCV")
    assert (np.abs(apart) < 1e-5 * same.sigma()).all()  # the descents begin at poses of their own
    assert np.sqrt(np.diag(np.linalg.inv(found.last.normal))) == pytest.approx(same.sigma(), rel=1e-6)
    assert found.factors.centres == pytest.approx(same.factors.centres, rel=1e-6)
    assert found.factors.dots == pytest.approx(same.factors.dots, rel=1e-6)
    moved = model_parameters(same.camera, "OPENCV") - model_parameters(single.intrinsics.camera, "OPENCV")
    assert (np.abs(moved) < 0.01 * single.intrinsics.sigma()).all()


def test_derivatives_are_those_of_differences(pair):
    _, cameras = pair
    both = tuple(cameras.values())
    rows = [each for k, camera in enumerate(both) for each in _sightings(k, camera)]
    together = gathered(["left", "right"], [c.intrinsics.camera for c in both], rows, BOARD)
    state = _start(both, together, BOARD)
    basis = tuple(np.eye(16)[:, :1] for _ in both)
    weight = (np.eye(1),) * 2
    setting = Setting(basis, weight, state.cameras, design_shapes(state, BOARD), BOARD.sigma_mm, np.inf, rig=True)
    i = state.camera_of.index(1)
    model, camera = state.models[i], state.cameras[1]
    by_pose, _, by_shared = derivatives(state, setting, i)
    assert by_shared.shape[2] == 7
    for axis in range(6):
        size = 1e-6 if axis < 3 else 1e-3
        step = size * np.eye(6)[axis]
        poses = state.first_from_board["."]
        other = replace(state, first_from_board={".": moved_poses(poses, np.tile(step, (len(poses), 1)))}).seen()
        numeric = (model.residuals_px(camera) - other.models[i].residuals_px(camera)) / size
        assert by_pose[:, :, axis] == pytest.approx(numeric, rel=2e-3, abs=2e-3 * np.abs(numeric).max())
        sits = (state.camera_from_first[0], *moved_poses(state.camera_from_first[1:], step[None]))
        other = replace(state, camera_from_first=sits).seen()
        numeric = (model.residuals_px(camera) - other.models[i].residuals_px(camera)) / size
        assert by_shared[:, :, 1 + axis] == pytest.approx(numeric, rel=2e-3, abs=2e-3 * np.abs(numeric).max())


def half_turned(view):
    """Its dots counted from the other end of the board."""
    labels = tuple(DotLabel(BOARD.rows - 1 - label.row, BOARD.columns - 1 - label.column) for label in view.labels)
    return replace(view, labels=labels)


def test_dots_that_a_camera_counts_from_the_other_end_are_counted_alike(pair, rig):
    seen, cameras = pair
    turned = [half_turned(view) for view in seen.views[1]]
    other = calibrated_alone(seen.cameras[1], seen.models[1], turned)
    found = rig_of({"left": cameras["left"], "right": other}, BOARD)
    assert not found.apart
    assert found.camera_from_first[1].matrix() == pytest.approx(rig.camera_from_first[1].matrix(), abs=1e-3)


def test_a_view_of_another_instant_is_set_apart_and_named(pair):
    seen, cameras = pair
    first, second = seen.views[1][2].name, seen.views[1][5].name
    names = {first: second, second: first}
    right = cameras["right"]
    swap = [replace(v, name=names.get(v.name, v.name)) for v in right.views]
    models = tuple(
        replace(m, images=tuple(names.get(name, name) for name in m.images)) for m in right.intrinsics.models
    )
    swapped = replace(right, views=tuple(swap), intrinsics=replace(right.intrinsics, models=models))
    rig = rig_of({"left": cameras["left"], "right": swapped}, BOARD)
    assert {each.image for each in rig.apart} == {first, second}
    assert all("px RMS from where left saw it" in each.reason for each in rig.apart)
    assert any("2 views are none of their instant" in each for each in rig.warnings)
    assert rig.factor == pytest.approx(1.0, abs=0.05)
    places, _ = squares(seen, rig)
    assert places[0] < chi2.ppf(0.9999, 6)
    assert len(rig.instants) == len({v.name for views in seen.views for v in views}) + 2


def test_a_camera_that_shares_no_instant_is_named(pair):
    _, cameras = pair
    right = cameras["right"]
    names = {view.name: f"x{view.name}" for view in right.views}
    views = tuple(replace(v, name=names[v.name]) for v in right.views)
    models = tuple(replace(m, images=tuple(names[name] for name in m.images)) for m in right.intrinsics.models)
    other = replace(right, views=views, intrinsics=replace(right.intrinsics, models=models))
    with fails_with("E-RIG-UNLINKED … right … left"):
        rig_of({"left": cameras["left"], "right": other}, BOARD)


def test_instants_of_a_plain_board_that_never_turns_do_not_tell_its_ends(pair):
    _, cameras = pair
    both = tuple(cameras.values())
    rows = [each for k, camera in enumerate(both) for each in _sightings(k, camera)]
    shared = {each.instant for each in rows if each.camera == 1}
    one = [each for each in rows if each.instant == min(shared)]
    where = ["left", "right"], [c.intrinsics.camera for c in both], one
    with fails_with("E-RIG-TURNED … 1"):
        gathered(*where, BOARD)
    assert len(gathered(*where, replace(BOARD, corner=(0, 0), corner_radius_mm=9.0)).sightings) == 2
    twice = [*one, replace(one[1], view=replace(one[1].view, name=one[1].view.name.replace(".png", ".jpg")))]
    with fails_with("E-RIG-INSTANT … right"):
        gathered(*where[:2], twice, BOARD)


def test_square_boards_look_the_same_four_ways():
    square = BoardDesign(5, 5, 10.0, 2.0, "dark", 0.01)
    turns = symmetries(square)
    assert len(turns) == 4
    for turn in turns:
        cells = (turn @ square.places_mm(square.labels()))[:, :2] / 10
        assert cells == pytest.approx(np.round(cells), abs=1e-9)
        assert len(np.unique(np.round(cells), axis=0)) == 25


def test_files(pair, rig, tmp_path):
    seen, _ = pair
    files, missing = files_of(rig)
    assert not missing
    assert list(files) == ["left.txt", "left.json", "right.txt", "right.json", "rig.json", "camchain.yaml"]
    for name, content in files.items():
        (tmp_path / name).write_text(content)
    camera = read_lens(tmp_path / "right.txt")
    assert camera.covariance is not None
    assert np.sqrt(np.diag(camera.covariance)) == pytest.approx(rig.cameras[1].intrinsics.sigma(), rel=1e-6)
    summary = json.loads(files["rig.json"])
    assert np.array(summary["cameras"][1]["camera_from_first"]) == pytest.approx(rig.camera_from_first[1].matrix())
    chain = yaml.safe_load(files["camchain.yaml"])
    first_to_second = np.array(chain["cam1"]["T_cn_cnm1"])
    assert first_to_second[:3, 3] * 1e3 == pytest.approx(seen.sits[1].translation, abs=0.1)
    assert read_lens(tmp_path / "camchain.yaml", "cam1").focal == pytest.approx(camera.focal)
    assert "right_from_left" in rig_report(rig, "photographs").text()


@pytest.mark.slow
def test_page(rig):
    page = rig_report(rig, "photographs").page()
    assert page.count("data:image/svg") == 6  # two of the rig, two of each camera
    assert "right_from_left" in page


def test_lenses_that_kalibr_has_not(rig):
    own = rig.cameras[0].intrinsics
    lens = replace(own.camera, distortion=[-0.1, 0, 0, 0, 0.02, 0, 0, 0])
    rational = replace(rig.cameras[0], intrinsics=replace(own, cameras=(lens,)))
    files, missing = files_of(replace(rig, cameras=(rational, rig.cameras[1])))
    assert "camchain.yaml" not in files
    assert "no camchain.yaml: kalibr has no place for" in missing[0]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["left=OPENCV", "left=RADIAL"], "E-OPTION-REPEATED … left … OPENCV"),
        (["OPENCV", "RADIAL"], "E-OPTION-CONFLICT … OPENCV"),
    ],
)
def test_models_that_contradict_each_other(words, message):
    with fails_with(message):
        models_of(words, "OPENCV")
    assert models_of(["a=b=RADIAL", "PINHOLE"], "OPENCV") == ({"a=b": "RADIAL"}, "PINHOLE")


def test_folders_that_are_no_rig(tmp_path, stcal_sfm):
    (tmp_path / "one").mkdir()
    with fails_with("E-RIG-CAMERAS … 1"):
        camera_names(tmp_path)
    (tmp_path / "rig").mkdir()
    with fails_with("E-RIG-CAMERAS … 'rig'"):
        camera_names(tmp_path)
    code, _, message = stcal_sfm("calibrate-camera", tmp_path, "--rig", "--model", "two=RADIAL", "--out", "new")
    assert code == 2
    assert "camera name 'rig'" in message
    (tmp_path / "rig").rename(tmp_path / "left")
    code, _, message = stcal_sfm("calibrate-camera", tmp_path, "--rig", "--model", "two=RADIAL", "--out", "new")
    assert code == 2
    assert "--model two=…: no folder two" in message
    assert "it has left, one" in message
    code, _, message = stcal_sfm("calibrate-camera", tmp_path, "--rig", "--out", "new")
    assert code == 2
    assert "rig: left: image folder" in message
    code, _, message = stcal_sfm("calibrate-camera", tmp_path, "--model", "left=RADIAL")
    assert code == 2
    assert "names a camera of a rig; give --rig" in message
