"""Export of compensated points to files of controllers; each file is read back when it is made."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

import stcal
from stcal.errors import InputError, StcalError
from stcal.geometry.arrays import require_arguments
from stcal.geometry.rigid import Poses
from stcal.io.poses.columns import ascii_text, program_name
from stcal.io.poses.controllers import MM_DIGITS, YASKAWA_MM_DIGITS
from stcal.robot.export.files import FORMS, Points
from stcal.robot.kinematics.model import Robot
from stcal.robot.use.compensation import Compensated
from stcal.robot.use.targets import poses_of

As = Literal["joints", "poses"]
SAME_MM, SAME_RAD = 10.0**-MM_DIGITS, 1e-9
"""Largest differences of poses that are read back, by the digits printed; Yaskawa's have fewer digits."""
YASKAWA_SAME_MM, YASKAWA_SAME_RAD = 10.0**-YASKAWA_MM_DIGITS, 5e-6
SHOWN = 6
"""Largest number of lines that are named in a note."""


@dataclass(frozen=True, slots=True)
class Exported:
    """An exported file. ``text`` : of the file; ``notes`` : what the file holds, and what it does not."""

    text: str
    notes: tuple[str, ...]


def require_form(form: str) -> None:
    """Refuses an unknown form.

    Raises InputError: the form is unknown; the message names the known ones.
    """
    if form not in FORMS:
        raise InputError("E-OPTION-FORM", f"--export {form}: unknown; one of {', '.join(FORMS)} needed")


@require_arguments
def robot_program(
    result: Compensated,
    robot: Robot,
    form: str,
    path: str | Path,
    wanted: As = "joints",
    pulses_per_deg: Sequence[float] | None = None,
) -> Exported:
    """Returns the points that are reached as a file of a controller; nothing is written.

    Parameters
    ----------
    result : Compensated
        Joint values of :func:`stcal.robot.compensate`.
    robot : Robot
        The robot whose joint values these are.
    form : {"yaskawa", "fanuc", "kuka", "abb", "ur"}
        The controller.
    path : str or Path
        The file. Controllers have its name, without its ending, inside the file too.
    wanted : {"joints", "poses"}
        Joint values, or the poses that must be commanded to the controller, which knows the nominal robot.
    pulses_per_deg : sequence of float, optional
        Pulses per degree of each joint, for Yaskawa's joint values; without them its file has poses.

    Returns
    -------
    Exported
        ``text`` of the file, and ``notes`` on what it holds and lacks.

    Raises
    ------
    InputError
        An unknown form, no row that is reached, joints for which the controller has no place, poses without a nominal
        robot or of several tools, or a wrong number of pulses.
    StcalError
        The file does not give the points back.
    """
    require_form(form)
    path = Path(path)
    where, controller = f"--export {form}={path}", FORMS[form]
    rows = np.flatnonzero(result.found.usable)
    if not len(rows):
        raise InputError("E-EXPORT-UNREACHED", f"{where}: none of {len(result)} rows is reached; nothing to write")
    if pulses_per_deg is not None and form == "yaskawa":
        _require_pulses(pulses_per_deg, robot, where)
    notes = []
    if form == "yaskawa" and wanted == "joints" and pulses_per_deg is None:
        wanted = "poses"
        notes.append("poses: joint values are pulses there; give --pulses-per-deg for these")
    points = _points(result, robot, rows, program_name(path.stem), pulses_per_deg)
    head = [f"stcal {stcal.__version__}: robot {robot.name}, {len(rows)} of {len(result)} points"]
    if wanted == "poses":
        poses, description = _poses(result, rows, where)
        points, head = points.with_poses(poses), [*head, description]
        notes.append(f"{description}; {controller.unknown}")
    else:
        reason = controller.refuses(points)
        if reason:
            raise InputError("E-ROBOT-MISMATCH", f"{where}: {reason}; joint values of robot {robot.name} do not fit")
        head.append("joint values that the controller must be told")
    unreached = np.flatnonzero(~result.found.usable)
    if len(unreached):
        named = ", ".join(str(result.targets.lines[i]) for i in unreached[:SHOWN]) + (
            ", …" if len(unreached) > SHOWN else ""
        )
        notes.append(f"left out, as they are not reached: line{'s' * (len(unreached) > 1)} {named}")
        head.append(
            f"left out, as they are not reached: {len(unreached)} lines, the first {result.targets.lines[unreached[0]]}"
        )
    text = controller.write(points, [ascii_text(line) for line in head])
    if not _same(controller.read(text), points, form):
        raise StcalError("E-EXPORT-READ-BACK", f"{where}: the file does not give the points back; use another form")
    return Exported(text, tuple(f"{where}: {note}" for note in [f"{len(rows)} points, {wanted}", *notes]))


def _points(
    result: Compensated, robot: Robot, rows: np.ndarray, name: str, pulses_per_deg: Sequence[float] | None
) -> Points:
    targets, labels = result.targets, []
    for i in rows:
        details = [f"{column} {own[i]}" for column, own in targets.names.items()]
        details += [f"target {targets.tools[i]}"] if targets.tools[i] else []
        labels.append(ascii_text(", ".join([f"line {targets.lines[i]}", *details])))
    pulses = None if pulses_per_deg is None else tuple(pulses_per_deg)
    joints = np.where(robot.prismatic, result.found.q[rows], np.degrees(result.found.q[rows]))
    return Points(name, tuple(labels), joints, robot.prismatic, None, pulses)


def _poses(result: Compensated, rows: np.ndarray, where: str) -> tuple[Poses, str]:
    """Returns the poses of the nominal robot at the compensated joint values, and a description of them with their
    tool."""
    if result.controller is None:
        raise InputError(
            "E-COMPENSATE-POSES",
            f"{where}: poses of compensated points are those of the nominal robot; give its file with --nominal, or "
            "joint values with --export-as joints",
        )
    targets = result.targets[rows]
    if len(names := sorted(set(targets.tools))) > 1:
        raise InputError(
            "E-EXPORT-TOOLS",
            f"{where}: poses of {len(names)} tools, {', '.join(map(repr, names))}; a file for each, or --export-as "
            "joints, needed",
        )
    x, y, z = result.controller.tool(names[0]).translation
    description = f"poses in the robot's base, of the tool at {x:.3f}, {y:.3f}, {z:.3f} mm on the flange"
    return poses_of(result.controller, targets, result.found.q[rows]), description


def _require_pulses(pulses: Sequence[float], robot: Robot, where: str) -> None:
    if len(pulses) != len(robot.rows) or not all(np.isfinite(p) and p != 0 for p in pulses):
        raise InputError(
            "E-OPTION-VALUE",
            f"{where}: --pulses-per-deg has {len(pulses)} numbers; {len(robot.rows)}, one for each joint, not 0, "
            "needed",
        )


def _same(found: Poses | np.ndarray, points: Points, form: str) -> bool:
    """Returns True if a file that was read back has these points."""
    if isinstance(found, Poses) != (points.poses is not None):
        return False
    if isinstance(found, Poses) and points.poses is not None:
        mm, rad = (YASKAWA_SAME_MM, YASKAWA_SAME_RAD) if form == "yaskawa" else (SAME_MM, SAME_RAD)
        if len(found) != len(points.poses):
            return False
        difference = found.difference(points.poses)
        return bool(np.abs(difference[:, 3:]).max() <= mm and np.abs(difference[:, :3]).max() <= rad)
    values, digit = FORMS[form].values(points)
    found = np.asarray(found)
    return found.shape == values.shape and bool(np.abs(found - values).max() <= 0.51 * digit)
