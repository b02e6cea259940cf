"""What a user gets who names no method: chosen by errors on poses held out."""

import re
from dataclasses import replace

import numpy as np
import pytest

from stcal.geometry.camera import Camera
from stcal.handeye import HandEyeOptions, Noise, Views, pairs_of_views, splits
from stcal.handeye.choose import BY_VIEWS, CLOSED_FORMS, Tried, Way, choose, widened
from stcal.handeye.handeye_problem import HandEyeProblem
from stcal.io.cameras.camera_model import camera_prior
from tests.levels import sampled
from tests.support.handeye import CAMERA, error, handeye, simulated, simulated_views

ROBOT = (5e-4, 0.2)
"""σ of a common arm: rad, mm."""


def filed(truth, camera):
    views = Views(camera, truth.views.views)
    return pairs_of_views(truth.pairs.base_from_flange, views, truth.pairs.names), views


def prior_of(camera):
    return camera_prior(Camera.of(camera, "OPENCV"))


def chosen(truth, camera=CAMERA, count=10, seed=0):
    pairs, views = filed(truth, camera)
    return choose(HandEyeProblem(pairs, truth.setup, views), prior_of(camera), splits(len(pairs), None, count, seed))


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
def test_no_way_predicts_much_better_than_the_one_chosen():
    """The robot's reach errs by 1 %, which is no noise of single poses, and the images are poor."""
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


@pytest.mark.slow
def test_steps_from_the_solution_of_all_are_solutions_of_the_others():
    """Without three of fourteen poses: within a tenth of σ of what these eleven give by themselves."""
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
