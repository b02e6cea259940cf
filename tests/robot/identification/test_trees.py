"""Two arms on a trunk: one adjustment of all joints, by markers on several branches."""

import re
from dataclasses import replace

import numpy as np
import pytest

from stcal.geometry.rigid import Rigid
from stcal.robot.identification.adjustment import State, observed
from stcal.robot.identification.identify import identify
from stcal.robot.identification.result import IdentifyOptions
from stcal.robot.identified_report import joints_figure
from stcal.robot.kinematics.dh import robot_from_chain
from stcal.robot.kinematics.forward import forward, joint_frames
from stcal.robot.kinematics.forward import jacobian as by_joints
from stcal.robot.kinematics.inverse import inverse
from stcal.robot.kinematics.robot_file import load_robot, robot_toml
from stcal.robot.kinematics.robot_model import Robot
from stcal.robot.simulated import joint_vectors, made, measured
from tests.outcome import refuses
from tests.shared import written
from tests.support.arms import MARKERS, RIGHT, elastic, two_arms


def apart(one: Robot, other: Robot, q: np.ndarray, name: str) -> np.ndarray:
    return (one.world_from_base @ forward(one, q, name)).difference(other.world_from_base @ forward(other, q, name))


def seen_by(robot: Robot, rng, each):
    targets = [name for name in MARKERS for _ in range(each)]
    return measured(robot, joint_vectors(robot, len(targets), rng), rng, targets=targets)


@pytest.mark.parametrize("convention", ["standard", "modified"])
def test_a_branch_is_the_arm_alone_and_comes_back_from_the_chain(convention):
    """The right hand by the tree, and by the torso's rows, mount and arm put one after the other by hand."""
    robot = two_arms(convention)
    q = joint_vectors(robot, 5, np.random.default_rng(0))
    torso = Robot("torso", robot.convention, robot.rows[:2], robot.joints[:2])
    arm = Robot("arm", robot.convention, robot.rows[8:], robot.joints[8:], tools={"": robot.tool("right")})
    wanted = forward(torso, q[:, :2]) @ RIGHT @ forward(arm, q[:, 8:])
    assert np.abs(forward(robot, q, "right").difference(wanted)).max() < 1e-9
    columns = by_joints(robot, q, "left")  # which joints of the other arm do not move
    assert np.abs(columns[:, :, 8:]).max() == 0
    assert np.abs(columns[:, :, :8]).max(axis=(0, 1)).min() > 0
    true = made(robot, np.random.default_rng(1))
    q = joint_vectors(robot, 8, np.random.default_rng(2))
    again = robot_from_chain(true.chain(), true.tools, robot)
    assert max(np.abs(apart(again, true, q, name)).max() for name in MARKERS) < 1e-9
    assert again.rows[2].theta == robot.rows[2].theta  # of a branch's first row the mount takes what differs
    assert true.rows[2].theta != robot.rows[2].theta
    assert again.rows[3] != robot.rows[3]
    assert np.abs(again.tree.mounts[8][1].matrix() - RIGHT.matrix()).max() > 1e-4


@pytest.mark.slow
def test_derivatives_of_an_elastic_tree_are_those_of_differences():
    """At a thousandth of usual deflections: torques are those on the rigid tree. The last are second derivatives. Every
    third parameter: each joint has some."""
    rng = np.random.default_rng(3)
    robot = elastic(two_arms(), rng, 1e-3)
    data = measured(robot, joint_vectors(robot, 3, rng), rng, 0.0, 0.0, MARKERS)
    state, seen = State(robot.chain(), dict(robot.tools), elastic=True), observed(data)
    derivative, pull = state.jacobian(seen), rng.normal(size=(3, 6))
    bent, count = state.curvature(seen, pull), state.elastic_count
    for k in range(0, count, 3):
        step = np.zeros(derivative.shape[2])
        step[k - count] = max(1e-3 * abs(robot.elasticity.values()[k]), 1e-9)
        ahead, behind = (state.moved(sign * step, "pose") for sign in (1, -1))
        by_difference = (behind.residuals(seen) - ahead.residuals(seen)) / (2 * step[k - count])
        size = max(np.abs(by_difference).max(), np.abs(derivative[:, :, k - count]).max())
        assert np.abs(derivative[:, :, k - count] - by_difference).max() < 1e-3 * size + 1e-6
        if k < 28:  # compliances
            change = (ahead.jacobian(seen) - behind.jacobian(seen))[:, :, 28 - count : 70 - count]
            expected = np.einsum("rw,rwk->k", pull, change) / (2 * step[k - count])
            assert np.abs(bent[k, 28:70] - expected).max() < 1e-3 * np.abs(bent).max()


def with_stiff_torso(robot: Robot) -> Robot:
    stiff = np.array(robot.elasticity.compliance)
    stiff[:2] = 0
    return replace(robot, elasticity=replace(robot.elasticity, compliance=stiff))


def test_one_arm_bends_the_other_and_a_load_hangs_at_the_tool_without_name():
    """The left hand sinks as the right arm is stretched out, by the torque on the torso alone."""
    rng = np.random.default_rng(0)
    robot = elastic(two_arms(), rng)
    q = np.zeros((2, 14))
    q[1, 8:] = joint_vectors(robot, 1, rng)[0, 8:]
    rigid = replace(robot, elasticity=None)
    assert np.ptp(forward(rigid, q, "left").translation, axis=0).max() == 0
    assert np.ptp(forward(robot, q, "left").translation, axis=0).max() > 0.003
    assert np.ptp(forward(with_stiff_torso(robot), q, "left").translation, axis=0).max() < 1e-9
    refuses("E-ROBOT-TREE", forward, robot, np.zeros((1, 14)), "left", 50.0)
    named = replace(robot.tree, carriers={**robot.tree.carriers, "": 7})
    robot = with_stiff_torso(replace(robot, tree=named, tools={**robot.tools, "": Rigid()}))
    q = joint_vectors(robot, 4, rng)
    sag = {name: np.abs(forward(robot, q, name, 50.0).difference(forward(robot, q, name))).max() for name in MARKERS}
    assert sag["left"] > 0.01
    assert sag["elbow"] > 0.001
    assert sag["right"] == 0


def test_joints_are_drawn_with_the_rows_that_they_move_and_a_target_on_no_branch_is_refused():
    robot, rng = two_arms(), np.random.default_rng(3)
    seen = observed(seen_by(robot, rng, each=4))
    state = State(robot.chain(), dict(robot.tools))
    drawn = joints_figure(state, seen, state.residuals(seen), np.ones(12, bool), ())
    dots = re.findall(r'd="([^"]*)" stroke="[^"]*" stroke-opacity', drawn.svg())
    points = [path.count("M") for path in dots]
    assert points == [12] * 2 + [8] * 3 + [4] * 9  # torso; left arm as far as the elbow; left hand, right arm
    refuses("E-ROBOT-TREE … target other", identify, robot, replace(seen.data, targets=("other",) * 12))


@pytest.mark.slow
def test_two_arms_are_identified_together():
    rng = np.random.default_rng(4)
    nominal = two_arms()
    true = made(nominal, rng)
    found = identify(nominal, seen_by(true, rng, each=25), IdentifyOptions(folds=0))
    assert found.rank == 4 * 14 + 6 * 3
    assert found.undetermined == ()
    assert found.weighting.sigma_mm == pytest.approx(0.05, rel=0.15)
    q = joint_vectors(true, 200, rng, 0.5)
    for name in MARKERS:
        off, before = (np.linalg.norm(apart(true, each, q, name)[:, 3:]) for each in (found.robot, nominal))
        assert off < 0.1 * before
    mount = next(each for each in found.placed if each.name == "mount of joint 9 behind joint 2")
    same_form = robot_from_chain(true.chain(), true.tools, nominal)  # a branch's first θ and d as drawn
    away = mount.pose.translation - same_form.tree.mounts[8][1].translation
    assert np.abs(away / mount.sigma[3:]).max() < 5


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("after = 2", "after = 9", "E-ROBOT-BRANCH … 3 … 9 … 2"),
        ("after = 2", "", "E-ROBOT-BRANCH … 3"),
        ("joint = 8", "joint = 15", "E-ROBOT-BRANCH … target left … 15 … 14"),
        ('type = "revolute"', 'type = "revolute"\nafter = 0', "E-ROBOT-BRANCH"),
    ],
)
def test_a_file_that_names_no_tree_is_refused(tmp_path, old, new, message):
    text = robot_toml(two_arms())
    assert old in text
    refuses(message, load_robot, written(tmp_path / "robot.toml", text.replace(old, new, 1)))


def test_a_hand_is_brought_to_a_pose():
    rng = np.random.default_rng(7)
    robot = elastic(two_arms(), rng)
    q = joint_vectors(robot, 5, rng, 0.3)
    wanted = forward(robot, q, "right")
    found = inverse(robot, wanted, q + rng.normal(0, 0.02, q.shape), "right")
    assert found.usable.all()
    assert np.abs(forward(robot, found.q, "right").difference(wanted)).max() < 1e-6


def test_rows_of_an_elastic_tree_keep_the_place_about_which_a_link_gives_way(tmp_path):
    """Joint 1 stands 700 mm below where the next axis crosses it: its row takes the crossing, and links give way by a
    fifth of a degree across it, about where they did."""
    robot, rng = elastic(two_arms(), np.random.default_rng(5)), np.random.default_rng(6)
    chain = robot.chain()
    place = chain.translation.copy()
    place[0] -= 700 * chain.rotation[0][:, 2]
    place[1] += [0, 0, 700]
    compliance = chain.elasticity.compliance.copy()
    compliance[0] = 1e-5
    bent = replace(chain, translation=place, elasticity=replace(chain.elasticity, compliance=compliance))
    text = robot_toml(robot_from_chain(bent, robot.tools, robot))
    again = load_robot(written(tmp_path / "robot.toml", text))
    assert again.tree.carriers == robot.tree.carriers
    q, targets = joint_vectors(robot, 6, rng), MARKERS * 2
    wanted = State(bent, dict(robot.tools)).tips(q, targets)
    found = State(again.chain(), dict(again.tools)).tips(q, targets)
    assert np.abs(found.difference(wanted)).max() < 1e-8
    slid = replace(again, elasticity=replace(again.elasticity, pivot=np.zeros_like(again.elasticity.pivot)))
    assert np.abs(State(slid.chain(), dict(slid.tools)).tips(q, targets).difference(wanted)).max() > 1e-3
    pivots = [joint_frames(each, q)[1][0] for each in (bent, again.chain())]
    assert np.abs(pivots[1] - pivots[0]).max() < 1e-8
