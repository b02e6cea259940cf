"""Levenberg–Marquardt on a manifold: the state moves, the parameters are always small motions about it."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from stcal.errors import ConvergenceError
from stcal.geometry.rigid import Rigid

MAX_STEPS = 200
SETTLED = 1e-12
"""Relative fall of the cost below which nothing is gained …"""
LEAST_GAIN = 1e-12
"""… and absolute, in units of σ²: what exact data still gain by rounding."""
S = TypeVar("S")


@dataclass(frozen=True, slots=True, eq=False)
class Linear:
    """A least-squares problem about a state: ``cost``; ``normal`` (k, k) and ``gradient`` (k,), half of the cost's."""

    cost: float
    normal: np.ndarray
    gradient: np.ndarray


def minimise(
    state: S, linear: Callable[[S], Linear], moved: Callable[[S, np.ndarray], S], what: str, settled: float = SETTLED
) -> tuple[S, Linear]:
    """State of least cost, and the problem about it; directions that nothing determines stay where they are.

    Raises
    ------
    ConvergenceError
        The cost still falls after :data:`MAX_STEPS` steps.
    """
    here, damping = linear(state), 1e-4
    for _ in range(MAX_STEPS):
        scale = np.sqrt(np.maximum(np.diag(here.normal), 1e-300))
        normal, slope = here.normal / scale[:, None] / scale, here.gradient / scale
        while True:
            step = -np.linalg.solve(normal + damping * np.eye(len(scale)), slope)
            trial = moved(state, step / scale)
            there = linear(trial)
            gain = here.cost - there.cost
            predicted = -(2 * slope @ step + step @ normal @ step)
            small = predicted <= settled * here.cost + LEAST_GAIN
            if gain >= 0.1 * predicted or small or damping > 1e10:
                break
            damping *= 10
        if gain > 0:
            state, here = trial, there
        if gain <= settled * here.cost + LEAST_GAIN:
            return state, here
        if gain > 0.5 * predicted:
            damping = max(damping / 10, 1e-10)
    raise ConvergenceError(
        f"{what}: the adjustment still gains after {MAX_STEPS} steps; check the poses that fit worst"
    )


def generalised_inverse(normal: np.ndarray) -> np.ndarray:
    """Inverse of a normal matrix (k, k), scaled; what nothing determines gets no part in it."""
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    return np.linalg.pinv(normal / scale[:, None] / scale, rcond=1e-11, hermitian=True) / scale[:, None] / scale


def perturbed(pose: Rigid, step: np.ndarray) -> Rigid:
    """By a left perturbation (6,)."""
    turn = Rigid.exp(step)
    return Rigid(turn.rotation @ pose.rotation, pose.translation + turn.translation)
