"""Sheets drawn as a camera would see them."""

import cv2
import numpy as np

IMAGE_FROM_MM = np.array([[2.6, -0.5, 330.0], [0.4, 2.3, 180.0], [-2e-4, 3e-4, 1.0]])
"""A view with perspective, pixels of the image from millimetres on the sheet."""
SHARPER = 3
"""The view is drawn larger by this and averaged down, which makes the edges what pixels see."""


def chessboard_mm(rows: int, columns: int, square: float, per_mm: int = 4) -> tuple[np.ndarray, float]:
    """The printed sheet, and the place of inner corner (0, 0) on it, mm."""
    margin = 2 * square
    side = int(square * per_mm)
    cells = np.add.outer(np.arange(rows + 1), np.arange(columns + 1)) % 2 == 0
    board = np.kron(np.where(cells, 0, 255), np.ones((side, side))).astype(np.uint8)
    edge = int(margin * per_mm)
    return cv2.copyMakeBorder(board, edge, edge, edge, edge, cv2.BORDER_CONSTANT, value=255), margin + square


def photograph(sheet: np.ndarray, per_mm: int, image_from_mm: np.ndarray, size=(1200, 900)) -> np.ndarray:
    """The sheet (pixels, ``per_mm`` of them a millimetre, white around) seen through a homography; a little noise."""
    # Centres of pixels are integers: half a pixel of the sheet, and of the image, lies before each.
    mm_from_sheet = np.array([[1 / per_mm, 0, 0.5 / per_mm], [0, 1 / per_mm, 0.5 / per_mm], [0, 0, 1]])
    fine_from_image = np.array([[SHARPER, 0, (SHARPER - 1) / 2], [0, SHARPER, (SHARPER - 1) / 2], [0, 0, 1.0]])
    warp = fine_from_image @ image_from_mm @ mm_from_sheet
    fine = cv2.warpPerspective(
        sheet, warp, (SHARPER * size[0], SHARPER * size[1]), flags=cv2.INTER_LINEAR, borderValue=255
    )
    seen = cv2.GaussianBlur(cv2.resize(fine, size, interpolation=cv2.INTER_AREA), (0, 0), 0.6).astype(float)
    noise = np.random.default_rng(0).normal(0, 1.5, seen.shape)
    return np.clip(0.8 * seen + 25 + noise, 0, 255).astype(np.uint8)
