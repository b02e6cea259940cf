"""Edges by the areas in each pixel, and how far the pixels' sampling displaces them."""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls
from scipy.special import ndtr

PIXEL_VARIANCE = 1 / 12  # variance of a square pixel about its centre, px²
PRIOR_PX = 0.005  # σ of the displacement of edges by the pixels' sampling before an image is seen, px
POINTS_PX = 0.01
"""The same of images that were resampled in points, as far as nothing shows that they were not, px."""
LEAST_PX = 0.0005  # least σ of a displacement that is told apart from another, px
ROUNDS = 5  # number of times that estimates are weighted by the variances found before
HARMONICS = 2.0  # estimates in that of an edge: the cosine and the sine of the phase


def integrated_step(distance: np.ndarray, normal: np.ndarray, variance: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the share of the bright side of m edges in pixels, and its derivatives by distance and by variance. The
    square pixel as the edge's normal (m, 2) sees it is a trapezoid, the convolution of two boxes. The wider one, and
    with it an edge along the rows, is integrated exactly; the narrower one, like the blur of ``variance`` (m,) px², as
    a Gaussian. ``distance`` : (m, ...) of the pixels' centres, positive on the bright side, px."""
    narrow, wide = (side.reshape(-1, *(1,) * (distance.ndim - 1)) for side in np.sort(np.abs(normal), axis=1).T)
    sigma = np.sqrt(variance.reshape(narrow.shape) + narrow**2 / 12)
    first, last = ((distance + shift) / sigma for shift in (wide / 2, -wide / 2))
    below = ndtr(first), ndtr(last)
    density = tuple(np.exp(-0.5 * at**2) / np.sqrt(2 * np.pi) for at in (first, last))
    step = sigma * (first * below[0] + density[0] - last * below[1] - density[1])
    widening = (density[0] - density[1]) / (2 * sigma)
    return step / wide, (below[0] - below[1]) / wide, widening / wide


def reach_of(reach: np.ndarray, rise: np.ndarray) -> int:
    """Return how many pixels to either side of the middle one, half a pixel off the edge, lie within ``reach`` (m,)."""
    across = reach.ravel() / np.abs(rise)
    return int(np.ceil(np.max(across, initial=1.0, where=np.isfinite(across)) + 0.5))


def across_edges(
    grey: np.ndarray, major: np.ndarray, column: np.ndarray, middle: np.ndarray, half: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return levels (m, p, s), places (m, p, s, 2) and whether they are in the image, of pixels across m edges.
    ``major`` : (m,) 0 for an edge along the rows, taken by columns; ``column``, ``middle`` : (m, p)."""
    across = middle[..., None] + np.arange(-half, half + 1)
    along = np.broadcast_to(column[..., None], across.shape)
    by_column = (major == 0)[:, None, None]
    x, y = np.where(by_column, along, across), np.where(by_column, across, along)
    height, width = grey.shape
    level = grey[y.clip(0, height - 1).astype(int), x.clip(0, width - 1).astype(int)].astype(float)
    return level, np.stack([x, y], axis=-1), (x >= 0) & (y >= 0) & (x < width) & (y < height)


def products(left: np.ndarray, weight: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return the sums (m, q, k) over the pixels (p, s) of weight · left · rightᵀ, of (m, p, s, q) and (m, p, s, k)."""
    m, pixels = len(weight), int(np.prod(weight.shape[1:]))
    rows, others = (values.reshape(m, pixels, values.shape[-1]) for values in (left, right))
    return np.swapaxes(rows, 1, 2) @ (weight.reshape(m, pixels, 1) * others)


def solved(design: np.ndarray, weight: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the least-squares solutions (m, q) and inverse normal matrices (m, q, q), NaN where they are singular."""
    normal = products(design, weight, design) + 1e-9 * np.eye(design.shape[-1])
    try:
        inverse = np.linalg.inv(normal)
    except np.linalg.LinAlgError:  # one of them is enough
        regular = np.linalg.matrix_rank(normal, hermitian=True) == normal.shape[-1]
        inverse = np.full_like(normal, np.nan)
        inverse[regular] = np.linalg.inv(normal[regular])
    return (inverse @ products(design, weight, right[..., None]))[..., 0], inverse


def passed_by_blur(rise: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """Return the displacements (m,) of edges by sampling, relative to that of an edge along the rows: a Gaussian blur
    of ``variance`` σ² passes exp(−2π²σ²f²) of what the image contains at the frequency f of the pixels across the edge.
    ``rise`` : (m,) change of the distance from the edge from one pixel to the next."""
    return np.exp(-2 * np.pi**2 * variance * (rise**-2 - 1))


def of_sampling(distance: np.ndarray, rise: np.ndarray, gradient: np.ndarray) -> np.ndarray:
    """Return the gradients (m, p, s, 2) by a displacement of 1 px that follows the cosine, or the sine, of the phase:
    sampling displaces all profiles of an edge along the rows alike. ``gradient`` : (m, p, s) derivative of the grey
    values by the place of the edge."""
    angle = -2 * np.pi * distance / rise[:, None, None]
    return gradient[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)


@dataclass(frozen=True, slots=True, eq=False)
class Displacement:
    """What k turned edges say about the variance of their displacement by sampling, px²."""

    square: np.ndarray  # the variance, which may be negative
    noise: np.ndarray  # mean of its part by other errors
    passed: np.ndarray  # as of :func:`passed_by_blur`


@dataclass(frozen=True, slots=True)
class SamplingVariance:
    """Variances of the displacement of edges by sampling, px²."""

    of_area: float  # of an edge along the rows; the blur passes less of it in turned ones
    of_points: float  # of all edges in images that were resampled in points before they were blurred

    def of(self, passed: np.ndarray) -> np.ndarray:
        """Return the variances of edges of which the blur passes ``passed`` (m,)."""
        return self.of_area * passed**2 + self.of_points


def displacement_variance(told: Displacement) -> SamplingVariance:
    """Return the variances that explain the estimates, weighted by certainty, best; at least 0, with a prior."""
    known = np.isfinite(told.square)
    square, noise, passed = told.square[known], told.noise[known], told.passed[known]
    design = np.stack([passed**2, np.ones_like(passed)], axis=-1)
    before = np.array([PRIOR_PX, POINTS_PX]) ** 2
    variance = before
    for _ in range(ROUNDS):
        root = np.sqrt(HARMONICS) / (noise + design @ variance + LEAST_PX**2)  # squares vary as themselves
        rows = np.concatenate([root[:, None] * design, np.diag(1 / before)])
        variance = nnls(rows, np.concatenate([root * square, np.ones(2)]))[0]
    return SamplingVariance(*variance.tolist())
