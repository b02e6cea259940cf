"""Edges measured by area: the integrated step, corners and their σ along the pixel rows and across them."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from stcal.boards.area import integrated_step, solved
from stcal.boards.board_designs import UNIT_SQUARE, CharucoDesign, ChessboardDesign, TagLayout
from stcal.boards.dictionaries import dictionary_of
from stcal.boards.edges import crossings
from stcal.boards.finders import find_charuco, find_chessboard
from stcal.boards.tags import find_tags
from tests.support.areas import homography, rendered, squares_nees, warped

NAME = "DICT_APRILTAG_36h11"


def test_the_integrated_step_its_derivatives_and_an_edge_whose_equations_are_singular():
    distance, normal, h = np.linspace(-3, 3, 13)[None], np.array([[0.6, 0.8]]), 1e-4
    share, slope, widening = integrated_step(distance, normal, np.array([0.3]))
    by_distance = [integrated_step(distance + s, normal, np.array([0.3])) for s in (h, -h)]
    by_variance = [integrated_step(distance, normal, np.array([0.3 + s])) for s in (h, -h)]
    assert np.allclose((by_distance[0][0] - by_distance[1][0]) / (2 * h), slope, atol=1e-6)
    assert np.allclose((by_variance[0][0] - by_variance[1][0]) / (2 * h), widening, atol=1e-6)
    assert np.allclose([share[0, 0], share[0, 6], share[0, -1]], [0, 0.5, 1], atol=1e-5)
    design = np.random.default_rng(1).normal(size=(2, 3, 4, 2))
    design[1] = 1e12  # two unknowns that move all pixels alike
    values, inverse = solved(design, np.ones((2, 3, 4)), np.ones((2, 3, 4)))
    assert np.isfinite(inverse[0]).all()
    assert np.isfinite(values[0]).all()
    assert np.isnan(inverse[1]).all()


@pytest.mark.parametrize(("degrees", "by_warp"), [(0.0, False), (1.0, False), (20.0, False), (45.0, True)])
def test_sigma_of_a_tags_corners_holds_at_every_angle(degrees, by_warp):
    """Twelve tags of 60 px: 96 squares, whose mean has σ 0.14. It is below 1, as edges keep a prior σ of what may be
    wrong with their profile. A warp in points displaces parallel edges along the diagonals by up to a quarter of its
    grid, each by its own amount, whatever blur comes after it. Taken for edges sampled by area, the mean is 3.2."""
    rng, per, corners = np.random.default_rng(3), 12, 60 * UNIT_SQUARE
    from_sheet = np.array([[6 / per, 0, -42 + 3 / per], [0, 6 / per, -42 + 3 / per], [0, 0, 1.0]])
    squares = []
    for _ in range(12):
        layout = TagLayout(((NAME, int(rng.integers(500))),), corners[None])
        turned = degrees if by_warp else degrees + 90 * rng.integers(4)
        turn = Rotation.from_euler("z", turned, degrees=True).as_matrix()
        place = homography(np.eye(3), turn, [*(79.5 + rng.uniform(-1, 1, 2)), 1.0])
        if by_warp:
            drawn = dictionary_of(NAME).generateImageMarker(layout.tags[0][1], 10 * per)
            image = warped(np.pad(drawn, 2 * per, constant_values=255), place @ from_sheet, (160, 160), rng)
        else:
            image = rendered(layout, place, (160, 160), rng)
        tags = find_tags(image, (NAME,))
        assert tags.tags == layout.tags
        error = tags.corners_px[0] - (corners @ place[:2, :2].T + place[:2, 2])
        squares.append(squares_nees(error.ravel()[None], tags.joint_px2))
    assert 0.4 < np.mean(squares) < 1.4


@pytest.mark.parametrize("degrees", [0.0, 20.0])
@pytest.mark.parametrize("kind", ["charuco", "chessboard"])
def test_corners_of_boards_lie_where_their_areas_meet(kind, degrees):
    """Squares of whole pixels, so that along the rows all corners have one phase, and would be off to one side."""
    rng, square = np.random.default_rng(4), 30.0
    board = CharucoDesign(5, 7, square, 22.0, "DICT_4X4_50") if kind == "charuco" else ChessboardDesign(4, 5, square)
    turn = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    middle = turn[:2, :2] @ board.xy_mm().mean(0)
    place = homography(np.eye(3), turn, [*(np.array([159.7, 149.6]) - middle), 1.0])
    image = rendered(board, place, (320, 300), rng)
    view = (find_charuco if kind == "charuco" else find_chessboard)(image, "", board)
    error = view.xy_px - (view.xyz_board[:, :2] @ place[:2, :2].T + place[:2, 2])
    assert len(view) == len(board.xy_mm())
    assert np.abs(error.mean(0)).max() < 0.006
    assert np.sqrt((error**2).mean()) < 0.015
    if view.covariance_px2 is not None:
        assert 0.4 < squares_nees(error, view.covariance_px2).mean() < 1.6


@pytest.mark.parametrize(("ragged_px", "least_sigma_px"), [(0.0, 0.002), (0.3, 0.03)])
def test_sigma_of_a_crossing_grows_with_edges_that_are_not_straight(ragged_px, least_sigma_px):
    """Of 200 crossings whose edges move from pixel to pixel: the mean of 400 squares has σ 0.07."""
    rng, side, fine = np.random.default_rng(8), 31, 4
    at = (np.arange(side * fine) + 0.5) / fine - 0.5
    true = 15 + rng.uniform(-0.5, 0.5, (200, 2))
    windows = []
    for x, y in true:
        move = ragged_px * np.repeat(rng.normal(size=(2, side)), fine, axis=1)
        right = ((at[None] - x - move[0][:, None]) * fine + 0.5).clip(0, 1)  # shares of the fine pixels
        below = ((at[:, None] - y - move[1][None]) * fine + 0.5).clip(0, 1)
        black = gaussian_filter(right * below + (1 - right) * (1 - below), 0.7 * fine)
        blurred = black.reshape(side, fine, side, fine).mean((1, 3))
        windows.append(np.rint(60 + 120 * blurred + rng.normal(0, 1.5, (side, side))).astype(np.uint8))
    picture = np.concatenate(windows, axis=1)
    place = true + np.column_stack([side * np.arange(200), np.zeros(200)])
    along = np.tile(np.array([[0.0, 1.0], [1.0, 0.0]]), (200, 1, 1))
    found = crossings(picture, np.rint(place), along, np.full(200, 7), np.full(200, 15.0))
    off = found.xy_px - place
    squares = np.einsum("ni,nij,nj->n", off, np.linalg.inv(found.covariance_px2), off) / 2
    assert found.seen.all()
    assert 0.4 < squares.mean() < 1.4  # below 1 without raggedness, as a prior σ of the profile is kept
    assert np.sqrt(found.covariance_px2[:, 0, 0]).min() > least_sigma_px
