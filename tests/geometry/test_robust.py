"""Scales of many rows at once, and limits of chance, against the plain ones."""

import numpy as np
import pytest
from scipy import stats

from stcal.geometry.robust import ratio_limit, robust_sigma, robust_sigmas, tailed_limit


def test_rows_have_the_scale_that_each_has_alone():
    rng = np.random.default_rng(1)
    length, among = np.abs(rng.standard_normal((40, 31))), rng.random((40, 31)) < 0.6
    among[3], among[4] = False, np.arange(31) == 7
    found = robust_sigmas(length, among)
    assert np.isnan(found[3])
    for k in (i for i in range(40) if i != 3):
        assert found[k] == pytest.approx(robust_sigma(length[k, among[k]]), rel=1e-12)


@pytest.mark.parametrize("redundancy", [2.0, 7.5, 300.0, 1e9])
@pytest.mark.parametrize("beyond", [0.3, 1e-3, 1e-9])
def test_a_ratio_is_beyond_its_limit_as_seldom_as_said(beyond, redundancy):
    assert stats.f.sf(ratio_limit(beyond, 3, redundancy), 3, redundancy) == pytest.approx(beyond, rel=1e-6)


@pytest.mark.parametrize(("freedom", "least"), [(np.inf, 4.4), (8, 8.0), (4, 15.0)])
def test_the_limit_of_lengths_follows_their_tail(freedom, least):
    """Sound lengths beyond the limit are rare, 0.01 in a sample; gross ones do not move it much.

    ``least`` : the quantile of Student's distribution, of 0.01 / 200."""
    rng, count, draws = np.random.default_rng(3), 200, 200
    beyond, limits, spoiled = 0, [], []
    for _ in range(draws):
        shrunk = 1.0 if np.isinf(freedom) else np.sqrt(rng.chisquare(freedom, (count, 1)) / freedom)
        length = np.linalg.norm(rng.normal(size=(count, 2)) / shrunk, axis=1)
        limits.append(tailed_limit(length, 0.01 / count))
        beyond += int((length > limits[-1]).sum())
        spoiled.append(tailed_limit(np.append(length, [60.0, 200.0]), 0.01 / count))
    assert beyond <= 8  # 2 expected where the tail was known
    assert np.median(spoiled) < 1.5 * np.median(limits)
    assert least * 0.8 < np.median(limits) < 3 * least
