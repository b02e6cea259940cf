"""Every method on simulated poses with known truth."""

import numpy as np
import pytest

from stcal.handeye import METHODS, handeye
from stcal.handeye.simulated import simulated

FROM_POSES = tuple(m for m in METHODS if m != "reprojection")


@pytest.mark.parametrize("setup", ["eye-in-hand", "eye-to-hand"])
@pytest.mark.parametrize("method", FROM_POSES)
def test_exact_poses_give_the_truth(method, setup):
    truth = simulated(np.random.default_rng(3), 12, setup)
    found = handeye(truth.pairs, setup, method)
    for got, true in (
        (found.mount_from_camera, truth.mount_from_camera),
        (found.stand_from_board, truth.stand_from_board),
    ):
        off = true.inverse() @ got
        assert off.angle_rad() < 1e-9
        assert np.linalg.norm(off.translation) < 1e-6


@pytest.mark.parametrize("method", FROM_POSES)
def test_noisy_poses_give_about_the_truth(method):
    """σ of X is about that of a pose over its lever and √m: 0.3 mm, 1 mrad × 450 mm over √20 ≈ 0.2 mm; 4 is a blunder."""
    truth = simulated(np.random.default_rng(4), 20, robot=(2e-4, 0.1), camera=(1e-3, 0.3))
    off = truth.mount_from_camera.inverse() @ handeye(truth.pairs, method=method).mount_from_camera
    assert 1e-6 < off.angle_rad() < 5e-3
    assert 1e-3 < np.linalg.norm(off.translation) < 4
