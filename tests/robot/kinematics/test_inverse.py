"""Inverse kinematics: what is found is reached, nearest and within limits; what is not is named."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from stcal.geometry.rigid import Poses
from stcal.robot.kinematics.forward import forward
from stcal.robot.kinematics.inverse import branches, inverse
from stcal.robot.kinematics.robot_model import DHRow, Joint, Robot, mh80
from stcal.robot.simulated import joint_vectors, made
from tests.outcome import refuses
from tests.support.arms import modified, scara


def gantry() -> Robot:
    """Three prismatic joints at right angles and a wrist of three."""
    half = np.pi / 2
    rows = ((0, -half, 0, 0), (0, half, 0, half), (0, 0, 0, 0), (0, -half, 0, 0), (0, half, 0, 0), (0, 0, 80, 0))
    joints = (*(Joint("prismatic", 0, length) for length in (2000, 1500, 800)), *(Joint("revolute", -3, 3),) * 3)
    return Robot("gantry", "standard", tuple(DHRow(*row) for row in rows), joints)


def seven() -> Robot:
    """Seven axes as of a lightweight arm."""
    half = np.pi / 2
    twists, lengths = (-half, half, half, -half, -half, half, 0), (340, 0, 400, 0, 400, 0, 126)
    rows = [DHRow(0, a, d, 0) for a, d in zip(twists, lengths, strict=True)]
    limits = np.radians([170, 120, 170, 120, 170, 120, 175])
    return Robot("seven", "standard", tuple(rows), tuple(Joint("revolute", -v, v) for v in limits))


def off(robot: Robot, poses: Poses, q: np.ndarray) -> tuple[float, float]:
    d = poses.difference(forward(robot, q))
    return np.linalg.norm(d[:, 3:], axis=1).max(), np.linalg.norm(d[:, :3], axis=1).max()


def assert_reached(robot: Robot, poses: Poses, found) -> None:
    assert found.usable.all()
    mm, rad = off(robot, poses, found.q)
    assert mm <= 1e-9
    assert rad <= 1e-12
    assert within(robot, found.q)


def within(robot: Robot, q: np.ndarray) -> bool:
    low, high = robot.limits().T
    unit = np.where(robot.prismatic, 1e-4, 1e-9)
    return bool(((q >= low - unit) & (q <= high + unit)).all())


ARMS = {
    "standard": mh80(),
    "made": made(mh80(), np.random.default_rng(1)),
    "modified": modified(),
    "made modified": made(modified(), np.random.default_rng(2)),
    "gantry": gantry(),
}


@pytest.mark.parametrize("name", ARMS)
def test_the_pose_is_reached_from_a_near_start(name):
    robot = ARMS[name]
    rng = np.random.default_rng(5)
    q = joint_vectors(robot, 300, rng, 0.8)
    unit = np.where(robot.prismatic, 5.0, 5e-3)
    found = inverse(robot, forward(robot, q), q + rng.normal(0, 1, q.shape) * unit)
    assert_reached(robot, forward(robot, q), found)
    assert np.median(np.abs(found.q - q)) < 1e-9


@pytest.mark.slow
def test_nearest_of_all_branches_and_turns():
    robot = ARMS["made"]
    rng = np.random.default_rng(8)
    turn = 2 * np.pi
    low, high = robot.limits().T
    for q in joint_vectors(robot, 2, rng, 0.9):
        pose = forward(robot, q)
        near = joint_vectors(robot, 1, rng, 0.9)[0]
        every = branches(robot, pose[0]).q
        turned = [b + turn * np.array(k) for b in every for k in product((-1, 0, 1), repeat=6)]
        turned = np.array([t for t in turned if (t >= low).all() and (t <= high).all()])
        expected = turned[np.linalg.norm(turned - near, axis=1).argmin()]
        np.testing.assert_allclose(inverse(robot, pose, near).q[0], expected, atol=1e-7)


@pytest.mark.slow
def test_nearest_where_two_branches_almost_meet():
    """Elbow nearly stretched: both elbow branches are within 0.1 rad of every reference, and a step leads to either."""
    free = replace(mh80(), joints=(Joint(),) * 6)
    stretched = -np.arctan2(1025, 210)  # of the forearm, where the elbow is straight
    q = np.array([0.3, 0.6, stretched + 0.01, 0.5, 0.8, -0.4])
    pose = forward(free, q)
    every = branches(free, pose[0]).q
    other = every[np.argsort(np.linalg.norm(every - q, axis=1))[1]]
    apart = np.linalg.norm(other - q)
    assert 0.01 < apart < 0.05
    near = (q + other) / 2 + np.random.default_rng(1).normal(0, 0.3 * apart, (300, 6))
    many = Poses(np.repeat(pose.rotation, 300, 0), np.repeat(pose.translation, 300, 0))
    first, second = np.linalg.norm(near - q, axis=1), np.linalg.norm(near - other, axis=1)
    clear = np.abs(first - second) > 1e-6
    expected = np.where((first < second)[:, None], q, other)
    np.testing.assert_allclose(inverse(free, many, near).q[clear], expected[clear], atol=1e-6)


@pytest.mark.slow
def test_eight_branches_of_an_arm_with_a_spherical_wrist():
    """Shoulder, elbow and wrist: 2³ (Pieper 1968), where nothing limits them."""
    robot = replace(mh80(), joints=(Joint(),) * 6)
    rng = np.random.default_rng(4)
    counts = []
    for q in joint_vectors(mh80(), 4, rng, 0.5):
        found = branches(robot, forward(robot, q)[0])
        counts.append(len(found))
        apart = (found.q - q + np.pi) % (2 * np.pi) - np.pi
        assert np.abs(apart).max(axis=1).min() < 1e-8
        assert max(off(robot, forward(robot, q), b[None])[0] for b in found.q) <= 1e-9
        flipped = q + np.array([0, 0, 0, np.pi, -2 * q[4], np.pi])
        apart = (found.q - flipped + np.pi) % (2 * np.pi) - np.pi
        assert np.abs(apart).max(axis=1).min() < 1e-8
    assert max(counts) == 8
    assert set(counts) <= {2, 4, 8}


@pytest.mark.slow
def test_out_of_reach_is_named_with_what_remains():
    robot = ARMS["made"]
    q = joint_vectors(robot, 3, np.random.default_rng(6))
    poses = forward(robot, q)
    at = poses.translation.copy()
    at[1] = [0, 0, 540 + 4000]
    found = inverse(robot, Poses(poses.rotation, at), q)
    assert found.status == ("reached", "unreachable", "reached")
    # Stretched, the arm is at most 145 + 870 + √(210² + 1025²) + 175 = 2236 mm from the first axis at z = 540.
    assert 4000 - 2236 - 5 < found.error_mm[1] < 4000 - 1000
    assert within(robot, found.q)
    np.testing.assert_allclose(found.error_mm[1], off(robot, Poses(poses.rotation, at)[1:2], found.q[1:2])[0])


def test_what_only_limits_forbid_is_named_and_turns_follow_the_reference_as_far_as_they_go():
    robot = mh80()
    q = np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
    narrow = replace(robot, joints=(Joint("revolute", 0.3, 0.5), *(Joint("revolute", v - 0.2, v + 0.2) for v in q[1:])))
    found = inverse(narrow, forward(robot, q), q)
    assert found.status == ("limit",)
    assert within(narrow, found.q)
    assert 1 < found.error_mm[0] < 0.4 * 2100
    assert inverse(robot, forward(robot, q), q).status == ("reached",)
    # The fourth and the sixth joint turn ± 360°.
    q = np.array([0.1, 0.2, 0.3, 0.4, 0.9, 0.6])
    near = q + np.array([0, 0, 0, 0, 0, -2 * np.pi])
    np.testing.assert_allclose(inverse(robot, forward(robot, q), near).q[0], near, atol=1e-8)
    narrow = replace(robot, joints=(*robot.joints[:5], Joint("revolute", -np.pi, np.pi)))
    flipped = q + np.array([0, 0, 0, np.pi, -1.8, -np.pi])  # nearer than a whole turn, which the limits forbid
    found = inverse(narrow, forward(robot, q), near).q[0]  # the fourth is as near a turn away
    np.testing.assert_allclose((found - flipped)[[0, 1, 2, 4, 5]], 0, atol=1e-8)
    assert abs(abs(found[3] - 0.4) - np.pi) < 1e-8


@pytest.mark.parametrize("name", [pytest.param("standard", marks=pytest.mark.slow), "made"])
def test_singular_poses(name):
    """Wrist straight; elbow stretched; wrist centre on the first axis."""
    robot = ARMS[name]
    wrist = np.array([0.3, 0.4, -0.2, 0.5, 0.0, 0.7])
    found = inverse(robot, forward(robot, wrist), wrist + 0.05)
    assert found.usable.all()
    assert off(robot, forward(robot, wrist), found.q)[0] <= 1e-9
    if name == "standard":
        assert found.status == ("singular",)
    free = replace(robot, joints=(Joint(),) * 6)
    stretched = np.array([0.3, 0.4, -np.arctan2(1025, 210), 0.5, 0.8, 0.7])
    found = inverse(free, forward(free, stretched), stretched + 0.02)
    assert found.usable.all()
    assert off(free, forward(free, stretched), found.q)[0] <= 1e-9
    assert len(branches(robot, forward(robot, wrist)[0])) > 0


def test_scara_reaches_what_four_joints_can_and_states_the_rest_of_tilted_axes():
    robot = scara()
    q = joint_vectors(robot, 10, np.random.default_rng(3), 0.8)
    q[:, 2] = np.abs(q[:, 2])
    found = inverse(robot, forward(robot, q), q + np.array([0.05, -0.05, 3, 0.1]))
    assert set(found.status) <= {"reached"}
    np.testing.assert_allclose(found.q, q, atol=1e-6)
    left = branches(robot, forward(robot, np.array([0.4, 0.9, 80.0, -0.3]))[0])
    np.testing.assert_allclose(np.sort(left.q[:, 1]), [-0.9, 0.9], atol=1e-8)  # elbow left and right
    q = np.array([[0.4, 0.9, 80.0, -0.3]])
    real = made(robot, np.random.default_rng(7))
    found = inverse(real, forward(robot, q), q)
    assert found.status == ("orientation",)
    assert found.error_mm[0] <= 1e-9
    assert 1e-5 < found.error_rad[0] < 5e-3  # tilts of 0.5 mrad at four axes
    # The spindle's angle, which it can choose, is chosen well: turning it makes the orientation worse.
    for turn in (-2e-3, 2e-3):
        other = forward(real, found.q + np.array([0, 0, 0, turn]))
        assert np.linalg.norm(forward(robot, q).difference(other)[:, :3]) > found.error_rad[0]


def test_redundant_arm_needs_a_reference_and_stays_near_it():
    robot = seven()
    rng = np.random.default_rng(2)
    q = joint_vectors(robot, 100, rng, 0.9)
    found = inverse(robot, forward(robot, q), q + rng.normal(0, 0.02, q.shape))
    assert_reached(robot, forward(robot, q), found)
    assert np.abs(found.q - q).max() < 1
    refuses("E-ROBOT-REDUNDANT … 7", inverse, robot, forward(robot, q))
    refuses("E-ROBOT-REDUNDANT", branches, robot, forward(robot, q)[0])


def test_without_reference_a_path_stays_in_its_branch_and_a_bad_one_is_named():
    robot = ARMS["made"]
    ends = np.array([[0.2, 0.3, -0.4, 0.5, 0.6, 0.7], [0.5, 0.5, -0.2, 0.8, 0.9, 0.4]])
    q = ends[0] + np.linspace(0, 1, 10)[:, None] * (ends[1] - ends[0])
    found = inverse(robot, forward(robot, q))
    assert set(found.status) == {"reached"}
    assert np.abs(np.diff(found.q, axis=0)).max() < 0.2
    pose = forward(mh80(), np.zeros(6))
    refuses("E-ARRAY-SHAPE … (5,) … 6 … 1 … 6", inverse, mh80(), pose, np.zeros(5))
    refuses("E-ARRAY-NOT-FINITE", inverse, mh80(), pose, np.full(6, np.nan))
    assert len(inverse(mh80(), pose[:0], np.zeros(6))) == 0
