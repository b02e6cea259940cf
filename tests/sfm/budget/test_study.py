"""The budget against simulated calibrations: each input alone, and all together (scripts/studies/budget_study.py)."""

import numpy as np
import pytest
from scipy.stats import chi2

from tests.levels import sampled
from tests.scripts import load_script

study = load_script("budget_study")
pytestmark = pytest.mark.slow

CHANCE = 1e-5
"""On either side, of one measurand; there are some hundred."""
DRAWS = 15


@pytest.fixture(scope="module")
def fixed():
    case = study.case_of(False)
    return case, study.stated_by(case)


def rows_of(case, stated, which, draws):
    single = study.single_inputs(1, draws)
    return [study.errors(case, stated, which, single[i], i, stated.common) for i in range(draws)]


def source_of(stated, key):
    return next(each for each in stated.budget.sources if each.key == key)


@pytest.mark.parametrize(
    "which", sampled(["circle_centres", "dot_centres", "board_dots", "flatness", "intrinsics"], kept=(2,))
)
def test_errors_of_one_input_are_as_its_contribution_says(fixed, which):
    """eᵀC⁻¹e of positions, rotations and distances; the board's dots erring as the run takes them to. σ of the centres
    and σ₀ are estimated, to 2 %."""
    case, stated = fixed
    rows, source = rows_of(case, stated, which, DRAWS), source_of(stated, which)
    for k, (measurand, _) in enumerate(stated.budget.rows):
        error = np.array([each[k] for each in rows])
        covariance = measurand.unit**2 * measurand.covariance(source, 0.0)
        square = float(np.einsum("ni,ni->", error, np.linalg.solve(covariance, error.T).T))
        low, high = chi2.ppf([CHANCE, 1 - CHANCE], error.size) * [0.96, 1.04]
        assert low < square < high, (measurand.name, measurand.kind, square / error.size)


@pytest.mark.parametrize("which", sampled(study.SINGLE))
def test_a_change_of_scale_is_foretold(fixed, which):
    """Drawn stratified, so that the numbers themselves have their σ to 4 % with so few; second order is far less."""
    case, stated = fixed
    single = study.single_inputs(1, 8)
    rows = [study.errors(case, stated, which, single[i], i) for i in range(8)]
    own = float(np.sqrt((single[:, study.SINGLE.index(which)] ** 2).mean()))
    for k, (measurand, row) in enumerate(stated.budget.rows):
        if measurand.kind == "distance":
            spread = float(np.sqrt(np.mean([each[k] ** 2 for each in rows])))
            assert spread == pytest.approx(own * row.contributions[which], rel=0.03)
