"""The robot poses to take next for hand-eye calibration, within an arm's reach: ``stcal handeye plan``."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from stcal.errors import InputError
from stcal.geometry.arrays import require_arguments
from stcal.geometry.rigid import Poses
from stcal.handeye import HandEyeOptions, NextPoses, plan_poses
from stcal.handeye.result import HandEye
from stcal.handeye.solve import handeye
from stcal.parallel import one_thread
from stcal.robot import Robot, inverse
from stcal.robot.kinematics.inverse import REACHED
from stcal.robot.use.compensation import joint_columns
from stcal.workflows.handeye.inputs import HandEyeInput

LEAST_REACHED = 0.5
"""Share of the poses taken that the arm of a robot file must reach to be accepted as this robot."""


@dataclass(frozen=True, slots=True, eq=False)
class Planned:
    """``result`` : from the poses taken; ``poses`` : poses to take; ``joints`` : joint values (k,) of these by column,
    deg or mm, with a robot file; ``notes`` : on the poses."""

    result: HandEye
    poses: NextPoses
    joints: dict[str, np.ndarray]
    notes: tuple[str, ...]


@require_arguments
@one_thread()
def plan_handeye(given: HandEyeInput, count: int = 3, robot: Robot | None = None, seed: int = 0) -> Planned:
    """Returns the robot poses that would lower the worst σ at the board most, after those of a hand-eye calibration.

    Parameters
    ----------
    given : HandEyeInput
        Poses taken so far, of :func:`stcal.workflows.read_handeye`.
    count : int
        Number of poses to plan.
    robot : Robot, optional
        Robot within whose joint limits the poses are to be, from its own base to its flange, no tool.
    seed : int
        Seed of the candidates.

    Returns
    -------
    Planned
        ``poses`` to take, mm; with a robot ``joints``, deg or mm, by column; the ``result`` so far.

    Raises
    ------
    InputError
        For the reasons given in :func:`stcal.handeye.plan_poses`, or the robot does not reach half of the poses taken.
    DegenerateError
        For the reasons given in :func:`stcal.handeye.handeye`.
    """
    setup = given.setup or "eye-in-hand"
    options = HandEyeOptions(with_scale=given.unit_mm is not None, symmetries=given.symmetries)
    result = handeye(given.pairs, setup, None, given.views, options)
    camera = outline = None
    if given.views is not None:
        camera = given.views.camera
        outline = np.unique(np.concatenate([view.xyz_board for view in given.views.views]), axis=0)
    if robot is None:
        return Planned(result, plan_poses(given.pairs, result, count, outline, camera, None, seed), {}, ())
    near, notes = _taken(robot, given)
    planned = plan_poses(given.pairs, result, count, outline, camera, _reach(robot, near), seed)
    return Planned(result, planned, _joints(robot, planned.base_from_flange, near), notes)


def _taken(robot: Robot, given: HandEyeInput) -> tuple[np.ndarray, tuple[str, ...]]:
    """Returns the joint values (n,) of the last pose taken that the robot reaches, and notes on poses that it does
    not."""
    flange = given.pairs.base_from_flange
    solutions = inverse(robot, flange, _middle(robot))
    beyond = [name for name, usable in zip(given.pairs.names, solutions.usable, strict=True) if not usable]
    message = f"robot {robot.name}: reaches {len(flange) - len(beyond)} of the {len(flange)} poses taken"
    if len(beyond) > (1 - LEAST_REACHED) * len(flange):
        raise InputError(
            "E-PLAN-ROBOT",
            f"{message}, first not {beyond[0]}; give the robot's own file, in whose base and flange (no tool) the "
            "poses are",
        )
    notes = (f"{message}, not {', '.join(beyond)}: do its lengths and limits hold for this arm?",) if beyond else ()
    return solutions.q[np.flatnonzero(solutions.usable)[-1]], notes


def _middle(robot: Robot) -> np.ndarray:
    """Returns the middle (n,) of the joint limits, 0 where there are none."""
    middle = robot.limits().mean(1)
    return np.where(np.isfinite(middle), middle, 0.0)


def _reach(robot: Robot, near: np.ndarray) -> Callable[[Poses], np.ndarray]:
    def reachable(flange: Poses) -> np.ndarray:
        """Returns True where a pose is within the limits and its joint values are determined."""
        return np.array([status == REACHED for status in inverse(robot, flange, near).status])

    return reachable


def _joints(robot: Robot, flange: Poses, near: np.ndarray) -> dict[str, np.ndarray]:
    q = inverse(robot, flange, near).q
    return dict(zip(joint_columns(robot), np.where(robot.prismatic, q, np.degrees(q)).T, strict=True))
