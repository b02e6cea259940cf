"""What a covariance is: the one place where those that come in are judged."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from stcal.errors import InputError

ROUNDING = 1e-5
"""By which correlations may be off, times their number of rows: files state six digits, and 1.00000 is 5e-6 off."""
LARGEST = 1e24
"""Variance in any unit: σ of 1e12 is more than all that is measured."""
TINY = 1e-300
"""In place of a variance of zero, so that there is no division by it."""


@dataclass(frozen=True, slots=True)
class Rows:
    """What the rows of a covariance are of: ``names``; ``nothing`` : variance of each that is zero but for rounding."""

    names: tuple[str, ...]
    nothing: float | tuple[float, ...] = 0.0

    @classmethod
    def of(cls, names: Iterable[str], axes: str) -> "Rows":
        """Of the coordinates, in mm, of several points."""
        return cls(tuple(f"{axis} of {name}" for name in names for axis in axes), NANOMETRE)


TWIST = ("rx", "ry", "rz", "x", "y", "z")
"""Rows of the covariance of a pose: rotation vector (rad) and translation (mm), left perturbation."""
NANOMETRE = 1e-12
"""Its square in mm²."""
NANORADIAN = 1e-18
"""Its square: what is a metre away moves by a nanometre."""
OF_POSE = Rows(TWIST, (*[NANORADIAN] * 3, *[NANOMETRE] * 3))
OF_POINT = Rows(("x", "y", "z"), NANOMETRE)
OF_PIXEL = Rows(("x", "y"))


@dataclass(frozen=True, slots=True)
class Fault:
    """``row`` : which of the matrices is none, from 0; ``reason`` : measured and needed."""

    row: int
    reason: str


def first_fault(matrices: np.ndarray, rows: Rows, definite: bool = False) -> Fault | None:
    """The first of many matrices that is no covariance.

    A covariance is finite, symmetric and without negative eigenvalues, up to rounding. Eigenvalues are those of the
    correlations, since the units of the rows differ.

    Parameters
    ----------
    matrices : (m, n, n) array
    rows : Rows
        Names of its rows, and which variances are no more than rounding.
    definite : bool
        Eigenvalues must be positive: it will be inverted.

    Returns
    -------
    Fault or None
        None where all are covariances.
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
        plain = (variance >= 0).all(axis=1) & (variance <= LARGEST).all(axis=1)
        plain &= (odd <= ROUNDING * size).all(axis=(1, 2))
        plain &= (np.abs(correlation) <= 1 + ROUNDING * size).all(axis=(1, 2))
    lowest = np.full(len(matrices), -np.inf)
    lowest[plain] = np.linalg.eigvalsh(correlation[plain])[:, 0]
    bad = np.flatnonzero(~(lowest > 0 if definite else lowest >= -ROUNDING * size))
    if not len(bad):
        return None
    row = int(bad[0])
    more = f" (and {len(bad) - 1} more)" if len(bad) > 1 else ""
    return Fault(row, _reason(matrices[row], odd[row], correlation[row], float(lowest[row]), rows, definite) + more)


def require_covariance(matrix: np.ndarray, size: int, rows: Rows, definite: bool = False) -> None:
    """Refuse what is no covariance of ``size`` rows, see :func:`first_fault`.

    Raises
    ------
    InputError
        Says what is measured and needed; whose covariance it is, is for the caller to say.
    """
    if matrix.shape != (size, size):
        raise InputError(
            "E-COVARIANCE-SHAPE", f"{'×'.join(map(str, matrix.shape)) or 'a single number'}, {size}×{size} needed"
        )
    fault = first_fault(matrix[None], rows, definite)
    if fault is not None:
        raise InputError("E-COVARIANCE-VALUE", fault.reason)


def _reason(matrix, odd, correlation, lowest: float, rows: Rows, definite: bool) -> str:
    """Why it is none; of one matrix, ``odd`` : by how much correlations differ from those across the diagonal."""
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
