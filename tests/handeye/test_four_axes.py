"""Robots of four axes: all but one number is found, and that one is said."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stcal.geometry.rigid import Poses
from stcal.handeye import HandEyeOptions, HandEyePoses
from tests.outcome import fails_with
from tests.support.handeye import BASE_FROM_CAMERA, FLANGE_FROM_BOARD, disturbed, handeye


def scara(rng, count=12, setup="eye-to-hand", sigma=(5e-4, 0.1)):
    """A robot of four axes: its flange looks down and turns about the vertical only."""
    down = Rotation.from_euler("x", 180, degrees=True)
    about = Rotation.from_rotvec(np.column_stack([np.zeros((count, 2)), rng.uniform(-1.5, 1.5, count)]))
    place = rng.uniform([200, -200, 0], [500, 200, 100], (count, 3))
    flange = Poses((about * down).as_matrix(), place)
    board = BASE_FROM_CAMERA.inverse() @ (flange @ FLANGE_FROM_BOARD)
    return HandEyePoses(flange, disturbed(rng, board, *sigma))


def test_four_axes_give_all_but_one_number():
    """BASE_FROM_CAMERA but for its height, which is said; the chain still closes."""
    pairs = scara(np.random.default_rng(10))
    with fails_with("E-HANDEYE-AXES … 0 … 0 … 1 … 0° … 30 … --four-dof"):
        handeye(pairs, "eye-to-hand")
    found = handeye(pairs, "eye-to-hand", options=HandEyeOptions(four_dof=True))
    away = BASE_FROM_CAMERA.inverse() @ found.base_from_camera
    assert away.angle_rad() < 3e-3
    assert found.base_from_camera.translation[:2] == pytest.approx(BASE_FROM_CAMERA.translation[:2], abs=2)
    assert found.base_from_camera.translation[2] == pytest.approx(0, abs=1e-9)
    assert any("base_from_camera is not known along (0, 0, 1) of the base" in note for note in found.notes)
    assert found.rms()[1] < 0.3
    sigma = np.sqrt(np.diag(found.covariance))
    assert sigma[5] < 1e-5 < sigma[3] < 1
    with fails_with("E-HANDEYE-AXES … park-martin"):
        handeye(pairs, "eye-to-hand", "park-martin", options=HandEyeOptions(four_dof=True))


@pytest.mark.slow
def test_four_axes_are_true_to_their_covariance():
    """15 trials of the 5 numbers that are found: χ² of 75, once in a thousand beyond."""
    found = [
        handeye(scara(np.random.default_rng(s)), "eye-to-hand", options=HandEyeOptions(four_dof=True))
        for s in range(15)
    ]
    true = Poses.of([BASE_FROM_CAMERA])
    errors = np.array([Poses.of([f.base_from_camera]).difference(true)[0, :5] for f in found])
    squared = [e @ np.linalg.solve(f.covariance[:5, :5], e) for e, f in zip(errors, found, strict=True)]
    assert 0.76 < np.sqrt(np.mean(squared) / 5) < 1.24
