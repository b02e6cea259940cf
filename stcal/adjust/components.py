"""Variance components by restricted maximum likelihood (REML, Patterson & Thompson 1971): σ of each kind of residual
from normal equations by kind, and variances of covariances that are sums of components."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
from scipy.optimize import minimize

from stcal.geometry.normal_equations import Reduction, inverse_and_size, reduce


@dataclass(frozen=True, slots=True, eq=False)
class Equations:
    """Normal equations of k kept and of m eliminated unknowns, of ``a`` numbers each."""

    square: float  # sum of the squares of all residuals
    count: float  # of the residuals
    normal: np.ndarray  # (k, k)
    right: np.ndarray  # (k,) minus half the gradient
    block: np.ndarray  # (m, a, a) of each eliminated unknown
    block_right: np.ndarray  # (m, a)
    cross: np.ndarray  # (m, a, k) mixed parts

    @classmethod
    def nothing(cls, kept: int, eliminated: tuple[int, int] = (0, 1)) -> "Equations":
        """Return the equations of no residual; ``eliminated`` : m and a."""
        k, (m, a) = kept, eliminated
        return cls(0.0, 0.0, np.zeros((k, k)), np.zeros(k), np.zeros((m, a, a)), np.zeros((m, a)), np.zeros((m, a, k)))

    @classmethod
    def of(cls, residual: np.ndarray, slope: np.ndarray) -> "Equations":
        """Return the equations of residuals (n,) and their derivatives (n, k), both over σ; nothing is eliminated."""
        square, count = float(residual @ residual), float(len(residual))
        none = cls.nothing(slope.shape[1])
        return cls(square, count, slope.T @ slope, -slope.T @ residual, none.block, none.block_right, none.cross)

    def __add__(self, other: "Equations") -> "Equations":
        return Equations(*(getattr(self, each.name) + getattr(other, each.name) for each in fields(self)))

    def flat(self) -> np.ndarray:
        """Return all numbers in a row."""
        return np.concatenate([np.ravel(getattr(self, each.name)) for each in fields(self)])

    def filled(self, flat: np.ndarray) -> "Equations":
        """Return equations of the same unknowns with the numbers of :meth:`flat`."""
        parts, at = [], 0
        for each in fields(self):
            own = getattr(self, each.name)
            parts.append(flat[at : at + np.size(own)].reshape(np.shape(own)))
            at += np.size(own)
        return Equations(*parts)

    def alone(self, held: float = 0.0) -> "tuple[np.ndarray, np.ndarray, Reduction]":
        """Return normal matrix and right side of the kept unknowns alone, and the elimination of the others.

        ``held`` : share of each unknown's information that is added; one on which nothing depends stays.
        """
        normal, block = self.normal.copy(), self.block.copy()
        for diagonal in (np.einsum("kk->k", normal), np.einsum("maa->ma", block)):
            diagonal[:] = np.where(diagonal > 0, (1 + held) * diagonal, 1.0)
        reduction = reduce(block, self.block_right, self.cross)
        return normal - reduction.normal, self.right - reduction.right, reduction

    def told(self, from_kept: np.ndarray) -> np.ndarray:
        """Return what the residuals tell (k, k) about the kept unknowns, with which the others go: (m, a, k)."""
        mixed = np.tensordot(from_kept, self.cross, ((0, 1), (0, 1)))
        return self.normal - mixed - mixed.T + np.tensordot(from_kept, self.block @ from_kept, ((0, 1), (0, 1)))


@dataclass(frozen=True, eq=False)
class Components:
    """A linearised adjustment in p parts with a σ each; what is sought is x = log (σ / present σ) (p,)."""

    each: Sequence[Equations]  # p of the parts at their present σ
    fixed: Equations  # of what has a known σ
    expected: np.ndarray | float = 0.0  # (p,) mean of the prior of x
    doubt: np.ndarray | float = np.inf  # (p,) σ of the prior
    caution: np.ndarray | float = 0.0  # (p,) redundancy that is not counted
    held: float = 0.0  # see :meth:`Equations.alone`

    @cached_property
    def _flat(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The numbers of all parts (p, N), those of ``fixed`` (N,), and how many residuals of each part count (p,)."""
        counted = np.array([own.count for own in self.each]) - self.caution
        return np.array([own.flat() for own in self.each]), self.fixed.flat(), counted

    def at(self, x: np.ndarray) -> tuple[float, np.ndarray, np.ndarray, np.ndarray]:
        """Evaluate the posterior at x (p,), by restricted maximum likelihood (Patterson & Thompson 1971).

        Return log posterior density, its gradient (p,), the step of the kept unknowns (k,) from the state, and their
        covariance (k, k).
        """
        share, (each, fixed, counted) = np.exp(-2 * x), self._flat
        whole = self.fixed.filled(share @ each + fixed)
        normal, right, reduction = whole.alone(self.held)
        inverse, size = inverse_and_size(normal)
        kept = inverse @ right
        away, dropped = reduction.from_kept, reduction.back(kept)
        mixed = -away @ inverse
        of_dropped = reduction.inverse - mixed @ np.swapaxes(away, 1, 2)
        # Second moments of the unknowns about the state, laid out as what they are multiplied by.
        moments = Equations(
            1.0,
            0.0,
            inverse + kept[:, None] * kept,
            -2 * kept,
            of_dropped + dropped[:, :, None] * dropped[:, None],
            -2 * dropped,
            2 * (mixed + dropped[:, :, None] * kept),
        )
        doubted = (x - self.expected) / self.doubt
        size += float(np.linalg.slogdet(reduction.block)[1].sum())
        left = float(whole.square - kept @ right - reduction.gain)
        value = -float(x @ counted) - 0.5 * (left + size + float((doubted**2).sum()))
        return value, share * (each @ moments.flat()) - counted - doubted / self.doubt, kept, inverse

    def best(self, low: np.ndarray, high: np.ndarray, starts: Sequence[np.ndarray]) -> np.ndarray:
        """Return the x (p,) of highest density within bounds (p,), by descents from several ``starts`` (p,)."""

        def downhill(logs: np.ndarray) -> tuple[float, np.ndarray]:
            """Return minus twice the log density, and its gradient, at the logarithms of the weights, -2x."""
            value, gradient, _, _ = self.at(-logs / 2)
            return -2 * value, gradient

        bounds, begin = -2 * np.column_stack([high, low]), [-2 * np.clip(x, low, high) for x in starts]
        fits = [minimize(downhill, logs, jac=True, method="L-BFGS-B", bounds=bounds) for logs in begin]
        return -min(fits, key=lambda fit: fit.fun).x / 2


def component_variances(
    residuals: np.ndarray,
    jacobian: np.ndarray,
    known: np.ndarray,
    free: np.ndarray,
    first: np.ndarray,
    bounds: tuple[np.ndarray, np.ndarray],
    caution: float = 0.0,
) -> np.ndarray:
    """Return restricted maximum-likelihood variances (f,) of covariances that are sums of components.

    Of residuals (m, a) near a solution and their derivatives (m, a, k) by what was solved for; ``known`` : (m, a, a)
    part of the covariances; ``free`` : (f, m, a, a) components, each to be multiplied by its variance, from ``first``
    (f,) and within ``bounds``; ``caution`` : redundancy of each variance that is not counted.
    """
    flat = jacobian.reshape(-1, jacobian.shape[2])
    u, s, _ = np.linalg.svd(flat / np.maximum(np.linalg.norm(flat, axis=0), 1e-300), full_matrices=False)
    jacobian = u[:, s > 1e-7 * s[0]].reshape(*jacobian.shape[:2], -1)  # an orthonormal basis of its columns

    def cost(logs: np.ndarray) -> tuple[float, np.ndarray]:
        theta = np.exp(logs)
        spread = known + np.tensordot(theta, free, 1)
        inverse = np.linalg.inv(spread)
        weighted = inverse @ jacobian
        normal = np.einsum("mai,maj->ij", jacobian, weighted)
        covariance = np.linalg.inv(normal)
        remaining = residuals - jacobian @ (covariance @ np.einsum("mai,ma->i", weighted, residuals))
        fitted = np.einsum("mab,mb->ma", inverse, remaining)
        value = np.linalg.slogdet(spread)[1].sum() + np.linalg.slogdet(normal)[1] + (fitted * remaining).sum()
        gradient = np.einsum("mab,kmba->k", inverse, free)
        weighted_free = np.einsum("kmab,mbj->kmaj", free, weighted)
        gradient = gradient - np.einsum("mai,kmaj,ij->k", weighted, weighted_free, covariance, optimize=True)
        gradient = gradient - np.einsum("ma,kmab,mb->k", fitted, free, fitted, optimize=True)
        return float(value - caution * logs.sum()), gradient * theta - caution

    limits = np.log(np.column_stack(bounds))
    optimum = minimize(cost, np.log(first), jac=True, method="L-BFGS-B", bounds=limits, options={"ftol": 1e-12})
    return np.exp(optimum.x)


def sigma_factor(square: float, redundancy: float) -> float:
    """Return the factor on σ that makes the sum of squares over σ² equal its redundancy (Förstner 1979); one step of an
    iteration if other σ are estimated too."""
    return float(np.sqrt(square / max(redundancy, 1.0)))
