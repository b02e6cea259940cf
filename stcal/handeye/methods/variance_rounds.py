"""An adjustment with unknown σ: groups of observations with one σ each, estimated in rounds."""

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
"""Lower limits of estimated σ: exact data would give 0. The lower limit of the factors of stated camera σ is 1."""
ROUNDS = 20
ROUGHLY = 1e-6
"""Relative fall of the cost below which the minimisation within a round of σ ends."""
SETTLED = 1e-3
"""Relative change of σ between rounds below which the iteration has converged."""
HELD = 1e-10
"""Share of each unknown's information that is added, so that undetermined unknowns do not make the matrix singular."""
WORST = "check the poses that fit worst"
FARTHEST = 7.0
"""Largest logarithm of the change of a σ in one round: e⁷ is a factor of a thousand."""


@dataclass(frozen=True, slots=True, eq=False)
class Knowledge:
    """Observations of one kind.

    ``names`` : names of the σ of its columns, each of an equal share of the columns; ``white`` : (g, d) residuals in
    units of σ; ``jacobian`` : (g d, k) their derivative; ``limit`` : Huber's limit of the length of a row.
    """

    names: tuple[str, ...]
    white: np.ndarray
    jacobian: csr_matrix
    limit: float

    def weight(self) -> np.ndarray:
        """Returns Huber's weights (g,)."""
        return huber_weights(np.linalg.norm(self.white, axis=1), self.limit)

    def linear(self) -> NormalEquations:
        """Returns the group's contribution to the cost and to the normal equations."""
        cost = float(huber_cost(np.linalg.norm(self.white, axis=1), self.limit).sum())
        pulled = self.jacobian.multiply(np.repeat(self.weight(), self.white.shape[1])[:, None]).tocsr().T
        return NormalEquations(cost, (pulled @ self.jacobian).toarray(), pulled @ self.white.ravel())

    def by_name(self) -> dict[str, tuple[int, NormalEquations]]:
        """Returns, for each of ``names`` or for the empty name, the number of residuals and their quadratic part of the
        cost."""
        g, d = self.white.shape
        width = d // max(len(self.names), 1)
        weight = np.repeat(self.weight(), d)
        parts = {}
        for i, name in enumerate(self.names or ("",)):
            rows = np.flatnonzero(np.arange(g * d) % d // width == i)
            jacobian, white = self.jacobian[rows], self.white.ravel()[rows]
            pulled = jacobian.multiply(weight[rows, None]).tocsr().T
            linear = NormalEquations(float(weight[rows] @ white**2), (pulled @ jacobian).toarray(), pulled @ white)
            parts[name] = len(rows), linear
        return parts


class Problem(Protocol):
    """An adjustment problem: the corners of one camera, or of several cameras about the same board."""

    @property
    def sigma(self) -> dict[str, float]:
        """σ of each group."""
        ...

    @property
    def base_from_flange(self) -> Poses:
        """The poses of the flange, as reported."""
        ...

    def with_sigma(self, sigma: dict[str, float]) -> Any:
        """Returns the same problem with other σ."""
        ...

    def with_board_scale(self) -> Any:
        """Returns the same problem with the board's scale among the unknowns."""
        ...

    def places(self) -> dict[str, slice]:
        """Returns the places of the unknowns in a step."""
        ...

    def factors(self) -> dict[str, float]:
        """Returns a factor of 1 for each kind of the intrinsics solved for."""
        ...

    def robot_weight(self) -> np.ndarray:
        """Returns the whitening (m, 6, 6) of errors of base_from_flange."""
        ...

    def count(self) -> int:
        """Returns the number of unknowns."""
        ...

    def moved(self, state: Any, step: np.ndarray) -> Any:
        """Returns a state after a step of all unknowns."""
        ...

    def groups(self, state: Any) -> list[Knowledge]:
        """Returns all observations: the corners seen, and the prior knowledge."""
        ...

    def linear(self, state: Any) -> NormalEquations:
        """Returns cost and normal equations."""
        ...


P = TypeVar("P", bound=Problem)
S = TypeVar("S")


@dataclass(frozen=True, slots=True, eq=False)
class BundleSolution(Generic[P, S]):
    """``corners`` : problem with the estimated σ; ``state``; ``normal`` : normal matrix about the state; ``settled`` :
    whether the σ settled within :data:`ROUNDS`."""

    corners: P
    state: S
    normal: np.ndarray
    settled: bool


def adjust(corners: P, start: S, free: tuple[str, ...]) -> BundleSolution[P, S]:
    """Solve the problem, and estimate the σ of the ``free`` groups in rounds.

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
    minimum = minimise(state, corners.linear, corners.moved).required("hand-eye", WORST)
    return BundleSolution(corners, minimum.state, minimum.linear.normal, settled)


def estimated(corners: Problem, state: Any, free: tuple[str, ...]) -> dict[str, float]:
    """Returns restricted maximum-likelihood σ of the ``free`` groups, with all else linear about a state (like
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
    likelihood = Parts(
        each=NormalEquations.stacked([linear for _, linear in parts.values()]),
        count=np.array([count for count, _ in parts.values()]),
        fixed=fixed,
        caution=np.array([CAUTION if kind(name) in LEAST else 0.0 for name in names]),
        held=HELD,
    )
    least = np.log([LEAST.get(kind(name), 1.0) / corners.sigma[name] for name in names])
    farthest = np.full(len(names), FARTHEST)
    best = likelihood.best(np.maximum(least, -farthest), farthest, [np.zeros(len(names))])
    return {name: float(corners.sigma[name] * np.exp(x)) for name, x in zip(names, best, strict=True)}


def kind(name: str) -> str:
    """Returns the kind of a group: ``corner_px`` for ``corner_px:left``, the group of one camera of several."""
    return name.partition(":")[0]
