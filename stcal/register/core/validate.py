"""Cross-validation: how far points lie off that had no part in the fit."""

from collections.abc import Callable

import numpy as np

from stcal.errors import StcalError
from stcal.register.core.models import Transform
from stcal.register.core.result import ErrorFigures, HeldOut

TRIED = 20_000
"""Of more points a sample is cross-validated: its errors are then known to 1 %."""


def held_out(
    fit_rows: Callable[[np.ndarray], Transform],
    xyz_a: np.ndarray,
    xyz_b: np.ndarray,
    inliers: np.ndarray,
    folds: int,
    least: int,
    seed: int,
) -> HeldOut | None:
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
    HeldOut or None
        None with too few points for a fit to the others, or where every fold's fit fails.
    """
    rows = np.random.default_rng([seed, 2]).permutation(len(xyz_a))[:TRIED]
    folds = min(folds, len(rows))
    if folds < 2 or len(rows) - -(-len(rows) // folds) < least:
        return None
    done, errors = [], []
    for part in np.array_split(rows, folds):
        try:
            transform = fit_rows(np.sort(np.setdiff1d(rows, part)))
        except StcalError:
            continue
        done.append(part)
        errors.append(np.linalg.norm(xyz_b[part] - transform @ xyz_a[part], axis=1))
    if not done:
        return None
    tried, error = np.concatenate(done), np.concatenate(errors)
    order = np.argsort(tried)
    tried, error = tried[order], error[order]
    own = error[inliers[tried]]
    return HeldOut(len(done), tried, error, ErrorFigures.of(own), ErrorFigures.of(error))
