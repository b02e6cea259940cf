"""Two arms on a trunk: one adjustment of all joints, by markers on several branches."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from stcal.errors import InputError
from stcal.robot.identify.residuals import State, jacobian, moved, observed, parameter_names, residuals
from stcal.robot.identify.result import IdentifyOptions
from stcal.robot.identify.solve import identify
from stcal.robot.kinematics.dh import robot_from_chain
from stcal.robot.kinematics.file import load_robot, robot_toml
from stcal.robot.kinematics.forward import forward
from stcal.robot.kinematics.forward import jacobian as by_joints
from stcal.robot.kinematics.inverse import inverse
from stcal.robot.kinematics.model import Robot
from stcal.synthetic.measured.arms import MARKERS, RIGHT, joint_vectors, made, measured, two_arms


def seen_by(robot: Robot, rng, each=60):
    targets = [name for name in MARKERS for _ in range(each)]
    return measured(robot, joint_vectors(robot, len(targets), rng), rng, targets=targets)


@pytest.mark.parametrize("convention", ["standard", "modified"])
def test_a_branch_is_the_arm_alone(convention):
    """The right hand by the tree, and by the torso's rows, mount and arm put one after the other by hand."""
    robot = two_arms(convention)
    q = joint_vectors(robot, 5, np.random.default_rng(0))
    torso = Robot("torso", robot.convention, robot.rows[:2], robot.joints[:2])
    arm = Robot("arm", robot.convention, robot.rows[8:], robot.joints[8:], tools={"": robot.tool("right")})
    wanted = forward(torso, q[:, :2]) @ RIGHT @ forward(arm, q[:, 8:])
    assert np.abs(forward(robot, q, "right").difference(wanted)).max() < 1e-9


@pytest.mark.parametrize("convention", ["standard", "modified"])
def test_rows_and_mounts_come_back_from_the_chain(convention):
    robot = two_arms(convention)
    true = made(robot, np.random.default_rng(1))
    q = joint_vectors(robot, 8, np.random.default_rng(2))
    again = robot_from_chain(true.chain(), true.tools, robot)
    for name in MARKERS:
        wanted = true.world_from_base @ forward(true, q, name)
        assert np.abs((again.world_from_base @ forward(again, q, name)).difference(wanted)).max() < 1e-9
    assert again.rows[2].theta == robot.rows[2].theta  # of a branch's first row the mount takes what differs
    assert true.rows[2].theta != robot.rows[2].theta
    assert again.rows[3] != robot.rows[3]
    assert np.abs(again.tree.mounts[8][1].matrix() - RIGHT.matrix()).max() > 1e-4


def test_derivatives_are_those_of_differences():
    robot, rng = two_arms(), np.random.default_rng(3)
    data = measured(robot, joint_vectors(robot, 9, rng), rng, 0.0, 0.0, MARKERS * 3)
    state, seen = State(robot.chain(), dict(robot.tools)), observed(data)
    derivative = jacobian(state, seen)
    for k in range(derivative.shape[2]):
        step = np.zeros(derivative.shape[2])
        step[k] = 1e-4 if parameter_names(state, "pose")[k].split()[-1] in ("x", "y", "z") else 1e-7
        ahead, behind = (residuals(moved(state, sign * step, "pose"), seen) for sign in (1, -1))
        by_difference = (behind - ahead) / (2 * step[k])
        assert np.abs(derivative[:, :, k] - by_difference).max() < 1e-5 * max(np.abs(by_difference).max(), 1)


def test_joints_of_the_other_arm_move_nothing():
    robot = two_arms()
    columns = by_joints(robot, joint_vectors(robot, 4, np.random.default_rng(0)), "left")
    assert np.abs(columns[:, :, 8:]).max() == 0
    assert np.abs(columns[:, :, :8]).max(axis=(0, 1)).min() > 0


def test_two_arms_are_identified_together():
    rng = np.random.default_rng(4)
    nominal = two_arms()
    true = made(nominal, rng)
    found = identify(nominal, seen_by(true, rng))
    assert found.rank == 4 * 14 + 6 * 3
    assert found.undetermined == ()
    assert found.weighting.sigma_mm == pytest.approx(0.05, rel=0.15)
    q = joint_vectors(true, 200, rng, 0.5)
    for name in MARKERS:
        off = (true.world_from_base @ forward(true, q, name)).difference(
            found.robot.world_from_base @ forward(found.robot, q, name)
        )
        before = (true.world_from_base @ forward(true, q, name)).difference(
            nominal.world_from_base @ forward(nominal, q, name)
        )
        assert np.sqrt((off[:, 3:] ** 2).sum(1).mean()) < 0.1 * np.sqrt((before[:, 3:] ** 2).sum(1).mean())
    mount = next(each for each in found.placed if each.name == "mount of joint 9 behind joint 2")
    same_form = robot_from_chain(true.chain(), true.tools, nominal)  # a branch's first θ and d as drawn
    away = mount.pose.translation - same_form.tree.mounts[8][1].translation
    assert np.abs(away / mount.sigma[3:]).max() < 5


@pytest.mark.slow
def test_covariance_of_a_tree_is_honest():
    """NEES of what the covariance says of the tips over 40 draws: χ² of 3 a place."""
    nominal, total, count = two_arms(), 0.0, 0
    for seed in range(40):
        rng = np.random.default_rng([5, seed])
        true = made(nominal, rng)
        found = identify(nominal, seen_by(true, rng, each=40), IdentifyOptions(folds=0))
        state = found.state
        q, names = joint_vectors(true, 3, rng), list(MARKERS)
        exact = measured(true, q, rng, 0.0, 0.0, names)
        seen = observed(replace(exact, covariance=None))
        slope, off = jacobian(state, seen)[:, 3:], residuals(state, seen)[:, 3:]
        for place, error in zip(slope, off, strict=True):
            total += error @ np.linalg.solve(place @ found.covariance @ place.T, error)
            count += 3
    low, high = chi2.ppf([1e-3, 1 - 1e-3], count)
    assert low < total < high


def test_the_file_holds_the_tree(tmp_path):
    robot = made(two_arms(), np.random.default_rng(6))
    (tmp_path / "robot.toml").write_text(robot_toml(robot))
    again = load_robot(tmp_path / "robot.toml")
    assert again.tree.carriers == robot.tree.carriers
    q = joint_vectors(robot, 5, np.random.default_rng(0))
    for name in MARKERS:
        assert np.abs(forward(again, q, name).difference(forward(robot, q, name))).max() < 1e-9


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("after = 2", "after = 9", r"joint 3: after is 9, 0 \(the base\) … 2 needed"),
        ("after = 2", "", "joint 3: mount without after"),
        ("joint = 8", "joint = 15", "target left: joint is 15, 1 … 14 needed"),
        ('type = "revolute"', 'type = "revolute"\nafter = 0', "joint 1: after is for joints that begin another branch"),
    ],
)
def test_a_file_that_names_no_tree_is_refused(tmp_path, old, new, message):
    text = robot_toml(two_arms())
    assert old in text
    (tmp_path / "robot.toml").write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=message):
        load_robot(tmp_path / "robot.toml")


def test_a_target_on_no_branch_and_elasticity_are_refused():
    robot, rng = two_arms(), np.random.default_rng(0)
    data = seen_by(robot, rng, each=10)
    with pytest.raises(InputError, match=r"which joint carries target other; give it a \[\[target\]\] with joint"):
        identify(robot, replace(data, targets=("other",) * len(data)))
    with pytest.raises(InputError, match="--model auto, but it is a tree"):
        identify(robot, data, IdentifyOptions(model="auto"))


def test_a_hand_is_brought_to_a_pose():
    robot, rng = two_arms(), np.random.default_rng(7)
    q = joint_vectors(robot, 5, rng, 0.3)
    wanted = forward(robot, q, "right")
    found = inverse(robot, wanted, q + rng.normal(0, 0.02, q.shape), "right")
    assert found.usable.all()
    assert np.abs(forward(robot, found.q, "right").difference(wanted)).max() < 1e-6
