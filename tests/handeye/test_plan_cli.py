"""``stcal handeye plan`` as a user types it."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest

from stcal.geometry.rigid import Poses, Rigid
from stcal.robot import Joint, forward, inverse, load_robot
from stcal.robot.kinematics.robot_file import save_robot
from stcal.robot.kinematics.robot_model import mh80
from tests.handeye.test_cli import NOISE, poses_file
from tests.outcome import INPUT, assert_error
from tests.support.handeye import simulated


@pytest.fixture
def plan(command):
    return lambda *arguments: command("plan", *arguments)


@pytest.fixture
def taken(tmp_path):
    """Eight poses in the reach of the example of a robot, and its file."""
    save_robot(tmp_path / "robot.toml", mh80())
    truth = simulated(np.random.default_rng(8), 8, tilt=0.2, **NOISE)
    return poses_file(tmp_path / "poses.csv", truth), tmp_path / "robot.toml"


@pytest.mark.slow
def test_poses_and_joint_values_are_named(plan, taken, tmp_path):
    poses, robot_file = taken
    code, shown, _ = plan(
        poses, "--robot", robot_file, "--count", 2, "--out", tmp_path / "next.csv", "--json", tmp_path / "n.json"
    )
    assert code == 0, shown
    robot = load_robot(robot_file)
    with open(tmp_path / "next.csv", newline="", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    q = np.radians([[float(row[f"q{i}_deg"]) for i in range(1, 7)] for row in rows])
    assert ((q >= robot.limits()[:, 0]) & (q <= robot.limits()[:, 1])).all()
    written = json.loads((tmp_path / "n.json").read_text())
    flange = Poses.of([Rigid.from_matrix(matrix) for matrix in written["base_from_flange"]])
    assert np.abs(forward(robot, q).difference(flange)).max() < 1e-6
    assert [float(row["base_from_flange_x_mm"]) for row in rows] == pytest.approx(flange.translation[:, 0])
    assert len(written["sigma_mm"]) == 3
    assert written["sigma_mm"] == sorted(written["sigma_mm"], reverse=True)
    assert len(written["taken"]) == 8
    assert "next 2" in shown
    assert "q6_deg" in shown


@pytest.mark.slow
def test_a_robot_that_does_not_reach_the_poses_taken_is_refused(plan, taken):
    poses, robot_file = taken
    arm = mh80()
    save_robot(robot_file, replace(arm, rows=tuple(replace(row, a=row.a / 9, d=row.d / 9) for row in arm.rows)))
    said = "reaches 0 of the 8 poses taken, first not line 2; give the robot's own file"
    assert_error(plan(poses, "--robot", robot_file), INPUT, said)


@pytest.mark.slow
def test_a_limit_that_some_poses_taken_pass_is_noted(plan, taken):
    """The limit is halfway between the second and third value of the first joint."""
    poses, robot_file = taken
    _, shown, _ = plan(poses, "--robot", robot_file, "--count", 1)
    assert "note" not in shown
    arm, flange = mh80(), simulated(np.random.default_rng(8), 8, tilt=0.2, **NOISE).pairs.base_from_flange
    first = np.sort(inverse(arm, flange).q[:, 0])
    assert (np.abs(first) < np.radians(60)).all()  # so that turned round the robot would have to bend over backwards
    limited = Joint("revolute", float(first[1:3].mean()), np.radians(60))
    save_robot(robot_file, replace(arm, joints=(limited, *arm.joints[1:])))
    code, shown, _ = plan(poses, "--robot", robot_file, "--count", 1)
    assert code == 0
    assert "of the 8 poses taken, not line" in shown
