"""Variance components against closed forms: the balanced one-way analysis of variance, and one σ of least squares."""

import numpy as np
import pytest

from stcal.geometry.variances import component_variances, sigma_factor

GROUPS, EACH = 12, 5


@pytest.fixture(scope="module")
def grouped():
    """Values (a, n) with errors of groups beside their own, and the closed-form REML variances of both: of errors the
    mean square within, of groups what the mean square between has more, by n (Searle, Casella & McCulloch 1992)."""
    rng = np.random.default_rng(3)
    values = 7.0 + rng.normal(0, 0.8, (GROUPS, 1)) + rng.normal(0, 0.5, (GROUPS, EACH))
    middle = values.mean(1, keepdims=True)
    within = ((values - middle) ** 2).sum() / (GROUPS * (EACH - 1))
    between = EACH * ((middle - values.mean()) ** 2).sum() / (GROUPS - 1)
    return values, (within, (between - within) / EACH)


def test_a_sum_of_components_gives_the_variances_of_the_analysis(grouped):
    values, wanted = grouped
    free = np.broadcast_to(np.array([np.eye(EACH), np.ones((EACH, EACH))])[:, None], (2, GROUPS, EACH, EACH))
    found = component_variances(
        values - 6.0,
        np.ones((GROUPS, EACH, 2)),  # the second column depends on the first
        np.zeros((GROUPS, EACH, EACH)),
        free,
        np.array([1.0, 1.0]),
        (np.full(2, 1e-6), np.full(2, 1e3)),
    )
    assert found == pytest.approx(wanted, rel=1e-4)


def test_a_component_stays_within_its_bounds(grouped):
    values, wanted = grouped
    free = np.broadcast_to(np.array([np.eye(EACH), np.ones((EACH, EACH))])[:, None], (2, GROUPS, EACH, EACH))
    least = np.array([1e-6, 3 * wanted[1]])
    found = component_variances(
        values - 6.0,
        np.ones((GROUPS, EACH, 1)),
        np.zeros((GROUPS, EACH, EACH)),
        free,
        least.clip(1),
        (least, np.full(2, 1e3)),
    )
    assert found[1] == pytest.approx(least[1])
    assert found[0] == pytest.approx(wanted[0], rel=0.05)


def test_one_sigma_is_that_of_least_squares():
    rng = np.random.default_rng(1)
    design, seen = rng.normal(size=(30, 4)), rng.normal(0, 3.0, 30)
    left = np.linalg.lstsq(design, seen, rcond=None)[1][0]
    assert 0.5 * sigma_factor(left / 0.5**2, 26) == pytest.approx(np.sqrt(left / 26))
