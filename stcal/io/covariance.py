"""Validation of covariances: the only place where covariances from outside are checked."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from stcal.errors import InputError

ROUNDING = 1e-5
"""Tolerance of a correlation per row of its matrix: files state six digits, so that 1.00000 may be off by 5e-6."""
LARGEST = 1e24
"""Largest variance in any unit: a σ of 1e12 exceeds anything that is measured."""
TINY = 1e-300
"""Value that replaces a variance of zero, to avoid division by zero."""


@dataclass(frozen=True, slots=True)
class Rows:
    """The rows of a covariance: ``names``; ``nothing`` : variance of each row that counts as zero (rounding)."""

    names: tuple[str, ...]
    nothing: float | tuple[float, ...] = 0.0

    @classmethod
    def of(cls, names: Iterable[str], axes: str) -> "Rows":
        """Return the rows for the coordinates, in mm, of several named points."""
        return cls(tuple(f"{axis} of {name}" for name in names for axis in axes), NANOMETRE)


TWIST = ("rx", "ry", "rz", "x", "y", "z")
"""Rows of the covariance of a pose: rotation vector (rad) and translation (mm), left perturbation."""
NANOMETRE = 1e-12
"""Square of a nanometre in mm²."""
NANORADIAN = 1e-18
"""Square of a nanoradian in rad²: a point at a distance of a metre moves by a nanometre."""
OF_POSE = Rows(TWIST, (*[NANORADIAN] * 3, *[NANOMETRE] * 3))
OF_POINT = Rows(("x", "y", "z"), NANOMETRE)
OF_PIXEL = Rows(("x", "y"))


@dataclass(frozen=True, slots=True)
class Fault:
    """An invalid covariance. ``row`` : index of the matrix, from 0; ``reason`` : measured and needed values."""

    row: int
    reason: str


def first_fault(matrices: np.ndarray, rows: Rows, definite: bool = False) -> Fault | None:
    """Return the fault of the first of m matrices (m, n, n) that is no covariance, None if all are.

    A covariance is finite, symmetric and without negative eigenvalues of its correlations, up to rounding; without any
    that are not positive if it will be inverted, ``definite``.
    """
    size = matrices.shape[-1]
    nothing = np.zeros(size) if definite else np.resize(rows.nothing, size)
    variance = np.diagonal(matrices, axis1=1, axis2=2) + nothing
    with np.errstate(all="ignore"):
        scale = np.sqrt(np.maximum(variance, TINY))
        scales = scale[:, :, None] * scale[:, None, :]
        correlation = matrices / scales
        correlation[:, range(size), range(size)] = variance / scale**2
        odd = np.abs(matrices - np.swapaxes(matrices, 1, 2)) - np.sqrt(np.outer(nothing, nothing))
        odd /= scales
        acceptable = (variance >= 0).all(axis=1) & (variance <= LARGEST).all(axis=1)
        acceptable &= (odd <= ROUNDING * size).all(axis=(1, 2))
        acceptable &= (np.abs(correlation) <= 1 + ROUNDING * size).all(axis=(1, 2))
    lowest = np.full(len(matrices), -np.inf)
    lowest[acceptable] = np.linalg.eigvalsh(correlation[acceptable])[:, 0]
    bad = np.flatnonzero(~(lowest > 0 if definite else lowest >= -ROUNDING * size))
    if not len(bad):
        return None
    row = int(bad[0])
    suffix = f" (and {len(bad) - 1} more)" if len(bad) > 1 else ""
    return Fault(row, _reason(matrices[row], odd[row], correlation[row], float(lowest[row]), rows, definite) + suffix)


def require_covariance(matrix: np.ndarray, size: int, rows: Rows, definite: bool = False) -> None:
    """Refuse a matrix that is not a covariance of ``size`` rows; see :func:`first_fault`."""
    if matrix.shape != (size, size):
        raise InputError(
            "E-COVARIANCE-SHAPE", f"{'×'.join(map(str, matrix.shape)) or 'a single number'}, {size}×{size} needed"
        )
    fault = first_fault(matrix[None], rows, definite)
    if fault is not None:
        raise InputError("E-COVARIANCE-VALUE", fault.reason)


def _reason(matrix, odd, correlation, lowest: float, rows: Rows, definite: bool) -> str:
    """Return why one matrix is not a covariance; ``odd`` : asymmetry of its correlations."""
    variance, needed = np.diagonal(matrix), "a positive number" if definite else "0 or more"
    if not np.isfinite(matrix).all():
        return "a value is not finite, finite numbers needed"
    below = variance <= 0 if definite else np.diagonal(correlation) < 0
    if below.any() or variance.max() > LARGEST:
        k = int(np.argmax(below if below.any() else variance))
        needed = needed if below.any() else f"up to {LARGEST:g}"
        return f"variance {variance[k]:.3g} of {rows.names[k]}, {needed} needed"
    if odd.max() > ROUNDING * len(matrix):
        i, j = np.unravel_index(int(np.argmax(odd)), odd.shape)
        share = abs(matrix[i, j] - matrix[j, i]) / max(abs(matrix[i, j]), abs(matrix[j, i]))
        return f"not symmetric by {round(100 * share, 1):g} % at {rows.names[i]}, {rows.names[j]}"
    off = np.abs(correlation - np.diag(np.diagonal(correlation)))
    i, j = np.unravel_index(int(np.argmax(off)), off.shape)
    if off[i, j] > 1 + ROUNDING * len(matrix):
        named = f"{rows.names[i]} and {rows.names[j]}"
        return f"correlation {correlation[i, j]:.3g} of {named}, −1 to 1 needed"
    return f"its correlations have the eigenvalue {lowest:.3g}, {needed} needed"
