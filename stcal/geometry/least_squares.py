"""Least squares on a manifold: the one descent of the package, of one problem or of many at once.

The state moves; the parameters are always small motions about it. Levenberg's damping, scaled by the diagonal
(Marquardt 1963), shrinks with every step that lowers the cost and grows with every one that does not. A minimum is
reached when the next whole step promises to lower the cost, in units of σ², by no more than a share of the cost that
rounding hides.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from stcal.errors import ConvergenceError
from stcal.geometry.rigid import Rigid

MAX_STEPS = 200
SETTLED = 1e-12
"""Share of the cost that the last step may promise: with a cost of 10⁴ it moves no parameter by more than 1e-4 σ, and
what is left after it is far less."""
LEAST_GAIN = 1e-12
"""In units of σ²: what exact data still promise by rounding, a millionth of σ."""
ROUNDING = 1e-12
"""Share of the cost by which a step at the minimum seems to raise it."""
MAX_DAMPING = 1e12
UNKEPT, KEPT = 1e-8, 0.1
"""A promise of so little, in units of σ², of which not even that share is kept, is the last: the rest is rounding."""
TRUSTED = 0.5
"""Share of a promise that was kept, from which on the damping shrinks; below ``KEPT`` it grows."""
DAMPED = 1e-4
"""Where derivatives neglect how residuals bend, only damped steps lower the cost. They may be trusted to have ended
when the whole step promises no more than this, in units of σ²: a hundredth of σ."""
NEARLY_WHOLE = 1e-3
"""Damping up to which a step's promise stands for that of the whole step."""
SLOW = 0.01
"""A problem behind the best one by ``hopeless``, of which a step promises less than this share of that distance, is
not followed further: with large residuals the last steps are many, and short."""
TINY = 1e-300


class Linear(Protocol):
    """A least-squares problem about a state, linear in the parameters."""

    @property
    def cost(self) -> float | np.ndarray:
        """Of the state, in units of σ²; (h,) for h problems at once; infinite where the state is impossible."""
        ...

    def step(self, damping: float | np.ndarray) -> tuple[np.ndarray, float | np.ndarray]:
        """The damped step, (k,) or (h, k), and by how much it promises to lower the cost."""
        ...


S = TypeVar("S")
L = TypeVar("L", bound=Linear)


@dataclass(frozen=True, slots=True, eq=False)
class NormalEquations:
    """``cost`` ; ``normal`` : (k, k); ``gradient`` : (k,) half of the cost's; or (h,), (h, k, k) and (h, k) of h
    problems. A parameter that nothing determines stays where it is."""

    cost: float | np.ndarray
    normal: np.ndarray
    gradient: np.ndarray

    @classmethod
    def of(cls, residual: np.ndarray, jacobian: np.ndarray) -> "NormalEquations":
        """Of residuals (n,) over their σ and their derivatives (n, k)."""
        return cls(float(residual @ residual), jacobian.T @ jacobian, jacobian.T @ residual)

    @classmethod
    def impossible(cls, count: int) -> "NormalEquations":
        """Of a state that must not be taken, with this many parameters."""
        return cls(np.inf, np.eye(count), np.zeros(count))

    @classmethod
    def stacked(cls, each: Sequence["NormalEquations"]) -> "NormalEquations":
        """Of h problems, from those of one each."""
        cost, normal, gradient = (np.array([getattr(one, name) for one in each]) for name in cls.__slots__)
        return cls(cost, normal, gradient)

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
    """Where a descent ended.

    ``linear`` : the problem about ``state``; ``converged`` : whether it is a minimum, (h,) for h problems; ``promised``
    : by how much the last step was to lower the cost, in units of σ²; ``steps`` : that were tried.
    """

    state: S
    linear: L
    converged: np.ndarray
    promised: np.ndarray
    steps: int

    def required(self, what: str, remedy: str, accepted: float = 0.0) -> "Minimum[S, L]":
        """This, if it is a minimum, or if no step promises more than ``accepted``, in units of σ².

        Raises
        ------
        ConvergenceError
            It is none; ``what`` and ``remedy`` begin and end the message.
        """
        if not (self.converged | (self.promised <= accepted)).all():
            raise ConvergenceError(
                "E-NO-MINIMUM",
                f"{what}: no minimum after {self.steps} steps, the last was to gain {np.max(self.promised):.2g} σ²; "
                f"{remedy}",
            )
        return self


def _one(take: np.ndarray, new, old):
    """The new state or the old one, of a single problem."""
    return new if take else old


def minimise(
    state: S,
    linearise: Callable[[S], L],
    moved: Callable[[S, np.ndarray], S],
    cost: Callable[[S], float] | None = None,
    select: Callable[[np.ndarray, Any, Any], Any] = _one,
    damping: float = 1e-4,
    least_damping: float = 1e-12,
    settled: float = SETTLED,
    least_gain: float = LEAST_GAIN,
    max_steps: int = MAX_STEPS,
    hopeless: float = np.inf,
) -> Minimum[S, L]:
    """State of least cost, from a start.

    Parameters
    ----------
    state
        The start; of h problems at once where the costs of ``linearise`` are (h,).
    linearise
        The problem about a state.
    moved
        The state after a step (k,), or (h, k).
    cost
        Cost of a state, if it comes cheaper than ``linearise``, which is then called at accepted states only; of a
        single problem.
    select
        Of (take (h,), new, old) for h problems: the new state and :class:`Linear` where ``take``, else the old ones.
    damping, least_damping
        At the start, and at least: what keeps directions regular that nothing determines.
    settled, least_gain
        A minimum is reached when the next whole step promises no more than this share of the cost plus this much, σ².
    max_steps
        That are tried.
    hopeless
        By how much a problem may be worse than the best of all and still be followed to its end; see :data:`SLOW`.

    Returns
    -------
    Minimum
        It says whether it converged; see :meth:`Minimum.required`.
    """
    here = linearise(state)
    damp = np.full(np.shape(here.cost), float(damping))
    done = np.zeros(damp.shape, bool)
    converged, promised = done.copy(), np.full(damp.shape, np.inf)
    for steps in range(max_steps + 1):
        step, gain = here.step(damp)
        limit = settled * np.asarray(here.cost) + least_gain
        small = (gain <= limit) & np.isfinite(here.cost)
        if (small & ~done & (damp > NEARLY_WHOLE)).any():
            whole = here.step(np.full(damp.shape, least_damping))[1]
            small &= (damp <= NEARLY_WHOLE) | (whole <= np.maximum(limit, DAMPED))
        promised = np.where(done, promised, gain)
        if steps == max_steps:
            break
        with np.errstate(invalid="ignore"):  # two that are impossible
            behind = here.cost - np.min(here.cost)
        done |= (behind > hopeless) & (gain < SLOW * behind)
        last = done | small | (damp > MAX_DAMPING)
        trial = moved(state, np.where(done[..., None], 0.0, step))
        if cost:
            there, reached = None, cost(trial)
        else:
            there = linearise(trial)
            reached = there.cost
        better = (reached <= np.asarray(here.cost) * (1 + ROUNDING)) & ~done
        with np.errstate(invalid="ignore"):
            fall = here.cost - reached
        unkept = (gain <= UNKEPT) & (fall < KEPT * gain) & (damp <= NEARLY_WHOLE)
        converged |= (small | unkept) & ~done
        done = last | unkept
        if better.any():
            here = select(better, linearise(trial) if there is None else there, here)
            state = select(better, trial, state)
        if done.all():
            break
        damp = np.where(fall < KEPT * gain, np.maximum(10 * damp, NEARLY_WHOLE), damp)
        damp = np.where(fall > TRUSTED * gain, np.maximum(damp / 10, least_damping), damp)
    return Minimum(state, here, converged, promised, steps)


def perturbed(pose: Rigid, step: np.ndarray) -> Rigid:
    """A pose after a left perturbation (6,), rotation rad and translation."""
    turn = Rigid.exp(step)
    return Rigid(turn.rotation @ pose.rotation, pose.translation + turn.translation)
