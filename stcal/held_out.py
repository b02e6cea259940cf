"""Rows held out of a fit, to see how it does on what it has not seen (Stone 1974, J. R. Stat. Soc. B 36)."""

from collections.abc import Callable, Sequence

import numpy as np

from stcal.errors import StcalError


def dealt(count: int, folds: int, rng: np.random.Generator) -> list[np.ndarray]:
    """Rows 0 … count - 1 dealt at random to folds, each in ascending order, of sizes that differ by one at most; as
    many folds as rows where more are asked for, none below two."""
    folds = min(folds, count)
    if folds < 2:
        return []
    fold = rng.permutation(np.arange(count) % folds)
    return [np.flatnonzero(fold == k) for k in range(folds)]


def repeated_splits(count: int, size: int, repeats: int, rng: np.random.Generator) -> np.ndarray:
    """(repeats, size) rows to hold out, in ascending order: in rounds, in each of which every row comes about once."""
    chosen: list[np.ndarray] = []
    while len(chosen) < repeats:
        order = rng.permutation(count)
        chosen += [np.sort(order[i : i + size]) for i in range(0, count - size + 1, size)]
    return np.array(chosen[:repeats])


def held_out_errors(
    ways: Sequence[Callable[[np.ndarray, np.ndarray], np.ndarray]], folds: Sequence[np.ndarray]
) -> tuple[int, np.ndarray, np.ndarray]:
    """Errors of each fold's rows by fits to the other folds.

    Parameters
    ----------
    ways : sequence of callables
        Each of (rows to fit to, rows (m,) to try on): the errors (m,).
    folds : sequence of int arrays
        Rows of each.

    Returns
    -------
    tuple
        The number of folds done, their rows (m,) in ascending order, and the errors (ways, m). A fold that some way
        cannot solve tells nothing of any, and is left out.
    """
    rows, errors = [np.zeros(0, int)], [np.zeros((len(ways), 0))]
    for own in folds:
        rest = np.setdiff1d(np.concatenate(folds), own)
        try:
            errors.append(np.array([way(rest, own) for way in ways]))
        except StcalError:
            continue
        rows.append(own)
    tried = np.concatenate(rows)
    order = np.argsort(tried)
    return len(rows) - 1, tried[order], np.hstack(errors)[:, order]
