"""Inverse kinematics of any serial arm: many poses at once, joint limits, nearest branch."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import KDTree

from stcal.errors import InputError
from stcal.geometry.arrays import Brief, freeze, frozen, require_arguments
from stcal.geometry.rigid import Poses, Rigid
from stcal.robot.kinematics.forward import flange_poses, from_base, tool_jacobian
from stcal.robot.kinematics.robot_model import Robot

DONE_MM, DONE_RAD = 1e-10, 1e-13  # errors at which iteration ends, one digit below the tolerance of a reached pose
WITHIN_MM, WITHIN_RAD = 1e-9, 1e-12
"""Errors below which a pose counts as reached: far below any measurement, above the rounding of a chain of metres."""
LONGEST, LEAST_DAMPING = 1.0, 1e-14
"""Longest step of a joint, rad or fraction of the reach, and smallest damping, for singular Jacobians."""
ORIENTATION_WEIGHT = 0.03  # weight of the orientation for arms of fewer than six joints, whose position has priority
LIMIT_SLACK = 1e-9  # largest excess over joint limits that counts as rounding, rad (or shares of the reach)
SINGULAR = 1e-5
"""Smallest singular value (no unit) below which joint values are not determined, as an error of 1e-12 leaves 1e-6."""
POOL, STARTS = 4096, 96  # joint vectors over the range, and nearest that are starts: 96 miss none of 2738 branches
SAME_BRANCH, SHORT = 1e-4, 0.1
"""Distances of joint vectors, rad, below which they are one solution, and up to which others are sought nearby only."""
AS_GOOD = 2.0
"""Largest ratio of an orientation error to the least one that counts as equally good, for arms with few joints."""
GROUP = 2048  # number of poses processed at a time if all branches are sought
TURN = 2 * np.pi

REACHED, ORIENTATION, SINGULAR_POSE = "reached", "orientation", "singular"
LIMIT, UNREACHABLE = "limit", "unreachable"


def reach_mm(robot: Robot, tools: Iterable[str]) -> float:
    """Returns an upper bound, mm, of the distance from the first joint to any of the tools: all links and travels."""
    whole, travel = robot.chain(), np.abs(robot.limits()[robot.prismatic])
    links = []
    for tool in tools:
        path = whole.branch(tool).path()
        end = whole.ends[path[-1]] @ robot.tool(tool)
        links.append(np.linalg.norm([*whole.translation[list(path[1:])], end.translation], axis=1).sum())
    return float(max(max(links) + travel[np.isfinite(travel)].sum(), 1.0))


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Inverse(Brief):
    """Joint vectors found for m poses.

    ``q`` : (m, n) values of the controller, rad or mm, within the limits; of a pose not reached the nearest tried.
    ``status`` : (m,) ``reached``; ``singular``: reached, but not by these values alone; ``orientation``: position
    reached, orientation as near as fewer than six joints allow; ``limit``: reached only beyond the limits;
    ``unreachable``: no joint vector found. ``error_mm``, ``error_rad`` : (m,) remaining errors.
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

    def with_rows(self, rows: Sequence[int], other: "Inverse") -> "Inverse":
        """Returns these joint vectors, with those of ``other`` in some rows."""
        q, status = self.q.copy(), np.array(self.status, object)
        error_mm, error_rad = self.error_mm.copy(), self.error_rad.copy()
        q[rows], status[rows], error_mm[rows], error_rad[rows] = other.q, other.status, other.error_mm, other.error_rad
        return Inverse(q, tuple(status), error_mm, error_rad)

    @property
    def usable(self) -> np.ndarray:
        """Mask (m,) of poses with the tool at the wanted place: reached, singular, or orientation."""
        return np.isin(np.array(self.status, str), (REACHED, SINGULAR_POSE, ORIENTATION))


@require_arguments
def inverse(
    robot: Robot, poses: Poses, near: ArrayLike | None = None, tool: str = "", payload_kg: float | None = None
) -> Inverse:
    """Returns joint vectors q that bring the tool to ``poses``: forward(robot, q) = base_from_tool.

    Of all branches and turns within the joint limits, the one nearest to ``near`` is returned (Euclidean distance, rad,
    prismatic joints in shares of the reach). No other branch is tried if the step from ``near`` is surely the shortest;
    up to 0.1 rad others are sought nearby, else all are compared. The solutions of an arm with more than six joints are
    not isolated; one near to ``near`` is returned.

    ``robot`` : an arm of n joints; where its base stands does not matter; ``poses`` : m transforms base_from_tool, mm;
    ``near`` : (m, n) or (n,) reference values of the controller, rad or mm; without it the first pose gets the branch
    nearest to the middle of the limits (0 where unlimited), and every other the one nearest to that of the pose before;
    ``tool`` : name of the tool; ``payload_kg`` : mass at the flange; that of the robot if not given. No pose raises an
    error: the result has joint vectors (m, n), and for each whether it reaches its pose.

    Raises InputError: ``near`` of another shape or not finite; a robot of more than six joints without ``near``; an
    unknown tool; a mass that no arm carries.

    References
    ----------
    J. Fan, Y. Yuan, "On the quadratic convergence of the Levenberg–Marquardt method without nonsingularity
    assumption", Computing 74, 2005.
    """
    m, n = len(poses), len(robot.rows)
    problem = InverseProblem(robot if payload_kg is None else robot.loaded(payload_kg), tool)
    if near is None:
        problem.refuse_redundant()
        return problem.searched(poses, np.zeros((m, n)), np.zeros(m, bool), None)
    near = frozen(near, None, "reference joint values")
    if near.shape not in ((n,), (m, n)):
        raise InputError("E-ARRAY-SHAPE", f"reference joint values: shape {near.shape}, ({n},) or ({m}, {n}) needed")
    near = np.broadcast_to(near, (m, n)) / problem.unit
    return problem.searched(poses, *problem.from_near(poses, near), near)


@require_arguments
def branches(robot: Robot, pose: Rigid, tool: str = "") -> Inverse:
    """Returns all joint vectors (k, n) within the limits that bring the tool to a pose, one for each branch.

    ``robot`` : an arm of at most six joints; where its base stands does not matter; ``pose`` : base_from_tool, mm;
    ``tool`` : its name. Values that differ by 2π are one branch, with the value nearest to the middle of the limits;
    the branch nearest to it is the first. At a singular pose only some of the continuum of solutions are returned. The
    search has many starts, the same every time. Raises InputError: more than six joints, and so infinitely many
    solutions; or an unknown tool.
    """
    problem = InverseProblem(robot, tool)
    problem.refuse_redundant()
    poses = Poses.of([pose])
    solutions, inside = problem.turned(problem.every_solution(poses)[0], problem.middle)
    kept: list[np.ndarray] = []
    for q in solutions[inside]:
        if all(np.abs(q - other).max() > SAME_BRANCH for other in kept):
            kept.append(q)
    solutions = np.array(kept).reshape(-1, solutions.shape[1])
    judged = problem.judge(poses[np.zeros(len(solutions), int)], solutions)
    keep = np.flatnonzero(judged.usable & _as_good(judged.error_rad))
    order = keep[np.argsort(np.linalg.norm(solutions[keep] - problem.middle, axis=1), kind="stable")]
    status = tuple(judged.status[i] for i in order)
    return Inverse(judged.q[order], status, judged.error_mm[order], judged.error_rad[order])


def _as_good(error_rad: np.ndarray) -> np.ndarray:
    """Returns which orientation errors are at most ``AS_GOOD`` times the least; with six joints all reached poses."""
    return error_rad <= AS_GOOD * error_rad.min(initial=np.inf) + WITHIN_RAD


class InverseProblem:
    """An arm with a tool, in unitless joint values: ``unit`` (n,) rad or mm; ``reach`` mm; ``bounds`` (n, 2);
    ``middle`` (n,), 0 if unlimited; ``turns`` (n,) whether 2π more is the same; ``few`` : fewer than six joints."""

    def __init__(self, robot: Robot, tool: str = ""):
        self.robot, self.reach = robot, reach_mm(robot, [tool])
        self.chain, self.flange_from_tool = from_base(robot, tool)
        self.unit = np.where(robot.prismatic, self.reach, 1.0)
        self.bounds = robot.limits() / self.unit[:, None]
        finite = np.isfinite(self.bounds)
        middle = np.where(finite.all(axis=1), np.where(finite, self.bounds, 0.0).mean(axis=1), 0.0)
        self.middle = np.clip(middle, *self.bounds.T)
        # A whole turn of the controller's value leaves the arm in place only if the coupling maps it to whole turns.
        coupling, sliding = robot.coupling, robot.prismatic
        whole = np.isclose(coupling, np.round(coupling)) & ~(sliding[:, None] & (coupling != 0))
        self.turns = ~sliding & whole.all(axis=0)
        self.few = len(self.chain.path()) < 6

    def refuse_redundant(self) -> None:
        if (n := len(self.unit)) > 6:
            fault = f"robot {self.robot.name}: {n} joints reach a pose in infinitely many ways"
            raise InputError("E-ROBOT-REDUNDANT", f"{fault}; give the joint values to stay near to (columns q1_deg …)")

    def errors(self, poses: Poses, q: np.ndarray) -> np.ndarray:
        """Returns (m, 6) differences from the poses that q reaches to ``poses``: rad, mm."""
        return poses.difference(self.reached(q))

    def reached(self, q: np.ndarray) -> Poses:
        """Returns base_from_tool of joint vectors (m, n)."""
        return flange_poses(self.chain, q * self.unit) @ self.flange_from_tool

    def jacobian(self, q: np.ndarray) -> np.ndarray:
        """Returns the unitless Jacobian, (m, 6, n)."""
        derivative = tool_jacobian(self.chain, self.flange_from_tool, q * self.unit) * self.unit
        derivative[:, 3:] /= self.reach
        return derivative

    def solve(self, poses: Poses, q: np.ndarray, bounds: np.ndarray | None = None) -> np.ndarray:
        """Returns joint vectors (m, n) of least error from starts q, also where a pose is out of reach."""
        q = q.copy()
        if not len(q):
            return q
        low, high = (-np.inf, np.inf) if bounds is None else bounds.T
        balance = np.repeat([ORIENTATION_WEIGHT if self.few else 1.0, 1.0], 3)
        weight = balance / np.repeat([1.0, self.reach], 3)  # the Jacobian's translation is in shares of the reach
        rows, goal = np.arange(len(q)), poses
        error = self.errors(goal, q)
        damping, going = np.full(len(q), 1e-2), np.ones(len(q), bool)
        for _ in range(60):  # at a fold every step halves the distance: 1 to 1e-12 takes 40
            going &= ~((np.abs(error[:, :3]).max(axis=1) <= DONE_RAD) & (np.abs(error[:, 3:]).max(axis=1) <= DONE_MM))
            rows, goal, error, damping = rows[going], goal[going], error[going], damping[going]
            if not len(rows):
                break
            at, weighted = q[rows], error * weight
            derivative = self.jacobian(at) * balance[:, None]
            pull = np.einsum("mij,mi->mj", derivative, weighted)
            held = ((at <= low) & (pull < 0)) | ((at >= high) & (pull > 0))  # do not move beyond their limits
            derivative, pull = np.where(held[:, None], 0.0, derivative), np.where(held, 0.0, pull)
            normal = np.einsum("mij,mik->mjk", derivative, derivative)
            diagonal = np.arange(normal.shape[1])
            size = np.einsum("mi,mi->m", weighted, weighted)
            normal[:, diagonal, diagonal] += np.maximum(damping * size, LEAST_DAMPING)[:, None]
            step = np.linalg.solve(normal, pull[..., None])[..., 0]
            longest = np.abs(step).max(axis=1, keepdims=True)
            trial = np.clip(at + step * np.minimum(1, LONGEST / np.maximum(longest, 1e-300)), low, high)
            new = self.errors(goal, trial)
            better = np.linalg.norm(new * weight, axis=1) < np.linalg.norm(weighted, axis=1)
            q[rows[better]] = trial[better]
            error = np.where(better[:, None], new, error)
            damping = np.clip(np.where(better, damping / 5, damping * 5), 1e-12, 1e12)
            stuck = (np.abs(trial - q[rows]).max(axis=1) < 1e-15) & ~better
            going = ~(stuck | (np.linalg.norm(pull, axis=1) < 1e-15))
        for _ in range(4 if self.few else 0):  # minimum-norm steps remove what the orientation's weight left
            off = self.errors(poses, q)[:, 3:] / self.reach
            near = np.linalg.norm(off, axis=1) < ORIENTATION_WEIGHT  # poses farther off stay out of reach
            derivative = np.where(((q <= low) | (q >= high))[:, None], 0.0, self.jacobian(q)[:, 3:])
            step = np.einsum("mji,mi->mj", np.linalg.pinv(derivative, rcond=1e-9), off)
            q = np.clip(np.where(near[:, None], q + step, q), low, high)
        return q

    def from_near(self, poses: Poses, near: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns joint vectors (m, n) by descent from ``near``, and a mask (m,) of those that are surely nearest."""
        isolated = len(self.unit) <= 6
        begin = near if isolated else np.clip(near, *self.bounds.T)
        q, inside = self.turned(self.solve(poses, begin, None if isolated else self.bounds), near)
        ok = inside & self.judge(poses, q).usable
        if isolated:
            doubtful = ok & ~self._is_nearest(q, near)
            q[doubtful] = self._nearest_around(poses[doubtful], q[doubtful], near[doubtful])
            ok &= ~doubtful | (np.linalg.norm(q - near, axis=1) <= SHORT)
        return q, ok

    def searched(self, poses: Poses, q: np.ndarray, ok: np.ndarray, near: np.ndarray | None) -> Inverse:
        """Returns all joint vectors, after a search where q is not ``ok`` (m,): nearest to ``near`` (m, n), or to the
        solution before; for a pose not reached, the local minimum of error within the limits."""
        q, rest, beyond, last = q.copy(), np.flatnonzero(~ok), np.zeros(len(poses), bool), self.middle
        for start in range(0, len(rest), GROUP):
            part = rest[start : start + GROUP]
            every = self.every_solution(poses[part], None if near is None else q[part])
            for i, solutions in zip(part, every, strict=True):
                q[i] = last if near is None else near[i]
                best, beyond[i] = self._nearest(poses[[i]], solutions, q[i])
                if best is not None:
                    q[i], ok[i] = best, True
                last = q[i]
        missing = np.flatnonzero(~ok)
        q[missing] = self.solve(poses[missing], np.clip(q[missing], *self.bounds.T), self.bounds)
        return self.judge(poses, q, beyond)

    def every_solution(self, poses: Poses, more: np.ndarray | None = None) -> list[np.ndarray]:
        """Returns for each pose joint vectors (k, n) from many starts and ``more`` (m, n), ignoring limits."""
        from scipy.stats import qmc  # loads for a third of a second

        n, m = len(self.unit), len(poses)
        half = np.diff(self.bounds, axis=1)[:, 0] / 2
        one_turn = np.minimum(np.pi, half)  # of more than a turn one turn is enough
        half = np.where(self.turns, one_turn, np.where(np.isfinite(half), half, 1.0))
        pool = self.middle + (2 * qmc.Halton(n, scramble=False).random(POOL + 1)[1:] - 1) * half
        tree = KDTree(self._embedded(self.reached(pool)))
        chosen = tree.query(self._embedded(poses), k=STARTS)[1].ravel()
        found = self.solve(poses[np.repeat(np.arange(m), STARTS)], pool[chosen]).reshape(m, STARTS, n)
        return list(found if more is None else np.concatenate([more[:, None], found], axis=1))

    def _embedded(self, poses: Poses) -> np.ndarray:
        """Returns points (m, 12) whose distances are those of poses: chord of the rotation and shares of the reach."""
        return np.hstack([poses.rotation.reshape(-1, 9) / np.sqrt(2), poses.translation / self.reach])

    def _nearest(self, pose: Poses, solutions: np.ndarray, near: np.ndarray) -> tuple[np.ndarray | None, bool]:
        """Returns the nearest solution within the limits or None, and whether only solutions beyond them reach."""
        turned, inside = self.turned(solutions, near)
        off = self.errors(pose[np.zeros(len(turned), int)], turned)
        good = self._is_reached(off)
        good[good] = _as_good(np.linalg.norm(off[good, :3], axis=1))
        eligible = turned[good & inside]
        if not len(eligible):
            return None, bool(good.any())
        return eligible[np.linalg.norm(eligible - near, axis=1).argmin()], False

    def _is_reached(self, off: np.ndarray) -> np.ndarray:
        """Returns (m,) whether errors (m, 6), rad and mm, are within tolerance; of few joints: the position."""
        position = np.linalg.norm(off[:, 3:], axis=1) <= WITHIN_MM
        return position & ((np.linalg.norm(off[:, :3], axis=1) <= WITHIN_RAD) | self.few)

    def turned(self, q: np.ndarray, near: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns joint values turned to be nearest to ``near`` within limits, and a mask (m,) of those within."""
        low, high = self.bounds.T
        turned = q + TURN * np.round((near - q) / TURN)
        with np.errstate(invalid="ignore"):  # inf − inf never occurs, inf / 2π does
            turned = turned - TURN * np.ceil(np.maximum(turned - high - LIMIT_SLACK, 0) / TURN)
            turned = turned + TURN * np.ceil(np.maximum(low - turned - LIMIT_SLACK, 0) / TURN)
        turned = np.where(self.turns, turned, q)
        return turned, ((turned >= low - LIMIT_SLACK) & (turned <= high + LIMIT_SLACK)).all(axis=1)

    def _is_nearest(self, q: np.ndarray, near: np.ndarray) -> np.ndarray:
        """Returns a mask (m,) of the joint vectors q that are surely the solutions nearest to ``near``. A solution is
        the only one within 2σ/K, σ the smallest singular value of the Jacobian there and K its Lipschitz constant
        (Newton–Kantorovich), which in the embedding of :meth:`_embedded` is at most √2 n ‖coupling‖²."""
        bound = np.sqrt(2) * q.shape[1] * np.linalg.norm(self.robot.coupling, 2) ** 2
        return np.linalg.norm(q - near, axis=1) <= self._weakest(q) / bound

    def _nearest_around(self, poses: Poses, q: np.ndarray, near: np.ndarray) -> np.ndarray:
        """Returns the solutions nearest to ``near`` among q and neighbours, which are along the weakest direction."""
        if not len(q):
            return q
        weakest = np.linalg.svd(self.jacobian(q))[2][:, q.shape[1] - 1]
        best, distance = q.copy(), np.linalg.norm(q - near, axis=1)
        for side in (-2, -1, 1, 2):
            neighbour, inside = self.turned(self.solve(poses, q + side * distance[:, None] * weakest), near)
            nearer = inside & self._is_reached(self.errors(poses, neighbour))
            nearer &= np.linalg.norm(neighbour - near, axis=1) < np.linalg.norm(best - near, axis=1)
            best[nearer] = neighbour[nearer]
        return best

    def _weakest(self, q: np.ndarray) -> np.ndarray:
        """Returns the smallest singular value (m,) of the unitless Jacobian."""
        return np.linalg.svd(self.jacobian(q), compute_uv=False)[:, -1] if len(q) else np.zeros(0)

    def judge(self, poses: Poses, q: np.ndarray, beyond: np.ndarray | bool = False) -> Inverse:
        """Returns the status of joint vectors; ``beyond`` : (m,) whether others, beyond the limits, reach the pose."""
        off = self.errors(poses, q)
        error_mm, error_rad = np.linalg.norm(off[:, 3:], axis=1), np.linalg.norm(off[:, :3], axis=1)
        reached, singular = self._is_reached(off), self._weakest(q) < SINGULAR
        missed = np.where(beyond, LIMIT, UNREACHABLE)
        status = np.where(reached, np.where(singular, SINGULAR_POSE, REACHED), missed).astype(object)
        status[reached & (error_rad > WITHIN_RAD)] = ORIENTATION
        return Inverse(q * self.unit, tuple(status), error_mm, error_rad)
