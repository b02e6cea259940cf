"""The problem of an arm: its minimum, its weights, and its variance components against closed forms of the textbook."""

from dataclasses import replace

import numpy as np
import pytest

from stcal.adjust.blocks import Components, Equations
from stcal.robot.identification import problem
from stcal.robot.identification.adjustment import Weighting, observed
from stcal.robot.identification.identify import identify
from stcal.robot.identification.problem import ArmProblem, Spread, huber_limit
from stcal.robot.identification.result import IdentifyOptions
from stcal.robot.kinematics.robot_model import mh80
from stcal.robot.simulated import joint_vectors, measured
from tests.outcome import refuses
from tests.support.arms import seen_arm

WEIGHTING = Weighting(0.05, 2e-4)


@pytest.fixture(scope="module")
def case():
    """A state far from what the instrument sees of a made arm, and what it sees: 40 poses, one with a gross error."""
    _, data = seen_arm(np.random.default_rng(3), 40)
    positions = data.positions.copy()
    positions[7] += [3.0, 0, 0]
    data = replace(data, positions=positions)
    start = identify(mh80(), data, IdentifyOptions(folds=0, robust=False)).state
    return start, observed(data)


def test_it_ends_where_the_weighted_gradient_is_zero(case):
    """In units of its own σ, and of Huber's cost: weight times residual."""
    state, seen = case
    found = ArmProblem(seen, WEIGHTING).solve(state)
    white = WEIGHTING.whiten(found.state.residuals(seen), seen)
    slope = WEIGHTING.whiten(found.state.jacobian(seen), seen)
    length = np.linalg.norm(white, axis=1)
    limit = huber_limit(seen.kind)
    assert found.weights == pytest.approx(np.minimum(1, limit / length))
    assert found.weights[7] == found.weights.min() < 0.2
    gradient = np.einsum("r,ri,rik->k", found.weights, white, slope)
    sigma = np.sqrt(np.diag(np.linalg.inv(found.equations.normal)))
    assert np.abs(gradient * sigma).max() < 1e-2


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
    count = state.jacobian(seen).shape[2]
    far = state.moved(np.full(count, 0.05), seen.kind)
    refuses("E-NO-MINIMUM … identification … 1", ArmProblem(seen, WEIGHTING).solve, far)


@pytest.mark.parametrize("rows", [14, 24, 104])
def test_one_sigma_is_that_of_least_squares_and_the_covariance_that_of_t(rows):
    rng = np.random.default_rng(rows)
    design, seen = rng.normal(size=(rows, 4)), rng.normal(size=rows)
    fixed = Equations.of(np.zeros(4), 1e-6 * np.eye(4))

    def spread(sigma: float) -> Spread:
        parts = Components([Equations.of(seen / sigma, -design / sigma)], fixed, 0.0, np.array([np.inf]))
        return Spread(parts, np.array([-3.0]), np.array([3.0]), np.ones(4))

    freedom, sigma = rows - 4, float(np.exp(spread(1.0).best()[0]))
    left = np.linalg.lstsq(design, seen, rcond=None)[1][0]
    assert sigma**2 == pytest.approx(left / freedom, rel=1e-6)
    wanted = left / (freedom - 2) * np.linalg.inv(design.T @ design)  # of a t distribution with so many degrees
    # three nodes are exact to the fourth order of the spread of log σ, 1 / √(2 · freedom)
    assert spread(sigma).covariance() == pytest.approx(wanted, rel=3 / freedom**2 + 1e-3)
