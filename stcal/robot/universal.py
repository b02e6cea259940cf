"""Calibration of an arm of Universal Robots: YAML of ur_calibration (ROS), and the controller's calibration.conf."""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import yaml
from pydantic import Field
from scipy.spatial.transform import Rotation

from stcal.errors import InputError
from stcal.geometry.arrays import require_arguments
from stcal.geometry.rigid import Rigid
from stcal.io.files import SETTINGS_BYTES, read_bytes, text_of
from stcal.io.static_transforms import METRE_MM, from_roll_pitch_yaw
from stcal.io.toml import Strict, load_yaml, validated
from stcal.robot.kinematics.dh import robot_between
from stcal.robot.kinematics.forward import fixed_values, forward
from stcal.robot.kinematics.robot_file import load_robot
from stcal.robot.kinematics.robot_model import Convention, DHRow, Joint, Robot
from stcal.robot.urdf import UrdfJoint, product, require_near, robot_of

LINKS = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
JOINTS = 6
NAME = "ur"
LEAST_OFF_MM = 1e-3
"""A micrometre: what angles of few digits round off."""
DELTAS = {"theta": 1.0, "a": METRE_MM, "d": METRE_MM, "alpha": 1.0}
"""Dimensions that a controller corrects, with the factors of their units."""
_LIST = re.compile(r"^\s*(?P<key>\w+)\s*=\s*\[(?P<values>[^\]]*)\]", re.MULTILINE)
Number = Annotated[float, Field(ge=-1e3, le=1e3, allow_inf_nan=False)]


class _Link(Strict):
    x: Number
    y: Number
    z: Number
    roll: Number
    pitch: Number
    yaw: Number


class _File(Strict):
    kinematics: dict[str, _Link]


def kinematics_content(text: str) -> Mapping | None:
    """Returns the keys and values of the YAML of ur_calibration; None for any other text."""
    if "kinematics" not in text:
        return None
    try:
        content = load_yaml(text)
    except (yaml.YAMLError, ValueError, RecursionError):
        return None
    return content if isinstance(content, dict) and "kinematics" in content else None


def is_conf(text: str) -> bool:
    """True if a text is the calibration.conf of a controller."""
    return re.search(r"^\s*delta_(theta|a|d|alpha)\s*=", text, re.MULTILINE) is not None


def robot_of_kinematics(content: Mapping, where: str, convention: Convention) -> tuple[Robot, float]:
    """Returns the arm of ur_calibration's YAML, and by how far (mm) a URDF with the same numbers is off at joint values
    of 0: roll, pitch and yaw are about moving axes X, Y, Z; URDF takes fixed ones. The base is the controller's; ROS's
    base_link is rotated by half a turn about Z. Raises InputError naming the link."""
    held = content["kinematics"]
    missing = [name for name in LINKS if name not in held] if isinstance(held, Mapping) else []
    if missing:
        raise InputError(
            "E-KEY-MISSING",
            f"{where}: kinematics without {', '.join(missing)}; an arm of Universal Robots has six links, "
            f"{', '.join(LINKS)}: extract its calibration anew with ur_calibration, or copy the whole file",
        )
    if isinstance(held, Mapping):  # the hash of the robot stands among the links
        content = {**content, "kinematics": {name: held[name] for name in LINKS}}
    links = validated(content, _File, where).kinematics

    def chain(turned: Callable[[list[float]], np.ndarray]) -> list[UrdfJoint]:
        joints = []
        for parent, (name, link) in zip(("base", *LINKS), links.items(), strict=False):
            pose = Rigid(turned([link.roll, link.pitch, link.yaw]), METRE_MM * np.array([link.x, link.y, link.z]))
            joints.append(UrdfJoint(name, "continuous", parent, name, pose, np.array([0.0, 0.0, 1.0]), None, ""))
        return joints

    moving = chain(lambda angles: Rotation.from_euler("XYZ", angles).as_matrix())
    off = np.linalg.norm(product(moving).translation - product(chain(from_roll_pitch_yaw)).translation)
    return robot_of({"": moving}, NAME, convention), float(off)


def robot_of_conf(text: str, where: str, nominal: Robot | None, convention: Convention) -> Robot:
    """Returns the arm of a calibration.conf: the one of its [DH] section or ``nominal``, and its deviations.

    Axes of upper arm, forearm and wrist are nearly parallel: the controller's rows have lengths of many metres that
    cancel, written here as rows with Hayati's angle. Raises InputError: no nominal arm, not six joints, or lists of
    other lengths.
    """
    lists = {match["key"]: match["values"] for match in _LIST.finditer(text)}
    deltas = {name: unit * _six(lists, f"delta_{name}", where) for name, unit in DELTAS.items()}
    joints = (Joint(),) * JOINTS if nominal is None else nominal.joints
    if all(name in lists for name in ("a", "d", "alpha")):
        a, d, alpha = (_six(lists, name, where) for name in ("a", "d", "alpha"))
        rows = tuple(DHRow(METRE_MM * a[i], alpha[i], METRE_MM * d[i], 0.0) for i in range(JOINTS))
        arm = Robot(NAME, "standard", rows, joints, unusual_size=True)
    elif nominal is None:
        raise InputError(
            "E-ROBOT-NOMINAL",
            f"{where}: deviations from a nominal arm, which it does not state; give --nominal robot.toml with the rows "
            "of the model, or add [DH] with a, d and alpha of urcontrol.conf",
        )
    elif len(nominal.rows) != JOINTS or nominal.convention != "standard" or nominal.prismatic.any():
        raise InputError(
            "E-ROBOT-NOMINAL",
            f"{where}: --nominal: {len(nominal.rows)} joints, convention {nominal.convention}; six that turn, "
            "standard, needed",
        )
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
    return replace(found, world_from_base=arm.world_from_base @ found.world_from_base)


def _six(lists: Mapping[str, str], key: str, where: str) -> np.ndarray:
    try:
        values = np.array([float(value) for value in lists.get(key, "").split(",")])
    except ValueError:
        values = np.zeros(0)
    if values.shape != (JOINTS,) or not np.isfinite(values).all():
        raise InputError("E-ROBOT-ENTRIES", f"{where}: {key}: a list of six numbers needed; give the controller's file")
    return values


@dataclass(frozen=True, slots=True, eq=False)
class UniversalRobot:
    """An arm of Universal Robots: ``robot``, and ``notes`` on how its file was read."""

    robot: Robot
    notes: tuple[str, ...]


@require_arguments
def load_universal(
    path: str | Path, nominal: Robot | str | Path | None = None, convention: Convention = "standard"
) -> UniversalRobot:
    """Returns the calibrated arm of Universal Robots of a file of ur_calibration (YAML), or of calibration.conf.

    Parameters
    ----------
    path : the file.
    nominal : the arm to whose rows the deviations of a calibration.conf are added, if that does not state it.
    convention : convention of the rows of Denavit and Hartenberg.

    Returns
    -------
    UniversalRobot : ``robot``, mm and rad, from the controller's base.

    Raises
    ------
    InputError : another file, a value that is missing or no number, or ``nominal`` does not fit or is not needed.
    """
    found = read_universal(Path(path), nominal, convention)
    if found is None:
        raise InputError(
            "E-ROBOT-FORM",
            f"robot {path}: no calibration of Universal Robots; ur_calibration's YAML needed, or its calibration.conf",
        )
    return found


def read_universal(path: Path, nominal: Robot | str | Path | None, convention: Convention) -> UniversalRobot | None:
    """Returns what :func:`load_universal` does, None for any other file."""
    try:
        text = text_of(read_bytes(path, SETTINGS_BYTES))
    except OSError as error:
        raise InputError("E-FILE-UNREADABLE", f"{path}: {error.strerror or error}; check the path") from error
    except UnicodeDecodeError:
        return None
    if is_conf(text):
        drawn = nominal if nominal is None or isinstance(nominal, Robot) else load_robot(nominal)
        return UniversalRobot(robot_of_conf(text, str(path), drawn, convention), ())
    content = kinematics_content(text)
    if content is None:
        return None
    if nominal is not None:
        raise InputError("E-OPTION-NEEDS", "--nominal: only of a calibration.conf; leave it out")
    robot, off_mm = robot_of_kinematics(content, str(path), convention)
    said = (
        "angles are read about turned axes, as ur_calibration computes them and the controller moves; a URDF with the "
        f"same numbers takes them about fixed ones, and its flange is {off_mm:.2g} mm off at joint values of 0"
    )
    return UniversalRobot(robot, (said,) if off_mm >= LEAST_OFF_MM else ())
