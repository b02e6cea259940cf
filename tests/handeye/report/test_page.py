"""What is printed, written and drawn."""

import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest

from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid
from stcal.handeye import HandEyeOptions
from stcal.handeye.data.corner_views import View, Views, pairs_of_views
from stcal.handeye.data.pose_content import HandEyeInput
from stcal.handeye.handeye_file import HandEyeFile
from stcal.handeye.handeye_page import by_robot, outcome_report
from stcal.handeye.handeye_pipeline import Outcome
from stcal.handeye.handeye_problem import FACTORS
from stcal.handeye.validate import Compared, compare, cross_validate, splits
from stcal.io.cameras.camera_model import camera_prior
from stcal.io.files import json_text
from tests.support.handeye import handeye, simulated, simulated_views


@pytest.fixture(scope="module")
def of_views() -> Outcome:
    truth = simulated_views(np.random.default_rng(2), 10, "eye-to-hand", (2e-4, 0.1), 0.1)
    options = HandEyeOptions(with_scale=True)
    result = handeye(truth.pairs, truth.setup, None, truth.views, options)
    result = replace(result, notes=("a note with <markup> & more",))
    held_out = cross_validate(truth.pairs, truth.setup, None, truth.views, options, splits(10, 2, 2))
    left_out = (("x<1>.png", "no board"),)
    given = HandEyeInput("images & poses", truth.pairs, truth.views, pitch_mm=25.0, left_out=left_out)
    return Outcome(given, result, held_out)


@pytest.fixture(scope="module")
def of_methods() -> Outcome:
    truth = simulated(np.random.default_rng(3), 10, robot=(2e-4, 0.1), camera=(5e-4, 0.2))
    compared = compare(truth.pairs, methods=("tsai-lenz", "pose"), rows=splits(10, 2, 2))
    failed = Compared("zhao", None, None, "hand-eye: zhao finds no rotation")
    given = HandEyeInput("poses.csv", truth.pairs)
    return Outcome(given, compared[1].result, compared[1].held_out, (*compared, failed))


@pytest.mark.slow
def test_the_text_has_the_transform_with_its_sigma(of_views):
    result = of_views.result
    lines = outcome_report(of_views).text().splitlines()
    row = next(i for i, line in enumerate(lines) if line.startswith("base_from_camera"))
    of_log = result.base_from_camera.log_sigma(result.covariance)
    for k, axis in enumerate("xyz"):
        name, shift, sigma, _, turn_sigma = lines[row + 1 + k].split()
        assert name == axis
        assert float(shift) == pytest.approx(result.base_from_camera.translation[k], abs=1e-4)
        assert float(sigma) == pytest.approx(math.sqrt(result.covariance[3 + k, 3 + k]), abs=1e-4)
        assert float(turn_sigma) == pytest.approx(math.degrees(of_log[k]), abs=1e-4)
    text = "\n".join(lines)
    assert f"pitch {25 * result.scale:.4f} ± {25 * result.sigma_scale:.4f} mm, stated 25 mm" in text
    assert "held out (2 × 2 of 10 poses), mean: rotation" in text
    assert re.search(r"corner in the image +\S+ px +estimated", text)


@pytest.mark.slow
def test_every_sigma_that_there_is_has_a_name():
    """A camera file that is off: its σ are widened, and the factor is among the σ."""
    truth = simulated_views(np.random.default_rng(2), 7, "eye-in-hand", (2e-4, 0.1), 0.1)
    wrong = replace(truth.views.camera, focal=1.02 * truth.views.camera.focal)
    options, views = (
        HandEyeOptions(intrinsics=camera_prior(Camera.of(wrong, "PINHOLE"))),
        Views(wrong, truth.views.views),
    )
    result = handeye(truth.pairs, truth.setup, None, views, options)
    outcome = Outcome(HandEyeInput("images", truth.pairs, views), result, options=options)
    assert "camera file, focal length" in outcome_report(outcome).text()
    assert "Camera, as adjusted" in outcome_report(outcome).page()
    assert max(v for k, v in HandEyeFile.of(outcome).sigma.items() if k in FACTORS) > 1.5


def test_the_file_is_plain_json_and_gives_the_transform_back(of_views, of_methods):
    data = json.loads(json_text(HandEyeFile.of(of_views, whole=True)))
    assert data["base_from_camera"] == of_views.result.base_from_camera.matrix().tolist()
    assert np.array(data["covariance"]) == pytest.approx(of_views.result.covariance, rel=1e-15)
    assert data["board"]["pitch_mm"] == pytest.approx(25 * of_views.result.scale)
    assert np.shape(data["splits"]["rows"]) == np.shape(data["splits"]["board_mm"]) == (2, 2)
    assert data["held_out"]["board_mm"] == pytest.approx(np.mean(data["splits"]["board_mm"]))
    data = json.loads(json_text(HandEyeFile.of(of_methods, whole=True)))
    assert [row["reason"] for row in data["methods"]] == ["", "", "hand-eye: zhao finds no rotation"]
    assert "methods" not in HandEyeFile.of(of_methods).content()


@pytest.fixture(scope="module")
def truth():
    return simulated_views(np.random.default_rng(2), 10, "eye-in-hand", (2e-4, 0.1), 0.1)


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
@pytest.mark.parametrize("method", ["reprojection", "pose"])
def test_a_board_behind_the_camera_is_nowhere(truth, method):
    result = handeye(truth.pairs, truth.setup, method, truth.views, HandEyeOptions(with_scale=True))
    behind = replace(result, stand_from_board=Rigid(translation=[0, 0, 1e5]) @ result.stand_from_board)
    assert any(np.isnan(px).any() for px in by_robot(behind, truth.pairs, truth.views))
    assert outcome_report(Outcome(HandEyeInput("images", truth.pairs, truth.views), behind)).page()
