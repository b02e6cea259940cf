"""Rows held out of a fit, to see how well it predicts what it has not seen (Stone 1974, J. R. Stat. Soc. B 36)."""

from collections.abc import Callable, Sequence

import numpy as np

from stcal.errors import StcalError


def dealt(count: int, folds: int, rng: np.random.Generator) -> list[np.ndarray]:
    """Deals rows 0 … count - 1 at random to folds whose sizes differ by at most one, each in ascending order. There are
    at most as many folds as rows, and none if that leaves fewer than two."""
    folds = min(folds, count)
    if folds < 2:
        return []
    fold = rng.permutation(np.arange(count) % folds)
    return [np.flatnonzero(fold == k) for k in range(folds)]


def repeated_splits(count: int, size: int, repeats: int, rng: np.random.Generator) -> np.ndarray:
    """Draws rows to hold out, (repeats, size), ascending in each split; each round holds out every row about once."""
    chosen: list[np.ndarray] = []
    while len(chosen) < repeats:
        order = rng.permutation(count)
        chosen += [np.sort(order[i : i + size]) for i in range(0, count - size + 1, size)]
    return np.array(chosen[:repeats])


def held_out_errors(
    ways: Sequence[Callable[[np.ndarray, np.ndarray], np.ndarray]], folds: Sequence[np.ndarray]
) -> tuple[int, np.ndarray, np.ndarray]:
    """Returns the number of folds done, their rows (m,) in ascending order, and the errors (ways, m) of each fold's
    rows by fits to the others. A fold that one way cannot solve is left out for all. ``ways`` : functions of (rows to
    fit to, rows (m,) to test on) that return the errors (m,); ``folds`` : rows of each fold."""
    rows, errors = [np.zeros(0, int)], [np.zeros((len(ways), 0))]
    for fold in folds:
        training = np.setdiff1d(np.concatenate(folds), fold)
        try:
            errors.append(np.array([way(training, fold) for way in ways]))
        except StcalError:
            continue
        rows.append(fold)
    tested = np.concatenate(rows)
    order = np.argsort(tested)
    return len(rows) - 1, tested[order], np.hstack(errors)[:, order]
