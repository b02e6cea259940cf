"""What is printed, written and drawn; and the verdict: right on honest poses, and worse for what is wrong."""

import json
import math
import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Poses, Rigid
from stcal.handeye import HandEyeOptions
from stcal.handeye.data.corner_views import View, Views, pairs_of_views
from stcal.handeye.data.pose_content import HandEyeInput
from stcal.handeye.handeye_file import HandEyeFile
from stcal.handeye.handeye_page import by_robot, outcome_report
from stcal.handeye.handeye_pipeline import Outcome, judged
from stcal.handeye.handeye_problem import FACTORS
from stcal.handeye.remarks import Aside, Grave
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
def test_the_text_has_the_transform_with_its_sigma_of_which_every_one_has_a_name(of_views):
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
    # A camera file that is off: its σ are widened, and the factor is among the σ.
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


NOISE = {"robot": (2e-4, 0.1), "camera": (5e-4, 0.2)}


@cache
def outcome_of(count: int, seed: int, method: str = "pose", pairs=None, **noise) -> Outcome:
    truth = simulated(np.random.default_rng(seed), count, **(noise or NOISE))
    pairs = pairs or truth.pairs
    result = handeye(pairs, truth.setup, method)
    held_out = cross_validate(pairs, truth.setup, method, None, HandEyeOptions(), splits(count, None, 6))
    return Outcome(HandEyeInput("poses.csv", pairs), result, held_out)


def word_of(outcome: Outcome, title: str) -> str:
    (found,) = [each.word for each in judged(outcome).findings if each.title == title]
    return found


@pytest.mark.full
def test_honest_poses_are_good():
    """Sixteen poses of a robot and a camera that err as stated: by chance an outlier is found in one of a hundred
    calibrations, and two groups in another; of 40, more than 4 in one of 10 000."""
    words = [judged(outcome_of(16, seed)).word for seed in range(100, 140)]
    assert words.count("good") >= 36
    assert words.count("do not use") <= 1


def test_few_poses_ask_for_care_and_those_without_errors_are_not_tested():
    """Of five poses the transform is known no better than a pose is measured."""
    assert judged(outcome_of(20, 5)).sentence().startswith("good: poses held out are missed by 0.")
    found = judged(outcome_of(5, 5))
    assert found.word == "use with care"
    assert "Motions of the flange" in [each.title for each in found.reasons()]
    few = [[each.title for each in judged(outcome_of(count, 5)).reasons()] for count in (4, 5)]
    assert ["Number of poses" in titles for titles in few] == [True, False]
    outcome = outcome_of(12, 3, method="park-martin", robot=(0, 0), camera=(0, 0))
    assert [each.title for each in judged(outcome).findings] == ["Motions of the flange", "Outliers"]
    assert judged(outcome).word == "good"


@pytest.mark.slow
def test_small_turns_are_named_with_the_axes_to_turn_about():
    """Turns of 2°: the camera's place is known ten times worse than a pose."""
    outcome = outcome_of(16, 5)
    base = outcome.given.pairs.base_from_flange
    small = Poses.of(Rigid.exp(np.append(0.04 * pose.log()[:3], pose.translation)) for pose in base)
    result, rng = outcome.result, np.random.default_rng(1)
    errors = [Rigid.exp([*rng.normal(0, 1e-4, 3), *rng.normal(0, 0.05, 3)]) for _ in range(16)]
    seen = result.mount_from_camera.inverse() @ (small.inverse() @ result.stand_from_board)
    pairs = replace(outcome.given.pairs, base_from_flange=small, camera_from_board=Poses.of(errors) @ seen)
    found = judged(outcome_of(16, 5, pairs=pairs))
    (motions,) = [each for each in found.findings if each.title == "Motions of the flange"]
    assert motions.word == "do not use"
    assert "rotate the flange about (" in motions.remedy
    assert found.word == "do not use"


def test_errors_on_poses_held_out_and_outliers_decide():
    """Errors of poses held out, four times as large: less than one of 100 000 by chance."""
    outcome = outcome_of(16, 5)
    assert word_of(outcome, "Poses held out") == "good"
    held = outcome.held_out
    for factor, word in ((1.9, "use with care"), (4.0, "do not use")):
        worse = replace(held, translation_mm=factor * held.translation_mm)
        assert word_of(replace(outcome, held_out=worse), "Poses held out") == word
    unknown = replace(outcome, held_out=None)
    assert judged(unknown).sentence() == "use with care: errors on poses held out are not known"
    for count, word in ((1, "use with care"), (4, "use with care"), (5, "do not use")):
        bad = np.arange(16) < count
        assert word_of(replace(outcome, result=replace(outcome.result, outliers=bad)), "Outliers") == word


@pytest.mark.parametrize(
    ("note", "word"), [(Grave("x: y"), "do not use"), ("x: y", "use with care"), (Aside("x: y"), "good")]
)
def test_notes_weigh(note, word):
    outcome = replace(outcome_of(20, 5), notes=(note,))
    found = judged(outcome)
    assert found.word == word
    assert [(each.said, each.remedy) for each in found.findings if each.title == "Note"] == [("x", "y")] * (
        word != "good"
    )
