"""σ and covariances: true to simulated truth, with cut-off residuals and with σ given."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stcal.register import register
from stcal.register.consensus import MODELS, problem_of, sigma_within
from tests.levels import sampled
from tests.outcome import fails_with
from tests.support.point_pairs import SIGMA_MM, make_scene, parameter_error

RIGID = MODELS["rigid"]


def calibration(trials: int, n: int, share=0.0, given=False, **options) -> float:
    """Mean of eᵀC⁻¹e/p over its expectation."""
    sizes = []
    for trial in range(trials):
        rng = np.random.default_rng([trial, n])
        s = make_scene(rng, n, share)
        b, stated = s.xyz_b, None
        if given:
            axes = Rotation.random(n, random_state=trial).as_matrix()
            root = axes * (np.array([0.02, 0.2, 0.2]) * rng.uniform(0.5, 2, (n, 1)))[:, None, :]
            noise = np.einsum("nij,nj->ni", root, rng.normal(size=(n, 3)))
            b = np.where(s.clean[:, None], s.b_from_a @ s.xyz_a + noise, b)
            stated = root @ np.swapaxes(root, 1, 2)
        found = register(s.xyz_a, b, covariances=stated, folds=0, **options)
        error = parameter_error(found.b_from_a, s.b_from_a)
        ν = found.redundancy
        of_sigma = (ν - 2) / ν if np.isfinite(ν) else 1  # E[σ²/s²] = ν/(ν − 2)
        sizes.append(error @ np.linalg.solve(found.covariance, error) / len(error) * of_sigma)
    return float(np.mean(sizes))


# χ²₆/6 has a standard deviation of 0.58; the mean of 60 trials one of 0.075, and 0.28 is nearly 4 of these.
@pytest.mark.parametrize(
    ("share", "options"),
    sampled(
        [
            (0.3, {}),
            (0, {}),
            (0.3, {"given": True}),
            (0, {"threshold_mm": 3 * SIGMA_MM}),
            (0, {"method": "least-squares"}),
        ]
    ),
)
def test_the_covariance_is_calibrated(share, options):
    assert calibration(60, 40, share, **options) == pytest.approx(1, abs=0.28)


def test_sigma_of_cut_off_residuals():
    r = np.random.default_rng(0).normal(0, 0.3, (200_000, 3))
    square = (r**2).sum(1)
    for threshold in (0.4, 0.6, 0.9, 3.0):
        near = square <= threshold**2
        found = sigma_within(square[near].sum(), RIGID, int(near.sum()), threshold)
        # within 1.3 σ only the curvature of the density tells σ: 1.5 % of 76 000 points
        assert found == pytest.approx(0.3, rel=0.04)


def test_given_sigma_stands_unless_contradicted():
    s = make_scene(np.random.default_rng(3), 50)
    true = register(s.xyz_a, s.xyz_b, covariances=np.full(50, SIGMA_MM**2), folds=0)
    assert not true.scaled
    assert true.redundancy == np.inf
    assert true.sigma_factor == pytest.approx(1, abs=0.25)  # 144 degrees of freedom: ± 6 %
    low = register(s.xyz_a, s.xyz_b, covariances=np.full(50, (SIGMA_MM / 5) ** 2), folds=0)
    assert low.scaled
    assert low.redundancy == 144
    assert low.sigma_factor == pytest.approx(5 * true.sigma_factor)
    assert any("residuals exceed the σ given" in note for note in low.notes)
    # scaled, it is what the residuals alone give
    plain = register(s.xyz_a, s.xyz_b, folds=0)
    np.testing.assert_allclose(low.covariance, plain.covariance, rtol=1e-9)
    # but for what is cut off at 5 σ
    np.testing.assert_allclose(true.covariance * true.sigma_factor**2, plain.covariance, rtol=1e-3)


def test_weights_have_no_unit():
    s = make_scene(np.random.default_rng(5), 30)
    weights = np.random.default_rng(6).uniform(0.5, 2, 30)
    one, two = (register(s.xyz_a, s.xyz_b, weights=w, folds=0) for w in (weights, 1000 * weights))
    np.testing.assert_allclose(one.covariance, two.covariance, rtol=1e-9)
    assert one.sigma_mm == pytest.approx(two.sigma_mm)
    assert one.sigma_factor is None


@pytest.mark.parametrize(
    ("weights", "covariances", "message"),
    [
        (np.ones(4), np.ones(4), "E-REGISTER-WEIGHTS"),
        (np.ones(3), None, "E-ARRAY-SHAPE … weights … (3,) … 4"),
        (None, np.ones((4, 3)), "E-ARRAY-SHAPE … covariances … (4, 3)"),
        ([1, 1, 0, 1], None, "E-REGISTER-WEIGHTS … weights … 3 … 0"),
        (None, [1, np.nan, 1, 1], "E-REGISTER-WEIGHTS … covariances … row 2 has nan"),
        (None, np.tile(np.diag([1, 1, -1.0]), (4, 1, 1)), "E-REGISTER-WEIGHTS … covariances … 1 … 1"),
    ],
)
def test_noise_that_cannot_be(weights, covariances, message):
    with fails_with(message):
        problem_of(RIGID, np.zeros((4, 3)), np.zeros((4, 3)), weights, covariances)
