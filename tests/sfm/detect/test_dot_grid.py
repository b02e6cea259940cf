"""The board's grid among the outlines of an image."""

from dataclasses import replace

import pytest

from stcal.design import reference_board
from stcal.io.cameras.read import read_camera
from stcal.io.images import decode
from stcal.sfm.detect.candidates import Candidates, EllipseOptions, find_ellipses
from stcal.sfm.detect.dot_grid import contradiction, find_boards
from stcal.sfm.detect.image import image_corners


@pytest.fixture(scope="module")
def dots(sample):
    grey = decode((sample / "images/12/IMG_1000.jpg").read_bytes(), "sample")
    camera = read_camera(sample / "cameras.txt").calibrated(grey.shape[1], grey.shape[0])
    return Candidates(find_ellipses(grey, "bright", EllipseOptions()), camera), image_corners(camera)


@pytest.mark.parametrize("factor", [0.52, 1.5, 3.0])
def test_another_pitch_than_stated_is_named_with_the_true_ratio(dots, factor):
    """Of the sample, 30 mm with radii of 7.5 mm; blur makes dots a little larger."""
    board = replace(reference_board(), pitch_mm=30.0 * factor, corner=None)
    note = contradiction(dots[0], board, dots[1], find_boards(dots[0], board, dots[1]))
    assert float(note.partition("its pitch ")[2].partition(" times")[0]) == pytest.approx(4.0, rel=0.03)


def test_a_grid_of_other_dots_is_not_the_board(dots):
    board = replace(reference_board(), rows=12, columns=14, pitch_mm=60.0, corner=None)
    tiny = replace(board, pitch_mm=0.5, radius_mm=0.1, unusual_size=True)  # as its file says
    small = replace(board, pitch_mm=1.0, radius_mm=0.06)  # smaller radii are tried than a file may state
    for other in (board, replace(reference_board(), corner=None), tiny, small):
        assert contradiction(dots[0], other, dots[1], []) == ""
