"""Fits the axis of a joint to positions and orientations of a target along sweeps, with full turns unwound."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.errors import DegenerateError, InputError
from stcal.geometry.arrays import rms
from stcal.geometry.least_squares import NormalEquations, minimise
from stcal.geometry.rigid import Rigid
from stcal.geometry.robust import HUBER, huber_weights, robust_sigma
from stcal.robot.axes.sweeps import Arc, VirtualReflectors
from stcal.robot.kinematics.measurements import Measurements
from stcal.robot.kinematics.robot_model import Robot

GROSS = 6.0
"""Residual, in σ, beyond which a point is left out and named: 1 in 10⁷ of normal ones."""
NEAR_AXIS = 10.0
"""Radius, in σ of a point, below which an arc is of no use: noise biases radii by σ²/2r, a twentieth of σ here."""
ROUNDING = 1e-12
"""Relative size of the rounding error of coordinates."""
STANDS_STILL_MM = 1.0
"""Motion of a reflector below which it stands still; sweeps move it by more, unless it is on the axis."""
WEAK_RAD = 0.02
"""σ of a direction beyond which an axis is not known; its covariance is valid for small angles only."""
MOTION = np.radians(2.0)
"""Largest difference of the observed motion from the joint's values, or share of a sliding joint's way."""
LONGER = "sweep further, or with reflectors farther apart"
QUIET = 1e-3
"""Share of the largest arc below which residuals are too small to hide a gross error that bent the first axis."""
STARTS, REWEIGHTINGS = 60, 30
WEIGHTS_SETTLED = 1e-3
"""Change of the weights below which they have converged; it moves an axis by less than a thousandth of its σ."""
SINGULAR, TINY = 1e-10, 1e-300
"""Ratio of singular values below which arcs do not determine an axis; and a number that prevents division by 0."""
FIRST_SIZE = 0.05
"""Size of an arc, as a share of the largest, from which on it is used for the first axis."""


@dataclass(frozen=True, eq=False, kw_only=True)
class AxisFit:
    """The axis of one joint, by the distances of its arcs' points from circles or lines; p is 4 or, prismatic, 2.

    ``where`` : the joint, for messages; ``world_from_axis`` : z of this frame is the joint's positive direction; the
    origin lies on the axis, at the foot of the measured points' centroid; ``arcs`` : those used; ``near`` : arcs too
    close to the axis to be used; ``rows``, ``points`` : (k,), (k, 3) mm of each point of each arc, with the joints
    before this one unwound; ``member`` : (k, a) one-hot, the arc of each point; ``size`` : of the largest arc, mm;
    ``weights`` : (k,), 0 for gross errors; ``span`` : range of the joint's values, rad or mm; ``settled`` : whether the
    robust weights converged.
    """

    where: str
    prismatic: bool
    arcs: tuple[Arc, ...]
    rows: np.ndarray
    points: np.ndarray
    member: np.ndarray
    size: float
    weights: np.ndarray
    world_from_axis: Rigid
    near: tuple[Arc, ...] = ()
    span: float = np.nan
    settled: bool = False

    @classmethod
    def of(cls, points: np.ndarray, arcs: Sequence[Arc], prismatic: bool, where: str, start: Rigid) -> "AxisFit":
        """Returns the fit at its start: points (m, 3) of all rows, of equal weights."""
        rows = np.concatenate([arc.rows for arc in arcs])
        member = np.zeros((len(rows), len(arcs)))
        member[np.arange(len(rows)), np.repeat(np.arange(len(arcs)), [len(arc.rows) for arc in arcs])] = 1
        return cls(
            where=where,
            prismatic=prismatic,
            arcs=tuple(arcs),
            rows=rows,
            points=points[rows],
            member=member,
            size=max(_spread(points[arc.rows]) for arc in arcs),
            weights=np.ones(len(rows)),
            world_from_axis=start,
        )

    @property
    def joint(self) -> int:
        """Number of the joint, from 0."""
        return self.arcs[0].joint

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

    @cached_property
    def means(self) -> np.ndarray:
        """Weighted means (2, a) of the values by arc."""
        weighted = self.member * self.weights[:, None]
        return (self.values.T @ weighted) / np.maximum(weighted.sum(axis=0), TINY)

    @property
    def radii(self) -> np.ndarray:
        """Radii (a,) of the arcs, mm; nan for a prismatic joint."""
        return self.means[0] * (np.nan if self.prismatic else 1.0)

    @property
    def heights(self) -> np.ndarray:
        """Heights (a,) of the arcs above the origin, mm; nan for a prismatic joint."""
        return self.means[1] * (np.nan if self.prismatic else 1.0)

    @cached_property
    def residuals(self) -> np.ndarray:
        """Residuals (k, 2) mm, radial and axial (across the line for a prismatic joint)."""
        return self.demean(self.values)

    @property
    def redundancy(self) -> int:
        """Number of redundant measured numbers."""
        return self._redundancy(self.weights)

    @cached_property
    def sigma_mm(self) -> float:
        """σ of one coordinate, mm."""
        return float(np.sqrt((self.weights[:, None] * self.residuals**2).sum() / max(self.redundancy, 1)))

    @cached_property
    def gain(self) -> np.ndarray:
        """Derivative (p, k, 3) of the axis (rx, ry rad, tx, ty mm in its own frame) by the points."""
        return np.einsum("pkv,kvc->pkc", self._inverse(), self._by_points())

    @property
    def covariance(self) -> np.ndarray:
        """Covariance (p, p) of the axis by the noise of its own points, in its own frame."""
        return self.sigma_mm**2 * np.einsum("pkc,qkc->pq", self.gain, self.gain)

    @property
    def outliers(self) -> np.ndarray:
        """Rows that are left out as gross errors."""
        return np.unique(self.rows[self.weights == 0])

    @property
    def rms_mm(self) -> float:
        """RMS of a coordinate of the residuals of the points used, mm."""
        return rms(self.lengths()) / float(np.sqrt(2))

    def lengths(self) -> np.ndarray:
        """Returns the lengths (k',) of the residuals of the points used, mm."""
        return np.linalg.norm(self.residuals[self.weights > 0], axis=1)

    def influence(self) -> np.ndarray:
        """Returns the change (k, p) of the axis, linear, without each of its points."""
        step = np.einsum("pkc,kvc->kpv", self.gain, self._by_points())  # derivative of the axis by the residuals
        weight = np.maximum(self.weights, TINY)
        normal = np.linalg.inv(np.einsum("kpv,kqv,k->pq", step, step, 1 / weight))
        lever = np.einsum("kpv,pq,kqu,k->kvu", step, normal, step, 1 / weight)
        sums = self.member @ (self.weights @ self.member)
        lever += (self.weights / np.maximum(sums, TINY))[:, None, None] * np.eye(2)
        without = np.linalg.solve(np.eye(2) - lever, self.residuals[:, :, None])
        return -(step @ without)[:, :, 0]

    def without(self, points: np.ndarray, left_out: Sequence[int]) -> Rigid:
        """Returns world_from_axis from moved points (m, 3), without the rows ``left_out``; the weights are kept."""
        weights = np.where(np.isin(self.rows, left_out), 0.0, self.weights)
        return replace(self, points=points[self.rows], weights=weights)._descended().world_from_axis

    def demean(self, values: np.ndarray) -> np.ndarray:
        """Returns values (k, c) minus each arc's weighted mean: variable projection of its radius and height."""
        weighted = self.member * self.weights[:, None]
        means = (weighted.T @ values) / np.maximum(weighted.sum(axis=0), TINY)[:, None]
        return values - self.member @ means

    def radius_of(self, points: np.ndarray) -> float:
        """Returns the mean distance of ``points`` from the axis."""
        local = (points - self.world_from_axis.translation) @ self.world_from_axis.rotation
        return float(np.hypot(local[:, 0], local[:, 1]).mean())

    def solved(self, moved: np.ndarray, starts: bool = True) -> "AxisFit":
        """Returns the fit by iterated Huber weights, without gross errors; ``moved`` : (m,) values of the joint;
        ``starts`` : the axis is not known yet."""
        if self.redundancy < 1:
            raise DegenerateError(
                "E-AXES-FEW",
                f"{self.where}: {len(self.rows)} positions on {len(self.arcs)} arcs leave no redundancy; another "
                "position or a second reflector needed",
            )
        fit = self._started(moved[self.rows]) if starts else self
        if starts:
            fit = replace(fit, weights=fit._huber())  # before the first step, which a gross error would lead astray
        for gross in (np.inf, GROSS):
            for _ in range(REWEIGHTINGS):
                fit = fit._descended()
                length = np.linalg.norm(fit.residuals, axis=1)
                new = np.where(length > gross * fit._robust_sigma(length), 0.0, fit._huber())
                new = new if fit._redundancy(new) > 0 else fit._huber()
                settled = bool(np.abs(new - fit.weights).max() < WEIGHTS_SETTLED)
                fit = replace(fit, weights=new, settled=settled)
                if settled:
                    break
        fit = fit._descended()
        fit._require_known()
        return fit

    def _started(self, moved: np.ndarray) -> "AxisFit":
        """Returns the axis from all points; if some stand out, from the subset with the least median residual. A subset
        leaves out one point, or all points at one value of the joint ``moved`` (k,)."""
        count = len(self.rows)
        value = np.unique(moved, return_inverse=True)[1]
        points, values = (np.arange(n) % min(n, STARTS) for n in (count, value.max() + 1))
        sets = [np.ones(count), *(points != out for out in np.unique(points))]
        sets += [values[value] != out for out in np.unique(values) if value.max() > 1]
        least, best = np.inf, None
        for i, subset in enumerate(sets):
            fit = replace(self, weights=np.asarray(subset, float))
            fit = replace(fit, world_from_axis=fit._linear_start())
            length = np.linalg.norm(fit.residuals, axis=1)
            if np.median(length) < least:
                least, best = np.median(length), fit
            if i == 0 and length.max() <= min(GROSS * fit._robust_sigma(length), QUIET * self.size):
                break
        if best is None:
            raise DegenerateError(
                "E-AXES-UNDETERMINED",
                f"{self.where}: no axis follows from any {count - 1} of its {count} positions; check them, or measure "
                "the sweep again",
            )
        return best

    def _linear_start(self) -> Rigid:
        """Returns the axis by the arcs' common scatter and the circles' common centre (Kåsa 1976)."""
        centred = self.demean(self.points)
        _, axes = np.linalg.eigh((self.weights[:, None] * centred).T @ centred)
        middle = self.points.mean(axis=0)
        if self.prismatic:
            return Rigid(_frame(axes[:, 0], axes[:, 2]), middle)
        frame = _frame(axes[:, 2], axes[:, 0])
        flat = (self.points - middle) @ frame[:, :2]
        # |x|² − 2 c·x is the same all along a circle about c
        root = np.sqrt(self.weights)
        square = self.demean((flat**2).sum(axis=1, keepdims=True))[:, 0]
        centre = np.linalg.lstsq(2 * root[:, None] * self.demean(flat), root * square, rcond=None)[0]
        return Rigid(frame, middle + frame[:, :2] @ centre)

    def _redundancy(self, weights: np.ndarray) -> int:
        kept = weights > 0
        return int(2 * kept.sum() - (2 if self.prismatic else 4) - 2 * (self.member[kept].any(axis=0)).sum())

    @property
    def _floor(self) -> float:
        return ROUNDING * max(np.abs(self.points).max(), self.size)

    def _huber(self) -> np.ndarray:
        """Returns Huber weights (k,) from the lengths of the residuals."""
        length = np.linalg.norm(self.residuals, axis=1)
        return huber_weights(length, HUBER * self._robust_sigma(length))

    def _robust_sigma(self, length: np.ndarray) -> float:
        """Returns σ of one coordinate from the median length, mm."""
        redundancy = self._redundancy(np.ones(len(length))) / (2 * len(length))
        return max(robust_sigma(length, 2, redundancy), self._floor)

    def _by_points(self) -> np.ndarray:
        """Returns the derivative (k, 2, 3) of the values by the points."""
        local, axes = self.local, self.world_from_axis.rotation
        if self.prismatic:
            return np.broadcast_to(axes[:, :2].T, (len(local), 2, 3))
        outward = local[:, :2] / np.maximum(np.hypot(local[:, 0], local[:, 1]), TINY)[:, None]
        return np.stack([outward @ axes[:, :2].T, np.broadcast_to(axes[:, 2], (len(local), 3))], axis=1)

    def _jacobian(self) -> np.ndarray:
        """Returns the derivative (k, 2, p) of the residuals by rx, ry, tx, ty of the axis in its own frame."""
        u, v, w = self.local.T
        zero = np.zeros_like(u)
        if self.prismatic:
            values = np.array([[zero, -w], [w, zero]])
        else:
            u1, v1 = np.array([u, v]) / np.maximum(np.hypot(u, v), TINY)
            values = np.array([[v1 * w, -u1 * w, -u1, -v1], [-v, u, zero, zero]])
        k = len(u)
        return self.demean(np.moveaxis(values, 2, 0).reshape(k, -1)).reshape(k, 2, -1)

    def _inverse(self) -> np.ndarray:
        """Returns the matrix (p, k, 2) by which residuals become the Gauss-Newton step."""
        jacobian = self._jacobian()
        k, _, p = jacobian.shape
        root = np.repeat(np.sqrt(self.weights), 2)
        unit = np.array([1 / self.size, 1 / self.size, 1.0, 1.0])[:p]
        u, s, vt = np.linalg.svd(root[:, None] * jacobian.reshape(2 * k, p) * unit, full_matrices=False)
        if s[-1] <= SINGULAR * s[0]:
            raise DegenerateError("E-AXES-UNDETERMINED", f"{self.where}: its arcs do not determine an axis; {LONGER}")
        return -(unit[:, None] * (vt.T / s) @ u.T * root).reshape(p, k, 2)

    def _descended(self) -> "AxisFit":
        """Returns the axis of least squares with these weights."""
        self._inverse()  # refuses arcs that determine no axis
        twists, root = np.eye(6)[[0, 1] if self.prismatic else [0, 1, 3, 4]], np.sqrt(np.repeat(self.weights, 2))

        def linearise(frame: Rigid) -> NormalEquations:
            fit = replace(self, world_from_axis=frame)
            jacobian = fit._jacobian().reshape(len(root), -1)
            return NormalEquations.of(root * fit.residuals.ravel(), root[:, None] * jacobian)

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
        if not self.prismatic and (self.means[0] <= NEAR_AXIS * self.sigma_mm).all():
            raise DegenerateError("E-AXES-UNDETERMINED", _on_axis(self.where, self.size))
        sigma = self.sigma_mm * np.linalg.norm(self.gain, axis=2)
        direction, place = np.linalg.norm(sigma[:2]), np.linalg.norm(sigma[2:])
        if direction > WEAK_RAD or place > WEAK_RAD * self.size * 10:
            if self.size < STANDS_STILL_MM:
                raise DegenerateError(
                    "E-AXES-STILL",
                    f"{self.where}: its reflectors stay within {self.size:.3g} mm of one position while its values "
                    "change; check that it moved and that each position was measured again, or put a reflector off "
                    "its axis",
                )
            raise DegenerateError(
                "E-AXES-UNDETERMINED",
                f"{self.where}: σ of the direction of its axis is {np.degrees(direction):.2g}° and of its place "
                f"{place:.2g} mm, {np.degrees(WEAK_RAD):.1f}° and {WEAK_RAD * self.size * 10:.2g} mm needed; {LONGER}",
            )

    def oriented(self, moved: np.ndarray) -> "AxisFit":
        """Returns the axis with z along positive motion; refuses motion that does not match the values (m,)."""
        moved, local = moved[self.rows], self.local
        if self.prismatic:
            travel = self.demean(np.column_stack([local[:, 2], moved]))
            turned = (self.weights * travel[:, 0]) @ travel[:, 1] < 0
            deviation = np.abs((-1 if turned else 1) * travel[:, 0] - travel[:, 1])
            allowed, unit, shown = MOTION * np.ptp(moved) + GROSS * self.sigma_mm, "mm", 1.0
        else:
            place = local[:, 0] + 1j * local[:, 1]
            weighted = self.member * self.weights[:, None]
            with_it, against = ((place * np.exp(-1j * sign * moved)) @ weighted for sign in (1, -1))
            turned = np.abs(against).sum() > np.abs(with_it).sum()
            arm = self.member @ (against if turned else with_it)
            deviation = np.abs(np.angle(place * np.exp(-1j * (-1 if turned else 1) * moved) * arm.conj()))
            near = GROSS * self.sigma_mm / np.maximum(np.abs(place), TINY)
            allowed, unit, shown = MOTION + near, "°", np.degrees(1.0)
        wrong = np.flatnonzero((deviation > allowed) & (self.weights > 0))
        if len(wrong):
            raise InputError(
                "E-AXES-JOINT-VALUES",
                f"{self.where}: the motion seen is off its values by up to {deviation[wrong].max() * shown:.3g} "
                f"{unit}; check the column's unit, the coupling in the robot file, and that positions and rows match",
            )
        axis = self.world_from_axis
        if turned:
            axis = Rigid(axis.rotation * [1, -1, -1], axis.translation)
        return replace(self, world_from_axis=axis, span=float(np.ptp(moved)))


def fit_axis(points: np.ndarray, moved: np.ndarray, arcs: list[Arc], prismatic: bool, where: str) -> AxisFit:
    """Returns the axis of a joint by robust least squares of the distances of its arcs' points to their circles or
    lines.

    ``points`` : (m, 3) of all rows, mm, with the joints before this one unwound; ``moved`` : (m,) kinematic values of
    this joint; ``where`` : the joint, for messages.

    Raises DegenerateError: no redundancy, reflectors on the axis, or arcs too short to give a direction. Raises
    InputError: the motion observed about the axis is not that of the joint's values.
    """
    size = np.array([_spread(points[arc.rows]) for arc in arcs])
    if size.max() <= ROUNDING * max(np.abs(points).max(), 1.0) * 1e3:
        raise DegenerateError("E-AXES-UNDETERMINED", _on_axis(where, size.max()))
    use = size >= FIRST_SIZE * size.max()
    fit = AxisFit.of(points, [arcs[i] for i in np.flatnonzero(use)], prismatic, where, Rigid()).solved(moved)
    if not prismatic and not use.all():
        far = np.array([fit.radius_of(points[arc.rows]) for arc in arcs]) > NEAR_AXIS * fit.sigma_mm
        if (far & ~use).any():
            use |= far
            used = [arcs[i] for i in np.flatnonzero(use)]
            fit = AxisFit.of(points, used, prismatic, where, fit.world_from_axis).solved(moved, starts=False)
    return replace(fit.oriented(moved), near=tuple(arcs[i] for i in np.flatnonzero(~use)))


def _spread(points: np.ndarray) -> float:
    return float(np.linalg.norm(points - points.mean(axis=0), axis=1).max())


def _on_axis(where: str, spread: float) -> str:
    return (
        f"{where}: all reflectors stay within {spread:.3g} mm of one place while it moves, so close to its axis that "
        "they say nothing about it; put a reflector off the axis"
    )


def _frame(x: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Returns right-handed axes (3, 3) from two perpendicular ones."""
    return np.column_stack([x, np.cross(z, x), z])


def fit_axes(
    data: Measurements, robot: Robot, arcs: list[Arc], virtual: VirtualReflectors | None = None
) -> tuple[list[AxisFit], np.ndarray, np.ndarray, list[list[np.ndarray]]]:
    """Returns the fits in order, their common covariance, the points with all joints unwound, and the derivatives of
    each axis by the axes before it. Each axis is fitted to points with the joints before it unwound.

    The covariance counts a row once, however many sweeps it belongs to, and a pose once for all its reflectors.
    """
    kinematic = data.q @ robot.coupling.T
    points, m = np.array(data.points()), len(data)
    turned = np.broadcast_to(np.eye(3), (m, 3, 3))  # rotation of the noise by unwinding
    fits, response, inherited, passed = [], [], [], []
    for j, sliding in enumerate(robot.prismatic):
        joint_arcs = [arc for arc in arcs if arc.joint == j]
        fit = fit_axis(points, kinematic[:, j], joint_arcs, bool(sliding), f"{data.where}: joint {j + 1}")
        # derivative of this axis by σ-scaled noise of every row: its own, and through the axes before it
        to_noise = np.zeros((len(fit.gain), m, 3))
        own_noise = fit.sigma_mm * np.einsum("pkc,kcd->kpd", fit.gain, turned[fit.rows])
        np.add.at(to_noise.swapaxes(0, 1), fit.rows, own_noise)  # a row may belong to several arcs
        passed.append([np.einsum("pkc,kcq->pq", fit.gain, jacobian[fit.rows]) for jacobian in inherited])
        for before, by in zip(response, passed[-1], strict=True):
            to_noise += np.einsum("pq,qmc->pmc", by, before)
        turn, after = unwound_by(fit.world_from_axis, points, kinematic[:, j], bool(sliding))
        inherited = [turn @ jacobian for jacobian in inherited]
        inherited.append(_unwinding_jacobian(fit.world_from_axis, points, after, turn, len(fit.gain)))
        fits.append(fit)
        response.append(to_noise)
        points, turned = after, turn @ turned
    rows = np.concatenate(response)
    stacked = rows.reshape(-1, 3 * m) if virtual is None else virtual.by_pose(rows)
    return fits, stacked @ stacked.T, points, passed


def unwound_by(axis: Rigid, points: np.ndarray, value: np.ndarray, sliding: bool) -> tuple[np.ndarray, np.ndarray]:
    """Returns the rotations (m, 3, 3) that undo the joint's values, and the points after that."""
    z, origin = axis.rotation[:, 2], axis.translation
    if sliding:
        return np.broadcast_to(np.eye(3), (len(points), 3, 3)), points - value[:, None] * z
    turn = Rotation.from_rotvec(-value[:, None] * z).as_matrix()
    return turn, np.einsum("mij,mj->mi", turn, points - origin) + origin


def _unwinding_jacobian(axis: Rigid, before: np.ndarray, after: np.ndarray, turn: np.ndarray, count: int) -> np.ndarray:
    """Returns the derivative (m, 3, p) of the unwound points by rx, ry, tx, ty of the axis: δ = D(U x) − U(D x)."""
    columns = []
    for component in (0, 1, 3, 4)[:count]:
        direction = axis.rotation[:, component % 3]
        if component < 3:
            after_shift, before_shift = (np.cross(direction, points - axis.translation) for points in (after, before))
        else:
            after_shift = before_shift = np.broadcast_to(direction, after.shape)
        columns.append(after_shift - np.einsum("mij,mj->mi", turn, before_shift))
    return np.stack(columns, axis=2)
