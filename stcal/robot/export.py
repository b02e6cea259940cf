"""Export of compensated points to files of controllers; each file is read back when it is made."""

import csv
import io
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Literal

import numpy as np

import stcal
from stcal.errors import InputError, StcalError
from stcal.geometry.arrays import require_arguments
from stcal.geometry.rigid import Poses
from stcal.io.files import require_written
from stcal.io.poses.columns import ascii_text, fixed, joined, program_name, without_comments
from stcal.io.poses.programs import (
    ABB,
    DEG_DIGITS,
    FANUC,
    KUKA,
    MM_DIGITS,
    NUMBER,
    REMARK,
    UNIT_DIGITS,
    UR,
    YASKAWA,
    YASKAWA_MM_DIGITS,
    PoseText,
    require_form,
)
from stcal.io.table import read_table
from stcal.robot.identification.prior import dh_values
from stcal.robot.identification.report import DH, SHOWN, UNITS
from stcal.robot.identification.result import Identified
from stcal.robot.kinematics.model import Robot
from stcal.robot.use.compensation import Compensated
from stcal.robot.use.targets import poses_of

NOTHING = "9E9,9E9,9E9,9E9,9E9,9E9"
"""Values of ABB's external axes that do not exist."""
QUARTER_DEG = 90.0


@dataclass(frozen=True, slots=True, eq=False)
class Points:
    """Points of a program. ``name`` : of the program; ``labels`` : (m,) for comments; ``joints`` : (m, n) deg or mm;
    ``sliding`` : (n,) mask of the prismatic joints; ``poses`` : m poses in place of joint values, or None;
    ``pulses_per_deg`` : (n,) or None."""

    name: str
    labels: tuple[str, ...]
    joints: np.ndarray
    sliding: np.ndarray
    poses: Poses | None = None
    pulses_per_deg: tuple[float, ...] | None = None

    def __len__(self) -> int:
        return len(self.labels)


@dataclass(frozen=True, slots=True)
class Form:
    """The form of a controller's file.

    ``write`` : returns the text of points, below lines of comment; ``pose`` : how poses are written; ``axes`` : pattern
    of joint values in a text; ``values`` : returns joint values (m, n) in the file's unit, and their last digit;
    ``refuses`` : returns why joint values cannot be written, or ""; ``unknown`` : what the file does not state about a
    pose.
    """

    write: Callable[[Points, Sequence[str]], str]
    pose: PoseText
    axes: re.Pattern[str]
    refuses: Callable[[Points], str]
    unknown: str
    values: Callable[[Points], tuple[np.ndarray, float]] = lambda points: (points.joints, 10.0**-DEG_DIGITS)

    def read(self, text: str) -> Poses | np.ndarray:
        """Returns the poses, or the joint values (m, n) as they are written."""
        poses = self.pose.read(text)
        if poses:
            return Poses.of(poses)
        matches = self.axes.finditer(without_comments(text))
        return np.array([[float(v) for v in re.findall(r"(?<![\w.])-?\d+(?:\.\d+)?", each[1])] for each in matches])


def most(count: int) -> Callable[[Points], str]:
    """Returns a check that refuses more than ``count`` joints."""

    def refuses(points: Points) -> str:
        n = points.joints.shape[1]
        return f"{n} joints, {count} or fewer are possible" if n > count else ""

    return refuses


def _six_turning(points: Points) -> str:
    n, sliding = points.joints.shape[1], int(points.sliding.sum())
    return "" if n == 6 and not sliding else f"{n} joints, {sliding} prismatic; six that turn needed"


def _turning(points: Points) -> str:
    sliding = int(points.sliding.sum())
    return f"{sliding} prismatic joints have no pulses per degree; give poses" if sliding else most(8)(points)


def _kuka(points: Points, head: Sequence[str]) -> str:
    lines = ["&ACCESS RVP", f"DEFDAT {points.name} PUBLIC", *(f"; {line}" for line in head)]
    for i, label in enumerate(points.labels):
        if points.poses is None:
            axes = ",".join(f"A{k} {fixed(v, DEG_DIGITS)}" for k, v in enumerate(points.joints[i], 1))
            frame = f"DECL GLOBAL E6AXIS XP{i + 1}={{{axes}}}"
        else:
            frame = f"DECL GLOBAL E6POS XP{i + 1}={{{KUKA.write(points.poses[i])}}}"
        lines += [f"; {label}", frame]
    return "\n".join([*lines, "ENDDAT"]) + "\n"


def _abb(points: Points, head: Sequence[str]) -> str:
    lines = [f"MODULE {points.name}", *(f"  ! {line}" for line in head)]
    for i, label in enumerate(points.labels):
        joints = points.joints[i]
        if points.poses is None:
            six = joined(np.pad(joints, (0, 6 - len(joints))), DEG_DIGITS)
            frame = f"jointtarget p{i + 1}:=[[{six}],[{NOTHING}]]"
        else:
            all_six = np.pad(joints, (0, max(0, 6 - len(joints))))  # 0 for joints that an arm does not have
            quarters = ",".join(str(int(v)) for v in np.floor(all_six[[0, 3, 5]] / QUARTER_DEG))
            frame = f"robtarget p{i + 1}:=[{ABB.write(points.poses[i])},[{quarters},0],[{NOTHING}]]"
        lines += [f"  ! {label}", f"  CONST {frame};"]
    return "\n".join([*lines, "ENDMODULE"]) + "\n"


def _abb_values(points: Points) -> tuple[np.ndarray, float]:
    return np.pad(points.joints, ((0, 0), (0, 6 - points.joints.shape[1]))), 10.0**-DEG_DIGITS


def _ur(points: Points, head: Sequence[str]) -> str:
    lines = [f"# {line}" for line in head]
    for i, label in enumerate(points.labels):
        if points.poses is None:
            value = f"[{joined(np.radians(points.joints[i]), UNIT_DIGITS, ', ')}]"
        else:
            value = UR.write(points.poses[i])
        lines += [f"# {label}", f"p{i + 1} = {value}"]
    return "\n".join(lines) + "\n"


def _fanuc(points: Points, head: Sequence[str]) -> str:
    remarks = [*head, *(f"P[{i}] {label}" for i, label in enumerate(points.labels, 1))]
    lines = [f"/PROG  {points.name}", "/ATTR", 'COMMENT = "stcal compensate";', "/MN"]
    lines += [f"   {k}:  !{remark[:REMARK]} ;" for k, remark in enumerate(remarks, 1)]
    lines.append("/POS")
    for i in range(len(points)):
        if points.poses is None:
            axes = [
                f"J{k} = {fixed(v, DEG_DIGITS)} {' mm' if slides else 'deg'}"
                for k, (v, slides) in enumerate(zip(points.joints[i], points.sliding, strict=True), 1)
            ]
            rows = [",\t".join(axes[k : k + 3]) for k in range(0, len(axes), 3)]
            body = ["\tUF : 0, UT : 1,", "\t" + ",\n\t".join(rows)]
        else:
            body = ["\tUF : 0, UT : 1,\t\tCONFIG : 'N U T, 0, 0, 0',", FANUC.write(points.poses[i])]
        lines += [f"P[{i + 1}]{{", "   GP1:", *body, "};"]
    return "\n".join([*lines, "/END"]) + "\n"


def _yaskawa_values(points: Points) -> tuple[np.ndarray, float]:
    return np.round(points.joints * np.array(points.pulses_per_deg)), 1.0


def _yaskawa(points: Points, head: Sequence[str]) -> str:
    lines = ["/JOB", f"//NAME {points.name}", "//POS", f"///NPOS {len(points)},0,0,0,0,0", "///TOOL 0"]
    if points.poses is None:
        lines += ["///POSTYPE PULSE", "///PULSE"]
        values = [",".join(str(int(v)) for v in row) for row in _yaskawa_values(points)[0]]
    else:
        lines += ["///POSTYPE ROBOT", "///RECTAN", "///RCONF 0,0,0,0,0,0,0,0"]
        values = [YASKAWA.write(pose) for pose in points.poses]
    lines += [f"C{i:05d}={value}" for i, value in enumerate(values)]
    lines += ["//INST", f"///DATE {datetime.now():%Y/%m/%d %H:%M}", "///ATTR SC,RW", "///GROUP1 RB1", "NOP"]
    remarks = [*head, *(f"C{i:05d} {label}" for i, label in enumerate(points.labels))]
    return "\r\n".join([*lines, *(f"'{remark[:REMARK]}" for remark in remarks), "END"]) + "\r\n"


_JOINT = NUMBER[1:-1]
FORMS = {
    "yaskawa": Form(
        _yaskawa,
        YASKAWA,
        re.compile(r"^C\d+=(-?\d+(?:,-?\d+)*)$", re.MULTILINE),
        _turning,
        "set ///TOOL, and ///RCONF for the configuration of the arm, which a pose does not tell",
        _yaskawa_values,
    ),
    "fanuc": Form(
        _fanuc,
        FANUC,
        re.compile(r"^P\[\d+\]\{\n.*\n.*\n((?:\tJ.*\n)+)\};", re.MULTILINE),
        most(9),
        "set UT for the tool, and CONFIG for the configuration of the arm, which a pose does not tell",
    ),
    "kuka": Form(
        _kuka,
        KUKA,
        re.compile(r"E6AXIS \w+=\{(.*)\}"),
        most(6),
        "without S and T: set $TOOL and $BASE; the arm stays in its configuration",
    ),
    "abb": Form(
        _abb,
        ABB,
        re.compile(r"jointtarget \w+:=\[\[(.*?)\]"),
        most(6),
        "cf1, cf4, cf6 are of the joint values, cfx is 0: correct it, or move with ConfJ\\Off and ConfL\\Off",
        _abb_values,
    ),
    "ur": Form(
        _ur,
        UR,
        re.compile(rf"^\w+ = \[({_JOINT}(?:, {_JOINT})*)\]", re.MULTILINE),
        _six_turning,
        "set the TCP; inverse kinematics takes the configuration nearest to the arm's",
        lambda points: (np.radians(points.joints), 10.0**-UNIT_DIGITS),
    ),
}
"""The form for each word of ``--export``."""


HEAD = ("joint", "parameter", "nominal", "identified", "difference", "sigma", "unit", "determined")
DIGITS = {"mm": 6, "deg": 9}
ZERO = "zero"
LENGTH_AT, ANGLE_AT = DH.index("d"), DH.index("theta")


def zeros(result: Identified, nominal: Robot) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns the joint values that the controller should have where it has 0 now, their σ, and a mask of those that
    the data determine.

    All are (n,), rad or mm. The identified rows have θ + Δ, or d + Δ for prismatic joints, where the nominal ones have
    θ; with the coupling C the joints turn by C q. Nominal rows do the same with q + C⁻¹ Δ.
    """
    at = np.where(nominal.prismatic, LENGTH_AT, ANGLE_AT)
    joints, back = np.arange(len(at)), np.linalg.inv(nominal.coupling)
    change = back @ (dh_values(result.robot) - dh_values(nominal))[joints, at]
    jacobian = back @ result.adjustment.rows.by_parameters(result.robot)[joints, at]
    k = jacobian.shape[1]
    sigma = np.sqrt(np.einsum("nk,kl,nl->n", jacobian, result.covariance[:k, :k], jacobian).clip(0))
    open_ = result.dh_sigma[joints, at] == 0
    open_[[turn for turn, _ in result.adjustment.rows.coaxial]] = True
    return change, sigma, (np.abs(back) > 0) @ open_ == 0


@require_arguments
def offsets_csv(result: Identified, nominal: Robot) -> str:
    """Returns the table of mastering offsets and differences of D-H values.

    Parameters
    ----------
    result : Identified
        The robot as identified, of :func:`~stcal.robot.identify`.
    nominal : Robot
        The robot from which it was identified.

    Returns
    -------
    str
        CSV in mm and degrees, with σ (form: ``data_layout.md``).
    """
    before, values, sigma = dh_values(nominal) * SHOWN, dh_values(result.robot) * SHOWN, result.dh_sigma * SHOWN
    change, change_sigma, known = zeros(result, nominal)
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(HEAD)

    def row(joint: int, name: str, old: float, new: float, deviation: float, unit: str, told: bool) -> None:
        shown = [fixed(v, DIGITS[unit]) for v in (old, new, new - old)]
        sigma_text = fixed(deviation, DIGITS[unit]) if told else ""
        writer.writerow([joint, name, *shown, sigma_text, unit, "yes" if told else "no"])

    for i, slides in enumerate(nominal.prismatic):
        for name, unit, old, new, deviation in zip(DH, UNITS, before[i], values[i], sigma[i], strict=True):
            row(i + 1, name, old, new, deviation, unit, deviation > 0)
        factor, unit = (1.0, "mm") if slides else (float(np.degrees(1.0)), "deg")
        row(i + 1, ZERO, 0.0, factor * change[i], factor * change_sigma[i], unit, bool(known[i]))
    return stream.getvalue()


def require_offsets_written(path: str | Path, result: Identified, nominal: Robot) -> None:
    """Read a written table of offsets again, and require the identified D-H values and offsets of zeros."""
    values, change = dh_values(result.robot) * SHOWN, zeros(result, nominal)[0]
    change = np.where(nominal.prismatic, change, np.degrees(change))
    require_written(
        path,
        lambda: read_table(path, "offsets").numbers("identified").reshape(len(values), -1),
        np.column_stack([values, change]),
        10.0 ** -DIGITS["mm"],
        "mm or deg",
    )


As = Literal["joints", "poses"]
SAME_MM, SAME_RAD = 10.0**-MM_DIGITS, 1e-9
"""Largest differences of poses that are read back, by the digits printed; Yaskawa's have fewer digits."""
YASKAWA_SAME_MM, YASKAWA_SAME_RAD = 10.0**-YASKAWA_MM_DIGITS, 5e-6
MOST_NAMED = 6
"""Largest number of lines that are named in a note."""


@dataclass(frozen=True, slots=True)
class Exported:
    """An exported file. ``text`` : of the file; ``notes`` : what the file holds, and what it does not."""

    text: str
    notes: tuple[str, ...]


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
    require_form(form, FORMS)
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
        points, head = replace(points, poses=poses), [*head, description]
        notes.append(f"{description}; {controller.unknown}")
    else:
        reason = controller.refuses(points)
        if reason:
            raise InputError("E-ROBOT-MISMATCH", f"{where}: {reason}; joint values of robot {robot.name} do not fit")
        head.append("joint values that the controller must be told")
    unreached = np.flatnonzero(~result.found.usable)
    if len(unreached):
        named = ", ".join(str(result.targets.lines[i]) for i in unreached[:MOST_NAMED]) + (
            ", …" if len(unreached) > MOST_NAMED else ""
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
