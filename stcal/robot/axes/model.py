"""From the axes of all joints to a robot: Denavit–Hartenberg rows, tools, what they are worth, what to refuse."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.errors import ConvergenceError, DegenerateError, InputError
from stcal.geometry.arrays import Array, freeze
from stcal.geometry.rigid import Rigid
from stcal.parallel import one_thread
from stcal.robot.axes.checks import AGREES_RAD, require_like_nominal
from stcal.robot.axes.fit import GROSS, REWEIGHTINGS, TINY, AxisFit, fit_axis, refit_axis
from stcal.robot.axes.orientations import VirtualReflectors, virtual_reflectors
from stcal.robot.axes.sweeps import STILL_RAD, Arc, called, find_arcs
from stcal.robot.kinematics.dh import PARALLEL_RAD, robot_from_chain
from stcal.robot.kinematics.measurements import Measurements
from stcal.robot.kinematics.model import Chain, Robot

REFITTED = 200
"""Rows of the sweeps up to which every one is left out by fitting again; of more by influence: of 600 rows the spread
is 1 to 4 % less so."""
FEW = 3
"""Outliers of a joint that are named one by one."""
USABLE_MM = 1.0
"""σ of a common normal's length or foot beyond which the Denavit–Hartenberg value is refused: arms repeat to 0.1 mm."""
STEP_RAD, STEP_MM = 1e-7, 1e-4
"""Central differences: far above rounding, and small against angles that an axis is known to."""
ONE_LINE_MM = 10.0
"""Axes meant to be one, as of a SCARA's spindle, are made closer than this."""
EXACTLY = 1e-12
"""Sine below which rounding alone decides where a common normal is."""
TOOL_GROSS = 6.0
"""Median distances from which a row does not count for a reflector's place on the flange."""
ROW_VALUES = ("a", "alpha", "d", "theta", "beta")


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Pair:
    """Two consecutive axes, ``joint`` (from 0) and the next; mm, rad; None along prismatic joints.

    ``angle`` : between them; ``distance`` : of the next axis from this one, in the plane across this one that the
    robot's rows give it (near-parallel pairs), else along the common normal; ``parallel`` : the rows have Hayati's β;
    ``normal``, ``foot`` : length of the common normal and where its foot lies on this axis, from where that was
    measured; ``refused`` : why a Denavit–Hartenberg row with these must not be used, or "".
    """

    joint: int
    angle: float
    angle_sigma: float
    parallel: bool
    distance: float | None = None
    distance_sigma: float | None = None
    normal: float | None = None
    normal_sigma: float | None = None
    foot: float | None = None
    foot_sigma: float | None = None
    refused: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class LeaveOneOut:
    """What each pair's values become without one row of the sweeps (all its reflectors).

    ``lines`` : of each row left out, its first; ``distance``, ``normal`` : (r, n − 1) mm, as in :class:`Pair`; nan
    where there is none, or where the rest does not determine an axis.
    """

    lines: tuple[int, ...]
    distance: np.ndarray
    normal: np.ndarray

    def __post_init__(self):  # nan is a value here
        for name in ("distance", "normal"):
            values = np.array(getattr(self, name))
            values.flags.writeable = False
            object.__setattr__(self, name, values)

    def spread(self, name: str) -> np.ndarray:
        """(n − 1,) largest less smallest of ``distance`` or ``normal``; nan where there is none."""
        values = getattr(self, name)
        known = np.isfinite(values)
        high, low = np.where(known, values, -np.inf).max(axis=0), np.where(known, values, np.inf).min(axis=0)
        return np.where(known.any(axis=0), high - low, np.nan)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class AxesResult:
    """A robot by the axis method.

    ``fits`` : one for each joint, with the joints before it at zero; ``covariance`` : (p, p) of all axes together, 4 or
    2 each in their own frames, with what each inherits from the unwinding of those before; ``robot`` : its rows, base
    and tools; ``row_sigma`` : (n, 5) of a, alpha, d, theta, beta (mm, rad), 0 where the nominal value is kept;
    ``tool_spread_mm`` : RMS of each reflector about its place on the flange; ``chain`` : the axes; ``off`` : of each
    axis, lines of rows that are off their arcs and were left out, mm; ``notes`` : what was passed over.
    """

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


@one_thread()
def robot_from_sweeps(
    data: Measurements, nominal: Robot, still_rad: float = STILL_RAD, places: np.ndarray | None = None
) -> AxesResult:
    """The axis method: axes, robot, and how far to trust them.

    Axes do not determine everything: what :func:`~stcal.robot.kinematics.dh.robot_from_chain` keeps of the nominal
    robot is kept, and the orientation of tools.

    Parameters
    ----------
    data : Measurements
        Positions of one or more reflectors in sweeps of single joints.
    nominal : Robot
        Convention, joint types, coupling, and about how the arm is built.
    still_rad : float
        Revolute joints stand still within this.
    places : (k, 3) array, optional
        Take orientations too, by virtual reflectors at these places of the target's frame, mm, k ≥ 3 and not in line:
        those of :func:`~stcal.robot.axes.orientations.ring`, or points of a real target. Positions alone where None.

    Returns
    -------
    AxesResult
        Axes in the instrument's frame with their covariance, and the robot that they make; mm, rad.

    Raises
    ------
    ConvergenceError
        The fit of an axis reaches no minimum.
    InputError
        A joint never swept, a reflector that does not move, mirrored positions, a robot of another build; no
        orientations where they are asked for.
    DegenerateError
        Axes that their arcs do not determine.

    References
    ----------
    H. W. Stone, "Kinematic Modeling, Identification, and Control of Robotic Manipulators", 1987. J. Santolaria, M.
    Ginés, "Uncertainty estimation in robot kinematic calibration", Robotics and Computer-Integrated Manufacturing 29,
    2013.
    """
    virtual = None if places is None else virtual_reflectors(data, places)
    data = data if virtual is None else virtual.data
    if nominal.tree is not None:
        raise InputError(
            f"robot {nominal.name} is a tree of joints; the axis method takes one arm at a time: give its file"
        )
    arcs, notes = find_arcs(data, nominal, still_rad)
    notes = [*data.notes, *notes]
    fits, covariance, unwound, passed = fit_axes(data, nominal, arcs, virtual)
    frames = [fit.world_from_axis for fit in fits]
    require_like_nominal(data.where, frames, nominal)
    axes = _chain(frames, nominal)
    tools, spread = _tools(data, frames[-1], unwound)
    if virtual is not None:
        tools, spread = virtual.tools(tools, spread)
    robot = robot_from_chain(axes, tools, nominal)
    if virtual is None:
        kept = {name: nominal.tools[name].rotation if name in nominal.tools else np.eye(3) for name in tools}
        robot = replace(robot, tools={n: Rigid(kept[n], t.translation) for n, t in robot.tools.items()})
    row_sigma = _sigma(_jacobian(lambda f: _row_values(f, nominal), frames, nominal), covariance).reshape(-1, 5)
    pairs = pairs_of(frames, covariance, robot)
    notes += _notes(data, fits, robot, nominal)
    notes += [
        f"joints {p.joint + 1} and {p.joint + 2}: {p.refused}; their row is Denavit and Hartenberg's all the same, as "
        f"they are not within {np.degrees(PARALLEL_RAD):g}° of parallel"
        for p in pairs
        if p.refused and not p.parallel
    ]
    return AxesResult(
        fits=tuple(fits),
        covariance=covariance,
        chain=axes,
        robot=robot,
        row_sigma=row_sigma,
        tool_spread_mm=spread,
        pairs=pairs,
        without_one=_leave_one_out(data, fits, nominal, passed),
        off=tuple({int(data.lines[row]): size for row, size in off_mm(fit).items()} for fit in fits),
        notes=tuple(notes),
    )


def fit_axes(
    data: Measurements, robot: Robot, arcs: list[Arc], virtual: VirtualReflectors | None = None
) -> tuple[list[AxisFit], np.ndarray, np.ndarray, list[list[np.ndarray]]]:
    """Fits in order, each on points with the joints before unwound; covariance of all; points with all unwound; and of
    each axis the derivatives by those before it.

    The covariance counts a row once, however many sweeps it belongs to, and a pose once for all its reflectors.
    """
    kinematic = data.q @ robot.coupling.T
    points, m = np.array(data.points()), len(data)
    turned = np.broadcast_to(np.eye(3), (m, 3, 3))  # what unwinding has turned the noise by
    fits, response, inherited, passed = [], [], [], []
    for j, sliding in enumerate(robot.prismatic):
        own = [arc for arc in arcs if arc.joint == j]
        fit = fit_axis(points, kinematic[:, j], own, bool(sliding), f"{data.where}: joint {j + 1}")
        # derivative of this axis by σ-scaled noise of every row: its own, and through the axes before it
        to_noise = np.zeros((len(fit.gain), m, 3))
        own_noise = fit.sigma_mm * np.einsum("pkc,kcd->kpd", fit.gain, turned[fit.rows])
        np.add.at(to_noise.swapaxes(0, 1), fit.rows, own_noise)  # a row may belong to several arcs
        passed.append([np.einsum("pkc,kcq->pq", fit.gain, jacobian[fit.rows]) for jacobian in inherited])
        for before, by in zip(response, passed[-1], strict=True):
            to_noise += np.einsum("pq,qmc->pmc", by, before)
        turn, after = _unwound(fit.world_from_axis, points, kinematic[:, j], bool(sliding))
        inherited = [turn @ jacobian for jacobian in inherited]
        inherited.append(_unwinding_jacobian(fit.world_from_axis, points, after, turn, len(fit.gain)))
        fits.append(fit)
        response.append(to_noise)
        points, turned = after, turn @ turned
    rows = np.concatenate(response)
    stacked = rows.reshape(-1, 3 * m) if virtual is None else virtual.by_pose(rows)
    return fits, stacked @ stacked.T, points, passed


def _unwound(axis: Rigid, points: np.ndarray, value: np.ndarray, sliding: bool) -> tuple[np.ndarray, np.ndarray]:
    """Rotations (m, 3, 3) that undo the joint's values, and the points after that."""
    z, origin = axis.rotation[:, 2], axis.translation
    if sliding:
        return np.broadcast_to(np.eye(3), (len(points), 3, 3)), points - value[:, None] * z
    turn = Rotation.from_rotvec(-value[:, None] * z).as_matrix()
    return turn, np.einsum("mij,mj->mi", turn, points - origin) + origin


def _unwinding_jacobian(axis: Rigid, before: np.ndarray, after: np.ndarray, turn: np.ndarray, count: int) -> np.ndarray:
    """(m, 3, p) derivative of the unwound points by rx, ry, tx, ty of the axis in its frame.

    Moving the axis by a small motion D makes of its unwinding U the motion D U D⁻¹: δ = D(U x) − U(D x).
    """
    columns = []
    for component in (0, 1, 3, 4)[:count]:
        direction = axis.rotation[:, component % 3]
        if component < 3:
            here, there = (np.cross(direction, points - axis.translation) for points in (after, before))
        else:
            here = there = np.broadcast_to(direction, after.shape)
        columns.append(here - np.einsum("mij,mj->mi", turn, there))
    return np.stack(columns, axis=2)


def _chain(frames: list[Rigid], nominal: Robot) -> Chain:
    """The chain through the axes; the flange is set in the last joint's frame."""
    gaps = [frames[0], *(a.inverse() @ b for a, b in pairwise(frames))]
    rotation, translation = np.array([g.rotation for g in gaps]), np.array([g.translation for g in gaps])
    return Chain(rotation, translation, Rigid(), nominal.prismatic, nominal.coupling)


def _tools(data: Measurements, last: Rigid, unwound: np.ndarray):
    """Places of the reflectors in the last joint's frame, from all rows (medians: some may be grossly wrong)."""
    names, tools, spread = np.array(data.targets), {}, {}
    for name in dict.fromkeys(data.targets):
        seen = last.inverse() @ unwound[names == name]
        place = np.median(seen, axis=0)
        far = np.linalg.norm(seen - place, axis=1)
        good = far <= TOOL_GROSS * max(np.median(far), TINY)
        place = seen[good].mean(axis=0)
        tools[name] = Rigid(np.eye(3), place)
        spread[name] = float(np.sqrt(((seen[good] - place) ** 2).sum(axis=1).mean()))
    return tools, spread


def _row_values(frames: list[Rigid], nominal: Robot) -> np.ndarray:
    """(5 n,) of the rows that these axes give."""
    robot = robot_from_chain(_chain(frames, nominal), {}, nominal)
    return np.array([[getattr(row, key) for key in ROW_VALUES] for row in robot.rows]).ravel()


def _jacobian(function, frames: list[Rigid], robot: Robot) -> np.ndarray:
    """(v, p) central differences of a function of the axes by their parameters, each in its own frame."""
    columns = []
    for i, sliding in enumerate(robot.prismatic):
        for component in (0, 1) if sliding else (0, 1, 3, 4):
            step = STEP_RAD if component < 3 else STEP_MM
            twist = step * np.eye(6)[component]
            high, low = (
                function([*frames[:i], frames[i] @ Rigid.exp(sign * twist), *frames[i + 1 :]]) for sign in (1, -1)
            )
            columns.append((high - low) / (2 * step))
    return np.column_stack(columns)


def _sigma(jacobian: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """(v,) σ of values from the covariance (p, p) of what their ``jacobian`` (v, p) is by."""
    return np.sqrt(np.maximum(np.einsum("vp,pq,vq->v", jacobian, covariance, jacobian), 0))


def _pair_values(frames: list[Rigid], nominal: Robot) -> np.ndarray:
    """(6 (n − 1),) for each pair the acute angle as a vector (3), the rows' distance, the common normal's length and
    foot from the axis's origin (nan with a prismatic joint)."""
    robot = robot_from_chain(_chain(frames, nominal), {}, nominal)
    out = np.full((len(frames) - 1, 6), np.nan)
    for i, (one, two) in enumerate(pairwise(frames)):
        across = np.cross(one.rotation[:, 2], two.rotation[:, 2])
        square = across @ across
        sine = np.sqrt(square)
        acute = np.arctan2(sine, abs(one.rotation[:, 2] @ two.rotation[:, 2]))
        out[i, :3] = across * (acute / sine if sine > EXACTLY else 1.0)
        if nominal.prismatic[i] or nominal.prismatic[i + 1]:
            continue
        between = two.translation - one.translation
        out[i, 3] = robot.rows[i if nominal.convention == "standard" else i + 1].a
        if sine > EXACTLY:
            out[i, 4:] = between @ across / sine, np.cross(between, two.rotation[:, 2]) @ across / square
    return out.ravel()


def pairs_of(frames: list[Rigid], covariance: np.ndarray, robot: Robot) -> tuple[Pair, ...]:
    """Consecutive axes with their covariance; ``robot`` gives what axes leave open (planes of near-parallel pairs)."""
    if len(frames) < 2:
        return ()
    values = _pair_values(frames, robot).reshape(-1, 6)
    jacobians = _jacobian(lambda f: _pair_values(f, robot), frames, robot).reshape(len(values), 6, -1)
    size = sum(abs(row.a) + abs(row.d) for row in robot.rows)
    pairs = []
    for i, (value, jacobian) in enumerate(zip(values, jacobians, strict=True)):
        acute = float(np.linalg.norm(value[:3]))
        opposed = frames[i].rotation[:, 2] @ frames[i + 1].rotation[:, 2] < 0
        lengths = {}
        if np.isfinite(value[3]):
            lengths = _lengths(acute, value[3:], _sigma(jacobian[3:], covariance), size)
        pair = Pair(
            joint=i,
            angle=np.pi - acute if opposed else acute,
            angle_sigma=_angle_sigma(value[:3], jacobian[:3] @ covariance @ jacobian[:3].T),
            parallel=bool(np.sin(acute) < np.sin(PARALLEL_RAD)),
            **lengths,
        )
        pairs.append(pair)
    return tuple(pairs)


def _angle_sigma(angle: np.ndarray, covariance: np.ndarray) -> float:
    """σ along the angle's vector; of exactly parallel axes, whose angle has no direction yet, the worst."""
    length = float(np.linalg.norm(angle))
    if length <= EXACTLY:
        return float(np.sqrt(max(np.linalg.eigvalsh(covariance)[-1], 0)))
    return float(np.sqrt(max(angle @ covariance @ angle, 0)) / length)


def _lengths(angle: float, value: np.ndarray, sigma: np.ndarray, size: float) -> dict:
    """Lengths of a pair, and whether Denavit and Hartenberg's may be used."""
    distance, normal, foot = (float(v) for v in value)
    known = {"distance": abs(distance), "distance_sigma": float(sigma[0])}
    if not np.isfinite(foot):
        return known | {"refused": "the axes are parallel: every common normal is as good as any other"}
    known |= {"normal": abs(normal), "foot": foot, "normal_sigma": float(sigma[1]), "foot_sigma": float(sigma[2])}
    reasons = []
    if abs(foot) > size:
        reasons.append(f"foot {abs(foot) / 1e3:.4g} m away, the arm is {size / 1e3:.3g} m long")
    if max(sigma[1:]) > USABLE_MM:
        reasons.append(f"σ {sigma[1]:.3g} mm of a and {sigma[2] / 1e3:.3g} m of the foot, {USABLE_MM:g} mm needed")
    if reasons:
        per_urad = abs(distance) / np.sin(angle) ** 2 * 1e-6
        reasons.append(f"axes {np.degrees(angle):.4f}° apart, 1 µrad moves the foot by {per_urad / 1e3:.3g} m")
    return known | {"refused": "; ".join(reasons)}


def _leave_one_out(
    data: Measurements, fits: list[AxisFit], nominal: Robot, passed: list[list[np.ndarray]]
) -> LeaveOneOut:
    """All axes again without each row; what comes after a changed axis is unwound and fitted again."""
    kinematic = data.q @ nominal.coupling.T
    start = [np.array(data.points())]
    for j, fit in enumerate(fits):
        start.append(_unwound(fit.world_from_axis, start[-1], kinematic[:, j], bool(nominal.prismatic[j]))[1])
    used = np.unique(np.concatenate([fit.rows for fit in fits]))
    instants = [rows for rows in _instants(data) if np.isin(rows, used).any()]
    if len(instants) > REFITTED:
        values = _by_influence(instants, fits, start, passed, nominal)
    else:
        values = np.array([_refitted(rows, fits, start, kinematic, nominal) for rows in instants])
    lines = tuple(int(data.lines[rows[0]]) for rows in instants)
    return LeaveOneOut(lines, values[:, :, 3], values[:, :, 4])


def _refitted(
    rows: list[int], fits: list[AxisFit], start: list[np.ndarray], kinematic: np.ndarray, nominal: Robot
) -> np.ndarray:
    """(n − 1, 6) of the pairs without these rows; nan where the rest determines no axis."""
    first = next(j for j, fit in enumerate(fits) if np.isin(fit.rows, rows).any())
    frames, points = [fit.world_from_axis for fit in fits[:first]], start[first]
    try:
        for j in range(first, len(fits)):
            frames.append(refit_axis(fits[j], points, np.array(rows)))
            points = _unwound(frames[j], points, kinematic[:, j], bool(nominal.prismatic[j]))[1]
        return _pair_values(frames, nominal).reshape(-1, 6)
    except (DegenerateError, ConvergenceError):
        return np.full((len(fits) - 1, 6), np.nan)


def _by_influence(
    instants: list[list[int]],
    fits: list[AxisFit],
    start: list[np.ndarray],
    passed: list[list[np.ndarray]],
    nominal: Robot,
) -> np.ndarray:
    """(r, n − 1, 6) of the pairs without each instant's rows, linear in what these change: a row left out is one whose
    residual is that by the others (Cook & Weisberg 1982, "Residuals and Influence in Regression")."""
    number = np.zeros(len(start[0]), int)
    for i, rows in enumerate(instants):
        number[rows] = i
    changes = []
    for fit, points, by in zip(fits, start, passed, strict=False):
        own = np.zeros((len(instants), len(fit.gain)))
        np.add.at(own, number[fit.rows], fit.influence(points[fit.rows]))
        for before, derivative in zip(changes, by, strict=True):
            own += before @ derivative.T
        changes.append(own)
    frames = [fit.world_from_axis for fit in fits]
    here = _pair_values(frames, nominal)
    slope = _jacobian(lambda f: _pair_values(f, nominal), frames, nominal)
    return (here + np.concatenate(changes, axis=1) @ slope.T).reshape(len(instants), -1, 6)


def _instants(data: Measurements) -> list[list[int]]:
    """Rows that were measured together: the same joint values, each reflector once."""
    instants, seen = {}, {}
    for row, (q, target) in enumerate(zip(data.q, data.targets, strict=True)):
        values = q.tobytes()
        seen[values, target] = seen.get((values, target), 0) + 1
        instants.setdefault((values, seen[values, target]), []).append(row)
    return list(instants.values())


def off_mm(fit: AxisFit) -> dict[int, float]:
    """How far each outlier (its row) is off its arc, the farthest first."""
    found = {}
    for row in fit.outliers:
        here = (fit.rows == row) & (fit.weights == 0)
        found[int(row)] = float(np.linalg.norm(fit.residuals[here], axis=1).max())
    return dict(sorted(found.items(), key=lambda item: -item[1]))


def _outliers_said(data: Measurements, fit: AxisFit) -> list[str]:
    """One line for each of a few outliers, one for all of many."""
    off, limit = off_mm(fit), f"{GROSS:g} σ is {GROSS * fit.sigma_mm:.2g} mm; left out"
    if len(off) <= FEW:
        return [
            f"line {data.lines[row]}, {called(data.targets[row])}: {size:.3g} mm off its arc about joint "
            f"{fit.joint + 1}, {limit}"
            for row, size in off.items()
        ]
    first = ", ".join(f"{data.lines[row]} ({size:.3g} mm)" for row, size in list(off.items())[:FEW])
    return [
        f"joint {fit.joint + 1}: {len(off)} of {len(set(fit.rows.tolist()))} rows are off their arcs, {limit}; the "
        f"farthest are lines {first}; all are in --json"
    ]


def _notes(data: Measurements, fits: list[AxisFit], robot: Robot, nominal: Robot) -> list[str]:
    notes = [
        f"joint {fit.joint + 1}: the weights of its points still change after {REWEIGHTINGS} rounds; look at them"
        for fit in fits
        if not fit.settled
    ]
    for fit in fits:
        notes += _outliers_said(data, fit)
        for arc in fit.near:
            notes.append(
                f"line {data.lines[arc.rows[0]]}, {called(arc.target)}: too close to the axis of joint "
                f"{fit.joint + 1} to tell of it; its arc is not used"
            )
    notes += _alone(data, fits)
    for i, (row, wanted) in enumerate(zip(robot.rows, nominal.rows, strict=True)):
        after = robot.rows[i if robot.convention == "standard" else min(i + 1, len(fits) - 1)]
        one_line = abs(np.sin(after.alpha)) < np.sin(PARALLEL_RAD) and abs(after.a) < ONE_LINE_MM
        if abs(row.theta - wanted.theta) > AGREES_RAD and not one_line:  # of one line with the next, theta is chance
            notes.append(
                f"joint {i + 1}: theta is {np.degrees(row.theta):.2f}°, {np.degrees(wanted.theta):.2f}° in the robot "
                "file: its zero position is elsewhere"
            )
    return notes


def _alone(data: Measurements, fits: list[AxisFit]) -> list[str]:
    """Of reflectors that are on no arc."""
    swept = {data.targets[row] for fit in fits for row in fit.rows.tolist()}
    notes = []
    for name in dict.fromkeys(data.targets):
        if name not in swept:
            rows = [i for i, target in enumerate(data.targets) if target == name]
            what = called(name) if name else "rows without a target, beside rows with one"
            notes.append(
                f"line {data.lines[rows[0]]}: {what}: on no arc of any joint ({len(rows)} rows), so that its place on "
                "the flange rests on these alone; name it as the others, or leave it out"
            )
    return notes
