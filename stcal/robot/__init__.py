"""Robots: kinematics, identification from measured data, compensation."""

from stcal.robot.kinematics import forward, jacobian
from stcal.robot.model import DHRow, Joint, Robot
from stcal.robot.robot_file import load_robot, robot_toml

__all__ = ["DHRow", "Joint", "Robot", "forward", "jacobian", "load_robot", "robot_toml"]
