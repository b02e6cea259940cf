"""The three models, σ and covariances of their fits, and errors of points that had no part in them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from stcal.errors import DegenerateError
from stcal.geometry.rigid import Affine, Rigid, Similarity, align_rigid
from stcal.register import register
from stcal.register.consensus import MODELS, Problem, problem_of
from stcal.register.registered import held_out
from tests.levels import sampled
from tests.outcome import refuses
from tests.support.point_pairs import SIGMA_MM, make_scene, parameter_error, scene

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
    there = Problem(model, s.xyz_a, moved @ s.xyz_b, weights).fit() @ s.xyz_a
    np.testing.assert_allclose(there, moved @ (found @ s.xyz_a), atol=1e-7)
    there = Problem(model, moved @ s.xyz_a, s.xyz_b, weights).fit() @ (moved @ s.xyz_a)
    np.testing.assert_allclose(there, found @ s.xyz_a, atol=1e-7)


RIGID = MODELS["rigid"]


def calibration(trials: int, n: int, share=0.0, given=False, **options) -> float:
    """Mean of eᵀC⁻¹e/p over its expectation."""
    sizes = []
    for trial in range(trials):
        rng = np.random.default_rng([trial, n])
        s = make_scene(rng, n, share)
        b, stated = s.xyz_b, None
        if given:
            axes = Rotation.random(n, random_state=trial).as_matrix()
            root = axes * (np.array([0.02, 0.2, 0.2]) * rng.uniform(0.5, 2, (n, 1)))[:, None, :]
            noise = np.einsum("nij,nj->ni", root, rng.normal(size=(n, 3)))
            b = np.where(s.clean[:, None], s.b_from_a @ s.xyz_a + noise, b)
            stated = root @ np.swapaxes(root, 1, 2)
        found = register(s.xyz_a, b, covariances=stated, folds=0, **options)
        error = parameter_error(found.b_from_a, s.b_from_a)
        ν = found.redundancy
        of_sigma = (ν - 2) / ν if np.isfinite(ν) else 1  # E[σ²/s²] = ν/(ν − 2)
        sizes.append(error @ np.linalg.solve(found.covariance, error) / len(error) * of_sigma)
    return float(np.mean(sizes))


BY_ALL = {"method": "least-squares"}


# χ²₆/6 has a standard deviation of 0.58; the mean of 60 trials one of 0.075, and 0.28 is nearly 4 of these.
@pytest.mark.parametrize(
    ("share", "options"),
    sampled([(0, BY_ALL), (0.3, {}), (0, {}), (0.3, {"given": True}), (0, {"threshold_mm": 3 * SIGMA_MM})]),
)
def test_the_covariance_is_calibrated(share, options):
    assert calibration(60, 40, share, **options) == pytest.approx(1, abs=0.28)


def test_given_sigma_stands_unless_contradicted_and_weights_have_no_unit():
    s = make_scene(np.random.default_rng(3), 50)
    true = register(s.xyz_a, s.xyz_b, covariances=np.full(50, SIGMA_MM**2), folds=0)
    assert not true.scaled
    assert true.redundancy == np.inf
    assert true.sigma_factor == pytest.approx(1, abs=0.25)  # 144 degrees of freedom: ± 6 %
    low = register(s.xyz_a, s.xyz_b, covariances=np.full(50, (SIGMA_MM / 5) ** 2), folds=0)
    assert low.scaled
    assert low.redundancy == 144
    assert low.sigma_factor == pytest.approx(5 * true.sigma_factor)
    assert any("residuals exceed the σ given" in note for note in low.notes)
    # scaled, it is what the residuals alone give
    plain = register(s.xyz_a, s.xyz_b, folds=0)
    np.testing.assert_allclose(low.covariance, plain.covariance, rtol=1e-9)
    # but for what is cut off at 5 σ
    np.testing.assert_allclose(true.covariance * true.sigma_factor**2, plain.covariance, rtol=1e-3)
    s = make_scene(np.random.default_rng(5), 30)
    weights = np.random.default_rng(6).uniform(0.5, 2, 30)
    one, two = (register(s.xyz_a, s.xyz_b, weights=w, folds=0) for w in (weights, 1000 * weights))
    np.testing.assert_allclose(one.covariance, two.covariance, rtol=1e-9)
    assert one.sigma_mm == pytest.approx(two.sigma_mm)
    assert one.sigma_factor is None


@pytest.mark.parametrize(
    ("weights", "covariances", "message"),
    [
        (np.ones(4), np.ones(4), "E-REGISTER-WEIGHTS"),
        (np.ones(3), None, "E-ARRAY-SHAPE … weights … (3,) … 4"),
        (None, np.ones((4, 3)), "E-ARRAY-SHAPE … covariances … (4, 3)"),
        ([1, 1, 0, 1], None, "E-REGISTER-WEIGHTS … weights … 3 … 0"),
        (None, [1, np.nan, 1, 1], "E-REGISTER-WEIGHTS … covariances … row 2 has nan"),
        (None, np.tile(np.diag([1, 1, -1.0]), (4, 1, 1)), "E-REGISTER-WEIGHTS … covariances … 1 … 1"),
    ],
)
def test_noise_that_cannot_be(weights, covariances, message):
    refuses(message, problem_of, RIGID, np.zeros((4, 3)), np.zeros((4, 3)), weights, covariances)


def test_leave_one_out_is_what_it_says_and_no_folds_are_left_of_too_few_points():
    s = scene(2, 12)
    assert register(s.xyz_a, s.xyz_b, folds=0).held_out is None
    assert register(s.xyz_a[:4], s.xyz_b[:4], folds=4).held_out is None
    assert register(s.xyz_a, s.xyz_b, folds=50).held_out.folds == 12
    s = scene(0, 7)
    problem = problem_of(RIGID, s.xyz_a, s.xyz_b)
    found = held_out(problem, lambda rows: problem[rows].fit(), s.clean, 7, 0)
    for i, error in zip(found.rows, found.error_mm, strict=True):
        rest = np.arange(7) != i
        expected = np.linalg.norm(s.xyz_b[i] - align_rigid(s.xyz_b[rest], s.xyz_a[rest]) @ s.xyz_a[i])
        assert error == pytest.approx(expected)
    assert found.rows.tolist() == list(range(7))
    figures = (found.of_all.mean_mm, found.of_all.rms_mm, found.of_all.max_mm)
    assert figures == pytest.approx((found.error_mm.mean(), np.sqrt((found.error_mm**2).mean()), max(found.error_mm)))


def test_a_fold_that_cannot_be_fitted_is_left_out():
    s = scene(3, 12)
    problem = problem_of(RIGID, s.xyz_a, s.xyz_b)

    def sometimes(rows):
        if 0 not in rows:
            raise DegenerateError("E-TEST", "without the first")
        return problem[rows].fit()

    found = held_out(problem, sometimes, s.clean, 4, 0)
    assert found.folds == 3
    assert len(found.rows) == 9
    assert 0 not in found.rows
