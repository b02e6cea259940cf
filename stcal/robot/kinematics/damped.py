"""Least squares, damped, for the joint vectors of many poses at once; unitless, lengths as fractions of the reach.

This solver is separate from :func:`stcal.geometry.least_squares.minimise`. It follows thousands of starts, most of
which end early, in shrinking arrays; joints stop at their limits; and the damping is proportional to the squared error,
which keeps steps short where the arm folds. Callers must check whether the result reaches the pose.
"""

from dataclasses import dataclass

import numpy as np

from stcal.geometry.rigid import Poses
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
"""Weight of the orientation for arms of fewer than six joints, whose position has priority. The position error that
remains is removed by :func:`_position_exact`."""


@dataclass(frozen=True, slots=True, eq=False)
class InverseProblem:
    """An arm with a tool, in unitless joint values.

    ``unit`` : (n,) rad or mm that a unitless value of 1 stands for; ``reach`` : mm; ``bounds`` : (n, 2) joint limits;
    ``middle`` : (n,) centre of the bounds, 0 if unlimited; ``turns`` : (n,) true if adding 2π gives the same position.
    """

    robot: Robot
    tool: str
    unit: np.ndarray
    reach: float
    bounds: np.ndarray
    middle: np.ndarray
    turns: np.ndarray

    @classmethod
    def of(cls, robot: Robot, tool: str = "") -> "InverseProblem":
        reach = reach_mm(robot, tool)
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


def reach_mm(robot: Robot, tool: str = "") -> float:
    """Returns an upper bound of the distance from first joint to tool origin, mm: the sum of all links and travels."""
    whole = robot.chain()
    chain = whole.branch(whole.carrier(tool))
    end = chain.last_from_flange @ robot.tool(tool)
    travel = np.abs(robot.limits()[robot.prismatic])
    links = np.linalg.norm(chain.translation[list(chain.path()[1:])], axis=1).sum() + np.linalg.norm(end.translation)
    return float(max(links + travel[np.isfinite(travel)].sum(), 1.0))


def solve(problem: InverseProblem, poses: Poses, q: np.ndarray, bounds: np.ndarray | None = None) -> np.ndarray:
    """Returns unitless joint vectors (m, n) of least error, found from starts q; within ``bounds`` (n, 2) if given.

    A pose that cannot be reached raises no error: the result is then a local minimum of the error.
    """
    q = q.copy()
    if not len(q):
        return q
    weight = np.full(6, 1.0)
    weight[3:] = 1 / problem.reach
    if problem.under_actuated:
        weight[:3] = ORIENTATION_WEIGHT
    rows, goal = np.arange(len(q)), poses
    error = problem.errors(goal, q)
    damping = np.full(len(q), 1e-2)
    for _ in range(ROUNDS):
        going = ~_done(error)
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
        keep = ~stuck
        rows, goal, error, damping = rows[keep], goal[keep], error[keep], damping[keep]
    return _position_exact(problem, poses, q, bounds) if problem.under_actuated else q


def _done(off: np.ndarray) -> np.ndarray:
    return (np.abs(off[:, :3]).max(axis=1) <= DONE_RAD) & (np.abs(off[:, 3:]).max(axis=1) <= DONE_MM)


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
