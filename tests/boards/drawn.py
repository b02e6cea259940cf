"""Sheets drawn as a camera would see them."""

import cv2
import numpy as np

from stcal.boards.board_designs import AprilGridDesign

IMAGE_FROM_MM = np.array([[2.6, -0.5, 330.0], [0.4, 2.3, 180.0], [-2e-4, 3e-4, 1.0]])
"""A view with perspective, pixels of the image from millimetres on the sheet."""
SHARPER = 3  # the view is drawn larger by this and averaged down, which makes the edges what pixels see


def chessboard_mm(rows: int, columns: int, square: float, per_mm: int = 4) -> tuple[np.ndarray, float]:
    """The printed sheet, and the place of inner corner (0, 0) on it, mm."""
    margin = 2 * square
    side = int(square * per_mm)
    cells = np.add.outer(np.arange(rows + 1), np.arange(columns + 1)) % 2 == 0
    board = np.kron(np.where(cells, 0, 255), np.ones((side, side))).astype(np.uint8)
    edge = int(margin * per_mm)
    return cv2.copyMakeBorder(board, edge, edge, edge, edge, cv2.BORDER_CONSTANT, value=255), margin + square


TAG36H11 = (
    *(0xD5D628584, 0xD97F18B49, 0xDD280910E, 0xE479E9C98, 0xEBCBCA822, 0xF31DAB3AC),
    *(0x056A5D085, 0x10652E1D4, 0x22B1DFEAD, 0x265AD0472, 0x34FE91B86, 0x3FF962CD5),
)
"""Codes of the family's first tags (Olson 2011), 36 bits each, white where 1, row by row from the top as Kalibr prints
them, the highest bit first."""


def kalibr_tag(tag: int, border: int) -> np.ndarray:
    """Cells of a tag, black border included."""
    code = np.array([int(bit) for bit in f"{TAG36H11[tag]:036b}"]).reshape(6, 6)
    return 255 * np.pad(code, border).astype(np.uint8)


def aprilgrid_mm(
    board: AprilGridDesign, border: int, squares: bool = True, per_mm: int = 4, margin: float = 20.0
) -> tuple[np.ndarray, np.ndarray]:
    """The sheet as Kalibr's generator makes it, ids from the bottom left, and the board's origin on it, mm. Cells must
    be whole pixels."""
    assert (board.tag_mm * per_mm) % (6 + 2 * border) == 0
    side, gap = board.tag_mm, board.spacing * board.tag_mm
    step = side + gap
    size = np.array([board.columns, board.rows]) * step - gap + 2 * margin
    sheet = np.full(np.rint(size[::-1] * per_mm).astype(int), 255, np.uint8)
    origin = np.array([margin, size[1] - margin])

    def fill(left: float, top: float, cells: np.ndarray, cell_mm: float) -> None:
        each = np.ones((round(cell_mm * per_mm),) * 2, np.uint8)
        x, y = round(left * per_mm), round(top * per_mm)
        drawn = np.kron(cells, each)
        sheet[y : y + len(drawn), x : x + len(drawn)] = drawn

    for row in range(board.rows):
        for column in range(board.columns):
            left, top = origin[0] + column * step, origin[1] - row * step - side
            cells = kalibr_tag(row * board.columns + column, border)
            fill(left, top, np.rot90(cells, 2) if board.upright else cells, side / len(cells))
            for x in (left - gap, left + side) if squares else ():
                fill(x, top - gap, np.zeros((1, 1), np.uint8), gap)
                fill(x, top + side, np.zeros((1, 1), np.uint8), gap)
    return sheet, origin


def photograph(sheet: np.ndarray, per_mm: int, image_from_mm: np.ndarray, size=(1200, 900)) -> np.ndarray:
    """The sheet (pixels, ``per_mm`` of them a millimetre, white around) seen through a homography; a little noise."""
    return exposed(enlarged(sheet, per_mm, image_from_mm, size), size)


def photograph_of_several(sheets: list[tuple[np.ndarray, np.ndarray]], per_mm: int, size) -> np.ndarray:
    """Sheets with their homographies, the last one in front."""
    fine = np.full((SHARPER * size[1], SHARPER * size[0]), 255, np.uint8)
    for sheet, image_from_mm in sheets:
        there = enlarged(np.full_like(sheet, 255), per_mm, image_from_mm, size, 0)
        fine = np.where(there > 127, enlarged(sheet, per_mm, image_from_mm, size), fine)
    return exposed(fine, size)


def enlarged(sheet: np.ndarray, per_mm: int, image_from_mm: np.ndarray, size, around: int = 255) -> np.ndarray:
    """Larger by :data:`SHARPER` than the image."""
    # Centres of pixels are integers: half a pixel of the sheet, and of the image, lies before each.
    mm_from_sheet = np.array([[1 / per_mm, 0, 0.5 / per_mm], [0, 1 / per_mm, 0.5 / per_mm], [0, 0, 1]])
    fine_from_image = np.array([[SHARPER, 0, (SHARPER - 1) / 2], [0, SHARPER, (SHARPER - 1) / 2], [0, 0, 1.0]])
    warp = fine_from_image @ image_from_mm @ mm_from_sheet
    return cv2.warpPerspective(
        sheet, warp, (SHARPER * size[0], SHARPER * size[1]), flags=cv2.INTER_LINEAR, borderValue=around
    )


def exposed(fine: np.ndarray, size) -> np.ndarray:
    """Averaged down, a little out of focus, with noise."""
    seen = cv2.GaussianBlur(cv2.resize(fine, size, interpolation=cv2.INTER_AREA), (0, 0), 0.6).astype(float)
    noise = np.random.default_rng(0).normal(0, 1.5, seen.shape)
    return np.clip(0.8 * seen + 25 + noise, 0, 255).astype(np.uint8)
