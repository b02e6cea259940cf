"""Normal equations: unknowns reduced away (Schur complement), free directions held, inverses of what is determined."""

from dataclasses import dataclass

import numpy as np

from stcal.geometry.rigid import skew

SINGULAR = 1e-11
"""Eigenvalue of a normal matrix of unit diagonal below which a direction is not determined."""


@dataclass(frozen=True, slots=True, eq=False)
class Reduction:
    """m blocks of unknowns, a in each, reduced away from normal equations over k others.

    ``normal`` : (k, k) and ``right`` : (k,) what has to be subtracted from those of the others; ``step`` : (m, a) of
    the blocks where the others stay, ``from_kept`` : (m, a, k) what a step of the others takes from it; ``inverse`` :
    (m, a, a) of the blocks; ``gain`` : by how much ``step`` alone lowers the cost.
    """

    normal: np.ndarray
    right: np.ndarray
    step: np.ndarray
    from_kept: np.ndarray
    inverse: np.ndarray
    gain: float

    def back(self, kept: np.ndarray) -> np.ndarray:
        """Steps (m, a) of the blocks beside a step (k,) of the others."""
        return self.step - self.from_kept @ kept


def reduce(block: np.ndarray, right: np.ndarray, cross: np.ndarray) -> Reduction:
    """Reduce independent blocks of unknowns.

    Parameters
    ----------
    block
        (m, a, a) their normal matrices.
    right
        (m, a) their right-hand sides.
    cross
        (m, a, k) between them and the others.

    Raises
    ------
    numpy.linalg.LinAlgError
        A block is singular.
    """
    m, a, k = cross.shape
    inverse = np.linalg.inv(block)
    from_kept = inverse @ cross
    flat, weighted = cross.reshape(m * a, k), from_kept.reshape(m * a, k)
    step = np.einsum("mij,mj->mi", inverse, right)
    return Reduction(
        flat.T @ weighted, weighted.T @ right.ravel(), step, from_kept, inverse, float((right * step).sum())
    )


def blocks_of(
    jacobian: np.ndarray, residual: np.ndarray, index: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Diagonal blocks (count, k, k) of a normal matrix and right-hand side (count, k).

    Parameters
    ----------
    jacobian
        (n, c, k) derivatives of each observation by the unknowns of one block, over σ.
    residual
        (n, c) observed minus computed, over σ.
    index
        (n,) which block.
    """
    k = jacobian.shape[2]
    block, right = np.zeros((count, k, k)), np.zeros((count, k))
    np.add.at(block, index, np.swapaxes(jacobian, 1, 2) @ jacobian)
    np.add.at(right, index, np.einsum("nki,nk->ni", jacobian, residual))
    return block, right


def free_motions(xyz: np.ndarray, scale: bool) -> np.ndarray:
    """Orthonormal directions (3n, 6) in which points (n, 3) move as one, or (3n, 7) with a change of scale."""
    middle = xyz - xyz.mean(0)
    parts = [-skew(middle), np.broadcast_to(np.eye(3), (len(xyz), 3, 3))] + [middle[:, :, None]] * scale
    columns = np.concatenate(parts, axis=2)
    return np.linalg.qr(columns.reshape(3 * len(xyz), -1))[0]


def constrained_inverse(normal: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Inverse of a normal matrix (k, k) with inner constraints: of all datums that of smallest trace over the points.

    Parameters
    ----------
    normal
        Singular in the directions ``free``, (k, f), which are orthonormal (S-transformation, Baarda 1973).
    """
    scale = float(np.median(np.diag(normal)[np.any(free != 0, axis=1)]))
    return np.linalg.inv(normal + scale * free @ free.T) - free @ free.T / scale


def generalised_inverse(normal: np.ndarray) -> np.ndarray:
    """Inverse of a normal matrix (k, k), scaled; what nothing determines gets no part in it."""
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    return np.linalg.pinv(normal / scale[:, None] / scale, rcond=SINGULAR, hermitian=True) / scale[:, None] / scale
