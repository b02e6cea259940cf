"""Scales of many rows at once, and limits of chance, against the plain ones."""

import numpy as np
import pytest
from scipy import stats

from stcal.geometry.robust import ratio_limit, robust_sigma, robust_sigmas


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
