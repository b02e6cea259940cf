"""Cross-validation: how far points lie off that had no part in the fit."""

from collections.abc import Callable

import numpy as np

from stcal.errors import StcalError
from stcal.register.core.models import Transform
from stcal.register.core.result import HeldOut

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
    """Errors of points (n, 3) left out in turn, mm; None with too few points for a fit to the others.

    ``fit_rows`` : the fit to the rows given; a fold whose fit fails is left out of the figures.
    ``inliers`` : (n,) mask of the fit to all; ``least`` : the fewest points to fit.
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
    return HeldOut(len(done), tried, error, _figures(own), _figures(error))


def _figures(error: np.ndarray) -> tuple[float, float, float]:
    if not len(error):
        return (np.nan, np.nan, np.nan)
    return float(error.mean()), float(np.sqrt((error**2).mean())), float(error.max())
