"""Boards rendered by area: each pixel holds the exact share of it that is black, then blur, noise and rounding."""

from collections.abc import Sequence

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter

from stcal.boards.board_designs import SquaresOrTags, black_areas
from stcal.geometry.plane import apply_homography
from stcal.synthetic.body_scene import covered_share

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
    areas = [[(apply_homography(image_from_mm, line) + 0.5) * fine for line in lines] for lines in black_areas(board)]
    black = covered_share(areas, (height * fine, width * fine)).astype(float)
    if blur_px:
        black = gaussian_filter(black, blur_px * fine).reshape(height, fine, width, fine).mean((1, 3))
    level = grey[1] + (grey[0] - grey[1]) * black + noise * rng.standard_normal((height, width))
    return np.clip(np.rint(level), 0, 255).astype(np.uint8)


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
