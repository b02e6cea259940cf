"""Covariance by clusters: σ from how photographs, or other clusters of observations, differ from one another.

Residuals of one photograph have much in common that a model of independent errors does not know: light, focus, the
edges of its blur. Photographs are what is drawn anew; how their pulls on the answer scatter tells σ, whatever they have
in common inside (Liang & Zeger 1986). With few of them that scatter is itself uncertain. It is corrected for the share
that a photograph has in the answer: as for independent errors (CR2), and, as far as photographs differ beyond chance
(James & Stein 1961), as for errors that they have in common, which pull the answer after them (CR3, the jackknife; Bell
& McCaffrey 2002). It is drawn towards one common factor as far as chance explains the difference (Ledoit & Wolf 2004),
and what it adds is that of Student's distribution.
"""

from dataclasses import dataclass

import numpy as np

NOTED = 1.25
"""Ratio from which it is said by how much photographs differ: of 16 photographs, chance is above in one run of 1000."""
MOST_SHARE = 1 - 1e-6
"""Largest share of a direction's information in one cluster for which its pull is corrected."""
LEAST_FREEDOM = 3.0
"""Smallest number of degrees of freedom for which Student's variance is used, which is infinite for two."""
TINY = 1e-150
LEAST_TOLD = 1e-14
"""Smallest eigenvalue of a normal matrix of unit diagonal: below it is rounding, and σ are enormous."""


@dataclass(frozen=True, slots=True, eq=False)
class ByClusters:
    """Covariance of q parameters, never below that of independent errors."""

    covariance: np.ndarray  # (q, q)
    independent: np.ndarray  # (q, q) of independent errors
    differ: float  # ratio of σ by which clusters differ more than those explain
    freedom: np.ndarray  # (q,) effective degrees


def released(values: np.ndarray, share: np.ndarray, power: float = 0.5) -> np.ndarray:
    """Return what clusters would show, of unit variance, (…, k), had they not taken their share (…, k, k) in the
    answer. ``power`` : 0.5 for the variance of independent errors (CR2), 1 for the answer without the cluster (CR3)"""
    taken, axes = np.linalg.eigh((share + np.swapaxes(share, -1, -2)) / 2)
    along = (np.swapaxes(axes, -1, -2) @ values[..., None])[..., 0] / (1 - np.clip(taken, 0, MOST_SHARE)) ** power
    return (axes @ along[..., None])[..., 0]


def by_clusters(normal: np.ndarray, pull: np.ndarray, information: np.ndarray) -> ByClusters:
    """Return the covariance of parameters at a minimum with a normal matrix (q, q), priors included, from n clusters.
    ``pull`` : (n, q) half the downhill gradient of each cluster's cost, other unknowns eliminated; ``information`` :
    (n, q, q) each cluster's part of ``normal``"""
    own = np.diag(normal)
    scale = np.sqrt(np.where(own > 0, own, 1.0))
    value, vector = np.linalg.eigh(normal / scale[:, None] / scale)
    half = vector / np.sqrt(np.maximum(value, LEAST_TOLD)) / scale[:, None]
    inverse = half @ half.T
    unit = half.T @ information @ half
    told, n = unit.sum(0), len(pull)
    size = max(float(np.trace(told)), TINY)
    factor = float((released(pull @ half, unit) ** 2).sum()) / size
    chance = 2 / pull.size  # variance of the factor by chance
    beyond = max(0.0, 1 - chance / max(factor - 1, TINY) ** 2)
    rows = released(pull @ half, unit, 0.5 + 0.5 * beyond)
    scatter = rows.T @ rows
    common = max(1.0, float(np.trace(scatter)) / size) * told
    by_chance = sum(((n * np.outer(row, row) - scatter) ** 2).sum() for row in rows) / n**2
    drawn = min(1.0, by_chance / max(((scatter - common) ** 2).sum(), TINY))
    value, vector = np.linalg.eigh(drawn * common + (1 - drawn) * scatter + np.eye(len(told)) - told)
    more = half @ (vector * np.maximum(value - 1, 0)) @ vector.T @ half.T
    of_cluster = np.einsum("pi,vij,jp->pv", inverse, information, inverse)
    freedom = of_cluster.sum(1) ** 2 / np.maximum((of_cluster**2).sum(1), TINY) - 1
    counted = np.maximum(freedom, LEAST_FREEDOM)
    student = np.sqrt(counted / (counted - 2))
    covariance = inverse + student[:, None] * more * student
    return ByClusters((covariance + covariance.T) / 2, inverse, float(np.sqrt(factor)), freedom)
