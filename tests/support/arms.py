"""Simulated arms that bend or that branch."""

from collections.abc import Sequence
from dataclasses import astuple, replace

import numpy as np

from stcal.geometry.rigid import Poses, Rigid
from stcal.robot.identification.prior import DOWN, MOMENT, Deviations, usual
from stcal.robot.kinematics.measurements import Measurements, Targets
from stcal.robot.kinematics.robot_model import Convention, DHRow, Elasticity, Joint, Robot, Tree, mh80
from stcal.robot.simulated import joint_vectors, made, measured, placed

TOOL, WORLD = Rigid.exp([0.3, 0.2, 0.1, 100, 50, 200]), Rigid.exp([0.1, 0.2, 0.3, 1000, 500, 200])
"""Of :func:`seen_arm`; its tool is also that of :func:`modified`."""
MARKERS = ("left", "right", "elbow")
"""Of :func:`two_arms`."""
LEFT, RIGHT = Rigid.exp([0.5, 0.2, 0.1, 100, 250, 300]), Rigid.exp([-0.5, 0.3, -0.1, 100, -250, 300])
"""Where its arms begin behind the torso."""


def elastic(robot: Robot, rng: np.random.Generator, share: float = 1.0, heavier: float = 1.0) -> Robot:
    """The robot with links that give way to gravity, and gears, by normal numbers of ``share`` times the usual σ; its
    masses are ``heavier`` times the usual ones."""
    known, n = usual(robot.chain()), len(robot.rows)
    sigma = np.array([*share * np.array(astuple(Deviations())), 1.0])[known.group]
    values = known.expected + rng.normal(0, sigma) / known.scale
    values[known.group == MOMENT] *= heavier
    compliance, rest = np.abs(values[: 2 * n]), values[2 * n :]
    none = Elasticity(np.zeros((n, 2)), np.zeros((n, 3)), np.zeros((n, 4)), DOWN)
    return replace(robot, elasticity=none.with_values(np.append(compliance, rest)))


def seen_arm(rng: np.random.Generator, rows: int, share: float = 0.6) -> tuple[Robot, Measurements]:
    """An arm as made, and what an instrument sees over the middle ``share`` of its ranges."""
    true = placed(made(mh80(), rng), WORLD, {"": TOOL})
    return true, measured(true, joint_vectors(true, rows, rng, share), rng)


def targets(poses: Poses | None, q: np.ndarray | None = None, tools: Sequence[str] = ()) -> Targets:
    """Poses base_from_tool (m,), or joint values (m, n) that command them, as the rows of a file after its header."""
    m = len(q) if poses is None else len(poses)
    return Targets("targets t.csv", range(2, m + 2), tuple(tools) or ("",) * m, poses, q)


def two_arms(convention: Convention = "standard") -> Robot:
    """Two joints of a torso, two arms of six, a marker in each hand and one on the left forearm."""
    arm = mh80() if convention == "standard" else replace(mh80(), convention="modified")
    arm_rows = tuple(replace(row, a=row.a / 3, d=row.d / 3) for row in arm.rows)
    torso = (DHRow(60.0, 1.4, 400.0, 0.0), DHRow(80.0, -1.3, 50.0, 0.2))
    wide = (Joint(lower=-1.0, upper=1.0), Joint(lower=-0.6, upper=0.6))
    tools = {"left": Rigid.exp([0.1, 0.2, 0.3, 20, 30, 80]), "right": Rigid.exp([0.3, -0.2, 0.1, -30, 10, 90])}
    tools["elbow"] = Rigid.exp([0, 0.1, 0.2, 60, -20, 40])
    tree = Tree({2: (1, LEFT), 8: (1, RIGHT)}, {"left": 7, "right": 13, "elbow": 4})
    base = Rigid.exp([0.1, 0.2, 0.9, 1500, -300, 200])
    rows, joints = (*torso, *arm_rows, *arm_rows), (*wide, *arm.joints, *arm.joints)
    return Robot("torso", arm.convention, rows, joints, world_from_base=base, tools=tools, tree=tree)


def modified() -> Robot:
    """A six-axis arm by Craig's convention with Hayati's β, its third joint coupled as Fanuc's."""
    half = np.pi / 2
    rows = [DHRow(0, 0, 400, 0), DHRow(150, -half, 0, -half), DHRow(700, 0, 0, 0)]
    rows += [DHRow(120, -half, 720, 0), DHRow(0, half, 0, 0), DHRow(0, -half, 90, 0)]
    rows[2] = replace(rows[2], beta=2e-4)
    coupling = np.eye(6)
    coupling[2, 1] = 1.0
    limits = np.radians([170, 100, 130, 190, 120, 350])
    joints = tuple(Joint("revolute", -v, v) for v in limits)
    tools = {"": Rigid.exp([0.2, -0.4, 0.9, 60.0, -35.0, 120.0])}
    return Robot("modified", "modified", tuple(rows), joints, coupling, tools=tools)


def scara() -> Robot:
    """Four axes: shoulder, elbow, vertical travel, spindle."""
    rows = (DHRow(350, 0, 400, 0), DHRow(300, np.pi, 0, 0), DHRow(0, 0, 0, 0), DHRow(0, 0, 50, 0))
    joints = (Joint("revolute", -2.4, 2.4), Joint("revolute", -2.5, 2.5), Joint("prismatic", 0, 200), Joint())
    return Robot("scara", "standard", rows, joints)
