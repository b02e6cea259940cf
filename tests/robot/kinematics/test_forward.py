"""Forward kinematics against products of the textbook's matrices, and derivatives against differences."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stcal.errors import InputError, InputNote
from stcal.geometry.rigid import Poses, Rigid
from stcal.robot.kinematics.dh import robot_from_chain
from stcal.robot.kinematics.forward import CHUNK, chain_jacobian, flange_poses, forward, jacobian
from stcal.robot.kinematics.robot_model import DHRow, Joint, Robot, mh80
from stcal.robot.simulated import joint_vectors, made


def arm(seed: int, joints: int, convention: str) -> Robot:
    """Any rows, with β, prismatic joints, coupling, base and tools."""
    rng = np.random.default_rng(seed)
    rows = [DHRow(*(rng.normal(size=5) * [300, 1.5, 300, 1.5, 0.2])) for _ in range(joints)]
    kinds = [Joint("prismatic" if rng.random() < 0.3 else "revolute") for _ in range(joints)]
    coupling = np.eye(joints) + np.tril(rng.normal(size=(joints, joints)), -1) * 0.3
    tools = {"": Rigid.exp(rng.normal(size=6) * [1, 1, 1, 100, 100, 100]), "b": Rigid()}
    base = Rigid.exp(rng.normal(size=6) * [1, 1, 1, 900, 900, 900])
    return Robot("any", convention, tuple(rows), tuple(kinds), coupling, base, tools)


def matrix(turn_z=0.0, z=0.0, x=0.0, turn_x=0.0, turn_y=0.0) -> dict[str, np.ndarray]:
    (c, cx, cy), (s, sx, sy) = np.cos([turn_z, turn_x, turn_y]), np.sin([turn_z, turn_x, turn_y])
    return {
        "Rz": np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]),
        "Tz": np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, z], [0, 0, 0, 1]]),
        "Tx": np.array([[1, 0, 0, x], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]),
        "Rx": np.array([[1, 0, 0, 0], [0, cx, -sx, 0], [0, sx, cx, 0], [0, 0, 0, 1]]),
        "Ry": np.array([[cy, 0, sy, 0], [0, 1, 0, 0], [-sy, 0, cy, 0], [0, 0, 0, 1]]),
    }


@settings(deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 8), st.sampled_from(["standard", "modified"]))
def test_forward_is_the_product_of_the_rows(seed, joints, convention):
    robot = arm(seed, joints, convention)
    q = np.random.default_rng(seed + 1).normal(size=(3, joints)) * np.where(robot.prismatic, 200, 1)
    found = forward(robot, q)
    for k in range(3):
        pose = np.eye(4)
        for row, joint, value in zip(robot.rows, robot.joints, robot.coupling @ q[k], strict=True):
            sliding = joint.type == "prismatic"
            turn, shift = (0, value) if sliding else (value, 0)
            part = matrix(row.theta + turn, row.d + shift, row.a, row.alpha, row.beta)
            order = ("Rz", "Tz", "Tx", "Rx", "Ry") if convention == "standard" else ("Rx", "Tx", "Ry", "Rz", "Tz")
            for name in order:
                pose = pose @ part[name]
        assert np.abs(found[k].matrix() - pose @ robot.tools[""].matrix()).max() < 1e-9  # mm of metres: rounding


@pytest.mark.slow
@settings(deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 8), st.sampled_from(["standard", "modified"]))
def test_jacobian_is_that_of_differences(seed, joints, convention):
    robot = arm(seed, joints, convention)
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
    robot = arm(3, 6, convention)
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
    arm = Robot.from_dh(table, "standard", np.tile([-100.0, np.inf], (3, 1)), types=["prismatic"] * 3)
    forward(arm, [90.0, 30.0, -45.0])  # mm
    arm = Robot.from_dh(table, "standard", np.tile([-6.3, 6.3], (3, 1)))
    for call in (forward, jacobian):
        with pytest.warns(InputNote, match=r"joint values: 90 rad are 14 turns; if it is degrees, give np.radians"):
            call(arm, [90.0, 30.0, -45.0])
