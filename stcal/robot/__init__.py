"""Robots: kinematics, identification from measured data, compensation.

Lengths in mm, angles in rad, joint values (m, n) as the controller has them::

    from stcal import robot

    nominal = robot.load_robot("robot.toml")
    plan = robot.design(nominal, robot.DesignOptions(count=40))  # plan.q: joint vectors to measure at
    data = robot.read_measurements("measured.csv", nominal)
    found = robot.identify(nominal, data, robot.IdentifyOptions(sigma_mm=0.03, folds=6))
    print(found.rank, found.held_out.position_mm.mean(), found.covariance.shape)
    robot.save_robot("identified.toml", found.robot)

    base_from_tool = robot.forward(found.robot, data.q)  # m poses at once
    slope = robot.jacobian(found.robot, data.q)  # (m, 6, n)
    solved = robot.inverse(found.robot, base_from_tool, data.q)  # solved.q, solved.status
    told = robot.compensate(found.robot, robot.read_targets("targets.csv", nominal), nominal)  # told.found.q
    check = robot.verify(robot.read_measured("verified.csv"))  # check.sets[0].mean_mm, .max_mm
    axes = robot.robot_from_sweeps(robot.read_measurements("sweeps.csv", nominal), nominal)  # axes.robot
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from stcal.robot.axes_model import robot_from_sweeps
    from stcal.robot.compensation import compensate, read_targets
    from stcal.robot.data import Measurements, read_measurements
    from stcal.robot.identification import Identified, IdentifyOptions, identify
    from stcal.robot.inverse_kinematics import inverse
    from stcal.robot.kinematics import forward, jacobian
    from stcal.robot.model import DHRow, Joint, Robot
    from stcal.robot.plan_poses import DesignOptions, design
    from stcal.robot.robot_file import load_robot, robot_toml, save_robot
    from stcal.robot.verification import read_measured, verify

_MODULES = {
    "axes_model": ("robot_from_sweeps",),
    "compensation": ("compensate", "read_targets"),
    "data": ("Measurements", "read_measurements"),
    "identification": ("Identified", "IdentifyOptions", "identify"),
    "inverse_kinematics": ("inverse",),
    "kinematics": ("forward", "jacobian"),
    "model": ("DHRow", "Joint", "Robot"),
    "plan_poses": ("DesignOptions", "design"),
    "robot_file": ("load_robot", "robot_toml", "save_robot"),
    "verification": ("read_measured", "verify"),
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}

__all__ = [
    "DHRow",
    "DesignOptions",
    "Identified",
    "IdentifyOptions",
    "Joint",
    "Measurements",
    "Robot",
    "compensate",
    "design",
    "forward",
    "identify",
    "inverse",
    "jacobian",
    "load_robot",
    "read_measured",
    "read_measurements",
    "read_targets",
    "robot_from_sweeps",
    "robot_toml",
    "save_robot",
    "verify",
]


def __getattr__(name: str):
    """Import on demand: forward kinematics needs neither files nor optimisers."""
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__} has no attribute {name}")
    return getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), name)
