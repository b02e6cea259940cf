"""Detection of the inner corners of a chessboard, by both detectors of OpenCV in images of several sizes.

``cv2.findChessboardCornersSB`` (after Duda & Frese 2018) tolerates noise, shade and small squares; the older detector,
which joins dark squares, tolerates steep views and blur. Images are searched at the smallest size that shows the
squares, which is fastest, and then at others: a board that neither detector finds in one size may be found in another.
Corners are measured in the original image.
"""

from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np

from stcal.boards.design import BoardView, ChessboardDesign, view_of
from stcal.boards.edges import Crossings, crossings
from stcal.geometry.plane import apply_homography, fit_homography
from stcal.io.images import grey_8bit

WINDOW_SHARE = 0.4
"""Half the side of the window in which a corner is refined, as a share of the smallest square's side."""
REFINE_STEPS = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-5)
LEAST_WINDOW, MOST_WINDOW, MOST_AT_FIRST = 2.0, 20.0, 100.0
MOST_BY_AREA = 10.0
"""Limits of half that window's side, px: smallest, largest, largest in the first pass, and largest for areas."""
UNSEEN_PX = 0.1
"""σ of a corner that is where the gradients of its edges meet, as the areas in its window do not fit."""
SMOOTHED_SHARE, LEAST_SMOOTHING = 0.05, 0.3
"""σ of the smoothing before refinement, as a share of half the window's side, and its lower limit in px. Smoothing does
not move a saddle, but removes noise of the gradients, which would hold a corner at its start."""
MARGIN, LEAST_MARGIN = 3.0, 10.0
"""Margin about the corners in which the image is smoothed, in windows and then in px: no window comes near its end."""
FLAGS = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE
OLDER_FLAGS = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
PART, PART_FLAGS = (3, 3), cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_LARGER
"""Smallest grid of inner corners that counts as a part of a chessboard, and the flags to find one."""
FIRST_SIDE, LEAST_SIDE = 1600, 300
"""Longer side of the largest image that is searched before the original, and of the smallest one, px."""
PX_A_SQUARE = 25.0
"""Longer side of the first image that is searched, per square of the board's longer side, px: a board that fills a
third of it has squares of 8 px."""


def find_chessboard(
    image: np.ndarray, name: str, board: ChessboardDesign, with_sigma: bool = False
) -> BoardView | None:
    """Return all inner corners, or None; they are numbered so that the square between (0, 0) and (1, 1) is black.

    A board that looks the same after half a turn may be returned rotated: :meth:`ChessboardDesign.symmetries`.
    ``with_sigma`` : whether the view states the covariances of its corners.
    """
    grey = grey_8bit(image)
    for detected in _found(grey, board):
        measured = _refined(grey, detected)
        grid = measured.xy_px.reshape(detected.shape)
        if _is_a_grid(detected, grid):
            order = _numbered(grey, grid, board)
            covariance = np.where(measured.seen[:, None, None], measured.covariance_px2, UNSEEN_PX**2 * np.eye(2))
            stated = covariance[order] if with_sigma else None
            return view_of(name, board, np.arange(len(order)), measured.xy_px[order], stated)
    return None


def _found(grey: np.ndarray, board: ChessboardDesign) -> Iterator[np.ndarray]:
    """Yield the grids (rows, columns, 2) that the detectors find, px of the original image."""
    height, width = grey.shape
    longer = max(height, width)
    sides = [longer * 0.5**k for k in range(6) if k == 0 or longer * 0.5**k >= LEAST_SIDE]
    needed = min(PX_A_SQUARE * (max(board.rows, board.columns) + 1), FIRST_SIDE)
    first = [side for side in sides if side >= needed][-1:]
    moderate = [side for side in sides if side <= FIRST_SIDE and side not in first]
    for side in (*first, *moderate, *(side for side in sides if side not in (*first, *moderate))):
        scale = side / longer
        size = (max(round(scale * width), 1), max(round(scale * height), 1))
        small = grey if scale == 1 else cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
        pixel = np.array([width / size[0], height / size[1]])
        for find, flags in ((cv2.findChessboardCornersSB, FLAGS), (cv2.findChessboardCorners, OLDER_FLAGS)):
            success, corners = find(small, (board.columns, board.rows), flags=flags)
            if success:
                yield (corners.reshape(board.rows, board.columns, 2).astype(float) + 0.5) * pixel - 0.5


def _is_a_grid(found: np.ndarray, refined: np.ndarray) -> bool:
    """Return True if the refinement moved no corner to another one, and no square is folded."""
    steps = [np.linalg.norm(np.diff(refined, axis=axis), axis=2).min() for axis in (0, 1)]
    across, down = refined[:-1, 1:] - refined[:-1, :-1], refined[1:, :-1] - refined[:-1, :-1]
    turn = across[..., 0] * down[..., 1] - across[..., 1] * down[..., 0]
    stayed = np.linalg.norm(refined - found, axis=2).max() < min(steps) / 2
    return bool(stayed and (np.sign(turn) == np.sign(turn[0, 0])).all())


def _numbered(grey: np.ndarray, grid: np.ndarray, board: ChessboardDesign) -> np.ndarray:
    """Return the rows (k,) of the corners in the order of the design."""
    order = np.arange(grid.shape[0] * grid.shape[1]).reshape(grid.shape[:2])
    across, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    if across[0] * down[1] - across[1] * down[0] < 0:  # seen from the front, X to Y turns clockwise on the screen
        order = order[:, ::-1]
    xy = grid.reshape(-1, 2)
    if not _first_is_black(grey, xy[order], board):
        order = order[::-1, ::-1]
    if not _first_is_black(grey, xy[order], board) and board.rows == board.columns:
        order = np.rot90(order)
    return order.ravel()


def _refined(grey: np.ndarray, grid: np.ndarray) -> Crossings:
    """Return the corners to a few hundredths of a pixel; the detectors are off by up to half a pixel in slanted views.

    The first windows are large enough for blurred edges; the second are so small that lens distortion bends no edge.
    """
    window = _window(grid)
    margin = MARGIN * min(window, MOST_AT_FIRST) + LEAST_MARGIN
    first = np.floor(np.maximum(grid.min((0, 1)) - margin, 0)).astype(int)
    last = np.ceil(grid.max((0, 1)) + margin).astype(int) + 1
    grey, grid = grey[first[1] : last[1], first[0] : last[0]], grid - first
    for most in (MOST_AT_FIRST, MOST_WINDOW):
        half = int(min(window, most))
        smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), max(SMOOTHED_SHARE * half, LEAST_SMOOTHING))
        places = np.ascontiguousarray(grid.reshape(-1, 1, 2), np.float32)
        grid = cv2.cornerSubPix(smooth, places, (half, half), (-1, -1), REFINE_STEPS).reshape(grid.shape).astype(float)
        if window <= MOST_WINDOW:
            break
    measured = _by_area(grey, grid)
    return replace(measured, xy_px=measured.xy_px + first)


def _by_area(grey: np.ndarray, grid: np.ndarray) -> Crossings:
    """Return the corners by the areas of black and white in their windows, or unchanged where these do not fit.

    Where edges lie along the pixel rows, gradients place all corners by up to 0.02 px to one side.
    """
    along = np.stack([np.gradient(grid, axis=1), np.gradient(grid, axis=0)], axis=2).reshape(-1, 2, 2)
    half = int(min(_window(grid), MOST_BY_AREA))
    clear = np.linalg.norm(along, axis=2).min(1)
    return crossings(grey, grid.reshape(-1, 2), along, np.full(len(along), half), clear)


def _window(grid: np.ndarray) -> float:
    """Return half the side of a window that holds no neighbour of a corner, px."""
    steps = [np.linalg.norm(np.diff(grid, axis=axis), axis=2).min() for axis in (0, 1)]
    return max(WINDOW_SHARE * min(steps), LEAST_WINDOW)


def _first_is_black(grey: np.ndarray, grid: np.ndarray, board: ChessboardDesign) -> bool:
    """Return True if the square between corners (0, 0) and (1, 1) has the darker colour."""
    xy = board.xy_mm() / board.square_mm
    image_from_board = fit_homography(xy, grid.reshape(-1, 2))
    row, column = np.divmod(np.arange((board.rows - 1) * (board.columns - 1)), board.columns - 1)
    middle = apply_homography(image_from_board, np.column_stack([column, row]) + 0.5)
    x, y = np.rint(middle).astype(int).T
    inside = (x >= 0) & (y >= 0) & (x < grey.shape[1]) & (y < grey.shape[0])
    level = grey[y[inside], x[inside]].astype(float)
    even = ((row + column) % 2 == 0)[inside]
    return bool(even.all() or level[even].mean() < level[~even].mean())


def why_no_chessboard(image: np.ndarray, board: ChessboardDesign) -> str:
    """Return the likely reason why :func:`find_chessboard` finds nothing, judged by the number of corners in view."""
    grey = grey_8bit(image)
    scale = min(FIRST_SIDE / max(grey.shape), 1.0)
    small = grey if scale == 1 else cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    found, _, meta = cv2.findChessboardCornersSBWithMeta(small, PART, PART_FLAGS)
    inner = f"not all {board.rows}×{board.columns} inner corners of the chessboard"
    if not found:
        return f"{inner}, which rows and columns of its file count"
    rows, columns = sorted(meta.shape[:2])
    if rows > min(board.rows, board.columns) or columns > max(board.rows, board.columns):
        return f"{inner}, but {rows}×{columns}; correct rows and columns in its file, which count inner corners"
    return (
        f"{inner}, but {rows}×{columns}: a part of a plain chessboard has no numbers; show all of it, or correct rows "
        "and columns in its file"
    )
