"""Black areas of a board of squares or tags, as closed lines in mm for a printer, a laser or a mill.

Cells are merged into areas, because viewers draw hairlines between squares that touch.
"""

from itertools import product

import cv2
import numpy as np

from stcal.boards.board_designs import AprilGridDesign, CharucoDesign, ChessboardDesign, TagLayout
from stcal.boards.dictionaries import dictionary_of

SquaresOrTags = ChessboardDesign | CharucoDesign | TagLayout | AprilGridDesign
SQUARE = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
UNKNOWN_BITS = 2
"""Border of an AprilGrid, in cells, if its file does not state it: Kalibr's."""


def black_areas(board: SquaresOrTags) -> list[list[np.ndarray]]:
    """Return areas as lists of closed lines (k, 2), mm in the board's frame; inner lines are holes, reversed."""
    if isinstance(board, ChessboardDesign):
        return _squares(board.rows + 1, board.columns + 1, board.square_mm, 0, -board.square_mm)
    if isinstance(board, CharucoDesign):
        first, size = int(board.legacy and board.rows % 2 == 0), (board.rows, board.columns, board.square_mm)
        white = _squares(*size, 1 - first, (board.square_mm - board.marker_mm) / 2)
        places = (at[0] + board.marker_mm * SQUARE for (at,) in white)  # the last square may be white without a tag
        tags = [_tag(board.dictionary, tag, at, 1) for tag, at in zip(board.tag_ids(), places, strict=False)]
        return _squares(*size, first, 0.0) + tags
    if isinstance(board, AprilGridDesign):
        bits = board.border_bits or UNKNOWN_BITS
        layout = board.layout()
        tags = [_tag(name, tag, at, bits) for (name, tag), at in zip(layout.tags, layout.corners_mm, strict=True)]
        return tags + _between(board)
    return [_tag(name, tag, at, 1) for (name, tag), at in zip(board.tags, board.corners_mm, strict=True)]


def clear_mm(board: SquaresOrTags) -> float:
    """Return the width of white, mm, that detectors need around the board: a square, or a quarter of a tag."""
    if isinstance(board, ChessboardDesign | CharucoDesign):
        return board.square_mm
    if isinstance(board, AprilGridDesign):
        return board.tag_mm / 4
    sides = np.linalg.norm(board.corners_mm - np.roll(board.corners_mm, 1, axis=1), axis=2)
    return float(sides.max()) / 4


def outlines(black: np.ndarray) -> list[np.ndarray]:
    """Return closed lines around the black cells of a mask (rows, columns). Each line is (k, 2) corners, column and
    row, with the black on the right if rows go down. Areas that touch only at a corner stay separate."""
    padded = np.pad(black, 1)
    after: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for row, column in np.argwhere(black).tolist():
        corners = [(column + x, row + y) for x, y in SQUARE.tolist()]
        beside = [padded[row, column + 1], padded[row + 1, column + 2], padded[row + 2, column + 1]]
        beside.append(padded[row + 1, column])
        for k in range(4):
            if not beside[k]:
                after.setdefault(corners[k], []).append(corners[(k + 1) % 4])
    lines = []
    while after:
        corner = start = next(iter(after))
        step, line = (0, 0), []
        while True:
            ends = after[corner]
            right = (corner[0] - step[1], corner[1] + step[0])
            end = ends.pop(ends.index(right) if right in ends else 0)
            if not ends:
                del after[corner]
            turned = (end[0] - corner[0], end[1] - corner[1])
            if turned != step:
                line.append(corner)
            corner, step = end, turned
            if corner == start:
                break
        first = (line[1][0] - line[0][0], line[1][1] - line[0][1])
        if first[0] * step[1] == first[1] * step[0]:  # the line began in the middle of an edge
            line = line[1:]
        lines.append(np.array(line))
    return lines


def _squares(rows: int, columns: int, side: float, first: int, origin: float) -> list[list[np.ndarray]]:
    """Return the black squares one by one; square (0, 0) begins at ``origin``, and is black if ``first`` is 0."""
    row, column = np.divmod(np.arange(rows * columns), columns)
    black = (row + column) % 2 == first
    return [[side * (at + SQUARE) + origin] for at in np.column_stack([column, row])[black]]


def _tag(name: str, tag: int, corners: np.ndarray, border_bits: int) -> list[np.ndarray]:
    """Return lines around the black cells of a tag with these ``corners`` (4, 2), as printed from top left."""
    dictionary = dictionary_of(name)
    cells = dictionary.markerSize + 2 * border_bits
    black = cv2.aruco.generateImageMarker(dictionary, tag, cells, borderBits=border_bits) == 0
    lines = []
    for line in outlines(black):
        u, v = (line / cells).T[:, :, None]
        top = (1 - u) * corners[0] + u * corners[1]
        lines.append((1 - v) * top + v * ((1 - u) * corners[3] + u * corners[2]))
    return lines


def _between(board: AprilGridDesign) -> list[list[np.ndarray]]:
    """Return the small squares at the tags' corners."""
    gap = board.spacing * board.tag_mm
    step, cells = board.tag_mm + gap, product(range(board.rows + 1), range(board.columns + 1))
    return [[np.array([column * step - gap, -row * step]) + gap * SQUARE] for row, column in cells]
