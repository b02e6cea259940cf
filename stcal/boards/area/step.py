"""The area of a pixel on either side of an edge, and the displacement of edges by sampling."""

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

PIXEL_VARIANCE = 1 / 12
"""Variance of a square pixel about its centre, px²."""
PRIOR_PX, PRIOR_LINES = 0.005, 1
"""σ of the displacement of edges by the pixels' sampling before an image is seen, px, and the number of lines that it
counts as."""


def integrated_step(distance: np.ndarray, normal: np.ndarray, variance: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the share of the bright side of an edge in pixels, and derivatives of this share.

    The square pixel as the edge's normal sees it is a trapezoid, the convolution of two boxes. The wider one, and with
    it an edge along the rows, is integrated exactly; the narrower one, like the blur, as a Gaussian of its variance.

    Parameters
    ----------
    distance : (m, ...) array
        Distances of the pixels' centres from the edges, positive on the bright side, px.
    normal : (m, 2) array
        Normals of the edges.
    variance : (m,) array
        Variances of the blur, px².

    Returns
    -------
    tuple of (m, ...) arrays
        The share; its derivatives by distance and by variance.
    """
    narrow, wide = (side.reshape(-1, *(1,) * (distance.ndim - 1)) for side in np.sort(np.abs(normal), axis=1).T)
    sigma = np.sqrt(variance.reshape(narrow.shape) + narrow**2 / 12)
    first, last = ((distance + shift) / sigma for shift in (wide / 2, -wide / 2))
    below = ndtr(first), ndtr(last)
    density = tuple(np.exp(-0.5 * at**2) / np.sqrt(2 * np.pi) for at in (first, last))
    step = sigma * (first * below[0] + density[0] - last * below[1] - density[1])
    widening = (density[0] - density[1]) / (2 * sigma)
    return step / wide, (below[0] - below[1]) / wide, widening / wide


def solved(design: np.ndarray, weight: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the least-squares solutions (m, q) and inverse normal matrices (m, q, q)."""
    m, q = len(design), design.shape[-1]
    rows, w = design.reshape(m, -1, q), weight.reshape(m, -1, 1)
    normal = np.swapaxes(rows, 1, 2) @ (w * rows) + 1e-9 * np.eye(q)
    inverse = np.linalg.inv(normal)
    return (inverse @ (np.swapaxes(rows, 1, 2) @ (w * right.reshape(m, -1, 1))))[..., 0], inverse


def of_sampling(phase: np.ndarray, gradient: np.ndarray) -> np.ndarray:
    """Return the gradients (m, p, s, 2) by a displacement of 1 px that follows the cosine, or the sine, of the phase.

    Sampling displaces an edge by an amount that depends on its place between two pixels, ``phase`` (m, p, s) in pixels,
    and comes again from pixel to pixel: in an edge along the rows it is one for all profiles, in a turned one it
    averages out. Its first harmonic is what is modelled.
    """
    angle = 2 * np.pi * phase
    return gradient[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)


@dataclass(frozen=True, slots=True, eq=False)
class Displacement:
    """What lines say about the variance of the displacement of edges by sampling, px².

    ``square`` : (k,) estimates of the variance, which may be negative; ``noise`` : (k,) the mean of their part by other
    errors; ``lines`` : (k,) the equivalent number of lines of each.
    """

    square: np.ndarray
    noise: np.ndarray
    lines: np.ndarray


def displacement_variance(*parts: Displacement) -> float:
    """Return the mean of the estimates, weighted by their certainty, with a prior; at least 0."""
    square, noise, lines = (
        np.concatenate([getattr(part, name) for part in parts]) for name in ("square", "noise", "lines")
    )
    certainty = np.where(np.isfinite(square), lines * (noise + PRIOR_PX**2) ** -2, 0.0)
    prior = PRIOR_LINES * PRIOR_PX**-4
    mean = (np.nansum(certainty * np.nan_to_num(square)) + prior * PRIOR_PX**2) / (np.nansum(certainty) + prior)
    return max(float(mean), 0.0)
