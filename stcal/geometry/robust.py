"""Robust weights and scales: Huber's loss of lengths, σ from medians, and limits of given false-alarm probability. A
length is the norm of d coordinates over their σ, of normal errors the root of a χ² of d degrees of freedom."""

from functools import partial

import numpy as np
from scipy.optimize import brentq
from scipy.special import chdtri, fdtri

HUBER = 3.0
"""Limit of Huber's loss for the length of two coordinates over their robust σ; one inlier in ninety is longer."""


def length_limit(coordinates: int, beyond: float) -> float:
    """Return the length that normal errors in this number of ``coordinates`` exceed with probability ``beyond``."""
    return float(np.sqrt(chdtri(coordinates, beyond)))


median_length = partial(length_limit, beyond=0.5)
"""Return the median length of normal errors in a number of coordinates, in σ."""
TAIL = 0.05
"""Share of the lengths beyond the quantile that tells how heavy the tail is: gross errors are fewer."""
TAIL_SIGMAS, LEAST_FREEDOM, MOST_FREEDOM = 1.0, 2.0, 1e3
"""Number of sampling errors of the quantiles that a tail is allowed; limits of the degrees of freedom."""


def tailed_limit(length: np.ndarray, beyond: float, together: int = 1) -> float:
    """Return the length over σ that sound errors in two coordinates exceed with probability ``beyond``, from a sample
    (n,). Where σ are estimates, errors over σ have Student's distribution. Its degrees of freedom are the fewest that
    the ratio of two low quantiles admits. ``together`` : number of lengths that share an error."""

    def quantile(exceeded: float, freedom: float) -> float:
        return float(np.sqrt(freedom * np.expm1(-2 / freedom * np.log(exceeded))))

    middle, high = np.quantile(length, [0.5, 1 - TAIL])
    # Variances of logarithms of quantiles, of normal errors.
    far, near = length_limit(2, TAIL) ** 2, length_limit(2, 0.5) ** 2
    variance = ((1 - TAIL) / TAIL / far**2 + 1 / near**2 - 2 / far / near) * together / len(length)
    ratio = high / max(middle, 1e-9) * np.exp(TAIL_SIGMAS * np.sqrt(variance))

    def off(logarithm: float) -> float:
        return quantile(TAIL, np.exp(logarithm)) / quantile(0.5, np.exp(logarithm)) - ratio

    low, high = float(np.log(LEAST_FREEDOM)), float(np.log(MOST_FREEDOM))
    logarithm = high if off(high) > 0 else brentq(off, low, high) if off(low) > 0 else low
    freedom = float(np.exp(np.asarray(logarithm, float)))
    return max(quantile(beyond, freedom) * middle / quantile(0.5, freedom), length_limit(2, beyond))


def ratio_limit(beyond: float, freedom: float, redundancy: float) -> float:
    """Return the ratio of two variances that chance exceeds with probability ``beyond``: a quantile of F."""
    return float(1 / fdtri(redundancy, freedom, beyond))


def huber_weights(length: np.ndarray, limit: float) -> np.ndarray:
    """Return weights of lengths, same shape: 1 up to ``limit``, then falling as the inverse length (Huber 1964)."""
    return limit / np.maximum(length, limit) if np.isfinite(limit) else np.ones_like(length)


def huber_cost(length: np.ndarray, limit: float) -> np.ndarray:
    """Return the loss of lengths, same shape: square up to ``limit``, then linear; derivative 2 · weight · length."""
    short = np.minimum(length, limit)
    return short * (2 * length - short)


def robust_sigma(length: np.ndarray, coordinates: int = 1, redundancy: float = 1.0) -> float:
    """Return σ of one coordinate from the median of lengths (n,) over ``coordinates``, up to half of them outliers.
    ``redundancy`` : per observation; residuals are shorter than errors by its square root."""
    n = len(length)
    if n < 2:
        median = float(np.median(length))
    else:  # five times as fast as np.median for some hundred numbers
        part = np.partition(length, (n // 2 - 1, n // 2, n - 1))
        middle = part[n // 2] if n % 2 else (part[n // 2 - 1] + part[n // 2]) / 2
        median = float(part[-1] if np.isnan(part[-1]) else middle)  # NaN is sorted last
    return median / (median_length(coordinates) * np.sqrt(redundancy))


def robust_sigmas(length: np.ndarray, among: np.ndarray) -> np.ndarray:
    """Return :func:`robust_sigma` (n,) of each row of absolute values (n, m) ``among`` these (n, m); NaN of none."""
    ordered = np.sort(np.where(among, length, np.inf), axis=1)
    count = among.sum(1)
    middle = np.maximum(np.stack([(count - 1) // 2, count // 2], 1), 0)
    median = np.take_along_axis(ordered, middle, 1).mean(1) if ordered.shape[1] else np.full(len(length), np.nan)
    return np.where(count > 0, median, np.nan) / median_length(1)
