"""Rows shifted together by a few σ, too little for two transforms: said, and held by the σ; of clean rows never."""

import re

import numpy as np
import pytest

from stcal.geometry.rigid import Rigid
from stcal.register import register
from tests.scripts import load_script

B_FROM_A = Rigid.exp([0.3, -0.4, 1.1, 2500.0, -300.0, 800.0])
SHIFT = np.array([0.5, -0.3, 0.4])
SAID = "rows agree with each other on a shift of"


def pairs(seed: int, wrong: int, n: int = 100, sigma: float = 0.15):
    """Points of two instruments, the last ``wrong`` of them shifted."""
    rng = np.random.default_rng(seed)
    a = rng.uniform(-100, 100, (n, 3))
    b = B_FROM_A @ a + rng.normal(0, sigma, (n, 3))
    b[n - wrong :] += SHIFT
    return a, b


@pytest.mark.parametrize("method", ["robust", "least-squares"])
def test_rows_shifted_together_are_named_with_their_shift(method):
    """4.7 σ of 38 rows: the shift to four of its own σ, 0.15 √(1/38 + 1/62) = 0.03 mm; the groups overlap a little."""
    a, b = pairs(0, 38)
    found = register(a, b, method=method, folds=0)
    (note,) = [note for note in found.notes if SAID in note]
    count, others = int(note.split()[0]), int(re.search(r"other (\d+)", note)[1])
    assert count + others == found.inliers.sum() == 100
    assert 34 <= count <= 42
    by = np.array([float(v) for v in re.search(r"\((.*?)\) mm", note)[1].split(", ")])
    np.testing.assert_allclose(by, SHIFT, atol=0.12)
    assert "do not show which is right" in note
    assert "lie together" not in note
    rows = [int(v) for v in re.findall(r"row (\d+)", note)]
    assert sum(row > 62 for row in rows) >= 4  # of the five shown


def test_the_covariance_holds_either_group():
    """The truth is 0.27 mm off, where σ without the shift is 0.03 mm: ten σ by that; with the shift in it, one."""
    a, b = pairs(0, 38)
    found = register(a, b, folds=0)
    error = found.b_from_a.translation - B_FROM_A.translation
    size = error @ np.linalg.solve(found.covariance[3:, 3:], error)
    assert 0.05 < size < 9
    clean = register(*pairs(0, 0), folds=0)
    assert error @ np.linalg.solve(clean.covariance[3:, 3:], error) > 30


@pytest.mark.slow
@pytest.mark.parametrize("wrong", [0, 5])
def test_clean_rows_and_few_wrong_ones_are_not_two_groups(wrong):
    for seed in range(20):
        assert not any(SAID in note for note in register(*pairs(seed, wrong), folds=0).notes)


@pytest.mark.full
def test_study_of_two_groups(capsys):
    """Shifts of 0.7 mm at σ 0.15 mm: of 60 one at most is wrong in silence (1 of 600); of clean sets none is told."""
    study = load_script("two_groups_study")
    study.issue(30)
    study.clean(60)
    rows = [line.split()[-6:] for line in capsys.readouterr().out.splitlines()]
    counts = np.array(rows, int)
    assert counts[:, 0].tolist() == [30, 30, 60, 60]
    assert counts[:2, 4].sum() <= 1
    assert (counts[:2, 1] + counts[:2, 2]).min() >= 29
    assert counts[2:, 2:].sum() == 0


@pytest.mark.parametrize("off_mm", [0.0, 5.0])
@pytest.mark.parametrize(
    ("n", "model", "more"), [(3, "rigid", 3), (4, "rigid", 2), (4, "similarity", 2), (5, "affine", 2)]
)
def test_one_wrong_of_so_few_is_said_to_be_beyond_telling(n, model, more, off_mm):
    """Any but one of them fit: whichever was wrong, the same residuals."""
    a, b = pairs(1, 0, n, 0.05)
    b[1] += [0, 0, off_mm]
    found = register(a, b, model=model, method="least-squares", folds=0)
    said = f"of {n} points a wrong one cannot be identified: measure {more} more"
    assert said in found.notes
    assert said not in register(a, b, model=model, method="least-squares", folds=0, covariances=np.full(n, 50.0)).notes


def test_one_wrong_of_five_is_found():
    a, b = pairs(1, 0, 5, 0.05)
    b[1] += [0, 0, 5.0]
    found = register(a, b, folds=0)
    assert found.outliers.tolist() == [1]
    assert "of 4 points a wrong one cannot be identified: measure 2 more" in found.notes
