"""AprilGrids as Kalibr prints them: every corner where the drawing puts it, whatever the border and the squares."""

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest

from stcal.boards.board_designs import AprilGridDesign
from stcal.boards.tags import find_aprilgrid
from stcal.geometry.camera import Camera
from stcal.geometry.plane import apply_homography
from stcal.workflows import board_views
from tests.boards.drawn import IMAGE_FROM_MM, aprilgrid_mm, photograph
from tests.support.areas import squares_nees

pytestmark = pytest.mark.slow

CAMERA = Camera(1200, 900, [1500, 1500], [600, 450], np.zeros(8))
CORNER_PX = 0.12  # as in the tests of the other boards
GRID = AprilGridDesign(3, 4, 30.0, 0.3)


@cache
def photographed(board: AprilGridDesign, border: int, squares: bool = True) -> tuple[np.ndarray, np.ndarray]:
    sheet, origin = aprilgrid_mm(board, border, squares)
    image = photograph(sheet, 4, IMAGE_FROM_MM)
    image.flags.writeable = False  # several tests share it
    return image, origin


def off_px(view, origin) -> np.ndarray:
    return apply_homography(IMAGE_FROM_MM, view.xyz_board[:, :2] + origin) - view.xy_px


@pytest.mark.parametrize(
    ("border", "squares", "upright", "stated"),
    [(2, True, False, None), (1, True, False, None), (1, False, False, 1), (2, True, True, 2)],
)
def test_every_corner_is_where_it_was_drawn(border, squares, upright, stated):
    board = replace(GRID, upright=upright, border_bits=stated)
    image, origin = photographed(board, border, squares)
    view, why = find_aprilgrid(image, "a", board, CAMERA)
    assert (len(view), why, view.unused) == (48, "", ())
    off = off_px(view, origin)
    assert np.abs(off).max() < CORNER_PX
    # squared errors over their covariance, 96 numbers of one noise
    assert 0.2 < squares_nees(off, view.covariance_px2).mean() < 4.0


def test_the_frame_is_kalibrs_turned_about_x():
    """Tag 0 bottom left, ids along the row, then upwards; a tag's corners begin at its bottom right (Kalibr's turn)."""
    xy = GRID.xy_mm().reshape(3, 4, 4, 2)
    step = 30.0 * 1.3
    assert np.allclose(xy[0, 0], [[30, 0], [0, 0], [0, -30], [30, -30]])
    assert np.allclose(xy[0, 1] - xy[0, 0], [step, 0])
    assert np.allclose(xy[1, 0] - xy[0, 0], [0, -step])


def test_a_border_that_is_not_the_boards_is_said_and_a_part_is_enough():
    image, _ = photographed(GRID, 1)
    view, why = find_aprilgrid(image, "a", replace(GRID, border_bits=2), CAMERA)
    assert view is None
    assert "no tag of the AprilGrid: DICT_APRILTAG_36h11, border of 2 cells" in why
    image, origin = photographed(GRID, 2)
    hidden = image.copy()
    hidden[:, :560] = 230
    view, _ = find_aprilgrid(hidden, "a", GRID, CAMERA)
    assert 8 <= len(view) < 48
    assert np.abs(off_px(view, origin)).max() < CORNER_PX


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"upright": True}, "turned by half a turn; write upright = false into its file"),
        ({"columns": 3, "rows": 4}, "12 tags of the AprilGrid, but not where rows, columns and spacing put them"),
        ({"first_id": 100}, "tag 0 of DICT_APRILTAG_36h11, none of 100 … 111 of the AprilGrid"),
        ({"dictionary": "DICT_APRILTAG_25h9"}, "no tag of the AprilGrid: DICT_APRILTAG_25h9, border of 1 or 2 cells"),
    ],
)
def test_why_there_is_none(changed, said):
    image, _ = photographed(GRID, 2)
    view, why = find_aprilgrid(image, "a", replace(GRID, **changed), CAMERA)
    assert view is None
    assert said in why


def test_a_stranger_is_named_and_left_out():
    """A tag beside the board that is none of it, and one of its own on a slip of paper in the wrong place."""
    board = replace(GRID, rows=2)
    image, origin = photographed(GRID, 2)  # the third row is none of the board
    view, _ = find_aprilgrid(image, "a", board, CAMERA)
    assert len(view) == 32
    assert view.unused == tuple(f"tag {tag} is none of its 8" for tag in range(8, 12))
    assert np.abs(off_px(view, origin)).max() < CORNER_PX
    sheet, (x, y) = aprilgrid_mm(GRID, 2, squares=False)
    bottom, left = round(4 * y), round(4 * x)
    slip = sheet[bottom - 120 : bottom, left : left + 120].copy()
    sheet[bottom - 120 : bottom, left : left + 120] = 255
    sheet[bottom - 80 : bottom + 40, left - 40 : left + 80] = slip  # 10 mm to the left and down
    view, _ = find_aprilgrid(photograph(sheet, 4, IMAGE_FROM_MM), "a", GRID, CAMERA)
    assert view.unused == ("tag 0 lies off the board's plane",)
    assert len(view) == 44


def test_corners_lie_on_edges_that_the_lens_curves(monkeypatch):
    """Straight lines along curved edges meet beside the corners, all of them farther out or in: a bias, not a noise."""
    board, lens = AprilGridDesign(3, 4, 60.0, 0.3), replace(CAMERA, distortion=np.array([-0.3, 0.1, 0, 0, 0, 0, 0, 0]))
    image_from_mm = np.array([[2.9, -0.2, 60.0], [0.1, 2.8, 40.0], [0, 0, 1.0]])
    sheet, origin = aprilgrid_mm(board, 1)
    ideal = photograph(sheet, 4, image_from_mm)
    grid = np.stack(np.meshgrid(np.arange(1200.0), np.arange(900.0)), axis=-1).reshape(-1, 2)
    source = CAMERA.pixel_from_normalised(lens.normalised_from_pixel(grid)).astype(np.float32).reshape(900, 1200, 2)
    image = cv2.remap(ideal, source[..., 0], source[..., 1], cv2.INTER_CUBIC, borderValue=255)
    straight, _ = find_aprilgrid(image, "a", board, lens)
    monkeypatch.setattr(board_views, "find_aprilgrid", lambda *_: (straight, ""))
    bias = []
    for view in (straight, board_views.find_board(image, "a", lens, board)[0]):
        true = apply_homography(image_from_mm, view.xyz_board[:, :2] + origin)
        off = view.xy_px - lens.pixel_from_normalised(CAMERA.normalised_from_pixel(true))
        tags = view.xy_px.reshape(-1, 4, 2)
        outwards = (tags - tags.mean(1, keepdims=True)).reshape(-1, 2)
        bias.append(float(np.mean((off * outwards).sum(1) / np.linalg.norm(outwards, axis=1))))
    assert abs(bias[1]) < 0.25 * abs(bias[0])
