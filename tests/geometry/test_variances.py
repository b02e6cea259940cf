"""Variance components against closed forms: the balanced one-way analysis of variance, and one σ of least squares."""

import numpy as np
import pytest

from stcal.geometry.least_squares import NormalEquations
from stcal.geometry.variances import Parts, component_variances, sigma_factor

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


def test_parts_of_an_adjustment_give_the_variances_of_the_analysis(grouped):
    values, wanted = grouped
    present = np.array([0.3, 2.0])
    own = np.repeat(np.eye(GROUPS), EACH, axis=0)
    error = NormalEquations.of(-values.ravel() / present[0], np.column_stack([np.ones(values.size), own]) / present[0])
    group = NormalEquations.of(np.zeros(GROUPS), np.column_stack([np.zeros(GROUPS), np.eye(GROUPS)]) / present[1])
    none = NormalEquations(0.0, np.zeros((GROUPS + 1, GROUPS + 1)), np.zeros(GROUPS + 1))
    parts = Parts(NormalEquations.stacked([error, group]), np.array([values.size, GROUPS]), none)
    best = parts.best(np.full(2, -5.0), np.full(2, 5.0), [np.zeros(2), np.ones(2)])
    assert (present * np.exp(best)) ** 2 == pytest.approx(wanted, rel=1e-4)
    assert parts.at(best[None])[2][0, 0] == pytest.approx(values.mean(), rel=1e-9)


def test_the_gradient_is_that_of_the_density(grouped):
    values, _ = grouped
    design = np.random.default_rng(5).normal(size=(values.size, 3))
    first, second = (NormalEquations.of(values.ravel()[rows], design[rows]) for rows in (slice(20), slice(20, None)))
    parts = Parts(
        NormalEquations.stacked([first, second]), np.array([20, 40]), first, np.array([0.1, 0.2]), 0.7, 2.0, 1e-10
    )
    x, small = np.array([0.4, -0.3]), 1e-5 * np.eye(2)
    ahead, behind = parts.at(x + small)[0], parts.at(x - small)[0]
    assert parts.at(x[None])[1][0] == pytest.approx((ahead - behind) / 2e-5, rel=1e-6)


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
