"""The one descent, robust scales and limits of chance, covariances by clusters, and modes of prints."""

import numpy as np
import pytest
from scipy import stats

from stcal.design import reference_board
from stcal.geometry.clusters import by_clusters
from stcal.geometry.least_squares import NormalEquations, minimise, select_rows
from stcal.geometry.normal_equations import constrained_inverse, free_motions, generalised_inverse
from stcal.geometry.print_modes import PrintModes
from stcal.geometry.robust import (
    huber_cost,
    huber_weights,
    length_limit,
    ratio_limit,
    robust_sigma,
    robust_sigmas,
    tailed_limit,
)
from tests.outcome import refuses


def rosenbrock(x: np.ndarray) -> NormalEquations:
    residual = np.array([10 * (x[1] - x[0] ** 2), 1 - x[0]])
    return NormalEquations.of(residual, np.array([[-20 * x[0], 10.0], [-1.0, 0.0]]))


def test_a_curved_valley_is_followed_to_its_end_also_by_many_problems_at_once():
    found = minimise(np.array([-1.2, 1.0]), rosenbrock, np.add)
    assert found.converged
    assert found.state == pytest.approx([1, 1], abs=1e-6)
    assert 5 < found.steps < 100
    found = minimise(np.array([5.0, 7.0]), lambda x: NormalEquations.of(x[:1] - 2, np.array([[1.0, 0.0]])), np.add)
    assert found.state == pytest.approx([2, 7], abs=1e-6)
    starts = np.array([[-1.2, 1.0], [2.0, 2.0], [0.0, 0.0]])

    def at_once(x):
        each = [rosenbrock(row) for row in x]
        return NormalEquations(*(np.array([getattr(e, k) for e in each]) for k in ("cost", "normal", "gradient")))

    def select(take, new, old):
        return np.where(take[:, None], new, old) if isinstance(new, np.ndarray) else select_rows(take, new, old)

    found = minimise(starts, at_once, np.add, select=select)
    assert found.converged.all()
    assert found.state == pytest.approx(np.ones((3, 2)), abs=1e-6)


def test_where_there_is_no_minimum_it_says_so_and_an_impossible_state_is_never_taken():
    """The cost falls for ever: e⁻ˣ."""
    found = minimise(
        np.zeros(1), lambda x: NormalEquations.of(1e3 * np.exp(-x), -1e3 * np.exp(-x)[:, None]), np.add, max_steps=5
    )
    assert not found.converged
    refuses("E-NO-MINIMUM … fit … 5 … look", found.required, "fit", "look")
    assert found.required("fit", "look", accepted=1e9) is found

    def linearise(x):
        return NormalEquations.impossible(1) if x[0] <= 0.5 else NormalEquations.of(x - 0.1, np.ones((1, 1)))

    found = minimise(np.array([3.0]), linearise, np.add)
    assert found.state[0] > 0.5
    assert not found.converged


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


def test_hubers_loss_and_its_weight_belong_together_and_rows_have_the_scale_that_each_has_alone():
    length = np.linspace(0.1, 9, 50)
    slope = (huber_cost(length + 1e-6, 3.0) - huber_cost(length - 1e-6, 3.0)) / 2e-6
    assert slope == pytest.approx(2 * huber_weights(length, 3.0) * length, rel=1e-6)
    assert (huber_weights(length, np.inf) == 1).all()
    assert huber_cost(length, np.inf) == pytest.approx(length**2)
    rng = np.random.default_rng(1)
    length, among = np.abs(rng.standard_normal((40, 31))), rng.random((40, 31)) < 0.6
    among[3], among[4] = False, np.arange(31) == 7
    found = robust_sigmas(length, among)
    assert np.isnan(found[3])
    for k in (i for i in range(40) if i != 3):
        assert found[k] == pytest.approx(robust_sigma(length[k, among[k]]), rel=1e-12)


@pytest.mark.parametrize("count", [1, 2, 7, 8])
def test_the_middle_of_few_lengths(count):
    """By which σ goes: of 1, 2, 3 … n it is (n + 1)/2; and one that is no number is not passed over."""
    lengths = np.random.default_rng(count).permutation(np.arange(1.0, count + 1))
    assert robust_sigma(lengths) * 0.6744897501960817 == pytest.approx((count + 1) / 2, rel=1e-12)
    assert np.isnan(robust_sigma(np.append(lengths, np.nan)))


@pytest.mark.parametrize("redundancy", [2.0, 7.5, 300.0, 1e9])
@pytest.mark.parametrize("beyond", [0.3, 1e-3, 1e-9])
def test_a_ratio_is_beyond_its_limit_as_seldom_as_said(beyond, redundancy):
    assert stats.f.sf(ratio_limit(beyond, 3, redundancy), 3, redundancy) == pytest.approx(beyond, rel=1e-6)


@pytest.mark.parametrize(("freedom", "least"), [(np.inf, 4.4), (8, 8.0), (4, 15.0)])
def test_the_limit_of_lengths_follows_their_tail(freedom, least):
    """Sound lengths beyond the limit are rare, 0.01 in a sample; gross ones do not move it much.

    ``least`` : the quantile of Student's distribution, of 0.01 / 200."""
    rng, count, draws = np.random.default_rng(3), 200, 100
    beyond, limits, spoiled = 0, [], []
    for _ in range(draws):
        shrunk = 1.0 if np.isinf(freedom) else np.sqrt(rng.chisquare(freedom, (count, 1)) / freedom)
        length = np.linalg.norm(rng.normal(size=(count, 2)) / shrunk, axis=1)
        limits.append(tailed_limit(length, 0.01 / count))
        beyond += int((length > limits[-1]).sum())
        spoiled.append(tailed_limit(np.append(length, [60.0, 200.0]), 0.01 / count))
    assert beyond <= 5  # 1 expected where the tail was known
    assert np.median(spoiled) < 1.5 * np.median(limits)
    assert least * 0.8 < np.median(limits) < 3 * least


def drawn(rng, n: int, common: float, q: int = 4, rows: int = 30):
    """A linear adjustment of n clusters whose errors share a part with a σ of ``common``; error, and its covariance."""
    jacobian = rng.standard_normal((n, rows, q)) + rng.standard_normal((n, 1, q))
    errors = rng.standard_normal((n, rows)) + common * rng.standard_normal((n, 1))
    information = np.swapaxes(jacobian, 1, 2) @ jacobian
    normal = information.sum(0)
    estimate = np.linalg.solve(normal, np.einsum("nrq,nr->q", jacobian, errors))
    pull = np.einsum("nrq,nr->nq", jacobian, errors - jacobian @ estimate)
    return estimate, by_clusters(normal, pull, information), np.linalg.inv(normal)


@pytest.mark.parametrize(("common", "formal"), [(0.0, (0.9, 1.1)), (1.0, (5, 30))])
def test_sigma_by_clusters_hold_with_and_without_common_errors(common, formal):
    rng, squares, plain, larger = np.random.default_rng(1), [], [], []
    for _ in range(200):
        error, found, independent = drawn(rng, 15, common)
        squares.append(error @ np.linalg.solve(found.covariance, error) / 4)
        plain.append(error @ np.linalg.solve(independent, error) / 4)
        larger.append(np.sqrt(np.diag(found.covariance) / np.diag(independent)).mean())
    assert formal[0] < np.mean(plain) < formal[1]
    # 200 draws of 4 parameters scatter by 5 %, and more where few clusters tell σ.
    assert 0.75 < np.mean(squares) < 1.25
    if not common:
        assert 1 <= np.mean(larger) < 1.12


def test_the_covariance_is_never_below_that_of_independent_errors_and_enormous_where_nothing_is_determined():
    rng = np.random.default_rng(2)
    for _ in range(50):
        _, found, independent = drawn(rng, 5, 0.0)
        assert np.linalg.eigvalsh(found.covariance - independent).min() > -1e-12 * np.trace(independent)
    information = np.zeros((5, 3, 3))
    information[:, :2, :2] = np.eye(2)
    pull = np.random.default_rng(4).standard_normal((5, 3)) * [1, 1, 0]
    found = by_clusters(information.sum(0), pull, information).covariance
    assert np.isfinite(found).all()
    assert found[2, 2] > 1e10 * found[0, 0]


def test_modes_are_what_printers_do_and_nothing_that_moves_the_whole():
    xy = reference_board().xy_mm()
    found = PrintModes.of(xy)
    assert found.modes.shape == (3 * len(xy), 11)
    np.testing.assert_allclose(found.modes.T @ found.modes, np.eye(11), atol=1e-12)
    xyz = np.column_stack([xy - xy.mean(0), np.zeros(len(xy))])
    for motion in (np.tile([1.0, 0, 0], len(xy)), np.cross([0, 0, 1.0], xyz).ravel(), xyz.ravel()):
        assert np.abs(found.modes.T @ motion).max() < 1e-9 * np.linalg.norm(motion)
    assert not PrintModes.of(xy[:9]).affine  # a row
    longer = np.column_stack([0.004 * xyz[:, 0], np.zeros((len(xy), 2))])
    assert found.stretch(longer) == pytest.approx((0.004, 0.0), abs=1e-12)


@pytest.mark.parametrize("amplitude", [0.01, 1.0])
def test_the_amplitude_of_a_print_is_found_from_its_points(amplitude):
    rng, logs = np.random.default_rng(3), []
    modes = PrintModes.of(reference_board().xy_mm())
    for _ in range(30):
        along = amplitude * modes.spread_mm * rng.standard_normal(11) + 0.01 * rng.standard_normal(11)
        prior = 0.003**2 + modes.spread_mm**2
        covariance = np.diag(1 / (1 / prior + 1 / 0.01**2))  # points measured to 0.01 mm
        off = (modes.modes @ (covariance @ along / 0.01**2)).reshape(-1, 3)
        logs.append(np.log(modes.as_found(off, covariance, 0.003).amplitude))
    if amplitude == 1:
        assert abs(np.mean(logs)) < 0.15  # 11 numbers tell a logarithm of σ to 0.21, 30 times
    else:  # 0.004 mm at the edge, which the points do not tell
        assert np.mean(np.exp(logs)) < 0.06
