"""Lines between the cells of a tag tell how far sampling displaces edges."""

import numpy as np
import pytest
from scipy.special import ndtr

from stcal.boards.area import POINTS_PX, PRIOR_PX, Displacement, OuterLines, displacement_variance, told_by_lines

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
