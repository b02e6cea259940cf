"""Normal equations by kind, and σ of each kind: against all unknowns at once, and the one-way analysis of variance."""

from dataclasses import replace

import numpy as np
import pytest

from stcal.adjust import Adjustment, Vector
from stcal.adjust.blocks import Components, Equations, component_variances

GROUPS, EACH = 12, 5


def drawn() -> np.ndarray:
    rng = np.random.default_rng(3)
    return 7.0 + rng.normal(0, 0.8, (GROUPS, 1)) + rng.normal(0, 0.5, (GROUPS, EACH))


def analysis(eliminate: bool, sigma: dict[str, float]) -> Adjustment:
    """Values with errors of groups beside their own: the balanced one-way layout."""
    values = drawn().reshape(-1, 1)
    a, group = Adjustment(sigma=sigma), np.repeat(np.arange(GROUPS), EACH)
    mean, own = a.block("mean", Vector(np.zeros((1, 1)))), a.block("group", Vector(np.zeros((GROUPS, 1))), eliminate)
    a.factor(lambda m, g: m.array + g.array[group] - values, [(mean, None), (own, group)], kind="error")
    a.factor(lambda g: np.hstack([g.array, 0 * g.array]), [(own, np.arange(GROUPS))], kind=("between", "none"))
    return a


@pytest.fixture(scope="module")
def grouped():
    """Values (a, n) with errors of groups beside their own, and the closed-form REML variances of both: of errors the
    mean square within, of groups what the mean square between has more, by n (Searle, Casella & McCulloch 1992)."""
    values = drawn()
    middle = values.mean(1, keepdims=True)
    within = ((values - middle) ** 2).sum() / (GROUPS * (EACH - 1))
    between = EACH * ((middle - values.mean()) ** 2).sum() / (GROUPS - 1)
    return values, (within, (between - within) / EACH)


@pytest.mark.parametrize("eliminate", [True, False])
def test_each_kind_has_the_variance_of_the_analysis(grouped, eliminate):
    values, wanted = grouped
    present = {"error": 0.3, "between": 2.0}
    problem = analysis(eliminate, present)
    likelihood = problem.at({block.name: block.start for block in problem.blocks}).components(list(present))
    best = likelihood.best(np.full(2, -5.0), np.full(2, 5.0), [np.zeros(2), np.ones(2)])
    assert (np.array(list(present.values())) * np.exp(best)) ** 2 == pytest.approx(wanted, rel=1e-4)
    assert likelihood.at(best)[2][0] == pytest.approx(values.mean(), rel=1e-8)  # a share of 1e-10 is held


def test_what_is_eliminated_changes_neither_density_nor_gradient():
    x, small = np.array([0.4, -0.3]), 1e-5 * np.eye(2)
    both = []
    for eliminate in (True, False):
        problem = analysis(eliminate, {"error": 0.4, "between": 0.9})
        parts = problem.at({block.name: block.start for block in problem.blocks}).components(["error", "between"])
        both.append(replace(parts, expected=0.7, doubt=2.0, caution=np.array([0.1, 0.2])))
    (value, slope, _, _), (again, same, _, _) = (parts.at(x) for parts in both)
    assert value == pytest.approx(again, rel=1e-8)
    assert slope == pytest.approx(same, rel=1e-8)
    ahead, behind = ([both[0].at(x + sign * step)[0] for step in small] for sign in (1, -1))
    assert slope == pytest.approx((np.array(ahead) - behind) / 2e-5, rel=1e-6)


def test_kinds_tell_together_what_all_do():
    problem = analysis(True, {"error": 0.4, "between": 0.9})
    at = problem.at({block.name: block.start for block in problem.blocks})
    told = sum(at.equations((kind,)).told(at.reduction.from_kept) for kind in ("error", "between", "none"))
    assert told == pytest.approx(at.normal, rel=1e-9)


def test_equations_of_residuals_are_least_squares():
    design, seen = np.random.default_rng(1).normal(size=(2, 20, 3)) @ np.diag([1, 2, 3.0]), np.arange(20.0)
    own = Equations.of(seen, -design[0])
    _, _, step, covariance = Components([own], Equations.nothing(3)).at(np.zeros(1))
    assert step == pytest.approx(np.linalg.lstsq(design[0], seen, rcond=None)[0])
    assert covariance == pytest.approx(np.linalg.inv(design[0].T @ design[0]))


@pytest.mark.parametrize("bound", [0.0, 3.0])
def test_a_sum_of_components_gives_the_variances_of_the_analysis_within_bounds(grouped, bound):
    values, wanted = grouped
    free = np.broadcast_to(np.array([np.eye(EACH), np.ones((EACH, EACH))])[:, None], (2, GROUPS, EACH, EACH))
    least = np.array([1e-6, max(bound * wanted[1], 1e-6)])
    found = component_variances(
        values - 6.0,
        np.ones((GROUPS, EACH, 2)),  # the second column depends on the first
        np.zeros((GROUPS, EACH, EACH)),
        free,
        least.clip(1),
        (least, np.full(2, 1e3)),
    )
    assert found[0] == pytest.approx(wanted[0], rel=0.05 if bound else 1e-4)
    assert found[1] == pytest.approx(max(wanted[1], least[1]), rel=1e-6 if bound else 1e-4)
