"""Hand-eye calibration together with the arm, from joint values and images: ``stcal handeye --with-kinematics``."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from stcal.errors import InputError
from stcal.geometry.rigid import Order, Poses, Rigid
from stcal.handeye import HandEyeOptions
from stcal.handeye.data.formats.record import require_each_once
from stcal.handeye.data.pairs import SIDES, read_side
from stcal.handeye.data.robot_poses import RobotPoses
from stcal.handeye.report.outcome import ArmFound, Outcome
from stcal.handeye.solve import handeye
from stcal.handeye.validate import cross_validate, widened_by_scatter
from stcal.io.cameras.model import CameraPrior
from stcal.io.table import read_table
from stcal.robot import Robot
from stcal.robot.kinematics.dh import robot_from_chain
from stcal.robot.kinematics.forward import chain_jacobian, chain_parameters, flange_poses, moved_chain
from stcal.robot.kinematics.measurements import joint_values
from stcal.robot.kinematics.model import Chain

COMPONENTS = ("rx", "ry", "rz", "x", "y", "z")


@dataclass(frozen=True, slots=True, eq=False)
class Arm:
    """A robot at joint values (m, n), moved by small motions of its axes: :class:`stcal.handeye.methods.arm.ArmModel`.

    Its base and flange frames stay where they are: X and Z absorb the error of their places.
    """

    robot: Robot
    q: np.ndarray

    @property
    def angles(self) -> np.ndarray:
        """Boolean array (k,): True for parameters in rad."""
        return np.array([component < 3 for _, component in chain_parameters(self._chain())])

    def poses(self, parameters: np.ndarray) -> Poses:
        """Returns base_from_flange, m poses."""
        return flange_poses(moved_chain(self._chain(), parameters), self.q)

    def slope(self, parameters: np.ndarray) -> np.ndarray:
        """Returns the derivative (m, 6, k) of :meth:`poses` by a step of the parameters."""
        chain = moved_chain(self._chain(), parameters)
        return chain_jacobian(chain, self.q, flange_poses(chain, self.q))

    def __getitem__(self, rows) -> "Arm":
        """Returns the arm at these joint values alone."""
        return Arm(self.robot, self.q[rows])

    def identified(self, parameters: np.ndarray) -> Robot:
        """Returns the robot with these parameters, as D-H rows; base and tools stay as they were."""
        moved = robot_from_chain(moved_chain(self._chain(), parameters), dict(self.robot.tools), self.robot)
        return replace(moved, world_from_base=self.robot.world_from_base)

    def names(self) -> tuple[str, ...]:
        """Returns the names (k,) of the parameters: J2 rx in rad, J2 x in mm, in the frame of the joint."""
        return tuple(f"J{joint + 1} {COMPONENTS[c]}" for joint, c in chain_parameters(self._chain()))

    def _chain(self) -> Chain:
        return replace(self.robot, world_from_base=Rigid()).chain()


def read_arm(path: Path, robot: Robot, quaternions: Order = "wxyz") -> tuple[RobotPoses, Arm]:
    """Returns the robot's poses by its file, from a table with columns ``image`` and ``q1_deg`` … (CSV).

    Where the table has base_from_flange_… too, ``understood`` says how far these poses are off.

    Raises InputError: missing columns, values that are not numbers, or an image that has two rows.
    """
    table = read_table(path, "robot poses", quaternions)
    arm = Arm(robot, joint_values(table, robot))
    images, places = tuple(table.text("image")), tuple(f"line {line}" for line in table.lines)
    require_each_once(images, places, table.where, "image ")
    flange = arm.poses(np.zeros(len(arm.angles)))
    understood = f"{path.name}: joint values of {len(images)} images; poses by the file of {robot.name}"
    if any(name.startswith(side) for side in SIDES[0] for name in table.columns):
        reported, *_ = read_side(table, *SIDES[0])
        apart = (reported.inverse() @ flange).difference((reported.inverse() @ flange)[[0] * len(flange)])
        understood += (
            f"; its flange moves against the one reported by up to {np.linalg.norm(apart[:, 3:], axis=1).max():.3g} mm "
            f"and {np.degrees(np.linalg.norm(apart[:, :3], axis=1).max()):.2g}°"
        )
    return RobotPoses(images, flange, None, places, table.where, understood, own=False), arm


def with_arm(
    outcome: Outcome,
    arm: Arm,
    options: HandEyeOptions,
    prior: CameraPrior | None,
    rows: np.ndarray,
    workers: int | None,
    progress: Callable[[int, int], None],
) -> Outcome:
    """Returns the calibration with the arm's parameters and the intrinsics among the unknowns, beside the one without.

    Parameters
    ----------
    outcome : calibration of the same poses, by the robot's file
    arm : the arm at the joint values of these poses
    options : options of the outcome
    prior : prior of the intrinsics
    rows : (s, k) poses to hold out; none where empty
    workers, progress : as in :func:`stcal.handeye.cross_validate`

    Returns
    -------
    Outcome

    Raises
    ------
    StcalError
        For the reasons given in :func:`stcal.handeye.handeye`.
    """
    pairs, views, setup = outcome.pairs, outcome.views, outcome.result.setup
    if pairs is None or views is None:
        raise InputError("E-OPTION-NEEDS", "--with-kinematics: only with images, whose corners show the arm's errors")
    options, method = replace(options, arm=arm, intrinsics=prior, symmetries=()), "reprojection"
    result = handeye(pairs, setup, method, views, options)
    held_out, notes = None, outcome.notes
    if len(rows):
        held_out = cross_validate(pairs, setup, method, views, options, rows, workers, progress)
        result = widened_by_scatter(result, held_out)
    adjusted = result.reprojection
    if adjusted is None or adjusted.arm is None or adjusted.arm_covariance is None:
        raise ValueError("reprojection with an arm has its parameters")
    sigma = np.sqrt(np.diag(adjusted.arm_covariance))
    arm_found = ArmFound(arm.robot.name, arm.names(), adjusted.arm, sigma, outcome.held_out)
    if held_out is not None and outcome.held_out is not None:
        now, before = (errors.means()["board_mm"] for errors in (held_out, outcome.held_out))
        if now >= before:
            notes = (
                *notes,
                f"the arm's parameters gain nothing on poses held out ({now:.3g} mm with, {before:.3g} mm without "
                "them): leave --with-kinematics out, or take more poses",
            )
    model = prior.colmap_model if prior else ""
    return replace(outcome, result=result, held_out=held_out, colmap_model=model, notes=notes, arm=arm_found)
