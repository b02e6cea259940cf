"""What the poses covered, and pictures of how corners by the robot miss."""

from dataclasses import replace

import numpy as np
import pytest

from stcal.geometry.rigid import Rigid
from stcal.handeye import HandEyeOptions
from stcal.handeye.data.corner_views import View, Views, pairs_of_views
from stcal.handeye.handeye_page import by_robot, image_coverage, outcome_report
from stcal.handeye.handeye_pipeline import Outcome
from tests.support.handeye import handeye, simulated_views


@pytest.fixture(scope="module")
def truth():
    return simulated_views(np.random.default_rng(2), 10, "eye-in-hand", (2e-4, 0.1), 0.1)


@pytest.fixture(scope="module", params=["reprojection", "pose"])
def outcome(request, truth) -> Outcome:
    result = handeye(truth.pairs, truth.setup, request.param, truth.views, HandEyeOptions(with_scale=True))
    return Outcome("images", result, pairs=truth.pairs, views=truth.views)


def views_of(camera, *corners) -> Views:
    return Views(
        camera, tuple(View(np.pad(np.array(xy, float), ((0, 0), (0, 1))), np.array(xy, float)) for xy in corners)
    )


def test_the_share_of_the_image(truth):
    """A quarter, by one view and by two that are the same; two quarters that meet are half; a line is nothing. Cells of
    a sixtieth of the width let a straight border be off by one of them: 1/60 and 1/45 of the sides."""
    camera = truth.views.camera
    w, h = camera.width, camera.height
    first = [(0, 0), (w / 2, 0), (w / 2, h / 2), (0, h / 2), (w / 5, h / 5)]
    second = [(x + w / 2, y) for x, y in first]
    for views, share, most in (((first,), 0.25, 1), ((first, first), 0.25, 2), ((first, second), 0.5, 1)):
        found = image_coverage(views_of(camera, *views))
        assert (found > 0).mean() == pytest.approx(share, abs=0.04)
        assert found.max() == most
    found = image_coverage(views_of(camera, first))
    assert found[:20, :25].min() == 1  # rows are y, columns x
    assert found[-20:].max() == 0
    assert not image_coverage(views_of(camera, [(x, 10) for x in range(10, 60, 10)])).any()


@pytest.mark.parametrize("method", ["reprojection", "pose"])
def test_corners_of_a_board_of_another_size(truth, method):
    """Stated a tenth too small: with its true size, which is found, the corners are where they were seen."""
    small = [View(view.xyz_board / 1.1, view.xy_px, view.covariance) for view in truth.views.views]
    views = Views(truth.views.camera, tuple(small))
    pairs = pairs_of_views(truth.pairs.base_from_flange, views)
    result = handeye(pairs, truth.setup, method, views, HandEyeOptions(with_scale=True))
    assert result.scale == pytest.approx(1.1, abs=0.01)
    for view, px in zip(views.views, by_robot(result, pairs, views), strict=True):
        assert np.linalg.norm(px - view.xy_px, axis=1).max() < 5


@pytest.mark.slow
def test_a_board_behind_the_camera_is_nowhere(truth, outcome):
    behind = replace(outcome.result, stand_from_board=Rigid(translation=[0, 0, 1e5]) @ outcome.result.stand_from_board)
    assert any(np.isnan(px).any() for px in by_robot(behind, truth.pairs, truth.views))
    assert outcome_report(replace(outcome, result=behind)).page()
