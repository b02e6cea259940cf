"""The three models: fits against a general optimiser, covariances against numeric derivatives."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from stcal.geometry.rigid import Affine, Rigid, Similarity
from stcal.register.consensus import MODELS, Problem, hypotheses, jacobian, parts
from tests.outcome import fails_with
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


@pytest.mark.parametrize("model", MODELS.values(), ids=lambda m: m.name)
@pytest.mark.parametrize("kind", NOISE)
def test_leverages_sum_to_the_parameters(model, kind):
    rng = np.random.default_rng(3)
    s = make_scene(rng, 15)
    problem, used = Problem(model, s.xyz_a, s.xyz_b, precision_of(kind, rng, 15)), np.arange(15) < 12
    found = problem.leverages(problem[used].fit(), used)
    assert np.trace(found, axis1=1, axis2=2)[used].sum() == pytest.approx(model.parameters, rel=1e-9)
    # inside, a point's own share is less than all of it; outside, extrapolation has no bound
    assert np.linalg.eigvalsh(found[used]).max() < 1


def test_leverage_foretells_the_residual_without_the_point():
    """Of a linear model exactly: r without i = (1 − H)⁻¹ r."""
    rng = np.random.default_rng(4)
    s, model = make_scene(rng, 9, sigma_mm=2), MODELS["affine"]
    problem = Problem(model, s.xyz_a, s.xyz_b, precision_of("matrices", rng, 9))
    transform = problem.fit()
    spread = problem.leverages(transform, np.ones(9, bool))
    own = problem.whitened(problem.residuals(transform))
    without = problem.whitened(problem.residuals(problem[np.arange(9) != 4].fit()))
    np.testing.assert_allclose(np.linalg.solve(np.eye(3) - spread[4], own[4]), without[4], rtol=1e-6)


@pytest.mark.parametrize("model", MODELS.values(), ids=lambda m: m.name)
def test_many_samples_at_once_are_single_fits(model):
    s = make_scene(np.random.default_rng(5), 30)
    samples = np.random.default_rng(6).permutation(30)[: 6 * model.sample].reshape(6, model.sample)
    linear, translation = hypotheses(model, s.xyz_a[samples], s.xyz_b[samples])
    for sample, matrix, shift in zip(samples, linear, translation, strict=True):
        one, at = parts(Problem(model, s.xyz_a[sample], s.xyz_b[sample], np.ones(len(sample))).fit())
        np.testing.assert_allclose(matrix, one, atol=1e-9)
        np.testing.assert_allclose(shift, at, atol=1e-6)


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


def test_jacobian_of_one_point_by_hand():
    quarter = Rigid(Rotation.from_rotvec([0, 0, np.pi / 2]).as_matrix())
    slope = jacobian(MODELS["rigid"], quarter, np.array([[1.0, 0, 0]]))[0]  # goes to (0, 1, 0)
    expected = np.array([[0, 0, -1, 1, 0, 0], [0, 0, 0, 0, 1, 0], [1, 0, 0, 0, 0, 1.0]])
    np.testing.assert_allclose(slope, expected, atol=1e-15)


def test_affine_transforms_compose_and_invert():
    one = Affine([[2, 1, 0], [0, 1, 0], [0, 0, 3.0]], [1, 2, 3])
    two = Affine([[1, 0, 0], [5, 1, 0], [0, 1, 1.0]], [0, 0, 7])
    points = np.random.default_rng(0).normal(size=(4, 3))
    np.testing.assert_allclose((one @ two) @ points, one @ (two @ points))
    np.testing.assert_allclose(one.inverse() @ (one @ points), points, atol=1e-12)
    np.testing.assert_allclose((one @ two).matrix(), one.matrix() @ two.matrix())
    with fails_with("E-AFFINE-SINGULAR"):
        Affine(np.ones((3, 3)), np.zeros(3)).inverse()
