"""The baseline of Liu et al. (2017), and that the robust method beats it."""

import numpy as np
import pytest

from stcal.register import Liu2017Options, register
from stcal.register.registration import affine_least_squares, liu2017
from tests.outcome import fails_with, refuses
from tests.support.point_pairs import scene


def test_twelve_parameters_are_the_normal_equations():
    s = scene(0, 20, sigma_mm=2)
    design = np.column_stack([s.xyz_a, np.ones(20)])
    by_hand = np.linalg.solve(design.T @ design, design.T @ s.xyz_b)  # eq. 6: (AᵀA)⁻¹AᵀB
    found = affine_least_squares(s.xyz_a, s.xyz_b)
    np.testing.assert_allclose(found.matrix()[:3].T, by_hand, rtol=1e-6, atol=1e-6)
    assert np.abs(found.linear.T @ found.linear - np.eye(3)).max() > 1e-4  # nothing makes it a rotation


def test_as_written():
    """Noise of 0.05 mm: the limit of 0.2 mm is 4 σ; 10 % of the points are wrong."""
    s = scene(1, 100, 0.1, sigma_mm=0.05)
    options = Liu2017Options(sample=12, limit_mm=0.2, share=0.8, tries=300)
    found = liu2017(s.xyz_a, s.xyz_b, options, seed=2)
    error = np.linalg.norm(s.xyz_b - found.transform @ s.xyz_a, axis=1)
    np.testing.assert_array_equal(found.inliers, error < 0.2)
    # of the acceptable samples that of the smallest variance, told by the points outside it
    rng, best, acceptable = np.random.default_rng(2), np.inf, 0
    for _ in range(options.tries):
        sample = rng.choice(100, 12, replace=False)
        one = affine_least_squares(s.xyz_a[sample], s.xyz_b[sample])
        off = np.delete(np.linalg.norm(s.xyz_b - one @ s.xyz_a, axis=1), sample)
        is_rotation = np.abs(one.linear.T @ one.linear - np.eye(3)).max() <= options.orthogonal_within
        if is_rotation and (off < 0.2).mean() > 0.8:
            acceptable += 1
            if off[off < 0.2].var() < best:
                best, winner = off[off < 0.2].var(), (one, sample)
    assert 0 < acceptable < 300
    assert s.clean[winner[1]].all()  # C(90, 12) / C(100, 12) = 26 % of the samples
    np.testing.assert_allclose(found.transform.matrix(), winner[0].matrix())


def test_in_register():
    s = scene(2, 100, 0.05, sigma_mm=0.05)
    options = Liu2017Options(sample=10, tries=100)
    found = register(s.xyz_a, s.xyz_b, method="liu2017", liu2017_options=options, folds=3)
    assert found.model == "affine"
    assert found.threshold_mm == 0.2
    assert found.covariance.shape == (12, 12)
    assert found.held_out.folds == 3
    assert found.held_out.of_all.max_mm > 2  # of the wrong points
    tight = register(s.xyz_a, s.xyz_b, method="liu2017", threshold_mm=0.3, folds=0)
    assert tight.threshold_mm == 0.3


def test_samples_of_thirty_never_find_a_clean_draw():
    """A third wrong: C(67, 30) / C(100, 30) is 1e-6. The robust method has its optimum there."""
    s = scene(3, 100, 0.33, off_mm=(5, 5))
    with fails_with("E-LIU-SAMPLE … 30 … 85"):
        register(s.xyz_a, s.xyz_b, method="liu2017", liu2017_options=Liu2017Options(tries=100))
    refuses("E-LIU-SAMPLE … 20 … 30", liu2017, s.xyz_a[:20], s.xyz_b[:20], Liu2017Options())
    refuses("E-LIU-SAMPLE … 3 … 3", liu2017, s.xyz_a, s.xyz_b, Liu2017Options(tries=20, orthogonal_within=1e-9))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sample": 3}, "E-LIU-OPTIONS … 3"),
        ({"share": 1.5}, "E-LIU-OPTIONS … 1.5"),
        ({"limit_mm": 0}, "E-LIU-OPTIONS … limit_mm … 0"),
        ({"tries": 0}, "E-LIU-OPTIONS … tries … 0"),
    ],
)
def test_options_that_cannot_be(options, message):
    with fails_with(message):
        Liu2017Options(**options)
