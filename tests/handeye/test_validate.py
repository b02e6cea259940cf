"""Held-out errors, the comparison of methods, and what a user gets who names none: chosen by errors on poses held out.
Robots of four axes, of which all but one number is found. Errors that the board's poses have in common, as those of a
camera that was found, are in σ of the hand-eye."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Poses, Rigid
from stcal.handeye import (
    HandEyeOptions,
    HandEyePoses,
    HeldOutPoses,
    Noise,
    Views,
    compare,
    cross_validate,
    motion_errors,
    pairs_of_views,
    predict_motions,
    splits,
)
from stcal.handeye import handeye as answer
from stcal.handeye.choose import BY_VIEWS, CLOSED_FORMS, Tried, Way, choose, widened
from stcal.handeye.data.pose_pairs import SETUPS, Loop, Motions, read_poses
from stcal.handeye.handeye_problem import HandEyeProblem
from stcal.handeye.validate import ERRORS, errors_of, with_common_errors, with_jackknife
from stcal.io.cameras.camera_model import camera_prior
from stcal.io.join import join_tables
from stcal.io.table import COVARIANCE, common_columns
from stcal.workflows.handeye_inputs import PREFIXES, HandEyeInput
from stcal.workflows.handeye_run import calibrate_handeye
from tests.handeye.written import table
from tests.levels import sampled
from tests.outcome import fails_with, refuses
from tests.support.handeye import (
    BASE_FROM_CAMERA,
    CAMERA,
    FLANGE_FROM_BOARD,
    disturbed,
    error,
    handeye,
    simulated,
    simulated_views,
    squared,
)


def test_splits_hold_out_a_quarter_and_of_nothing_but_outliers_there_is_no_mean():
    assert (splits(12, 3, 8) == splits(12, None, 8)).all()
    assert splits(4).shape == (15, 1)
    refuses("E-HELD-OUT-FEW … 5 … 7 … 2 … 3", splits, 7, 5)
    for held_out in (0, -1):
        refuses(f"E-OPTION-RANGE … held_out {held_out}: 1 or more needed", splits, 10, held_out)
    held = HeldOutPoses(np.array([[0], [1]]), np.array([[1.0], [2.0]]), np.array([[3.0], [4.0]]))
    assert held.means(np.array([False, True]))["translation_mm"] == 4
    for outliers, agreeing in (([True, True], None), ([False, False], None), ([True, False], {"rotation_rad": 2.0})):
        found = held.summary(np.array(outliers))["agreeing"]
        assert found is None if agreeing is None else agreeing.items() <= found.items()


@pytest.mark.parametrize("setup", SETUPS)
def test_held_out_errors_are_those_of_the_poses(setup):
    """Of many poses X is well known, and what is left is the noise of a pose: a length of 3 coordinates, √(8/π) σ in
    the mean. 48 values scatter by 0.42/√48 = 6 %; X adds 12/60 of the variance at most."""
    truth = simulated(np.random.default_rng(1), 60, setup, camera=(1e-3, 0.3))
    means = cross_validate(truth.pairs, setup, "pose", rows=splits(60, 12, 4)).means()
    assert means == pytest.approx(
        {"rotation_rad": np.sqrt(8 / np.pi) * 1e-3, "translation_mm": np.sqrt(8 / np.pi) * 0.3}, rel=0.2
    )


def test_errors_at_the_board():
    """A chain 1 mm off across the line of sight is 1 mm off at the board by both measures; along it, by one only."""
    truth = simulated_views(np.random.default_rng(2), 6, "eye-to-hand")
    exact = handeye(truth.pairs, "eye-to-hand", views=truth.views, options=HandEyeOptions(noise=Noise(board_mm=0)))
    seen = HandEyeProblem(truth.pairs, "eye-to-hand", truth.views)[np.array([0])]
    assert [errors_of(exact, seen)[name].item() < 1e-3 for name in ERRORS] == [True] * 4
    for shift, on_board in (([1.0, 0, 0], 1.0), ([0, 0, 1.0], 0.0)):
        moved = exact.mount_from_camera @ Rigid(np.eye(3), shift)
        errors = errors_of(replace(exact, mount_from_camera=moved), seen)
        _, distance, board, pose = (errors[name].item() for name in ERRORS)
        assert distance == pytest.approx(1, abs=1e-2)
        assert pose == pytest.approx(1, abs=1e-2)
        # The board is tilted by up to 29° and seen up to 20° off the axis.
        assert board == pytest.approx(on_board, abs=0.6)


@pytest.mark.full
def test_solutions_of_parts_scatter_as_sigma_says():
    """40 splits of 20 poses: six numbers each, of which 20/5 · 6 are independent, so that one set's ratio scatters by
    1/√(2·24) = 14 %, the mean of eight by 5 %; three times that. σ that are three times too small are put right."""
    ratios = []
    for seed in range(8):
        truth = simulated(np.random.default_rng(seed), 20, robot=(5e-4, 0.2), camera=(5e-4, 0.2))
        found = handeye(truth.pairs, truth.setup)
        held_out = cross_validate(truth.pairs, truth.setup, rows=splits(20, 5, 40))
        ratios.append(held_out.scatter(found))
        sure = replace(found, covariance=found.covariance / 9)
        wide = held_out.widened(sure)
        assert np.allclose(wide.covariance, ratios[-1] ** 2 * found.covariance)
        assert any("solutions of parts of the poses scatter" in note for note in wide.notes)
    assert np.mean(ratios) == pytest.approx(1, abs=0.15)
    assert np.isnan(held_out.scatter(handeye(truth.pairs, truth.setup, "li")))


def test_the_last_motions_are_predicted_by_those_before():
    """Exact poses: exactly. A mount 1 mm off across a motion's axis turns with it: Â is off by 2 sin(½ angle) mm."""
    truth = simulated(np.random.default_rng(4), 9, "eye-in-hand", robot=(1e-9, 1e-9), camera=(1e-9, 1e-9))
    found = predict_motions(truth.pairs, "eye-in-hand", "pose", count=3)
    names = truth.pairs.names
    assert found.fitted == 5
    assert found.names == tuple((names[i], names[i + 1]) for i in (5, 6, 7))
    assert found.translation_mm.max() < 1e-5
    motions = Motions.consecutive(Loop.of(truth.pairs, "eye-in-hand"))
    axis = motions.alpha / np.linalg.norm(motions.alpha, axis=1, keepdims=True)
    across = np.cross(axis[0], [0.3, -0.5, 0.8])
    across /= np.linalg.norm(across)
    off = Rigid(np.eye(3), across) @ truth.mount_from_camera
    expected = 2 * np.sin(np.linalg.norm(motions.alpha[0]) / 2)
    assert motion_errors(off, motions)[0] == pytest.approx([0, expected], abs=1e-5)
    refuses("E-OPTION-RANGE … --motions-held-out … 7 … 8 … 6", predict_motions, truth.pairs, count=7)


def scara(rng, count=12, setup="eye-to-hand", sigma=(5e-4, 0.1)):
    """A robot of four axes: its flange looks down and turns about the vertical only."""
    down = Rotation.from_euler("x", 180, degrees=True)
    about = Rotation.from_rotvec(np.column_stack([np.zeros((count, 2)), rng.uniform(-1.5, 1.5, count)]))
    place = rng.uniform([200, -200, 0], [500, 200, 100], (count, 3))
    flange = Poses((about * down).as_matrix(), place)
    board = BASE_FROM_CAMERA.inverse() @ (flange @ FLANGE_FROM_BOARD)
    return HandEyePoses(flange, disturbed(rng, board, *sigma))


def test_four_axes_give_all_but_one_number_and_a_method_that_fails_says_why():
    """BASE_FROM_CAMERA but for its height, which is said; the chain still closes."""
    pairs = scara(np.random.default_rng(10))
    refuses("E-HANDEYE-AXES … 0 … 0 … 1 … 0° … 30 … --four-dof", handeye, pairs, "eye-to-hand")
    found = handeye(pairs, "eye-to-hand", options=HandEyeOptions(four_dof=True))
    away = BASE_FROM_CAMERA.inverse() @ found.base_from_camera
    assert away.angle_rad() < 3e-3
    assert found.base_from_camera.translation[:2] == pytest.approx(BASE_FROM_CAMERA.translation[:2], abs=2)
    assert found.base_from_camera.translation[2] == pytest.approx(0, abs=1e-9)
    assert any("base_from_camera is not known along (0, 0, 1) of the base" in note for note in found.notes)
    assert found.rms()[1] < 0.3
    sigma = np.sqrt(np.diag(found.covariance))
    assert sigma[5] < 1e-5 < sigma[3] < 1
    options = HandEyeOptions(four_dof=True)
    refuses("E-HANDEYE-AXES … park-martin", handeye, pairs, "eye-to-hand", "park-martin", options=options)
    truth = simulated(np.random.default_rng(4), 12, camera=(1e-3, 0.3))
    scale = compare(truth.pairs, rows=splits(12, 3, 2), methods=("pose", "li"), options=HandEyeOptions(with_scale=True))
    assert [c.reason for c in scale] == ["", ""]
    pairs, options = scara(np.random.default_rng(4), sigma=(0, 0)), HandEyeOptions(four_dof=True)
    found = compare(pairs, "eye-to-hand", options=options, rows=splits(12, 3, 4))
    by = {c.method: c for c in found}
    assert by["pose"].held_out.means()["translation_mm"] < 1e-3
    assert by["shah"].result is None
    assert "needs turns about two axes" in by["shah"].reason
    with fails_with("E-HANDEYE-FEW-POSES … 3"):  # a split that cannot be solved
        cross_validate(truth.pairs, rows=np.arange(2, 12)[None])


@pytest.mark.slow
def test_four_axes_are_true_to_their_covariance():
    """15 trials of the 5 numbers that are found: χ² of 75, once in a thousand beyond."""
    found = [
        handeye(scara(np.random.default_rng(s)), "eye-to-hand", options=HandEyeOptions(four_dof=True))
        for s in range(15)
    ]
    true = Poses.of([BASE_FROM_CAMERA])
    errors = np.array([Poses.of([f.base_from_camera]).difference(true)[0, :5] for f in found])
    squared = [e @ np.linalg.solve(f.covariance[:5, :5], e) for e, f in zip(errors, found, strict=True)]
    assert 0.76 < np.sqrt(np.mean(squared) / 5) < 1.24


ROBOT = (5e-4, 0.2)
"""σ of a common arm: rad, mm."""


def filed(truth, camera):
    views = Views(camera, truth.views.views)
    return pairs_of_views(truth.pairs.base_from_flange, views, truth.pairs.names), views


def chosen(truth, camera=CAMERA, count=10, seed=0):
    pairs, views = filed(truth, camera)
    prior = camera_prior(Camera.of(camera, "OPENCV"))
    return choose(HandEyeProblem(pairs, truth.setup, views), prior, splits(len(pairs), None, count, seed))


def off_mm(found, truth):
    return np.linalg.norm(found.mount_from_camera.translation - truth.mount_from_camera.translation)


@pytest.mark.parametrize("seed", sampled(range(3), kept=()))
def test_files_that_are_right_are_trusted(seed):
    truth = simulated_views(np.random.default_rng(seed), 14, "eye-in-hand", ROBOT, 0.1)
    found = chosen(truth)
    assert found.chosen.method == "reprojection"
    assert [each.candidate for each in found.tried] == list(BY_VIEWS)
    assert "by poses held out" in found.sentence
    # What is printed is what poses held out by none really show: the robot's error, 3-D, a little less across.
    assert 0.5 * ROBOT[1] < found.held_out.board_mm.mean() < 4 * ROBOT[1]


@pytest.mark.full
def test_a_camera_file_that_is_wrong_is_found_out():
    camera = Camera(1280, 1024, [1478.0, 1478.0], [655.5, 500.5], np.zeros(8))  # 2 %, 16 px, and no distortion
    truth = simulated_views(np.random.default_rng(5), 14, "eye-in-hand", ROBOT, 0.1)
    found = chosen(truth, camera)
    assert found.chosen.camera
    plain = next(each for each in found.tried if each.candidate == Way("reprojection"))
    assert plain.mean_mm > 1.5 * found.held_out.board_mm.mean()
    assert "the camera file costs" in found.sentence
    pairs, views = filed(truth, camera)
    assert off_mm(found.result, truth) < off_mm(handeye(pairs, truth.setup, views=views), truth) / 2


@pytest.mark.parametrize(
    ("scale", "said"),
    sampled([(1.0, ""), (1.02, "% larger than stated")], kept=(0, 1)),
)
def test_poses_alone_are_chosen_among_too(scale, said):
    truth, pairs = pairs_of_size(scale, 7, 16)
    found = choose(HandEyeProblem(pairs, truth.setup), None, splits(16, None, 8))
    assert found.chosen.name == ("pose + scale" if said else "pose")
    assert said in found.sentence
    if said:
        assert found.result.scale == pytest.approx(scale, abs=4 * found.result.sigma_scale)
    assert found.held_out.board_mm is None
    assert found.held_out.rows.shape == (8, 4)


def pairs_of_size(scale, seed, count=15):
    """Poses in front of a board that is ``scale`` times as large as its file says."""
    truth = simulated(np.random.default_rng(seed), count, "eye-in-hand", ROBOT, (5e-4, 0.2))
    eye = truth.pairs.camera_from_board
    return truth, replace(truth.pairs, camera_from_board=replace(eye, translation=eye.translation / scale))


@pytest.mark.parametrize("seed", sampled((28, 32, 33, 34), kept=(0, 2)))
def test_sound_poses_are_taken_as_filed(seed):
    """Sets on whose poses held out the scale (28, 32) or a closed form (33, 34) is ahead, by chance."""
    truth, pairs = pairs_of_size(1.0, seed)
    found = choose(HandEyeProblem(pairs, truth.setup), None, splits(15))
    by_pose = handeye(pairs, truth.setup, "pose")
    free = handeye(pairs, truth.setup, "pose", options=HandEyeOptions(with_scale=True))
    assert abs(free.scale - 1) < 2.5 * free.sigma_scale
    assert found.chosen == Way("pose")
    assert off_mm(found.result, truth) == pytest.approx(off_mm(by_pose, truth), abs=1e-9)
    assert not [note for note in found.result.notes if "scatter" in note]
    assert np.sqrt(found.result.covariance[3, 3] / by_pose.covariance[3, 3]) < 1.5


def test_answers_that_contradict_widen_sigma():
    """Another way is 5 mm off: as far as that is more than σ explain, spread over six parameters."""
    truth = simulated(np.random.default_rng(9), 12, "eye-in-hand", ROBOT)
    plain = handeye(truth.pairs)
    x = replace(plain.mount_from_camera, translation=np.add(plain.mount_from_camera.translation, [5.0, 0, 0]))
    rival = Tried(Way("pose", scale=True), result=replace(plain, mount_from_camera=x))
    assert widened(plain, Way("pose"), [replace(rival, result=plain)])[1] == ()
    found, (note,) = widened(plain, Way("pose"), [rival])
    assert "pose + scale predicts as well as pose" in note
    assert re.search(r" 5(\.\d)? mm off", note)
    factor = np.sqrt(found.covariance[3, 3] / plain.covariance[3, 3])
    assert f"{factor:.2g} times what their σ allow" in note
    assert 0.5 * 5 / np.sqrt(6) < np.sqrt(found.covariance[3, 3]) < 1.5 * 5 / np.sqrt(6)


@pytest.mark.slow
def test_no_way_predicts_much_better_than_the_one_chosen_and_steps_from_all_are_solutions_of_the_others():
    """The robot's reach errs by 1 %, which is no noise of single poses, and the images are poor. Without three of
    fourteen poses: within a tenth of σ of what these eleven give by themselves."""
    truth = simulated(np.random.default_rng(0), 10, "eye-in-hand", (1e-3, 0.5), (1.5e-3, 1.0))
    flange = truth.pairs.base_from_flange
    middle = flange.translation.mean(0)
    bent = flange.translation + (flange.translation - middle) @ np.random.default_rng(1).normal(0, 0.01, (3, 3))
    pairs = replace(truth.pairs, base_from_flange=replace(flange, translation=bent))
    found = choose(HandEyeProblem(pairs, truth.setup), None, splits(10, None, 6))
    mean = {each.candidate: each.mean_mm for each in found.tried}
    assert set(CLOSED_FORMS) <= set(mean)
    assert mean[found.chosen] <= 1.1 * min(mean.values())
    assert found.result.covariance.shape == (6, 6)
    truth = simulated_views(np.random.default_rng(2), 14, "eye-in-hand", ROBOT, 0.1)
    noise = Noise(*ROBOT, corner_px=0.1, board_mm=0.01)
    out, options = np.array([2, 5, 11]), HandEyeOptions(noise)
    remaining = np.setdiff1d(np.arange(14), out)
    for method in ("pose", "reprojection", "shah"):
        near = HandEyeProblem(truth.pairs, truth.setup, truth.views, options).solved(method).without(out)
        exact = handeye(truth.pairs[remaining], truth.setup, method, truth.views[remaining], options)
        moved = error(near, exact)
        size = [1e-9] * 6 if exact.covariance is None else np.sqrt(np.diag(exact.covariance))
        assert (np.abs(moved) < 0.1 * np.array(size)).all(), method


IN_COMMON = np.array([[1e-3, 0, 0, 0, 0.4, 0], [0, -1e-3, 0, 0.4, 0, 0], [0, 0, 0, 0, 0, 0.8]]).T
"""Errors of the principal point and of the focal length at about 450 mm, rad and mm, (6, 3)."""
OWN = np.diag(np.repeat([2e-4, 0.05], 3) ** 2)
DRAWS = 12


def draw(seed: int, count: int = 16, stated: bool = True, size_sigma: float | None = None):
    """Pairs with these errors, or with a common one of the board's size alone, which they state, and the truth."""
    rng = np.random.default_rng(seed)
    truth = simulated(rng, count, robot=(1e-4, 0.03))
    pairs = truth.pairs
    common = np.tile(IN_COMMON, (count, 1, 1))
    if size_sigma is not None:
        common = size_sigma * np.pad(pairs.camera_from_board.translation, ((0, 0), (3, 0)))[:, :, None]
    noise = rng.normal(size=(count, 6)) @ np.linalg.cholesky(OWN).T + common @ rng.normal(size=common.shape[2])
    pairs = replace(
        pairs,
        camera_from_board=pairs.camera_from_board.moved(noise),
        camera_from_board_covariance=OWN + common @ np.swapaxes(common, 1, 2),
        camera_from_board_common=common if stated else None,
    )
    return pairs, truth


def by_the_jackknife(pairs):
    solution = HandEyeProblem(pairs).solved("shah")
    result = with_jackknife(solution.result, [solution.without(np.array([i])) for i in range(len(pairs))])
    return with_common_errors(result, HandEyeProblem(pairs))


@pytest.mark.slow
@pytest.mark.parametrize("method", ["pose", "shah", None])
def test_sigma_hold_with_common_errors(method):
    """The mean of 6·n squared normal numbers lies within these limits in 998 of 1000 studies; without the common errors
    it is many times as large."""
    draws = {"pose": DRAWS, "shah": 10}.get(method, 1)
    limits = chi2.ppf([0.001, 0.999], 6 * draws) / 6 / draws
    found = []
    for seed in range(draws):
        pairs, truth = draw(seed)
        result = {"pose": handeye, "shah": by_the_jackknife}.get(method, answer)(pairs)
        found.append(squared(result, truth) / 6)
        assert any("in common" in note for note in result.notes)
    assert np.mean(found) < limits[1] * (1.3 if method == "shah" else 1)  # a jackknife of sixteen poses
    if method == "pose":
        assert np.mean(found) > limits[0] / 1.3  # σ of the robot and factors are estimated
    pairs, truth = draw(0, stated=False)
    assert squared(handeye(pairs), truth) / 6 > 10 * limits[1]


def test_the_scale_takes_up_a_common_error_of_the_size():
    """With the scale among the unknowns, σ of X do not contain an error that it takes up; limits as above."""
    limits = chi2.ppf([0.001, 0.999], 6 * DRAWS) / 6 / DRAWS
    found = []
    for seed in range(DRAWS):
        pairs, truth = draw(seed, size_sigma=0.01)
        result = handeye(pairs, method="pose", options=HandEyeOptions(with_scale=True))
        found.append(squared(result, truth) / 6)
        assert np.sqrt(result.covariance[3:, 3:].trace()) < 1  # without a scale: several mm
    assert limits[0] / 1.3 < np.mean(found) < limits[1] * 1.3  # σ of the robot and factors are estimated


def test_they_are_read_from_what_measure_writes(tmp_path):
    """Also where the file states the inverse transforms, whose errors differ."""
    pairs, _ = draw(0)
    flange, board = pairs.base_from_flange, pairs.camera_from_board
    (i, j), images = np.triu_indices(6), [f"{k}.jpg" for k in range(len(board))]
    errors = dict(zip(COVARIANCE, pairs.camera_from_board_covariance[:, i, j].T.tolist(), strict=True))
    common = np.swapaxes(pairs.camera_from_board_common, 1, 2).reshape(len(board), -1)
    errors |= dict(zip(common_columns(3), common.T.tolist(), strict=True))
    robot = table(tmp_path / "robot.csv", {"": flange}, image=images)
    joined = join_tables(robot, table(tmp_path / "poses.csv", {"": board}, image=images, **errors), "image", PREFIXES)
    as_read = read_poses(joined.table)
    assert np.allclose(as_read[[3, 5]].camera_from_board_common, pairs.camera_from_board_common[[3, 5]], rtol=1e-9)
    other = ("camera_from_board", "board_from_camera")
    columns = {name.replace(*other): own for name, own in joined.table.columns.items()}
    inverse = read_poses(replace(joined.table, columns=columns))
    step = 1e-4 * pairs.camera_from_board_common[:, :, 1]
    moved = board.moved(step).inverse().difference(board.inverse())
    assert np.allclose(1e-4 * inverse.camera_from_board_common[:, :, 1], moved, rtol=1e-3, atol=1e-9)


def test_the_verdict_does_not_ask_for_more_poses_and_says_what_sigma_lack_without_covariances():
    pairs, _ = draw(0)
    found = answer(pairs)
    assert found.verdict.word == "use with care"
    assert "have in common" in found.verdict.sentence()
    assert "more poses do not help" in found.verdict.reasons()[0].remedy
    assert np.linalg.eigvalsh(found.covariance - found.common_covariance).min() > 0
    pairs = simulated(np.random.default_rng(3), 12, robot=(1e-4, 0.03), camera=(2e-4, 0.05)).pairs
    stated = replace(pairs, camera_from_board_covariance=np.tile(OWN, (12, 1, 1)))
    notes = [calibrate_handeye(HandEyeInput("t", each), "pose", repeats=0).all_notes() for each in (pairs, stated)]
    assert [any("state no covariance" in note for note in each) for each in notes] == [True, False]
