"""Cross-validation: errors of points that had no part in the fit."""

import numpy as np
import pytest

from stcal.errors import DegenerateError
from stcal.geometry.rigid import align_rigid
from stcal.register import register
from stcal.register.consensus import MODELS, problem_of
from stcal.register.registered import held_out
from tests.support.point_pairs import scene


def test_leave_one_out_is_what_it_says():
    s = scene(0, 7)
    problem = problem_of(MODELS["rigid"], s.xyz_a, s.xyz_b)
    found = held_out(problem, lambda rows: problem[rows].fit(), s.clean, 7, 0)
    for i, error in zip(found.rows, found.error_mm, strict=True):
        rest = np.arange(7) != i
        expected = np.linalg.norm(s.xyz_b[i] - align_rigid(s.xyz_b[rest], s.xyz_a[rest]) @ s.xyz_a[i])
        assert error == pytest.approx(expected)
    assert found.rows.tolist() == list(range(7))
    figures = (found.of_all.mean_mm, found.of_all.rms_mm, found.of_all.max_mm)
    assert figures == pytest.approx((found.error_mm.mean(), np.sqrt((found.error_mm**2).mean()), max(found.error_mm)))


def test_no_folds_and_too_few_points():
    s = scene(2, 12)
    assert register(s.xyz_a, s.xyz_b, folds=0).held_out is None
    assert register(s.xyz_a[:4], s.xyz_b[:4], folds=4).held_out is None
    assert register(s.xyz_a, s.xyz_b, folds=50).held_out.folds == 12


def test_a_fold_that_cannot_be_fitted_is_left_out():
    s = scene(3, 12)
    problem = problem_of(MODELS["rigid"], s.xyz_a, s.xyz_b)

    def sometimes(rows):
        if 0 not in rows:
            raise DegenerateError("E-TEST", "without the first")
        return problem[rows].fit()

    found = held_out(problem, sometimes, s.clean, 4, 0)
    assert found.folds == 3
    assert len(found.rows) == 9
    assert 0 not in found.rows
