"""Errors that the board's poses have in common, as those of a camera that was found, are in σ of the hand-eye."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from stcal.handeye import handeye
from stcal.handeye.data.pose_pairs import read_poses
from stcal.handeye.handeye_problem import HandEyeOptions, HandEyeProblem
from stcal.handeye.validate import with_common_errors, with_jackknife
from stcal.io.join import join_tables
from stcal.io.table import COVARIANCE, common_columns
from stcal.workflows.handeye_inputs import PREFIXES, HandEyeInput
from stcal.workflows.handeye_run import calibrate_handeye
from tests.handeye.written import table
from tests.support.handeye import handeye as handeye_by
from tests.support.handeye import simulated, squared

COMMON = np.array([[1e-3, 0, 0, 0, 0.4, 0], [0, -1e-3, 0, 0.4, 0, 0], [0, 0, 0, 0, 0, 0.8]]).T
"""Errors of the principal point and of the focal length at about 450 mm, rad and mm, (6, 3)."""
OWN = np.diag(np.repeat([2e-4, 0.05], 3) ** 2)
DRAWS = 12


def draw(seed: int, count: int = 16, stated: bool = True, size_sigma: float | None = None):
    """Pairs with these errors, or with a common one of the board's size alone, which they state, and the truth."""
    rng = np.random.default_rng(seed)
    truth = simulated(rng, count, robot=(1e-4, 0.03))
    pairs = truth.pairs
    common = np.tile(COMMON, (count, 1, 1))
    if size_sigma is not None:
        common = size_sigma * np.pad(pairs.camera_from_board.translation, ((0, 0), (3, 0)))[:, :, None]
    noise = rng.normal(size=(count, 6)) @ np.linalg.cholesky(OWN).T + common @ rng.normal(size=common.shape[2])
    pairs = replace(
        pairs,
        camera_from_board=pairs.camera_from_board.moved(noise),
        camera_from_board_covariance=OWN + common @ np.swapaxes(common, 1, 2),
        camera_from_board_common=common if stated else None,
    )
    return pairs, truth


def by_the_jackknife(pairs):
    solution = HandEyeProblem(pairs).solved("shah")
    result = with_jackknife(solution.result, [solution.without(np.array([i])) for i in range(len(pairs))])
    return with_common_errors(result, HandEyeProblem(pairs))


@pytest.mark.slow
@pytest.mark.parametrize("method", ["pose", "shah", None])
def test_sigma_hold_with_common_errors(method):
    """The mean of 6·n squared normal numbers lies within these limits in 998 of 1000 studies; without the common errors
    it is many times as large."""
    draws = {"pose": DRAWS, "shah": 10}.get(method, 1)
    limits = chi2.ppf([0.001, 0.999], 6 * draws) / 6 / draws
    found = []
    for seed in range(draws):
        pairs, truth = draw(seed)
        result = {"pose": handeye_by, "shah": by_the_jackknife}.get(method, handeye)(pairs)
        found.append(squared(result, truth) / 6)
        assert any("in common" in note for note in result.notes)
    assert np.mean(found) < limits[1] * (1.3 if method == "shah" else 1)  # a jackknife of sixteen poses
    if method == "pose":
        assert np.mean(found) > limits[0] / 1.3  # σ of the robot and factors are estimated
    pairs, truth = draw(0, stated=False)
    assert squared(handeye_by(pairs), truth) / 6 > 10 * limits[1]


def test_the_scale_takes_up_a_common_error_of_the_size():
    """With the scale among the unknowns, σ of X do not contain an error that it takes up; limits as above."""
    limits = chi2.ppf([0.001, 0.999], 6 * DRAWS) / 6 / DRAWS
    found = []
    for seed in range(DRAWS):
        pairs, truth = draw(seed, size_sigma=0.01)
        result = handeye_by(pairs, method="pose", options=HandEyeOptions(with_scale=True))
        found.append(squared(result, truth) / 6)
        assert np.sqrt(result.covariance[3:, 3:].trace()) < 1  # without a scale: several mm
    assert limits[0] / 1.3 < np.mean(found) < limits[1] * 1.3  # σ of the robot and factors are estimated


def test_they_are_read_from_what_measure_writes(tmp_path):
    """Also where the file states the inverse transforms, whose errors differ."""
    pairs, _ = draw(0)
    flange, board = pairs.base_from_flange, pairs.camera_from_board
    (i, j), images = np.triu_indices(6), [f"{k}.jpg" for k in range(len(board))]
    errors = dict(zip(COVARIANCE, pairs.camera_from_board_covariance[:, i, j].T.tolist(), strict=True))
    common = np.swapaxes(pairs.camera_from_board_common, 1, 2).reshape(len(board), -1)
    errors |= dict(zip(common_columns(3), common.T.tolist(), strict=True))
    robot = table(tmp_path / "robot.csv", {"": flange}, image=images)
    joined = join_tables(robot, table(tmp_path / "poses.csv", {"": board}, image=images, **errors), "image", PREFIXES)
    as_read = read_poses(joined.table)
    assert np.allclose(as_read[[3, 5]].camera_from_board_common, pairs.camera_from_board_common[[3, 5]], rtol=1e-9)
    other = ("camera_from_board", "board_from_camera")
    columns = {name.replace(*other): own for name, own in joined.table.columns.items()}
    inverse = read_poses(replace(joined.table, columns=columns))
    step = 1e-4 * pairs.camera_from_board_common[:, :, 1]
    moved = board.moved(step).inverse().difference(board.inverse())
    assert np.allclose(1e-4 * inverse.camera_from_board_common[:, :, 1], moved, rtol=1e-3, atol=1e-9)


def test_the_verdict_does_not_ask_for_more_poses_and_says_what_sigma_lack_without_covariances():
    pairs, _ = draw(0)
    found = handeye(pairs)
    assert found.verdict.word == "use with care"
    assert "have in common" in found.verdict.sentence()
    assert "more poses do not help" in found.verdict.reasons()[0].remedy
    assert np.linalg.eigvalsh(found.covariance - found.common_covariance).min() > 0
    pairs = simulated(np.random.default_rng(3), 12, robot=(1e-4, 0.03), camera=(2e-4, 0.05)).pairs
    stated = replace(pairs, camera_from_board_covariance=np.tile(OWN, (12, 1, 1)))
    notes = [calibrate_handeye(HandEyeInput("t", each), "pose", repeats=0).all_notes() for each in (pairs, stated)]
    assert [any("state no covariance" in note for note in each) for each in notes] == [True, False]
