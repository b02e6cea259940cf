"""Held-out errors and the comparison of methods; robots of four axes, of which all but one number is found."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stcal.geometry.rigid import Poses, Rigid
from stcal.handeye import (
    HandEyeOptions,
    HandEyePoses,
    HeldOutPoses,
    Noise,
    compare,
    cross_validate,
    motion_errors,
    predict_motions,
    splits,
)
from stcal.handeye.data.pose_pairs import SETUPS, Loop, Motions
from stcal.handeye.handeye_problem import HandEyeProblem
from stcal.handeye.validate import ERRORS, errors_of
from tests.outcome import fails_with, refuses
from tests.support.handeye import (
    BASE_FROM_CAMERA,
    FLANGE_FROM_BOARD,
    disturbed,
    handeye,
    simulated,
    simulated_views,
)


def test_splits_hold_out_a_quarter_and_of_nothing_but_outliers_there_is_no_mean():
    assert (splits(12, 3, 8) == splits(12, None, 8)).all()
    assert splits(4).shape == (15, 1)
    refuses("E-HELD-OUT-FEW … 5 … 7 … 2 … 3", splits, 7, 5)
    for held_out in (0, -1):
        refuses(f"E-OPTION-RANGE … held_out {held_out}: 1 or more needed", splits, 10, held_out)
    held = HeldOutPoses(np.array([[0], [1]]), np.array([[1.0], [2.0]]), np.array([[3.0], [4.0]]))
    assert held.means(np.array([False, True]))["translation_mm"] == 4
    for outliers, agreeing in (([True, True], None), ([False, False], None), ([True, False], {"rotation_rad": 2.0})):
        found = held.summary(np.array(outliers))["agreeing"]
        assert found is None if agreeing is None else agreeing.items() <= found.items()


@pytest.mark.parametrize("setup", SETUPS)
def test_held_out_errors_are_those_of_the_poses(setup):
    """Of many poses X is well known, and what is left is the noise of a pose: a length of 3 coordinates, √(8/π) σ in
    the mean. 48 values scatter by 0.42/√48 = 6 %; X adds 12/60 of the variance at most."""
    truth = simulated(np.random.default_rng(1), 60, setup, camera=(1e-3, 0.3))
    means = cross_validate(truth.pairs, setup, "pose", rows=splits(60, 12, 4)).means()
    assert means == pytest.approx(
        {"rotation_rad": np.sqrt(8 / np.pi) * 1e-3, "translation_mm": np.sqrt(8 / np.pi) * 0.3}, rel=0.2
    )


def test_errors_at_the_board():
    """A chain 1 mm off across the line of sight is 1 mm off at the board by both measures; along it, by one only."""
    truth = simulated_views(np.random.default_rng(2), 6, "eye-to-hand")
    exact = handeye(truth.pairs, "eye-to-hand", views=truth.views, options=HandEyeOptions(noise=Noise(board_mm=0)))
    seen = HandEyeProblem(truth.pairs, "eye-to-hand", truth.views)[np.array([0])]
    assert [errors_of(exact, seen)[name].item() < 1e-3 for name in ERRORS] == [True] * 4
    for shift, on_board in (([1.0, 0, 0], 1.0), ([0, 0, 1.0], 0.0)):
        moved = exact.mount_from_camera @ Rigid(np.eye(3), shift)
        errors = errors_of(replace(exact, mount_from_camera=moved), seen)
        _, distance, board, pose = (errors[name].item() for name in ERRORS)
        assert distance == pytest.approx(1, abs=1e-2)
        assert pose == pytest.approx(1, abs=1e-2)
        # The board is tilted by up to 29° and seen up to 20° off the axis.
        assert board == pytest.approx(on_board, abs=0.6)


@pytest.mark.full
def test_solutions_of_parts_scatter_as_sigma_says():
    """40 splits of 20 poses: six numbers each, of which 20/5 · 6 are independent, so that one set's ratio scatters by
    1/√(2·24) = 14 %, the mean of eight by 5 %; three times that. σ that are three times too small are put right."""
    ratios = []
    for seed in range(8):
        truth = simulated(np.random.default_rng(seed), 20, robot=(5e-4, 0.2), camera=(5e-4, 0.2))
        found = handeye(truth.pairs, truth.setup)
        held_out = cross_validate(truth.pairs, truth.setup, rows=splits(20, 5, 40))
        ratios.append(held_out.scatter(found))
        sure = replace(found, covariance=found.covariance / 9)
        wide = held_out.widened(sure)
        assert np.allclose(wide.covariance, ratios[-1] ** 2 * found.covariance)
        assert any("solutions of parts of the poses scatter" in note for note in wide.notes)
    assert np.mean(ratios) == pytest.approx(1, abs=0.15)
    assert np.isnan(held_out.scatter(handeye(truth.pairs, truth.setup, "li")))


def test_a_method_that_fails_says_why():
    truth = simulated(np.random.default_rng(4), 12, camera=(1e-3, 0.3))
    scale = compare(truth.pairs, rows=splits(12, 3, 2), methods=("pose", "li"), options=HandEyeOptions(with_scale=True))
    assert [c.reason for c in scale] == ["", ""]
    pairs, options = scara(np.random.default_rng(4), sigma=(0, 0)), HandEyeOptions(four_dof=True)
    found = compare(pairs, "eye-to-hand", options=options, rows=splits(12, 3, 4))
    by = {c.method: c for c in found}
    assert by["pose"].held_out.means()["translation_mm"] < 1e-3
    assert by["shah"].result is None
    assert "needs turns about two axes" in by["shah"].reason
    with fails_with("E-HANDEYE-FEW-POSES … 3"):  # a split that cannot be solved
        cross_validate(truth.pairs, rows=np.arange(2, 12)[None])


def test_the_last_motions_are_predicted_by_those_before():
    """Exact poses: exactly. A mount 1 mm off across a motion's axis turns with it: Â is off by 2 sin(½ angle) mm."""
    truth = simulated(np.random.default_rng(4), 9, "eye-in-hand", robot=(1e-9, 1e-9), camera=(1e-9, 1e-9))
    found = predict_motions(truth.pairs, "eye-in-hand", "pose", count=3)
    names = truth.pairs.names
    assert found.fitted == 5
    assert found.names == tuple((names[i], names[i + 1]) for i in (5, 6, 7))
    assert found.translation_mm.max() < 1e-5
    motions = Motions.consecutive(Loop.of(truth.pairs, "eye-in-hand"))
    axis = motions.alpha / np.linalg.norm(motions.alpha, axis=1, keepdims=True)
    across = np.cross(axis[0], [0.3, -0.5, 0.8])
    across /= np.linalg.norm(across)
    off = Rigid(np.eye(3), across) @ truth.mount_from_camera
    expected = 2 * np.sin(np.linalg.norm(motions.alpha[0]) / 2)
    assert motion_errors(off, motions)[0] == pytest.approx([0, expected], abs=1e-5)
    with fails_with("E-OPTION-RANGE … --motions-held-out … 7 … 8 … 6"):
        predict_motions(truth.pairs, count=7)


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
    refuses("E-HANDEYE-AXES … 0 … 0 … 1 … 0° … 30 … --four-dof", handeye, pairs, "eye-to-hand")
    found = handeye(pairs, "eye-to-hand", options=HandEyeOptions(four_dof=True))
    away = BASE_FROM_CAMERA.inverse() @ found.base_from_camera
    assert away.angle_rad() < 3e-3
    assert found.base_from_camera.translation[:2] == pytest.approx(BASE_FROM_CAMERA.translation[:2], abs=2)
    assert found.base_from_camera.translation[2] == pytest.approx(0, abs=1e-9)
    assert any("base_from_camera is not known along (0, 0, 1) of the base" in note for note in found.notes)
    assert found.rms()[1] < 0.3
    sigma = np.sqrt(np.diag(found.covariance))
    assert sigma[5] < 1e-5 < sigma[3] < 1
    options = HandEyeOptions(four_dof=True)
    refuses("E-HANDEYE-AXES … park-martin", handeye, pairs, "eye-to-hand", "park-martin", options=options)


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
