"""Lines between the cells of a tag tell how far sampling displaces edges."""

import numpy as np
import pytest
from scipy.special import ndtr

from stcal.boards.area import PRIOR_PX, Displacement, OuterLines, displacement_variance, told_by_lines

CELLS, WIDTH_PX, BLUR_PX, DARK, RISE, NOISE = 8, 14.3, 0.6, 30.0, 180.0, 0.7
AT_PX = 20.4


def shares(lines: np.ndarray, size: int) -> np.ndarray:
    """Returns the shares (size, cells) of cells between lines in pixels, blurred: exact integrals over each pixel."""

    def integral(x):
        return x * ndtr(x / BLUR_PX) + BLUR_PX * np.exp(-0.5 * (x / BLUR_PX) ** 2) / np.sqrt(2 * np.pi)

    beyond = np.arange(size)[:, None] - lines
    bright_side = integral(beyond + 0.5) - integral(beyond - 0.5)
    return bright_side[:, :-1] - bright_side[:, 1:]


def told(displaced_px: float, seed: int) -> float:
    """Returns the variance that a tag along the pixel rows tells, every second of whose inner lines is displaced."""
    rng = np.random.default_rng(seed)
    bright = np.zeros((CELLS, CELLS))
    bright[1:-1, 1:-1] = rng.integers(0, 2, (CELLS - 2, CELLS - 2))
    lines = AT_PX + WIDTH_PX * np.arange(CELLS + 1)
    shares_of_cell = shares(lines + displaced_px * np.r_[0, (-1.0) ** np.arange(1, CELLS), 0], 160)
    paper = 1 - np.outer(shares_of_cell.sum(1), shares_of_cell.sum(1))
    image = DARK + RISE * (shares_of_cell @ bright @ shares_of_cell.T + paper)
    grey = np.rint(image + np.sqrt(NOISE) * rng.standard_normal(image.shape)).astype(np.uint8)
    low, high = lines[0], lines[-1]
    corners = np.array([[[low, low], [high, low], [high, high], [low, high]]])
    one = np.ones(1)
    outer = OuterLines(
        corners,
        BLUR_PX**2 * one,
        DARK * one,
        RISE * one,
        (NOISE + 1 / 12) * one,
        np.full((1, 4), 1e-6),
        np.broadcast_to([1.0, 0.0], (1, 4, 2)),
    )
    return displacement_variance(told_by_lines(grey, outer, CELLS)).of_area


def test_a_blur_that_passes_nothing_tells_nothing():
    """The share of a turned edge underflows to 0: nothing is known of areas beyond the prior, and no σ is lost."""
    one = np.ones(2)
    found = displacement_variance(Displacement(1e-6 * one, 1e-6 * one, 4 * one, 0 * one))
    assert found.of_area == pytest.approx(PRIOR_PX**2)
    assert found.of(np.zeros(1)) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_displaced_lines_are_told_and_even_ones_are_not(seed):
    """Twelve lines of 0.02 px each way: their RMS within a third, two standard deviations of that of a dozen."""
    assert np.sqrt(told(0.02, seed)) == pytest.approx(0.02, rel=0.35)
    assert np.sqrt(told(0.0, seed)) < PRIOR_PX
