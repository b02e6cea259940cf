"""Whether residuals are alike at neighbours, as those of bent frames are."""

import numpy as np
from scipy.spatial import KDTree
from scipy.special import ndtr

NEIGHBOURS = 2000
"""Number of points whose residuals are compared with the nearest neighbour's …"""
FEWEST_NEIGHBOURS = 20
"""… and of no fewer: the sum of fewer products is not normal."""
BY_NEIGHBOURS = 1e-4
"""Clean data called bent: so many."""


def neighbours_alike(xyz_a: np.ndarray, residuals: np.ndarray) -> bool:
    """Whether points (n, 3) have residuals (n, 3) in common with their nearest neighbours, more than chance has it.

    Of independent ones the products r · r' of neighbours have mean zero (a little less after a fit), and their sum is
    normal with the variance Σ (r · r')².
    """
    rows = slice(None, None, max(1, len(xyz_a) // NEIGHBOURS))
    xyz, r = xyz_a[rows], residuals[rows]
    if len(xyz) < FEWEST_NEIGHBOURS:
        return False
    nearest = np.asarray(KDTree(xyz).query(xyz, k=2)[1])[:, 1]
    pairs = np.column_stack([np.arange(len(xyz)), nearest])
    one, two = np.unique(np.sort(pairs, axis=1), axis=0).T
    product = np.einsum("ni,ni->n", r[one], r[two])
    return bool(ndtr(-product.sum() / max(np.sqrt((product**2).sum()), 1e-300)) < BY_NEIGHBOURS)
