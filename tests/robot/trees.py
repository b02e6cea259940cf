"""A robot with two arms on a torso, and a marker on a forearm."""

from dataclasses import replace

from stcal.geometry.rigid import Rigid
from stcal.robot.kinematics.example import mh80
from stcal.robot.kinematics.model import DHRow, Joint, Robot, Tree

MARKERS = ("left", "right", "elbow")
LEFT, RIGHT = Rigid.exp([0.5, 0.2, 0.1, 100, 250, 300]), Rigid.exp([-0.5, 0.3, -0.1, 100, -250, 300])


def two_arms(convention="standard") -> Robot:
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
    return Robot("torso", arm.convention, rows, joints, None, base, tools, tree=tree)
