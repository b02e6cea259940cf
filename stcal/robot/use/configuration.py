"""Whether an arm stays in its configuration: another branch, or another turn of a joint, is no compensation.

Inverse kinematics takes the nearest solution within the limits. Where the nearest one of all is beyond a limit, what is
left may be an arm with its wrist or elbow turned over, which no program may do by itself.
"""

from dataclasses import dataclass, replace

import numpy as np

from stcal.geometry.rigid import Poses
from stcal.robot.kinematics.inverse import LIMIT, SAME_BRANCH, Inverse
from stcal.robot.kinematics.model import Joint, Robot
from stcal.robot.use.targets import Targets, joints_of

ISOLATED = 6
"""Joints, up to which solutions are isolated: another one is another configuration."""


@dataclass(frozen=True, slots=True, eq=False)
class Stayed:
    """``found`` : solutions, none of another configuration than that of the joint values they are near to; ``beyond`` :
    by row what stands against it, such as ``"J4 at 190.2°, limit 190°"``."""

    found: Inverse
    beyond: dict[int, str]


def stayed(robot: Robot, targets: Targets, poses: Poses, near: np.ndarray, found: Inverse, rows: np.ndarray) -> Stayed:
    """Solutions ``found`` near to ``near`` (m, n), looked at once more in ``rows``: without limits.

    A row whose nearest solution of all is beyond the limits gets the status ``limit`` and joint values at the limit.
    """
    if not len(rows) or len(robot.rows) > ISOLATED:
        return Stayed(found, {})
    some = targets[rows]
    free = joints_of(_between(robot, np.tile([-np.inf, np.inf], (len(robot.rows), 1))), some, poses[rows], near[rows])
    q, status = found.q.copy(), list(found.status)
    error_mm, error_rad = found.error_mm.copy(), found.error_rad.copy()
    beyond = {}
    for k, i in enumerate(rows.tolist()):
        if not free.usable[k]:
            continue
        said = _beyond(robot, free.q[k])
        if not said or (found.usable[i] and np.abs(free.q[k] - found.q[i]).max() <= SAME_BRANCH):
            continue
        beyond[i] = said
        if found.usable[i]:
            least, most = np.minimum(near[i], free.q[k]), np.maximum(near[i], free.q[k])
            limits = np.column_stack([least, most]).clip(*robot.limits().T[:, :, None])
            at = joints_of(_between(robot, limits), targets[rows[[k]]], poses[[i]], near[[i]])
            q[i], error_mm[i], error_rad[i], status[i] = at.q[0], at.error_mm[0], at.error_rad[0], LIMIT
    return Stayed(Inverse(q, tuple(status), error_mm, error_rad), beyond)


def _between(robot: Robot, limits: np.ndarray) -> Robot:
    """Returns the robot with other limits (n, 2)."""
    joints = (Joint(own.type, low, high) for own, (low, high) in zip(robot.joints, limits.tolist(), strict=True))
    return replace(robot, joints=tuple(joints))


def _beyond(robot: Robot, q: np.ndarray) -> str:
    """Which joints of (n,) are beyond their limits, and by what; empty where none is."""
    said = []
    for number, (value, joint) in enumerate(zip(q.tolist(), robot.joints, strict=True), 1):
        limit = min(max(value, joint.lower), joint.upper)
        if abs(value - limit) > SAME_BRANCH:
            unit, factor = (" mm", 1.0) if joint.type == "prismatic" else ("°", float(np.degrees(1.0)))
            said.append(f"J{number} at {value * factor:.6g}{unit}, limit {limit * factor:.6g}{unit}")
    return " and ".join(said)
