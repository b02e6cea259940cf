"""Inverse kinematics of any serial arm: many poses at once, joint limits, nearest branch."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import KDTree
from scipy.stats import qmc

from stcal.errors import InputError
from stcal.geometry.arrays import Brief, freeze, require_arguments
from stcal.geometry.rigid import Poses, Rigid
from stcal.robot.kinematics.forward import forward, jacobian
from stcal.robot.kinematics.model import Robot

ROUNDS = 60
"""Largest number of iterations. At a fold every step halves the distance, so that 1 to 1e-12 takes 40."""
DONE_MM, DONE_RAD = 1e-10, 1e-13
"""Errors at which iteration ends, one digit below the tolerance of a reached pose."""
LONGEST = 1.0
"""Longest step of a joint, rad or fraction of the reach; the linear model does not hold beyond it."""
LEAST_DAMPING = 1e-14
"""Smallest damping; it keeps the normal equations regular where the Jacobian is singular."""
ORIENTATION_WEIGHT = 0.03
"""Weight of the orientation for arms of fewer than six joints, whose position has priority."""


@dataclass(frozen=True, slots=True, eq=False)
class InverseProblem:
    """An arm with a tool, in unitless joint values. ``unit`` : (n,) rad or mm of a unitless 1; ``reach`` : mm;
    ``bounds`` : (n, 2); ``middle`` : (n,) of the bounds, 0 if unlimited; ``turns`` : (n,) whether 2π more is the same
    position."""

    robot: Robot
    tool: str
    unit: np.ndarray
    reach: float
    bounds: np.ndarray
    middle: np.ndarray
    turns: np.ndarray

    @classmethod
    def of(cls, robot: Robot, tool: str = "") -> "InverseProblem":
        reach = reach_mm(robot, [tool])
        sliding = robot.prismatic
        unit = np.where(sliding, reach, 1.0)
        bounds = robot.limits() / unit[:, None]
        finite = np.isfinite(bounds)
        middle = np.where(finite.all(axis=1), np.where(finite, bounds, 0.0).mean(axis=1), 0.0)
        middle = np.clip(middle, *bounds.T)
        # A whole turn of the controller's value leaves the arm in place only if the coupling maps it to whole turns.
        whole = np.isclose(robot.coupling, np.round(robot.coupling)) & ~(sliding[:, None] & (robot.coupling != 0))
        return cls(robot, tool, unit, reach, bounds, middle, ~sliding & whole.all(axis=0))

    @property
    def under_actuated(self) -> bool:
        chain = self.robot.chain()
        return len(chain.branch(chain.carrier(self.tool)).path()) < 6

    def clipped(self, q: np.ndarray) -> np.ndarray:
        return np.clip(q, *self.bounds.T)

    def errors(self, poses: Poses, q: np.ndarray) -> np.ndarray:
        """Returns (m, 6) differences from the poses that q reaches to ``poses``: rad, mm."""
        return poses.difference(forward(self.robot, q * self.unit, self.tool))

    def jacobian(self, q: np.ndarray) -> np.ndarray:
        """Returns the unitless Jacobian, (m, 6, n)."""
        derivative = jacobian(self.robot, q * self.unit, self.tool) * self.unit
        derivative[:, 3:] /= self.reach
        return derivative


def reach_mm(robot: Robot, tools: Iterable[str]) -> float:
    """Returns an upper bound, mm, of the distance from the first joint to any of the tools: all links and travels."""
    whole, travel = robot.chain(), np.abs(robot.limits()[robot.prismatic])
    links = []
    for tool in tools:
        chain = whole.branch(whole.carrier(tool))
        end = chain.last_from_flange @ robot.tool(tool)
        along = np.linalg.norm(chain.translation[list(chain.path()[1:])], axis=1)
        links.append(along.sum() + np.linalg.norm(end.translation))
    return float(max(max(links) + travel[np.isfinite(travel)].sum(), 1.0))


def solve(problem: InverseProblem, poses: Poses, q: np.ndarray, bounds: np.ndarray | None = None) -> np.ndarray:
    """Returns unitless joint vectors (m, n) of least error from starts q, also where a pose is out of reach."""
    q = q.copy()
    if not len(q):
        return q
    weight = np.full(6, 1.0)
    weight[3:] = 1 / problem.reach
    if problem.under_actuated:
        weight[:3] = ORIENTATION_WEIGHT
    rows, goal = np.arange(len(q)), poses
    error = problem.errors(goal, q)
    damping, going = np.full(len(q), 1e-2), np.ones(len(q), bool)
    for _ in range(ROUNDS):
        going &= ~((np.abs(error[:, :3]).max(axis=1) <= DONE_RAD) & (np.abs(error[:, 3:]).max(axis=1) <= DONE_MM))
        rows, goal, error, damping = rows[going], goal[going], error[going], damping[going]
        if not len(rows):
            break
        step, gain = _step(problem, q[rows], error, weight, damping, bounds)
        trial = q[rows] + step
        if bounds is not None:
            trial = np.clip(trial, *bounds.T)
        new = problem.errors(goal, trial)
        better = np.linalg.norm(new * weight, axis=1) < np.linalg.norm(error * weight, axis=1)
        q[rows[better]] = trial[better]
        error = np.where(better[:, None], new, error)
        damping = np.clip(np.where(better, damping / 5, damping * 5), 1e-12, 1e12)
        stuck = (np.abs(trial - q[rows]).max(axis=1) < 1e-15) & ~better | (gain < 1e-15)
        going = ~stuck
    return _position_exact(problem, poses, q, bounds) if problem.under_actuated else q


def _step(
    problem: InverseProblem,
    q: np.ndarray,
    off: np.ndarray,
    weight: np.ndarray,
    damping: np.ndarray,
    bounds: np.ndarray | None,
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the damped step (m, n) and the norm (m,) of the gradient, the error that the joints can act on."""
    weighted = off * weight
    row = np.where(weight == 1 / problem.reach, 1.0, weight)  # the Jacobian's translation is in shares of the reach
    derivative = problem.jacobian(q) * row[:, None]
    pull = np.einsum("mij,mi->mj", derivative, weighted)
    if bounds is not None:  # a joint at its limit does not move beyond it
        low, high = bounds.T
        held = ((q <= low) & (pull < 0)) | ((q >= high) & (pull > 0))
        derivative = np.where(held[:, None], 0.0, derivative)
        pull = np.where(held, 0.0, pull)
    size = np.einsum("mi,mi->m", weighted, weighted)
    normal = np.einsum("mij,mik->mjk", derivative, derivative)
    diagonal = np.arange(normal.shape[1])
    normal[:, diagonal, diagonal] += (np.maximum(damping * size, LEAST_DAMPING))[:, None]
    step = np.linalg.solve(normal, pull[..., None])[..., 0]
    longest = np.abs(step).max(axis=1, keepdims=True)
    gain = np.linalg.norm(pull, axis=1)
    return step * np.minimum(1, LONGEST / np.maximum(longest, 1e-300)), gain


def _position_exact(problem: InverseProblem, poses: Poses, q: np.ndarray, bounds: np.ndarray | None) -> np.ndarray:
    """Removes the remaining position error by minimum-norm steps of the joints that are not at their limits."""
    for _ in range(4):
        off = problem.errors(poses, q)[:, 3:] / problem.reach
        derivative = problem.jacobian(q)[:, 3:]
        near = np.linalg.norm(off, axis=1) < ORIENTATION_WEIGHT  # poses farther off are out of reach and stay unchanged
        if bounds is not None:
            low, high = bounds.T
            derivative = np.where(((q <= low) | (q >= high))[:, None], 0.0, derivative)
        step = np.einsum("mji,mi->mj", np.linalg.pinv(derivative, rcond=1e-9), off)
        q = np.where(near[:, None], q + step, q)
        if bounds is not None:
            q = np.clip(q, *bounds.T)
    return q


WITHIN_MM, WITHIN_RAD = 1e-9, 1e-12
"""Errors below which a pose counts as reached: far below any measurement, above the rounding of a chain of metres."""
LIMIT_SLACK = 1e-9
"""Largest excess over joint limits that counts as rounding, rad (or shares of the reach)."""
SINGULAR = 1e-5
"""Smallest singular value (no unit) below which joint values are not determined, as an error of 1e-12 leaves 1e-6."""
POOL, STARTS = 4096, 96
"""Joint vectors over the range, and nearest that are starts: 96 miss none of 2738 branches."""
SAME_BRANCH = 1e-4
"""Distance of joint vectors, rad, below which they are one solution."""
SHORT = 0.1
"""Distance from the reference, rad, up to which other branches are sought around the solution only, else everywhere."""
AS_GOOD = 2.0
"""Largest ratio of an orientation error to the least one that counts as equally good, for arms with few joints."""
GROUP = 2048
"""Number of poses processed at a time if all branches are sought."""

REACHED, ORIENTATION, SINGULAR_POSE = "reached", "orientation", "singular"
LIMIT, UNREACHABLE = "limit", "unreachable"


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Inverse(Brief):
    """Joint vectors found for m poses.

    ``q`` : (m, n) values of the controller, rad or mm, always within the limits; if the pose is not reached, the
    nearest of all that were tried. ``status`` : (m,) ``reached``; ``singular``: reached, but the values are not unique,
    as joints can move without moving the tool, or a branch ends; ``orientation``: position reached, and orientation as
    near as fewer than six joints allow; ``limit``: reached only by joint vectors beyond the limits; ``unreachable``: no
    joint vector was found. ``error_mm``, ``error_rad`` : (m,) remaining errors of position and orientation.
    """

    q: np.ndarray
    status: tuple[str, ...]
    error_mm: np.ndarray
    error_rad: np.ndarray

    def __post_init__(self):
        m = len(self.status)
        freeze(self, "q", (m, None), "joint values")
        freeze(self, "error_mm", (m,), "errors")
        freeze(self, "error_rad", (m,), "errors")

    def __len__(self) -> int:
        return len(self.status)

    @property
    def usable(self) -> np.ndarray:
        """Mask (m,) of poses with the tool at the wanted place: reached, singular, or orientation."""
        return np.array([s in (REACHED, SINGULAR_POSE, ORIENTATION) for s in self.status], bool)


@require_arguments
def inverse(
    robot: Robot, poses: Poses, near: ArrayLike | None = None, tool: str = "", payload_kg: float | None = None
) -> Inverse:
    """Returns joint vectors q that bring the tool to ``poses``: forward(robot, q) = base_from_tool.

    Of all branches and turns within the joint limits, the one nearest to ``near`` is returned (Euclidean distance, rad,
    prismatic joints in shares of the reach). If the step from ``near`` is so short that no other branch can be as near
    (a bound from the Jacobian's smallest singular value), no other is tried. For steps up to 0.1 rad, other branches
    are sought nearby; for longer ones, all branches are compared. The solutions of an arm with more than six joints are
    not isolated; one near to ``near`` is returned.

    Parameters
    ----------
    robot : an arm of n joints; where its base stands does not matter.
    poses : m transforms base_from_tool, mm.
    near : (m, n) or (n,) array, optional
        Reference values of the controller, rad or mm. Without it the first pose gets the branch nearest to the middle
        of the limits (0 where unlimited), and every other the one nearest to that of the pose before.
    tool : name of the tool.
    payload_kg : mass at the flange; that of the robot if not given.

    Returns
    -------
    Inverse
        Joint vectors (m, n), and for each whether it reaches its pose; no pose raises an error.

    Raises
    ------
    InputError
        ``near`` of another shape or not finite; a robot of more than six joints without ``near``; an unknown tool;
        a mass that no arm carries.

    References
    ----------
    J. Fan, Y. Yuan, "On the quadratic convergence of the Levenberg–Marquardt method without nonsingularity
    assumption", Computing 74, 2005.
    """
    m, n = len(poses), len(robot.rows)
    problem = InverseProblem.of(robot if payload_kg is None else robot.loaded(payload_kg), tool)
    if near is None:
        _refuse_redundant(problem)
        return _by_search(problem, poses, np.arange(m), np.zeros((m, n)), np.zeros(m, bool), None)
    near = np.asarray(near, float)
    if near.shape not in ((n,), (m, n)):
        raise InputError("E-ARRAY-SHAPE", f"reference joint values: shape {near.shape}, ({n},) or ({m}, {n}) needed")
    near = np.broadcast_to(near, (m, n)) / problem.unit
    if not np.isfinite(near).all():
        raise InputError("E-ARRAY-NOT-FINITE", "reference joint values: hold values that are not finite")
    q, ok = _from_near(problem, poses, near)
    return _by_search(problem, poses, np.flatnonzero(~ok), q, ok, near)


@require_arguments
def branches(robot: Robot, pose: Rigid, tool: str = "") -> Inverse:
    """Returns all joint vectors within the limits that bring the tool to ``pose``, one for each branch.

    Joint values that differ by 2π are one branch, with the value nearest to the middle of the limits. At a singular
    pose, which has a continuum of solutions, only some are returned. The search has many starts, the same every time.

    Parameters
    ----------
    robot : an arm of n joints, at most six; where its base stands does not matter.
    pose : base_from_tool, mm.
    tool : name of the tool.

    Returns
    -------
    Inverse
        Joint vectors (k, n), the nearest to the middle of the limits first; k is 0 where the pose is not reached.

    Raises
    ------
    InputError
        The arm has more than six joints, and so infinitely many solutions; or the tool is unknown.
    """
    problem = InverseProblem.of(robot, tool)
    _refuse_redundant(problem)
    poses = Poses.of([pose])
    solutions, inside = _turned(problem, _every_solution(problem, poses)[0], problem.middle)
    kept: list[np.ndarray] = []
    for q in solutions[inside]:
        if all(np.abs(q - other).max() > SAME_BRANCH for other in kept):
            kept.append(q)
    solutions = np.array(kept).reshape(-1, solutions.shape[1])
    repeated = Poses(np.repeat(poses.rotation, len(solutions), 0), np.repeat(poses.translation, len(solutions), 0))
    judged = _judge(problem, repeated, solutions)
    keep = np.flatnonzero(judged.usable & _as_good(judged.error_rad))
    order = keep[np.argsort(np.linalg.norm(solutions[keep] - problem.middle, axis=1), kind="stable")]
    return Inverse(
        judged.q[order], tuple(judged.status[i] for i in order), judged.error_mm[order], judged.error_rad[order]
    )


def _from_near(problem: InverseProblem, poses: Poses, near: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns joint vectors (m, n) by descent from ``near``, and a mask (m,) of those that are surely nearest."""
    isolated = len(problem.unit) <= 6
    bounds = None if isolated else problem.bounds
    q = solve(problem, poses, near if isolated else problem.clipped(near), bounds)
    q, inside = _turned(problem, q, near)
    ok = inside & _judge(problem, poses, q).usable
    if isolated:
        doubtful = ok & ~_is_nearest(problem, q, near)
        q[doubtful] = _nearest_around(problem, poses[doubtful], q[doubtful], near[doubtful])
        ok &= ~doubtful | (np.linalg.norm(q - near, axis=1) <= SHORT)
    return q, ok


def _by_search(
    problem: InverseProblem, poses: Poses, rest: np.ndarray, q: np.ndarray, ok: np.ndarray, near: np.ndarray | None
) -> Inverse:
    """Returns all joint vectors, the poses ``rest`` searched: nearest to ``near`` (m, n), or to the solution before."""
    beyond, last = np.zeros(len(poses), bool), problem.middle
    for start in range(0, len(rest), GROUP):
        part = rest[start : start + GROUP]
        every = _every_solution(problem, poses[part], None if near is None else q[part])
        for i, solutions in zip(part, every, strict=True):
            wanted = last if near is None else near[i]
            best, beyond[i] = _nearest(problem, poses[[i]], solutions, wanted)
            ok[i] = best is not None
            q[i] = last = wanted if best is None else best
    return _finished(problem, poses, q, ok, beyond)


def _refuse_redundant(problem: InverseProblem) -> None:
    n = len(problem.unit)
    if n > 6:
        raise InputError(
            "E-ROBOT-REDUNDANT",
            f"robot {problem.robot.name}: {n} joints reach a pose in infinitely many ways; "
            "give the joint values to stay near to (columns q1_deg …)",
        )


def _every_solution(problem: InverseProblem, poses: Poses, more: np.ndarray | None = None) -> list[np.ndarray]:
    """Returns for each pose joint vectors (k, n) from many starts and ``more`` (m, n), ignoring limits."""
    n, m = len(problem.unit), len(poses)
    low, high = problem.bounds.T
    whole = np.minimum(np.pi, (high - low) / 2)  # of more than a turn one turn is enough
    half = np.where(problem.turns, whole, np.where(np.isfinite(high - low), (high - low) / 2, 1.0))
    pool = problem.middle + (2 * qmc.Halton(n, scramble=False).random(POOL + 1)[1:] - 1) * half
    reach = problem.reach
    tree = KDTree(_embedded(forward(problem.robot, pool * problem.unit, problem.tool), reach))
    chosen = tree.query(_embedded(poses, reach), k=STARTS)[1].ravel()
    repeated = np.repeat(np.arange(m), STARTS)
    found = solve(problem, poses[repeated], pool[chosen]).reshape(m, STARTS, n)
    if more is not None:
        found = np.concatenate([more[:, None], found], axis=1)
    return list(found)


def _embedded(poses: Poses, reach: float) -> np.ndarray:
    """Returns points (m, 12) whose distances are those of poses: chord of the rotation and shares of the reach."""
    return np.hstack([poses.rotation.reshape(-1, 9) / np.sqrt(2), poses.translation / reach])


def _nearest(
    problem: InverseProblem, pose: Poses, solutions: np.ndarray, near: np.ndarray
) -> tuple[np.ndarray | None, bool]:
    """Returns the nearest solution within the limits or None, and whether only solutions beyond them reach."""
    turned, inside = _turned(problem, solutions, near)
    count = len(turned)
    many = Poses(np.repeat(pose.rotation, count, 0), np.repeat(pose.translation, count, 0))
    off = problem.errors(many, turned)
    good = _is_reached(problem, off)
    if not good.any():
        return None, False
    good[good] = _as_good(np.linalg.norm(off[good, :3], axis=1))
    eligible = np.flatnonzero(good & inside)
    if not len(eligible):
        return None, True
    return turned[eligible[np.linalg.norm(turned[eligible] - near, axis=1).argmin()]], False


def _as_good(error_rad: np.ndarray) -> np.ndarray:
    """Returns which orientation errors are at most ``AS_GOOD`` times the least; with six joints all reached poses."""
    return error_rad <= AS_GOOD * error_rad.min(initial=np.inf) + WITHIN_RAD


def _is_reached(problem: InverseProblem, off: np.ndarray) -> np.ndarray:
    """Returns (m,) true if errors (m, 6), rad and mm, are within tolerance; fewer than six joints: position only."""
    position = np.linalg.norm(off[:, 3:], axis=1) <= WITHIN_MM
    return position & ((np.linalg.norm(off[:, :3], axis=1) <= WITHIN_RAD) | problem.under_actuated)


def _turned(problem: InverseProblem, q: np.ndarray, near: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns joint values turned by 2π to be nearest to ``near`` within limits, and a mask (m,) of those within."""
    low, high = problem.bounds.T
    turn = 2 * np.pi
    turned = q + turn * np.round((near - q) / turn)
    with np.errstate(invalid="ignore"):  # inf − inf never occurs, inf / 2π does
        turned = turned - turn * np.ceil(np.maximum(turned - high - LIMIT_SLACK, 0) / turn)
        turned = turned + turn * np.ceil(np.maximum(low - turned - LIMIT_SLACK, 0) / turn)
    turned = np.where(problem.turns, turned, q)
    return turned, ((turned >= low - LIMIT_SLACK) & (turned <= high + LIMIT_SLACK)).all(axis=1)


def _is_nearest(problem: InverseProblem, q: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Returns a mask (m,) of the joint vectors q that are surely the solutions nearest to ``near``.

    A solution is the only one within 2σ/K, σ being the smallest singular value of the Jacobian there and K a Lipschitz
    constant of the Jacobian (the mean value theorem; Newton–Kantorovich). In the embedding of :func:`_embedded` the
    second derivatives by two joints are at most √2 long (1 of the rotation, 1 of the translation), which makes
    K ≤ √2 n ‖coupling‖². A distance up to σ/K is therefore the least.
    """
    bound = np.sqrt(2) * q.shape[1] * np.linalg.norm(problem.robot.coupling, 2) ** 2
    return np.linalg.norm(q - near, axis=1) <= _smallest(problem, q) / bound


def _nearest_around(problem: InverseProblem, poses: Poses, q: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Returns the solutions nearest to ``near`` among q and neighbours, which are along the weakest direction."""
    if not len(q):
        return q
    weakest = np.linalg.svd(problem.jacobian(q))[2][:, q.shape[1] - 1]
    best, distance = q.copy(), np.linalg.norm(q - near, axis=1)
    for side in (-2, -1, 1, 2):
        start = q + side * distance[:, None] * weakest
        neighbour, inside = _turned(problem, solve(problem, poses, start), near)
        away = np.linalg.norm(neighbour - near, axis=1)
        nearer = inside & _is_reached(problem, problem.errors(poses, neighbour))
        nearer &= away < np.linalg.norm(best - near, axis=1)
        best[nearer] = neighbour[nearer]
    return best


def _smallest(problem: InverseProblem, q: np.ndarray) -> np.ndarray:
    """Returns the smallest singular value (m,) of the unitless Jacobian."""
    if not len(q):
        return np.zeros(0)
    return np.linalg.svd(problem.jacobian(q), compute_uv=False)[:, -1]


def _judge(problem: InverseProblem, poses: Poses, q: np.ndarray) -> Inverse:
    """Returns the status of joint vectors, ignoring limits."""
    off = problem.errors(poses, q)
    error_mm, error_rad = np.linalg.norm(off[:, 3:], axis=1), np.linalg.norm(off[:, :3], axis=1)
    reached, singular = _is_reached(problem, off), _smallest(problem, q) < SINGULAR
    status = np.where(~reached, UNREACHABLE, np.where(singular, SINGULAR_POSE, REACHED)).astype(object)
    status[reached & (error_rad > WITHIN_RAD)] = ORIENTATION
    return Inverse(q * problem.unit, tuple(status), error_mm, error_rad)


def _finished(problem: InverseProblem, poses: Poses, q: np.ndarray, ok: np.ndarray, beyond: np.ndarray) -> Inverse:
    """Returns all joint vectors with status; for a pose not reached, the local minimum of error within the limits."""
    q = q.copy()
    missing = np.flatnonzero(~ok)
    if len(missing):
        q[missing] = solve(problem, poses[missing], problem.clipped(q[missing]), problem.bounds)
    judged = _judge(problem, poses, q)
    # An arm of more than six joints may get there on the second way, within the limits.
    status = [s if ok[i] or s != UNREACHABLE else (LIMIT if beyond[i] else s) for i, s in enumerate(judged.status)]
    return Inverse(judged.q, tuple(status), judged.error_mm, judged.error_rad)
