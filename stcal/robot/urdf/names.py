"""Names of links and joints, units and bounds of a URDF."""

from stcal.robot.kinematics.model import JointType

WHAT = "URDF"
WORLD, BASE, FLANGE, TOOL, TOOL0 = "world", "base_link", "flange", "tool", "tool0"
"""Names of links; other tools are ``tool_NAME``."""
UNLIMITED = 1e6
"""Value in rad or m beyond which a limit counts as unlimited; URDF cannot state only one of two limits."""
MOVING: dict[str, JointType] = {"revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic"}


def link_of(tool: str) -> str:
    """Name of a tool's link."""
    return f"{TOOL}_{tool}" if tool else TOOL


def joint_name(i: int) -> str:
    """Returns the name of joint ``i``, counted from 0."""
    return f"joint_{i + 1}"
