"""Least squares on a manifold: the package's only descent, for one problem or many, also with several minima."""

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, fields
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from stcal.errors import ConvergenceError
from stcal.geometry.rigid import Poses
from stcal.geometry.robust import huber_cost, huber_weights

MAX_STEPS = 200
SETTLED = 1e-12
"""Largest predicted decrease of the last step, as a share of the cost; such a step moves nothing by 1e-4 σ."""
LEAST_GAIN = 1e-12
"""Decrease that rounding alone predicts for exact data, in units of σ²: a step of a millionth of σ."""
ROUNDING = 1e-12  # share of the cost by which rounding may seem to raise the cost at the minimum
MAX_DAMPING = 1e12
UNKEPT, KEPT = 1e-8, 0.1
"""A descent ends if a decrease of at most ``UNKEPT`` σ² is predicted, and less than ``KEPT`` of it comes."""
TRUSTED = 0.5  # ratio of actual to predicted decrease above which the damping shrinks; below KEPT it grows
DAMPED = 1e-4
"""Largest predicted decrease of an undamped step at which a damped descent counts as ended, in units of σ²: a step of a
hundredth of σ. Where the derivatives neglect the curvature of the residuals, only damped steps lower the cost."""
NEARLY_WHOLE = 1e-3
"""Largest damping at which a step's predicted decrease stands for that of the undamped step."""
SLOW = 0.01
"""A problem whose excess over the best cost is beyond ``hopeless`` is given up if it falls by less than this share."""
TINY = 1e-300


class Linear(Protocol):
    """A least-squares problem, linearised about a state."""

    @property
    def cost(self) -> float | np.ndarray:
        """Cost of the state, in units of σ²; (h,) for h problems at once; infinite where the state is impossible."""
        ...

    def step(self, damping: float | np.ndarray) -> tuple[np.ndarray, float | np.ndarray]:
        """Return the damped step, (k,) or (h, k), and the predicted decrease of the cost."""
        ...


S = TypeVar("S")
L = TypeVar("L", bound=Linear)


@dataclass(frozen=True, slots=True, eq=False)
class NormalEquations:
    """Normal equations of one problem, or of h problems at once. A parameter that nothing determines is not moved."""

    cost: float | np.ndarray
    normal: np.ndarray  # (..., k, k)
    gradient: np.ndarray  # (..., k) half of that of the cost

    @classmethod
    def of(cls, residual: np.ndarray, jacobian: np.ndarray) -> "NormalEquations":
        """Return the normal equations of residuals (n,) and their derivatives (n, k), both divided by σ."""
        return cls(float(residual @ residual), jacobian.T @ jacobian, jacobian.T @ residual)

    @classmethod
    def impossible(cls, count: int) -> "NormalEquations":
        """Return the equations of an inadmissible state with ``count`` parameters: the cost is infinite."""
        return cls(np.inf, np.eye(count), np.zeros(count))

    def __add__(self, other: "NormalEquations") -> "NormalEquations":
        return NormalEquations(self.cost + other.cost, self.normal + other.normal, self.gradient + other.gradient)

    def step(self, damping: float | np.ndarray) -> tuple[np.ndarray, float | np.ndarray]:
        """See :meth:`Linear.step`."""
        scale = np.sqrt(np.maximum(np.einsum("...ii->...i", self.normal), TINY))
        normal, slope = self.normal / scale[..., :, None] / scale[..., None, :], self.gradient / scale
        damped = normal + np.asarray(damping)[..., None, None] * np.eye(scale.shape[-1])
        step = -np.linalg.solve(damped, slope[..., None])[..., 0]
        gain = -(2 * (slope * step).sum(-1) + np.einsum("...i,...ij,...j", step, normal, step))
        return step / scale, gain


@dataclass(frozen=True, slots=True, eq=False)
class Minimum(Generic[S, L]):
    """End of a descent."""

    state: S
    linear: L  # the problem linearised about the state
    converged: np.ndarray  # whether it is a minimum
    promised: np.ndarray  # decrease of the cost that the last step promised, in σ²
    steps: int

    def required(self, what: str, remedy: str, accepted: float = 0.0) -> "Minimum[S, L]":
        """Return this result if it is a minimum, or if the last predicted decrease is at most ``accepted``, in σ²."""
        if not (self.converged | (self.promised <= accepted)).all():
            fault = f"{what}: no minimum after {self.steps} steps, the last was to gain {np.max(self.promised):.2g} σ²"
            raise ConvergenceError("E-NO-MINIMUM", f"{fault}; {remedy}")
        return self


def minimise(
    state: S,
    linearise: Callable[[S], L],
    moved: Callable[[S, np.ndarray], S],
    cost: Callable[[S], float] | None = None,
    select: Callable[[np.ndarray, Any, Any], Any] = lambda take, new, old: new if take else old,
    damping: float = 1e-4,
    least_damping: float = 1e-12,
    settled: float = SETTLED,
    least_gain: float = LEAST_GAIN,
    max_steps: int = MAX_STEPS,
    hopeless: float = np.inf,
) -> Minimum[S, L]:
    """Return the state of least cost, of one problem, or of h problems at once if costs are (h,), found from a
    start. ``linearise`` : returns the problem about a state; ``moved`` : a state after a step (k,), or (h, k);
    ``cost`` : that of a state, where it is cheaper, so that accepted states alone are linearised; ``select`` :
    returns the new state or :class:`Linear` where ``take`` (h,), else the old one; ``damping``, ``least_damping`` :
    at the start, and the lower limit, which regularises what nothing determines; ``settled``, ``least_gain`` : a
    minimum is reached when the next undamped step promises at most ``settled`` times the cost plus ``least_gain``,
    in σ²; ``hopeless`` : excess of a problem's cost over the best one up to which it is followed to its end; see
    :data:`SLOW`."""
    current = linearise(state)
    damp = np.full(np.shape(current.cost), float(damping))
    done = np.zeros(damp.shape, bool)
    converged, promised = done.copy(), np.full(damp.shape, np.inf)
    for steps in range(max_steps + 1):
        step, gain = current.step(damp)
        limit = settled * np.asarray(current.cost) + least_gain
        small = (gain <= limit) & np.isfinite(current.cost)
        if (small & ~done & (damp > NEARLY_WHOLE)).any():
            whole = current.step(np.full(damp.shape, least_damping))[1]
            small &= (damp <= NEARLY_WHOLE) | (whole <= np.maximum(limit, DAMPED))
        promised = np.where(done, promised, gain)
        if steps == max_steps:
            break
        with np.errstate(invalid="ignore"):  # both costs may be infinite
            behind = current.cost - np.min(current.cost)
        done |= (behind > hopeless) & (gain < SLOW * behind)
        last = done | small | (damp > MAX_DAMPING)
        trial = moved(state, np.where(done[..., None], 0.0, step))
        if cost:
            trial_linear, reached = None, cost(trial)
        else:
            trial_linear = linearise(trial)
            reached = trial_linear.cost
        better = (reached <= np.asarray(current.cost) * (1 + ROUNDING)) & ~done
        with np.errstate(invalid="ignore"):
            fall = current.cost - reached
        unkept = (gain <= UNKEPT) & (fall < KEPT * gain) & (damp <= NEARLY_WHOLE)
        converged |= (small | unkept) & ~done
        done = last | unkept
        if better.any():
            current = select(better, linearise(trial) if trial_linear is None else trial_linear, current)
            state = select(better, trial, state)
        if done.all():
            break
        damp = np.where(fall < KEPT * gain, np.maximum(10 * damp, NEARLY_WHOLE), damp)
        damp = np.where(fall > TRUSTED * gain, np.maximum(damp / 10, least_damping), damp)
    return Minimum(state, current, converged, promised, steps)


MAX_POSE_STEPS = 60
ACCEPTED = 1e-2
"""Largest predicted decrease, in σ², that counts as settled after the last step: flat valleys need many steps."""


@dataclass(frozen=True, slots=True, eq=False)
class Normal(NormalEquations):
    """Normal equations of h poses, and ``length`` (h, n) of the residuals in σ."""

    cost: np.ndarray
    length: np.ndarray

    @classmethod
    def of(cls, residual: np.ndarray, by_pose: np.ndarray, possible: np.ndarray, huber: float) -> "Normal":
        """Return the normal equations of Huber's loss on the lengths of whitened residuals (h, n, 2). ``by_pose`` :
        (h, n, 2, 6) negative derivatives; the cost is infinite where a pose is not ``possible`` (h,)."""
        length = np.sqrt((residual**2).sum(2))
        cost = np.where(possible, huber_cost(length, huber).sum(1), np.inf)
        h = len(residual)
        flat = by_pose.reshape(h, -1, 6)
        weight = np.repeat(huber_weights(length, huber), 2, axis=1)[..., None]
        back = np.swapaxes(weight * flat, 1, 2)
        return cls(cost, back @ flat, -(back @ residual.reshape(h, -1, 1))[..., 0], length)


@dataclass(frozen=True, slots=True, eq=False)
class Minima:
    """h poses at their minima."""

    poses: Poses
    cost: np.ndarray  # (h,)
    normal: np.ndarray  # (h, 6, 6)
    length: np.ndarray  # (h, n) of the residuals in σ
    settled: np.ndarray  # (h,)

    def rows(self, index) -> "Minima":
        """Return the minima that a list, a mask or a slice selects."""
        return Minima(self.poses[index], self.cost[index], self.normal[index], self.length[index], self.settled[index])

    def ordered(self) -> "Minima":
        """Return the minima by their costs."""
        return self.rows(np.argsort(self.cost, kind="stable"))


def descend(evaluate: Callable[[Poses], Normal], poses: Poses, settled: float, hopeless: float = np.inf) -> Minima:
    """Return the minima reached from h poses at once; a step that lowers χ² by less than ``settled``, or by less than
    this share, is the last, and so is any one of a pose whose χ² exceeds the best one by ``hopeless``."""
    result = minimise(
        poses,
        evaluate,
        Poses.moved,
        select=select_rows,
        damping=1e-6,
        settled=settled,
        least_gain=settled,
        max_steps=MAX_POSE_STEPS,
        hopeless=hopeless,
    )
    last = result.linear
    ended = result.converged | (result.promised < ACCEPTED) | (last.cost - last.cost.min() > hopeless)
    return Minima(result.state, last.cost, last.normal, last.length, ended)


def select_rows(take: np.ndarray, new, old):
    """Return the rows of the new poses, or normal equations, where ``take`` (h,) is True, else of the old ones."""

    made = copy(new)
    for field in fields(new):
        a, b = getattr(new, field.name), getattr(old, field.name)
        object.__setattr__(made, field.name, np.where(take.reshape(-1, *[1] * (a.ndim - 1)), a, b))
    return made


def block_diagonal(blocks: np.ndarray) -> np.ndarray:
    """Return block-diagonal matrices (…, n·a, n·b) of blocks (…, n, a, b)."""
    *stack, n, a, b = blocks.shape
    full = np.zeros((*stack, n, a, n, b))
    every = np.arange(n)
    full[..., every, :, every, :] = np.moveaxis(blocks, -3, 0)
    return full.reshape(*stack, n * a, n * b)
