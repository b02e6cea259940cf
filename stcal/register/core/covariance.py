"""What noise the residuals have, and what covariance follows for the transform.

Inside, inverse covariances are scaled so that a point of mean σ (the RMS of all σ) has σ = 1: whitened residuals are
millimetres of such a point.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq
from scipy.stats import chi2

from stcal.errors import InputError
from stcal.register.core.models import Model, Transform, unit_covariance

CONTRADICTED_AT = 0.01
"""Given σ are scaled when so small residuals as theirs have less than this chance (two-sided would be twice)."""
WIDE = 8.0
"""Beyond so many σ nothing is cut off: the tail of χ²₃ is 1e-13."""


@dataclass(frozen=True, slots=True, eq=False)
class Noise:
    """``precision`` : None, (n,) or (n, 3, 3), inverse covariances at mean σ 1; ``sigma_mm`` : that mean σ where it was
    given in mm, else None."""

    precision: np.ndarray | None = None
    sigma_mm: float | None = None

    def __getitem__(self, rows) -> "Noise":
        return self if self.precision is None else Noise(self.precision[rows], self.sigma_mm)


def noise_of(n: int, weights: np.ndarray | None, covariances: np.ndarray | None) -> Noise:
    """From weights (n,) ~ 1/σ², or covariances (n, 3, 3) or variances per axis (n,), mm².

    Raises
    ------
    InputError
        Both given, another shape, or weights and covariances that are not positive.
    """
    if weights is not None and covariances is not None:
        raise InputError("registration: weights and covariances given; give only one of them")
    if weights is None and covariances is None:
        return Noise()
    given, name = (weights, "weights") if covariances is None else (covariances, "covariances")
    given = np.asarray(given, float)
    if given.shape != (n,) and (name == "weights" or given.shape != (n, 3, 3)):
        raise InputError(f"registration: {name} of shape {given.shape} for {n} point pairs; one for each needed")
    matrices = given.ndim == 3
    lowest = np.linalg.eigvalsh(given)[:, 0] if matrices else given
    bad = np.flatnonzero(~(np.isfinite(lowest) & (lowest > 0)))
    if len(bad):
        raise InputError(
            f"registration: {name}: row {bad[0] + 1} has {lowest[bad[0]]:.3g}, a positive number needed; "
            "leave a row out to give it no weight"
        )
    if name == "weights":
        return Noise(given * np.mean(1 / given))
    variance = float(np.mean(np.trace(given, axis1=1, axis2=2) / 3 if matrices else given))
    return Noise((np.linalg.inv(given) if matrices else 1 / given) * variance, float(np.sqrt(variance)))


def kept_share(cut: float) -> float:
    """Share of points within ``cut`` σ: χ²₃."""
    return float(chi2.cdf(cut**2, 3))


def kept_variance(cut: float) -> float:
    """Share of the points' whole square sum that those within ``cut`` σ hold: χ²₅."""
    return float(chi2.cdf(cut**2, 5))


def sigma_within(square_sum: float, model: Model, count: int, threshold: float | None) -> float:
    """σ per axis, mm, of points whose residuals were cut off at ``threshold``; at most the threshold.

    Those within c σ hold only the share χ²₅(c²)/χ²₃(c²) of their variance: σ solves s² = σ² χ²₅/χ²₃ at c = t/σ. Below
    c = 1 they fill the sphere all but evenly and say nothing about σ.
    """
    sigma = float(np.sqrt(square_sum / model.freedom(count)))
    if threshold is None or sigma == 0 or threshold > WIDE * sigma:
        return sigma

    def excess(candidate: float) -> float:
        cut = threshold / candidate
        return candidate**2 * kept_variance(cut) / kept_share(cut) - sigma**2

    if excess(threshold) < 0:
        return threshold
    return float(brentq(excess, sigma, threshold, xtol=1e-9 * sigma, rtol=1e-9))


def covariance_of(
    model: Model,
    transform: Transform,
    xyz_a: np.ndarray,
    noise: Noise,
    sigma: float,
    threshold: float | None,
) -> tuple[np.ndarray, bool, float]:
    """Covariance of the fit to inliers (n, 3), whether it rests on their residuals, and its σ's degrees of freedom.

    ``sigma`` : estimated, mm of a point of mean σ. σ given with the data stands unless χ² contradicts it.
    Cutting at c σ costs: the estimate's variance grows by χ²₃(c²)/χ²₅(c²) (that of an M-estimator with hard rejection).
    """
    count = len(xyz_a)
    dof = float(model.freedom(count))
    used, scaled = sigma, True
    if noise.sigma_mm is not None:
        scaled = bool(chi2.sf(dof * (sigma / noise.sigma_mm) ** 2, dof) < CONTRADICTED_AT)
        if not scaled:
            used, dof = noise.sigma_mm, np.inf
    covariance = used**2 * unit_covariance(model, transform, xyz_a, noise.precision)
    if threshold is not None and used > 0 and threshold < WIDE * used:
        cut = threshold / used
        covariance = covariance * kept_share(cut) / kept_variance(cut)
    return covariance, scaled, dof
