"""Lines, planes and symmetric layouts: refused, or told, with what was measured."""

import numpy as np
import pytest

from stcal.geometry.rigid import Rigid
from stcal.register import register
from stcal.register.consensus import MODELS
from stcal.register.doubts import WIDER_THAN, single_supports, spreads, symmetry
from tests.outcome import fails_with, refuses

B_FROM_A = Rigid.exp([0.2, -0.7, 1.0, 500, 100, -900])
SIGMA = 0.1


def seen(xyz_a, seed=0, sigma=SIGMA):
    return B_FROM_A @ xyz_a + np.random.default_rng(seed).normal(0, sigma, np.shape(xyz_a))


def along_a_line(n: int, off: float, seed=0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-200, 200, n), rng.normal(0, off, (n, 2))])


@pytest.mark.parametrize("method", ["robust", "least-squares"])
def test_a_line_is_refused(method):
    a = along_a_line(20, 0.02)
    refuses("E-POINTS-COLLINEAR … 20", register, a, seen(a), method=method)
    refuses("E-POINTS-COLLINEAR", register, a * [1, 0, 0], seen(a * [1, 0, 0]), method=method)


def test_a_plane_is_solved_rigidly_and_refused_affinely():
    a = np.random.default_rng(1).uniform(-100, 100, (25, 3)) * [1, 1, 0]
    found = register(a, seen(a), folds=0)
    assert found.inliers.all()
    assert any("in a plane" in note for note in found.notes)
    for method in ("robust", "least-squares"):
        refuses("E-POINTS-COPLANAR", register, a, seen(a), model="affine", method=method)
    thin = a + np.random.default_rng(2).normal(0, 0.05, a.shape)
    refuses("E-POINTS-COPLANAR … 25", register, thin, seen(thin), model="affine")


def test_one_point_off_a_line_is_named_and_outliers_cannot_turn_it():
    """Any one wrong point off the line fits exactly, and would set the turn about it."""
    a = np.vstack([along_a_line(12, 0.0), [[0, 80, 0]]])
    found = register(a, seen(a), folds=0, lines=range(2, 15))
    assert any("only line 14 keeps the points off a line" in note for note in found.notes)
    two = np.vstack([a, [[50, 60, 10]]])
    assert not any("keeps the points off" in note for note in register(two, seen(two), folds=0).notes)
    a = np.vstack([along_a_line(20, 0.02), np.random.default_rng(5).uniform(-100, 100, (4, 3))])
    b = seen(a)
    b[20:] += np.random.default_rng(6).uniform(-60, 60, (4, 3))
    with fails_with("E-POINTS-COLLINEAR"):
        register(a, b, folds=0)


def test_one_point_off_a_plane_is_named_for_the_affine_model():
    flat = np.random.default_rng(3).uniform(-100, 100, (12, 3)) * [1, 1, 0]
    a = np.vstack([flat, [[0, 0, 90]]])
    assert single_supports(MODELS["affine"], a, 0.1).tolist() == [12]
    assert single_supports(MODELS["rigid"], a, 0.1).tolist() == []
    found = register(a, seen(a), model="affine", method="least-squares", folds=0)
    assert any("only row 13 keeps the points off a plane" in note for note in found.notes)


SQUARE = np.array([[100.0, 0, 0], [0, 100, 0], [-100, 0, 0], [0, -100, 0]])


def test_a_symmetric_layout_is_told():
    found = register(SQUARE, seen(SQUARE), folds=0)
    [note] = [n for n in found.notes if "symmetric" in n]
    assert "maps it onto itself (row" in note
    # labels exchanged by such a turn fit as well
    angle, to = symmetry(SQUARE, 0.5)
    turned = register(SQUARE, seen(SQUARE)[to], folds=0)
    assert turned.inlier_errors.rms_mm < 4 * SIGMA
    assert np.degrees(angle) == pytest.approx(90, abs=1) or np.degrees(angle) == pytest.approx(180, abs=1)


@pytest.mark.parametrize("model", ["rigid", "affine"])
@pytest.mark.parametrize("width", [0.4, 0.6])
def test_supports_are_those_of_leaving_out_one_after_the_other(model, width):
    """Most points are passed over, as none alone could matter: the others must be the right ones."""
    rng = np.random.default_rng(round(10 * width))
    found = 0
    for _ in range(60):
        xyz = rng.normal(size=(12, 3)) * ([100, width, width / 2] if model == "rigid" else [100, 100, width])
        xyz[rng.integers(12)] += [0, 5 * rng.random(), 5 * rng.random()]
        values = [spreads(np.delete(xyz, i, axis=0)) for i in range(len(xyz))]
        off = [value[2] if model == "affine" else np.hypot(value[1], value[2]) for value in values]
        alone = single_supports(MODELS[model], xyz, 0.2)
        assert alone.tolist() == np.flatnonzero(np.array(off) < WIDER_THAN * 0.2).tolist()
        found += len(alone)
    assert 20 < found < 480  # some alone, not all
