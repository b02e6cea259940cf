"""The inner corners of a chessboard (through ``cv2.findChessboardCornersSB``, after Duda & Frese 2018)."""

import cv2
import numpy as np

from stcal.boards.design import BoardView, ChessboardDesign, view_of
from stcal.geometry.plane import apply_homography, fit_homography
from stcal.io.images import grey_8bit

WINDOW_SHARE = 0.4
"""Half the side of the window in which a corner is refined, as a share of the smallest square's side."""
REFINE_STEPS = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-5)
FLAGS = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY


def find_chessboard(image: np.ndarray, name: str, board: ChessboardDesign) -> BoardView | None:
    """All inner corners, numbered so that the square between (0, 0) and (1, 1) is black; None where they are not seen.

    A board that looks the same after half a turn may come out turned: :meth:`ChessboardDesign.symmetries`.
    """
    grey = grey_8bit(image)
    there, corners = cv2.findChessboardCornersSB(grey, (board.columns, board.rows), flags=FLAGS)
    if not there:
        return None
    grid = _refined(grey, corners.reshape(board.rows, board.columns, 2).astype(np.float32))
    across, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    if across[0] * down[1] - across[1] * down[0] < 0:  # seen from the front, X to Y turns clockwise on the screen
        grid = grid[:, ::-1]
    if not _first_is_black(grey, grid, board):
        grid = grid[::-1, ::-1]
    if not _first_is_black(grey, grid, board) and board.rows == board.columns:
        grid = np.rot90(grid)
    return view_of(name, board, np.arange(board.rows * board.columns), grid.reshape(-1, 2))


def _refined(grey: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """The corners to a few hundredths of a pixel; the detector's own are a quarter to a half off in slanted views."""
    steps = [np.linalg.norm(np.diff(grid, axis=axis), axis=2).min() for axis in (0, 1)]
    half = int(np.clip(WINDOW_SHARE * min(steps), 2, 20))
    found = cv2.cornerSubPix(grey, np.ascontiguousarray(grid.reshape(-1, 1, 2)), (half, half), (-1, -1), REFINE_STEPS)
    return found.reshape(grid.shape).astype(float)


def _first_is_black(grey: np.ndarray, grid: np.ndarray, board: ChessboardDesign) -> bool:
    """Whether the square between corners (0, 0) and (1, 1) is of the darker colour."""
    xy = board.xy_mm() / board.square_mm
    image_from_board = fit_homography(xy, grid.reshape(-1, 2))
    row, column = np.divmod(np.arange((board.rows - 1) * (board.columns - 1)), board.columns - 1)
    middle = apply_homography(image_from_board, np.column_stack([column, row]) + 0.5)
    x, y = np.rint(middle).astype(int).T
    inside = (x >= 0) & (y >= 0) & (x < grey.shape[1]) & (y < grey.shape[0])
    level = grey[y[inside], x[inside]].astype(float)
    even = ((row + column) % 2 == 0)[inside]
    return bool(even.all() or level[even].mean() < level[~even].mean())
