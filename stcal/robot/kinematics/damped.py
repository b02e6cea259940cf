"""Damped least squares for joint vectors, many poses at once; without unit, lengths in shares of the arm's reach.

This descent stands apart from :func:`stcal.geometry.least_squares.minimise`: thousands of starts, most of which end
early, are followed in shrinking arrays, joints stop at their limits, and the damping is a share of the squared error,
which keeps steps short where the arm folds. Callers look at what was reached, so that none passes for a solution.
"""

from dataclasses import dataclass

import numpy as np

from stcal.geometry.rigid import Poses
from stcal.robot.kinematics.forward import forward, jacobian
from stcal.robot.kinematics.model import Robot

ROUNDS = 60
"""At a fold every step halves the distance: 40 to come from 1 to 1e-12."""
DONE_MM, DONE_RAD = 1e-10, 1e-13
"""Iteration ends here, a digit below what counts as reached."""
LONGEST = 1.0
"""Longest step of a joint, rad or share of the reach: beyond it the linear model says nothing."""
LEAST_DAMPING = 1e-14
"""Keeps the normal equations regular where the Jacobian is not."""
ORIENTATION_WEIGHT = 0.03
"""Of arms that cannot choose the orientation: position first. What this leaves of the position is taken away after."""


@dataclass(frozen=True, slots=True, eq=False)
class InverseProblem:
    """An arm with a tool, without unit.

    ``unit`` : (n,) rad or mm of a joint's value 1; ``reach`` : mm; ``bounds`` : (n, 2); ``middle`` : (n,) of the
    bounds, 0 where there are none; ``turns`` : (n,) whether 2π more is the same place.
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
        # A turn of the controller's value is one of the arm only if coupling makes whole turns of it.
        whole = np.isclose(robot.coupling, np.round(robot.coupling)) & ~(sliding[:, None] & (robot.coupling != 0))
        return cls(robot, tool, unit, reach, bounds, middle, ~sliding & whole.all(axis=0))

    @property
    def under_actuated(self) -> bool:
        chain = self.robot.chain()
        return len(chain.branch(chain.carrier(self.tool)).path()) < 6

    def clipped(self, q: np.ndarray) -> np.ndarray:
        return np.clip(q, *self.bounds.T)

    def errors(self, poses: Poses, q: np.ndarray) -> np.ndarray:
        """(m, 6) from what q reaches to ``poses``: rad, mm."""
        return poses.difference(forward(self.robot, q * self.unit, self.tool))

    def jacobian(self, q: np.ndarray) -> np.ndarray:
        """(m, 6, n) without unit."""
        found = jacobian(self.robot, q * self.unit, self.tool) * self.unit
        found[:, 3:] /= self.reach
        return found


def reach_mm(robot: Robot, tool: str = "") -> float:
    """No point of the tool's origin is further from the first joint: the lengths of all links, and travels, added."""
    whole = robot.chain()
    chain = whole.branch(whole.carrier(tool))
    end = chain.last_from_flange @ robot.tool(tool)
    travel = np.abs(robot.limits()[robot.prismatic])
    links = np.linalg.norm(chain.translation[list(chain.path()[1:])], axis=1).sum() + np.linalg.norm(end.translation)
    return float(max(links + travel[np.isfinite(travel)].sum(), 1.0))


def solve(problem: InverseProblem, poses: Poses, q: np.ndarray, bounds: np.ndarray | None = None) -> np.ndarray:
    """Joint vectors (m, n), without unit, from starts q to least error; within ``bounds`` (n, 2) where given.

    Nothing is raised where a pose cannot be reached: the result is then a local minimum of the error.
    """
    q = q.copy()
    if not len(q):
        return q
    weight = np.full(6, 1.0)
    weight[3:] = 1 / problem.reach
    if problem.under_actuated:
        weight[:3] = ORIENTATION_WEIGHT
    at, goal = np.arange(len(q)), poses
    off = problem.errors(goal, q)
    damping = np.full(len(q), 1e-2)
    for _ in range(ROUNDS):
        going = ~_done(off)
        at, goal, off, damping = at[going], goal[going], off[going], damping[going]
        if not len(at):
            break
        step, gain = _step(problem, q[at], off, weight, damping, bounds)
        trial = q[at] + step
        if bounds is not None:
            trial = np.clip(trial, *bounds.T)
        new = problem.errors(goal, trial)
        better = np.linalg.norm(new * weight, axis=1) < np.linalg.norm(off * weight, axis=1)
        q[at[better]] = trial[better]
        off = np.where(better[:, None], new, off)
        damping = np.clip(np.where(better, damping / 5, damping * 5), 1e-12, 1e12)
        stuck = (np.abs(trial - q[at]).max(axis=1) < 1e-15) & ~better | (gain < 1e-15)
        keep = ~stuck
        at, goal, off, damping = at[keep], goal[keep], off[keep], damping[keep]
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
    """Damped step (m, n), and (m,) how much of the error the joints can act on."""
    weighted = off * weight
    row = np.where(weight == 1 / problem.reach, 1.0, weight)  # the Jacobian's translation is in shares of the reach
    derivative = problem.jacobian(q) * row[:, None]
    pull = np.einsum("mij,mi->mj", derivative, weighted)
    if bounds is not None:  # a joint at its limit that would go beyond stays
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
    """Shortest steps that take the rest of the position error away; of joints within bounds only, as far as it goes."""
    for _ in range(4):
        off = problem.errors(poses, q)[:, 3:] / problem.reach
        derivative = problem.jacobian(q)[:, 3:]
        near = np.linalg.norm(off, axis=1) < ORIENTATION_WEIGHT  # farther ones are out of reach, and stay as they are
        if bounds is not None:
            low, high = bounds.T
            derivative = np.where(((q <= low) | (q >= high))[:, None], 0.0, derivative)
        step = np.einsum("mji,mi->mj", np.linalg.pinv(derivative, rcond=1e-9), off)
        q = np.where(near[:, None], q + step, q)
        if bounds is not None:
            q = np.clip(q, *bounds.T)
    return q
