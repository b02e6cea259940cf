"""Estimation of σ from the residuals, and the covariance of the transform that follows from it."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import root_scalar
from scipy.special import chdtr, chdtrc

from stcal.geometry.arrays import Array, freeze
from stcal.register.core.models import Model, Transform, unit_covariance
from stcal.register.core.pairs import Problem

CONTRADICTED_AT = 0.01
"""Significance level of the one-sided χ² test; stated σ are scaled if the test rejects them."""
WIDE = 8.0
"""Threshold in σ beyond which nothing is cut off; the tail of χ²₃ is 1e-13."""


@dataclass(frozen=True, slots=True, eq=False)
class Covariance:
    """Covariance of a transform's parameters.

    ``matrix`` : (p, p) parameters as of :func:`~stcal.register.core.models.unit_covariance`; ``scaled`` : whether it is
    derived from the residuals; False if it is derived from the given σ; ``redundancy`` : degrees of freedom of the σ
    that it is derived from; infinite if this σ was given.
    """

    matrix: Array
    scaled: bool
    redundancy: float

    def __post_init__(self):
        freeze(self, "matrix", (None, None), "covariance")


def kept_share(cut: float) -> float:
    """Returns the fraction of points within ``cut`` σ, from χ²₃."""
    return float(chdtr(3, cut**2))


def kept_variance(cut: float) -> float:
    """Returns the fraction of the total sum of squares that points within ``cut`` σ contribute, from χ²₅."""
    return float(chdtr(5, cut**2))


def sigma_within(square_sum: float, model: Model, count: int, threshold: float) -> float:
    """Estimates σ of points from residuals that were cut off at a threshold.

    Residuals within c σ hold only the share χ²₅(c²)/χ²₃(c²) of their variance: σ solves s² = σ² χ²₅/χ²₃ at c = t/σ.
    Below c = 1 the points fill the sphere almost uniformly and give no information on σ.

    Parameters
    ----------
    square_sum : square sum of the residuals of the points used, mm²
    model : model
    count : number of points used
    threshold : threshold at which residuals were cut off, mm; infinite if none was

    Returns
    -------
    float
        σ per axis, mm, at most the threshold.
    """
    sigma = float(np.sqrt(square_sum / model.redundancy(count)))
    if sigma == 0 or threshold > WIDE * sigma:
        return sigma

    def excess(candidate: float) -> float:
        cut = threshold / candidate
        return candidate**2 * kept_variance(cut) / kept_share(cut) - sigma**2

    if excess(threshold) < 0:
        return threshold
    bracket = (sigma, threshold)
    return float(root_scalar(excess, method="brentq", bracket=bracket, xtol=1e-9 * sigma, rtol=1e-9).root)


def covariance_of(inliers: Problem, b_from_a: Transform, sigma: float, threshold: float) -> Covariance:
    """Returns the covariance of a fit.

    A given σ is kept unless χ² contradicts it. Cutting off at c σ increases the variance of the estimate by the factor
    χ²₃(c²)/χ²₅(c²), as for an M-estimator with hard rejection.

    ``inliers`` : points that the transform is fitted to; ``b_from_a`` : transform; ``sigma`` : estimated σ, mm of a
    point of mean σ; ``threshold`` : threshold at which residuals were cut off, mm; infinite if none was.
    """
    model, noise = inliers.model, inliers.noise
    redundancy = float(inliers.redundancy)
    used, scaled = sigma, True
    if noise.sigma_mm is not None:
        scaled = bool(chdtrc(redundancy, redundancy * (sigma / noise.sigma_mm) ** 2) < CONTRADICTED_AT)
        if not scaled:
            used, redundancy = noise.sigma_mm, np.inf
    matrix = used**2 * unit_covariance(model, b_from_a, inliers.xyz_a, noise.precision)
    if used > 0 and threshold < WIDE * used:
        cut = threshold / used
        matrix = matrix * kept_share(cut) / kept_variance(cut)
    return Covariance(matrix, scaled, redundancy)


def shifted_too(covariance: Covariance, off_mm: np.ndarray) -> Covariance:
    """Adds a common shift (3,), mm, as an error to the covariance of a fit between two groups of points."""
    p = len(covariance.matrix)
    by_step = np.zeros(p)
    by_step[slice(3, None, 4) if p == 12 else slice(3, 6)] = off_mm
    return replace(covariance, matrix=covariance.matrix + np.outer(by_step, by_step))
