"""Robots as others describe them: URDF, read and written, and the calibration of an arm of Universal Robots."""

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Annotated

import numpy as np
import yaml
from pydantic import Field
from scipy.spatial.transform import Rotation

from stcal.errors import InputError, StcalError
from stcal.geometry.arrays import Brief, require_arguments
from stcal.geometry.rigid import Poses, Rigid
from stcal.io.files import SETTINGS_BYTES, read_bytes, require_written, text_of
from stcal.io.rotations import MOST_RAD
from stcal.io.static_transforms import METRE_MM, from_roll_pitch_yaw, roll_pitch_yaw
from stcal.io.table import pose_values
from stcal.io.toml import Strict, load_yaml, validated
from stcal.lengths import MOST_LINK_MM
from stcal.robot.kinematics.dh import robot_between, robot_from_chain
from stcal.robot.kinematics.forward import carried_poses, fixed_values, forward
from stcal.robot.kinematics.robot_file import load_robot
from stcal.robot.kinematics.robot_model import Chain, Convention, DHRow, Joint, JointType, Robot, Tree

WORLD, BASE, FLANGE, TOOL, TOOL0 = "world", "base_link", "flange", "tool", "tool0"
"""Names of links; other tools are ``tool_NAME``."""
UNLIMITED = 1e6  # value in rad or m beyond which a limit counts as unlimited; URDF cannot state only one of two limits
PLACED_BY = {"origin": ("xyz", "rpy"), "axis": ("xyz",)}  # elements of a joint that place it, and their attributes
MOVING: dict[str, JointType] = {"revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic"}
SAME_MM, SAME_RAD = 1e-9, 1e-12
"""Largest difference between the poses of the Denavit–Hartenberg rows and those of the joints as read."""


def link_of(tool: str) -> str:
    """Returns the name of a tool's link."""
    return f"{TOOL}_{tool}" if tool else TOOL


def few(names: Sequence[str], most: int = 12) -> str:
    """Returns the first names of many, and how many more there are."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class UrdfRobot(Brief):
    """A robot of a URDF, or of a calibration of Universal Robots, mm, rad; its joint values are those of the file.

    ``joints`` : names of the moving joints; ``from_link``, ``to_link`` : links between which the robot was read;
    ``notes`` : missing limits of joints, and how angles were read.
    """

    robot: Robot
    joints: tuple[str, ...]
    from_link: str
    to_link: str
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class UrdfJoint:
    """``parent_from_child`` with the joint at 0; ``axis`` : (3,) of length 1, in the child; ``limit`` : rad or mm."""

    name: str
    kind: str
    parent: str
    child: str
    parent_from_child: Rigid
    axis: np.ndarray
    limit: tuple[float, float] | None
    mimics: str

    @property
    def moves(self) -> bool:
        """True if it is not fixed."""
        return self.kind != "fixed"

    @property
    def unit(self) -> float:
        """Of its value in the file, in mm or rad."""
        return METRE_MM if self.kind == "prismatic" else 1.0


@require_arguments
def load_urdf(
    path: str | Path, from_link: str = "", to_link: str | Sequence[str] = "", convention: Convention = "standard"
) -> UrdfRobot:
    """Read the chain of joints between two links of a URDF, or the tree of those to several links.

    ``path`` : URDF; a xacro file must be expanded before; ``from_link`` : the base, the root if not given: where the
    root is called ``world`` and holds a link by a fixed joint, this link is the base, and the joint where it stands;
    ``to_link`` : the tool; if not given the only link without children behind the last joint, ``tool0``, or ``tool``
    and ``tool_NAME`` as :func:`robot_urdf` writes them; several are tools called like the links, on branches of a tree;
    ``convention`` : of the Denavit–Hartenberg rows. The robot's flange is the link ``flange`` where a row can end
    there, else the frame of the last joint.

    Raises InputError: unreadable, no URDF, no such links or none between them that moves, joints that move otherwise or
    mimic others, several links that may be the tool.
    """
    where = f"URDF {path}"
    try:
        content = read_bytes(path, SETTINGS_BYTES)
    except OSError as error:
        raise InputError("E-FILE-UNREADABLE", f"{where}: {error.strerror or error}; check the path") from error
    root = _parsed(content, where)
    elements = root.findall("joint")
    joints = {joint.child: joint for joint in (_read_joint(each, where) for each in elements)}
    if len(joints) < len(elements):
        raise InputError("E-URDF-LINKS", f"{where}: a link is the child of two joints; a tree needed")
    links = [link.get("name", "") for link in root.findall("link")]
    links = list(dict.fromkeys([*links, *joints, *(joint.parent for joint in joints.values())]))
    try:
        TopologicalSorter({child: [joint.parent] for child, joint in joints.items()}).prepare()
    except CycleError as error:
        raise InputError("E-URDF-LINKS", f"{where}: link {error.args[1][0]} is below itself; a tree needed") from error
    given = [to_link] if isinstance(to_link, str) else list(to_link)
    for option, name in (("--from-link", from_link), *(("--to-link", name) for name in given)):
        if name and name not in links:
            raise InputError("E-URDF-LINKS", f"{where}: {option} {name}: no such link; there are {few(links)}")
    for joint in joints.values():
        far, most = (mm / METRE_MM for mm in (np.linalg.norm(joint.parent_from_child.translation), MOST_LINK_MM))
        if far > most:
            fault = f"{where}: joint {joint.name}: origin {far:g} m from its parent, up to {most:g} possible"
            raise InputError("E-LENGTH-UNIT", f"{fault}: URDF is in metres; divide lengths in mm by 1000")
    roots = [link for link in links if link not in joints]
    if not from_link and len(roots) != 1:
        fault = f"{where}: {len(roots)} links are no joint's child"
        raise InputError("E-URDF-LINKS", f"{fault}; one root needed, or --from-link")
    start = from_link or roots[0]
    ends = {name if given[1:] else "": name for name in given} if any(given) else _tools(joints, start, where)
    paths = {name: _path(joints, start, end, where) for name, end in ends.items()}
    first, world = next(iter(paths.values())), Rigid()
    shared = all(way[0].name == first[0].name for way in paths.values())
    if not from_link and start == WORLD and not first[0].moves and shared:
        world, start = first[0].parent_from_child, first[0].child
        paths = {name: way[1:] for name, way in paths.items()}
    robot = robot_of(paths, root.get("name") or "robot", convention)
    moving = list({joint.name: joint for way in paths.values() for joint in way if joint.moves}.values())
    notes = tuple(f"joint {j.name} has no limits" for j in moving if j.limit is None and j.kind != "continuous")
    robot = replace(robot, world_from_base=world @ robot.world_from_base)
    return UrdfRobot(robot, tuple(j.name for j in moving), start, ", ".join(ends.values()), notes)


def require_near(found: Poses, wanted: Poses) -> None:
    """Requires that rows lead where joints do; raises StcalError."""
    off = np.abs(found.difference(wanted)).max(axis=0)
    far = max(SAME_MM, 1e-12 * float(np.abs(wanted.translation).max()))
    if off[3:].max() > far or off[:3].max() > SAME_RAD:
        fault = f"URDF: the rows lead elsewhere, by {off[3:].max():.2g} mm and {off[:3].max():.2g} rad"
        raise StcalError("E-ROBOT-READ-BACK", f"{fault}; {far:.2g} mm and {SAME_RAD:g} rad allowed")


def robot_of(paths: dict[str, list[UrdfJoint]], name: str, convention: Convention) -> Robot:
    """Returns the robot of the paths from one link to tools: one arm if one of them is ``""``, else a tree."""
    place: dict[str, int] = {}
    moving, gaps, mounts, carriers, tools, flange = [], [], {}, {}, {}, Rigid()
    for tool, path in paths.items():
        last, passed = -1, Rigid()
        for joint in path:
            passed = passed @ joint.parent_from_child
            if joint.moves:
                turn = _z_to(joint.axis)
                if joint.name not in place:
                    place[joint.name] = i = len(moving)
                    moving.append(joint)
                    gaps.append(passed @ turn)
                    if last != i - 1:
                        mounts[i] = last, Rigid()
                last, passed = place[joint.name], turn.inverse()
            if not tool and (joint.moves or joint.child == FLANGE):
                flange = Rigid() if joint.moves else passed
        carriers[tool], tools[tool] = last, passed
    joints, n, placed = [], len(moving), Poses.of(gaps)
    for each in moving:
        kind, (low, high) = MOVING[each.kind], each.limit or (-np.inf, np.inf)
        most = UNLIMITED * each.unit
        joints.append(Joint(kind, low if low > -most else -np.inf, high if high < most else np.inf))
    sliding = np.array([joint.type == "prismatic" for joint in joints])
    ends, tree = (*(Rigid(),) * (n - 1), flange), Tree() if "" in paths else Tree(mounts, carriers)
    chain = Chain(placed.rotation, placed.translation, ends, sliding, np.eye(n), None, tree)
    if not tree:
        tools = {tool: flange.inverse() @ pose for tool, pose in tools.items()}
        robot = robot_between(chain, tools, name, convention, tuple(joints))
    else:
        bare = Robot(name, convention, (DHRow(0, 0, 0, 0),) * n, tuple(joints), tools=tools, tree=tree)
        robot = robot_from_chain(chain, tools, bare)
    q = fixed_values(n)
    for tool, pose in tools.items():
        require_near(robot.world_from_base @ forward(robot, q, tool), carried_poses(chain, q, [tool] * len(q)) @ pose)
    return robot


def _parsed(content: bytes, where: str) -> ElementTree.Element:
    if b"<!ENTITY" in content:
        raise InputError("E-URDF-ENTITIES", f"{where}: defines entities of XML; write their values out")
    try:
        root = ElementTree.fromstring(content)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise InputError("E-URDF-INVALID", f"{where}: not XML ({error}); correct it") from error
    if root.tag != "robot":
        raise InputError("E-URDF-CONTENT", f"{where}: begins with <{root.tag}>, <robot> needed")
    if any("xacro" in str(element.tag) for element in root.iter()):
        raise InputError("E-URDF-XACRO", f"{where}: has macros of xacro; expand it first: xacro FILE > robot.urdf")
    return root


def _read_joint(element: ElementTree.Element, where: str) -> UrdfJoint:
    name, kind = element.get("name", ""), element.get("type", "")
    parts = {part.tag: part.attrib for part in element}

    def wrong(said: str, code: str = "E-URDF-CONTENT") -> InputError:
        return InputError(code, f"{where}: joint {name}: {said}")

    def numbers(text: str, count: int = 3) -> np.ndarray:
        try:
            values = np.array([float(word) for word in text.split()])
        except ValueError:
            values = np.zeros(0)
        if values.shape != (count,) or not np.isfinite(values).all() or np.abs(values).max() > UNLIMITED:
            raise wrong(f"{text!r}: finite numbers up to {UNLIMITED:g} needed")
        return values

    for tag, known in PLACED_BY.items():
        if (count := len(element.findall(tag))) > 1:
            raise wrong(f"{tag} {count} times; leave one in")
        if unknown := parts.get(tag, {}).keys() - known:
            raise wrong(f"{tag} has {min(unknown)}, which is not one of URDF's {', '.join(known)}; use one of these")
    parent, child = parts.get("parent", {}).get("link"), parts.get("child", {}).get("link")
    if not (name and parent and child):
        raise wrong("its name, parent or child is missing; all three needed")
    origin, along = parts.get("origin", {}), parts.get("axis", {})
    place, turn = numbers(origin.get("xyz", "0 0 0")), numbers(origin.get("rpy", "0 0 0"))
    axis = numbers(along.get("xyz", "1 0 0"))
    if (most := float(np.abs(turn).max())) > MOST_RAD:
        raise wrong(f"rpy of {most:g}, more than a turn: URDF is in radians; divide degrees by 57.3")
    length = float(np.linalg.norm(axis))
    if not length > 1e-9:
        raise wrong("its axis has no direction; correct it")
    limit, unit = None, METRE_MM if kind == "prismatic" else 1.0
    if "limit" in parts and kind != "continuous":
        low, high = numbers(" ".join(parts["limit"].get(end, "0") for end in ("lower", "upper")), 2).tolist()
        if low > high:
            raise wrong(f"lower limit {low:g} is above upper {high:g}; swap or correct them", "E-URDF-LIMITS")
        limit = (low * unit, high * unit) if low < high else None
    pose = Rigid(from_roll_pitch_yaw(turn), METRE_MM * place)
    return UrdfJoint(name, kind, parent, child, pose, axis / length, limit, parts.get("mimic", {}).get("joint", ""))


def _z_to(axis: np.ndarray) -> Rigid:
    """Returns a rotation that brings z to the axis: the identity for z, half a turn about x for −z."""
    x, y, z = axis
    across = float(np.hypot(x, y))
    if across == 0.0:
        return Rigid() if z > 0 else Rigid(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
    return Rigid.exp([*(np.arctan2(across, z) * np.array([-y, x, 0.0]) / across), 0.0, 0.0, 0.0])


def _tools(joints: dict[str, UrdfJoint], start: str, where: str) -> dict[str, str]:
    """Returns links by names of tools, behind the last joint that moves."""
    above: dict[str, int] = {}  # number of moving joints from the start to each link behind it
    for link in [start, *joints]:
        at, moving = link, 0
        while at != start and at in joints:
            at, moving = joints[at].parent, moving + joints[at].moves
        if at == start:
            above[link] = moving
    parents, most = {joint.parent for joint in joints.values()}, max(above.values())
    every = [link for link in above if link not in parents]
    if sum(joints[link].moves for link in above if link != start) == most:  # one chain
        every = [link for link in every if above[link] == most]
        if len(every) == 1:
            return {"": every[0]}
        if TOOL in every:
            return {"": TOOL} | {link.removeprefix(f"{TOOL}_"): link for link in every if link.startswith(f"{TOOL}_")}
        if TOOL0 in every:
            return {"": TOOL0}
    raise InputError("E-URDF-LINKS", f"{where}: several links may be the tool; give --to-link, one of {few(every)}")


def _path(joints: dict[str, UrdfJoint], start: str, end: str, where: str) -> list[UrdfJoint]:
    """Returns the joints between two links, some of which move."""
    path: list[UrdfJoint] = []
    at = end
    while at != start:
        if at not in joints:
            fault = f"{where}: no joints lead from link {start} to the tool"
            raise InputError("E-URDF-LINKS", f"{fault}; other --from-link, --to-link needed")
        path.insert(0, joints[at])
        at = path[0].parent
    if not any(joint.moves for joint in path):
        fault = f"{where}: no joint from {start} to {end} moves"
        raise InputError("E-URDF-LINKS", f"{fault}; other --from-link or --to-link needed")
    for joint in path:
        reason = f"mimics {joint.mimics}; joints of their own needed" if joint.mimics else ""
        if joint.kind not in MOVING:
            reason = f"is {joint.kind}; fixed, {', '.join(MOVING)} are read"
        if joint.moves and reason:
            raise InputError("E-URDF-JOINT", f"{where}: joint {joint.name} {reason}")
    return path


def robot_urdf(robot: Robot) -> str:
    """The text of a URDF: links ``world``, ``base_link``, ``link_1`` …, ``flange``, ``tool`` and ``tool_NAME``; without
    ``flange`` of a tree, the tools of which are fixed to the links that carry them.

    Joint values are the kinematic ones: where the controller couples joints, the coupling times its values, and limits
    are the widest that its limits allow. Returns XML of ``robot``, in metres and rad, in which every number reads back
    to the same double but for the last bit. Raises InputError: an elastic robot, or a name with control characters,
    which XML cannot hold.
    """
    for name in (robot.name, *robot.tools):
        if not name.isprintable():
            raise InputError("E-ROBOT-NAME", f"robot: name {name!r} has control characters; give a name in letters")
    if robot.elasticity is not None:
        fault = f"robot {robot.name}: a URDF cannot hold its elasticity; remove [elasticity] for the axes alone"
        other = "export compensated points (`stcal robot compensate --export`)"
        raise InputError("E-ROBOT-ELASTICITY", f"{fault}, or {other}")
    chain = replace(robot, world_from_base=Rigid()).chain()
    root = ElementTree.Element("robot", name=robot.name)
    root.append(ElementTree.Comment(" effort and velocity are not known: 0 "))
    low, high = robot.limits().T
    if coupled(robot):
        said = " joint values are kinematic: the coupling of the robot file times the controller's "
        root.append(ElementTree.Comment(said))
        ends = np.where(robot.coupling[..., None] == 0, 0.0, robot.coupling[..., None] * robot.limits()[None])
        low, high = ends.min(axis=2).sum(axis=1), ends.max(axis=2).sum(axis=1)

    def add(name: str, kind: str, parent: str, child: str, pose: Rigid) -> ElementTree.Element:
        ElementTree.SubElement(root, "link", name=child)
        element = ElementTree.SubElement(root, "joint", name=name, type=kind)
        ElementTree.SubElement(element, "parent", link=parent)
        ElementTree.SubElement(element, "child", link=child)
        place, turn = ([repr(float(v)) for v in part] for part in (pose.translation / METRE_MM, roll_pitch_yaw(pose)))
        ElementTree.SubElement(element, "origin", xyz=" ".join(place), rpy=" ".join(turn))
        return element

    def fix(parent: str, child: str, pose: Rigid) -> None:
        add(f"{parent}_to_{child}", "fixed", parent, child, pose)

    ElementTree.SubElement(root, "link", name=WORLD)
    fix(WORLD, BASE, robot.world_from_base)
    for i, joint in enumerate(robot.joints):
        unit = METRE_MM if joint.type == "prismatic" else 1.0
        limited = np.isfinite([low[i], high[i]]).any()
        kind = "continuous" if joint.type == "revolute" and not limited else joint.type
        above = f"link_{chain.after(i) + 1}" if chain.after(i) >= 0 else BASE
        element = add(f"joint_{i + 1}", kind, above, f"link_{i + 1}", chain.gap(i))
        ElementTree.SubElement(element, "axis", xyz="0 0 1")
        if kind != "continuous":
            ends = {"lower": max(low[i] / unit, -UNLIMITED), "upper": min(high[i] / unit, UNLIMITED)}
            shown = {end: repr(float(value)) for end, value in ends.items()}
            ElementTree.SubElement(element, "limit", shown | {"effort": "0", "velocity": "0"})
    if not robot.tree:
        fix(f"link_{len(chain)}", FLANGE, chain.ends[-1])
    for name, tool in robot.tools.items():
        carrier = chain.carrier(name)
        at = (f"link_{carrier + 1}", chain.ends[carrier] @ tool) if robot.tree else (FLANGE, tool)
        fix(at[0], link_of(name), at[1])
    ElementTree.indent(root)
    return f'<?xml version="1.0"?>\n{ElementTree.tostring(root, encoding="unicode")}\n'


def coupled(robot: Robot) -> bool:
    """True if the controller's joint values differ from the kinematic ones."""
    return bool((robot.coupling != np.eye(len(robot.rows))).any())


def require_urdf_written(path: str | Path, robot: Robot) -> None:
    """Read a written URDF again, and require that it leads every tool where the robot does; raises ConvergenceError."""
    q, several = fixed_values(len(robot.rows)), len(robot.tools) > 1

    def tips(pose: Callable[[str], Poses]) -> np.ndarray:
        return np.array([pose_values(pose(name)) for name in robot.tools])

    def again() -> np.ndarray:
        read = load_urdf(path, WORLD, [link_of(name) for name in robot.tools], robot.convention)
        order = [int(name.removeprefix("joint_")) - 1 for name in read.joints]
        kinematic, base = (q @ robot.coupling.T)[:, order], read.robot.world_from_base
        return tips(lambda name: base @ forward(read.robot, kinematic, link_of(name) if several else ""))

    wanted = tips(lambda name: robot.world_from_base @ forward(robot, q, name))
    far = max(SAME_MM, 1e-12 * float(np.abs(wanted).max()))
    require_written(path, again, wanted, far, "mm")


LINKS = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
JOINTS, NAME = 6, "ur"
LEAST_OFF_MM = 1e-3  # a micrometre: what angles of few digits round off
DELTAS = {"theta": 1.0, "a": METRE_MM, "d": METRE_MM, "alpha": 1.0}
"""Dimensions that a controller corrects, with the factors of their units."""
_DELTA = re.compile(r"^\s*delta_(theta|a|d|alpha)\s*=", re.MULTILINE)  # a key of a calibration.conf
_LIST = re.compile(r"^\s*(?P<key>\w+)\s*=\s*\[(?P<values>[^\]]*)\]", re.MULTILINE)
Number = Annotated[float, Field(ge=-1e3, le=1e3, allow_inf_nan=False)]


class _Link(Strict):
    x: Number
    y: Number
    z: Number
    roll: Number
    pitch: Number
    yaw: Number


class _UrFile(Strict):
    kinematics: dict[str, _Link]


def _of_kinematics(content: dict, where: str, convention: Convention) -> UrdfRobot:
    """Returns the arm of ur_calibration's YAML. Its roll, pitch and yaw are about moving axes X, Y, Z; URDF takes fixed
    ones. The base is the controller's; ROS's base_link is rotated by half a turn about Z."""
    held = content["kinematics"]
    if isinstance(held, dict):  # the hash of the robot stands among the links
        if missing := [name for name in LINKS if name not in held]:
            fault = f"{where}: kinematics without {', '.join(missing)}; an arm of Universal Robots has six links"
            raise InputError("E-KEY-MISSING", f"{fault}: extract its calibration anew with ur_calibration")
        content = {**content, "kinematics": {name: held[name] for name in LINKS}}
    joints, flange, as_urdf, z = [], Rigid(), Rigid(), np.array([0.0, 0.0, 1.0])
    links = validated(content, _UrFile, where).kinematics
    for parent, (name, link) in zip(("base", *LINKS), links.items(), strict=False):
        place, angles = METRE_MM * np.array([link.x, link.y, link.z]), [link.roll, link.pitch, link.yaw]
        pose = Rigid(Rotation.from_euler("XYZ", angles), place)
        flange, as_urdf = flange @ pose, as_urdf @ Rigid(from_roll_pitch_yaw(angles), place)
        joints.append(UrdfJoint(name, "continuous", parent, name, pose, z, None, ""))
    off_mm = float(np.linalg.norm(flange.translation - as_urdf.translation))
    said = (
        "angles are read about turned axes, as ur_calibration computes them and the controller moves; a URDF with the "
        f"same numbers takes them about fixed ones, and its flange is {off_mm:.2g} mm off at joint values of 0"
    )
    notes = (said,) if off_mm >= LEAST_OFF_MM else ()
    return UrdfRobot(robot_of({"": joints}, NAME, convention), LINKS, BASE, LINKS[-1], notes)


def _of_conf(text: str, where: str, nominal: Robot | None, convention: Convention) -> UrdfRobot:
    """Returns the arm of a calibration.conf: its [DH] or ``nominal``, and deviations, by Hayati's angle."""
    lists = {match["key"]: match["values"] for match in _LIST.finditer(text)}

    def six(key: str) -> np.ndarray:
        try:
            values = np.array([float(value) for value in lists.get(key, "").split(",")])
        except ValueError:
            values = np.zeros(0)
        if values.shape != (JOINTS,) or not np.isfinite(values).all():
            fault = f"{where}: {key}: a list of six numbers needed"
            raise InputError("E-ROBOT-ENTRIES", f"{fault}; give the controller's file")
        return values

    deltas = {name: unit * six(f"delta_{name}") for name, unit in DELTAS.items()}
    joints = (Joint(),) * JOINTS if nominal is None else nominal.joints
    if all(name in lists for name in ("a", "d", "alpha")):
        table = np.column_stack([METRE_MM * six("a"), six("alpha"), METRE_MM * six("d"), np.zeros(JOINTS)])
        arm = Robot(NAME, "standard", tuple(DHRow(*row) for row in table.tolist()), joints, unusual_size=True)
    elif nominal is None or len(joints) != JOINTS or nominal.convention != "standard" or nominal.prismatic.any():
        given = "none is given" if nominal is None else f"that given has {len(joints)} joints, {nominal.convention}"
        needed = "give --nominal robot.toml with its six joints that turn, standard, or add [DH] with a, d and alpha"
        fault = f"{where}: deviations from a nominal arm, which it does not state, and {given}"
        raise InputError("E-ROBOT-NOMINAL", f"{fault}; {needed} of urcontrol.conf")
    else:
        arm = nominal
    corrected = tuple(
        replace(row, **{name: getattr(row, name) + float(delta[i]) for name, delta in deltas.items()})
        for i, row in enumerate(arm.rows)
    )
    controller = Robot(arm.name, "standard", corrected, joints, tools=arm.tools)
    found = robot_between(controller.chain(), arm.tools, arm.name, convention, joints)
    q = fixed_values(JOINTS)
    for tool in arm.tools:
        require_near(found.world_from_base @ forward(found, q, tool), forward(controller, q, tool))
    placed = replace(found, world_from_base=arm.world_from_base @ found.world_from_base)
    return UrdfRobot(placed, LINKS, BASE, LINKS[-1], ())


@require_arguments
def load_universal(
    path: str | Path, nominal: Robot | str | Path | None = None, convention: Convention = "standard"
) -> UrdfRobot:
    """Returns the calibrated arm of Universal Robots of a file of ur_calibration (YAML), or of calibration.conf.

    ``path`` : the file; ``nominal`` : the arm to whose rows the deviations of a calibration.conf are added, if that
    does not state it; ``convention`` : of the rows of Denavit and Hartenberg. Returns ``robot``, mm and rad, from the
    controller's base. Raises InputError: another file, a value that is missing or no number, or ``nominal`` does not
    fit or is not needed.
    """
    where = f"robot {path}"
    try:
        text = text_of(read_bytes(path, SETTINGS_BYTES))
    except OSError as error:
        raise InputError("E-FILE-UNREADABLE", f"{where}: {error.strerror or error}; check the path") from error
    except UnicodeDecodeError:
        text = ""
    if _DELTA.search(text):
        drawn = nominal if nominal is None or isinstance(nominal, Robot) else load_robot(nominal)
        return _of_conf(text, str(path), drawn, convention)
    try:
        content = load_yaml(text) if "kinematics" in text else None
    except (yaml.YAMLError, ValueError, RecursionError):
        content = None
    if not isinstance(content, dict) or "kinematics" not in content:
        needed = "ur_calibration's YAML or its calibration.conf needed; robot files end in .toml, URDF in .urdf or .xml"
        raise InputError("E-ROBOT-FORM", f"{where}: no calibration of Universal Robots; {needed}")
    if nominal is not None:
        raise InputError("E-OPTION-NEEDS", "--nominal: only of a calibration.conf; leave it out")
    return _of_kinematics(content, str(path), convention)
