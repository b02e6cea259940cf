"""The verdict: right on honest poses, and worse for what is wrong."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from stcal.geometry.rigid import Poses, Rigid
from stcal.handeye import HandEyeOptions
from stcal.handeye.data.pose_content import HandEyeInput
from stcal.handeye.handeye_pipeline import Outcome, judged
from stcal.handeye.remarks import Aside, Grave
from stcal.handeye.validate import cross_validate, splits
from tests.support.handeye import handeye, simulated

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


def test_few_poses_ask_for_care():
    """Of five poses the transform is known no better than a pose is measured."""
    assert judged(outcome_of(20, 5)).sentence().startswith("good: poses held out are missed by 0.")
    found = judged(outcome_of(5, 5))
    assert found.word == "use with care"
    assert "Motions of the flange" in [each.title for each in found.reasons()]
    few = [[each.title for each in judged(outcome_of(count, 5)).reasons()] for count in (4, 5)]
    assert ["Number of poses" in titles for titles in few] == [True, False]


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


def test_poses_without_errors_are_not_tested():
    outcome = outcome_of(12, 3, method="park-martin", robot=(0, 0), camera=(0, 0))
    assert [each.title for each in judged(outcome).findings] == ["Motions of the flange", "Outliers"]
    assert judged(outcome).word == "good"
