"""ChArUco boards out of focus and partly hidden: corners where the drawing has them, with σ that say how well."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from stcal.boards.board_designs import CharucoDesign
from stcal.boards.finders import find_charuco
from stcal.geometry.camera import Camera
from stcal.geometry.plane import apply_homography
from stcal.workflows.board_views import find_board
from tests.boards.drawn import IMAGE_FROM_MM, photograph

BOARD = CharucoDesign(9, 10, 20.0, 16.0, "DICT_4X4_250")
"""The white around its tags is a tenth of a square wide: 5 px in the view."""
EVEN = replace(BOARD, rows=10, columns=8)
PER_MM, MARGIN_MM = 4, 20.0
CAMERA = Camera(1200, 900, [1440.0, 1440.0], [599.5, 449.5], np.zeros(8))


def sheet_of(board: CharucoDesign) -> np.ndarray:
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    plain = cv2.aruco.CharucoBoard((board.columns, board.rows), board.square_mm, board.marker_mm, dictionary)
    plain.setLegacyPattern(board.legacy)
    side = board.square_mm * PER_MM
    sheet = plain.generateImage((round(board.columns * side), round(board.rows * side)))
    return cv2.copyMakeBorder(sheet, *[round(MARGIN_MM * PER_MM)] * 4, cv2.BORDER_CONSTANT, value=255)


@pytest.fixture(scope="module")
def sharp() -> np.ndarray:
    return photograph(sheet_of(BOARD), PER_MM, IMAGE_FROM_MM)


def errors_px(view) -> np.ndarray:
    return np.linalg.norm(apply_homography(IMAGE_FROM_MM, view.xyz_board[:, :2] + MARGIN_MM) - view.xy_px, axis=1)


@pytest.mark.parametrize(("blur_px", "most_px"), [(0.0, 0.1), (1.5, 0.15), (2.5, 0.2), (3.0, 0.2)])
def test_corners_out_of_focus(sharp, blur_px, most_px):
    """Blur moves no corner of a symmetric pattern. Windows of 3 px that stay clear of the tags, as OpenCV's, are off by
    2 px and more from a blur of 2.5 px on; noise is 1.5 of 200 grey values."""
    seen = cv2.GaussianBlur(sharp, (0, 0), blur_px) if blur_px else sharp
    view = find_charuco(seen, "a", BOARD)
    error = errors_px(view)
    assert len(view) > 40
    assert np.percentile(error, 95) < most_px
    assert error.max() < 2 * most_px
    sigma = np.sqrt(np.trace(view.covariance_px2, axis1=1, axis2=2) / 2)
    assert np.median(error / sigma) < 2.4  # twice the median length of two coordinates


def test_blurred_corners_have_larger_sigma_and_a_hidden_one_is_left_out(sharp):
    """The right half out of focus; and under a grey rectangle with a checkered edge, from which no corner is taken."""
    seen, middle = sharp.copy(), 600
    seen[:, middle:] = cv2.GaussianBlur(sharp, (0, 0), 3.0)[:, middle:]
    view = find_charuco(seen, "a", BOARD)
    sigma, right = np.sqrt(np.trace(view.covariance_px2, axis1=1, axis2=2) / 2), view.xy_px[:, 0] > middle + 10
    assert np.median(sigma[right]) > 1.5 * np.median(sigma[~right])
    hidden = sharp.copy()
    whole = find_charuco(sharp, "a", BOARD)
    x, y = np.rint(whole.xy_px[len(whole) // 2]).astype(int)
    hidden[y - 60 : y + 8, x - 60 : x + 8] = 120
    view = find_charuco(hidden, "a", BOARD)
    assert len(view) > 0.8 * len(whole)
    assert errors_px(view).max() < 1.0
    wrong = replace(CAMERA, focal=[500.0, 500.0])  # no camera changes the corners
    assert np.array_equal(find_board(sharp, "a", wrong, BOARD)[0].xy_px, whole.xy_px)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("printed", "declared", "said"),
    [
        (BOARD, replace(BOARD, rows=10, columns=9), "rows = 9, columns = 10; correct"),
        (EVEN, replace(EVEN, legacy=True), "rows = 10, columns = 8, legacy = false"),
        (replace(EVEN, legacy=True), EVEN, "rows = 10, columns = 8, legacy = true"),
    ],
    ids=["turned", "not legacy", "legacy"],
)
def test_a_wrong_file_is_told_what_fits(printed, declared, said):
    view, why = find_board(photograph(sheet_of(printed), PER_MM, IMAGE_FROM_MM), "a", CAMERA, declared)
    assert view is None
    assert said in why
