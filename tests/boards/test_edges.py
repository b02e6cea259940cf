"""Edges measured by area: the integrated step, corners and their σ along the pixel rows and across them, and what lines
between the cells of a tag tell of how far sampling displaces edges."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation
from scipy.special import ndtr

from stcal.boards.area import (
    POINTS_PX,
    PRIOR_PX,
    Displacement,
    OuterLines,
    displacement_variance,
    integrated_step,
    solved,
    told_by_lines,
)
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


CELLS, WIDTH_PX, BLUR_PX, DARK, RISE, NOISE = 8, 14.3, 0.6, 30.0, 180.0, 0.7
AT_PX = 20.4
OUTWARDS = np.array([-AT_PX, AT_PX + CELLS * WIDTH_PX, AT_PX + CELLS * WIDTH_PX, -AT_PX])


def shares(lines: np.ndarray, size: int) -> np.ndarray:
    """Returns the shares (size, cells) of cells between lines in pixels, blurred: exact integrals over each pixel."""

    def integral(x):
        return x * ndtr(x / BLUR_PX) + BLUR_PX * np.exp(-0.5 * (x / BLUR_PX) ** 2) / np.sqrt(2 * np.pi)

    beyond = np.arange(size)[:, None] - lines
    bright_side = integral(beyond + 0.5) - integral(beyond - 0.5)
    return bright_side[:, :-1] - bright_side[:, 1:]


def told(displaced_px: float, seed: int, by_phase: bool = False) -> float:
    """Returns the variance that a tag along the pixel rows tells, every second of whose inner lines is displaced.

    By phase, all lines are displaced instead, by a sine of their place between two pixels of this RMS.
    """
    rng = np.random.default_rng(seed)
    bright = np.zeros((CELLS, CELLS))
    bright[1:-1, 1:-1] = rng.integers(0, 2, (CELLS - 2, CELLS - 2))
    lines = AT_PX + WIDTH_PX * np.arange(CELLS + 1)
    wave = np.sqrt(2) * np.sin(2 * np.pi * lines)
    lines = lines + displaced_px * (wave if by_phase else np.r_[0, (-1.0) ** np.arange(1, CELLS), 0])
    shares_of_cell = shares(lines, 160)
    paper = 1 - np.outer(shares_of_cell.sum(1), shares_of_cell.sum(1))
    image = DARK + RISE * (shares_of_cell @ bright @ shares_of_cell.T + paper)
    grey = np.rint(image + np.sqrt(NOISE) * rng.standard_normal(image.shape)).astype(np.uint8)
    low, high = lines[0], lines[-1]
    corners = np.array([[[low, low], [high, low], [high, high], [low, high]]])
    blur, dark, rise, noise = np.array([[BLUR_PX**2], [DARK], [RISE], [NOISE + 1 / 12]])
    # Outwards from the upper, right, lower and left edge.
    by_sampling = np.stack([np.cos(2 * np.pi * OUTWARDS), np.sin(2 * np.pi * OUTWARDS)], axis=-1)[None]
    outer = OuterLines(corners, blur, dark, rise, noise, np.full((1, 4), 1e-6), by_sampling)
    waves, otherwise = told_by_lines(grey, outer, CELLS)
    return float(displacement_variance([waves], [otherwise]).of(np.ones(1))[0])


def test_lines_that_tell_nothing_leave_the_prior():
    """The share of a turned edge underflows to 0: nothing is known of areas beyond the prior, and no σ is lost.
    Lines whose spacing is a whole number of pixels say nothing: σ allows for images that were warped in points."""
    one = np.ones(2)
    found = displacement_variance([Displacement(0 * one, 1e-8 * one, 4 * one, 0 * one)])
    assert found.of_area == pytest.approx(PRIOR_PX**2)
    assert found.of(np.zeros(1)) == pytest.approx(0.0, abs=1e-6)
    found = displacement_variance([Displacement(0 * one, one, one, one)])
    assert np.sqrt(found.of(np.ones(1))) == pytest.approx(np.hypot(PRIOR_PX, POINTS_PX), rel=0.01)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("by_phase", [True, False])
def test_displaced_lines_are_told_and_even_ones_are_not(seed, by_phase):
    """Twelve lines of 0.02 px each way: their RMS within a third, two standard deviations of that of a dozen."""
    assert np.sqrt(told(0.02, seed, by_phase)) == pytest.approx(0.02, rel=0.35)
    assert np.sqrt(told(0.0, seed)) < PRIOR_PX
