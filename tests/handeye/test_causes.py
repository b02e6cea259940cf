"""Causes that the data can test are tried: a clock's lag before the board's size, stale poses, a setup not stated."""

from dataclasses import replace

import numpy as np
import pytest

import stcal.handeye
from stcal.geometry.rigid import Poses, Rigid
from stcal.handeye.data.pose_pairs import HandEyePoses
from stcal.handeye.data.stream import Timed
from stcal.handeye.handeye_pipeline import judged
from stcal.handeye.handeye_problem import HandEyeProblem
from stcal.handeye.remarks import Grave, SizeDoubt
from stcal.workflows.handeye_inputs import HandEyeInput
from stcal.workflows.handeye_run import calibrate_handeye, lag_tried
from tests.outcome import fails_with
from tests.support.handeye import BASE_FROM_CAMERA, FLANGE_FROM_BOARD, handeye, simulated
from tests.support.handeye_stream import simulated_stream


def given_of(seed: int, offset_s: float, count: int = 25) -> HandEyeInput:
    """Poses taken as if both clocks were one."""
    truth = simulated_stream(np.random.default_rng(seed), count, offset_s=offset_s)
    pairs = replace(truth.pairs, base_from_flange=truth.stream.at(truth.seconds))
    return HandEyeInput("poses", pairs, timed=Timed(truth.stream, truth.seconds))


def told(given: HandEyeInput) -> tuple[str, ...]:
    return lag_tried(HandEyeProblem(given.pairs), given.timed, handeye(given.pairs))[1]


@pytest.mark.slow
@pytest.mark.parametrize("offset_s", [-0.003, 0.004, -0.02, 0.1])
def test_a_lag_is_told_with_what_it_explains(offset_s):
    given = given_of(11, offset_s)
    (note,) = told(given)
    assert f"{'ahead of' if offset_s > 0 else 'behind'} the camera's" in note
    found = float(note.split("clock is ")[1].split(" ±")[0])
    assert found == pytest.approx(1e3 * abs(offset_s), abs=1.0)
    assert isinstance(note, Grave) or abs(offset_s) < 0.01


@pytest.mark.parametrize("seed", range(12, 15))
def test_clocks_that_agree_are_not_blamed(seed):
    assert told(given_of(seed, 0.0)) == ()


@pytest.mark.slow
def test_a_doubt_of_the_size_ends_with_the_lag():
    given = given_of(19, 0.05)
    doubted = replace(result := handeye(given.pairs), notes=(*result.notes, SizeDoubt("the board is larger")))
    again, notes = lag_tried(HandEyeProblem(given.pairs), given.timed, doubted)
    assert not any(isinstance(note, SizeDoubt) for note in again.notes)
    assert len(notes) == 1


def stale(pairs: HandEyePoses, rows: slice) -> HandEyePoses:
    """The flange's pose of the first of these rows in all of them."""
    rotation, place = np.array(pairs.base_from_flange.rotation), np.array(pairs.base_from_flange.translation)
    rotation[rows], place[rows] = rotation[rows][0], place[rows][0]
    return replace(pairs, base_from_flange=Poses(rotation, place))


def test_poses_of_the_flange_that_were_not_read_anew_are_refused():
    pairs = stale(given_of(20, 0.0).pairs, slice(6, 12))
    with fails_with("E-POSES-IDENTICAL … pose 7, pose 8, pose 9 … 6 rows"):
        handeye(pairs)


def drawn(count: int) -> HandEyePoses:
    return simulated(np.random.default_rng(5), count, robot=(3e-4, 0.1), camera=(4e-4, 0.15)).pairs


@pytest.mark.parametrize(
    ("which", "flange", "board"), [("below", np.r_[:19], np.r_[1:20]), ("above", np.r_[1:20], np.r_[:19])]
)
def test_a_side_that_is_stored_a_pose_late_is_named(which, flange, board):
    pairs = drawn(20)
    late = HandEyePoses(pairs.base_from_flange[flange], pairs.camera_from_board[board])
    with fails_with(f"E-HANDEYE-CONVENTION … beside that of the flange one row {which}"):
        handeye(late)


def test_images_at_one_commanded_pose_are_used():
    """Twice each pose, with noise of the board between the two."""
    pairs = given_of(21, 0.0).pairs
    rows, rng = np.repeat(np.arange(len(pairs)), 2), np.random.default_rng(0)
    board = pairs.camera_from_board[rows]
    jitter = Poses(board.rotation, board.translation + rng.normal(0, 0.3, (len(rows), 3)))
    assert len(handeye(HandEyePoses(pairs.base_from_flange[rows], jitter)).names) == len(rows)


def test_residuals_that_no_arm_leaves_are_not_to_be_used():
    given = given_of(22, 0.0)
    rng = np.random.default_rng(1)
    board = given.pairs.camera_from_board
    far = Poses(board.rotation, board.translation + rng.normal(0, 40, (len(board), 3)))
    pairs = replace(given.pairs, camera_from_board=far)
    outcome = calibrate_handeye(replace(given, pairs=pairs, timed=None), "pose", repeats=0)
    assert judged(outcome).word == "do not use"
    assert any(finding.title == "Residuals" for finding in judged(outcome).reasons())


def test_many_outliers_make_the_setup_suspect():
    pairs = drawn(15)
    places = pairs.camera_from_board.translation.copy()
    places[:5] += np.random.default_rng(0).normal(0, 40, (5, 3))
    found = handeye(replace(pairs, camera_from_board=Poses(pairs.camera_from_board.rotation, places)))
    assert any(note.startswith("5 of 15 poses contradict the others: with so many look first") for note in found.notes)


def test_a_camera_far_off_the_flange_needs_its_setup_stated():
    """Robot's poses inverted, as of a camera beside the robot: nothing else tells."""
    truth = simulated_stream(np.random.default_rng(23), 20, "eye-to-hand", 0.0)
    flange = truth.stream.at(truth.seconds).inverse()
    far = Poses(flange.rotation, flange.translation)
    given = HandEyeInput("poses", replace(truth.pairs, base_from_flange=far))
    outcome = calibrate_handeye(given, "pose", repeats=0)
    assert np.linalg.norm(outcome.result.mount_from_camera.translation) > 1000
    assert any("--setup eye-to-hand" in note and isinstance(note, Grave) for note in outcome.notes)
    stated = calibrate_handeye(replace(given, setup="eye-in-hand"), "pose", repeats=0)
    assert not any("--setup" in note for note in stated.notes)


def test_a_board_at_the_base_needs_its_setup_stated():
    """A camera near the robot, 0.5 m off its base: a bracket could be as long, but no board lies within a base."""
    pairs = drawn(20)
    camera = Rigid(BASE_FROM_CAMERA.rotation, [200.0, -50.0, 450.0])
    flange = camera @ pairs.camera_from_board @ FLANGE_FROM_BOARD.inverse()
    inverted = HandEyePoses(flange.inverse(), pairs.camera_from_board)
    given = HandEyeInput("poses", inverted)
    outcome = calibrate_handeye(given, "pose", repeats=0)
    assert any("off the base's origin" in note and "--setup eye-to-hand" in note for note in outcome.notes)
    right = calibrate_handeye(HandEyeInput("poses", pairs), "pose", repeats=0)
    assert not any("--setup" in note for note in right.notes)


@pytest.mark.parametrize(
    ("given", "told"),
    [
        (lambda a, b: (a, b), ""),
        (lambda a, b: (b, a), "the two sides are exchanged"),
        (lambda a, b: (a.inverse(), b.inverse()), "both are the inverses of what they are named"),
    ],
)
@pytest.mark.parametrize("setup", [None, "eye-in-hand"])
def test_sides_that_are_exchanged_are_doubted(given, told, setup):
    """No residual tells; the camera is then as far off the flange as the board is off the base."""
    pairs = simulated_stream(np.random.default_rng(5), 15, "eye-in-hand", 0.0).pairs
    result = stcal.handeye.handeye(*given(pairs.base_from_flange, pairs.camera_from_board), setup=setup)
    assert any(told in note for note in result.notes) if told else not result.notes
