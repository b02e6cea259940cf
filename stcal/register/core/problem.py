"""Point pairs that one transform is to explain, and the noise they are known to have."""

from dataclasses import dataclass

import numpy as np

from stcal.errors import InputError
from stcal.io.covariance import OF_POINT, first_fault
from stcal.register.core.models import Model, Transform, fit, rounding_mm, squares, whitened


@dataclass(frozen=True, slots=True, eq=False)
class PointNoise:
    """What is known of the residuals' noise.

    Inverse covariances are scaled so that a point of mean σ (the RMS of all σ) has σ = 1: whitened residuals are
    millimetres of such a point.

    Parameters
    ----------
    precision : (n,) or (n, 3, 3) array, or None
        Inverse variances or covariances at mean σ 1, frame b; None where all noise is equal and isotropic.
    sigma_mm : float or None
        That mean σ where it was given in mm.
    """

    precision: np.ndarray | None = None
    sigma_mm: float | None = None

    def __getitem__(self, rows: np.ndarray) -> "PointNoise":
        """Returns the noise of the points selected by a mask or by indices."""
        return self if self.precision is None else PointNoise(self.precision[rows], self.sigma_mm)


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """Point pairs of one model. Neither copied nor checked: subsets are taken in inner loops.

    Parameters
    ----------
    model : Model
    xyz_a, xyz_b : (n, 3) arrays
        mm; row i of both is the same point.
    noise : PointNoise
    """

    model: Model
    xyz_a: np.ndarray
    xyz_b: np.ndarray
    noise: PointNoise

    def __len__(self) -> int:
        return len(self.xyz_a)

    def __getitem__(self, rows: np.ndarray) -> "Problem":
        """The point pairs chosen by a mask or by indices."""
        return Problem(self.model, self.xyz_a[rows], self.xyz_b[rows], self.noise[rows])

    @property
    def redundancy(self) -> int:
        """Redundancy of a fit to all points."""
        return self.model.redundancy(len(self))

    def fit(self) -> Transform:
        """b_from_a of least squares; errors as of :func:`~stcal.register.core.models.fit`."""
        return fit(self.model, self.xyz_a, self.xyz_b, self.noise.precision)

    def residuals(self, b_from_a: Transform) -> np.ndarray:
        """(n, 3) b − b_from_a a, mm, frame b."""
        return self.xyz_b - b_from_a @ self.xyz_a

    def squares(self, b_from_a: Transform) -> np.ndarray:
        """(n,) rᵀ P r, mm² of a point of mean σ."""
        return squares(self.residuals(b_from_a), self.noise.precision)

    def whitened(self, b_from_a: Transform) -> np.ndarray:
        """(n, 3) residuals, mm of a point of mean σ."""
        return whitened(self.residuals(b_from_a), self.noise.precision)

    def rounding_mm(self) -> float:
        """What of residuals rounding of numbers may make."""
        return rounding_mm(self.xyz_a, self.xyz_b)


def noise_of(n: int, weights: np.ndarray | None, covariances: np.ndarray | None) -> PointNoise:
    """The noise that weights or covariances state.

    Parameters
    ----------
    n : int
        Number of point pairs.
    weights : (n,) array, optional
        ~ 1/σ².
    covariances : (n, 3, 3) or (n,) array, optional
        Covariances, or variances per axis, of b − b_from_a a in frame b, mm².

    Returns
    -------
    PointNoise

    Raises
    ------
    InputError
        Both given, another shape, or weights and covariances that are not positive.
    """
    if weights is not None and covariances is not None:
        raise InputError("E-REGISTER-WEIGHTS", "registration: weights and covariances given; give only one of them")
    if weights is None and covariances is None:
        return PointNoise()
    name = "weights" if covariances is None else "covariances"
    given = np.asarray(weights if covariances is None else covariances, float)
    if given.shape != (n,) and (name == "weights" or given.shape != (n, 3, 3)):
        raise InputError(
            "E-ARRAY-SHAPE", f"registration: {name} of shape {given.shape} for {n} point pairs; one for each needed"
        )
    matrices = given.ndim == 3
    _require_positive(given, name)
    if name == "weights":
        return PointNoise(given * np.mean(1 / given))
    variance = float(np.mean(np.trace(given, axis1=1, axis2=2) / 3 if matrices else given))
    return PointNoise((np.linalg.inv(given) if matrices else 1 / given) * variance, float(np.sqrt(variance)))


def _require_positive(given: np.ndarray, name: str) -> None:
    """Refuse weights or variances (n,), or covariances (n, 3, 3), that are not positive."""
    if given.ndim == 3:
        fault = first_fault(given, OF_POINT, definite=True)
        trouble = fault and f"row {fault.row + 1}: {fault.reason}"
    else:
        bad = np.flatnonzero(~(np.isfinite(given) & (given > 0)))
        trouble = f"row {bad[0] + 1} has {given[bad[0]]:.3g}, a positive number needed" if len(bad) else None
    if trouble:
        raise InputError("E-REGISTER-WEIGHTS", f"registration: {name}: {trouble}; leave a row out to give it no weight")
