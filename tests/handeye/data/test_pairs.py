"""Pose files and pose pairs."""

import numpy as np
import pytest

from stcal.handeye import HandEyePoses, read_poses
from stcal.handeye.data.pose_pairs import inverted
from stcal.io.table import COVARIANCE
from tests.handeye.written import poses_file, sides_of, table
from tests.outcome import fails_with, refuses
from tests.support.handeye import simulated


@pytest.fixture(scope="module")
def truth():
    return simulated(np.random.default_rng(1), 8, camera=(1e-3, 0.3))


@pytest.mark.parametrize("unit", ["mm", "m"])
@pytest.mark.parametrize("robot", ["base_from_flange", "flange_from_base"])
@pytest.mark.parametrize("camera", ["camera_from_board", "board_from_camera"])
def test_files_in_every_form_say_the_same(tmp_path, truth, unit, robot, camera):
    flange, board = truth.pairs.base_from_flange, truth.pairs.camera_from_board
    sides = {
        robot: flange if robot.startswith("base") else flange.inverse(),
        camera: board if camera.startswith("camera") else board.inverse(),
    }
    pairs = read_poses(table(tmp_path / "poses.csv", sides, unit=unit))
    assert pairs.base_from_flange.difference(flange) == pytest.approx(np.zeros((8, 6)), abs=1e-9)
    assert pairs.camera_from_board.difference(board) == pytest.approx(np.zeros((8, 6)), abs=1e-9)
    assert pairs.names[:2] == ("line 2", "line 3")


def test_bad_cells_and_sides_are_named(tmp_path, truth):
    for row, column, cell, error in (
        (2, 0, "nan", "E-TABLE-NUMBER … 4 … base_from_flange_x_mm … 'nan'"),
        (5, 13, "3", "E-QUATERNION-LENGTH … line 7"),
        (0, 8, "abc", "E-TABLE-NUMBER … 2 … camera_from_board_y_mm … 'abc'"),
    ):
        path = poses_file(tmp_path / "poses.csv", truth, lambda rows: rows[row].__setitem__(column, cell))  # noqa: B023
        refuses(error, read_poses, path)
    flange, board = truth.pairs.base_from_flange, truth.pairs.camera_from_board
    every = {"base_from_flange": flange, "flange_from_base": flange.inverse(), "camera_from_board": board}
    for sides, fault in (({"base_from_flange": flange}, "base_from_flange alone"), (every, "base_from_flange, flange")):
        refuses(f"E-POSES-MIXED … {fault}", read_poses, table(tmp_path / "a.csv", sides))


def test_identical_poses_and_a_board_that_did_not_follow_are_named(tmp_path, truth):
    rows = [0, 1, 2, 3, 1, 5]
    with fails_with("E-POSES-IDENTICAL … line 3 and line 6"):
        read_poses(table(tmp_path / "poses.csv", {n: poses[rows] for n, poses in sides_of(truth.pairs).items()}))
    board = truth.pairs.camera_from_board[[0, 1, 2, 3, 3, 5, 6, 7]]
    with fails_with("E-POSES-IDENTICAL … pose 4 and pose 5"):
        HandEyePoses(truth.pairs.base_from_flange, board)


def test_matrices_are_checked_one_by_one(truth):
    flange = [p.matrix() for p in truth.pairs.base_from_flange]
    board = [p.matrix() for p in truth.pairs.camera_from_board]
    same = HandEyePoses.from_matrices(flange, board)
    assert same.camera_from_board.translation == pytest.approx(truth.pairs.camera_from_board.translation)
    mirrored = [m.copy() for m in board]
    mirrored[3][:3, 2] *= -1
    refuses("E-ROTATION-IMPROPER … camera_from_board", HandEyePoses.from_matrices, flange, mirrored)
    broken = [m.copy() for m in flange]
    broken[1][0, 3] = np.inf
    with fails_with("E-ARRAY-NOT-FINITE"):
        HandEyePoses.from_matrices(broken, board, names=tuple(f"{c}.png" for c in "abcdefgh"))
    refuses("E-POSES-COUNT … 8 … 7", HandEyePoses.from_matrices, flange, board[:7])
    refuses("E-POSES-COUNT … 7 … 8", HandEyePoses.from_matrices, flange[:7], board)


def test_covariances_are_read_and_turned_over(tmp_path, truth):
    """The inverse's covariance, given under the inverse's name, comes back as the pose's own."""
    rng = np.random.default_rng(2)
    root = rng.normal(size=(8, 6, 6)) * np.repeat([1e-3, 0.3], 3)[:, None]
    covariance = root @ np.swapaxes(root, 1, 2)
    board = truth.pairs.camera_from_board
    i, j = np.triu_indices(6)
    _, inverse, _ = inverted(board, covariance, None)
    extra = {f"board_from_camera_{name}": inverse[:, i[k], j[k]] for k, name in enumerate(COVARIANCE)}
    sides = {"base_from_flange": truth.pairs.base_from_flange, "board_from_camera": board.inverse()}
    pairs = read_poses(table(tmp_path / "poses.csv", sides, **extra))
    assert pairs.camera_from_board_covariance == pytest.approx(covariance, rel=1e-6, abs=1e-10)
    assert pairs.base_from_flange_covariance is None
    assert pairs[2:4].camera_from_board_covariance.shape == (2, 6, 6)
