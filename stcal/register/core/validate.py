"""Cross-validation: how far points lie off that had no part in the fit."""

from collections.abc import Callable

import numpy as np

from stcal.cross_validation import dealt, held_out_errors
from stcal.register.core.models import Transform
from stcal.register.core.result import ErrorFigures, HeldOutPoints

TRIED = 20_000
"""Largest number of points that are all cross-validated; of more points a sample is, whose errors are known to 1 %."""


def held_out(
    fit_rows: Callable[[np.ndarray], Transform],
    xyz_a: np.ndarray,
    xyz_b: np.ndarray,
    inliers: np.ndarray,
    folds: int,
    least: int,
    seed: int,
) -> HeldOutPoints | None:
    """Errors of points left out of the fit in turn.

    Parameters
    ----------
    fit_rows : callable
        The fit to the rows given, b_from_a; a fold whose fit fails is left out of the figures.
    xyz_a, xyz_b : (n, 3) arrays
        mm; row i of both is the same point.
    inliers : (n,) bool array
        Of the fit to all.
    folds : int
        Parts to leave out, one at a time.
    least : int
        The fewest points to fit.
    seed : int
        Of the division into parts.

    Returns
    -------
    HeldOutPoints or None
        None with too few points for a fit to the others, or where every fold's fit fails.
    """
    rng = np.random.default_rng([seed, 2])
    sample = np.sort(rng.permutation(len(xyz_a))[:TRIED])
    parts = [sample[part] for part in dealt(len(sample), folds, rng)]

    def errors(rest: np.ndarray, own: np.ndarray) -> np.ndarray:
        return np.linalg.norm(xyz_b[own] - fit_rows(rest) @ xyz_a[own], axis=1)

    if not parts or len(sample) - len(parts[0]) < least:
        return None
    done, rows, (error,) = held_out_errors([errors], parts)
    if not done:
        return None
    return HeldOutPoints(done, rows, error, ErrorFigures.of(error[inliers[rows]]), ErrorFigures.of(error))
