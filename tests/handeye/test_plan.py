"""Poses that are planned keep what they promise."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest

from stcal.geometry.rigid import Poses, Rigid
from stcal.handeye import HandEyeOptions, HandEyePoses, Noise, plan_poses
from stcal.handeye.data.pose_pairs import SETUPS, Loop
from stcal.handeye.plan import judged_at, worst_sigma
from stcal.robot import Joint, forward, inverse, load_robot
from stcal.robot.kinematics.robot_file import save_robot
from stcal.robot.kinematics.robot_model import mh80
from tests.handeye.test_cli import NOISE
from tests.handeye.written import poses_file
from tests.outcome import INPUT, assert_error, fails_with, refuses
from tests.support.handeye import CAMERA, board_corners, disturbed, handeye, simulated, squared

ROBOT, SEEN = (5e-4, 0.2), (2e-4, 0.05)
OUTLINE = board_corners(8, 7, 25.0)


def few(seed: int, setup: str = "eye-in-hand"):
    """Six poses that turn by little, σ stated."""
    truth = simulated(np.random.default_rng(seed), 6, setup, ROBOT, SEEN, tilt=0.15)
    return truth, handeye(truth.pairs, setup, "pose", options=HandEyeOptions(Noise(*ROBOT, *SEEN)))


def with_more(truth, planned, rng):
    """The pairs with those planned, as robot and camera would have measured them by the true transforms."""
    flange = planned.base_from_flange
    stand = flange.inverse() if truth.setup == "eye-to-hand" else flange
    board = (stand @ truth.mount_from_camera).inverse() @ truth.stand_from_board
    measured = (disturbed(rng, flange, *ROBOT), disturbed(rng, board, *SEEN))
    pairs = (truth.pairs.base_from_flange, truth.pairs.camera_from_board)
    return HandEyePoses(*(Poses.of([*old, *new]) for old, new in zip(pairs, measured, strict=True)))


@pytest.mark.slow
@pytest.mark.parametrize("setup", SETUPS)
def test_sigma_comes_out_as_planned(setup):
    """The information of poses within a degree and a few mm of those planned: 10 %. Errors of X are then within what
    the σ of the new result say: χ² of twelve numbers, above 32.9 in one case in a thousand."""
    errors = []
    for seed in range(2):
        truth, found = few(seed, setup)
        planned = plan_poses(truth.pairs, found, 3, OUTLINE, CAMERA)
        again = with_more(truth, planned, np.random.default_rng(seed))
        result = handeye(again, setup, "pose", options=HandEyeOptions(Noise(*ROBOT, *SEEN)))
        errors.append(squared(result, truth))
        eye = truth.pairs.camera_from_board
        points = judged_at(eye.rotation @ OUTLINE.mean(0) + eye.translation)
        now = worst_sigma(np.linalg.inv(result.covariance), result.mount_from_camera, points)
        assert now == pytest.approx(planned.sigma_mm[-1], rel=0.1)
        assert planned.sigma_mm[-1] < planned.sigma_mm[0] / 2
        assert (np.diff(planned.sigma_mm) < 0).all()
    assert np.sum(errors) < 32.9


@pytest.mark.parametrize("setup", SETUPS)
def test_the_board_stays_in_the_image(setup):
    truth, found = few(2, setup)
    planned = plan_poses(truth.pairs, found, 4, OUTLINE, CAMERA)
    loop = Loop.of(HandEyePoses(planned.base_from_flange, planned.camera_from_board), setup)
    assert np.abs(loop.residuals(found.mount_from_camera, found.stand_from_board)).max() < 1e-9
    for pose in planned.camera_from_board:
        px = CAMERA.project(pose @ OUTLINE)
        assert (px > 0.1 * np.array([1280, 1024]) - 1e-6).all()
        assert (px < 0.9 * np.array([1280, 1024]) + 1e-6).all()
    turned = np.degrees(planned.turn_rad)
    assert (turned > 15).all()


def test_only_what_the_robot_reaches_is_planned():
    truth, found = few(3)
    height = np.median(truth.pairs.base_from_flange.translation[:, 2])
    planned = plan_poses(truth.pairs, found, 3, OUTLINE, CAMERA, lambda flange: flange.translation[:, 2] > height)
    assert (planned.base_from_flange.translation[:, 2] > height).all()
    with fails_with("E-PLAN-OUT-OF-REACH"):
        plan_poses(truth.pairs, found, 1, OUTLINE, CAMERA, lambda flange: np.zeros(len(flange), bool))
    refuses("E-PLAN-NO-SIGMA … park-martin", plan_poses, truth.pairs, handeye(truth.pairs, method="park-martin"))
    refuses("E-PLAN-NO-VIEW", plan_poses, truth.pairs, found, 1, 1000 * OUTLINE, CAMERA)


@pytest.fixture
def taken(tmp_path):
    """Six poses in the reach of the example of a robot, and its file."""
    save_robot(tmp_path / "robot.toml", mh80())
    return poses_file(tmp_path / "poses.csv", TAKEN), tmp_path / "robot.toml"


TAKEN = simulated(np.random.default_rng(8), 6, tilt=0.2, **NOISE)


@pytest.mark.slow
def test_poses_and_joint_values_are_named(command, taken, tmp_path):
    poses, robot_file = taken
    table, written = tmp_path / "next.csv", tmp_path / "n.json"
    code, shown, _ = command("plan", poses, "--robot", robot_file, "--count", 1, "--out", table, "--json", written)
    assert code == 0, shown
    robot, data = load_robot(robot_file), json.loads(written.read_text())
    with table.open(newline="", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    q = np.radians([[float(row[f"q{i}_deg"]) for i in range(1, 7)] for row in rows])
    assert ((q >= robot.limits()[:, 0]) & (q <= robot.limits()[:, 1])).all()
    flange = Poses.of([Rigid.from_matrix(matrix) for matrix in data["base_from_flange"]])
    assert np.abs(forward(robot, q).difference(flange)).max() < 1e-6
    assert [float(row["base_from_flange_x_mm"]) for row in rows] == pytest.approx(flange.translation[:, 0])
    assert len(data["sigma_mm"]) == 2
    assert data["sigma_mm"] == sorted(data["sigma_mm"], reverse=True)
    assert len(data["taken"]) == 6
    assert "next 1" in shown
    assert "q6_deg" in shown
    assert "note" not in shown


@pytest.mark.slow
def test_a_robot_that_does_not_reach_the_poses_taken_is_refused_and_a_limit_that_some_pass_is_noted(command, taken):
    poses, robot_file = taken
    arm = mh80()
    save_robot(robot_file, replace(arm, rows=tuple(replace(row, a=row.a / 9, d=row.d / 9) for row in arm.rows)))
    said = "reaches 0 of the 6 poses taken, first not line 2; give the robot's own file"
    assert_error(command("plan", poses, "--robot", robot_file), INPUT, said)
    # The limit is halfway between the second and third value of the first joint.
    first = np.sort(inverse(arm, TAKEN.pairs.base_from_flange).q[:, 0])
    assert (np.abs(first) < np.radians(60)).all()  # so that turned round the robot would have to bend over backwards
    limited = Joint("revolute", float(first[1:3].mean()), np.radians(60))
    save_robot(robot_file, replace(arm, joints=(limited, *arm.joints[1:])))
    code, shown, _ = command("plan", poses, "--robot", robot_file, "--count", 1)
    assert code == 0
    assert "of the 6 poses taken, not line" in shown
