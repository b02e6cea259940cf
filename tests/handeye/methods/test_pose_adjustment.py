"""Pose-error least squares: it reaches the bound, its covariance is true, bad poses are named."""

from dataclasses import replace

import numpy as np
import pytest

from stcal.errors import DegenerateError
from stcal.geometry.rigid import Poses, Rigid
from stcal.handeye import HandEyeOptions, HandEyePoses, Noise
from stcal.handeye.data.pose_pairs import SETUPS, Loop
from stcal.handeye.methods.pose_adjustment import components
from tests.support.handeye import error, handeye, normalised, simulated, simulated_views

TRUE = Noise(3e-4, 0.1, 1e-3, 0.3)


def bound(truth, noise):
    loop = Loop.of(truth.pairs, truth.setup)
    slope = loop.jacobian(truth.mount_from_camera)
    spread = components(loop, noise, truth.mount_from_camera).known
    return np.linalg.inv(np.einsum("mai,maj->ij", slope, np.linalg.solve(spread, slope)))[:6, :6]


@pytest.mark.full
@pytest.mark.parametrize("setup", SETUPS)
@pytest.mark.parametrize("stated", [True, False])
def test_pose_error_reaches_the_bound_and_knows_it(setup, stated):
    """40 trials of 6 numbers: a ratio that is 1 scatters by 1/√480 = 5 %. σ from 15 poses is itself known to
    1/√150 = 8 % only, which adds 2 % to errors and 5 % to errors in units of it."""
    options = HandEyeOptions(noise=TRUE if stated else Noise())
    errors, covariances, bounds = [], [], []
    for seed in range(40):
        truth = simulated(np.random.default_rng(seed), 15, setup, (3e-4, 0.1), (1e-3, 0.3))
        found = handeye(truth.pairs, setup, "pose", options=options)
        errors.append(error(found, truth))
        covariances.append(found.covariance)
        bounds.append(bound(simulated(np.random.default_rng(seed), 15, setup), TRUE))
    assert 0.8 < normalised(errors, bounds) < 1.2
    assert 0.8 < normalised(errors, covariances) < 1.25


@pytest.mark.full
@pytest.mark.parametrize("robot", [(3e-4, 0.1), (1e-3, 0.02)])
def test_sigma_are_estimated(robot):
    """Mean of 30 estimates from 30 poses each: 180 − 12 redundancies, 3 each of 4 kinds, so 1/√(2·30·90) = 1.4 % and
    2 % for caution; turns of the robot, told by levers only, are worth fewer redundancies. Shifts are told together."""
    found = []
    for seed in range(30):
        truth = simulated(np.random.default_rng(seed), 30, "eye-in-hand", robot, (1e-3, 0.3))
        found.append(list(handeye(truth.pairs).sigma.values()))
    mean = np.sqrt((np.array(found) ** 2).mean(0))
    assert mean[0] == pytest.approx(robot[0], rel=0.3)
    assert mean[1:] == pytest.approx([1e-3, np.hypot(robot[1], 0.3)], rel=0.1)


def test_the_robot_is_estimated_where_the_camera_is_known():
    truth = simulated(np.random.default_rng(1), 60, "eye-to-hand", (5e-4, 0.2), (1e-3, 0.3))
    found = handeye(truth.pairs, "eye-to-hand", options=HandEyeOptions(noise=Noise(camera_rad=1e-3, camera_mm=0.3)))
    assert found.estimated == ("robot_rad", "robot_mm")
    assert (found.sigma["robot_rad"], found.sigma["robot_mm"]) == pytest.approx((5e-4, 0.2), rel=0.4)
    assert found.sigma["camera_mm"] == 0.3


@pytest.mark.full
@pytest.mark.parametrize(("count", "low", "high"), [(3, 0.7, 1.3), (4, 0.7, 1.15)])
def test_few_poses_state_what_they_can_know(count, low, high):
    """All σ estimated from 6 or 12 redundancies: heavy tails, so 200 draws tell their RMS to some 10 %; caution may
    state too much by a third, as the four are left 12 − 3·2 redundancies."""
    errors, covariances = [], []
    for seed in range(200):
        truth = simulated(np.random.default_rng(seed), count, "eye-in-hand", (5e-4, 0.2), (5e-4, 0.2))
        try:
            found = handeye(truth.pairs)
        except DegenerateError:  # three that hardly turned
            continue
        errors.append(error(found, truth))
        covariances.append(found.covariance)
    assert len(errors) > 190
    assert low < normalised(errors, covariances) < high


@pytest.mark.parametrize("factor", [pytest.param(1, marks=pytest.mark.slow), 4])
def test_covariances_of_the_board_s_poses_hold_up_to_a_factor(factor):
    """40 poses, 240 − 12 redundancies, most of them for the camera: 1/√(2·228) = 5 % of the factor, and what robot and
    camera take from each other."""
    truth = simulated_views(np.random.default_rng(5), 40, "eye-to-hand", (1e-4, 0.03), 0.3)
    stated = replace(truth.pairs, camera_from_board_covariance=truth.pairs.camera_from_board_covariance / factor**2)
    found, right = handeye(stated, "eye-to-hand"), handeye(truth.pairs, "eye-to-hand")
    assert found.sigma["camera_factor"] == pytest.approx(factor, rel=0.15)
    assert any("check the intrinsics" in note for note in found.notes) == (factor > 2)
    assert found.covariance == pytest.approx(right.covariance, rel=1e-3)


@pytest.mark.parametrize("bad", [1, 4])
def test_bad_poses_are_named_and_left_out(bad):
    """Boards seen 8° and 20 mm off: they are found, and the rest gives what it gives without them."""
    truth = simulated(np.random.default_rng(2), 14, camera=(1e-3, 0.3))
    board = list(truth.pairs.camera_from_board)
    for i in range(bad):
        board[3 * i] = Rigid.exp([0.1, -0.08, 0.05, 12, -8, 14]) @ board[3 * i]
    pairs = HandEyePoses(truth.pairs.base_from_flange, Poses.of(board))
    found = handeye(pairs)
    assert np.flatnonzero(found.outliers).tolist() == [3 * i for i in range(bad)]
    assert found.notes[0].startswith("pose 1 contradicts the others, by ")
    without = handeye(truth.pairs[~found.outliers])
    assert found.mount_from_camera.translation == pytest.approx(without.mount_from_camera.translation, abs=1e-3)
