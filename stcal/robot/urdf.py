"""Reads a robot from URDF, and writes it; the written file is verified to give the same poses."""

import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from pathlib import Path

import numpy as np

from stcal.errors import InputError, StcalError
from stcal.geometry.arrays import Brief, require_arguments
from stcal.geometry.rigid import Poses, Rigid
from stcal.io.files import SETTINGS_BYTES, read_bytes, require_written
from stcal.io.rotations import MOST_RAD
from stcal.io.static_transforms import METRE_MM, from_roll_pitch_yaw, roll_pitch_yaw
from stcal.io.table import pose_values
from stcal.lengths import MOST_LINK_MM
from stcal.robot.kinematics.dh import robot_between, robot_from_chain
from stcal.robot.kinematics.forward import carried_poses, fixed_values, flange_poses, forward
from stcal.robot.kinematics.robot_model import Chain, Convention, DHRow, Joint, JointType, Robot, Tree

WHAT = "URDF"
WORLD, BASE, FLANGE, TOOL, TOOL0 = "world", "base_link", "flange", "tool", "tool0"
"""Names of links; other tools are ``tool_NAME``."""
UNLIMITED = 1e6
"""Value in rad or m beyond which a limit counts as unlimited; URDF cannot state only one of two limits."""
PLACED_BY = {"origin": ("xyz", "rpy"), "axis": ("xyz",)}
"""Elements of a joint that place it, and their attributes."""
MOVING: dict[str, JointType] = {"revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic"}


SAME_MM, SAME_RAD = 1e-9, 1e-12
"""Largest difference between the poses of the Denavit–Hartenberg rows and those of the URDF's joints."""


def link_of(tool: str) -> str:
    """Returns the name of a tool's link."""
    return f"{TOOL}_{tool}" if tool else TOOL


def few(names: Sequence[str], most: int = 12) -> str:
    """Returns the first names of many, and how many more there are."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class UrdfRobot(Brief):
    """A robot of a URDF, mm, rad; its joint values are those of the URDF's joints.

    ``joints`` : names of the moving joints; ``from_link``, ``to_link`` : links between which the robot was read;
    ``notes`` : missing limits of joints.
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


@require_arguments
def load_urdf(
    path: str | Path, from_link: str = "", to_link: str | Sequence[str] = "", convention: Convention = "standard"
) -> UrdfRobot:
    """Read the chain of joints between two links of a URDF, or the tree of those to several links.

    Parameters
    ----------
    path : URDF; a xacro file must be expanded before.
    from_link : the base; the root if not given. Where the root is called ``world`` and holds a link by a fixed joint,
        this link is the base, and the joint where it stands.
    to_link : the tool; if not given the only link without children behind the last joint, ``tool0``, or ``tool`` and
        ``tool_NAME`` as :func:`robot_urdf` writes them. Several are tools called like the links, on branches of a tree.
    convention : of the Denavit–Hartenberg rows.

    Returns
    -------
    UrdfRobot : its robot's flange is the link ``flange`` where a row can end there, else the frame of the last joint.

    Raises
    ------
    InputError : unreadable, no URDF, no such links or none between them that moves, joints that move otherwise or mimic
        others, several links that may be the tool.
    """
    where = f"{WHAT} {path}"
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
    _require_no_circle(joints, where)
    given = [to_link] if isinstance(to_link, str) else list(to_link)
    for option, name in (("--from-link", from_link), *(("--to-link", name) for name in given)):
        if name and name not in links:
            raise InputError("E-URDF-LINKS", f"{where}: {option} {name}: no such link; there are {few(links)}")
    farthest = max(joints.values(), key=_far, default=None)
    if farthest is not None and _far(farthest) > MOST_LINK_MM:
        raise InputError(
            "E-LENGTH-UNIT",
            f"{where}: joint {farthest.name}: origin {_far(farthest) / METRE_MM:g} m from its parent, up to "
            f"{MOST_LINK_MM / METRE_MM:g} possible: URDF is in metres; divide lengths in mm by 1000",
        )
    roots = [link for link in links if link not in joints]
    if not from_link and len(roots) != 1:
        raise InputError(
            "E-URDF-LINKS", f"{where}: {len(roots)} links are no joint's child; one root needed, or --from-link"
        )
    start = from_link or roots[0]
    ends = {name if given[1:] else "": name for name in given} if any(given) else _tools(joints, start, where)
    paths = {name: _path(joints, start, end, where) for name, end in ends.items()}
    for name, way in paths.items():
        _require_chain(way, start, ends[name], where)
    first, world = next(iter(paths.values())), Rigid()
    shared = all(way[0].name == first[0].name for way in paths.values())
    if not from_link and start == WORLD and first[0].kind == "fixed" and shared:
        world, start = first[0].parent_from_child, first[0].child
        paths = {name: way[1:] for name, way in paths.items()}
    name = root.get("name") or "robot"
    robot = robot_of(paths, name, convention) if "" in paths else _tree_of(paths, name, convention)
    moving = list({joint.name: joint for way in paths.values() for joint in way if joint.kind != "fixed"}.values())
    notes = tuple(f"joint {j.name} has no limits" for j in moving if j.limit is None and j.kind != "continuous")
    robot = replace(robot, world_from_base=world @ robot.world_from_base)
    return UrdfRobot(robot, tuple(j.name for j in moving), start, ", ".join(ends.values()), notes)


def require_near(found: Poses, wanted: Poses) -> None:
    off = np.abs(found.difference(wanted)).max(axis=0)
    far = max(SAME_MM, 1e-12 * float(np.abs(wanted.translation).max()))
    if off[3:].max() > far or off[:3].max() > SAME_RAD:
        raise StcalError(
            "E-ROBOT-READ-BACK",
            f"{WHAT}: the rows lead elsewhere, by {off[3:].max():.2g} mm and {off[:3].max():.2g} rad; {far:.2g} mm and "
            f"{SAME_RAD:g} rad allowed",
        )


def _require_chain(path: list[UrdfJoint], start: str, end: str, where: str) -> None:
    moving = [joint for joint in path if joint.kind != "fixed"]
    if not moving:
        raise InputError(
            "E-URDF-LINKS", f"{where}: no joint from {start} to {end} moves; other --from-link or --to-link needed"
        )
    for joint in moving:
        known = f"is {joint.kind}; fixed, {', '.join(MOVING)} are read" if joint.kind not in MOVING else ""
        if reason := known or (f"mimics {joint.mimics}; joints of their own needed" if joint.mimics else ""):
            raise InputError("E-URDF-JOINT", f"{where}: joint {joint.name} {reason}")


def robot_of(paths: dict[str, list[UrdfJoint]], name: str, convention: Convention) -> Robot:
    """Returns the robot of the paths from one link to each tool, ``""`` among them, that part after the last joint."""
    moving = [joint for joint in paths[""] if joint.kind != "fixed"]
    gaps, passed = [], Rigid()
    for joint in paths[""]:
        passed = passed @ joint.parent_from_child
        if joint.kind != "fixed":
            turn = _z_to(joint.axis)
            gaps.append(passed @ turn)
            passed = turn.inverse()
    back = _z_to(moving[-1].axis).inverse()
    behind = {tool: path[[j.name for j in path].index(moving[-1].name) + 1 :] for tool, path in paths.items()}
    children = [joint.child for joint in behind[""]]
    flange = back @ product(behind[""][: children.index(FLANGE) + 1]) if FLANGE in children else Rigid()
    tools = {tool: flange.inverse() @ back @ product(path) for tool, path in behind.items()}
    joints = tuple(_limited(joint) for joint in moving)
    sliding = np.array([joint.type == "prismatic" for joint in joints])
    placed = Poses.of(gaps)
    chain = Chain(placed.rotation, placed.translation, flange, sliding, np.eye(len(gaps)))
    robot, q = robot_between(chain, tools, name, convention, joints), fixed_values(len(gaps))
    found = robot.chain()
    for each, tool in tools.items():
        ends = found.last_from_flange @ robot.tools[each], flange @ tool
        own, wanted = (replace(c, last_from_flange=e) for c, e in zip((found, chain), ends, strict=True))
        require_near(flange_poses(own, q), flange_poses(wanted, q))
    return robot


def _tree_of(paths: dict[str, list[UrdfJoint]], name: str, convention: Convention) -> Robot:
    """Returns the robot of the paths from one link to tools on several branches."""
    place: dict[str, int] = {}
    moving, gaps, mounts, carriers, tools = [], [], {}, {}, {}
    for tool, path in paths.items():
        last, passed = -1, Rigid()
        for joint in path:
            passed = passed @ joint.parent_from_child
            if joint.kind == "fixed":
                continue
            turn = _z_to(joint.axis)
            if joint.name not in place:
                place[joint.name] = i = len(moving)
                moving.append(joint)
                gaps.append(passed @ turn)
                if last != i - 1:
                    mounts[i] = last, Rigid()
            last, passed = place[joint.name], turn.inverse()
        carriers[tool], tools[tool] = last, passed
    joints, n = tuple(_limited(joint) for joint in moving), len(moving)
    bare = Robot(name, convention, (DHRow(0, 0, 0, 0),) * n, joints, tools=tools, tree=Tree(mounts, carriers))
    placed = Poses.of(gaps)
    branches = bare.tree, (Rigid(),) * n
    chain = Chain(placed.rotation, placed.translation, Rigid(), bare.prismatic, np.eye(n), None, *branches)
    robot, q = robot_from_chain(chain, tools, bare), fixed_values(n)
    for tool, pose in tools.items():
        require_near(robot.world_from_base @ forward(robot, q, tool), carried_poses(chain, q, [tool] * len(q)) @ pose)
    return robot


def product(path: list[UrdfJoint]) -> Rigid:
    """Returns the product of the transforms of successive joints, all at 0."""
    return reduce(Rigid.__matmul__, (joint.parent_from_child for joint in path), Rigid())


def _limited(joint: UrdfJoint) -> Joint:
    kind = MOVING[joint.kind]
    most = UNLIMITED * (METRE_MM if kind == "prismatic" else 1.0)
    low, high = joint.limit or (-np.inf, np.inf)
    return Joint(kind, low if low > -most else -np.inf, high if high < most else np.inf)


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
    where = f"{where}: joint {name}"
    parts = {part.tag: part.attrib for part in element}
    for tag, known in PLACED_BY.items():
        if (count := len(element.findall(tag))) > 1:
            raise InputError("E-URDF-CONTENT", f"{where}: {tag} {count} times; leave one in")
        if unknown := parts.get(tag, {}).keys() - known:
            raise InputError(
                "E-URDF-CONTENT",
                f"{where}: {tag} has {min(unknown)}, which is not one of URDF's {', '.join(known)}; use one of these",
            )
    parent, child = parts.get("parent", {}).get("link"), parts.get("child", {}).get("link")
    if not (name and parent and child):
        raise InputError("E-URDF-CONTENT", f"{where}: its name, parent or child is missing; all three needed")
    origin = parts.get("origin", {})
    place, turn = _three(origin.get("xyz", "0 0 0"), where), _three(origin.get("rpy", "0 0 0"), where)
    if (most := float(np.abs(turn).max())) > MOST_RAD:
        raise InputError(
            "E-URDF-CONTENT", f"{where}: rpy of {most:g}, more than a turn: URDF is in radians; divide degrees by 57.3"
        )
    axis = _three(parts.get("axis", {}).get("xyz", "1 0 0"), where)
    length = float(np.linalg.norm(axis))
    if not length > 1e-9:
        raise InputError("E-URDF-CONTENT", f"{where}: its axis has no direction; correct it")
    limit, unit = None, METRE_MM if kind == "prismatic" else 1.0
    if "limit" in parts and kind != "continuous":
        ends = _three(" ".join([*(parts["limit"].get(end, "0") for end in ("lower", "upper")), "0"]), where)[:2]
        if ends[0] > ends[1]:
            raise InputError(
                "E-URDF-LIMITS", f"{where}: lower limit {ends[0]:g} is above upper {ends[1]:g}; swap or correct them"
            )
        if ends[0] < ends[1]:
            limit = (float(ends[0] * unit), float(ends[1] * unit))
    mimics = parts.get("mimic", {}).get("joint", "")
    pose = Rigid(from_roll_pitch_yaw(turn), METRE_MM * place)
    return UrdfJoint(name, kind, parent, child, pose, axis / length, limit, mimics)


def _three(text: str, where: str) -> np.ndarray:
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError:
        values = np.zeros(0)
    if values.shape != (3,) or not np.isfinite(values).all() or np.abs(values).max() > UNLIMITED:
        raise InputError("E-URDF-CONTENT", f"{where}: {text!r}: finite numbers up to {UNLIMITED:g} needed")
    return values


def _z_to(axis: np.ndarray) -> Rigid:
    """Returns a rotation that brings z to the axis: the identity for z, half a turn about x for −z."""
    x, y, z = axis
    across = float(np.hypot(x, y))
    if across == 0.0:
        return Rigid() if z > 0 else Rigid(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
    return Rigid.exp([*(np.arctan2(across, z) * np.array([-y, x, 0.0]) / across), 0.0, 0.0, 0.0])


def _require_no_circle(joints: dict[str, UrdfJoint], where: str) -> None:
    """Refuses a link that is below itself."""
    sound: set[str] = set()
    for link in joints:
        passed, at = [], link
        while at in joints and at not in sound:
            if at in passed:
                raise InputError("E-URDF-LINKS", f"{where}: link {at} is below itself; a tree needed")
            passed.append(at)
            at = joints[at].parent
        sound.update(passed)


def _tools(joints: dict[str, UrdfJoint], start: str, where: str) -> dict[str, str]:
    """Links by names of tools, behind the last joint that moves."""
    below: dict[str, list[UrdfJoint]] = {}
    for joint in joints.values():
        below.setdefault(joint.parent, []).append(joint)
    behind, pending, branches = [start], [start], []
    while pending:
        link = pending.pop()
        fixed = [joint.child for joint in below.get(link, ()) if joint.kind == "fixed"]
        branches += [joint for joint in below.get(link, ()) if joint.kind != "fixed"]
        behind, pending = behind + fixed, pending + fixed
        if not pending and len(branches) == 1:
            last = branches.pop().child
            behind, pending = [last], [last]
    ends = [link for link in behind if link not in below]
    if len(ends) == 1 and not branches:
        return {"": ends[0]}
    if not branches and TOOL in ends:
        named = {link.removeprefix(f"{TOOL}_"): link for link in ends if link.startswith(f"{TOOL}_")}
        return {"": TOOL, **named}
    if not branches and TOOL0 in ends:
        return {"": TOOL0}
    every = [link for link in joints if link not in below] if branches else ends
    raise InputError("E-URDF-LINKS", f"{where}: several links may be the tool; give --to-link, one of {few(every)}")


def _path(joints: dict[str, UrdfJoint], start: str, end: str, where: str) -> list[UrdfJoint]:
    path: list[UrdfJoint] = []
    while end != start:
        if end not in joints or len(path) > len(joints):
            raise InputError(
                "E-URDF-LINKS",
                f"{where}: no joints lead from link {start} to the tool; other --from-link, --to-link needed",
            )
        path.insert(0, joints[end])
        end = path[0].parent
    return path


def _far(joint: UrdfJoint) -> float:
    return float(np.linalg.norm(joint.parent_from_child.translation))


def robot_urdf(robot: Robot) -> str:
    """The text of a URDF: links ``world``, ``base_link``, ``link_1`` …, ``flange``, ``tool`` and ``tool_NAME``; without
    ``flange`` of a tree, the tools of which are fixed to the links that carry them.

    Joint values are the kinematic ones: where the controller couples joints, the coupling times its values, and limits
    are the widest that its limits allow.

    Parameters
    ----------
    robot : what to write.

    Returns
    -------
    str : XML, in metres and rad; every number reads back to the same double but for the last bit.

    Raises
    ------
    InputError : an elastic robot, or a name with control characters, which XML cannot hold.
    """
    for name in (robot.name, *robot.tools):
        if not name.isprintable():
            raise InputError("E-ROBOT-NAME", f"robot: name {name!r} has control characters; give a name in letters")
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
        element = _joint(root, f"joint_{i + 1}", kind, above, f"link_{i + 1}", chain.gap(i))
        ElementTree.SubElement(element, "axis", xyz="0 0 1")
        if kind != "continuous":
            ends = {"lower": max(low[i] / unit, -UNLIMITED), "upper": min(high[i] / unit, UNLIMITED)}
            shown = {end: repr(float(value)) for end, value in ends.items()}
            ElementTree.SubElement(element, "limit", shown | {"effort": "0", "velocity": "0"})
    if chain.tree is None:
        _fixed(root, f"link_{len(chain)}", FLANGE, chain.last_from_flange)
    for name, tool in robot.tools.items():
        carrier = chain.carrier(name)
        at = (FLANGE, tool) if chain.tree is None else (f"link_{carrier + 1}", chain.end(carrier) @ tool)
        _fixed(root, at[0], link_of(name), at[1])
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
    """Read a written URDF again, and require that it leads every tool where the robot does; raises ConvergenceError."""
    q = fixed_values(len(robot.rows))

    def again() -> np.ndarray:
        if robot.tree is None:
            found = load_urdf(path, convention=robot.convention).robot
            chain, kinematic = found.chain(), q @ robot.coupling.T
            return tips(lambda name: flange_poses(chain, kinematic) @ found.tool(name))
        read = load_urdf(path, BASE, [link_of(name) for name in robot.tools], robot.convention)
        names = [f"joint_{i + 1}" for i in range(len(robot.rows))]
        kinematic = (q @ robot.coupling.T)[:, [names.index(name) for name in read.joints]]
        return tips(lambda name: read.robot.world_from_base @ forward(read.robot, kinematic, link_of(name)))

    def tips(pose: Callable[[str], Poses]) -> np.ndarray:
        return np.array([pose_values(pose(name)) for name in robot.tools])

    base = robot.world_from_base if robot.tree is None else Rigid()  # a tree is read from its base
    wanted = tips(lambda name: base @ forward(robot, q, name))
    far = max(SAME_MM, 1e-12 * float(np.abs(wanted).max()))
    require_written(path, again, wanted, far, "mm")
