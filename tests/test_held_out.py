"""Rows dealt to folds, splits, and errors of rows held out."""

import numpy as np
import pytest

from stcal.cross_validation import dealt, held_out_errors, repeated_splits
from stcal.errors import DegenerateError


def rng(seed=0):
    return np.random.default_rng(seed)


@pytest.mark.parametrize(
    ("count", "folds", "sizes"),
    [(11, 4, [2, 3, 3, 3]), (3, 6, [1, 1, 1]), (8, 2, [4, 4]), (8, 0, []), (8, 1, []), (1, 6, []), (0, 6, [])],
)
def test_every_row_is_dealt_once_or_none_to_one_fold(count, folds, sizes):
    found = dealt(count, folds, rng())
    assert sorted(len(rows) for rows in found) == sizes
    assert sorted(row for rows in found for row in rows) == list(range(count if sizes else 0))
    assert all((np.diff(rows) > 0).all() for rows in found)


def test_rows_are_dealt_at_random():
    """Two rows of eight fall in the same of two folds in 3 of 7 cases; 400 tries scatter by 0.025."""
    together = [any({0, 1} <= set(rows) for rows in dealt(8, 2, rng(seed))) for seed in range(400)]
    assert np.mean(together) == pytest.approx(3 / 7, abs=0.1)


def test_splits_come_in_rounds():
    rows = repeated_splits(12, 3, 8, rng())
    assert rows.shape == (8, 3)
    assert sorted(rows[:4].ravel()) == sorted(rows[4:].ravel()) == list(range(12))
    assert (np.diff(rows) > 0).all()
    assert repeated_splits(16, 5, 15, rng()).shape == (15, 5)


def test_rows_are_held_out_of_all_ways():
    seen = []

    def way(rest, own):
        seen.append((rest, own))
        if 5 in own:
            raise DegenerateError("E-TEST", "this fold cannot be solved")
        return 2.0 * own

    done, rows, errors = held_out_errors([way, way], dealt(11, 4, rng()))
    assert done == 3
    assert all(sorted([*rest, *own]) == list(range(11)) for rest, own in seen)
    np.testing.assert_array_equal(rows, np.unique(np.concatenate([own for _, own in seen if 5 not in own])))
    np.testing.assert_array_equal(errors, [2.0 * rows, 2.0 * rows])


def test_nothing_held_out():
    done, rows, errors = held_out_errors([lambda _, own: own, lambda _, own: own], [])
    assert (done, rows.shape, errors.shape) == (0, (0,), (2, 0))
