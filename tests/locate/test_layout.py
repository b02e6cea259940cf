"""Layout files: what they say, and what they may not say."""

import numpy as np
import pytest

from stcal.boards.board_file import load_flat_board
from stcal.locate.layout import layout_toml, load_layout, load_plan, square
from tests.outcome import fails_with
from tests.support.tags import example_layout

HEAD = 'type = "tags"\n'
TAG = '[[tag]]\ndictionary = "4x4_50"\nid = {}\n'
NEGATIVE = f"covariance_mm2 = {[[0.0] * k + [-1.0 if k else 1.0] for k in range(8)]}\n"
PLACED = TAG + "size_mm = 20.0\nx_mm = {}\ny_mm = {}\nangle_deg = {}\n"


def written(tmp_path, text):
    path = tmp_path / "layout.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_obj_lies_in_the_middle_of_the_origin_tag(tmp_path):
    text = HEAD + "origin = 2\n" + PLACED.format(1, 0, 0, 0) + PLACED.format(2, 100, 50, 90)
    layout = load_layout(written(tmp_path, text))
    assert layout.origin == 1
    assert np.allclose(layout.corners_mm[1], square(20.0), atol=1e-12)
    # tag 1 as seen from tag 2, which is turned by a quarter from X to Y
    assert np.allclose(layout.corners_mm[0].mean(0), [-50, 100], atol=1e-12)


def test_a_calibrated_layout_comes_back(tmp_path):
    layout = example_layout()
    rng = np.random.default_rng(0)
    mix = rng.standard_normal((48, 48))
    layout = type(layout)(layout.name, layout.tags, layout.corners_mm, 1e-4 * mix @ mix.T, 0, 0.3)
    path = written(tmp_path, layout_toml(layout, ["a comment"]))
    again = load_layout(path)
    assert np.abs(again.corners_mm - layout.corners_mm).max() < 1e-6  # six decimals
    # six digits of each element
    assert np.abs(again.covariance_mm2 - layout.covariance_mm2).max() < 1e-5 * np.abs(layout.covariance_mm2).max()
    assert (again.tags, again.origin, again.sigma_px) == (layout.tags, 0, 0.3)
    assert load_flat_board(path).tags == layout.tags  # and it is a board of tags


def test_a_plan_may_leave_places_open(tmp_path):
    path = written(tmp_path, HEAD + TAG.format(4) + "size_mm = 20.0\n" + PLACED.format(5, 1, 2, 0))
    plan = load_plan(path)
    assert np.isnan(plan.corners_mm[0]).all()
    assert np.isfinite(plan.corners_mm[1]).all()
    with fails_with("E-TAG-PLACE … 4"):
        load_layout(path)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (TAG.format(1) + TAG.format(1).replace("4x4", "5x5"), "E-TAG-REPEATED … 1 … 2"),
        ("origin = 9\n" + TAG.format(1), "E-LAYOUT-ORIGIN … 9"),
        (TAG.format(1) + "corners_mm = [[0, 0], [0, 9], [9, 9], [9, 0]]\n", "E-TAG-CORNERS"),
        (TAG.format(1).replace("4x4_50", "9x9_50"), "E-KEY-VALUE"),
        ("covariance_mm2 = [[1.0]]\n" + PLACED.format(1, 0, 0, 0), "E-KEY-VALUE … covariance_mm2 … 8"),
        (NEGATIVE + PLACED.format(1, 0, 0, 0), "E-KEY-VALUE … covariance_mm2 … -1 … 0 … 1"),
    ],
)
def test_what_is_wrong_is_named(tmp_path, text, reason):
    with fails_with(reason):
        load_layout(written(tmp_path, HEAD + text))
