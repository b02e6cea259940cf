"""Writes a robot as URDF, and verifies that the written file gives the same poses."""

import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from stcal.errors import InputError
from stcal.geometry.rigid import Poses, Rigid
from stcal.io.files import SETTINGS_BYTES, read_bytes, require_written
from stcal.io.poses.controllers import METRE_MM, roll_pitch_yaw
from stcal.io.table import pose_values
from stcal.robot.kinematics.forward import fixed_values, flange_poses, forward
from stcal.robot.kinematics.model import Robot
from stcal.robot.urdf.read import (
    BASE,
    FLANGE,
    SAME_MM,
    UNLIMITED,
    WHAT,
    WORLD,
    joint_name,
    link_of,
    read_urdf,
)


def robot_urdf(robot: Robot) -> str:
    """The text of a URDF: links ``world``, ``base_link``, ``link_1`` …, ``flange``, ``tool`` and ``tool_NAME``; without
    ``flange`` of a tree, the tools of which are fixed to the links that carry them.

    Joint values are the kinematic ones: where the controller couples joints, the coupling times its values, and limits
    are the widest that its limits allow.

    Parameters
    ----------
    robot : Robot
        What to write.

    Returns
    -------
    str
        XML, in metres and rad; every number reads back to the same double but for the last bit.

    Raises
    ------
    InputError
        An elastic robot.
    """
    if robot.elasticity is not None:
        raise InputError(
            "E-ROBOT-ELASTICITY",
            f"robot {robot.name}: a URDF cannot hold its elasticity; remove [elasticity] for the axes alone, or "
            "export compensated points (`stcal robot compensate --export`)",
        )
    chain = replace(robot, world_from_base=Rigid()).chain()
    root = ElementTree.Element("robot", name=robot.name)
    root.append(ElementTree.Comment(" effort and velocity are not known: 0 "))
    if coupled(robot):
        root.append(
            ElementTree.Comment(" joint values are kinematic: the coupling of the robot file times the controller's ")
        )
    ElementTree.SubElement(root, "link", name=WORLD)
    _fixed(root, WORLD, BASE, robot.world_from_base)
    low, high = _limits(robot)
    for i, joint in enumerate(robot.joints):
        unit = METRE_MM if joint.type == "prismatic" else 1.0
        limited = np.isfinite([low[i], high[i]]).any()
        kind = "continuous" if joint.type == "revolute" and not limited else joint.type
        above = f"link_{chain.after(i) + 1}" if chain.after(i) >= 0 else BASE
        element = _joint(root, joint_name(i), kind, above, f"link_{i + 1}", chain.gap(i))
        ElementTree.SubElement(element, "axis", xyz="0 0 1")
        if kind != "continuous":
            ends = {"lower": max(low[i] / unit, -UNLIMITED), "upper": min(high[i] / unit, UNLIMITED)}
            shown = {end: repr(float(value)) for end, value in ends.items()}
            ElementTree.SubElement(element, "limit", shown | {"effort": "0", "velocity": "0"})
    if chain.grown is None:
        _fixed(root, f"link_{len(chain)}", FLANGE, chain.last_from_flange)
    for name, tool in robot.tools.items():
        if chain.grown is None:
            _fixed(root, FLANGE, link_of(name), tool)
        else:
            carrier = chain.carrier(name)
            _fixed(root, f"link_{carrier + 1}", link_of(name), chain.grown.ends[carrier] @ tool)
    ElementTree.indent(root)
    return f'<?xml version="1.0"?>\n{ElementTree.tostring(root, encoding="unicode")}\n'


def coupled(robot: Robot) -> bool:
    """True if the controller's joint values differ from the kinematic ones."""
    return bool((robot.coupling != np.eye(len(robot.rows))).any())


def _limits(robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    """(n,) lowest and highest kinematic joint values."""
    if not coupled(robot):
        low, high = robot.limits().T
        return low, high
    ends = np.where(robot.coupling[..., None] == 0, 0.0, robot.coupling[..., None] * robot.limits()[None])
    return ends.min(axis=2).sum(axis=1), ends.max(axis=2).sum(axis=1)


def _joint(
    root: ElementTree.Element, name: str, kind: str, parent: str, child: str, pose: Rigid
) -> ElementTree.Element:
    ElementTree.SubElement(root, "link", name=child)
    element = ElementTree.SubElement(root, "joint", name=name, type=kind)
    ElementTree.SubElement(element, "parent", link=parent)
    ElementTree.SubElement(element, "child", link=child)
    place, turn = ([repr(float(v)) for v in part] for part in (pose.translation / METRE_MM, roll_pitch_yaw(pose)))
    ElementTree.SubElement(element, "origin", xyz=" ".join(place), rpy=" ".join(turn))
    return element


def _fixed(root: ElementTree.Element, parent: str, child: str, pose: Rigid) -> None:
    _joint(root, f"{parent}_to_{child}", "fixed", parent, child, pose)


def require_urdf_written(path: str | Path, robot: Robot) -> None:
    """Read a written URDF again, and require that it leads every tool where the robot does.

    Raises ConvergenceError: the file cannot be read again, or the poses of a tool differ.
    """
    q = fixed_values(len(robot.rows))

    def again() -> np.ndarray:
        content = read_bytes(path, SETTINGS_BYTES)
        if robot.tree is None:
            found = read_urdf(content, WHAT, convention=robot.convention).robot
            chain, kinematic = found.chain(), q @ robot.coupling.T
            return tips(lambda name: flange_poses(chain, kinematic) @ found.tool(name))
        read = read_urdf(content, WHAT, BASE, [link_of(name) for name in robot.tools], robot.convention)
        names = [joint_name(i) for i in range(len(robot.rows))]
        kinematic = (q @ robot.coupling.T)[:, [names.index(name) for name in read.joints]]
        return tips(lambda name: read.robot.world_from_base @ forward(read.robot, kinematic, link_of(name)))

    def tips(pose: Callable[[str], Poses]) -> np.ndarray:
        return np.array([pose_values(pose(name)) for name in robot.tools])

    base = robot.world_from_base if robot.tree is None else Rigid()  # a tree is read from its base
    wanted = tips(lambda name: base @ forward(robot, q, name))
    far = max(SAME_MM, 1e-12 * float(np.abs(wanted).max()))
    require_written(path, again, wanted, far, "mm")
