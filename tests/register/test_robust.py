"""The robust method finds the optimum of the clean points, or refuses; it beats the baseline of Liu et al. (2017)."""

import numpy as np
import pytest

from stcal.geometry.rigid import align_rigid
from stcal.register import Liu2017Options, register
from stcal.register.consensus import CLEAN_SETS_WITH_OUTLIER
from stcal.register.registration import affine_least_squares, liu2017
from tests.levels import sampled
from tests.outcome import fails_with, refuses
from tests.support.point_pairs import B_FROM_A, SIGMA_MM, directions, scene


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


def test_outliers_just_beyond_noise_are_found():
    """9 σ, of a point whose limit is about 5 σ: seen unless noise takes half of it back."""
    s = scene(3, 60, 0.25, off_mm=(9 * SIGMA_MM, 9 * SIGMA_MM))
    found = register(s.xyz_a, s.xyz_b, folds=0)
    assert (found.inliers == s.clean).all()
    assert 4 * SIGMA_MM < found.threshold_mm < 6 * SIGMA_MM
    assert found.sigma_mm == pytest.approx(SIGMA_MM, rel=0.2)  # 129 degrees of freedom: ± 6 %


@pytest.mark.parametrize("size", [1e4, 1e15])
def test_outliers_of_two_sizes(size):
    s = scene(4, 80)
    b = s.xyz_b.copy()
    b[:20] += np.random.default_rng(1).uniform(-size, size, (20, 3))
    b[20:40] += 3 * directions(np.random.default_rng(0), 20)
    found = register(s.xyz_a, b, folds=0)
    np.testing.assert_array_equal(np.flatnonzero(~found.inliers), np.arange(40))


def test_more_wrong_than_right_is_said():
    s = scene(5, 50, 0.6)
    found = register(s.xyz_a, s.xyz_b, folds=0)
    assert (found.inliers == s.clean).all()
    assert any("only 20 of 50 point pairs agree" in note for note in found.notes)


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


def test_noise_along_one_axis_is_not_two_groups():
    """Half of it is on either side, but what two transforms take off it, one covariance explains as well."""
    for trial, n, along in ((0, 12, 3), (3, 200, 10), (4, 100, 30)):
        rng = np.random.default_rng([trial, 6])
        s = scene([trial, 6], n, sigma_mm=0.02)
        b = s.xyz_b + rng.normal(0, along * 0.02, (n, 1)) * [0.6, 0, 0.8]
        assert register(s.xyz_a, b, folds=0).inliers.mean() > 0.9


def test_a_far_point_may_be_off_by_what_the_fit_cannot_know():
    """Points of 20 mm tell the place of one 3 m away to 150 times their noise: none of that is an outlier."""
    rng = np.random.default_rng(25)
    a = np.vstack([rng.uniform(-10, 10, (20, 3)), [[3000, 0, 0]]])
    for trial in range(4):
        b = a + np.random.default_rng(trial).normal(0, SIGMA_MM, a.shape)
        assert register(a, b, folds=0).inliers.all()


def test_a_minority_that_moved_is_left_out_and_told():
    s = scene(6, 60, 0.25, "one shift", (3, 3))
    found = register(s.xyz_a, s.xyz_b, folds=0)
    assert (found.inliers == s.clean).all()
    assert not found.ambiguous
    np.testing.assert_array_equal(found.alternative.rows, np.flatnonzero(~s.clean))
    assert found.alternative.apart_mm == pytest.approx(3, abs=0.5)
    assert found.alternative.turn_rad < 0.01
    assert any("15 of the other points agree on another transform" in note for note in found.notes)


def test_a_bent_frame_is_not_two_motions():
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


def test_many_points():
    """The samples see 500 of them, the fit all."""
    s = scene(11, 60_000, 0.4)
    found = register(s.xyz_a, s.xyz_b, folds=2)
    assert cost_ratio(s, found) < 1 + 1e-6
    assert (found.inliers != s.clean).sum() <= 3
    assert found.sigma_mm == pytest.approx(SIGMA_MM, rel=0.01)  # 108 000 degrees of freedom: ± 0.2 %
    assert found.held_out.of_inliers.rms_mm == pytest.approx(np.sqrt(3) * SIGMA_MM, rel=0.02)
    assert len(found.held_out.rows) == 20_000


def test_exact_points():
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


def test_weights_decide_who_is_far():
    s = scene(14, 40)
    b, weights = s.xyz_b.copy(), np.ones(40)
    b[:10] += np.random.default_rng(2).normal(0, 3, (10, 3))
    weights[:10] = (SIGMA_MM / 3) ** 2
    assert register(s.xyz_a, b, weights=weights, folds=0).inliers.all()
    assert not register(s.xyz_a, b, folds=0).inliers[:10].all()


def test_inliers_are_those_within_a_threshold():
    s = scene(15, 80, 0.3)
    found = register(s.xyz_a, s.xyz_b, threshold_mm=0.4, folds=0)
    np.testing.assert_array_equal(found.inliers, np.linalg.norm(found.residuals, axis=1) <= 0.4)
    assert found.threshold_mm == 0.4
    assert not (found.inliers & ~s.clean).any()
    # 0.4 mm is 2.7 σ and cuts off 7 %: without a correction σ would come out 5 % too small
    assert found.sigma_mm == pytest.approx(SIGMA_MM, rel=0.15)


def test_three_points_have_nobody_to_judge_by():
    s = scene(17, 3)
    found = register(s.xyz_a, s.xyz_b)
    assert found.inliers.all()
    assert found.redundancy == 3
    assert found.held_out is None
    assert any("3 degrees of freedom" in note for note in found.notes)


def test_one_wrong_of_four_is_refused_and_so_are_points_of_which_none_is_within():
    s = scene(18, 4)
    off = np.array([0, 60, 0]) * (np.arange(4) == 1)[:, None]
    refuses("E-REGISTER-DISAGREE … 3 … 4 … rigid … 4", register, s.xyz_a, s.xyz_b + off)
    a, b = np.random.default_rng(0).uniform(-1, 1, (2, 30, 3))
    refuses("E-REGISTER-DISAGREE … rigid … within 1e-06 mm", register, a, b, threshold_mm=1e-6)


@pytest.mark.parametrize(("model", "n", "needed"), [("rigid", 2, 3), ("similarity", 2, 3), ("affine", 4, 5)])
def test_too_few(model, n, needed):
    s = scene(20, n)
    refuses(f"E-POINTS-FEW … {n} point pairs, {needed} needed … {model}", register, s.xyz_a, s.xyz_b, model=model)


def test_points_without_correspondence_are_refused():
    rng = np.random.default_rng(21)
    for n in (8, 200):
        refuses("E-REGISTER-CHANCE", register, *rng.uniform(-100, 100, (2, n, 3)))
    a, b = rng.uniform(-100, 100, (2, 30, 3))  # least squares: σ is as large as the cloud, along all of its axes
    for model in ("rigid", "affine"):
        refuses("E-REGISTER-CHANCE … 30", register, a, b, model=model, method="least-squares")


def test_twelve_parameters_are_the_normal_equations():
    s = scene(0, 20, sigma_mm=2)
    design = np.column_stack([s.xyz_a, np.ones(20)])
    by_hand = np.linalg.solve(design.T @ design, design.T @ s.xyz_b)  # eq. 6: (AᵀA)⁻¹AᵀB
    found = affine_least_squares(s.xyz_a, s.xyz_b)
    np.testing.assert_allclose(found.matrix()[:3].T, by_hand, rtol=1e-6, atol=1e-6)
    assert np.abs(found.linear.T @ found.linear - np.eye(3)).max() > 1e-4  # nothing makes it a rotation


def test_as_written():
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


def test_samples_of_thirty_never_find_a_clean_draw():
    """A third wrong: C(67, 30) / C(100, 30) is 1e-6. The robust method has its optimum there."""
    s = scene(3, 100, 0.33, off_mm=(5, 5))
    with fails_with("E-LIU-SAMPLE … 30 … 85"):
        register(s.xyz_a, s.xyz_b, method="liu2017", liu2017_options=Liu2017Options(tries=100))
    refuses("E-LIU-SAMPLE … 20 … 30", liu2017, s.xyz_a[:20], s.xyz_b[:20], Liu2017Options())
    refuses("E-LIU-SAMPLE … 3 … 3", liu2017, s.xyz_a, s.xyz_b, Liu2017Options(tries=20, orthogonal_within=1e-9))


def test_liu2017_options_that_cannot_be():
    refuses("E-LIU-OPTIONS … 3", Liu2017Options, sample=3)
    refuses("E-LIU-OPTIONS … 1.5", Liu2017Options, share=1.5)
    refuses("E-LIU-OPTIONS … limit_mm … 0", Liu2017Options, limit_mm=0)
    refuses("E-LIU-OPTIONS … tries … 0", Liu2017Options, tries=0)


def test_wrong_rows_may_recur_in_step_with_those_that_are_looked_at():
    """Of 30 000 rows every third is wrong."""
    rng = np.random.default_rng(3)
    a = rng.uniform(-500, 500, (30_000, 3))
    b = B_FROM_A @ a + rng.normal(0, 0.05, a.shape)
    b[::3] += rng.uniform(-50, 50, (10_000, 3))
    found = register(a, b, folds=0)
    assert found.sigma_mm == pytest.approx(0.05, rel=0.02)
    assert np.isin(np.arange(0, 30_000, 3), found.outliers).mean() > 0.999
