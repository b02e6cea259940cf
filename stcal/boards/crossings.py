"""Corners at which four squares meet, black and white crosswise, measured by the areas of both in each pixel."""

from dataclasses import dataclass

import numpy as np

from stcal.boards.edges import (
    BIN_PX,
    MIN_VARIANCE,
    PIXEL_VARIANCE,
    PRIOR_PX,
    ROUNDING,
    START_VARIANCE,
    integrated_step,
    solved,
)

STEPS = 4
"""Number of Gauss–Newton steps."""
MOST_MOVED_PX = 1.0
"""Largest distance of a crossing from its start."""
MOST_LEFT = 0.15
"""Largest RMS residual of a window, as a share of the contrast; a window with a larger one shows something else."""
WIDEST_BLUR = 0.4
"""Largest σ of the blur, in half sides of the window: a wider one leaves no area of one colour."""


@dataclass(frozen=True, slots=True, eq=False)
class Crossings:
    """Crossings ``xy_px`` (n, 2) with ``covariance_px2`` (n, 2, 2); ``seen`` : (n,) False where a window shows none."""

    xy_px: np.ndarray
    covariance_px2: np.ndarray
    seen: np.ndarray


def crossings(grey: np.ndarray, start: np.ndarray, along: np.ndarray, half: np.ndarray) -> Crossings:
    """Measure the crossings near ``start`` (n, 2) of edges in the directions ``along`` (n, 2, 2), one edge in a row.

    ``half`` : (n,) half the sides of the square windows, whole px; nothing else may be in a window.
    """
    n = len(start)
    xy, covariance, seen = start.astype(float), np.full((n, 2, 2), np.nan), np.zeros(n, bool)
    for side in np.unique(half).tolist():
        rows = np.flatnonzero(half == side)
        xy[rows], covariance[rows], seen[rows] = _of_size(grey, start[rows], along[rows], side)
    return Crossings(np.where(seen[:, None], xy, start), covariance, seen)


def _of_size(grey, start, along, half: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the crossings, their covariances and a mask of those seen, for windows of one size."""
    n, q = len(start), 11
    offsets = np.stack(np.meshgrid(*[np.arange(-half, half + 1)] * 2), axis=-1).reshape(-1, 2)
    pixels = np.rint(start).astype(int)[:, None] + offsets
    last = np.array(grey.shape[::-1]) - 1
    inside = ((pixels >= 0) & (pixels <= last)).all((1, 2))
    x, y = np.moveaxis(pixels.clip(0, last), 2, 0)
    level, weight = grey[y, x].astype(float), np.ones(x.shape)
    relative = offsets / half
    shade = np.broadcast_to(np.column_stack([np.ones(len(offsets)), relative]), (n, len(offsets), 3))
    angle = np.arctan2(along[..., 1], along[..., 0])
    value = np.zeros((n, q))  # shift, turns of both edges, variance of the blur, dark and rise with their gradients
    value[:, 4] = START_VARIANCE
    residual = first = second = distance = level
    design, inverse = np.zeros((*level.shape, q)), np.zeros((n, q, q))
    for k in range(STEPS + 1):
        direction = np.stack([np.cos(angle + value[:, 2:4]), np.sin(angle + value[:, 2:4])], axis=-1)
        normal = np.stack([-direction[..., 1], direction[..., 0]], axis=-1)
        off = pixels - (start + value[:, :2])[:, None]
        distance, place = (np.einsum("nki,nei->enk", off, axes) for axes in (normal, direction))
        (one, slope1, wide1, _), (two, slope2, wide2, _) = (
            integrated_step(distance[e], normal[:, e], value[:, 4]) for e in (0, 1)
        )
        # Where edges are not square, the pixel sees both at once (first term of the tetrachoric series).
        both = (normal[:, 0] * normal[:, 1]).sum(1) * (value[:, 4] + PIXEL_VARIANCE)
        cross = one * two + (1 - one) * (1 - two) + 2 * both[:, None] * slope1 * slope2
        by_first, by_second = (2 * two - 1) * slope1, (2 * one - 1) * slope2
        levels = np.concatenate([shade, cross[..., None] * shade], axis=2)
        if not k:
            value[:, 5:] = solved(levels, weight, level)[0]
        rise = (shade @ value[:, 8:, None])[..., 0]
        first, second = rise * by_first, rise * by_second
        design = np.concatenate(
            [
                -first[..., None] * normal[:, None, 0] - second[..., None] * normal[:, None, 1],
                np.stack([-first * place[0], -second * place[1]], axis=-1),
                (rise * ((2 * two - 1) * wide1 + (2 * one - 1) * wide2))[..., None],
                levels,
            ],
            axis=2,
        )
        residual = level - (levels @ value[:, 5:, None])[..., 0]
        change, inverse = solved(design, weight, residual)
        if k < STEPS:
            value += np.where(np.isfinite(change), change, 0.0)
            value[:, 4] = value[:, 4].clip(MIN_VARIANCE, half**2)
    noise = np.maximum((residual**2).sum(1) / (len(offsets) - q), ROUNDING)
    pull = (design @ inverse)[..., :2]
    covariance = noise[:, None, None] * inverse[:, :2, :2]
    for displaced, apart in ((first, distance[0]), (second, distance[1])):
        covariance += PRIOR_PX**2 * _common(pull * displaced[..., None], apart, half)
    seen = inside & np.isfinite(covariance).all((1, 2)) & (np.linalg.norm(value[:, :2], axis=1) <= MOST_MOVED_PX)
    seen &= (np.sqrt(noise) <= MOST_LEFT * np.abs(value[:, 8])) & (np.sqrt(value[:, 4]) <= WIDEST_BLUR * half)
    return start + value[:, :2], covariance, seen


def _common(pull: np.ndarray, distance: np.ndarray, half: int) -> np.ndarray:
    """Return Σ over classes of distances of the squares (n, 2, 2) of what all pixels of a class pull (n, k, 2)."""
    n, most = len(pull), round(2 * half / BIN_PX)
    bins = 2 * most + 1
    row = np.rint(distance / BIN_PX).clip(-most, most).astype(int) + most + bins * np.arange(n)[:, None]
    summed = np.stack([np.bincount(row.ravel(), pull[..., i].ravel(), n * bins) for i in (0, 1)], axis=-1)
    summed = summed.reshape(n, bins, 2)
    return np.swapaxes(summed, 1, 2) @ summed
