"""The one descent: minima that are known, problems at once, and what is said where there is none."""

import numpy as np
import pytest

from stcal.geometry.least_squares import NormalEquations, minimise
from stcal.geometry.normal_equations import constrained_inverse, free_motions, generalised_inverse, reduce
from stcal.geometry.robust import huber_cost, huber_weights, length_limit, robust_sigma
from tests.outcome import fails_with


def rosenbrock(x: np.ndarray) -> NormalEquations:
    residual = np.array([10 * (x[1] - x[0] ** 2), 1 - x[0]])
    return NormalEquations.of(residual, np.array([[-20 * x[0], 10.0], [-1.0, 0.0]]))


def test_a_curved_valley_is_followed_to_its_end():
    found = minimise(np.array([-1.2, 1.0]), rosenbrock, np.add)
    assert found.converged
    assert found.state == pytest.approx([1, 1], abs=1e-6)
    assert 5 < found.steps < 100


def test_an_exponential_is_fitted_where_its_residuals_are_least():
    t = np.linspace(0, 2, 40)
    y = 3 * np.exp(-1.3 * t) + 0.05 * np.sin(40 * t)

    def linearise(p):
        model = p[0] * np.exp(-p[1] * t)
        return NormalEquations.of(model - y, np.column_stack([model / p[0], -t * model]))

    found = minimise(np.array([1.0, 0.1]), linearise, np.add).required("fit", "look")
    gradient = linearise(found.state).gradient
    assert np.abs(gradient).max() < 1e-6
    assert (
        linearise(found.state + np.array([1e-4, 0])).cost
        > found.linear.cost
        < linearise(found.state - np.array([1e-4, 0])).cost
    )


def test_what_nothing_determines_stays():
    found = minimise(np.array([5.0, 7.0]), lambda x: NormalEquations.of(x[:1] - 2, np.array([[1.0, 0.0]])), np.add)
    assert found.state == pytest.approx([2, 7], abs=1e-6)


def test_many_problems_end_where_each_would_alone():
    starts = np.array([[-1.2, 1.0], [2.0, 2.0], [0.0, 0.0]])

    def at_once(x):
        each = [rosenbrock(row) for row in x]
        return NormalEquations(*(np.array([getattr(e, k) for e in each]) for k in ("cost", "normal", "gradient")))

    def select(take, new, old):
        if isinstance(new, np.ndarray):
            return np.where(take[:, None], new, old)
        return NormalEquations(
            np.where(take, new.cost, old.cost),
            np.where(take[:, None, None], new.normal, old.normal),
            np.where(take[:, None], new.gradient, old.gradient),
        )

    found = minimise(starts, at_once, np.add, select=select)
    assert found.converged.all()
    assert found.state == pytest.approx(np.ones((3, 2)), abs=1e-6)


def test_where_there_is_no_minimum_it_says_so():
    """The cost falls for ever: e⁻ˣ."""
    found = minimise(
        np.zeros(1), lambda x: NormalEquations.of(1e3 * np.exp(-x), -1e3 * np.exp(-x)[:, None]), np.add, max_steps=5
    )
    assert not found.converged
    with fails_with("E-NO-MINIMUM … fit … 5 … look"):
        found.required("fit", "look")
    assert found.required("fit", "look", accepted=1e9) is found


def test_an_impossible_state_is_never_taken():
    def linearise(x):
        return NormalEquations.impossible(1) if x[0] <= 0.5 else NormalEquations.of(x - 0.1, np.ones((1, 1)))

    found = minimise(np.array([3.0]), linearise, np.add)
    assert found.state[0] > 0.5
    assert not found.converged


def test_reduced_equations_are_those_of_all_unknowns():
    rng = np.random.default_rng(3)
    jacobian, residual = rng.normal(size=(60, 3 * 4 + 5)), rng.normal(size=60)
    for i in range(3):  # blocks that do not meet
        jacobian[np.arange(60) % 3 != i, 4 * i : 4 * i + 4] = 0
    normal, right = jacobian.T @ jacobian, jacobian.T @ residual
    whole = np.linalg.solve(normal, right)
    block = np.array([normal[4 * i : 4 * i + 4, 4 * i : 4 * i + 4] for i in range(3)])
    away = reduce(block, right[:12].reshape(3, 4), normal[:12, 12:].reshape(3, 4, 5))
    kept = np.linalg.solve(normal[12:, 12:] - away.normal, right[12:] - away.right)
    assert kept == pytest.approx(whole[12:])
    assert away.back(kept).ravel() == pytest.approx(whole[:12])
    reduced_right = right[12:] - away.right
    assert away.gain + reduced_right @ kept == pytest.approx(right @ whole)


@pytest.mark.parametrize("scale", [False, True])
def test_inner_constraints_give_the_smallest_trace(scale):
    rng = np.random.default_rng(4)
    xyz = rng.normal(size=(6, 3))
    free = free_motions(xyz, scale)
    assert free.T @ free == pytest.approx(np.eye(6 + scale), abs=1e-12)
    away = np.eye(18) - free @ free.T
    root = rng.normal(size=(30, 18)) @ away
    normal = root.T @ root
    inverse = constrained_inverse(normal, free)
    assert inverse == pytest.approx(np.linalg.pinv(normal, rcond=1e-9), abs=1e-9)
    assert generalised_inverse(normal + free @ free.T) == pytest.approx(np.linalg.inv(normal + free @ free.T), abs=1e-8)


@pytest.mark.parametrize("coordinates", [1, 2, 3, 6])
def test_robust_sigma_is_sigma_of_normal_errors(coordinates):
    rng = np.random.default_rng(5)
    length = np.linalg.norm(0.7 * rng.normal(size=(200_000, coordinates)), axis=1)
    assert robust_sigma(length, coordinates) == pytest.approx(0.7, rel=0.01)  # 200 000 lengths: 0.3 %
    length[:60_000] += 1e6 * (rng.random(60_000) < 0.1)
    assert robust_sigma(length, coordinates) == pytest.approx(0.7, rel=0.06)
    beyond = (length > 0.7 * length_limit(coordinates, 0.05)).mean()
    assert 0.04 < beyond < 0.10


def test_hubers_loss_and_its_weight_belong_together():
    length = np.linspace(0.1, 9, 50)
    slope = (huber_cost(length + 1e-6, 3.0) - huber_cost(length - 1e-6, 3.0)) / 2e-6
    assert slope == pytest.approx(2 * huber_weights(length, 3.0) * length, rel=1e-6)
    assert (huber_weights(length, np.inf) == 1).all()
    assert huber_cost(length, np.inf) == pytest.approx(length**2)


@pytest.mark.parametrize("count", [1, 2, 7, 8])
def test_the_middle_of_few_lengths(count):
    """By which σ goes: of 1, 2, 3 … n it is (n + 1)/2; and one that is no number is not passed over."""
    lengths = np.random.default_rng(count).permutation(np.arange(1.0, count + 1))
    assert robust_sigma(lengths) * 0.6744897501960817 == pytest.approx((count + 1) / 2, rel=1e-12)
    assert np.isnan(robust_sigma(np.append(lengths, np.nan)))
