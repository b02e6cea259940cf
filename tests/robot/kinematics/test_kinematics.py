"""Forward kinematics against products of the textbook's matrices, derivatives against differences, what links give way
by; and inverse kinematics: what is found is reached, nearest and within limits; what is not is named."""

import re
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stcal.errors import InputError, InputNote
from stcal.geometry.rigid import Poses, Rigid
from stcal.robot.kinematics.dh import robot_from_chain
from stcal.robot.kinematics.forward import (
    CHUNK,
    chain_jacobian,
    elasticity_jacobian,
    flange_poses,
    forward,
    jacobian,
    links,
)
from stcal.robot.kinematics.inverse import branches, inverse
from stcal.robot.kinematics.robot_file import load_robot, robot_toml
from stcal.robot.kinematics.robot_model import Conditions, DHRow, Elasticity, Joint, Robot, loaded, mh80
from stcal.robot.simulated import joint_vectors, made
from tests.outcome import refuses
from tests.robot.test_descriptions import about, place
from tests.shared import written
from tests.support.arms import modified, scara


def any_arm(seed: int, joints: int, convention: str) -> Robot:
    """Any rows, with β, prismatic joints, coupling, base and tools."""
    rng = np.random.default_rng(seed)
    rows = [DHRow(*(rng.normal(size=5) * [300, 1.5, 300, 1.5, 0.2])) for _ in range(joints)]
    kinds = [Joint("prismatic" if rng.random() < 0.3 else "revolute") for _ in range(joints)]
    coupling = np.eye(joints) + np.tril(rng.normal(size=(joints, joints)), -1) * 0.3
    tools = {"": Rigid.exp(rng.normal(size=6) * [1, 1, 1, 100, 100, 100]), "b": Rigid()}
    base = Rigid.exp(rng.normal(size=6) * [1, 1, 1, 900, 900, 900])
    return Robot("any", convention, tuple(rows), tuple(kinds), coupling, base, tools)


@settings(deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 8), st.sampled_from(["standard", "modified"]))
def test_forward_is_the_product_of_the_rows(seed, joints, convention):
    robot = any_arm(seed, joints, convention)
    q = np.random.default_rng(seed + 1).normal(size=(3, joints)) * np.where(robot.prismatic, 200, 1)
    found = forward(robot, q)
    for k in range(3):
        pose = np.eye(4)
        for row, joint, value in zip(robot.rows, robot.joints, robot.coupling @ q[k], strict=True):
            sliding = joint.type == "prismatic"
            turn, shift = (0, value) if sliding else (value, 0)
            part = {"Rz": about("z", row.theta + turn), "Tz": place((0, 0, row.d + shift)), "Tx": place((row.a, 0, 0))}
            part |= {"Rx": about("x", row.alpha), "Ry": about("y", row.beta)}
            order = ("Rz", "Tz", "Tx", "Rx", "Ry") if convention == "standard" else ("Rx", "Tx", "Ry", "Rz", "Tz")
            for name in order:
                pose = pose @ part[name]
        assert np.abs(found[k].matrix() - pose @ robot.tools[""].matrix()).max() < 1e-9  # mm of metres: rounding


@pytest.mark.slow
@settings(deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 8), st.sampled_from(["standard", "modified"]))
def test_jacobian_is_that_of_differences(seed, joints, convention):
    robot = any_arm(seed, joints, convention)
    q = np.random.default_rng(seed + 1).normal(size=(2, joints)) * np.where(robot.prismatic, 200, 1)
    analytic = jacobian(robot, q, "b")
    for j in range(joints):
        step = np.zeros(joints)
        step[j] = 1e-5  # of 1e-6, rounding of metres is 3e-6 of a slope of 1
        slope = forward(robot, q + step, "b").difference(forward(robot, q - step, "b")) / 2e-5
        size = max(1.0, float(np.abs(analytic[:, :, j]).max()))
        assert slope == pytest.approx(analytic[:, :, j], abs=2e-6 * size)


@pytest.mark.parametrize("convention", ["standard", "modified"])
def test_chain_jacobian_is_that_of_differences(convention):
    robot = any_arm(3, 6, convention)
    chain, q = robot.chain(), np.random.default_rng(1).normal(size=(4, 6))
    analytic = chain_jacobian(chain, q, flange_poses(chain, q))
    for k in range(len(chain.parameters())):
        step = np.zeros(analytic.shape[2])
        step[k] = 1e-6
        ends = [flange_poses(chain.moved(sign * step), q) for sign in (1, -1)]
        slope = ends[0].difference(ends[1]) / 2e-6
        assert slope == pytest.approx(analytic[:, :, k], abs=1e-5 * max(1.0, np.abs(analytic[:, :, k]).max()))


@settings(deadline=None)
@given(st.integers(0, 10**6), st.sampled_from(["standard", "modified"]))
def test_rows_of_a_moved_chain_make_its_poses(seed, convention):
    """The way back to D-H rows, with β where axes are nearly parallel: 1e-9 mm."""
    base = replace(mh80(), convention=convention)
    if convention == "modified":
        rows = ((0, 0, 540, 0), (145, -90, 0, -90), (870, 0, 0, 0))
        rows = (*rows, (210, -90, 1025, 0), (0, 90, 0, 0), (0, -90, 175, 0))
        rows = tuple(DHRow(a, np.radians(alpha), d, np.radians(theta)) for a, alpha, d, theta in rows)
        base = replace(base, rows=rows)
    rng = np.random.default_rng(seed)
    robot = made(base, rng, 2.0, 5e-3)
    chain = robot.chain().moved(rng.normal(size=24) * np.tile([5e-3, 5e-3, 2.0, 2.0], 6))
    tools = {"": Rigid.exp(rng.normal(size=6) * [1, 1, 1, 100, 100, 100])}
    again = robot_from_chain(chain, tools, base)
    q = joint_vectors(base, 20, rng)
    apart = (flange_poses(chain, q) @ tools[""]).difference(flange_poses(again.chain(), q) @ again.tools[""])
    assert np.abs(apart[:, 3:]).max() < 1e-9
    assert np.abs(apart[:, :3]).max() < 1e-12


def test_many_are_the_same_as_one_by_one_and_of_another_shape_are_refused():
    robot = mh80()
    q = joint_vectors(robot, CHUNK + 5, np.random.default_rng(0))
    every = forward(robot, q)
    for i in (0, CHUNK - 1, CHUNK, CHUNK + 4):
        assert np.abs(forward(robot, q[i]).difference(every[[i]])).max() < 1e-12
    assert isinstance(every, Poses)
    assert len(forward(robot, np.zeros((0, 6)))) == 0
    for q in (np.zeros(5), np.zeros((3, 7)), np.full((2, 6), np.nan), np.zeros((1, 2, 6))):
        with pytest.raises(InputError, match="joint values"):
            forward(robot, q)


def test_degrees_that_are_taken_for_radians_are_told():
    table = [[25, -np.pi / 2, 400, 0], [455, 0, 0, -np.pi / 2], [35, -np.pi / 2, 0, 0]]
    with pytest.warns(InputNote, match="limits: 100 rad are 16 turns"):
        Robot.from_dh(table, "standard", np.tile([-100.0, 100.0], (3, 1)))
    any_arm = Robot.from_dh(table, "standard", np.tile([-100.0, np.inf], (3, 1)), types=["prismatic"] * 3)
    forward(any_arm, [90.0, 30.0, -45.0])  # mm
    any_arm = Robot.from_dh(table, "standard", np.tile([-6.3, 6.3], (3, 1)))
    for call in (forward, jacobian):
        with pytest.warns(InputNote, match=r"joint values: 90 rad are 14 turns; if it is degrees, give np.radians"):
            call(any_arm, [90.0, 30.0, -45.0])


TOOL = Rigid.exp([0.1, 0.2, 0.3, 50, 60, 70])
ALONE = ("",) * 20


def bent(scale: float = 1.0) -> Robot:
    """An arm that stands askew, with half a millimetre of deflection at ``scale`` 1."""
    rng = np.random.default_rng(0)
    compliance, moment, periodic = rng.normal(size=(6, 2)), rng.normal(size=(6, 3)), rng.normal(size=(6, 4))
    elasticity = Elasticity(1e-6 * scale * compliance, 100 * moment, 1e-4 * scale * periodic, np.array([0.1, 0.2, -2]))
    return replace(mh80(), world_from_base=Rigid.exp([0.3, -0.5, 0.2, 100, 200, 300]), elasticity=elasticity)


def vectors(robot: Robot, count: int = 20) -> np.ndarray:
    return joint_vectors(robot, count, np.random.default_rng(1))


COUPLING = np.eye(6)
COUPLING[2, 1] = 1.0


def loose() -> Robot:
    """A coupled arm of which joints are 0.1 mrad farther where they came from below. Other deflections are a
    ten-thousandth of usual ones: differences grow with them, as the bent arm's torques are those of the rigid one."""
    elasticity = replace(bent(1e-4).elasticity, hysteresis=1e-4 * np.array([1, -0.5, 2, 0.3, 0.7, 1]))
    return replace(bent(), coupling=COUPLING, elasticity=elasticity)


def test_derivatives_are_those_of_small_changes():
    robot, q, rng = loose(), vectors(loose()), np.random.default_rng(6)
    chain, conditions = robot.chain(), Conditions(rng.uniform(0, 50, 20), rng.choice([-1.0, 1.0], (20, 6)))
    values = chain.elasticity.values(hysteresis=True)
    assert (chain.elasticity.with_values(values).hysteresis == robot.elasticity.hysteresis).all()
    values[54:] *= 1e-2

    def tips(moved) -> Poses:
        bending = replace(chain, elasticity=chain.elasticity.with_values(moved))
        return flange_poses(bending, q, conditions) @ TOOL

    found = elasticity_jacobian(chain, q, tips(values), ALONE, conditions, hysteresis=True)
    assert found.shape == (20, 6, 60)
    assert (elasticity_jacobian(chain, q, tips(values), ALONE, conditions) == found[:, :, :54]).all()
    for k, value in enumerate(values):
        step = np.zeros(len(values))
        step[k] = max(1e-3 * abs(value), 1e-10) if k < 54 else 1e-6
        expected = tips(values + step).difference(tips(values - step)) / (2 * step[k])
        size = np.abs(expected).max()
        assert np.abs(found[:, :, k] - expected).max() < 1e-4 * size + 1e-4


def test_rows_of_an_adjusted_chain_keep_its_deflections():
    """Axes off by 1 mm and 1 mrad: frames turn and slide by as little, deflections of 0.2 mm change by under 1 µm."""
    robot, rng = bent(), np.random.default_rng(2)
    chain = robot.chain()
    step = np.array([rng.normal(0, 1e-3 if c < 3 else 1.0) for _, c in chain.parameters()])
    moved = chain.moved(step)
    rows = robot_from_chain(moved, {"": TOOL}, robot)
    q = vectors(robot)
    reached = (flange_poses(moved, q) @ TOOL).difference(flange_poses(rows.chain(), q) @ rows.tools[""])
    rigid = flange_poses(moved, q).difference(flange_poses(replace(moved, elasticity=None), q))
    assert np.abs(rigid[:, 3:]).max() > 0.2
    assert np.abs(reached[:, 3:]).max() < 1e-3
    assert np.abs(reached[:, :3]).max() < 1e-12


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("gravity = [0, 0, 0]", "gravity is [0, 0, 0]"),
        ("axis_rad_per_Nm = [1e-6]", "elasticity: axis_rad_per_Nm has 1 entries, 6 needed"),
        ("stiffness = 3", "stiffness"),
        ("payload_kg = -1", "elasticity: payload_kg is -1; 0 … 10000 needed"),
        ("payload_kg = nan", "payload_kg"),
        ("hysteresis_rad = [1e-5]", "elasticity: hysteresis_rad has 1 entries, 6 needed"),
        ("payload_centre_mm = [1, 2]", "payload_centre_mm"),
    ],
)
def test_mistakes_in_a_file_are_named(tmp_path, text, message):
    path = written(tmp_path / "robot.toml", f"{robot_toml(mh80())}\n[elasticity]\n{text}\n")
    with pytest.raises(InputError, match=re.escape(message)):
        load_robot(path)


def test_weights_turn_the_shoulder_by_their_torque():
    """Joint 2 of the example is level. 1000 N m about it at 1e-6 rad/(N m) turn it by 1 mrad; 50 kg at the flange by
    50 · 9.80665 N times the flange's distance before it."""
    compliance, moment = np.zeros((6, 2)), np.zeros((6, 3))
    compliance[1, 0] = 1e-6
    q, rigid = np.zeros((1, 6)), mh80()
    place = forward(rigid, q).translation[0]
    reach = place - [rigid.rows[0].a, 0.0, rigid.rows[0].d]
    level = Elasticity(compliance, moment, np.zeros((6, 4)), np.array([0.0, 0.0, -1.0]))
    robot = replace(rigid, elasticity=level)
    moment = moment.copy()
    moment[1] = 1000 * links(rigid.chain(), q)[0][1, 0].T @ [1.0, 0.0, 0.0]
    heavy = replace(rigid, elasticity=replace(level, moment=moment))
    turn = 1e-6 * 50 * 9.80665 * reach[0] * 1e-3
    for moved, angle in ((forward(heavy, q), 1e-3), (forward(robot, q, payload_kg=50), turn)):
        assert moved.translation[0] - place == pytest.approx([angle * reach[2], 0.0, -angle * reach[0]], abs=2e-3)
    assert np.abs(forward(rigid, q, payload_kg=50).difference(forward(rigid, q))).max() == 0
    assert np.abs(forward(robot.loaded(50), q).difference(forward(robot, q, payload_kg=50))).max() == 0
    assert np.abs(forward(robot, q).translation[0] - place).max() == 0


def test_a_file_reads_back_the_same_and_rows_made_of_a_chain_know_the_payload(tmp_path):
    hysteresis = 1e-4 * np.array([1, -0.5, 2, 0.3, 0.7, 1])
    own = replace(bent().elasticity, payload_kg=12.5, payload_centre=np.ones(3), hysteresis=hysteresis)
    robot = replace(bent(), elasticity=own)
    again, q = load_robot(written(tmp_path / "robot.toml", robot_toml(robot))), vectors(robot)
    assert again.elasticity.payload_kg == 12.5
    assert again.elasticity.hysteresis == pytest.approx(hysteresis, rel=1e-15)
    assert np.abs(forward(again, q).difference(forward(robot, q))).max() < 1e-9
    step = np.random.default_rng(3).normal(0, 1e-3, len(robot.chain().parameters()))
    moved = robot.chain().moved(step)
    found = robot_from_chain(moved, {"": TOOL}, robot)
    assert found.elasticity.payload_centre == pytest.approx(np.ones(3), abs=1.0)  # rows put the flange elsewhere
    heavy = loaded(60.0, len(q))
    sag = flange_poses(moved, q, heavy).translation - flange_poses(moved, q).translation
    again = flange_poses(found.chain(), q, heavy).translation - flange_poses(found.chain(), q).translation
    assert np.abs(again - sag).max() < 1e-9


def test_hysteresis_is_an_error_of_the_controllers_values_and_masses_and_directions_that_cannot_be_are_refused():
    robot, rng = loose(), np.random.default_rng(5)
    q, came = vectors(robot), rng.choice([-1.0, 0.0, 1.0], (20, 6))
    chain = robot.chain()
    moved = flange_poses(chain, q, Conditions(approach=came))
    shifted = flange_poses(chain, q + robot.elasticity.hysteresis * came)
    assert np.abs(moved.difference(shifted)).max() < 1e-6
    assert np.abs(moved.difference(flange_poses(chain, q))[:, 3:]).max() > 0.1
    refuses("E-APPROACH-VALUE … 2", Conditions, approach=np.array([[1.0, 2.0]]))
    robot = bent()
    for mass in (-1.0, np.nan, 2e4, [1.0, 2.0]):
        with pytest.raises(InputError, match="payload"):
            forward(robot, vectors(robot), payload_kg=mass)


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
def test_nearest_of_all_branches_and_turns_and_where_two_almost_meet():
    """Elbow nearly stretched: both elbow branches are within 0.1 rad of every reference, and a step leads to either."""
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
def test_eight_branches_of_an_arm_with_a_spherical_wrist_and_what_remains_out_of_reach():
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


def test_a_redundant_arm_needs_a_reference_without_which_a_path_stays_in_its_branch():
    robot = seven()
    rng = np.random.default_rng(2)
    q = joint_vectors(robot, 100, rng, 0.9)
    found = inverse(robot, forward(robot, q), q + rng.normal(0, 0.02, q.shape))
    assert_reached(robot, forward(robot, q), found)
    assert np.abs(found.q - q).max() < 1
    refuses("E-ROBOT-REDUNDANT … 7", inverse, robot, forward(robot, q))
    refuses("E-ROBOT-REDUNDANT", branches, robot, forward(robot, q)[0])
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
