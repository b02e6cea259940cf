"""Boards rendered by area: each pixel holds the exact share of it that is black, then blur, noise and rounding."""

from collections.abc import Sequence

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter

from stcal.boards.board_designs import SquaresOrTags, black_areas

FINE = 4  # pixels of the grid, along each axis of a pixel, on which blur is applied


def rendered(
    board: SquaresOrTags,
    image_from_mm: np.ndarray,
    size: tuple[int, int],
    rng: np.random.Generator,
    blur_px: float = 0.5,
    grey: tuple[float, float] = (20.0, 220.0),
    noise: float = 2.0,
) -> np.ndarray:
    """The board (mm) through a homography to pixels; Gaussian blur, ``grey`` values of black and white."""
    width, height = size
    fine = FINE if blur_px else 1
    black = np.zeros((height * fine, width * fine))
    for lines in black_areas(board):
        for line in lines:
            there = np.pad(line, ((0, 0), (0, 1)), constant_values=1.0) @ image_from_mm.T
            add_area(black, (there[:, :2] / there[:, 2:] + 0.5) * fine - 0.5)
    if blur_px:
        black = gaussian_filter(black, blur_px * fine).reshape(height, fine, width, fine).mean((1, 3))
    level = grey[1] + (grey[0] - grey[1]) * np.abs(black) + noise * rng.standard_normal((height, width))
    return np.clip(np.rint(level), 0, 255).astype(np.uint8)


def add_area(share: np.ndarray, line: np.ndarray) -> None:
    """Add to each pixel (centres are integers) its share inside a closed line (k, 2), with the sign of its turn."""
    last = np.array(share.shape[::-1]) - 1
    first, end = (np.clip(at, 0, last).astype(int) for at in (np.floor(line.min(0)) - 1, np.ceil(line.max(0)) + 1))
    x, y = (np.arange(a, b + 2) - 0.5 for a, b in zip(first, end, strict=True))
    below = np.zeros((len(y), len(x)))  # area inside with smaller x and y
    for (xa, ya), (xb, yb) in zip(line, np.roll(line, -1, axis=0), strict=True):
        if yb != ya:
            to = np.clip(y, min(ya, yb), max(ya, yb))
            ends = [xa + (xb - xa) * (value - ya) / (yb - ya) for value in (np.full_like(to, min(ya, yb)), to)]
            below += np.sign(yb - ya) * (to - min(ya, yb))[:, None] * _mean_of_least(*ends, x)
    share[first[1] : end[1] + 1, first[0] : end[0] + 1] += np.diff(np.diff(below, axis=0), axis=1)


def _mean_of_least(start: np.ndarray, end: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Mean of min(u, x) over u from each ``start`` to its ``end``, (k, len(x))."""
    apart = np.abs(end - start) > 1e-7
    integral = [np.where(u < x, u**2 / 2, x * u - x**2 / 2) for u in (start[:, None], end[:, None])]
    mean = (integral[1] - integral[0]) / np.where(apart, end - start, 1.0)[:, None]
    return np.where(apart[:, None], mean, np.minimum((start + end)[:, None] / 2, x))


def warped(
    sheet: np.ndarray,
    image_from_sheet: np.ndarray,
    size: tuple[int, int],
    rng: np.random.Generator,
    blur_px: float = 0.5,
    grey: tuple[float, float] = (20.0, 220.0),
    noise: float = 2.0,
) -> np.ndarray:
    """A drawn sheet by OpenCV's warp on the finer grid, averaged: its edges lie on pixels of the sheet, to 0.01 px."""
    from_image = np.array([[FINE, 0, (FINE - 1) / 2], [0, FINE, (FINE - 1) / 2], [0, 0, 1.0]])
    fine_size = (FINE * size[0], FINE * size[1])
    fine = cv2.warpPerspective(sheet, from_image @ image_from_sheet, fine_size, borderValue=255)
    seen = cv2.GaussianBlur(cv2.resize(fine, size, interpolation=cv2.INTER_AREA).astype(float), (0, 0), blur_px)
    level = grey[0] + (grey[1] - grey[0]) * seen / 255 + noise * rng.standard_normal(seen.shape)
    return np.clip(np.rint(level), 0, 255).astype(np.uint8)


def squares_nees(error: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Squares of errors (n, d) by their covariances (n, d, d), over d: 1 is expected."""
    return (error * np.linalg.solve(covariance, error[..., None])[..., 0]).sum(-1) / error.shape[-1]


def homography(camera_matrix: np.ndarray, rotation: np.ndarray, translation: Sequence[float]) -> np.ndarray:
    return camera_matrix @ np.column_stack([rotation[:, :2], translation])
