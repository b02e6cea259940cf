"""Normal equations of an adjustment of corners, from which the corners of the board are eliminated.

The board has hundreds of unknowns, three for each corner, and no observation depends on two corners. There are about a
hundred others: poses of the robot, X, Z, intrinsics. With the corners eliminated (Schur complement), a step costs as
little as one for the others alone.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from operator import add

import numpy as np
from scipy.optimize import minimize

from stcal.geometry.normal_equations import generalised_inverse

TINY = 1e-300


@dataclass(frozen=True, slots=True, eq=False)
class Equations:
    """Normal equations of s unknowns that are kept, and of the K corners of a board.

    ``cost``; ``normal`` : (s, s); ``gradient`` : (s,), half the gradient of the cost; ``block`` : (K, 3, 3) of each
    corner; ``slope`` : (K, 3) half the gradient by each corner; ``cross`` : (K, 3, s) mixed parts. K is 0 where the
    board is exact. ``cross`` is None where no corner depends on other unknowns.
    """

    cost: float
    normal: np.ndarray
    gradient: np.ndarray
    block: np.ndarray
    slope: np.ndarray
    cross: np.ndarray | None

    @classmethod
    def impossible(cls, kept: int, corners: int) -> "Equations":
        """Returns the equations of a state with a corner behind a camera: the cost is infinite."""
        block = np.tile(np.eye(3), (corners, 1, 1))
        return cls(np.inf, np.eye(kept), np.zeros(kept), block, np.zeros((corners, 3)), None)

    def __add__(self, other: "Equations") -> "Equations":
        cross = self.cross if other.cross is None else other.cross if self.cross is None else self.cross + other.cross
        return Equations(
            self.cost + other.cost,
            self.normal + other.normal,
            self.gradient + other.gradient,
            self.block + other.block,
            self.slope + other.slope,
            cross,
        )

    def times(self, factor: float) -> "Equations":
        """Returns the equations with all weights multiplied by ``factor``."""
        cross = None if self.cross is None else factor * self.cross
        return Equations(
            factor * self.cost,
            factor * self.normal,
            factor * self.gradient,
            factor * self.block,
            factor * self.slope,
            cross,
        )

    def eliminated(self, damping: float = 0.0) -> "Eliminated":
        """Returns the equations without the corners, with this share of each unknown's information added."""
        corner, kept = np.arange(3), np.arange(len(self.gradient))
        block, normal = self.block.copy(), self.normal.copy()
        block[:, corner, corner] *= 1 + damping
        normal[kept, kept] += damping * np.maximum(normal[kept, kept], TINY)
        inverse = np.linalg.inv(block)
        from_slope = np.einsum("kab,kb->ka", inverse, self.slope)
        if self.cross is None:
            return Eliminated(normal, self.gradient, block, inverse, from_slope, None)
        from_kept, s = inverse @ self.cross, len(kept)
        flat = self.cross.reshape(-1, s)
        return Eliminated(
            normal - flat.T @ from_kept.reshape(-1, s),
            self.gradient - flat.T @ from_slope.ravel(),
            block,
            inverse,
            from_slope,
            from_kept,
        )

    def step(self, damping: float | np.ndarray) -> tuple[np.ndarray, float]:
        """Returns the damped step of kept unknowns, then corners, and the predicted decrease of the cost."""
        kept, corners = self.eliminated(float(damping)).step()
        step = np.concatenate([kept, corners.ravel()])
        gain = -2 * float(kept @ self.gradient + (corners * self.slope).sum())
        return step, gain - self.bent(kept, corners)

    def bent(self, kept: np.ndarray, corners: np.ndarray) -> float:
        """Returns the quadratic form of the equations at a step of kept unknowns (s,) and corners (K, 3)."""
        mixed = 0.0 if self.cross is None else 2 * float((corners * (self.cross @ kept)).sum())
        return float(kept @ self.normal @ kept) + mixed + float(np.einsum("ka,kab,kb->", corners, self.block, corners))

    def inverse(self) -> np.ndarray:
        """Returns the covariance (s, s) of the kept unknowns; undetermined directions are 0."""
        return generalised_inverse(self.eliminated().normal)

    def gain(self) -> float:
        """Returns the decrease of the cost that an undamped step of all unknowns predicts."""
        left = self.eliminated()
        own = float((left.from_slope * self.slope).sum())
        return own + float(left.gradient @ generalised_inverse(left.normal) @ left.gradient)


@dataclass(frozen=True, slots=True, eq=False)
class Eliminated:
    """Equations without the corners: ``normal`` (s, s) and ``gradient`` (s,) of the kept unknowns; ``block`` (K, 3, 3)
    of the corners and its ``inverse``; ``from_slope`` : (K, 3) minus the corners' step if the others stay;
    ``from_kept`` : (K, 3, s) is multiplied by the step of the others and subtracted."""

    normal: np.ndarray
    gradient: np.ndarray
    block: np.ndarray
    inverse: np.ndarray
    from_slope: np.ndarray
    from_kept: np.ndarray | None

    def step(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns the steps of the kept unknowns (s,) and of the corners (K, 3)."""
        scale = np.sqrt(np.maximum(np.diag(self.normal), TINY))
        kept = -np.linalg.solve(self.normal / scale[:, None] / scale, self.gradient / scale) / scale
        return kept, self.corners(kept)

    def corners(self, kept: np.ndarray) -> np.ndarray:
        """Returns the step (K, 3) of the corners that belongs to a step (s,) of the others."""
        return -self.from_slope - (0.0 if self.from_kept is None else self.from_kept @ kept)


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """Observations of one σ: their ``count``, and their ``equations`` at the present σ."""

    count: int
    equations: Equations

    def __add__(self, other: "Part") -> "Part":
        return Part(self.count + other.count, self.equations + other.equations)


@dataclass(frozen=True, slots=True, eq=False)
class Components:
    """A linearised adjustment in p parts, each with its own σ; the unknowns are x = log (σ / present σ).

    It is :class:`stcal.geometry.variances.Parts` with the corners eliminated. ``fixed`` : equations of the observations
    whose σ is not estimated, or None; ``caution`` : (p,) redundancy that is not counted; ``held`` : share of each
    unknown's information that is added.
    """

    parts: Sequence[Part]
    fixed: Equations | None
    caution: np.ndarray
    held: float

    def at(self, x: np.ndarray) -> tuple[float, np.ndarray]:
        """Returns the log of the restricted likelihood at x (p,), and its gradient (p,)."""
        share = np.exp(-2 * x)
        free = [part.equations for part in self.parts]
        weighted = [equations.times(factor) for equations, factor in zip(free, share, strict=True)]
        whole = reduce(add, weighted if self.fixed is None else [*weighted, self.fixed])
        reduced = whole.eliminated(self.held)
        kept, corners = reduced.step()
        inverse = np.linalg.inv(reduced.normal)
        mixed, of_corners = None, reduced.inverse
        if reduced.from_kept is not None:
            mixed = -reduced.from_kept @ inverse
            of_corners = reduced.inverse - mixed @ np.swapaxes(reduced.from_kept, 1, 2)
        square, taken = np.zeros((2, len(free)))
        for i, equations in enumerate(free):
            square[i] = equations.cost + 2 * float(kept @ equations.gradient + (corners * equations.slope).sum())
            square[i] += equations.bent(kept, corners)
            taken[i] = float((inverse * equations.normal).sum() + (of_corners * equations.block).sum())
            if equations.cross is not None and mixed is not None:
                taken[i] += 2 * float((mixed * equations.cross).sum())
        fixed = 0.0
        if self.fixed is not None:
            fixed = self.fixed.cost + 2 * float(kept @ self.fixed.gradient + (corners * self.fixed.slope).sum())
            fixed += self.fixed.bent(kept, corners)
        size = np.linalg.slogdet(reduced.normal)[1] + np.linalg.slogdet(reduced.block)[1].sum()
        counted = np.array([part.count for part in self.parts]) - self.caution
        value = -float(x @ counted) - 0.5 * (float(share @ square) + fixed + size)
        return value, share * (square + taken) - counted

    def best(self, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Returns the x (p,) of largest likelihood within bounds (p,), by descent from 0."""

        def downhill(logs: np.ndarray) -> tuple[float, np.ndarray]:
            """Returns minus twice the log, and its gradient, at the logarithms of the weights, -2x."""
            value, gradient = self.at(-logs / 2)
            return -2 * value, gradient

        bounds = -2 * np.column_stack([high, low])
        start = -2 * np.clip(np.zeros(len(low)), low, high)
        return -minimize(downhill, start, jac=True, method="L-BFGS-B", bounds=bounds).x / 2
