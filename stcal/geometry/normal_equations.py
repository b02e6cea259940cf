"""Normal equations: elimination of unknowns (Schur complement), inner constraints, and generalised inverses."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dpotrf, dpotri, dpotrs
from scipy.sparse import csr_array

from stcal.geometry.rigid import skew

SINGULAR = 1e-11
"""Eigenvalue of a normal matrix of unit diagonal below which a direction counts as undetermined."""
TINY = 1e-300
SPARSE = 0.1  # share of entries that are not 0 below which a product of sparse matrices is faster
LARGE = 100  # number of unknowns of a block from which on its inverse is computed from Cholesky's factors


@dataclass(frozen=True, slots=True, eq=False)
class Reduction:
    """Elimination of m blocks of ``a`` unknowns each from the normal equations of k other unknowns."""

    normal: np.ndarray  # (k, k) to be subtracted from that of the others, as ``right`` (k,)
    right: np.ndarray
    step: np.ndarray  # (m, a) of the blocks if the others stay
    from_kept: np.ndarray  # (m, a, k) times the step of the others is subtracted from ``step``
    block: np.ndarray  # (m, a, a)
    gain: float  # of ``step`` alone

    @property
    def inverse(self) -> np.ndarray:
        """Inverses (m, a, a) of the blocks, computed anew each time; of large ones by Cholesky's factors, three times
        as fast."""
        if self.block.shape[1] < LARGE:
            return np.linalg.inv(self.block) if len(self.block) else self.block
        return np.stack([inverse_and_size(matrix)[0] for matrix in self.block])

    def back(self, kept: np.ndarray) -> np.ndarray:
        """Return the steps (m, a) of the blocks that belong to a step (k,) of the other unknowns."""
        return self.step - self.from_kept @ kept


def reduce(block: np.ndarray, right: np.ndarray, cross: np.ndarray) -> Reduction:
    """Eliminate m independent blocks of unknowns with normal matrices (m, a, a), right-hand sides (m, a), and mixed
    parts of the normal matrix (m, a, k). LinAlgError: a block is singular."""
    m, a, k = cross.shape
    if not m:
        return Reduction(np.zeros((k, k)), np.zeros(k), right, cross, block, 0.0)
    if a < LARGE:
        inverse = np.linalg.inv(block)
        from_kept, step = inverse @ cross, (inverse @ right[..., None])[..., 0]
    else:
        both = np.column_stack([cross.reshape(m * a, k), right.ravel()]).reshape(m, a, k + 1)
        for own, solved in zip(block, both, strict=True):  # an inverse takes three times as long
            factor, fault = dpotrf(own, lower=True)
            solved[:] = np.linalg.solve(own, solved) if fault else dpotrs(factor, solved, lower=True)[0]
        from_kept, step = np.ascontiguousarray(both[..., :k]), both[..., k]
    flat, weighted = cross.reshape(m * a, k), from_kept.reshape(m * a, k)
    of_kept = weighted.T @ right.ravel()
    if np.count_nonzero(flat) < SPARSE * flat.size:  # dots of a plate, each tied to its own place on it
        normal = (csr_array(flat).T @ csr_array(weighted)).toarray()
    else:
        normal = flat.T @ weighted
    return Reduction(normal, of_kept, step, from_kept, block, float((right * step).sum()))


def inverse_and_size(normal: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the inverse of a symmetric matrix (k, k), by Cholesky's factors, and the logarithm of its determinant."""
    factor, fault = dpotrf(normal, lower=True)
    if fault:
        return np.linalg.inv(normal), float(np.linalg.slogdet(normal)[1])
    lower, _ = dpotri(factor, lower=True)  # its upper triangle is zero, as the factor's is
    own = np.diag(lower)
    return lower + lower.T - np.diag(own), 2 * float(np.log(np.diag(factor)).sum())


def blocks_of(
    jacobian: np.ndarray, residual: np.ndarray, index: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the diagonal blocks (count, k, k) of a normal matrix and the right-hand sides (count, k). Of n
    observations: derivatives (n, c, k) and residuals (n, c), both over σ, and the block of each, (n,)."""
    n, _, k = jacobian.shape
    if count == 1:
        flat = jacobian.reshape(residual.size, k)
        return (flat.T @ flat)[None], (flat.T @ residual.ravel())[None]
    products = np.swapaxes(jacobian, 1, 2) @ np.concatenate([jacobian, residual[:, :, None]], axis=2)
    order = np.argsort(index, kind="stable")
    ends = np.searchsorted(index, np.arange(count + 1), sorter=order)
    # A product with a sparse matrix takes a fifth of the time of numpy.add.at.
    by_block = csr_array((np.ones(n), order, ends), shape=(count, n))
    sums = (by_block @ products.reshape(n, k * (k + 1))).reshape(count, k, k + 1)
    return sums[:, :, :k].copy(), sums[:, :, k].copy()


def free_motions(xyz: np.ndarray, scale: bool) -> np.ndarray:
    """Return orthonormal directions (3n, 6) of rigid motions of points (n, 3), or (3n, 7) with a change of scale."""
    middle = xyz - xyz.mean(0)
    parts = [-skew(middle), np.broadcast_to(np.eye(3), (len(xyz), 3, 3))] + [middle[:, :, None]] * scale
    columns = np.concatenate(parts, axis=2)
    return np.linalg.qr(columns.reshape(3 * len(xyz), -1))[0]


def constrained_inverse(normal: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Return the inverse of a normal matrix (k, k), singular in the orthonormal directions ``free`` (k, f), with the
    datum of smallest trace over the points (S-transformation, Baarda 1973)."""
    if not free.any():
        return np.linalg.inv(normal)
    held = datum(np.diag(normal), free)
    return np.linalg.inv(normal + held) - free @ free.T / (held.trace() / free.shape[1])


def datum(diagonal: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Return what is to be added to a normal matrix of this ``diagonal`` (k,), so that its ``free`` directions stay."""
    held = np.any(free != 0, axis=1)
    return float(np.median(diagonal[held])) * free @ free.T if held.any() else np.zeros((len(free), len(free)))


def generalised_inverse(normal: np.ndarray) -> np.ndarray:
    """Return the pseudo-inverse of a normal matrix (k, k), scaled by its diagonal; undetermined directions are 0."""
    scale = np.sqrt(np.maximum(np.diag(normal), TINY))
    return np.linalg.pinv(normal / scale[:, None] / scale, rcond=SINGULAR, hermitian=True) / scale[:, None] / scale
