"""The three models, σ and covariances of their fits, and errors of points that had no part in them. The robust method
finds the optimum of the clean points, or refuses; it beats the baseline of Liu et al. (2017), also in their simulated
experiment, what the table of docs/accuracy says for one robot; and a real robot with a total station."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from stcal.errors import DegenerateError
from stcal.geometry.rigid import Affine, Rigid, Similarity, align_rigid
from stcal.register import Liu2017Options, register
from stcal.register.consensus import CLEAN_SETS_WITH_OUTLIER, MODELS, Problem, _moved, problem_of
from stcal.register.registered import held_out
from stcal.register.registration import affine_least_squares, liu2017
from tests.levels import sampled
from tests.outcome import fails_with, refuses
from tests.scripts import load_script
from tests.support.point_pairs import B_FROM_A, SIGMA_MM, directions, make_scene, parameter_error, scene

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
def test_the_fit_is_the_minimum_that_a_general_optimiser_finds_and_its_covariance_that_of_derivatives(model, kind):
    rng = np.random.default_rng(1)
    s = make_scene(rng, 12, sigma_mm=3)
    problem = Problem(model, s.xyz_a, s.xyz_b, precision_of(kind, rng, 12))
    found = model.transform(problem.fit())

    def cost(step):
        return problem.whitened(problem.residuals(perturbed(found, step))).ravel()

    # from elsewhere, so that it does not merely stay
    step = [1e-3, -1e-3, 2e-3, 1] * 3 if model.name == "affine" else [0.01, -0.01, 0.02, 0, 0, 0, 0]
    start = np.array(step[: model.parameters])
    best = least_squares(cost, start, x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-15, max_nfev=2000)
    mine = (cost(np.zeros(model.parameters)) ** 2).sum()
    assert mine == pytest.approx(2 * best.cost, rel=1e-8)
    assert mine == pytest.approx(problem.squares(found).sum())
    rng = np.random.default_rng(2)
    s = make_scene(rng, 9)
    problem = Problem(model, s.xyz_a, s.xyz_b, precision_of(kind, rng, 9))
    transform, h = model.transform(problem.fit()), 1e-5
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


@pytest.mark.parametrize("model", MODELS.values(), ids=lambda m: m.name)
def test_a_long_step_keeps_the_model(model):
    begin, step = Affine(np.eye(3), np.array([1.0, 2, 3])), np.linspace(-0.4, 0.5, model.parameters)
    expected = perturbed(model.transform(begin), step).matrix()
    moved = _moved(model, begin, np.zeros(3), step)
    np.testing.assert_allclose(moved.matrix(), expected, atol=1e-12)


def test_points_that_are_off_a_plane_by_little_determine_an_affine_transform():
    xyz = np.random.default_rng(0).uniform(-500, 500, (30, 3)) * [1, 1, 2e-8]
    truth = Affine([[1, 0.1, 0], [0, 1, 0], [0.2, 0, 1.1]], [1, 2, 3])
    found = register(xyz, truth @ xyz, model="affine", method="least-squares").b_from_a
    np.testing.assert_allclose(found.matrix(), truth.matrix(), atol=1e-6)


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


def test_leave_one_out_is_what_it_says_and_a_fold_that_cannot_be_fitted_is_left_out():
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


def cost_ratio(s, found) -> float:
    a, b = s.xyz_a[s.clean], s.xyz_b[s.clean]
    return ((b - found.b_from_a @ a) ** 2).sum() / ((b - align_rigid(b, a) @ a) ** 2).sum()


@pytest.mark.parametrize("share", sampled([0.4, 0, 0.1, 0.2, 0.3]))
@pytest.mark.parametrize("n", [20, 100])
def test_within_one_per_cent_of_the_optimum_of_the_clean_points(n, share):
    for trial in range(3):
        s = scene([trial, n], n, share)
        found = register(s.xyz_a, s.xyz_b, folds=0)
        assert cost_ratio(s, found) > 1 - 1e-12
        assert cost_ratio(s, found) < 1.01
        assert not (found.inliers & ~s.clean).any()  # 2 mm is 13 σ
        assert (found.inliers[s.clean]).mean() > 0.9


@pytest.mark.slow
def test_clean_points_are_kept_and_not_called_bent():
    """One set in a thousand may lose a point: of 25 one would with a chance of 2.5 %. One in ten thousand is bent."""
    assert CLEAN_SETS_WITH_OUTLIER == 0.001
    for n, sets in ((12, 20), (100, 5)):
        for trial in range(sets):
            s = scene([trial, 7], n)
            found = register(s.xyz_a, s.xyz_b, folds=0)
            assert found.inliers.all()
            assert not any("bent" in note for note in found.notes)
    assert found.notes == ()


def test_outliers_just_beyond_noise_are_found_and_more_wrong_than_right_is_said():
    """9 σ, of a point whose limit is about 5 σ: seen unless noise takes half of it back."""
    s = scene(3, 60, 0.25, off_mm=(9 * SIGMA_MM, 9 * SIGMA_MM))
    found = register(s.xyz_a, s.xyz_b, folds=0)
    assert (found.inliers == s.clean).all()
    assert 4 * SIGMA_MM < found.threshold_mm < 6 * SIGMA_MM
    assert found.sigma_mm == pytest.approx(SIGMA_MM, rel=0.2)  # 129 degrees of freedom: ± 6 %
    s = scene(5, 50, 0.6)
    found = register(s.xyz_a, s.xyz_b, folds=0)
    assert (found.inliers == s.clean).all()
    assert any("only 20 of 50 point pairs agree" in note for note in found.notes)


@pytest.mark.parametrize("size", [1e4, 1e15])
def test_outliers_of_two_sizes(size):
    s = scene(4, 80)
    b = s.xyz_b.copy()
    b[:20] += np.random.default_rng(1).uniform(-size, size, (20, 3))
    b[20:40] += 3 * directions(np.random.default_rng(0), 20)
    found = register(s.xyz_a, b, folds=0)
    np.testing.assert_array_equal(np.flatnonzero(~found.inliers), np.arange(40))


@pytest.mark.parametrize("kind", ["one shift", "other motion"])
@pytest.mark.parametrize("share", sampled([0.5, 0.4, 0.6]))
def test_two_transforms_are_refused_or_told(kind, share):
    for trial in range(2):
        s = scene([trial, 11], 40, share, kind)
        refuses("E-REGISTER-TWO-TRANSFORMS", register, s.xyz_a, s.xyz_b, folds=0)
        found = register(s.xyz_a, s.xyz_b, folds=0, allow_ambiguous=True)
        assert found.ambiguous
        assert found.notes[0].startswith("AMBIGUOUS") or found.notes[1].startswith("AMBIGUOUS")
        assert len(found.alternative.rows) + found.inliers.sum() >= 38
        # one of the two is the truth
        a, b = s.xyz_a[s.clean], s.xyz_b[s.clean]
        rms = [np.sqrt(((b - t @ a) ** 2).sum(1).mean()) for t in (found.b_from_a, found.alternative.b_from_a)]
        assert min(rms) < 4 * SIGMA_MM


def test_groups_that_no_consensus_tells_apart():
    """At 1 mm, 7 σ, between them: trimming sees one set of larger σ, two transforms are seen."""
    for trial in range(2):
        s = scene([trial, 9], 80, 0.5, "one shift", (1, 1))
        found = register(s.xyz_a, s.xyz_b, folds=0, allow_ambiguous=True)
        assert found.ambiguous
        assert abs((found.inliers == s.clean).mean() - 0.5) > 0.45
        assert found.sigma_mm == pytest.approx(SIGMA_MM, rel=0.3)


def test_noise_along_one_axis_is_not_two_groups_and_a_far_point_may_be_off():
    """Half of it is on either side, but what two transforms take off it, one covariance explains as well. Points of
    20 mm tell the place of one 3 m away to 150 times their noise: none of that is an outlier."""
    for trial, n, along in ((0, 12, 3), (3, 200, 10), (4, 100, 30)):
        rng = np.random.default_rng([trial, 6])
        s = scene([trial, 6], n, sigma_mm=0.02)
        b = s.xyz_b + rng.normal(0, along * 0.02, (n, 1)) * [0.6, 0, 0.8]
        assert register(s.xyz_a, b, folds=0).inliers.mean() > 0.9
    rng = np.random.default_rng(25)
    a = np.vstack([rng.uniform(-10, 10, (20, 3)), [[3000, 0, 0]]])
    for trial in range(4):
        b = a + np.random.default_rng(trial).normal(0, SIGMA_MM, a.shape)
        assert register(a, b, folds=0).inliers.all()


def test_a_minority_that_moved_is_left_out_and_a_bent_frame_is_not_two_motions():
    s = scene(6, 60, 0.25, "one shift", (3, 3))
    found = register(s.xyz_a, s.xyz_b, folds=0)
    assert (found.inliers == s.clean).all()
    assert not found.ambiguous
    np.testing.assert_array_equal(found.alternative.rows, np.flatnonzero(~s.clean))
    assert found.alternative.apart_mm == pytest.approx(3, abs=0.5)
    assert found.alternative.turn_rad < 0.01
    assert any("15 of the other points agree on another transform" in note for note in found.notes)
    rng = np.random.default_rng(8)
    a = rng.uniform(-100, 100, (150, 3))
    bend = np.abs(a[:, :1] - 10) * [0, 0.01, 0.005]  # as of a beam with a joint: up to 1 mm, each half straight
    b = a + bend + rng.normal(0, 0.05, a.shape)
    found = register(a, b, folds=0)
    plain = register(a, b, folds=0, method="least-squares")
    assert found.inliers.mean() > 0.9
    assert any("bent" in note for note in found.notes)
    away = np.sqrt((((found.b_from_a @ a) - plain.b_from_a @ a) ** 2).sum(1).mean())
    assert away < 0.1 * plain.inlier_errors.rms_mm


def test_the_same_seed_gives_the_same_answer_and_rows_in_any_order_the_same_points():
    s = scene(9, 40, 0.3)
    found, again = (register(s.xyz_a, s.xyz_b, folds=2) for _ in range(2))
    assert (found.b_from_a.matrix() == again.b_from_a.matrix()).all()
    assert found.samples == again.samples > 0
    assert (found.held_out.error_mm == again.held_out.error_mm).all()
    order = np.random.default_rng(1).permutation(40)
    shuffled = register(s.xyz_a[order], s.xyz_b[order], folds=0, seed=5)
    np.testing.assert_array_equal(found.inliers[order], shuffled.inliers)
    np.testing.assert_allclose(found.b_from_a.matrix(), shuffled.b_from_a.matrix(), atol=1e-9)


def test_wrong_rows_may_recur_in_step_with_those_that_are_looked_at():
    """Of 30 000 rows every third is wrong."""
    rng = np.random.default_rng(3)
    a = rng.uniform(-500, 500, (30_000, 3))
    b = B_FROM_A @ a + rng.normal(0, 0.05, a.shape)
    b[::3] += rng.uniform(-50, 50, (10_000, 3))
    found = register(a, b, folds=0)
    assert found.sigma_mm == pytest.approx(0.05, rel=0.02)
    assert np.isin(np.arange(0, 30_000, 3), found.outliers).mean() > 0.999


def test_many_points_and_exact_ones():
    """The samples see 500 of them, the fit all."""
    s = scene(11, 60_000, 0.4)
    found = register(s.xyz_a, s.xyz_b, folds=2)
    assert cost_ratio(s, found) < 1 + 1e-6
    assert (found.inliers != s.clean).sum() <= 3
    assert found.sigma_mm == pytest.approx(SIGMA_MM, rel=0.01)  # 108 000 degrees of freedom: ± 0.2 %
    assert found.held_out.of_inliers.rms_mm == pytest.approx(np.sqrt(3) * SIGMA_MM, rel=0.02)
    assert len(found.held_out.rows) == 20_000
    s = scene(12, 30, 0.3, sigma_mm=0)
    found = register(s.xyz_a, s.xyz_b, folds=0)
    assert (found.inliers == s.clean).all()
    assert found.inlier_errors.max_mm < 1e-8
    clean = register(s.xyz_a[s.clean], s.xyz_b[s.clean], folds=0)
    assert clean.inliers.all()


@pytest.mark.parametrize("model", ["similarity", "affine"])
def test_other_models(model):
    s = scene(13, 60, 0.4)
    found = register(s.xyz_a, 1.01 * s.xyz_b, model=model, folds=0)
    assert (found.inliers == s.clean).all()
    if model == "similarity":
        assert found.b_from_a.scale == pytest.approx(1.01, abs=5 * np.sqrt(found.covariance[6, 6]))


def test_weights_decide_who_is_far_and_inliers_are_those_within_a_threshold():
    s = scene(14, 40)
    b, weights = s.xyz_b.copy(), np.ones(40)
    b[:10] += np.random.default_rng(2).normal(0, 3, (10, 3))
    weights[:10] = (SIGMA_MM / 3) ** 2
    assert register(s.xyz_a, b, weights=weights, folds=0).inliers.all()
    assert not register(s.xyz_a, b, folds=0).inliers[:10].all()
    s = scene(15, 80, 0.3)
    found = register(s.xyz_a, s.xyz_b, threshold_mm=0.4, folds=0)
    np.testing.assert_array_equal(found.inliers, np.linalg.norm(found.residuals, axis=1) <= 0.4)
    assert found.threshold_mm == 0.4
    assert not (found.inliers & ~s.clean).any()
    # 0.4 mm is 2.7 σ and cuts off 7 %: without a correction σ would come out 5 % too small
    assert found.sigma_mm == pytest.approx(SIGMA_MM, rel=0.15)


def test_three_points_have_nobody_to_judge_by_and_one_wrong_of_four_or_of_no_correspondence_is_refused():
    s = scene(17, 3)
    found = register(s.xyz_a, s.xyz_b)
    assert found.inliers.all()
    assert found.redundancy == 3
    assert found.held_out is None
    assert any("3 degrees of freedom" in note for note in found.notes)
    s = scene(18, 4)
    off = np.array([0, 60, 0]) * (np.arange(4) == 1)[:, None]
    refuses("E-REGISTER-DISAGREE … 3 … 4 … rigid … 4", register, s.xyz_a, s.xyz_b + off)
    a, b = np.random.default_rng(0).uniform(-1, 1, (2, 30, 3))
    refuses("E-REGISTER-DISAGREE … rigid … within 1e-06 mm", register, a, b, threshold_mm=1e-6)
    rng = np.random.default_rng(21)
    for n in (8, 200):
        refuses("E-REGISTER-CHANCE", register, *rng.uniform(-100, 100, (2, n, 3)))
    a, b = rng.uniform(-100, 100, (2, 30, 3))  # least squares: σ is as large as the cloud, along all of its axes
    for model in ("rigid", "affine"):
        refuses("E-REGISTER-CHANCE … 30", register, a, b, model=model, method="least-squares")


@pytest.mark.parametrize(("model", "n", "needed"), [("rigid", 2, 3), ("similarity", 2, 3), ("affine", 4, 5)])
def test_too_few(model, n, needed):
    s = scene(20, n)
    refuses(f"E-POINTS-FEW … {n} point pairs, {needed} needed … {model}", register, s.xyz_a, s.xyz_b, model=model)


def test_as_written_and_twelve_parameters_are_the_normal_equations():
    """Noise of 0.05 mm: the limit of 0.2 mm is 4 σ; 10 % of the points are wrong."""
    s = scene(1, 100, 0.1, sigma_mm=0.05)
    options = Liu2017Options(sample=12, limit_mm=0.2, share=0.8, tries=300)
    found = liu2017(s.xyz_a, s.xyz_b, options, seed=2)
    error = np.linalg.norm(s.xyz_b - found.transform @ s.xyz_a, axis=1)
    np.testing.assert_array_equal(found.inliers, error < 0.2)
    # of the acceptable samples that of the smallest variance, told by the points outside it
    rng, best, acceptable = np.random.default_rng(2), np.inf, 0
    for _ in range(options.tries):
        sample = rng.choice(100, 12, replace=False)
        one = affine_least_squares(s.xyz_a[sample], s.xyz_b[sample])
        off = np.delete(np.linalg.norm(s.xyz_b - one @ s.xyz_a, axis=1), sample)
        is_rotation = np.abs(one.linear.T @ one.linear - np.eye(3)).max() <= options.orthogonal_within
        if is_rotation and (off < 0.2).mean() > 0.8:
            acceptable += 1
            if off[off < 0.2].var() < best:
                best, winner = off[off < 0.2].var(), (one, sample)
    assert 0 < acceptable < 300
    assert s.clean[winner[1]].all()  # C(90, 12) / C(100, 12) = 26 % of the samples
    np.testing.assert_allclose(found.transform.matrix(), winner[0].matrix())
    s = scene(0, 20, sigma_mm=2)
    design = np.column_stack([s.xyz_a, np.ones(20)])
    by_hand = np.linalg.solve(design.T @ design, design.T @ s.xyz_b)  # eq. 6: (AᵀA)⁻¹AᵀB
    found = affine_least_squares(s.xyz_a, s.xyz_b)
    np.testing.assert_allclose(found.matrix()[:3].T, by_hand, rtol=1e-6, atol=1e-6)
    assert np.abs(found.linear.T @ found.linear - np.eye(3)).max() > 1e-4  # nothing makes it a rotation


def test_in_register():
    s = scene(2, 100, 0.05, sigma_mm=0.05)
    options = Liu2017Options(sample=10, tries=100)
    found = register(s.xyz_a, s.xyz_b, method="liu2017", liu2017_options=options, folds=3)
    assert found.model == "affine"
    assert found.threshold_mm == 0.2
    assert found.covariance.shape == (12, 12)
    assert found.held_out.folds == 3
    assert found.held_out.of_all.max_mm > 2  # of the wrong points
    tight = register(s.xyz_a, s.xyz_b, method="liu2017", threshold_mm=0.3, folds=0)
    assert tight.threshold_mm == 0.3


def test_samples_of_thirty_never_find_a_clean_draw_and_options_that_cannot_be():
    """A third wrong: C(67, 30) / C(100, 30) is 1e-6. The robust method has its optimum there."""
    s = scene(3, 100, 0.33, off_mm=(5, 5))
    with fails_with("E-LIU-SAMPLE … 30 … 85"):
        register(s.xyz_a, s.xyz_b, method="liu2017", liu2017_options=Liu2017Options(tries=100))
    refuses("E-LIU-SAMPLE … 20 … 30", liu2017, s.xyz_a[:20], s.xyz_b[:20], Liu2017Options())
    refuses("E-LIU-SAMPLE … 3 … 3", liu2017, s.xyz_a, s.xyz_b, Liu2017Options(tries=20, orthogonal_within=1e-9))
    refuses("E-LIU-OPTIONS … 3", Liu2017Options, sample=3)
    refuses("E-LIU-OPTIONS … 1.5", Liu2017Options, share=1.5)
    refuses("E-LIU-OPTIONS … limit_mm … 0", Liu2017Options, limit_mm=0)
    refuses("E-LIU-OPTIONS … tries … 0", Liu2017Options, tries=0)


@pytest.mark.slow
def test_ours_beats_theirs_which_beats_their_least_squares_and_only_the_kinematics_hold_outside():
    """Mean errors in the cube of the fit and in the large one, mm, one point in ten wrong. The paper says three times
    their least squares; one robot of ours: at least 1.5 and at most 6."""
    script = load_script("reproduce_registration")
    errors = {name: [float(e.mean()) for e in errors] for name, errors in script.trial(1, script.SHOWN).items()}
    near, far = ({name: both[i] for name, both in errors.items()} for i in (0, 1))
    assert 1.5 < near[script.USUAL] / near[script.PAPER] < 6
    assert near[script.AFFINE] < near[script.PAPER] / 1.5
    assert near[script.TOGETHER] < near[script.PAPER] / 1.5
    assert near[script.FIELD] < near[script.RIGID]
    for name in (script.USUAL, script.PAPER, script.RIGID, script.AFFINE):
        assert far[name] > near[name]
    assert far[script.RIGID] > 1.3 * near[script.RIGID]
    assert far[script.TOGETHER] == min(far.values())


@pytest.fixture(scope="module")
def hilti(shared_data):
    """The script, stations by name, and the robot of the URDF."""
    script, root = load_script("register_shared"), shared_data("hilti_stationing")
    return script, script.stations(root), script.robot_of(root / "data" / "trailblazer.urdf")


@pytest.mark.slow  # a set that lies beside the repository
def test_rigid_registration_holds_to_a_centimetre_affine_to_metres_and_kinematics_serve_another_station(hilti):
    """The figures of SOURCE.txt: 6.9–9.9 mm, and 3.2–5.4 m of the affine fit to coplanar places. Identified where the
    floor is flat, used where it is not: the error falls to below 70 %."""
    script, stations, robot = hilti
    rigid = {name: script.errors_by_part(s, robot).mean() for name, s in stations.items()}
    affine = {name: script.errors_by_part(s, robot, affine=True).mean() for name, s in stations.items()}
    assert len(rigid) == 7
    assert min(rigid.values()) > 6.0
    assert max(rigid.values()) < 9.95
    assert min(affine.values()) > 2000
    real = script.identified(robot, script.everything(stations["flat"]), slice(None, None, 2))
    nominal, better = (script.errors_by_part(stations["pallet"], each).mean() for each in (robot, real))
    assert better < 0.7 * nominal
