"""Covariances by clusters against drawn errors, and modes of prints."""

import numpy as np
import pytest

from stcal.design import reference_board
from stcal.geometry.clusters import by_clusters
from stcal.geometry.print_modes import PrintModes


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
    for _ in range(400):
        error, found, independent = drawn(rng, 15, common)
        squares.append(error @ np.linalg.solve(found.covariance, error) / 4)
        plain.append(error @ np.linalg.solve(independent, error) / 4)
        larger.append(np.sqrt(np.diag(found.covariance) / np.diag(independent)).mean())
    assert formal[0] < np.mean(plain) < formal[1]
    # 400 draws of 4 parameters scatter by 4 %, and more where few clusters tell σ.
    assert 0.75 < np.mean(squares) < 1.25
    if not common:
        assert 1 <= np.mean(larger) < 1.12


def test_the_covariance_is_never_below_that_of_independent_errors():
    rng = np.random.default_rng(2)
    for _ in range(50):
        _, found, independent = drawn(rng, 5, 0.0)
        assert np.linalg.eigvalsh(found.covariance - independent).min() > -1e-12 * np.trace(independent)


def test_what_nothing_determines_has_an_enormous_sigma():
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
        prior = modes.variances(0.003)
        covariance = np.diag(1 / (1 / prior + 1 / 0.01**2))  # points measured to 0.01 mm
        off = (modes.modes @ (covariance @ along / 0.01**2)).reshape(-1, 3)
        logs.append(np.log(modes.as_found(off, covariance, 0.003).amplitude))
    if amplitude == 1:
        assert abs(np.mean(logs)) < 0.15  # 11 numbers tell a logarithm of σ to 0.21, 30 times
    else:  # 0.004 mm at the edge, which the points do not tell
        assert np.mean(np.exp(logs)) < 0.06
