"""Errors that all poses of the camera have in common: they shift the result, and no residual shows them."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stcal import handeye
from stcal.geometry.rigid import Poses, Rigid
from stcal.io.table import COVARIANCE, POSE, common_columns, pose_cells
from tests.support.handeye import simulated


def _measured(setup: str, seed: int) -> tuple[handeye.HandEyePoses, Rigid]:
    """Poses of a camera whose principal point, and whose scale, are off: all are turned by 0.8 mrad, and shifted."""
    rng = np.random.default_rng(seed)
    sample = simulated(rng, 12, robot=(1e-4, 0.03), camera=(1e-4, 0.02), setup=setup)
    poses = sample.pairs.camera_from_board
    turns = 8e-4 * np.eye(3)[:2]  # about x and y of the camera
    common = np.zeros((len(poses), 6, 3))
    for k, turn in enumerate(turns):
        common[:, :3, k] = turn
        common[:, 3:, k] = np.cross(turn, poses.translation)
    common[:, 3:, 2] = 2e-3 * poses.translation * [0, 0, 1]  # of the focal length
    error = common @ rng.standard_normal(3)
    moved = [
        Rigid(Rigid.exp([*e[:3], 0, 0, 0]).rotation @ pose.rotation, pose.translation + e[3:])
        for e, pose in zip(error, poses, strict=True)
    ]
    own = np.diag([1e-4**2] * 3 + [0.02**2] * 3) * np.ones((len(poses), 1, 1))
    pairs = replace(
        sample.pairs, camera_from_board=Poses.of(moved), camera_from_board_covariance=own, camera_common=common
    )
    return pairs, sample.mount_from_camera


@pytest.mark.slow
@pytest.mark.parametrize("setup", ["eye-in-hand", "eye-to-hand"])
def test_sigma_contain_what_all_poses_have_in_common(setup):
    """Squared error over covariance, 6 expected, of eight draws; without the common part it is a hundred times that."""
    with_common, without = [], []
    for seed in range(8):
        pairs, truth = _measured(setup, seed)
        found = handeye.compare(pairs, methods=("pose",), setup=setup)[0].result
        error = found.mount_from_camera @ truth.inverse()
        turn = Rotation.from_matrix(error.rotation).as_rotvec()
        apart = np.concatenate([turn, found.mount_from_camera.translation - truth.translation])
        for result, squares in ((found.with_common(pairs.common_of_camera()), with_common), (found, without)):
            squares.append(apart @ np.linalg.solve(result.covariance, apart))
    assert 2 < np.mean(with_common) < 12
    assert np.mean(without) > 60


def test_columns_of_common_errors_are_read(tmp_path):
    """Of a table that measure wrote, joined with the robot's: they leave the pose's own covariance."""
    pairs, _ = _measured("eye-to-hand", 0)
    whole = pairs.camera_from_board_covariance + pairs.camera_common @ np.swapaxes(pairs.camera_common, 1, 2)
    rows, upper = [], np.triu_indices(6)
    for flange, board, square, errors in zip(
        pairs.base_from_flange, pairs.camera_from_board, whole, pairs.camera_common, strict=True
    ):
        rows.append(
            [*pose_cells(flange), *pose_cells(board), *map(repr, [*square[upper].tolist(), *errors.T.ravel().tolist()])]
        )
    board = "camera_from_board_"
    names = [f"base_from_flange_{c}" for c in POSE] + [f"{board}{c}" for c in (*POSE, *COVARIANCE, *common_columns(3))]
    (tmp_path / "poses.csv").write_text("\n".join(",".join(row) for row in [names, *rows]) + "\n")
    read = handeye.read_poses(tmp_path / "poses.csv")
    np.testing.assert_allclose(read.camera_common, pairs.camera_common, atol=1e-12)
    np.testing.assert_allclose(read.camera_from_board_covariance, pairs.camera_from_board_covariance, atol=1e-9)
    assert read[[0, 2]].camera_common.shape == (2, 6, 3)
