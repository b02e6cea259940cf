"""AprilGrids as of Kalibr: AprilTags with a border of one or two cells, and small black squares at their corners.

``cv2.aruco`` looks for dark quadrilaterals. Blur joins a tag with the squares at its corners, so that there is none:
tags are also searched in images with dilated white. Their corners are measured in the original image.
"""

from dataclasses import replace

import numpy as np

from stcal.boards.design import AprilGridDesign, BoardView, TagLayout
from stcal.boards.tags import Tags, find_tags, view_of_tags
from stcal.geometry.camera import Camera
from stcal.geometry.plane import apply_homography, fit_homography

KALIBR_BITS, USUAL_BITS = 2, 1
"""Widths of the black border of Kalibr's tags and of usual ones, cells."""
TELLING_SHARE = 0.5
"""Smallest share of the tags read with a border of one cell that a border of two cells must read to be accepted. A
border of two cells is sometimes read as one, but a border of one cell never as two."""
ENOUGH_SHARE = 0.5
"""Share of all tags of the board from which on a border of two cells is accepted without trying one cell."""
MAX_OFF_SHARE = 0.15
"""Largest deviation of a tag from its place in the board's plane, as a share of its side; a tag with a larger one is
elsewhere, or rotated."""
MOST_STRAY_SHARE = 1 / 3
"""Largest share of the tags in view that may be rejected for lying off the plane."""


def find_aprilgrid(
    image: np.ndarray, name: str, board: AprilGridDesign, camera: Camera
) -> tuple[BoardView | None, str]:
    """Return the view with all four corners of each tag seen, or None and the reason. A part of the board is enough."""
    layout = board.layout()
    tags, bits = _tags(image, board)
    view = view_of_tags(name, tags, layout)
    if view is None:
        return None, _without_tags(tags, bits, board)
    fitting, unused = view, list(view.unused)
    strangers = [tag for _, tag in tags.tags if tag not in board.tag_ids()]
    unused += [f"tag {tag} is none of its {len(board.tag_ids())}" for tag in strangers]
    while (off := _off(fitting, camera)).max() > MAX_OFF_SHARE and len(fitting) - 4 >= (1 - MOST_STRAY_SHARE) * len(
        view
    ):
        worst = fitting.ids[4 * int(off.argmax())] // 4
        unused.append(f"tag {layout.tags[worst][1]} lies off the board's plane")
        fitting = _rows(fitting, fitting.ids // 4 != worst)
    if _off(fitting, camera).max() > MAX_OFF_SHARE:
        return None, _why_off(view, board, camera)
    return replace(fitting, unused=tuple(unused)), ""


def _tags(image: np.ndarray, board: AprilGridDesign) -> tuple[Tags, str]:
    """Return the tags, read with the board's border width or the more likely one, and the widths tried, in words."""
    names = (board.dictionary,)
    if board.border_bits is not None:
        return find_tags(image, names, board.border_bits, joined=True), f"{board.border_bits}"
    of_two_bits = find_tags(image, names, KALIBR_BITS, joined=True)
    if _own(of_two_bits, board) >= ENOUGH_SHARE * len(board.tag_ids()):
        return of_two_bits, f"{KALIBR_BITS}"
    of_one_bit = find_tags(image, names, USUAL_BITS, joined=True)
    two_bits_hold = _own(of_two_bits, board) > 0 and _own(of_two_bits, board) >= TELLING_SHARE * _own(of_one_bit, board)
    return (of_two_bits if two_bits_hold else of_one_bit), f"{USUAL_BITS} or {KALIBR_BITS}"


def _own(tags: Tags, board: AprilGridDesign) -> int:
    return sum(tag in board.tag_ids() for _, tag in tags.tags)


def _without_tags(tags: Tags, bits: str, board: AprilGridDesign) -> str:
    ids = board.tag_ids()
    if tags.tags:
        return f"tag {tags.tags[0][1]} of {board.dictionary}, none of {ids[0]} … {ids[-1]} of the AprilGrid"
    if tags.repeated:
        return f"tag {tags.repeated[0][1]} of the AprilGrid is in view more than once, and no other"
    return f"no tag of the AprilGrid: {board.dictionary}, border of {bits} cells"


def _rows(view: BoardView, keep: np.ndarray) -> BoardView:
    covariance = None if view.covariance_px2 is None else view.covariance_px2[keep]
    return BoardView(view.image, view.ids[keep], view.xyz_board[keep], view.xy_px[keep], covariance)


def _off(view: BoardView, camera: Camera) -> np.ndarray:
    """Return the RMS deviation of each tag's corners from their places in the plane, in sides of the tag as seen."""
    observed = camera.normalised_from_pixel(view.xy_px)
    predicted = apply_homography(fit_homography(view.xyz_board[:, :2], observed), view.xyz_board[:, :2])
    corners = observed.reshape(-1, 4, 2)
    side = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).mean(1)
    return np.sqrt(((predicted - observed) ** 2).sum(1).reshape(-1, 4).mean(1)) / side


def _why_off(view: BoardView, board: AprilGridDesign, camera: Camera) -> str:
    """Return why the tags do not fit the board: rotated printing, or another arrangement."""
    turned = replace(board, upright=not board.upright)
    if _off(_as(turned.layout(), view), camera).max() <= MAX_OFF_SHARE:
        value = "true" if turned.upright else "false"
        return f"the tags of the AprilGrid are turned by half a turn; write upright = {value} into its file"
    return (
        f"{len(view) // 4} tags of the AprilGrid, but not where rows, columns and spacing put them; ids count from the "
        "bottom left, row by row upwards"
    )


def _as(layout: TagLayout, view: BoardView) -> BoardView:
    xyz = np.pad(layout.xy_mm()[view.ids], ((0, 0), (0, 1)))
    return BoardView(view.image, view.ids, xyz, view.xy_px, view.covariance_px2)
