"""Simulation of arms as they leave the factory, and of measurements of them by an instrument."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.geometry.rigid import Rigid
from stcal.robot.identification.adjustment import State
from stcal.robot.kinematics.dh import robot_from_chain
from stcal.robot.kinematics.measurements import Measurements
from stcal.robot.kinematics.robot_model import USUAL, Conditions, Robot


def made(robot: Robot, rng: np.random.Generator, sigma_mm: float = 0.3, sigma_rad: float = 5e-4) -> Robot:
    """Returns the robot as made: axes shifted and tilted, zero positions off, by normal errors of these σ."""
    chain = robot.chain()
    kinds = chain.parameters()
    step = np.array([rng.normal(0, sigma_rad if c < 3 else sigma_mm) for _, c in kinds])
    step[: sum(i == 0 for i, _ in kinds)] = 0  # the first axis defines the base
    shifted = robot_from_chain(chain.moved(step), robot.tools, robot)
    rows = [shifted.rows[0]]
    rows += [replace(row, theta=row.theta + rng.normal(0, sigma_rad)) for row in shifted.rows[1:]]
    return replace(shifted, rows=tuple(rows), tools=dict(robot.tools), unusual_size=True)


def joint_vectors(robot: Robot, count: int, rng: np.random.Generator, share: float = 0.6) -> np.ndarray:
    """Returns joint vectors (count, n) over a share of each range (± 1 rad or 100 mm where unlimited)."""
    low, high = robot.limits().T
    free = np.where(robot.prismatic, 100.0, 1.0)
    low, high = np.where(np.isfinite(low), low, -free), np.where(np.isfinite(high), high, free)
    middle, half = (low + high) / 2, (high - low) / 2 * share
    return rng.uniform(middle - half, middle + half, (count, len(robot.rows)))


def placed(robot: Robot, world_from_base: Rigid, tools: dict[str, Rigid]) -> Robot:
    """Returns the robot with ``world_from_base`` as an instrument sees it, and with these tools."""
    return replace(robot, world_from_base=world_from_base, tools=tools)


def measured(
    robot: Robot,
    q: np.ndarray,
    rng: np.random.Generator,
    sigma_mm: float = 0.05,
    sigma_rad: float = 2e-4,
    targets: Sequence[str] = (),
    covariance: np.ndarray | None = None,
    conditions: Conditions = USUAL,
) -> Measurements:
    """Returns what an instrument measures of the robot at joint vectors (m, n). The poses have normal noise of these σ
    per axis, or of ``covariance`` (m, 6, 6), which then comes with them. They are of tool ``""``, or of each row's
    ``targets``, and under the rows' ``conditions``."""
    targets = tuple(targets) or ("",) * len(q)
    tip = State(robot.chain(), dict(robot.tools)).tips(q, targets, conditions)
    noise = rng.normal(0, 1, (len(q), 6))
    if covariance is None:
        noise = noise * np.repeat([sigma_rad, sigma_mm], 3)
    else:
        noise = np.einsum("mij,mj->mi", np.linalg.cholesky(covariance), noise)
    turn = Rotation.from_rotvec(noise[:, :3]).as_matrix()
    place = tip.translation + noise[:, 3:]
    lines, rotation = range(2, len(q) + 2), turn @ tip.rotation
    return Measurements("simulated", lines, q, targets, place, rotation, covariance, conditions=conditions)
