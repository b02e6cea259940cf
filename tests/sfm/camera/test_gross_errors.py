"""Corners that are errors, reasons why there are no views, and rows that no image shows."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stcal.io.images import ImageFile, Skipped
from stcal.labels import DotLabel, unseen_lines
from stcal.sfm.camera.calibrate import MAX_RESIDUAL_PX, judged, require_determined, require_views, residual_rms_px
from stcal.workflows.calibrate_camera import without_gross_errors
from tests.outcome import fails_with
from tests.sfm.camera.test_intrinsics import BOARD, calibrated, views_of


def moved(view, rows, by_px):
    """The view with some of its points elsewhere."""
    centre = view.centre_px.copy()
    centre[rows] += by_px
    return replace(view, centre_px=centre)


def test_gross_errors_are_left_out_and_other_points_stay():
    """Three points of one view at 40 px pull its pose, so that others look wrong, too."""
    views = views_of(np.random.default_rng(4), count=10)
    spoiled = [*views]
    spoiled[3] = moved(views[3], [0, 1, 2], [40.0, -25.0])
    result = calibrated(spoiled)
    assert residual_rms_px(result) > MAX_RESIDUAL_PX
    require_determined(result, spoiled, BOARD)  # a few do not refuse all
    kept, skipped, (warning,) = without_gross_errors(spoiled, BOARD, result)
    assert skipped == []
    assert kept[3].labels == views[3].labels[3:]
    assert [len(view) for view in kept] == [len(view) - 3 * (i == 3) for i, view in enumerate(views)]
    assert f"3 corners in 1 views are left out, first {views[3].name} {views[3].labels[0]}" in warning


@pytest.mark.slow
def test_a_view_of_gross_errors_is_skipped_and_views_without_stay_as_they_are():
    views = views_of(np.random.default_rng(5), count=10)
    kept, skipped, warnings = without_gross_errors(views, BOARD, calibrated(views))
    assert all(a is b for a, b in zip(kept, views, strict=True))
    assert skipped == warnings == []
    spoiled, rng = [*views], np.random.default_rng(6)
    wrong = np.arange(len(views[7]))[: int(0.8 * len(views[7]))]
    spoiled[7] = moved(views[7], wrong, rng.uniform(-60, 60, (len(wrong), 2)))
    kept, skipped, _ = without_gross_errors(spoiled, BOARD, calibrated(spoiled))
    assert [each.name for each in skipped] == [views[7].name]
    assert len(kept) == 9


def test_the_reason_for_no_board_is_that_of_an_image():
    files = [ImageFile(Path("a.png"), "a.png", ".")]
    skipped = [Skipped("board.yaml", "not an image file"), Skipped("a.png", "no board of dots recognised", "board")]
    with fails_with("E-BOARD-NOT-FOUND … a.png: no board of dots"):
        require_views([], files, skipped)


@pytest.mark.parametrize(("rows", "columns", "said"), [(4, 5, []), (5, 5, ["row 4"]), (4, 7, ["column 5, 6"])])
def test_rows_and_columns_that_no_image_shows(rows, columns, said):
    labels = [DotLabel(row, column) for row in range(4) for column in range(5)]
    assert [note.split(":")[0] for note in unseen_lines(labels, rows, columns)] == [f"board {each}" for each in said]


@pytest.mark.slow
def test_a_row_too_many_is_a_warning_of_the_calibration():
    views = views_of(np.random.default_rng(8), count=6)
    longer = replace(BOARD, rows=BOARD.rows + 1)
    warnings = judged(calibrated(views), views, (), 1, True, longer).warnings
    assert any(f"board row {BOARD.rows}: not seen in any image" in warning for warning in warnings)
