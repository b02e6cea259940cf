"""λ from the board: least squares, and Zhang & Wei's rows with its erratum."""

import numpy as np
import pytest

from stcal.design import reference_board
from stcal.geometry.rigid import Rigid
from stcal.sfm.adjust.refine import find_scale
from stcal.sfm.data.group_model import WorldModel
from tests.outcome import fails_with

BOARD = reference_board()
WORLD_FROM_BOARD = Rigid.exp([0.4, -0.2, 0.9, 3.0, 1.0, 20.0])


def model_of(xyz_board, labels, mm_per_unit=25.0):
    xyz = (WORLD_FROM_BOARD @ xyz_board) / mm_per_unit
    none = np.zeros(0)
    return WorldModel(
        "g", (), (), tuple(labels), xyz, none, none, none, np.zeros((0, 2)), np.zeros((0, 2)), np.zeros((0, 2, 2))
    )


def board_xyz():
    return np.column_stack([BOARD.xy_mm(), np.zeros(63)])


@pytest.mark.parametrize("missing", [0, 5])
def test_both_scales_are_exact_without_noise_whichever_dots_are_missing(missing):
    keep = [i for i in range(63) if not missing or i % missing]
    scale = find_scale(model_of(board_xyz()[keep], [BOARD.labels()[i] for i in keep]), BOARD)
    assert scale.mm_per_unit == pytest.approx(25.0, rel=1e-12)
    # The mean over pairs, 2/(n(n−1)): the printed 1/(n−1)! would give a number near zero.
    assert scale.rows_mm_per_unit == pytest.approx(25.0, rel=1e-12)
    assert scale.rows == (0, 6)
    assert scale.rms_mm() < 1e-10


def test_rows_use_the_first_and_the_last_mapped_row_only():
    xyz = board_xyz()
    xyz[9:54] += np.random.default_rng(0).normal(0, 1, (45, 3))  # the rows between are far off
    scale = find_scale(model_of(xyz, BOARD.labels()), BOARD)
    assert scale.rows_mm_per_unit == pytest.approx(25.0, rel=1e-12)
    assert abs(scale.mm_per_unit / 25 - 1) > 1e-6


def test_residuals_and_the_spread_of_lambda_follow_the_boards_sigma():
    rng = np.random.default_rng(0)
    ratios, residuals = [], []
    for _ in range(300):
        scale = find_scale(model_of(board_xyz() + rng.normal(0, 0.005, (63, 3)), BOARD.labels()), BOARD)
        ratios.append((scale.mm_per_unit / 25 - 1) / (scale.sigma_mm_per_unit / scale.mm_per_unit))
        residuals.append(scale.rms_mm())
    assert 0.85 < np.std(ratios) < 1.15  # 300 draws: ± 4 %
    # 189 coordinates less 7 parameters: 5 µm · √3 · √(182/189).
    assert np.mean(residuals) == pytest.approx(0.0085, rel=0.03)


@pytest.mark.parametrize(("keep", "reason"), [(range(3), "E-SCALE-FEW-DOTS … 3 … 4"), (range(9), "E-SCALE-COLLINEAR")])
def test_too_little_of_the_board(keep, reason):
    labels = [BOARD.labels()[i] for i in keep]
    with fails_with(reason):
        find_scale(model_of(board_xyz()[list(keep)], labels), BOARD)
