"""The robot from the axes of all joints: Denavit–Hartenberg rows, tools, their σ, and what to refuse."""

from collections import Counter, defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import chain, combinations, pairwise
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import BeforeValidator, Field

from stcal.errors import InputError
from stcal.geometry.arrays import Array, freeze
from stcal.geometry.rigid import Poses, Rigid
from stcal.io.json import ByName, Finite, Matrix, Named, Part, Pose, ResultFile
from stcal.parallel import one_thread
from stcal.robot.axes.fit import (
    GROSS,
    REWEIGHTINGS,
    STILL_RAD,
    TINY,
    AxisFit,
    called,
    find_arcs,
    fit_axes,
    virtual_reflectors,
)
from stcal.robot.identification.adjustment import State, observed, sigma_of
from stcal.robot.identification.prior import dh_values
from stcal.robot.identification.unexplained import moved_meanwhile
from stcal.robot.kinematics.dh import PARALLEL_RAD, robot_from_chain
from stcal.robot.kinematics.forward import joint_frames
from stcal.robot.kinematics.measurements import Measurements
from stcal.robot.kinematics.robot_file import RobotText
from stcal.robot.kinematics.robot_model import Chain, Robot

ByLine = Annotated[int, "line"]
Rows = Annotated[list[list[Finite]], BeforeValidator(lambda rows: np.asarray(rows, float).tolist())]
"""Rows of numbers, null where there is none."""
TOOL_GROSS = 6.0
"""Distance, in median distances, beyond which a row does not count for a reflector's place on the flange."""
USABLE_MM = 1.0
"""σ of a common normal's length or foot beyond which the Denavit–Hartenberg value is refused: arms repeat to 0.1 mm."""
STEP_RAD, STEP_MM = 1e-7, 1e-4
"""Steps of central differences: far above rounding, and small against angles to which an axis is known."""
EXACTLY = 1e-12  # sine of the angle of two axes below which rounding alone decides where their common normal is
LIKELY, MANY = 2.0, 4
"""Factor by which a mirror may fit worse than reversed joints, and number of these from which on they are not tried."""
LIKE_SIZE = 2.0  # largest ratio of the lengths to the nominal ones, or of these to them; wrong units differ by more
AGREES_RAD = np.radians(10.0)
"""Largest difference of axes and joint zeros from a nominal robot that is the same, and counts alike."""
MOVED_SHARE = 0.5
"""Share of the squared residuals beyond which a move along the order of the rows is named: gear errors vary with the
order too."""
FEW = 3  # largest number of outliers of a joint that are named
ONE_LINE_MM = 10.0  # largest distance between axes that are meant to be one line, such as those of a SCARA's spindle


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """Two consecutive axes; :class:`AxesFile` describes the fields (``pairs``). None along prismatic joints."""

    joint: int
    angle_rad: float
    angle_sigma_rad: float
    parallel: bool
    distance_mm: float | None = None
    distance_sigma_mm: float | None = None
    normal_mm: float | None = None
    normal_sigma_mm: float | None = None
    foot_mm: float | None = None
    foot_sigma_mm: float | None = None
    refused: str = ""


class LeaveOneOut(Part):
    """The values of each pair without one of r rows of the sweeps, to first order; :class:`AxesFile` describes the
    fields. ``distance``, ``normal`` : r rows of n − 1, mm, None where there is none."""

    lines: list[int]
    distance: Rows
    normal: Rows

    def spread(self, name: str) -> np.ndarray:
        """Returns the largest minus the smallest ``distance`` or ``normal``, (n − 1,); nan where there is none."""
        values = np.array(getattr(self, name), float)
        return np.fmax.reduce(values, axis=0) - np.fmin.reduce(values, axis=0)  # without nan, where there is any other


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class AxesResult:
    """A robot by the axis method; :class:`AxesFile` describes the fields. ``chain`` : the axes as measured."""

    format: ClassVar = "stcal axes 1"
    fits: tuple[AxisFit, ...]
    covariance: Array
    chain: Chain
    robot: Robot
    row_sigma: Array
    tool_spread_mm: dict[str, float]
    pairs: tuple[Pair, ...]
    without_one: LeaveOneOut
    off: tuple[Mapping[int, float], ...]
    notes: tuple[str, ...]

    def __post_init__(self):
        freeze(self, "covariance", (None, None), "covariance")
        freeze(self, "row_sigma", (None, 5), "σ of the rows")

    @property
    def rows(self) -> np.ndarray:
        """Rows (n, 5) a, alpha, d, theta, beta of the robot; mm, rad."""
        return dh_values(self.robot)

    @property
    def tools(self) -> Mapping[str, Rigid]:
        """Tools of the robot."""
        return self.robot.tools


OfAxis = Annotated[AxisFit, Named("world_from_axis covariance rms_mm sigma_mm redundancy span arcs radii heights")]


class AxesFile(ResultFile):
    """The result file of ``axes``."""

    format: Literal["stcal axes 1"] = Field(description="the file's form and its version")
    robot: RobotText = Field(description="text of the robot file")
    fits: list[OfAxis] = Field(
        description="of each joint, all joints at zero: `world_from_axis`, z along positive motion; `covariance` of "
        "rx, ry (rad), tx, ty (mm) in that frame (prismatic: rx, ry) by its own noise; `rms_mm` of a coordinate of the "
        "residuals, `sigma_mm`, `redundancy`; `span`, rad or mm; reflectors of its `arcs`, `radii` and `heights`, mm"
    )
    off: list[dict[ByLine, float]] = Field(description="by joint, rows off their arcs and left out, mm")
    covariance: Matrix = Field(description="of all axes together, with what each inherits from those before")
    rows: Matrix = Field(description="`a` (mm), `alpha` (rad), `d`, `theta`, `beta` of each joint")
    row_sigma: Matrix = Field(description="their σ; 0: kept from the robot given")
    tools: dict[ByName, Pose] = Field(description="flange_from_target, mm")
    tool_spread_mm: dict[ByName, float] = Field(description="RMS about it: encoders, gears and elasticity are in it")
    pairs: list[Pair] = Field(
        description="`joint` (from 1) and the next: `angle_rad`, `angle_sigma_rad`; `parallel`: within 1° of it; "
        "`distance_mm`, `distance_sigma_mm`: along the common normal, of near-parallel axes in the plane of their row; "
        "`normal_mm`, `foot_mm` and their σ `normal_sigma_mm`, `foot_sigma_mm`: the common normal, and its foot along "
        'the first axis from where that was measured; `refused`: why these must not be used, or `""`'
    )
    without_one: LeaveOneOut = Field(
        description="`lines` of the rows left out, `distance`, `normal` of each pair without them, mm, signed as `a`; "
        "to first order"
    )
    notes: list[str] = Field(description="rows, reflectors and arcs not used, columns not read, conventions of angles")


@one_thread()
def robot_from_sweeps(
    data: Measurements, nominal: Robot, still_rad: float = STILL_RAD, places: np.ndarray | None = None
) -> AxesResult:
    """Returns the axes, the robot, and their uncertainty by the axis method.

    Axes do not determine everything. What :func:`~stcal.robot.kinematics.dh.robot_from_chain` keeps of the nominal
    robot is kept here, and so is the orientation of tools.

    ``data`` : positions of one or more reflectors in sweeps of single joints; ``nominal`` : convention, joint types,
    coupling, and approximate build of the arm; ``still_rad`` : change of a revolute joint's value up to which the joint
    stands still; ``places`` : (k, 3) places of virtual reflectors in the target's frame, mm, k ≥ 3 and not in line, by
    which orientations are used too: those of :func:`~stcal.robot.axes.fit.ring`, or points of a real target; if None,
    positions alone are used. Returns axes in the instrument's frame with their covariance, and the robot that they
    make; mm, rad.

    Raises ConvergenceError: the fit of an axis reaches no minimum. Raises InputError: several stations, a joint never
    swept, a reflector that does not move, mirrored positions, a robot of another build; no orientations where they are
    asked for. Raises DegenerateError: axes that their arcs do not determine.

    References
    ----------
    H. W. Stone, "Kinematic Modeling, Identification, and Control of Robotic Manipulators", 1987. J. Santolaria, M.
    Ginés, "Uncertainty estimation in robot kinematic calibration", Robotics and Computer-Integrated Manufacturing 29,
    2013.
    """
    if len(set(data.stations)) > 1:
        fault = f"{data.where}: stations {', '.join(data.by_station())}"
        raise InputError("E-STATION-SINGLE", f"{fault}; sweeps are seen from one, so give one at a time")
    if nominal.tree:
        remedy = "the axis method takes one arm at a time: give its file"
        raise InputError("E-ROBOT-TREE", f"robot {nominal.name} is a tree of joints; {remedy}")
    measured, virtual = data, None if places is None else virtual_reflectors(data, places)
    data = data if virtual is None else virtual.data
    arcs, notes = find_arcs(data, nominal, still_rad)
    fits, covariance, unwound, passed = fit_axes(data, nominal, arcs, virtual)
    frames = [fit.world_from_axis for fit in fits]
    _require_signs(data.where, frames, nominal)
    axes = _chain_through(frames, nominal)
    tools, spread = _tools(data, frames[-1], unwound)
    if virtual is not None:
        tools, spread = virtual.tools(tools, spread)
    robot = robot_from_chain(axes, tools, nominal)
    _require_build(data.where, robot, nominal)
    if virtual is None:
        orientation = {name: nominal.tools[name].rotation if name in nominal.tools else np.eye(3) for name in tools}
        robot = replace(robot, tools={n: Rigid(orientation[n], t.translation) for n, t in robot.tools.items()})
    slopes, rows = slopes_of(frames, nominal), 5 * len(frames)
    pairs = pairs_of(frames, slopes, covariance, nominal, sum(abs(row.a) + abs(row.d) for row in robot.rows))
    notes = [*data.notes, *notes, *_remarks(measured, data, fits, robot, nominal)]
    notes += [
        f"joints {p.joint} and {p.joint + 1}: {p.refused}; their row is Denavit and Hartenberg's all the same, as "
        f"they are not within {np.degrees(PARALLEL_RAD):g}° of parallel"
        for p in pairs
        if p.refused and not p.parallel
    ]
    return AxesResult(
        fits=tuple(fits),
        covariance=covariance,
        chain=axes,
        robot=robot,
        row_sigma=sigma_of(slopes[:rows], covariance).reshape(-1, 5),
        tool_spread_mm=spread,
        pairs=pairs,
        without_one=_leave_one_out(data, fits, nominal, slopes @ passed),
        off=tuple({int(data.lines[row]): size for row, size in fit.off_mm.items()} for fit in fits),
        notes=tuple(notes),
    )


def _tools(data: Measurements, last: Rigid, unwound: np.ndarray):
    """Returns the places of the reflectors in the last joint's frame, from all rows, and their spread."""
    names, tools, spread = np.array(data.targets), {}, {}
    for name in dict.fromkeys(data.targets):
        points = last.inverse() @ unwound[names == name]
        place = np.median(points, axis=0)
        far = np.linalg.norm(points - place, axis=1)
        good = far <= TOOL_GROSS * max(np.median(far), TINY)
        place = points[good].mean(axis=0)
        tools[name] = Rigid(np.eye(3), place)
        spread[name] = float(np.sqrt(((points[good] - place) ** 2).sum(axis=1).mean()))
    return tools, spread


def _chain_through(frames: list[Rigid], nominal: Robot) -> Chain:
    """Returns the chain through the axes; the flange is the last joint's frame."""
    gaps, ends = Poses.of([frames[0], *(a.inverse() @ b for a, b in pairwise(frames))]), (Rigid(),) * len(frames)
    return Chain(gaps.rotation, gaps.translation, ends, nominal.prismatic, nominal.coupling)


def slopes_of(frames: list[Rigid], nominal: Robot) -> np.ndarray:
    """Returns the derivative (v, p) of :func:`_values` by the parameters of the axes, each in its own frame."""
    columns = []
    for i, component in _chain_through(frames, nominal).parameters():
        step = STEP_RAD if component < 3 else STEP_MM
        twists = (sign * step * np.eye(6)[component] for sign in (1, -1))
        high, low = (_values([*frames[:i], frames[i] @ Rigid.exp(t), *frames[i + 1 :]], nominal) for t in twists)
        columns.append((high - low) / (2 * step))
    return np.column_stack(columns)


def _values(frames: list[Rigid], nominal: Robot) -> np.ndarray:
    """Returns the rows (5 n,) of the robot with these axes, and (6 (n − 1),): angles (3), distances, normals, feet."""
    robot = robot_from_chain(_chain_through(frames, nominal), {}, nominal)
    values = np.full((len(frames) - 1, 6), np.nan)
    for i, (axis, next_axis) in enumerate(pairwise(frames)):
        across = np.cross(axis.rotation[:, 2], next_axis.rotation[:, 2])
        square = across @ across
        sine = np.sqrt(square)
        acute = np.arctan2(sine, abs(axis.rotation[:, 2] @ next_axis.rotation[:, 2]))
        values[i, :3] = across * (acute / sine if sine > EXACTLY else 1.0)
        if nominal.prismatic[i] or nominal.prismatic[i + 1]:
            continue
        between = next_axis.translation - axis.translation
        values[i, 3] = robot.rows[i if nominal.convention == "standard" else i + 1].a
        if sine > EXACTLY:
            values[i, 4:] = between @ across / sine, np.cross(between, next_axis.rotation[:, 2]) @ across / square
    return np.concatenate([dh_values(robot).ravel(), values.ravel()])


def pairs_of(
    frames: list[Rigid], slopes: np.ndarray, covariance: np.ndarray, nominal: Robot, size: float
) -> tuple[Pair, ...]:
    """Returns the pairs of consecutive axes with their σ from the covariance (p, p) of all axes; ``slopes`` : of
    :func:`slopes_of`; ``size`` : of the arm, mm."""
    values = _values(frames, nominal)[5 * len(frames) :].reshape(-1, 6)
    jacobians, pairs = slopes[5 * len(frames) :].reshape(len(values), 6, -1), []
    for i, (value, jacobian) in enumerate(zip(values, jacobians, strict=True)):
        acute = float(np.linalg.norm(value[:3]))
        opposed = frames[i].rotation[:, 2] @ frames[i + 1].rotation[:, 2] < 0
        spread = jacobian[:3] @ covariance @ jacobian[:3].T  # of the angle's vector
        # of exactly parallel axes the largest σ of that
        variance = np.linalg.eigvalsh(spread)[-1] if acute <= EXACTLY else value[:3] @ spread @ value[:3] / acute**2
        sigma = np.where(np.isfinite(value[3:]), sigma_of(jacobian[3:], covariance), np.nan)
        numbers = np.column_stack([[*np.abs(value[3:5]), value[5]], sigma]).ravel().tolist()
        lengths: list[Any] = [number if np.isfinite(number) else None for number in numbers]
        angle, parallel = np.pi - acute if opposed else acute, bool(np.sin(acute) < np.sin(PARALLEL_RAD))
        pair = Pair(i + 1, angle, float(np.sqrt(max(variance, 0))), parallel, *lengths)
        pairs.append(replace(pair, refused=_refused(pair, acute, size)))
    return tuple(pairs)


def _refused(pair: Pair, acute: float, size: float) -> str:
    """Returns why the lengths of Denavit and Hartenberg must not be used, if so."""
    if pair.distance_mm is None:
        return ""
    if pair.normal_sigma_mm is None or pair.foot_mm is None or pair.foot_sigma_mm is None:
        return "the axes are parallel: every common normal is as good as any other"
    foot, normal, foot_sigma = abs(pair.foot_mm), pair.normal_sigma_mm, pair.foot_sigma_mm
    reasons = []
    if foot > size:
        reasons.append(f"foot {foot / 1e3:.4g} m away, the arm is {size / 1e3:.3g} m long")
    if max(normal, foot_sigma) > USABLE_MM:
        reasons.append(f"σ {normal:.3g} mm of a and {foot_sigma / 1e3:.3g} m of the foot, {USABLE_MM:g} mm needed")
    if reasons:
        per_urad_m = pair.distance_mm / np.sin(acute) ** 2 * 1e-9
        reasons.append(f"axes {np.degrees(acute):.4f}° apart, 1 µrad moves the foot by {per_urad_m:.3g} m")
    return "; ".join(reasons)


def _shape(z: np.ndarray, origin: np.ndarray, sliding: np.ndarray) -> np.ndarray:
    """Returns cosines, moments of revolute axes, and triple products of directed axes."""
    size = max(float(np.linalg.norm(origin - origin[0], axis=1).max()), 1.0)
    pairs, three = (np.array(list(combinations(range(len(z)), k)), int).reshape(-1, k) for k in (2, 3))
    cosines = (z[pairs[:, 0]] * z[pairs[:, 1]]).sum(axis=1)
    a, b = pairs[~sliding[pairs].any(axis=1)].T
    moments = ((origin[b] - origin[a]) * np.cross(z[a], z[b])).sum(axis=1) / size
    return np.concatenate([cosines, moments, np.linalg.det(z[three])])


def _apart(z: np.ndarray, origin: np.ndarray, sliding: np.ndarray) -> float:
    """Returns the sum of the distances of revolute axes; of two nearly parallel ones, the distance across them."""
    total = 0.0
    for i, k in combinations(np.flatnonzero(~sliding), 2):
        between, normal = origin[k] - origin[i], np.cross(z[i], z[k])
        sine = np.linalg.norm(normal)
        parallel = sine < np.sin(AGREES_RAD)
        total += np.linalg.norm(np.cross(between, z[i])) if parallel else abs(between @ normal) / sine
    return float(total)


def _require_signs(where: str, frames: list[Rigid], nominal: Robot) -> None:
    """Refuses mirrored positions, joints with reversed sign, and an arm of another size."""
    n, sliding = len(frames), nominal.prismatic
    rotation, origins = joint_frames(nominal.chain(), np.zeros((1, n)))
    drawn = rotation[:, 0, :, 2], origins[:, 0], sliding
    shape = _shape(*drawn)
    directions, places = np.array([f.rotation[:, 2] for f in frames]), np.array([f.translation for f in frames])

    def off(sign: np.ndarray, mirror: float = 1.0) -> float:
        """Returns how far the axes are off the nominal ones after changes of sign (n,), and a mirror if −1."""
        axes = directions * sign[:, None] * [1, 1, mirror], places * [1, 1, mirror]
        return float(np.linalg.norm(_shape(*axes, sliding) - shape))

    as_it_is, mirrored = off(np.ones(n)), off(np.where(sliding, 1.0, -1.0), -1.0)
    reversed_ = {
        flipped: off(np.where(np.isin(np.arange(n), flipped), -1.0, 1.0))
        for flipped in chain.from_iterable(combinations(range(n), k) for k in range(1, MANY))
    }
    best = min(reversed_, key=lambda flipped: reversed_[flipped])
    named, robot = ", ".join(str(i + 1) for i in best), f"robot {nominal.name}"
    if mirrored < as_it_is / 2 and mirrored <= LIKELY * reversed_[best]:
        fault = f"{where}: the axes are the mirror image of {robot}'s: positions of a left-handed frame"
        remedy = "swap two columns of x, y, z or change the sign of one"
        raise InputError("E-AXES-MIRRORED", f"{fault} (or joints that count the other way); {remedy}")
    if reversed_[best] < as_it_is / 2:
        fault = f"{where}: joint {named} counts against {robot}'s"
        raise InputError("E-AXES-SIGN", f"{fault}; correct alpha in the robot file or the sign of its values")
    apart, right = _apart(directions, places, sliding), _apart(*drawn)
    if right > 0 and not 1 / LIKE_SIZE < apart / right < LIKE_SIZE:
        fault = f"{where}: the axes lie {apart / right:.3g} times as far apart as {robot}'s"
        raise InputError("E-AXES-UNITS", f"{fault}; check the unit of x, y, z, and the lengths in the robot file")


def _require_build(where: str, robot: Robot, nominal: Robot) -> None:
    """Refuses an arm of other angles between its axes than the nominal one."""
    for i, (row, drawn) in enumerate(zip(robot.rows, nominal.rows, strict=True), 1):
        if abs(row.alpha - drawn.alpha) > AGREES_RAD:
            alpha, nominal_alpha = np.degrees([row.alpha, drawn.alpha])
            fault = f"{where}: alpha of row {i} is {alpha:.1f}°, {nominal_alpha:.1f}° in robot {nominal.name}"
            remedy = "correct its alpha or theta, or the sign with which a joint counts"
            raise InputError("E-AXES-ANGLE", f"{fault}; {remedy}")


def _remarks(
    measured: Measurements, data: Measurements, fits: list[AxisFit], robot: Robot, nominal: Robot
) -> list[str]:
    """Returns remarks on the axes, their robot, and moves between the rows ``measured``, ``data`` with virtual ones."""
    notes = [
        f"joint {fit.joint + 1}: the weights of its points still change after {REWEIGHTINGS} rounds; look at them"
        for fit in fits
        if not fit.settled
    ]

    def at(row: int) -> str:
        return f"line {data.lines[row]}, {called(data.targets[row])}"

    for fit in fits:
        if off := fit.off_mm:
            farthest = "; ".join(f"{at(row)} ({size:.3g} mm)" for row, size in list(off.items())[:FEW])
            limit = f"{GROSS:g} σ is {GROSS * fit.sigma_mm:.2g} mm; left out, and listed in --json"
            rows = f"{len(off)} of {len(set(fit.rows.tolist()))} rows are off their arcs, {limit}"
            notes.append(f"joint {fit.joint + 1}: {rows}; the farthest: {farthest}")
        unused = f"too close to the axis of joint {fit.joint + 1} to tell of it; its arc is not used"
        notes += [f"{at(arc.rows[0])}: {unused}" for arc in fit.near]
    swept = {data.targets[row] for fit in fits for row in fit.rows.tolist()}
    for name in dict.fromkeys(each for each in data.targets if each not in swept):
        line, count = data.lines[data.targets.index(name)], data.targets.count(name)
        what = called(name) if name else "rows without a target, beside rows with one"
        alone = "so that its place on the flange rests on these rows alone; name it like the others, or leave it out"
        notes.append(f"line {line}: {what}: on no arc of any joint ({count} rows), {alone}")
    for i, (row, wanted) in enumerate(zip(robot.rows, nominal.rows, strict=True)):
        after = robot.rows[i if robot.convention == "standard" else min(i + 1, len(fits) - 1)]
        one_line = abs(np.sin(after.alpha)) < np.sin(PARALLEL_RAD) and abs(after.a) < ONE_LINE_MM
        if abs(row.theta - wanted.theta) > AGREES_RAD and not one_line:  # on one line theta is arbitrary
            theta, drawn = np.degrees([row.theta, wanted.theta])
            said = f"theta is {theta:.2f}°, {drawn:.2f}° in the robot file: its zero position differs"
            notes.append(f"joint {i + 1}: {said}")
    moved = moved_meanwhile(State(robot.chain(), dict(robot.tools)), observed(measured, "position"), MOVED_SHARE)
    return notes if moved is None else [*notes, moved.sentence()]


def _leave_one_out(data: Measurements, fits: list[AxisFit], nominal: Robot, slopes: np.ndarray) -> LeaveOneOut:
    """Returns the pairs' values without each row, by influence; ``slopes`` : of :func:`_values` by the fits."""
    groups, counts = defaultdict(list), Counter()  # rows measured together: the same joint values, each reflector once
    for row, (q, target) in enumerate(zip(data.q, data.targets, strict=True)):
        key = q.tobytes()
        counts[key, target] += 1
        groups[key, counts[key, target]].append(row)
    used = np.unique(np.concatenate([fit.rows for fit in fits]))
    instants = [rows for rows in groups.values() if np.isin(rows, used).any()]
    changes = np.concatenate([fit.influence(instants) for fit in fits], axis=1)
    every = _values([fit.world_from_axis for fit in fits], nominal) + changes @ slopes.T
    values = every[:, 5 * len(fits) :].reshape(len(instants), -1, 6)
    lines = [int(data.lines[rows[0]]) for rows in instants]
    return LeaveOneOut(lines=lines, distance=values[:, :, 3], normal=values[:, :, 4])
