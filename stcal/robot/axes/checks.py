"""Relations of consecutive axes, checks of measured axes against the nominal robot, leave-one-out, and remarks."""

from dataclasses import dataclass
from itertools import chain, combinations, pairwise

import numpy as np

from stcal.errors import ConvergenceError, DegenerateError, InputError
from stcal.geometry.rigid import Rigid
from stcal.robot.axes.fit import GROSS, REWEIGHTINGS, AxisFit, unwound_by
from stcal.robot.axes.sweeps import called
from stcal.robot.identification.adjustment import State, observed
from stcal.robot.identification.unexplained import moved_meanwhile
from stcal.robot.kinematics.dh import PARALLEL_RAD, robot_from_chain
from stcal.robot.kinematics.forward import joint_frames
from stcal.robot.kinematics.measurements import Measurements
from stcal.robot.kinematics.robot_model import Chain, Robot

USABLE_MM = 1.0
"""σ of a common normal's length or foot beyond which the Denavit–Hartenberg value is refused: arms repeat to 0.1 mm."""
STEP_RAD, STEP_MM = 1e-7, 1e-4
"""Steps of central differences: far above rounding, and small against angles to which an axis is known."""
EXACTLY = 1e-12
"""Sine of the angle of two axes below which rounding alone decides where their common normal is."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Pair:
    """Two consecutive axes, ``joint`` (from 1) and the next; mm, rad; None along prismatic joints.

    ``angle_rad`` : between the axes; ``distance_mm`` : of the next axis from this one, for near-parallel pairs in the
    plane across this axis that the robot's rows define, else along the common normal; ``parallel`` : the rows have
    Hayati's β; ``normal_mm``, ``foot_mm`` : length of the common normal, and position of its foot on this axis, from
    where the axis was measured; ``refused`` : why a row of Denavit and Hartenberg must not be used, or "".
    """

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


def chain_through(frames: list[Rigid], nominal: Robot) -> Chain:
    """Returns the chain through the axes; the flange is the last joint's frame."""
    gaps = [frames[0], *(a.inverse() @ b for a, b in pairwise(frames))]
    rotation, translation = np.array([g.rotation for g in gaps]), np.array([g.translation for g in gaps])
    return Chain(rotation, translation, Rigid(), nominal.prismatic, nominal.coupling)


def jacobian_by_axes(function, frames: list[Rigid], robot: Robot) -> np.ndarray:
    """Returns the derivative (v, p) of a function of the axes by their parameters, each in its own frame."""
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


def sigma_of(jacobian: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Returns σ (v,) of values from their ``jacobian`` (v, p) by parameters with this covariance (p, p)."""
    return np.sqrt(np.maximum(np.einsum("vp,pq,vq->v", jacobian, covariance, jacobian), 0))


def pair_values(frames: list[Rigid], nominal: Robot) -> np.ndarray:
    """Returns values (6 (n − 1),) of the pairs: the acute angle as a vector (3), the rows' distance, and the common
    normal's length and foot from the axis's origin (nan with a prismatic joint)."""
    robot = robot_from_chain(chain_through(frames, nominal), {}, nominal)
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
    return values.ravel()


def pairs_of(frames: list[Rigid], covariance: np.ndarray, robot: Robot) -> tuple[Pair, ...]:
    """Returns the pairs of consecutive axes with their σ; ``robot`` gives planes of near-parallel pairs."""
    if len(frames) < 2:
        return ()
    values = pair_values(frames, robot).reshape(-1, 6)
    jacobians = jacobian_by_axes(lambda f: pair_values(f, robot), frames, robot).reshape(len(values), 6, -1)
    size = sum(abs(row.a) + abs(row.d) for row in robot.rows)
    pairs = []
    for i, (value, jacobian) in enumerate(zip(values, jacobians, strict=True)):
        acute = float(np.linalg.norm(value[:3]))
        opposed = frames[i].rotation[:, 2] @ frames[i + 1].rotation[:, 2] < 0
        lengths = {}
        if np.isfinite(value[3]):
            lengths = _lengths(acute, value[3:], sigma_of(jacobian[3:], covariance), size)
        spread = (
            jacobian[:3] @ covariance @ jacobian[:3].T
        )  # of the angle's vector; of exactly parallel axes its largest
        variance = np.linalg.eigvalsh(spread)[-1] if acute <= EXACTLY else value[:3] @ spread @ value[:3] / acute**2
        pair = Pair(
            joint=i + 1,
            angle_rad=np.pi - acute if opposed else acute,
            angle_sigma_rad=float(np.sqrt(max(variance, 0))),
            parallel=bool(np.sin(acute) < np.sin(PARALLEL_RAD)),
            **lengths,
        )
        pairs.append(pair)
    return tuple(pairs)


def _lengths(angle: float, value: np.ndarray, sigma: np.ndarray, size: float) -> dict:
    """Returns the lengths of a pair, and why Denavit and Hartenberg's must not be used, if so."""
    distance, normal, foot = (float(v) for v in value)
    lengths = {"distance_mm": abs(distance), "distance_sigma_mm": float(sigma[0])}
    if not np.isfinite(foot):
        return lengths | {"refused": "the axes are parallel: every common normal is as good as any other"}
    lengths |= {"normal_mm": abs(normal), "foot_mm": foot}
    lengths |= {"normal_sigma_mm": float(sigma[1]), "foot_sigma_mm": float(sigma[2])}
    reasons = []
    if abs(foot) > size:
        reasons.append(f"foot {abs(foot) / 1e3:.4g} m away, the arm is {size / 1e3:.3g} m long")
    if max(sigma[1:]) > USABLE_MM:
        reasons.append(f"σ {sigma[1]:.3g} mm of a and {sigma[2] / 1e3:.3g} m of the foot, {USABLE_MM:g} mm needed")
    if reasons:
        per_urad = abs(distance) / np.sin(angle) ** 2 * 1e-6
        reasons.append(f"axes {np.degrees(angle):.4f}° apart, 1 µrad moves the foot by {per_urad / 1e3:.3g} m")
    return lengths | {"refused": "; ".join(reasons)}


LIKELY, MANY = 2.0, 4
"""Factor by which a mirror may fit worse than reversed joints, and number of these from which on they are not tried."""
LIKE_SIZE = 2.0
"""Largest ratio of the distances between axes to the nominal ones, or of these to them; wrong units differ by more."""
AGREES_RAD = np.radians(10.0)
"""Largest difference of axes and joint zeros from a nominal robot that is the same, and counts alike."""
MOVED_SHARE = 0.5
"""Share of the squared residuals beyond which a move along the order of the rows is named."""


def _shape(z: np.ndarray, origin: np.ndarray, sliding: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns cosines, moments and triple products of directed axes, and their signs after a mirror."""
    size = max(float(np.linalg.norm(origin - origin[0], axis=1).max()), 1.0)
    values, mirrored = [], []
    for i, k in combinations(range(len(z)), 2):
        values.append(z[i] @ z[k])
        mirrored.append(1 if sliding[i] == sliding[k] else -1)
        if not sliding[i] and not sliding[k]:
            values.append((origin[k] - origin[i]) @ np.cross(z[i], z[k]) / size)
            mirrored.append(-1)
    for three in combinations(range(len(z)), 3):
        a, b, c = z[list(three)]
        values.append(a @ np.cross(b, c))
        mirrored.append(-1 if sliding[list(three)].sum() % 2 else 1)
    return np.array(values), np.array(mirrored)


def _distances(z: np.ndarray, origin: np.ndarray, sliding: np.ndarray) -> np.ndarray:
    """Returns the distance of every two revolute axes; for two nearly parallel ones, the distance across them."""
    distances = []
    for i, k in combinations(np.flatnonzero(~sliding), 2):
        between, normal = origin[k] - origin[i], np.cross(z[i], z[k])
        sine = np.linalg.norm(normal)
        parallel = sine < np.sin(AGREES_RAD)
        distances.append(np.linalg.norm(np.cross(between, z[i])) if parallel else abs(between @ normal) / sine)
    return np.array(distances)


def require_like_nominal(where: str, frames: list[Rigid], nominal: Robot) -> None:
    """Refuses mirrored positions, joints with reversed sign, and an arm of another build."""
    rotation, origin = joint_frames(nominal.chain(), np.zeros((1, len(frames))))
    wanted, directions = rotation[:, 0, :, 2], np.array([f.rotation[:, 2] for f in frames])
    places = np.array([f.translation for f in frames])
    shape, _ = _shape(wanted, origin[:, 0], nominal.prismatic)
    values, mirror = _shape(directions, places, nominal.prismatic)
    as_it_is, mirrored = (float(np.linalg.norm(v - shape)) for v in (values, values * mirror))
    every, reversed_ = np.arange(len(frames)), {}
    for flipped in chain.from_iterable(combinations(range(len(frames)), k) for k in range(1, MANY)):
        sign = np.where(np.isin(every, flipped), -1.0, 1.0)[:, None]
        reversed_[flipped] = np.linalg.norm(_shape(directions * sign, places, nominal.prismatic)[0] - shape)
    best = min(reversed_, key=lambda flipped: reversed_[flipped])
    if mirrored < as_it_is / 2 and mirrored <= LIKELY * reversed_[best]:
        raise InputError(
            "E-AXES-MIRRORED",
            f"{where}: the axes are the mirror image of robot {nominal.name}'s: positions of a left-handed frame (or "
            "joints that count the other way); swap two columns of x, y, z or change the sign of one",
        )
    if reversed_[best] < as_it_is / 2:
        named = ", ".join(str(i + 1) for i in best)
        raise InputError(
            "E-AXES-SIGN",
            f"{where}: joint {named} counts against robot {nominal.name}'s; correct alpha in the robot file or "
            "the sign of its values",
        )
    apart, right = (
        _distances(z, o, nominal.prismatic).sum() for z, o in ((directions, places), (wanted, origin[:, 0]))
    )
    if right > 0 and not 1 / LIKE_SIZE < apart / right < LIKE_SIZE:
        raise InputError(
            "E-AXES-UNITS",
            f"{where}: the axes lie {apart / right:.3g} times as far apart as robot {nominal.name}'s; check the unit "
            "of x, y, z, and the lengths in the robot file",
        )
    for i in range(len(frames) - 1):
        angle, right = (np.degrees(np.arccos(np.clip(z[i] @ z[i + 1], -1, 1))) for z in (directions, wanted))
        if abs(angle - right) > np.degrees(AGREES_RAD):
            raise InputError(
                "E-AXES-ANGLE",
                f"{where}: axes of joints {i + 1} and {i + 2} are {angle:.1f}° apart, {right:.1f}° in robot "
                f"{nominal.name}; correct its alpha or theta, or the sign with which a joint counts",
            )


FEW = 3
"""Largest number of outliers of a joint that are named one by one."""
ONE_LINE_MM = 10.0
"""Largest distance between axes that are meant to be one line, such as those of a SCARA's spindle."""


def off_mm(fit: AxisFit) -> dict[int, float]:
    """Returns how far each outlier (by its row) is off its arc, mm, the farthest first."""
    distances = {}
    for row in fit.outliers:
        of_row = (fit.rows == row) & (fit.weights == 0)
        distances[int(row)] = float(np.linalg.norm(fit.residuals[of_row], axis=1).max())
    return dict(sorted(distances.items(), key=lambda item: -item[1]))


def remarks(measured: Measurements, data: Measurements, fits: list[AxisFit], robot: Robot, nominal: Robot) -> list[str]:
    """Returns remarks on the axes, their robot, and moves between the rows ``measured``, ``data`` with virtual ones."""
    notes = [
        f"joint {fit.joint + 1}: the weights of its points still change after {REWEIGHTINGS} rounds; look at them"
        for fit in fits
        if not fit.settled
    ]
    for fit in fits:
        off_arc, limit = off_mm(fit), f"{GROSS:g} σ is {GROSS * fit.sigma_mm:.2g} mm; left out"
        if len(off_arc) > FEW:
            first = ", ".join(f"{data.lines[row]} ({size:.3g} mm)" for row, size in list(off_arc.items())[:FEW])
            notes.append(
                f"joint {fit.joint + 1}: {len(off_arc)} of {len(set(fit.rows.tolist()))} rows are off their arcs, "
                f"{limit}; the farthest are lines {first}; all are in --json"
            )
            off_arc = {}
        notes += [
            f"line {data.lines[row]}, {called(data.targets[row])}: {size:.3g} mm off its arc about joint "
            f"{fit.joint + 1}, {limit}"
            for row, size in off_arc.items()
        ]
        notes += [
            f"line {data.lines[arc.rows[0]]}, {called(arc.target)}: too close to the axis of joint {fit.joint + 1} to "
            "tell of it; its arc is not used"
            for arc in fit.near
        ]
    swept = {data.targets[row] for fit in fits for row in fit.rows.tolist()}
    for name in dict.fromkeys(each for each in data.targets if each not in swept):
        rows = [i for i, target in enumerate(data.targets) if target == name]
        what = called(name) if name else "rows without a target, beside rows with one"
        notes.append(
            f"line {data.lines[rows[0]]}: {what}: on no arc of any joint ({len(rows)} rows), so that its place on the "
            "flange rests on these rows alone; name it like the others, or leave it out"
        )
    for i, (row, wanted) in enumerate(zip(robot.rows, nominal.rows, strict=True)):
        after = robot.rows[i if robot.convention == "standard" else min(i + 1, len(fits) - 1)]
        one_line = abs(np.sin(after.alpha)) < np.sin(PARALLEL_RAD) and abs(after.a) < ONE_LINE_MM
        if abs(row.theta - wanted.theta) > AGREES_RAD and not one_line:  # on one line theta is arbitrary
            notes.append(
                f"joint {i + 1}: theta is {np.degrees(row.theta):.2f}°, {np.degrees(wanted.theta):.2f}° in the robot "
                "file: its zero position differs"
            )
    # Gear errors vary with the order of rows too: a move is named only if it explains most of the residuals.
    moved = moved_meanwhile(State(robot.chain(), dict(robot.tools)), observed(measured, "position"), MOVED_SHARE)
    return notes if moved is None else [*notes, moved.sentence()]


REFITTED = 200
"""Largest number of rows of which each is left out by a new fit; of more, by influence, which is 1 to 4 % less."""


@dataclass(frozen=True, slots=True, eq=False)
class LeaveOneOut:
    """The values of each pair without one row of the sweeps. ``lines`` : first line of each row left out; ``distance``,
    ``normal`` : (r, n − 1) mm, as in :class:`Pair`, or nan."""

    lines: tuple[int, ...]
    distance: np.ndarray
    normal: np.ndarray

    def spread(self, name: str) -> np.ndarray:
        """Returns the largest minus the smallest ``distance`` or ``normal``, (n − 1,); nan where there is none."""
        values = getattr(self, name)
        known = np.isfinite(values)
        high, low = np.where(known, values, -np.inf).max(axis=0), np.where(known, values, np.inf).min(axis=0)
        return np.where(known.any(axis=0), high - low, np.nan)


def leave_one_out(
    data: Measurements, fits: list[AxisFit], nominal: Robot, passed: list[list[np.ndarray]]
) -> LeaveOneOut:
    """Returns the values without each row; what comes after a changed axis is unwound and fitted again."""
    kinematic, sliding = data.q @ nominal.coupling.T, nominal.prismatic.tolist()
    start = [np.array(data.points())]
    for j, fit in enumerate(fits):
        start.append(unwound_by(fit.world_from_axis, start[-1], kinematic[:, j], sliding[j])[1])

    def refitted(rows: list[int]) -> np.ndarray:
        """Returns the values (n − 1, 6) without these rows; nan if the remaining rows determine no axis."""
        first = next(j for j, fit in enumerate(fits) if np.isin(fit.rows, rows).any())
        frames, points = [fit.world_from_axis for fit in fits[:first]], start[first]
        try:
            for j in range(first, len(fits)):
                frames.append(fits[j].without(points, rows))
                points = unwound_by(frames[j], points, kinematic[:, j], sliding[j])[1]
            return pair_values(frames, nominal).reshape(-1, 6)
        except (DegenerateError, ConvergenceError):
            return np.full((len(fits) - 1, 6), np.nan)

    used = np.unique(np.concatenate([fit.rows for fit in fits]))
    instants = [rows for rows in _instants(data) if np.isin(rows, used).any()]
    if len(instants) > REFITTED:
        values = _by_influence(instants, fits, passed, nominal)
    else:
        values = np.array([refitted(rows) for rows in instants])
    lines = tuple(int(data.lines[rows[0]]) for rows in instants)
    return LeaveOneOut(lines, values[:, :, 3], values[:, :, 4])


def _by_influence(
    instants: list[list[int]], fits: list[AxisFit], passed: list[list[np.ndarray]], nominal: Robot
) -> np.ndarray:
    """Returns the pairs' values (r, n − 1, 6) without each instant's rows, to first order (Cook & Weisberg 1982)."""
    number = {row: i for i, rows in enumerate(instants) for row in rows}
    changes = []
    for fit, derivatives in zip(fits, passed, strict=True):
        change = np.zeros((len(instants), len(fit.gain)))
        np.add.at(change, [number[row] for row in fit.rows.tolist()], fit.influence())
        for before, derivative in zip(changes, derivatives, strict=True):
            change += before @ derivative.T
        changes.append(change)
    frames = [fit.world_from_axis for fit in fits]
    values = pair_values(frames, nominal)
    slope = jacobian_by_axes(lambda f: pair_values(f, nominal), frames, nominal)
    return (values + np.concatenate(changes, axis=1) @ slope.T).reshape(len(instants), -1, 6)


def _instants(data: Measurements) -> list[list[int]]:
    """Returns the groups of rows that were measured together: the same joint values, each reflector once."""
    instants, counts = {}, {}
    for row, (q, target) in enumerate(zip(data.q, data.targets, strict=True)):
        values = q.tobytes()
        counts[values, target] = counts.get((values, target), 0) + 1
        instants.setdefault((values, counts[values, target]), []).append(row)
    return list(instants.values())
