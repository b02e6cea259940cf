"""The problem of an arm: its minimum, its weights, and its variance components against closed forms of the textbook."""

from dataclasses import replace

import numpy as np
import pytest

from stcal.adjust.blocks import Components, Equations
from stcal.geometry.rigid import Rigid
from stcal.robot.identification import problem
from stcal.robot.identification.adjustment import Weighting, jacobian, moved, observed, residuals
from stcal.robot.identification.identify import identify
from stcal.robot.identification.problem import MOST_BENT, ArmProblem, Bent, Spread, huber_limit, relaxed
from stcal.robot.identification.result import IdentifyOptions
from stcal.robot.kinematics.robot_model import mh80
from stcal.robot.simulated import joint_vectors, made, measured, placed
from tests.outcome import fails_with

WEIGHTING = Weighting(0.05, 2e-4)


@pytest.fixture(scope="module")
def case():
    """A state far from what the instrument sees of a made arm, and what it sees: 40 poses, one with a gross error."""
    rng = np.random.default_rng(3)
    true = placed(
        made(mh80(), rng), Rigid.exp([0.1, 0.2, -0.3, 900, 800, 700]), {"": Rigid.exp([0, 0, 0.4, 50, 0, 150])}
    )
    data = measured(true, joint_vectors(true, 40, rng), rng, 0.05, 2e-4, [""] * 40)
    positions = data.positions.copy()
    positions[7] += [3.0, 0, 0]
    data = replace(data, positions=positions)
    start = identify(mh80(), data, IdentifyOptions(folds=0, robust=False)).state
    return start, observed(data)


def test_it_ends_where_the_weighted_gradient_is_zero(case):
    """In units of its own σ, and of Huber's cost: weight times residual."""
    state, seen = case
    found = ArmProblem(seen, WEIGHTING).solve(state)
    white = WEIGHTING.whiten(residuals(found.state, seen), seen)
    slope = WEIGHTING.whiten(jacobian(found.state, seen), seen)
    length = np.linalg.norm(white, axis=1)
    limit = huber_limit(seen.kind)
    assert found.weights == pytest.approx(np.minimum(1, limit / length))
    assert found.weights[7] == found.weights.min() < 0.2
    gradient = np.einsum("r,ri,rik->k", found.weights, white, slope)
    sigma = np.sqrt(np.diag(np.linalg.inv(found.equations.normal)))
    assert np.abs(gradient * sigma).max() < 1e-2


def test_the_normal_matrix_is_that_of_whitened_derivatives(case):
    state, seen = case
    found = ArmProblem(seen, WEIGHTING, robust=False).solve(state)
    slope = WEIGHTING.whiten(jacobian(found.state, seen), seen).reshape(-1, len(found.units))
    scaled = found.units * slope
    np.testing.assert_allclose(
        found.equations.normal * np.outer(found.units, found.units), scaled.T @ scaled, rtol=1e-9, atol=1e-3
    )
    assert found.rank() == len(found.units)
    assert (found.weights == 1).all()


def test_what_is_common_to_all_observations_is_whitened_too():
    """Values with covariance Σ = own + F Fᵀ become independent, of σ 1: the whitened Σ is the identity."""
    rng = np.random.default_rng(0)
    data = measured(mh80(), joint_vectors(mh80(), 5, rng), rng, 0.05, 2e-4, [""] * 5)
    root = rng.normal(size=(5, 6, 6)) + 3 * np.eye(6)
    own, common = root @ np.swapaxes(root, 1, 2), rng.normal(size=(5, 6, 2))
    data = replace(data, covariance=own + common @ np.swapaxes(common, 1, 2), common=common)
    seen = observed(data)
    white = Weighting(1.0, 1.0, given=True).whiten(np.eye(30).reshape(5, 6, 30), seen).reshape(30, 30)
    full = np.zeros((30, 30))
    for i in range(5):
        full[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] = own[i]
    flat = common.reshape(30, 2)
    np.testing.assert_allclose(white @ (full + flat @ flat.T) @ white.T, np.eye(30), atol=1e-9)
    values = rng.normal(size=(5, 6))  # and half the derivative of their squares is the inverse of Σ times them
    pull = Weighting(1.0, 1.0, given=True).pull(Weighting(1.0, 1.0, given=True).whiten(values, seen), seen)
    np.testing.assert_allclose((full + flat @ flat.T) @ pull.ravel(), values.ravel(), atol=1e-9)


def test_no_minimum_within_the_steps_is_an_error(case, monkeypatch):
    state, seen = case
    monkeypatch.setattr(problem, "MAX_STEPS", 1)
    count = jacobian(state, seen).shape[2]
    far = moved(state, np.full(count, 0.05), seen.kind)
    with fails_with("E-NO-MINIMUM … identification … 1"):
        ArmProblem(seen, WEIGHTING).solve(far)


def regression(
    rng: np.random.Generator, rows: int, width: int = 4, groups: int = 0, sigma: float = 1.0, tau: float = 1.0
):
    """A linear model of ``width`` parameters, the last ``groups`` of them drawn with ``tau`` about 0; about zero."""
    design = rng.normal(size=(rows, width))
    drawn = rng.normal(size=width) * tau * (np.arange(width) >= width - groups)
    seen = design @ drawn + rng.normal(size=rows) * sigma
    each, doubt = [Equations.of(seen, -design)], [np.inf]
    if groups:
        mine = np.diag((np.arange(width) >= width - groups).astype(float))
        each, doubt = [*each, replace(Equations.of(np.zeros(width), mine), count=groups)], [np.inf, 1.0]
    fixed = Equations.of(np.zeros(width), 1e-6 * np.eye(width))
    far = np.full(len(each), 3.0)
    return Spread(Components(each, fixed, 0.0, np.array(doubt)), -far, far, np.ones(width)), design, seen, drawn


@pytest.mark.parametrize("rows", [14, 24, 104])
def test_one_sigma_is_that_of_least_squares_and_the_covariance_that_of_t(rows):
    parts, design, seen, _ = regression(np.random.default_rng(rows), rows)
    freedom = rows - 4
    left = np.linalg.lstsq(design, seen, rcond=None)[1][0]
    best = parts.best()
    assert np.exp(2 * best[0]) == pytest.approx(left / freedom, rel=1e-6)
    wanted = left / (freedom - 2) * np.linalg.inv(design.T @ design)  # of a t distribution with so many degrees
    # three nodes are exact to the fourth order of the spread of log σ, 1 / √(2 · freedom)
    assert parts.covariance(best) == pytest.approx(wanted, rel=3 / freedom**2 + 1e-3)


@pytest.mark.slow
def test_of_several_parts_the_covariance_is_true_on_average():
    error = []
    for seed in range(400):
        parts, _, _, drawn = regression(np.random.default_rng(seed), 30, 10, 6, 1.0, 0.6)
        best = parts.best()
        step = parts.parts.at(best)[2]
        away = step - drawn
        error.append(away @ np.linalg.solve(parts.covariance(best), away) / 10)
    # With the σ taken for known it is 1.18. Three standard errors of the mean of 400 draws:
    assert np.mean(error) == pytest.approx(1, abs=0.1)


@pytest.mark.parametrize("slope", [-2.5, -0.5, 0.9])
def test_steps_that_overshoot_are_shortened(slope):
    """Of an iteration x → slope · x the first wanted step is (slope - 1) x; at -2.5 whole steps lead away for ever."""
    x, last, share = np.array([1.0, -2.0]), np.zeros(2), 1.0
    for _ in range(30):
        wanted = (slope - 1) * x
        last, share = wanted, relaxed(wanted, last, share)
        x = x + share * wanted
    assert np.abs(x).max() < 0.1 * max(slope, 0) ** 30 * 20 + 1e-6


def test_second_derivatives_leave_a_minimum():
    """They are as they are where they take little, and are cut off where they would make a saddle."""
    root = np.random.default_rng(0).normal(size=(4, 4)) * [1, 10, 100, 1000]
    normal, share = root @ root.T, np.array([-1.0, 0.1, 0.5, 2.0])
    little = (root * np.minimum(share, 0.5)) @ root.T
    assert Bent.of(normal, little).taken() == pytest.approx(little, rel=1e-6)
    bent = Bent.of(normal, (root * share) @ root.T)
    left = (root * [2.0, 0.9, 0.5, 1 - MOST_BENT]) @ root.T
    assert normal - bent.taken() == pytest.approx(left, rel=1e-6)
    assert bent.bends().T @ normal @ bent.bends() == pytest.approx(left, rel=1e-6)
