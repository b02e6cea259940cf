"""Variance components: σ of each group of observations, estimated from the residuals of an adjustment.

Restricted maximum likelihood (REML, Patterson & Thompson 1971), for groups that each have one σ or for covariances that
are sums of components; and Förstner's (1979) step towards it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from stcal.geometry.least_squares import NormalEquations


@dataclass(frozen=True, slots=True, eq=False)
class Parts:
    """A linearised adjustment in p parts, each with its own σ; the unknowns are x = log (σ / present σ).

    ``each`` : normal equations of the p parts, each scaled by its present σ; ``count`` : (p,) numbers of observations;
    ``fixed`` : normal equations of the observations whose σ is not estimated; ``expected``, ``doubt`` : (p,) mean and σ
    of the prior of x, ``doubt`` infinite without a prior; ``caution`` : (p,) redundancy that is not counted; ``held`` :
    share of each parameter's information that is added, so that undetermined parameters do not make it singular.
    """

    each: NormalEquations
    count: np.ndarray
    fixed: NormalEquations
    expected: np.ndarray | float = 0.0
    doubt: np.ndarray | float = np.inf
    caution: np.ndarray | float = 0.0
    held: float = 0.0

    def at(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Evaluate the posterior at x (m, p).

        Returns log posterior density (m,), its gradient (m, p), the step of the parameters (m, k) from the state, and
        their covariance (m, k, k).
        """
        share, normals = np.exp(-2 * x), self.each.normal
        p, k = self.each.gradient.shape
        normal = (share @ normals.reshape(p, -1)).reshape(-1, k, k) + self.fixed.normal
        scale = np.sqrt(np.maximum(np.einsum("mkk->mk", normal), 1e-300))
        unit = normal / scale[:, :, None] / scale[:, None, :] + self.held * np.eye(k)
        inverse = np.linalg.inv(unit) / scale[:, :, None] / scale[:, None, :]
        step = -np.einsum("mkl,ml->mk", inverse, share @ self.each.gradient + self.fixed.gradient)
        away = (x - self.expected) / self.doubt
        bent = np.einsum("pmk,mk->mp", step @ normals, step)
        square = self.each.cost + 2 * step @ self.each.gradient.T + bent
        taken = inverse.reshape(-1, k * k) @ normals.reshape(p, -1).T
        fixed = self.fixed.cost + 2 * step @ self.fixed.gradient + ((step @ self.fixed.normal) * step).sum(1)
        size = np.linalg.slogdet(unit)[1] + 2 * np.log(scale).sum(1)
        counted = self.count - self.caution
        value = -(x @ counted) - 0.5 * ((share * square).sum(1) + fixed + size + (away**2).sum(1))
        return value, share * (square + taken) - counted - away / self.doubt, step, inverse

    def best(self, low: np.ndarray, high: np.ndarray, starts: Sequence[np.ndarray]) -> np.ndarray:
        """Return the x (p,) of highest density within bounds (p,), by descents from several ``starts`` (p,)."""

        def downhill(logs: np.ndarray) -> tuple[float, np.ndarray]:
            """Return minus twice the log density, and its gradient, at the logarithms of the weights, -2x."""
            value, gradient, _, _ = self.at(-logs[None] / 2)
            return -2 * float(value[0]), gradient[0]

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

    Parameters
    ----------
    residuals : (m, a) residuals near a solution
    jacobian : (m, a, k) derivative of the residuals by the parameters solved for; dependent columns do no harm
    known : (m, a, a) known part of the covariances
    free : (f, m, a, a) components, each to be multiplied by its variance
    first : (f,) initial variances
    bounds : (f,) smallest and largest variances
    caution : redundancy of each variance that is not counted
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
    """Return the factor on a σ that makes the normalised sum of squares equal its redundancy (Förstner 1979).

    ``square`` : sum of squared residuals over σ². If other σ are estimated too, this is one step of an iteration.
    """
    return float(np.sqrt(square / max(redundancy, 1.0)))
