"""Fits the axis of each joint to positions and orientations of a target along sweeps of single joints."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NoReturn

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.errors import DegenerateError, InputError
from stcal.geometry.arrays import rms
from stcal.geometry.least_squares import NormalEquations, minimise
from stcal.geometry.rigid import Rigid, align_rigid, skew
from stcal.geometry.robust import HUBER, huber_weights, robust_sigma
from stcal.robot.kinematics.measurements import Measurements
from stcal.robot.kinematics.robot_model import Robot

STILL_RAD = np.radians(1.5e-3)
"""Difference up to which joint values are equal: a controller shows 0.001°, and coupling adds two of them."""
STILL_MM = 2e-3
DISTINCT = {"revolute": 3, "prismatic": 2}
"""Number of positions that give an arc its radius and height, or a line its direction."""
STANDS_STILL_MM = 1.0
"""Motion of a reflector below which it stands still; sweeps move it by more, unless it is on the axis."""
GROSS = 6.0  # residual, in σ, beyond which a point is left out and named: 1 in 10⁷ of normal ones
NEAR_AXIS = 10.0
"""Radius, in σ of a point, below which an arc is of no use: noise biases radii by σ²/2r, a twentieth of σ here."""
ROUNDING = 1e-12  # relative size of the rounding error of coordinates
WEAK_RAD = 0.02  # σ of a direction beyond which an axis is not known; its covariance is valid for small angles only
MOTION = np.radians(2.0)
"""Largest difference of the observed motion from the joint's values, as a share of the radius or of the way."""
QUIET = 1e-3
"""Share of the largest arc below which residuals are too small to hide a gross error that bent the first axis."""
STARTS, REWEIGHTINGS = 60, 30
WEIGHTS_SETTLED = 1e-3
"""Change of the weights below which they have converged; it moves an axis by less than a thousandth of its σ."""
SINGULAR, TINY = 1e-10, 1e-300
"""Ratio of singular values below which arcs do not determine an axis; and a number that prevents division by 0."""
SHORTEST_MM, LONGEST_MM = 1.0, 10_000.0  # distances of virtual reflectors from the target that make sense
SEPARATOR = " point "


@dataclass(frozen=True, slots=True, eq=False)
class Arc:
    """Rows (indices into the measurements) of one reflector in one sweep of ``joint`` (from 0)."""

    joint: int
    target: str
    rows: np.ndarray


def find_arcs(data: Measurements, robot: Robot, still_rad: float = STILL_RAD) -> tuple[list[Arc], list[str]]:
    """Returns the arcs of all joints, rows of one reflector that differ in exactly one *kinematic* joint value, and
    notes on arcs not used. Positions a full turn apart are one only for the joint that turns. Raises InputError: no
    positions, a joint that is never swept, or a reflector that does not move."""
    names, places = np.array(data.targets), data.points()
    for target in dict.fromkeys(data.targets):
        points = places[names == target]
        far = float(np.quantile(np.linalg.norm(points - np.median(points, axis=0), axis=1), 0.9))
        if len(points) > 1 and far < STANDS_STILL_MM:
            near = f"90 % of its {len(points)} positions lie within {far:.3g} mm while the joints move"
            remedy = "a reflector on the flange, and each row's own measurement needed"
            raise InputError("E-TARGET-STILL", f"{data.where}: {called(target)} does not move: {near}; {remedy}")
    kinematic = data.q @ robot.coupling.T
    still = np.where(robot.prismatic, STILL_MM, still_rad)
    same = np.column_stack([_clusters(v, s) for v, s in zip(kinematic.T, still, strict=True)])
    arcs, notes = [], []
    for j, joint in enumerate(robot.joints):
        groups, least = defaultdict(list), DISTINCT[joint.type]
        for row, others in enumerate(np.delete(same, j, axis=1)):
            groups[data.targets[row], *others.tolist()].append(row)
        for (target, *_), rows in groups.items():
            places = kinematic[rows, j]
            if not robot.prismatic[j]:  # angles from the middle of their widest gap, so that no cluster lies across 0
                around = np.sort(np.mod(places, 2 * np.pi))
                gaps = np.diff(around, append=around[0] + 2 * np.pi)
                places = np.mod(places - around[gaps.argmax()] - gaps.max() / 2, 2 * np.pi)
            distinct = len(set(_clusters(places, still[j])))
            if distinct >= least:
                arcs.append(Arc(j, target, np.array(rows)))
            elif distinct > 1:
                which = f"joint {j + 1}, {called(target)}, line {data.lines[rows[0]]}"
                notes.append(f"{which}: an arc of {distinct} positions is not used, {least} needed")
    missing = sorted(set(range(len(robot.joints))) - {arc.joint for arc in arcs})
    if missing:
        names, least = ", ".join(str(j + 1) for j in missing), DISTINCT[robot.joints[missing[0]].type]
        lacking = f"no rows of one reflector differ in that joint alone, {least} or more positions needed"
        remedy = "measure its sweep, and if the controller couples joints, give `coupling` in the robot file"
        raise InputError("E-AXES-NO-SWEEP", f"{data.where}: joint {names} is never swept: {lacking}; {remedy}")
    return arcs, notes


def called(target: str) -> str:
    """Returns the name by which messages refer to a reflector."""
    return f"reflector {target}" if target else "the reflector"


def _clusters(values: np.ndarray, still: float) -> np.ndarray:
    """Returns the number of the cluster of each value; neighbours closer than ``still`` are in one cluster."""
    order = np.argsort(values)
    label = np.empty(len(values), int)
    label[order] = np.concatenate([[0], np.cumsum(np.diff(values[order]) > still)])
    return label


@dataclass(frozen=True, slots=True, eq=False)
class VirtualReflectors:
    """Virtual reflectors of poses. ``data`` : k rows for each of m poses; ``places`` : (k, 3) places of the reflectors
    in the target's frame, mm; ``pose`` : (km,) number of the pose of each row; ``lever`` : (km, 3) vectors from the
    reflectors' mean, of RMS length 1, in the instrument's frame."""

    data: Measurements
    places: np.ndarray
    pose: np.ndarray
    lever: np.ndarray

    def by_pose(self, response: np.ndarray) -> np.ndarray:
        """Returns the response (p, 6 m) to the noise of poses, given that (p, km, 3) to the noise of independent rows.
        A pose errs by a translation, and by a rotation that moves the reflectors as much (RMS)."""
        by_row = np.concatenate([np.broadcast_to(np.eye(3), (len(self.lever), 3, 3)), -skew(self.lever)], axis=2)
        shared = np.zeros((len(response), int(self.pose.max()) + 1, 6))
        np.add.at(shared.swapaxes(0, 1), self.pose, np.einsum("pmc,mcd->mpd", response, by_row))
        return np.sqrt(3 / 5) * shared.reshape(len(response), -1)

    def tools(self, places: dict[str, Rigid], spread_mm: dict[str, float]) -> tuple[dict[str, Rigid], dict[str, float]]:
        """Returns the poses of the targets from their reflectors' places, and the RMS about these places."""
        tools, spread = {}, {}
        for target in dict.fromkeys(name.rpartition(SEPARATOR)[0] for name in self.data.targets):
            names = [f"{target}{SEPARATOR}{i + 1}" for i in range(len(self.places))]
            tools[target] = align_rigid(np.array([places[each].translation for each in names]), self.places)
            spread[target] = rms(np.array([spread_mm[each] for each in names]))
        return tools, spread


def length_of(data: Measurements) -> float | None:
    """Returns the distance, mm, at which σ of rotations moves a point by σ of positions; None if no σ are stated."""
    if data.rotations is None or data.covariance is None:
        return None
    variance = np.einsum("mii->mi", np.asarray(data.covariance))
    rotation, position = variance[:, :3].mean(axis=1), variance[:, 3:].mean(axis=1)
    if not (rotation > 0).all():
        return None
    return float(np.clip(np.median(np.sqrt(position / rotation)), SHORTEST_MM, LONGEST_MM))


def ring(length_mm: float) -> np.ndarray:
    """Returns places (3, 3) at ``length_mm`` about the target's origin, in its XY plane; InputError if out of range."""
    if not SHORTEST_MM <= length_mm <= LONGEST_MM:
        needed = f"{SHORTEST_MM:g} to {LONGEST_MM:g} mm needed, auto or off"
        raise InputError("E-OPTION-RANGE", f"--orientations {length_mm:g}: {needed}")
    angles = 2 * np.pi / 3 * np.arange(3)
    return length_mm * np.column_stack([np.cos(angles), np.sin(angles), np.zeros(3)])


def virtual_reflectors(data: Measurements, places: np.ndarray) -> VirtualReflectors:
    """Returns reflectors carried at ``places`` (k, 3) of a target, mm; InputError without orientations."""
    m, k, rotations = len(data), len(places), data.poses().rotation
    about = places - places.mean(axis=0)
    lever = about / np.sqrt((about**2).sum(axis=1).mean())
    carried, lever = (np.einsum("mij,kj->mki", rotations, each).reshape(-1, 3) for each in (places, lever))
    row = np.repeat(np.arange(m), k)
    many = replace(data, rotations=None, covariance=None, common=None)[row]
    names = tuple(f"{target}{SEPARATOR}{n % k + 1}" for n, target in enumerate(many.targets))
    virtual = replace(many, targets=names, positions=many.points() + carried)
    return VirtualReflectors(virtual, places, row, lever)


@dataclass(frozen=True, eq=False)
class AxisFit:
    """The axis of one joint, by the distances of its arcs' points from circles or lines; p is 4 or, prismatic, 2.

    ``where`` : the joint, for messages; ``world_from_axis`` : z of this frame is the joint's positive direction; the
    origin lies on the axis, at the foot of the measured points' centroid; ``used`` : its arcs; ``near`` : arcs too
    close to the axis to be used; ``rows``, ``points`` : (k,), (k, 3) mm of each point of each arc, with the joints
    before this one unwound; ``member`` : (k, a) one-hot, the arc of each point; ``size`` : of the largest arc, mm;
    ``weights`` : (k,), 0 for gross errors; ``span`` : range of the joint's values, rad or mm; ``settled`` : whether the
    robust weights converged.
    """

    where: str
    prismatic: bool
    used: tuple[Arc, ...]
    rows: np.ndarray
    points: np.ndarray
    member: np.ndarray
    size: float
    weights: np.ndarray
    world_from_axis: Rigid
    near: tuple[Arc, ...] = ()
    span: float = np.nan
    settled: bool = False

    @property
    def joint(self) -> int:
        """Number of the joint, from 0."""
        return self.used[0].joint

    @property
    def arcs(self) -> tuple[str, ...]:
        """Reflector of each arc."""
        return tuple(arc.target for arc in self.used)

    @cached_property
    def local(self) -> np.ndarray:
        """The points (k, 3) in the axis's frame."""
        return (self.points - self.world_from_axis.translation) @ self.world_from_axis.rotation

    @cached_property
    def values(self) -> np.ndarray:
        """Values (k, 2) that are constant along an arc: radius and height, or the place across a line."""
        if self.prismatic:
            return self.local[:, :2]
        return np.column_stack([np.hypot(self.local[:, 0], self.local[:, 1]), self.local[:, 2]])

    def means(self, values: np.ndarray) -> np.ndarray:
        """Returns the weighted means (a, c) of values (k, c) by arc."""
        none = self.member @ (self.weights @ self.member) == 0  # of arcs without weights, the plain mean
        weighted = self.member * np.where(none, 1.0, self.weights)[:, None]
        return (weighted.T @ values) / weighted.sum(axis=0)[:, None]

    def demean(self, values: np.ndarray) -> np.ndarray:
        """Returns values (k, c) minus each arc's weighted mean: variable projection of its radius and height."""
        return values - self.member @ self.means(values)

    @property
    def radii(self) -> list[float]:
        """Radii (a,) of the arcs, mm; nan for a prismatic joint."""
        return (self.means(self.values)[:, 0] * (np.nan if self.prismatic else 1.0)).tolist()

    @property
    def heights(self) -> list[float]:
        """Heights (a,) of the arcs above the origin, mm; nan for a prismatic joint."""
        return (self.means(self.values)[:, 1] * (np.nan if self.prismatic else 1.0)).tolist()

    @cached_property
    def residuals(self) -> np.ndarray:
        """Residuals (k, 2) mm, radial and axial (across the line for a prismatic joint)."""
        return self.demean(self.values)

    @property
    def redundancy(self) -> int:
        """Number of redundant measured numbers."""
        kept = self.weights > 0
        return int(2 * kept.sum() - (2 if self.prismatic else 4) - 2 * (self.member[kept].any(axis=0)).sum())

    @cached_property
    def sigma_mm(self) -> float:
        """σ of one coordinate, mm."""
        return float(np.sqrt((self.weights[:, None] * self.residuals**2).sum() / max(self.redundancy, 1)))

    @cached_property
    def gain(self) -> np.ndarray:
        """Derivative (p, k, 3) of the axis (rx, ry rad, tx, ty mm in its own frame) by the points."""
        return np.einsum("kpv,kvc->pkc", self._inverse(), self._by_local() @ self.world_from_axis.rotation.T)

    @property
    def covariance(self) -> np.ndarray:
        """Covariance (p, p) of the axis by the noise of its own points, in its own frame."""
        return self.sigma_mm**2 * np.einsum("pkc,qkc->pq", self.gain, self.gain)

    @property
    def off_mm(self) -> dict[int, float]:
        """How far each row that is left out as a gross error is off its arc, mm, the farthest first."""
        length = np.where(self.weights == 0, np.linalg.norm(self.residuals, axis=1), 0.0)
        off = {int(row): float(length[self.rows == row].max()) for row in np.unique(self.rows[self.weights == 0])}
        return dict(sorted(off.items(), key=lambda item: -item[1]))

    @property
    def rms_mm(self) -> float:
        """RMS of a coordinate of the residuals of the points used, mm."""
        return rms(self.lengths()) / float(np.sqrt(2))

    def lengths(self) -> np.ndarray:
        """Returns the lengths (k',) of the residuals of the points used, mm."""
        return np.linalg.norm(self.residuals[self.weights > 0], axis=1)

    def influence(self, left_out: Sequence[Sequence[int]]) -> np.ndarray:
        """Returns the change (i, p) of the axis, linear, without each of i sets of rows (Cook & Weisberg 1982)."""
        step, jacobian = self._inverse(), self._jacobian()
        sums = np.maximum(self.member @ (self.weights @ self.member), TINY)
        changes = np.zeros((len(left_out), step.shape[1]))
        for change, rows in zip(changes, left_out, strict=True):
            at = np.isin(self.rows, rows)
            by_residual = np.concatenate([np.zeros((change.size, 0)), *step[at]], axis=1)
            kept = np.eye(by_residual.shape[1]) + jacobian[at].reshape(-1, change.size) @ by_residual
            kept -= np.diag(np.repeat((self.weights / sums)[at], 2))
            # singular where an arc rests on these points alone, which then say nothing of the axis
            change[:] = -by_residual @ np.linalg.lstsq(kept, self.residuals[at].ravel(), rcond=1e-9)[0]
        return changes

    def unwound(self, points: np.ndarray, value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the rotations (m, 3, 3) that undo the joint's values (m,), and points (m, 3) after that."""
        z, origin = self.world_from_axis.rotation[:, 2], self.world_from_axis.translation
        if self.prismatic:
            return np.broadcast_to(np.eye(3), (len(points), 3, 3)), points - value[:, None] * z
        turn = Rotation.from_rotvec(-value[:, None] * z).as_matrix()
        return turn, np.einsum("mij,mj->mi", turn, points - origin) + origin

    def solved(self, moved: np.ndarray | None) -> "AxisFit":
        """Returns the fit by iterated Huber weights, without gross errors; ``moved`` : (m,) joint values, if needed."""
        if self.redundancy < 1:
            few = f"{len(self.rows)} positions on {len(self.used)} arcs leave no redundancy"
            self._undetermined(f"{few}; another position or a second reflector needed", "E-AXES-FEW")
        fit = self
        if moved is not None:  # weights before the first step, which a gross error would lead astray
            fit = self._started(moved[self.rows])
            fit = replace(fit, weights=fit._robust()[2])
        for gross in (np.inf, GROSS):
            for _ in range(REWEIGHTINGS):
                fit = fit._descended()
                length, sigma, huber = fit._robust()
                new = replace(fit, weights=np.where(length > gross * sigma, 0.0, huber))
                weights = new.weights if new.redundancy > 0 else huber
                settled = bool(np.abs(weights - fit.weights).max() < WEIGHTS_SETTLED)
                fit = replace(fit, weights=weights, settled=settled)
                if settled:
                    break
        fit = fit._descended()
        fit._require_known()
        return fit

    def _started(self, moved: np.ndarray) -> "AxisFit":
        """Returns the axis from all points, or from the subset (less one point or value) of least median."""
        count, sets = len(self.rows), [np.ones(len(self.rows))]
        for each in (np.arange(count), np.unique(moved, return_inverse=True)[1]):
            groups = each % STARTS
            sets += [groups != out for out in np.unique(groups) if each.max() > 1]
        tried = []
        for subset in sets:
            fit = replace(self, weights=np.asarray(subset, float))
            fit = replace(fit, world_from_axis=fit._linear_start())
            length, sigma, _ = fit._robust()
            if not tried and length.max() <= min(GROSS * sigma, QUIET * self.size):
                return fit
            tried.append((float(np.median(length)), fit))
        return min(tried, key=lambda each: each[0])[1]

    def _linear_start(self) -> Rigid:
        """Returns the axis by the arcs' common scatter and the circles' common centre (Kåsa 1976)."""
        centred = self.demean(self.points)
        _, axes = np.linalg.eigh((self.weights[:, None] * centred).T @ centred)
        x, z = (axes[:, 0], axes[:, 2]) if self.prismatic else (axes[:, 2], axes[:, 0])
        middle, frame = self.points.mean(axis=0), np.column_stack([x, np.cross(z, x), z])
        if self.prismatic:
            return Rigid(frame, middle)
        flat = (self.points - middle) @ frame[:, :2]
        # |x|² − 2 c·x is the same all along a circle about c
        root = np.sqrt(self.weights)
        square = self.demean((flat**2).sum(axis=1, keepdims=True))[:, 0]
        centre = np.linalg.lstsq(2 * root[:, None] * self.demean(flat), root * square, rcond=None)[0]
        return Rigid(frame, middle + frame[:, :2] @ centre)

    @property
    def _floor(self) -> float:
        return ROUNDING * max(np.abs(self.points).max(), self.size)

    def _robust(self) -> tuple[np.ndarray, float, np.ndarray]:
        """Returns the residuals' lengths (k,), σ of one coordinate by their median, mm, and Huber weights (k,)."""
        length = np.linalg.norm(self.residuals, axis=1)
        redundancy = replace(self, weights=np.ones(len(length))).redundancy / (2 * len(length))
        sigma = max(robust_sigma(length, 2, redundancy), self._floor)
        return length, sigma, huber_weights(length, HUBER * sigma)

    def _by_local(self) -> np.ndarray:
        """Returns the derivative (k, 2, 3) of the values by the points in the axis's frame."""
        by_local = np.zeros((len(self.local), 2, 3))
        by_local[:, 0, 0] = by_local[:, 1, 1 if self.prismatic else 2] = 1.0
        if not self.prismatic:
            across = self.local[:, :2]
            by_local[:, 0, :2] = across / np.maximum(np.hypot(*across.T), TINY)[:, None]
        return by_local

    def _jacobian(self) -> np.ndarray:
        """Returns the derivative (k, 2, p) of the residuals by rx, ry, tx, ty of the axis in its own frame."""
        by_axis = self._by_local() @ -_motions(self.local, np.eye(3), self.prismatic)
        return self.demean(by_axis.reshape(len(by_axis), -1)).reshape(by_axis.shape)

    def _inverse(self) -> np.ndarray:
        """Returns the matrices (k, p, 2) by which residuals become the Gauss-Newton step."""
        jacobian = self._jacobian()
        p, root = jacobian.shape[2], np.repeat(np.sqrt(self.weights), 2)
        unit = np.array([1 / self.size, 1 / self.size, 1.0, 1.0])[:p]
        u, s, vt = np.linalg.svd(root[:, None] * jacobian.reshape(-1, p) * unit, full_matrices=False)
        if s[-1] <= SINGULAR * s[0]:
            self._undetermined("its arcs do not determine an axis; sweep further, or with reflectors farther apart")
        return -np.moveaxis((unit[:, None] * (vt.T / s) @ u.T * root).reshape(p, -1, 2), 1, 0)

    def _undetermined(self, said: str, code: str = "E-AXES-UNDETERMINED") -> NoReturn:
        raise DegenerateError(code, f"{self.where}: {said}")

    def _descended(self) -> "AxisFit":
        """Returns the axis of least squares with these weights."""
        self._inverse()  # refuses arcs that determine no axis
        twists, root = np.eye(6)[[0, 1] if self.prismatic else [0, 1, 3, 4]], np.sqrt(np.repeat(self.weights, 2))

        def linearise(frame: Rigid) -> NormalEquations:
            fit = replace(self, world_from_axis=frame)
            slope = fit._jacobian().reshape(len(root), -1)
            return NormalEquations.of(root * fit.residuals.ravel(), root[:, None] * slope)

        def moved(frame: Rigid, step: np.ndarray) -> Rigid:
            """Returns the moved frame with its origin at the foot of the points' centroid."""
            frame = frame @ Rigid.exp(step @ twists)
            shift = frame.inverse() @ self.points.mean(axis=0)
            return Rigid(frame.rotation, frame @ (shift if self.prismatic else shift * [0, 0, 1]))

        minimum = minimise(self.world_from_axis, linearise, moved, least_gain=self._floor**2)
        found = minimum.required(f"{self.where}: axis", "are these single-joint sweeps?").state
        return replace(self, world_from_axis=found)

    def _require_known(self) -> None:
        """Refuses an axis whose σ is too large for its linear covariance."""
        if not self.prismatic and max(self.radii) <= NEAR_AXIS * self.sigma_mm:
            self._undetermined(ON_AXIS.format(self.size))
        sigma, most_mm = self.sigma_mm * np.linalg.norm(self.gain, axis=2), WEAK_RAD * self.size * 10
        direction, place = np.linalg.norm(sigma[:2]), np.linalg.norm(sigma[2:])
        if direction <= WEAK_RAD and place <= most_mm:
            return
        fault = f"σ of the direction of its axis is {np.degrees(direction):.2g}° and of its place {place:.2g} mm"
        needed = f"{np.degrees(WEAK_RAD):.1f}° and {most_mm:.2g} mm needed"
        remedy = "check that each position was measured anew; sweep further, or with reflectors farther apart"
        self._undetermined(f"{fault}, {needed}; {remedy}")

    def oriented(self, moved: np.ndarray) -> "AxisFit":
        """Returns the axis with z along positive motion; refuses motion that does not match the values (m,)."""
        moved, axis = moved[self.rows], self.world_from_axis
        ways = [replace(self, world_from_axis=Rigid(axis.rotation * [1, s, s], axis.translation)) for s in (1, -1)]
        off = [np.linalg.norm(self.demean(way.unwound(self.points, moved)[1]), axis=1) for way in ways]
        turned = int(np.argmin([self.weights @ each**2 for each in off]))
        way_mm = np.ptp(moved) if self.prismatic else self.values[:, 0]
        wrong = (off[turned] > MOTION * way_mm + GROSS * self.sigma_mm) & (self.weights > 0)
        if wrong.any():
            remedy = "check the column's unit, the coupling in the robot file, and that positions and rows match"
            fault = f"{self.where}: the motion seen is off its values by up to {off[turned][wrong].max():.3g} mm"
            raise InputError("E-AXES-JOINT-VALUES", f"{fault}; {remedy}")
        return replace(ways[turned], span=float(np.ptp(moved)))


def _motions(xyz: np.ndarray, axes: np.ndarray, sliding: bool) -> np.ndarray:
    """Returns the motions (m, 3, p) of points (m, 3) with a frame of ``axes`` at the origin, by its rx, ry, tx, ty."""
    across = np.broadcast_to(axes[:, :2], (len(xyz), 3, 2))
    turning = -skew(xyz) @ across
    return turning if sliding else np.concatenate([turning, across], axis=2)


ON_AXIS = (
    "all reflectors stay within {:.3g} mm of one place while it moves, so close to its axis that they say nothing "
    "about it; put a reflector off the axis"
)


def fit_axis(points: np.ndarray, moved: np.ndarray, arcs: list[Arc], prismatic: bool, where: str) -> AxisFit:
    """Returns the axis of a joint by robust least squares of the distances of its arcs' points to circles or lines.
    ``points`` : (m, 3) of all rows, mm, with the joints before this one unwound; ``moved`` : (m,) kinematic values of
    this joint; ``where`` : the joint, for messages. Raises DegenerateError: no redundancy, reflectors on the axis, or
    arcs too short to give a direction. Raises InputError: a motion that is not that of the joint's values."""
    size = np.array([np.linalg.norm(p - p.mean(axis=0), axis=1).max() for p in (points[arc.rows] for arc in arcs)])
    if size.max() <= ROUNDING * max(np.abs(points).max(), 1.0) * 1e3:
        raise DegenerateError("E-AXES-UNDETERMINED", f"{where}: {ON_AXIS.format(size.max())}")

    def of(use: np.ndarray, start: Rigid) -> AxisFit:
        """Returns the fit to these arcs at its start, with equal weights."""
        used = tuple(arcs[i] for i in np.flatnonzero(use))
        rows, largest = np.concatenate([arc.rows for arc in used]), float(size[use].max())
        member = np.repeat(np.eye(len(used)), [len(arc.rows) for arc in used], axis=0)
        return AxisFit(where, prismatic, used, rows, points[rows], member, largest, np.ones(len(rows)), start)

    fit = of(np.ones(len(arcs), bool), Rigid()).solved(moved)
    near = (np.array(fit.radii) <= NEAR_AXIS * fit.sigma_mm) & (fit.member.T @ fit.weights > 0)
    if near.any():
        fit = of(~near, fit.world_from_axis).solved(None)
    return replace(fit.oriented(moved), near=tuple(arcs[i] for i in np.flatnonzero(near)))


def fit_axes(
    data: Measurements, robot: Robot, arcs: list[Arc], virtual: VirtualReflectors | None = None
) -> tuple[list[AxisFit], np.ndarray, np.ndarray, np.ndarray]:
    """Returns the fits in order, their common covariance, the points with all joints unwound, and the derivatives (P,
    P) of the parameters of all axes by those of each joint's own fit, which axes after it inherit by unwinding. The
    covariance counts a row once, however many sweeps it belongs to, and a pose once for all its reflectors."""
    kinematic = data.q @ robot.coupling.T
    points, m, count = np.array(data.points()), len(data), int(np.where(robot.prismatic, 2, 4).sum())
    turned = np.broadcast_to(np.eye(3), (m, 3, 3))  # rotation of the noise by unwinding
    fits, by_noise, by_before = [], np.zeros((count, m, 3)), np.zeros((count, count))
    inherited = np.zeros((m, 3, 0))  # derivatives of the unwound points by the axes before
    for j, sliding in enumerate(robot.prismatic):
        joint_arcs = [arc for arc in arcs if arc.joint == j]
        fit = fit_axis(points, kinematic[:, j], joint_arcs, bool(sliding), f"{data.where}: joint {j + 1}")
        begin = inherited.shape[2]
        own = slice(begin, begin + len(fit.gain))
        noise = fit.sigma_mm * np.einsum("pkc,kcd->kpd", fit.gain, turned[fit.rows])
        np.add.at(by_noise[own].swapaxes(0, 1), fit.rows, noise)  # a row may belong to several arcs
        by_before[own, :begin] = np.einsum("pkc,kcq->pq", fit.gain, inherited[fit.rows])
        axis, (turn, after) = fit.world_from_axis, fit.unwound(points, kinematic[:, j])
        # The unwound points change with rx, ry, tx, ty of the axis: δ = D(U x) − U(D x).
        before, later = (_motions(xyz - axis.translation, axis.rotation, fit.prismatic) for xyz in (points, after))
        inherited = np.concatenate([turn @ inherited, later - turn @ before], axis=2)
        fits.append(fit)
        points, turned = after, turn @ turned
    passed = np.linalg.inv(np.eye(count) - by_before)
    response = np.einsum("pq,qmc->pmc", passed, by_noise)
    stacked = response.reshape(count, -1) if virtual is None else virtual.by_pose(response)
    return fits, stacked @ stacked.T, points, passed
