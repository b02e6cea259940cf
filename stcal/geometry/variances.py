"""Variance components: σ of each group of observations, estimated from the residuals of an adjustment.

Restricted maximum likelihood (REML, Patterson & Thompson 1971) for covariances that are sums of components, and
Förstner's (1979) step towards it; :mod:`stcal.adjust.components` has it for groups that each have one σ.
"""

import numpy as np
from scipy.optimize import minimize


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
