"""Detection of the boards and tags on the faces of a body, all of one image together."""

from collections.abc import Mapping

import numpy as np

from stcal.boards.aprilgrid import find_aprilgrid
from stcal.boards.charuco import find_charuco
from stcal.boards.design import AprilGridDesign, BoardView, CharucoDesign, FlatBoard, TagLayout
from stcal.boards.tags import find_tags, view_of_tags
from stcal.errors import StcalError
from stcal.geometry.camera import Camera


def find_on_faces(
    image: np.ndarray, name: str, boards: Mapping[str, FlatBoard], camera: Camera
) -> tuple[dict[str, BoardView], list[str]]:
    """Return the views of the boards and tags in a grey image by face, and notes on what was left out.

    Each dictionary is searched once for all faces: a face of which no tag is read is not searched for corners.
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
                view = view_of_tags(name, tags, board)
            elif isinstance(board, CharucoDesign):
                if any((board.dictionary, tag) in read for tag in board.tag_ids()):
                    view = find_charuco(image, name, board)
            elif isinstance(board, AprilGridDesign):
                view, why = find_aprilgrid(image, name, board, camera)
        except StcalError as error:  # corners on a line, say
            why = f"left out, {error}"
        if view is not None:
            views[face] = view
            notes += [f"face {face}: {reason}" for reason in view.unused]
        elif why and "no tag of" not in why and "none of" not in why:
            notes.append(f"face {face}: {why}")
    return views, notes
