"""An instrument that moves between two rows, or drifts along them: located, and not in sound or bent frames."""

import numpy as np
import pytest

from stcal.geometry.rigid import Rigid
from stcal.register import register
from stcal.register.consensus import MODELS, problem_of
from stcal.register.doubts import moved_meanwhile
from tests.outcome import fails_with

B_FROM_A = Rigid.exp([0.3, -0.4, 1.1, 2500.0, -300.0, 800.0])
MOVE = Rigid.exp([0, 1e-3, 0, 0.6, -0.8, 0])


def points(seed: int, n: int = 40, sigma: float = 0.05) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    a = rng.uniform(-500, 500, (n, 3))
    return a, B_FROM_A @ a + rng.normal(0, sigma, (n, 3))


def moved_from(row: int, b: np.ndarray, by: Rigid) -> np.ndarray:
    middle = b.mean(0)
    return np.concatenate([b[:row], by @ (b[row:] - middle) + middle])


@pytest.mark.parametrize("model", ["rigid", "similarity", "affine"])
@pytest.mark.parametrize("method", ["robust", "least-squares"])
def test_a_move_is_located_with_its_size(model, method):
    a, b = points(1)
    b = moved_from(25, b, MOVE)
    found = register(a, b, model=model, method=method, folds=0, lines=range(2, 42), allow_ambiguous=True)
    [note] = [note for note in found.notes if "stands elsewhere" in note]
    assert note.startswith("from line 27 on")
    size = float(note.split("by ")[1].split(" mm")[0])
    assert size == pytest.approx(1.0, rel=0.15)


def test_a_large_move_is_located_too_and_two_transforms_refused_with_the_row_between_them():
    a, b = points(2)
    with fails_with("E-REGISTER-TWO-TRANSFORMS … from row 26 on … separately"):
        register(a, moved_from(25, b, MOVE), folds=0)
    found = register(a, moved_from(26, b, Rigid.exp([0, 0, 0.01, 10, 0, 0])), folds=0, allow_ambiguous=True)
    assert any(note.startswith("from row 27 on") for note in found.notes)


def test_a_drift_is_told_from_a_jump():
    a, b = points(3)
    found = register(a, b + np.linspace(0, 1, len(b))[:, None] * [0.6, 0, -0.8], method="least-squares", folds=0)
    [note] = [note for note in found.notes if "drifts against the other along the rows, by " in note]
    assert float(note.split("by ")[1].split(" mm")[0]) == pytest.approx(1.0, rel=0.15)


def sound(seed: int) -> bool:
    a, b = points(seed, 20 + seed % 40)
    problem = problem_of(MODELS[("rigid", "similarity", "affine")[seed % 3]], a, b)
    return moved_meanwhile(problem, problem.fit()) is not None


@pytest.mark.parametrize(("sets", "most"), [(60, 4), pytest.param(3000, 45, marks=pytest.mark.full)])
def test_sound_points_do_not_move(sets, most):
    """1 % at most; of 60 five or more once in 2500 runs."""
    assert sum(map(sound, range(sets))) <= most


def test_a_bent_frame_in_the_order_of_its_rows_is_no_move():
    rng = np.random.default_rng(4)
    a = rng.uniform(-500, 500, (60, 3))
    a = a[np.argsort(a[:, 0])]
    b = B_FROM_A @ (a + 2e-6 * a[:, :1] ** 2 * [0, 0, 1.0]) + rng.normal(0, 0.02, a.shape)
    found = register(a, b, method="least-squares", folds=0)
    assert not any("stands elsewhere" in note or "drifts" in note for note in found.notes)
