"""The three models: fits against a general optimiser, covariances against numeric derivatives."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from stcal.geometry.rigid import Affine, Rigid, Similarity
from stcal.register.consensus import MODELS, Problem
from tests.support.point_pairs import make_scene

NOISE = ("equal", "weights", "matrices")


def precision_of(kind: str, rng: np.random.Generator, n: int) -> np.ndarray:
    if kind == "equal":
        return np.ones(n)
    if kind == "weights":
        return rng.uniform(0.2, 5, n)
    root = Rotation.random(n, random_state=1).as_matrix() * rng.uniform(0.3, 3, (n, 1, 3))
    return root @ np.swapaxes(root, 1, 2)


def perturbed(transform, step: np.ndarray):
    """By the parameters that the covariance is stated in."""
    if isinstance(transform, Affine):
        rows = step.reshape(3, 4)
        return Affine(transform.linear + rows[:, :3], transform.translation + rows[:, 3])
    rigid = transform if isinstance(transform, Rigid) else transform.rigid
    turn = Rotation.from_rotvec(step[:3]).as_matrix()
    moved = Rigid(turn @ rigid.rotation, rigid.translation + step[3:6])
    return moved if isinstance(transform, Rigid) else Similarity(transform.scale * (1 + step[6]), moved)


@pytest.mark.parametrize("model", MODELS.values(), ids=lambda m: m.name)
@pytest.mark.parametrize("kind", NOISE)
def test_the_fit_is_the_minimum_that_a_general_optimiser_finds(model, kind):
    rng = np.random.default_rng(1)
    s = make_scene(rng, 12, sigma_mm=3)
    problem = Problem(model, s.xyz_a, s.xyz_b, precision_of(kind, rng, 12))
    found = problem.fit()

    def cost(step):
        return problem.whitened(problem.residuals(perturbed(found, step))).ravel()

    # from elsewhere, so that it does not merely stay
    step = [1e-3, -1e-3, 2e-3, 1] * 3 if model.name == "affine" else [0.01, -0.01, 0.02, 0, 0, 0, 0]
    start = np.array(step[: model.parameters])
    best = least_squares(cost, start, x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-15, max_nfev=2000)
    mine = (cost(np.zeros(model.parameters)) ** 2).sum()
    assert mine == pytest.approx(2 * best.cost, rel=1e-8)
    assert mine == pytest.approx(problem.squares(found).sum())


@pytest.mark.parametrize("model", MODELS.values(), ids=lambda m: m.name)
@pytest.mark.parametrize("kind", NOISE)
def test_the_covariance_is_that_of_numeric_derivatives(model, kind):
    rng = np.random.default_rng(2)
    s = make_scene(rng, 9)
    problem = Problem(model, s.xyz_a, s.xyz_b, precision_of(kind, rng, 9))
    transform, h = problem.fit(), 1e-5
    moved = [
        perturbed(transform, h * e) @ s.xyz_a - perturbed(transform, -h * e) @ s.xyz_a for e in np.eye(model.parameters)
    ]
    slope = np.column_stack([problem.whitened(each).ravel() / (2 * h) for each in moved])
    # The origin of a is 1 m from the points, so that the parameters are correlated to 0.99: compare N⁻¹ N with 1.
    product = problem.unit_covariance(transform) @ (slope.T @ slope)
    scale = np.sqrt(np.diag(slope.T @ slope))
    np.testing.assert_allclose(product * scale[:, None] / scale, np.eye(model.parameters), atol=2e-4)


@given(st.integers(0, 9999), st.sampled_from(sorted(MODELS)))
def test_frames_may_be_moved(seed, name):
    """Moving b moves the transform; moving a takes the motion off again; residuals keep their length."""
    rng = np.random.default_rng(seed)
    s, model = make_scene(rng, 8), MODELS[name]
    weights = rng.uniform(0.5, 2, 8)
    moved = make_scene(rng, 3).b_from_a
    found = Problem(model, s.xyz_a, s.xyz_b, weights).fit()
    np.testing.assert_allclose(
        Problem(model, s.xyz_a, moved @ s.xyz_b, weights).fit() @ s.xyz_a, moved @ (found @ s.xyz_a), atol=1e-7
    )
    np.testing.assert_allclose(
        Problem(model, moved @ s.xyz_a, s.xyz_b, weights).fit() @ (moved @ s.xyz_a), found @ s.xyz_a, atol=1e-7
    )
