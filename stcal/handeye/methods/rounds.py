"""What is known, in groups of one σ each, and the adjustment that estimates these σ in rounds."""

from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

import numpy as np
from scipy.sparse import csr_matrix

from stcal.geometry.least_squares import NormalEquations, minimise
from stcal.geometry.rigid import Poses
from stcal.geometry.robust import huber_cost, huber_weights
from stcal.geometry.variances import Parts
from stcal.handeye.methods.noise import CAUTION

LEAST = {
    "corner_px": 1e-6,
    "robot_rad": 1e-8,
    "robot_mm": 1e-5,
    "board_mm": 1e-5,
    "arm_rad": 1e-8,
    "arm_mm": 1e-5,
}
"""Estimated σ stay above: exact data have none. Factors of what is stated of a camera stay above 1."""
ROUNDS = 20
ROUGHLY = 1e-6
"""Relative fall of the cost at which a round of σ has solved well enough."""
SETTLED = 1e-3
"""Relative change of σ from round to round that moves nothing any more."""
HELD = 1e-10
"""Share of each unknown's information that is added: what nothing determines must not be singular."""
WORST = "check the poses that fit worst"
FARTHEST = 7.0
"""A round changes a σ by e⁷, a thousand times, at most."""


@dataclass(frozen=True, slots=True, eq=False)
class Knowledge:
    """Knowledge of one kind.

    ``names`` : of the σ that its columns have, each an equal share; ``white`` : (g, d) residuals in units of σ;
    ``jacobian`` : (g d, k) their derivative; ``limit`` : Huber's, of the length of a row.
    """

    names: tuple[str, ...]
    white: np.ndarray
    jacobian: csr_matrix
    limit: float

    def weight(self) -> np.ndarray:
        """(g,) Huber's weights."""
        return huber_weights(np.linalg.norm(self.white, axis=1), self.limit)

    def linear(self) -> NormalEquations:
        """Its part of the cost and of the normal equations."""
        cost = float(huber_cost(np.linalg.norm(self.white, axis=1), self.limit).sum())
        pulled = self.jacobian.multiply(np.repeat(self.weight(), self.white.shape[1])[:, None]).tocsr().T
        return NormalEquations(cost, (pulled @ self.jacobian).toarray(), pulled @ self.white.ravel())

    def by_name(self) -> dict[str, tuple[int, NormalEquations]]:
        """By each of ``names``, or by none: number of residuals, and its quadratic part of the cost."""
        g, d = self.white.shape
        width = d // max(len(self.names), 1)
        weight = np.repeat(self.weight(), d)
        found = {}
        for i, name in enumerate(self.names or ("",)):
            rows = np.flatnonzero(np.arange(g * d) % d // width == i)
            jacobian, white = self.jacobian[rows], self.white.ravel()[rows]
            pulled = jacobian.multiply(weight[rows, None]).tocsr().T
            linear = NormalEquations(float(weight[rows] @ white**2), (pulled @ jacobian).toarray(), pulled @ white)
            found[name] = len(rows), linear
        return found


class Problem(Protocol):
    """What is adjusted: the corners of one camera, or of several about the same board."""

    @property
    def sigma(self) -> dict[str, float]:
        """Of each group."""
        ...

    @property
    def base_from_flange(self) -> Poses:
        """As reported."""
        ...

    def with_sigma(self, sigma: dict[str, float]) -> Any:
        """With other σ."""
        ...

    def with_board_scale(self) -> Any:
        """With the board's scale among the unknowns."""
        ...

    def places(self) -> dict[str, slice]:
        """Where the unknowns stand in a step."""
        ...

    def factors(self) -> dict[str, float]:
        """1 for each kind of the intrinsics solved for."""
        ...

    def robot_weight(self) -> np.ndarray:
        """(m, 6, 6) whitening of errors of base_from_flange."""
        ...

    def count(self) -> int:
        """Number of unknowns."""
        ...

    def moved(self, state: Any, step: np.ndarray) -> Any:
        """A state after a step of all unknowns."""
        ...

    def groups(self, state: Any) -> list[Knowledge]:
        """Everything that is known."""
        ...

    def linear(self, state: Any) -> NormalEquations:
        """Cost and normal equations."""
        ...


P = TypeVar("P", bound=Problem)
S = TypeVar("S")


@dataclass(frozen=True, slots=True, eq=False)
class BundleSolution(Generic[P, S]):
    """``corners`` : with the σ that were estimated; ``state``; ``normal`` : matrix about it; ``settled`` : whether the
    σ did within :data:`ROUNDS`."""

    corners: P
    state: S
    normal: np.ndarray
    settled: bool


def adjust(corners: P, start: S, free: tuple[str, ...]) -> BundleSolution[P, S]:
    """Solve, and estimate the σ of the ``free`` groups in rounds.

    Raises
    ------
    ConvergenceError
        No minimum is reached.
    """
    state, settled = start, not free
    for _ in range(ROUNDS if free else 0):
        state = minimise(state, corners.linear, corners.moved, settled=ROUGHLY).required("hand-eye", WORST).state
        sigma = corners.sigma | estimated(corners, state, free)
        change = max(abs(np.log(sigma[name] / corners.sigma[name])) for name in free)
        corners = corners.with_sigma(sigma)
        settled = bool(change < SETTLED)
        if settled:
            break
    found = minimise(state, corners.linear, corners.moved).required("hand-eye", WORST)
    return BundleSolution(corners, found.state, found.linear.normal, settled)


def estimated(corners: Problem, state: Any, free: tuple[str, ...]) -> dict[str, float]:
    """Restricted maximum-likelihood σ of the ``free`` groups, all else linear about a state (as
    :func:`~stcal.handeye.methods.noise.variance_components`)."""
    unknowns = corners.count()
    nothing = NormalEquations(0.0, np.zeros((unknowns, unknowns)), np.zeros(unknowns))
    parts: dict[str, tuple[int, NormalEquations]] = {}
    for group in corners.groups(state):
        for name, (count, linear) in group.by_name().items():
            key = name if name in free else ""
            old_count, old = parts.get(key, (0, nothing))
            parts[key] = old_count + count, old + linear
    fixed = parts.pop("", (0, nothing))[1]
    names = tuple(parts)
    found = Parts(
        each=NormalEquations.stacked([linear for _, linear in parts.values()]),
        count=np.array([count for count, _ in parts.values()]),
        fixed=fixed,
        caution=np.array([CAUTION if kind(name) in LEAST else 0.0 for name in names]),
        held=HELD,
    )
    least = np.log([LEAST.get(kind(name), 1.0) / corners.sigma[name] for name in names])
    farthest = np.full(len(names), FARTHEST)
    best = found.best(np.maximum(least, -farthest), farthest, [np.zeros(len(names))])
    return {name: float(corners.sigma[name] * np.exp(x)) for name, x in zip(names, best, strict=True)}


def kind(name: str) -> str:
    """``corner_px`` of a group that is one camera's of several, ``corner_px:left``."""
    return name.partition(":")[0]
