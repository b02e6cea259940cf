"""Robust weights and scales: Huber's loss of lengths, and σ from medians; and what chance exceeds seldom.

A length is that of d coordinates over their σ; of normal errors its square is χ² distributed with d degrees of freedom.
"""

import numpy as np
from scipy.special import chdtri, fdtri

HUBER = 3.0
"""Limit of a length of two coordinates over their robust σ: one honest residual in ninety is longer, and loses hardly
anything."""


def length_limit(coordinates: int, beyond: float) -> float:
    """Length that normal errors of so many ``coordinates`` exceed with probability ``beyond``."""
    return float(np.sqrt(chdtri(coordinates, beyond)))


def ratio_limit(beyond: float, freedom: float, redundancy: float) -> float:
    """Ratio of two variances, of so many degrees of freedom each, that chance exceeds with probability ``beyond``: of
    the F distribution, by its lower end, which small probabilities leave exact."""
    return float(1 / fdtri(redundancy, freedom, beyond))


def median_length(coordinates: int) -> float:
    """Length that half of the normal errors of so many ``coordinates`` exceed, in σ."""
    return length_limit(coordinates, 0.5)


def huber_weights(length: np.ndarray, limit: float) -> np.ndarray:
    """Weights of lengths, same shape: 1 up to ``limit``, then falling with the inverse of the length (Huber 1964)."""
    return limit / np.maximum(length, limit) if np.isfinite(limit) else np.ones_like(length)


def huber_cost(length: np.ndarray, limit: float) -> np.ndarray:
    """Loss of lengths, same shape: the square up to ``limit``, then linear; its derivative is 2 · weight · length."""
    short = np.minimum(length, limit)
    return short * (2 * length - short)


def robust_sigma(length: np.ndarray, coordinates: int = 1, redundancy: float = 1.0) -> float:
    """σ of one coordinate from the median of lengths (n,); half of them may be anything.

    Parameters
    ----------
    length
        (n,) Absolute values, or lengths of so many ``coordinates``.
    coordinates
        Behind each length.
    redundancy
        Share of the observations that parameters have not taken up: residuals are shorter than errors by its root.
    """
    return _median(length) / (median_length(coordinates) * np.sqrt(redundancy))


def robust_sigmas(length: np.ndarray, among: np.ndarray) -> np.ndarray:
    """:func:`robust_sigma` of each row of absolute values (n, m), (n,), of those that the mask ``among`` (n, m) takes;
    NaN where it takes none."""
    ordered = np.sort(np.where(among, length, np.inf), axis=1)
    count = among.sum(1)
    middle = np.maximum(np.stack([(count - 1) // 2, count // 2], 1), 0)
    median = np.take_along_axis(ordered, middle, 1).mean(1) if ordered.shape[1] else np.full(len(length), np.nan)
    return np.where(count > 0, median, np.nan) / median_length(1)


def _median(values: np.ndarray) -> float:
    """``np.median`` of (n,), which takes five times as long for some hundred numbers."""
    n = len(values)
    if n < 2:
        return float(np.median(values))
    part = np.partition(values, (n // 2 - 1, n // 2, n - 1))
    if np.isnan(part[-1]):  # sorted last
        return float(part[-1])
    return float(part[n // 2] if n % 2 else (part[n // 2 - 1] + part[n // 2]) / 2)
