"""Jumps and drifts along the order of the rows: found, located, and not in sound data."""

import numpy as np
import pytest

from stcal.row_order import change_along


def drawn(seed: int, rows: int = 40, parameters: int = 20):
    """Residuals of a fit of ``parameters`` to rows of noise, their derivatives, and motions of a frame."""
    rng = np.random.default_rng(seed)
    explained = rng.normal(size=(rows, 3, parameters))
    place = rng.normal(size=(rows, 3))
    turn = np.cross(np.eye(3)[None], place[:, None]).swapaxes(1, 2)
    motions = np.concatenate([turn, np.broadcast_to(np.eye(3), (rows, 3, 3))], axis=2)
    return rng.normal(size=(rows, 3)), explained, motions


def fitted(errors: np.ndarray, explained: np.ndarray) -> np.ndarray:
    flat = explained.reshape(errors.size, -1)
    return errors - (flat @ np.linalg.lstsq(flat, errors.ravel(), rcond=None)[0]).reshape(errors.shape)


def jumped(seed: int, row: int, size: float):
    errors, explained, motions = drawn(seed)
    errors[row:] += motions[row:] @ (size * np.array([0.3, 0, 0, 1.0, -0.5, 0]))
    return fitted(errors, explained), explained, motions


@pytest.mark.parametrize("row", [6, 20, 33])
def test_a_jump_is_located_with_its_size(row):
    change = change_along(*jumped(1, row, 20.0))
    assert (change.kind, change.row) == ("jump", row)
    assert change.first <= row <= change.last
    assert change.p < 1e-6
    assert change.motion[3:] == pytest.approx([20, -10, 0], abs=3)


def test_a_small_jump_is_located_by_a_range():
    found = [change_along(*jumped(seed, 20, 2.5)) for seed in range(20)]
    sure = [each for each in found if each.p < 0.01]
    assert len(sure) > 10
    assert np.mean([each.first <= 20 <= each.last for each in sure]) > 0.9
    assert any(each.first < each.last for each in sure)


def test_a_drift_is_no_jump():
    errors, explained, motions = drawn(3)
    along = np.linspace(0, 1, len(errors))[:, None]
    errors += 15 * along * motions[:, :, 3]
    change = change_along(fitted(errors, explained), explained, motions)
    assert change.kind == "drift"
    assert change.motion[3] == pytest.approx(15, abs=3)


def test_gross_errors_are_no_jump_and_hide_none():
    for row in (None, 25):
        errors, explained, motions = drawn(4)
        if row:
            errors[row:] += 8 * motions[row:, :, 3]
        errors[[3, 4, 36]] += [[60, 0, 0], [0, 90, 0], [0, 0, -70]]
        change = change_along(fitted(errors, explained), explained, motions)
        assert (change.p < 0.01) == bool(row)
        if row:
            assert abs(change.row - row) <= 1
            assert not change.good[[3, 4, 36]].any()


def test_what_the_parameters_explain_is_no_change():
    errors, _, motions = drawn(5)
    steps = [motions * (np.arange(len(errors)) >= row)[:, None, None] for row in range(len(errors))]
    assert change_along(errors, np.concatenate(steps, axis=2), motions) is None
    assert change_along(errors[:7], motions[:7, :, :1], motions[:7]) is None


def false_alarms(seeds: range) -> int:
    """Number of sound sets of 30 to 59 rows that show a change at 1 %, wherever in the order."""
    found = []
    for seed in seeds:
        errors, explained, motions = drawn(seed, rows=30 + seed % 30)
        found.append(change_along(fitted(errors, explained), explained, motions))
    assert all(each.good.mean() > 0.9 for each in found)
    return sum(each.p < 0.01 for each in found)


def test_sound_data_show_no_change():
    assert false_alarms(range(40)) <= 3  # four or more once in 1000 runs


@pytest.mark.full
def test_sound_data_show_a_change_at_most_as_often_as_stated():
    """Bonferroni's bound is on the safe side: jumps at neighbouring rows are nearly one test."""
    assert 0 < false_alarms(range(2000)) <= 30  # 1 % are 20 ± 4.5
