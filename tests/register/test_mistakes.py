"""Mistakes that the data show: units, mirrored axes."""

import numpy as np
import pytest

from stcal.errors import InputError
from stcal.geometry.rigid import Rigid
from stcal.register import register
from stcal.register.doubts import mirrored_ratio
from tests.outcome import fails_with, refuses
from tests.support.point_pairs import scene


@pytest.mark.parametrize("method", ["robust", "least-squares"])
@pytest.mark.parametrize(("factor", "unit"), [(1000, "m"), (25.4, "inches"), (10, "cm")])
def test_another_unit_is_named(factor, unit, method):
    s = scene(0, 40, 0.3)
    with pytest.raises(InputError, match=rf"distances in b are [\d.]+ times those in a .*is a in {unit} "):
        register(s.xyz_a / factor, s.xyz_b, method=method)
    with pytest.raises(InputError, match=rf"distances in a are [\d.]+ times those in b .*is b in {unit} "):
        register(s.xyz_a, s.xyz_b / factor, method=method)


def test_a_similarity_takes_any_scale_and_tells_units():
    s = scene(1, 20)
    found = register(s.xyz_a / 25.4, s.xyz_b, model="similarity", folds=0)
    assert any("the scale is 25.4" in note and "is a in inches" in note for note in found.notes)
    assert not any("scale" in note for note in register(s.xyz_a, s.xyz_b, model="similarity", folds=0).notes)


@pytest.mark.parametrize(("share", "method"), [(0, "robust"), (0.35, "robust"), (0, "least-squares")])
def test_a_mirrored_frame_is_refused(share, method):
    for seed in range(3):
        s = scene(seed, 60, share)
        with fails_with("E-REGISTER-MIRRORED … 60"):
            register(s.xyz_a * [1, 1, -1], s.xyz_b, method=method)


@pytest.mark.parametrize(
    "mend", [np.diag([1.0, -1, 1]), np.diag([1.0, 1, -1]), np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, 1]])]
)
def test_any_mirrored_axis_is_refused(mend):
    s = scene(4, 30)
    a = s.xyz_a
    b = Rigid.exp([0.02, -0.01, 0.03, 5, 6, 7]) @ a + (s.xyz_b - s.b_from_a @ a)
    with fails_with("E-REGISTER-MIRRORED"):
        register(a @ mend.T, b)


@pytest.mark.slow
def test_planes_and_few_points_are_not_called_mirrored():
    for seed in range(40):
        s = scene([seed, 5], 5)
        register(s.xyz_a, s.xyz_b, folds=0)
        flat = s.xyz_a * [1, 1, 0]
        register(flat, s.b_from_a @ flat + (s.xyz_b - s.b_from_a @ s.xyz_a), folds=0)


def test_a_thin_bent_sheet_is_not_called_mirrored():
    """What is mirrored fits to noise; here one sign leaves half of the residuals of the other."""
    rng = np.random.default_rng(5)
    a = np.column_stack([rng.uniform(-100, 100, (200, 2)), rng.normal(0, 0.5, 200)])
    b = a * [1, 1, -0.3] + rng.normal(0, 0.1, a.shape)
    assert mirrored_ratio(a, b) > 1.5
    register(a, b, folds=0)


def test_an_affine_fit_tells_that_it_mirrors():
    s = scene(6, 30)
    found = register(s.xyz_a * [1, 1, -1], s.xyz_b, model="affine", folds=0)
    assert any("is a reflection" in note for note in found.notes)


def test_least_squares_tells_that_rows_are_far_off():
    s = scene(10, 40, 0.05)
    found = register(s.xyz_a, s.xyz_b, method="least-squares", folds=0)
    worst = int(np.linalg.norm(found.residuals, axis=1).argmax()) + 1
    assert any(f"the farthest row {worst} at" in note and "use the robust method" in note for note in found.notes)
    clean = scene(11, 40)
    assert register(clean.xyz_a, clean.xyz_b, method="least-squares", folds=0).notes == ()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"model": "projective"}, "E-OPTION-VALUE … 'projective' … rigid, similarity, affine"),
        ({"method": "magic"}, "E-OPTION-METHOD … 'magic' … robust"),
        ({"threshold_mm": -1}, "E-OPTION-RANGE … -1"),
        ({"method": "liu2017", "weights": np.ones(30)}, "E-REGISTER-WEIGHTS"),
    ],
)
def test_options_that_cannot_be(options, message):
    s = scene(12, 30)
    with fails_with(message):
        register(s.xyz_a, s.xyz_b, **options)


def test_points_that_cannot_be():
    s = scene(13, 30)
    refuses("E-ARRAY-SHAPE … (30, 3) … (29, 3)", register, s.xyz_a, s.xyz_b[1:])
    bad = s.xyz_b.copy()
    bad[5, 1] = np.nan
    refuses("E-ARRAY-NOT-FINITE … 6", register, s.xyz_a, bad)
    refuses("E-POINTS-FEW … 0 … 3", register, np.zeros((0, 3)), np.zeros((0, 3)))


def test_points_in_metres_are_doubted():
    s = scene(2, 20)
    said = "if lengths are metres"
    assert any(said in note for note in register(s.xyz_a / 1000, s.xyz_b / 1000, folds=0).notes)
    assert not any(said in note for note in register(s.xyz_a, s.xyz_b, folds=0).notes)
