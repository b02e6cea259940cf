"""σ that are stated of the robot, and the setup, are tested against the data by every method that uses them."""

import numpy as np
import pytest

from stcal.geometry.rigid import Poses
from stcal.handeye import HandEyeOptions, Noise, View, Views, pairs_of_views, splits
from stcal.handeye.data.pose_pairs import HandEyePoses
from stcal.handeye.handeye_problem import HandEyeProblem
from stcal.handeye.validate import better_setup
from tests.levels import sampled
from tests.support.handeye import disturbed, error, handeye, simulated, simulated_views

BAD = (8e-3, 3.0)
"""σ of a robot in need of repair: rad, mm."""
STATED = Noise(np.radians(0.02), 0.1)


@pytest.mark.parametrize("noise", [STATED, Noise(0.0, 0.0)])
@pytest.mark.parametrize("seed", sampled(range(2)))
def test_a_bad_robot_is_called_so_by_its_corners(noise, seed):
    truth = simulated_views(np.random.default_rng(seed), 14, "eye-in-hand", BAD, 0.1)
    told = handeye(truth.pairs, views=truth.views, options=HandEyeOptions(noise=noise))
    free = handeye(truth.pairs, views=truth.views)
    assert any("its σ are estimated instead; check the robot's poses" in note for note in told.notes)
    assert not any("board" in note for note in told.notes)
    np.testing.assert_allclose(told.covariance, free.covariance)
    assert told.sigma["robot_mm"] == pytest.approx(BAD[1], rel=0.5)
    assert {"robot_rad", "robot_mm"} <= set(told.estimated)


@pytest.mark.parametrize("camera", [(None, None), (1e-3, 0.3)])
def test_a_bad_robot_is_called_so_by_its_poses(camera):
    truth = simulated(np.random.default_rng(2), 16, "eye-in-hand", BAD, (1e-3, 0.3))
    told = handeye(truth.pairs, options=HandEyeOptions(noise=Noise(STATED.robot_rad, STATED.robot_mm, *camera)))
    assert any("its σ are estimated instead" in note for note in told.notes)
    off = np.linalg.norm(told.mount_from_camera.translation - truth.mount_from_camera.translation)
    assert off < 3 * np.sqrt(np.trace(told.covariance[3:, 3:]))


@pytest.mark.parametrize(("count", "camera"), [(4, (None, None)), (8, (1e-3, 0.3)), (20, (None, None))])
def test_a_robot_far_better_than_the_camera_is_believed(count, camera):
    """Its estimated σ are the camera's for the most part: it was doubted in all sets, and σ were up to 1.4 times too
    large. Of 10 sets one may be doubted by a chance of 1 in 200."""
    doubted = 0
    for seed in range(10):
        truth = simulated(np.random.default_rng(seed), count, "eye-in-hand", (1e-4, 0.03), (1e-3, 0.3))
        found = handeye(truth.pairs, options=HandEyeOptions(noise=Noise(1e-4, 0.03, *camera)))
        doubted += any("estimated instead" in note for note in found.notes)
    assert doubted <= 1


def test_errors_of_a_stated_pair_widen_sigma():
    """Robot exact and camera five times as bad as stated: σ of the answer are five times as large."""
    truth = simulated(np.random.default_rng(3), 20, camera=(1e-3, 0.3))
    right = handeye(truth.pairs, options=HandEyeOptions(noise=Noise(0.0, 0.0, 1e-3, 0.3)))
    told = handeye(truth.pairs, options=HandEyeOptions(noise=Noise(0.0, 0.0, 2e-4, 0.06)))
    np.testing.assert_allclose(np.diag(told.covariance), np.diag(right.covariance), rtol=0.5)
    assert "times what the stated σ make expect" in told.notes[-1]
    assert right.notes == ()


@pytest.mark.parametrize("setup", ["eye-in-hand", "eye-to-hand"])
@pytest.mark.parametrize("seed", sampled(range(3)))
def test_the_other_setup_is_named_where_it_predicts_better(setup, seed):
    truth = simulated(np.random.default_rng(seed), 5, setup, (5e-3, 2.0), (2e-3, 0.5))
    other = {"eye-in-hand": "eye-to-hand", "eye-to-hand": "eye-in-hand"}[setup]
    assert better_setup(HandEyeProblem(truth.pairs, setup), splits(5)) == ()
    (note,) = better_setup(HandEyeProblem(truth.pairs, other), splits(5))
    assert f"give --setup {setup} if it is that" in note


@pytest.mark.slow
@pytest.mark.parametrize("method", ["pose", "reprojection"])
def test_poses_at_one_place_of_the_robot_count_once(method):
    """Six places, four detections at each, in which the robot's error is the same; taken for independent, the mean of
    the squared error over the covariance is 18 by poses, and 5.9 by corners."""
    squares = []
    for seed in range(16):
        rng = np.random.default_rng(seed)
        make = {"pose": simulated, "reprojection": simulated_views}[method]
        truth = make(rng, 6, "eye-in-hand", (1.7e-3, 0.6), **({"corner_px": 0.1} if method == "reprojection" else {}))
        flange, views = Poses.of([pose for pose in truth.pairs.base_from_flange for _ in range(4)]), None
        if truth.views is None:
            seen = Poses.of([pose for pose in truth.pairs.camera_from_board for _ in range(4)])
            pairs = HandEyePoses(flange, disturbed(rng, seen, 1e-4, 0.05))
        else:
            again = [view for view in truth.views.views for _ in range(4)]
            moved = [View(v.xyz_board, v.xy_px + rng.normal(0, 0.1, v.xy_px.shape)) for v in again]
            views = Views(truth.views.camera, tuple(moved))
            pairs = pairs_of_views(flange, views)
        found = handeye(pairs, views=views)
        off = error(found, truth)
        squares.append(off @ np.linalg.solve(found.covariance, off) / 6)
        assert any("several times at one place" in str(note) for note in found.notes)
    assert np.mean(squares) < 2.5
