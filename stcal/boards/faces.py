"""Detection of the boards and tags on the faces of a body, all of one image together."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from stcal.boards.aprilgrid import find_aprilgrid
from stcal.boards.cells import UNKNOWN_BITS
from stcal.boards.charuco import find_charuco
from stcal.boards.chessboard import find_chessboard, why_no_chessboard
from stcal.boards.design import AprilGridDesign, BoardView, CharucoDesign, ChessboardDesign, FlatBoard, TagLayout
from stcal.boards.dictionaries import cells_of
from stcal.boards.tags import find_tags, view_of_tags
from stcal.errors import StcalError
from stcal.geometry.camera import Camera
from stcal.labels import BOARD

FLOOR_PX = 0.05
"""σ that the pixel raster and the tag's own cells leave to the corner of a tag, whatever its edges say. Of 100 drawn
tags of 24 px the edges' σ was 0.035 px in the median, the error 2.3 times as large."""

NARROW_CELL_PX, NARROW_PX = 2.0, 1.0
"""Width of a tag's cell below which its edges run into its cells or cannot be measured, and σ of its corners then."""


def find_on_faces(
    image: np.ndarray, name: str, boards: Mapping[str, FlatBoard], camera: Camera
) -> tuple[dict[str, BoardView], list[str]]:
    """Return the views of the boards and tags in a grey image by face, and notes on what was left out.

    Each dictionary is searched once for all faces: a face of which no tag is read is not searched for corners. The
    board beside the body has the name ``board``; why it is not found is always noted.
    """
    of_layouts = [d for board in boards.values() if isinstance(board, TagLayout) for d, _ in board.tags]
    of_charuco = [board.dictionary for board in boards.values() if isinstance(board, CharucoDesign)]
    tags = find_tags(image, tuple(dict.fromkeys([*of_layouts, *of_charuco])))
    read = {*tags.tags, *tags.repeated}
    views: dict[str, BoardView] = {}
    notes: list[str] = []
    for face, board in boards.items():
        view, why = None, ""
        try:
            if isinstance(board, TagLayout):
                view = _floored(view_of_tags(name, tags, board), board)
            elif isinstance(board, CharucoDesign):
                if any((board.dictionary, tag) in read for tag in board.tag_ids()):
                    view = find_charuco(image, name, board)
                elif face == BOARD:
                    why = f"no tag of {board.dictionary}"
            elif isinstance(board, ChessboardDesign):
                view = find_chessboard(image, name, board, with_sigma=True)
                why = "" if view else why_no_chessboard(image, board)
            elif isinstance(board, AprilGridDesign):
                view, why = find_aprilgrid(image, name, board, camera)
                view = view if face == BOARD else _floored(view, board)  # of many tags their own σ is right
        except StcalError as error:  # corners on a line, say
            why = f"left out, {error}"
        where = BOARD if face == BOARD else f"face {face}"
        if view is not None:
            views[face] = view
            notes += [f"{where}: {reason}" for reason in view.unused]
        elif why and (face == BOARD or ("no tag of" not in why and "none of" not in why)):
            notes.append(f"{where}: {why}")
    return views, notes


def _floored(view: BoardView | None, board: TagLayout | AprilGridDesign) -> BoardView | None:
    """Returns the view of tags with the σ that their corners have beside that of their edges."""
    if view is None or view.covariance_px2 is None:
        return view
    layout = board.layout() if isinstance(board, AprilGridDesign) else board
    border = (board.border_bits or UNKNOWN_BITS) if isinstance(board, AprilGridDesign) else 1
    corners = view.xy_px.reshape(-1, 4, 2)
    side = np.roll(corners, -1, axis=1) - corners
    diagonal = corners[:, 2:] - corners[:, :2]
    area = np.abs(diagonal[:, 0, 0] * diagonal[:, 1, 1] - diagonal[:, 0, 1] * diagonal[:, 1, 0]) / 2
    width = area / np.linalg.norm(side, axis=2).max(1)
    cells = np.array([cells_of(layout.tags[row][0], border) for row in view.ids[::4] // 4])
    narrow = np.repeat(width < NARROW_CELL_PX * cells, 4)
    variance = np.where(narrow, NARROW_PX**2, FLOOR_PX**2)
    return replace(view, covariance_px2=view.covariance_px2 + variance[:, None, None] * np.eye(2))
