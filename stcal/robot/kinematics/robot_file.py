"""Reading and writing of ``robot.toml``; every mistake is named, and a written file reads back as the same robot."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import BeforeValidator, Field

from stcal.errors import InputError
from stcal.geometry.arrays import require_arguments
from stcal.geometry.rigid import Poses, Rigid
from stcal.io.files import require_written, save
from stcal.io.table import LEVER_MM, POSE, pose_values
from stcal.io.toml import Finite, PoseEntry, Sized, Strict, load_toml, toml_string
from stcal.lengths import require_millimetres, stated_unusual
from stcal.robot.kinematics.forward import carried_poses, fixed_values, joint_frames
from stcal.robot.kinematics.robot_model import (
    MOST_KG,
    Chain,
    Convention,
    DHRow,
    Elasticity,
    Joint,
    JointType,
    Robot,
    Tree,
    longest_link,
)

WHAT = "robot file"
REMEDY = "`stcal robot init FILE` writes one to edit"
OTHERS = (".urdf", ".xml", ".yaml", ".yml", ".conf")  # endings of files of robots that are converted first
MOST_JOINTS = 60  # largest number of joints, that of a humanoid with hands
WRITTEN_MM = 1e-5
"""Largest difference, mm, between a written robot file and what was reported: far above that of decimals."""
_FORM = {
    "standard": "Rz(theta + q) Tz(d) Tx(a) Rx(alpha) Ry(beta)",
    "modified": "Rx(alpha) Tx(a) Ry(beta) Rz(theta + q) Tz(d)",
}
_KEYS = {"a": "a_mm", "alpha": "alpha_deg", "d": "d_mm", "theta": "theta_deg", "beta": "beta_deg"}


class _CarriedFile(PoseEntry):
    joint: int | None = None


class _ToolFile(_CarriedFile):
    name: str = Field(min_length=1)


class _JointFile(Strict):
    type: JointType = "revolute"
    a_mm: Finite = 0.0
    alpha_deg: Finite = 0.0
    d_mm: Finite = 0.0
    theta_deg: Finite = 0.0
    beta_deg: Finite = 0.0
    min_deg: Finite | None = None
    max_deg: Finite | None = None
    min_mm: Finite | None = None
    max_mm: Finite | None = None
    fixed: dict[Literal["a_mm", "alpha_deg", "d_mm", "theta_deg", "beta_deg"], str] = Field(default_factory=dict)
    after: int | None = None
    mount: PoseEntry | None = None


class _ElasticityFile(Strict):
    gravity: tuple[Finite, Finite, Finite] = (0.0, 0.0, -1.0)
    axis_rad_per_Nm: list[Finite] | None = None
    across_rad_per_Nm: list[Finite] | None = None
    moment_Nm: list[tuple[Finite, Finite, Finite]] | None = None
    periodic_rad: list[tuple[Finite, Finite, Finite, Finite]] | None = None
    hysteresis_rad: list[Finite] | None = None
    pivot_mm: list[tuple[Finite, Finite, Finite]] | None = None
    payload_kg: Finite = 0.0
    payload_centre_mm: tuple[Finite, Finite, Finite] = (0.0, 0.0, 0.0)

    def elasticity(self, count: int, where: str) -> Elasticity:
        """Returns the elasticity of ``count`` joints."""
        for key, values in self:
            if isinstance(values, list) and len(values) != count:
                fault = f"{where}: {key} has {len(values)} entries"
                raise InputError("E-ROBOT-ENTRIES", f"{fault}, {count} needed, one for each joint")
        if not 0 <= self.payload_kg <= MOST_KG:
            raise InputError("E-PAYLOAD-VALUE", f"{where}: payload_kg is {self.payload_kg:g}; 0 … {MOST_KG:g} needed")

        def given(values: list | None, *width: int) -> np.ndarray:
            return np.zeros((count, *width)) if values is None else np.array(values)

        compliance = np.column_stack([given(self.axis_rad_per_Nm), given(self.across_rad_per_Nm)])
        moment, periodic = given(self.moment_Nm, 3), given(self.periodic_rad, 4)
        load = self.payload_kg, np.array(self.payload_centre_mm)
        more = given(self.hysteresis_rad), given(self.pivot_mm, 3)
        return Elasticity(compliance, moment, periodic, np.array(self.gravity), *load, *more)


class _RobotFile(Sized):
    name: str = "robot"
    convention: Convention
    joint: list[_JointFile] = Field(min_length=1, max_length=MOST_JOINTS)
    coupling: list[list[Finite]] | None = None
    base: PoseEntry = PoseEntry()
    tool: _CarriedFile = _CarriedFile()
    target: tuple[_ToolFile, ...] = ()
    elasticity: _ElasticityFile | None = None


@require_arguments
def load_robot(path: str | Path) -> Robot:
    """Reads a robot file from ``path``: lengths in mm and angles in degrees (form: ``data_layout.md``).

    Raises InputError: unreadable, unknown or missing keys, limits that are swapped or of the wrong unit, a coupling
    matrix that does not fit, quaternions that are not unit; the message names the file and the place.
    """
    where = f"{WHAT} {path}"
    if Path(path).suffix.lower() in OTHERS and Path(path).is_file():
        remedy = f"`stcal robot convert {Path(path).name} robot.toml` makes it of URDF"
        others = "of the calibration of an arm of Universal Robots"
        raise InputError("E-ROBOT-FORM", f"{where}: TOML needed; {remedy}, and {others}")
    data = load_toml(path, _RobotFile, WHAT, REMEDY)
    rows, joints, n = [], [], len(data.joint)
    for i, j in enumerate(data.joint, 1):
        alpha, theta, beta = np.radians([j.alpha_deg, j.theta_deg, j.beta_deg]).tolist()
        rows.append(DHRow(j.a_mm, alpha, j.d_mm, theta, beta))
        joints.append(_joint(j, f"{where}: joint {i}"))
    require_millimetres(longest_link(rows), data.unusual_size, where)
    if data.coupling is not None and {n, *map(len, data.coupling)} != {len(data.coupling)}:
        raise InputError("E-ROBOT-COUPLING", f"{where}: coupling: {n} rows of {n} numbers needed for {n} joints")
    tools = {"": data.tool.rigid(f"{where}: tool")}
    for t in data.target:
        if t.name in tools:
            raise InputError("E-ROBOT-TARGET", f"{where}: target {t.name} occurs twice; names must differ")
        tools[t.name] = t.rigid(f"{where}: target {t.name}")
    base = data.base.rigid(f"{where}: base")
    elasticity = None if data.elasticity is None else data.elasticity.elasticity(n, f"{where}: elasticity")
    arm = tuple(rows), tuple(joints), np.eye(n) if data.coupling is None else np.array(data.coupling)
    return Robot(data.name, data.convention, *arm, base, tools, elasticity, _tree(data, where), data.unusual_size)


def _tree(data: _RobotFile, where: str) -> Tree:
    """Returns the tree that keys ``after``, ``mount`` and ``joint`` describe."""
    mounts, carriers, n = {}, {}, len(data.joint)

    def refuse(wrong: bool, said: str) -> None:
        if wrong:
            raise InputError("E-ROBOT-BRANCH", f"{where}: {said}")

    for i, joint in enumerate(data.joint):
        place, alone = f"joint {i + 1}", joint.after is None and joint.mount is not None
        refuse(alone, f"{place}: mount without after; the number of the joint that carries it needed")
        if joint.after is not None:
            refuse(not 0 <= joint.after <= i, f"{place}: after is {joint.after}, 0 (the base) … {i} needed")
            mounts[i] = joint.after - 1, (joint.mount or PoseEntry()).rigid(f"{where}: {place}: mount")
    first = "the first joint has no after, which is for joints that begin another branch; leave it out, and give base"
    refuse(0 in mounts, f"joint 1: {first}")
    for name, each in [("", data.tool), *((t.name, t) for t in data.target)]:
        if each.joint is not None:
            what = f"target {name}" if name else "tool"
            refuse(not 1 <= each.joint <= n, f"{what}: joint is {each.joint}, 1 … {n} needed")
            carriers[name] = each.joint - 1
    return Tree(mounts, carriers)


def _joint(j: _JointFile, where: str) -> Joint:
    mine, other = ("deg", "mm") if j.type == "revolute" else ("mm", "deg")
    limits = []
    for end, unlimited in {"min": -np.inf, "max": np.inf}.items():
        if getattr(j, f"{end}_{other}") is not None:
            raise InputError("E-ROBOT-LIMITS", f"{where}: {end}_{other} at a {j.type} joint; {end}_{mine} needed")
        value = getattr(j, f"{end}_{mine}")
        limits.append(unlimited if value is None else value)
    lower, upper = limits
    if lower >= upper:
        fault = f"{where}: min_{mine} {lower:g} is not below max_{mine} {upper:g}"
        raise InputError("E-ROBOT-LIMITS", f"{fault}; swap or correct them")
    unit = np.pi / 180 if mine == "deg" else 1.0
    fixed = {key.partition("_")[0]: reason for key, reason in j.fixed.items()}
    return Joint(j.type, float(lower * unit), float(upper * unit), fixed)


def robot_toml(robot: Robot, comments: Sequence[str] = ()) -> str:
    """Returns the text of the file of ``robot``, with ``comments`` at the top (form: ``data_layout.md``).

    Every number reads back as the same double, but for the last bit of angles.
    """
    lines = [
        *(f"# {comment}" for comment in comments),
        f"name = {toml_string(robot.name)}",
        f'convention = "{robot.convention}"  # {_FORM[robot.convention]}; angles in degrees, lengths in mm',
        *stated_unusual(longest_link(robot.rows)),
    ]

    def add(key: str, value: ArrayLike, note: str = "") -> None:
        """Adds a number, or an array of them, that reads back the same."""
        lines.append(f"{key} = {np.asarray(value, float).tolist()!r}{note and f'  # {note}'}")

    def pose(a_from_b: Rigid) -> list[str]:
        values = [*a_from_b.translation.tolist(), *Poses.of([a_from_b]).quaternions()[0].tolist()]
        return [f"{key} = {value!r}" for key, value in zip(POSE, values, strict=True)]

    if (robot.coupling != np.eye(len(robot.rows))).any():
        lines.append("# kinematic joint values from the controller's")
        add("coupling", robot.coupling)
    tree = robot.tree
    for i, (row, joint) in enumerate(zip(robot.rows, robot.joints, strict=True)):
        lines += ["", "[[joint]]", f'type = "{joint.type}"']
        for name, key in _KEYS.items():
            value = getattr(row, name)
            if value or name != "beta":
                add(key, np.degrees(value) if key.endswith("deg") else value)
        unit, of_unit = ("deg", np.degrees) if joint.type == "revolute" else ("mm", float)
        for end, value in (("min", joint.lower), ("max", joint.upper)):
            if np.isfinite(value):
                add(f"{end}_{unit}", round(of_unit(value), 9))
        if joint.fixed:
            reasons = (f"{_KEYS[name]} = {toml_string(reason)}" for name, reason in joint.fixed.items())
            lines.append(f"fixed = {{ {', '.join(reasons)} }}")
        if i in tree.mounts:
            after, mount = tree.mounts[i]
            lines += [f"after = {after + 1}", f"mount = {{ {', '.join(pose(mount))} }}"]
    lines += ["", "[base]  # of the robot, in the frame of the instrument", *pose(robot.world_from_base)]
    lines += ["", "[tool]  # in the frame of the flange"]
    for name, tool in {"": robot.tools.get("", Rigid()), **robot.tools}.items():
        lines += ["", "[[target]]", f"name = {toml_string(name)}"] if name else []
        lines += [*pose(tool), *([f"joint = {tree.carriers[name] + 1}"] if name in tree.carriers else [])]
    if (elasticity := robot.elasticity) is not None:
        lines += ["", "[elasticity]  # one entry for each joint; compliance about its axis and across it"]
        add("gravity", elasticity.gravity, "in the base")
        add("axis_rad_per_Nm", elasticity.compliance[:, 0])
        add("across_rad_per_Nm", elasticity.compliance[:, 1])
        add("moment_Nm", elasticity.moment)
        lines.append("# of sin q, cos q, sin 2q, cos 2q")
        add("periodic_rad", elasticity.periodic)
        if elasticity.hysteresis.any():
            add("hysteresis_rad", elasticity.hysteresis, "half of it: farther if it came from below")
        if elasticity.pivot.any():
            add("pivot_mm", elasticity.pivot, "in the joints' frames: where the links turn when they give way")
        if elasticity.payload_kg or elasticity.payload_centre.any():
            add("payload_kg", elasticity.payload_kg)
            add("payload_centre_mm", elasticity.payload_centre, "in the frame of the flange")
    return "\n".join(lines) + "\n"


RobotText = Annotated[str, BeforeValidator(lambda robot: robot_toml(robot) if isinstance(robot, Robot) else robot)]
"""Text of a robot file inside a result file."""


@require_arguments
def save_robot(path: str | Path, robot: Robot, comments: Sequence[str] = ()) -> None:
    """Writes the file of ``robot`` to ``path``, complete or not at all, with ``comments`` at the top.

    An existing file is replaced. Raises InputError: it cannot be written.
    """
    save(Path(path), robot_toml(robot, comments))
    require_robot_written(path, robot)


def require_robot_written(path: str | Path, robot: Robot, chain: Chain | None = None) -> None:
    """Raises ConvergenceError if a written file has not the axes of ``chain`` (of ``robot`` if None) and its tools."""
    q, tools = fixed_values(len(robot.rows)), list(robot.tools)

    def values(robot: Robot, chain: Chain) -> np.ndarray:
        poses = [carried_poses(robot.chain(), q, [name] * len(q)) @ robot.tool(name) for name in tools]
        rotation, origin = joint_frames(chain, q)
        along = rotation[..., 2]
        lines = np.concatenate([LEVER_MM * along, np.cross(origin, along)])
        return np.concatenate([lines.ravel(), *(pose_values(each).ravel() for each in poses)])

    def again() -> np.ndarray:
        found = load_robot(path)
        return values(found, found.chain())

    require_written(path, again, values(robot, chain or robot.chain()), WRITTEN_MM, "mm")
