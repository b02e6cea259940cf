"""AprilGrids as Kalibr prints them: AprilTags with a border of one cell or two, small black squares at their corners.

``cv2.aruco`` looks for dark quadrilaterals. Where a square touches a tag's corner, blur joins the two, and there is
none: tags are looked for in images with grown white too. Their corners are measured in the image as it is.
"""

from dataclasses import replace

import numpy as np

from stcal.boards.design import AprilGridDesign, BoardView, TagLayout
from stcal.boards.tags import Tags, find_tags, view_of_tags
from stcal.geometry.camera import Camera
from stcal.geometry.plane import apply_homography, fit_homography

KALIBR_BITS, USUAL_BITS = 2, 1
"""Widths of the black border, cells."""
TELLING_SHARE = 0.5
"""A border of two cells is read as one now and then, one of one never as two: two cells hold where they read so many of
the tags that one reads …"""
ENOUGH_SHARE = 0.5
"""… or so many of all tags of the board, and then one is not tried."""
MAX_OFF_SHARE = 0.15
"""Of a tag's side: what lies farther from where one plane puts it stands elsewhere, or is turned."""
MOST_STRAY_SHARE = 1 / 3
"""Of the tags in view, that may lie elsewhere."""


def find_aprilgrid(
    image: np.ndarray, name: str, board: AprilGridDesign, camera: Camera
) -> tuple[BoardView | None, str]:
    """All four corners of each tag that is seen, or why there are none. A part of the board is enough."""
    layout = board.layout()
    tags, bits = _tags(image, board)
    view = view_of_tags(name, tags, layout)
    if view is None:
        return None, _without_tags(tags, bits, board)
    own, unused = view, list(view.unused)
    strangers = [tag for _, tag in tags.tags if tag not in board.tag_ids()]
    unused += [f"tag {tag} is none of its {len(board.tag_ids())}" for tag in strangers]
    while (off := _off(own, camera)).max() > MAX_OFF_SHARE and len(own) - 4 >= (1 - MOST_STRAY_SHARE) * len(view):
        worst = own.ids[4 * int(off.argmax())] // 4
        unused.append(f"tag {layout.tags[worst][1]} lies off the board's plane")
        own = _rows(own, own.ids // 4 != worst)
    if _off(own, camera).max() > MAX_OFF_SHARE:
        return None, _why_off(view, board, camera)
    return replace(own, unused=tuple(unused)), ""


def _tags(image: np.ndarray, board: AprilGridDesign) -> tuple[Tags, str]:
    """Tags with the border that the board has, or that most of them have; and what it was looked for with."""
    names = (board.dictionary,)
    if board.border_bits is not None:
        return find_tags(image, names, board.border_bits, joined=True), f"{board.border_bits}"
    two = find_tags(image, names, KALIBR_BITS, joined=True)
    if _own(two, board) >= ENOUGH_SHARE * len(board.tag_ids()):
        return two, f"{KALIBR_BITS}"
    one = find_tags(image, names, USUAL_BITS, joined=True)
    holds = _own(two, board) > 0 and _own(two, board) >= TELLING_SHARE * _own(one, board)
    return (two if holds else one), f"{USUAL_BITS} or {KALIBR_BITS}"


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
    """Of each tag: how far its corners lie from where the plane puts them, RMS, in sides of the tag as seen."""
    seen = camera.normalised_from_pixel(view.xy_px)
    there = apply_homography(fit_homography(view.xyz_board[:, :2], seen), view.xyz_board[:, :2])
    corners = seen.reshape(-1, 4, 2)
    side = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).mean(1)
    return np.sqrt(((there - seen) ** 2).sum(1).reshape(-1, 4).mean(1)) / side


def _why_off(view: BoardView, board: AprilGridDesign, camera: Camera) -> str:
    """What other printing would put the tags where they are."""
    turned = replace(board, upright=not board.upright)
    if _off(_as(turned.layout(), view), camera).max() <= MAX_OFF_SHARE:
        said = "true" if turned.upright else "false"
        return f"the tags of the AprilGrid are turned by half a turn; write upright = {said} into its file"
    return (
        f"{len(view) // 4} tags of the AprilGrid, but not where rows, columns and spacing put them; ids count from the "
        "bottom left, row by row upwards"
    )


def _as(layout: TagLayout, view: BoardView) -> BoardView:
    xyz = np.pad(layout.xy_mm()[view.ids], ((0, 0), (0, 1)))
    return BoardView(view.image, view.ids, xyz, view.xy_px, view.covariance_px2)
