"""Fits the axis of a joint to positions and orientations of a target along sweeps, with full turns unwound."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.errors import DegenerateError, InputError
from stcal.geometry.arrays import rms
from stcal.geometry.least_squares import NormalEquations, minimise
from stcal.geometry.rigid import Rigid
from stcal.geometry.robust import HUBER, huber_weights, robust_sigma
from stcal.robot.axes.sweeps import Arc, VirtualReflectors
from stcal.robot.kinematics.measurements import Measurements
from stcal.robot.kinematics.model import Robot

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
"""Largest difference of the observed motion from the joint's values; for a sliding joint also the largest share of its
way. Joints, gears and zero positions are true to hundredths of this."""
LONGER = "sweep further, or with reflectors farther apart"
QUIET = 1e-3
"""Share of the largest arc below which residuals are too small to hide a gross error that bent the first axis."""
STARTS, REWEIGHTINGS = 60, 30
WEIGHTS_SETTLED = 1e-3
"""Change of the weights below which they have converged; it moves an axis by less than a thousandth of its σ."""
SINGULAR, TINY = 1e-10, 1e-300
"""Ratio of singular values below which arcs do not determine an axis; and a number that prevents division by 0."""
FIRST_SIZE = 0.05
"""Size of an arc, as a share of the largest one, from which on it is used for the first axis and σ, by which the
smaller arcs are judged."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class AxisFit:
    """The axis of one joint.

    ``world_from_axis`` : z of this frame is the joint's positive direction; the origin lies on the axis, at the foot of
    the measured points' centroid; ``arcs``, ``radii``, ``heights`` : of the arcs used, (a,) mm, heights above the
    origin (nan for a prismatic joint); ``near`` : arcs too close to the axis to be used; ``rows`` : (k,) rows used, one
    for each point of each arc; ``residuals`` : (k, 2) mm, radial and axial (across the line for a prismatic joint);
    ``weights`` : (k,), 0 for gross errors; ``gain`` : (p, k, 3) derivative of the axis by the points, where p is 4 (rx,
    ry rad, tx, ty mm in the axis's own frame) or 2 (rx, ry); ``sigma_mm`` : σ of one coordinate; ``redundancy`` :
    number of redundant measured numbers; ``span`` : range of the joint's values, rad or mm; ``settled`` : whether the
    robust weights converged.
    """

    joint: int
    world_from_axis: Rigid
    arcs: tuple[Arc, ...]
    radii: np.ndarray
    heights: np.ndarray
    near: tuple[Arc, ...]
    rows: np.ndarray
    residuals: np.ndarray
    weights: np.ndarray
    gain: np.ndarray
    sigma_mm: float
    redundancy: int
    span: float
    settled: bool

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

    def influence(self, points: np.ndarray) -> np.ndarray:
        """Returns the change (k, p) of the axis, linear, without each of the fitted ``points`` (k, 3), mm."""
        axes, prismatic = self.world_from_axis.rotation, len(self.gain) == 2
        across = np.broadcast_to(axes.T[:2], (len(points), 2, 3)).copy()
        if not prismatic:
            local = (points - self.world_from_axis.translation) @ axes
            outward = local[:, :2] / np.maximum(np.linalg.norm(local[:, :2], axis=1), TINY)[:, None]
            across[:, 0], across[:, 1] = outward @ axes[:, :2].T, axes[:, 2]
        step = np.einsum("pkc,kvc->kpv", self.gain, across)  # derivative of the axis by the residuals
        weight = np.maximum(self.weights, TINY)
        normal = np.linalg.inv(np.einsum("kpv,kqv,k->pq", step, step, 1 / weight))
        lever = np.einsum("kpv,pq,kqu,k->kvu", step, normal, step, 1 / weight)
        counts = [len(arc.rows) for arc in self.arcs]
        sums = np.add.reduceat(self.weights, np.cumsum([0, *counts[:-1]]))
        lever += (self.weights / np.maximum(np.repeat(sums, counts), TINY))[:, None, None] * np.eye(2)
        without = np.linalg.solve(np.eye(2) - lever, self.residuals[:, :, None])
        return -(step @ without)[:, :, 0]

    def lengths(self) -> np.ndarray:
        """Returns the lengths (k',) of the residuals of the points used, mm."""
        return np.linalg.norm(self.residuals[self.weights > 0], axis=1)


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
    use = list(np.flatnonzero(size >= FIRST_SIZE * size.max()))
    fit = _AxisFitting(points, [arcs[i] for i in use], prismatic, where)
    fit.solve(moved)
    if not prismatic:
        small = [i for i in range(len(arcs)) if i not in use]
        added = [i for i in small if fit.radius_of(points[arcs[i].rows]) > NEAR_AXIS * fit.sigma()]
        if added:
            use = sorted(use + added)
            fit = _AxisFitting(points, [arcs[i] for i in use], prismatic, where, fit.frame)
            fit.solve(moved)
    fit.orient(moved)
    return fit.result(moved, tuple(arc for i, arc in enumerate(arcs) if i not in use))


def refit_axis(fit: AxisFit, points: np.ndarray, left_out: np.ndarray) -> Rigid:
    """Returns world_from_axis from moved points, without the rows ``left_out``; the weights of the fit are kept."""
    again = _AxisFitting(points, list(fit.arcs), fit.gain.shape[0] == 2, f"joint {fit.joint + 1}", fit.world_from_axis)
    again.weights = np.where(np.isin(fit.rows, left_out), 0.0, fit.weights)
    again.descend()
    return again.frame


def _spread(points: np.ndarray) -> float:
    return float(np.linalg.norm(points - points.mean(axis=0), axis=1).max())


def _on_axis(where: str, spread: float) -> str:
    return (
        f"{where}: all reflectors stay within {spread:.3g} mm of one place while it moves, so close to its axis that "
        "they say nothing about it; put a reflector off the axis"
    )


class _AxisFitting:
    """A fit in progress: the frame of the axis and the weights change, the points stay."""

    def __init__(self, points: np.ndarray, arcs: list[Arc], prismatic: bool, where: str, frame: Rigid | None = None):
        self.arcs, self.prismatic, self.where = arcs, prismatic, where
        self.frame, self.started, self.settled = frame or Rigid(), frame is not None, False
        self.rows = np.concatenate([arc.rows for arc in arcs])
        self.points = points[self.rows]
        self.member = np.zeros((len(self.rows), len(arcs)))  # (k, a) one-hot
        self.member[np.arange(len(self.rows)), np.repeat(np.arange(len(arcs)), [len(a.rows) for a in arcs])] = 1
        self.weights = np.ones(len(self.rows))
        self.size = max(_spread(points[arc.rows]) for arc in arcs)
        self.floor = ROUNDING * max(np.abs(self.points).max(), self.size)

    def solve(self, moved: np.ndarray) -> None:
        """Starts, iterates with Huber weights, and leaves out gross errors until nothing changes; ``moved`` : (m,)
        values of the joint."""
        if self.redundancy() < 1:
            raise DegenerateError(
                "E-AXES-FEW",
                f"{self.where}: {len(self.rows)} positions on {len(self.arcs)} arcs leave no redundancy; another "
                "position or a second reflector needed",
            )
        if not self.started:
            self.start(moved[self.rows])
            self.weights = self.huber()  # before the first step, which a gross error would lead astray
        for gross in (np.inf, GROSS):
            for _ in range(REWEIGHTINGS):
                self.descend()
                length = np.linalg.norm(self.residuals(), axis=1)
                new = np.where(length > gross * self.robust_sigma(length), 0.0, self.huber())
                new = new if self.redundancy(new) > 0 else self.huber()
                changed = np.abs(new - self.weights).max()
                self.weights = new
                self.settled = bool(changed < WEIGHTS_SETTLED)
                if self.settled:
                    break
        self.descend()
        self.require_known()

    def start(self, moved: np.ndarray) -> None:
        """Sets the axis from all points; if some stand out, from the subset with the least median residual. A subset
        leaves out one point, or all points at one value of the joint ``moved`` (k,)."""
        count = len(self.rows)
        value = np.unique(moved, return_inverse=True)[1]
        points, values = (np.arange(n) % min(n, STARTS) for n in (count, value.max() + 1))
        sets = [np.ones(count), *(points != out for out in np.unique(points))]
        sets += [values[value] != out for out in np.unique(values) if value.max() > 1]
        least, best = np.inf, None
        for i, subset in enumerate(sets):
            self.weights = np.asarray(subset, float)
            self.frame = self.linear_start()
            length = np.linalg.norm(self.residuals(), axis=1)
            if np.median(length) < least:
                least, best = np.median(length), (self.frame, self.weights)
            quiet = length.max() <= min(GROSS * self.robust_sigma(length), QUIET * self.size)
            if i == 0 and quiet:
                break
        if best is None:
            raise DegenerateError(
                "E-AXES-UNDETERMINED",
                f"{self.where}: no axis follows from any {count - 1} of its {count} positions; check them, or measure "
                "the sweep again",
            )
        self.frame, self.weights = best

    def linear_start(self) -> Rigid:
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

    def local(self) -> np.ndarray:
        """Returns the points (k, 3) in the axis's frame."""
        return (self.points - self.frame.translation) @ self.frame.rotation

    def values(self) -> np.ndarray:
        """Returns values (k, 2) that are constant along an arc: radius and height, or the place across a line."""
        local = self.local()
        if self.prismatic:
            return local[:, :2]
        return np.column_stack([np.hypot(local[:, 0], local[:, 1]), local[:, 2]])

    def means(self) -> np.ndarray:
        """Returns the weighted means (2, a) of the values by arc."""
        weighted = self.member * self.weights[:, None]
        return (self.values().T @ weighted) / np.maximum(weighted.sum(axis=0), TINY)

    def demean(self, values: np.ndarray) -> np.ndarray:
        """Returns values (k, c) minus each arc's weighted mean: variable projection of its radius and height."""
        weighted = self.member * self.weights[:, None]
        means = (weighted.T @ values) / np.maximum(weighted.sum(axis=0), TINY)[:, None]
        return values - self.member @ means

    def residuals(self) -> np.ndarray:
        return self.demean(self.values())

    def radius_of(self, points: np.ndarray) -> float:
        """Returns the mean distance of ``points`` from the axis."""
        local = (points - self.frame.translation) @ self.frame.rotation
        return float(np.hypot(local[:, 0], local[:, 1]).mean())

    def redundancy(self, weights: np.ndarray | None = None) -> int:
        kept = (self.weights if weights is None else weights) > 0
        return int(2 * kept.sum() - (2 if self.prismatic else 4) - 2 * (self.member[kept].any(axis=0)).sum())

    def sigma(self) -> float:
        """Returns σ of one coordinate, mm."""
        return float(np.sqrt((self.weights[:, None] * self.residuals() ** 2).sum() / max(self.redundancy(), 1)))

    def huber(self) -> np.ndarray:
        """Returns Huber weights (k,) from the lengths of the residuals."""
        length = np.linalg.norm(self.residuals(), axis=1)
        return huber_weights(length, HUBER * self.robust_sigma(length))

    def robust_sigma(self, length: np.ndarray) -> float:
        """Returns σ of one coordinate from the median length, mm."""
        redundancy = self.redundancy(np.ones(len(length))) / (2 * len(length))
        return max(robust_sigma(length, 2, redundancy), self.floor)

    def points_jacobian(self) -> np.ndarray:
        """Returns the derivative (k, 2, 3) of the values by the points."""
        local, axes = self.local(), self.frame.rotation
        if self.prismatic:
            return np.broadcast_to(axes[:, :2].T, (len(local), 2, 3))
        outward = local[:, :2] / np.maximum(np.hypot(local[:, 0], local[:, 1]), TINY)[:, None]
        return np.stack([outward @ axes[:, :2].T, np.broadcast_to(axes[:, 2], (len(local), 3))], axis=1)

    def jacobian(self) -> np.ndarray:
        """Returns the derivative (k, 2, p) of the residuals by rx, ry, tx, ty of the axis in its own frame."""
        u, v, w = self.local().T
        zero = np.zeros_like(u)
        if self.prismatic:
            values = np.array([[zero, -w], [w, zero]])
        else:
            u1, v1 = np.array([u, v]) / np.maximum(np.hypot(u, v), TINY)
            values = np.array([[v1 * w, -u1 * w, -u1, -v1], [-v, u, zero, zero]])
        k = len(u)
        return self.demean(np.moveaxis(values, 2, 0).reshape(k, -1)).reshape(k, 2, -1)

    def inverse(self) -> np.ndarray:
        """Returns the matrix (p, k, 2) by which residuals become the Gauss-Newton step."""
        jacobian = self.jacobian()
        k, _, p = jacobian.shape
        root = np.repeat(np.sqrt(self.weights), 2)
        unit = np.array([1 / self.size, 1 / self.size, 1.0, 1.0])[:p]
        u, s, vt = np.linalg.svd(root[:, None] * jacobian.reshape(2 * k, p) * unit, full_matrices=False)
        if s[-1] <= SINGULAR * s[0]:
            raise DegenerateError("E-AXES-UNDETERMINED", f"{self.where}: its arcs do not determine an axis; {LONGER}")
        return -(unit[:, None] * (vt.T / s) @ u.T * root).reshape(p, k, 2)

    def descend(self) -> None:
        """Minimises the squares with fixed weights."""
        self.inverse()  # refuses arcs that determine no axis
        start, twists = self.frame, np.eye(6)[[0, 1] if self.prismatic else [0, 1, 3, 4]]

        def linearise(frame: Rigid) -> NormalEquations:
            self.frame = frame
            root = np.sqrt(np.repeat(self.weights, 2))
            jacobian = self.jacobian().reshape(len(root), -1)
            return NormalEquations.of(root * self.residuals().ravel(), root[:, None] * jacobian)

        minimum = minimise(
            start,
            linearise,
            lambda frame, step: self.centred(frame @ Rigid.exp(step @ twists)),
            least_gain=self.floor**2,
        )
        self.frame = minimum.required(f"{self.where}: axis", "are these single-joint sweeps?").state

    def centred(self, frame: Rigid) -> Rigid:
        """Returns the frame with its origin at the foot of the points' centroid."""
        shift = frame.inverse() @ self.points.mean(axis=0)
        if not self.prismatic:
            shift[:2] = 0
        return Rigid(frame.rotation, frame @ shift)

    def gain(self) -> np.ndarray:
        """Returns the derivative (p, k, 3) of the axis by the points."""
        return np.einsum("pkv,kvc->pkc", self.inverse(), self.points_jacobian())

    def require_known(self) -> None:
        """Refuses an axis whose σ is too large for its linear covariance."""
        if not self.prismatic and (self.means()[0] <= NEAR_AXIS * self.sigma()).all():
            raise DegenerateError("E-AXES-UNDETERMINED", _on_axis(self.where, self.size))
        sigma = self.sigma() * np.linalg.norm(self.gain(), axis=2)
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

    def orient(self, moved: np.ndarray) -> None:
        """Turns z along positive motion, and refuses motion that does not match the joint's values."""
        moved, local = moved[self.rows], self.local()
        if self.prismatic:
            travel = self.demean(np.column_stack([local[:, 2], moved]))
            turned = (self.weights * travel[:, 0]) @ travel[:, 1] < 0
            deviation = np.abs((-1 if turned else 1) * travel[:, 0] - travel[:, 1])
            allowed, unit, shown = MOTION * np.ptp(moved) + GROSS * self.sigma(), "mm", 1.0
        else:
            place = local[:, 0] + 1j * local[:, 1]
            weighted = self.member * self.weights[:, None]
            with_it, against = ((place * np.exp(-1j * sign * moved)) @ weighted for sign in (1, -1))
            turned = np.abs(against).sum() > np.abs(with_it).sum()
            arm = self.member @ (against if turned else with_it)
            deviation = np.abs(np.angle(place * np.exp(-1j * (-1 if turned else 1) * moved) * arm.conj()))
            near = GROSS * self.sigma() / np.maximum(np.abs(place), TINY)
            allowed, unit, shown = MOTION + near, "°", np.degrees(1.0)
        wrong = np.flatnonzero((deviation > allowed) & (self.weights > 0))
        if len(wrong):
            raise InputError(
                "E-AXES-JOINT-VALUES",
                f"{self.where}: the motion seen is off its values by up to {deviation[wrong].max() * shown:.3g} "
                f"{unit}; check the column's unit, the coupling in the robot file, and that positions and rows match",
            )
        if turned:
            self.frame = Rigid(self.frame.rotation * [1, -1, -1], self.frame.translation)

    def result(self, moved: np.ndarray, near: tuple[Arc, ...]) -> AxisFit:
        """Returns the result for joint values ``moved`` (m,)."""
        radii, heights = self.means()
        if self.prismatic:
            radii, heights = np.full((2, len(self.arcs)), np.nan)
        return AxisFit(
            joint=self.arcs[0].joint,
            world_from_axis=self.frame,
            arcs=tuple(self.arcs),
            radii=radii,
            heights=heights,
            near=near,
            rows=self.rows,
            residuals=self.residuals(),
            weights=self.weights,
            gain=self.gain(),
            sigma_mm=self.sigma(),
            redundancy=self.redundancy(),
            span=float(np.ptp(moved[self.rows])),
            settled=self.settled,
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
