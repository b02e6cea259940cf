"""What a registration gives."""

from dataclasses import dataclass

import numpy as np

from stcal.geometry.arrays import frozen
from stcal.register.core.models import Transform


@dataclass(frozen=True, slots=True, eq=False)
class HeldOut:
    """Errors |b − b_from_a a| of points that were left out of the fit, by cross-validation.

    ``folds`` : parts, each left out once; ``rows`` : (m,) indices of the points tried (a sample where there are very
    many); ``error_mm`` : (m,) of each; ``of_inliers`` and ``of_all`` : (mean, RMS, maximum), mm.
    """

    folds: int
    rows: np.ndarray
    error_mm: np.ndarray
    of_inliers: tuple[float, float, float]
    of_all: tuple[float, float, float]

    def __post_init__(self):
        object.__setattr__(self, "rows", frozen(self.rows, (None,), "rows", int))
        object.__setattr__(self, "error_mm", frozen(self.error_mm, (len(self.rows),), "held-out errors"))


@dataclass(frozen=True, slots=True, eq=False)
class Alternative:
    """Another transform, which fits other points as well as the one found fits its own.

    ``b_from_a`` : as of :class:`Registration`; ``rows`` : (m,) indices of its points; ``apart_mm`` : RMS distance
    between the two transforms over all points; ``turn_rad`` : angle between them (0 for affine ones).
    """

    b_from_a: Transform
    rows: np.ndarray
    apart_mm: float
    turn_rad: float

    def __post_init__(self):
        object.__setattr__(self, "rows", frozen(self.rows, (None,), "rows", int))


@dataclass(frozen=True, slots=True, eq=False)
class Registration:
    """The transform between two instruments' frames.

    Parameters
    ----------
    model, method : str
        ``rigid``, ``similarity`` or ``affine``; ``robust``, ``least-squares`` or ``liu2017``.
    b_from_a : Rigid, Similarity or Affine
    covariance : (6, 6), (7, 7) or (12, 12) array
        Of a left perturbation in frame b: rotation vector (rad), translation (mm), and a similarity's relative scale;
        affine: the rows of the 3×4 matrix. σ is estimated with ``dof`` degrees of freedom: a region of confidence
        takes its bound from F(p, dof), not from χ².
    inliers : (n,) bool array
        The points that the transform is fitted to.
    residuals : (n, 3) array
        b − b_from_a a of all points, mm, frame b.
    sigma_mm : float
        σ per axis of a residual; of points of different σ their RMS.
    sigma_factor : float or None
        By how much the inliers' residuals exceed the σ given with the data; None where none was given. The covariance
        is scaled by it only where the data contradict the σ given (``scaled``).
    scaled : bool
        Whether the covariance rests on the residuals; False where it rests on the σ given.
    dof : float
        Degrees of freedom of the σ that the covariance rests on; infinite where that was given.
    threshold_mm : float or None
        Inliers are nearer than this (a point of the σ above; at the points' middle); None without a threshold.
    mean_mm, rms_mm, max_mm : float
        Of the inliers' residual lengths.
    held_out : HeldOut or None
        None where not asked for, or with too few points.
    ambiguous : bool
        The alternative is about as good.
    alternative : Alternative or None
    notes : tuple of str
        What to look at.
    seed, samples : int
        Of the random samples, and how many were drawn; 0 where all there are were tried.
    """

    model: str
    method: str
    b_from_a: Transform
    covariance: np.ndarray
    inliers: np.ndarray
    residuals: np.ndarray
    sigma_mm: float
    dof: float
    threshold_mm: float | None
    mean_mm: float
    rms_mm: float
    max_mm: float
    sigma_factor: float | None = None
    scaled: bool = True
    held_out: HeldOut | None = None
    ambiguous: bool = False
    alternative: Alternative | None = None
    notes: tuple[str, ...] = ()
    seed: int = 0
    samples: int = 0

    def __post_init__(self):
        object.__setattr__(self, "residuals", frozen(self.residuals, (None, 3), "residuals"))
        object.__setattr__(self, "inliers", frozen(self.inliers, (len(self.residuals),), "inliers", bool))
        p = len(self.covariance)
        object.__setattr__(self, "covariance", frozen(self.covariance, (p, p), "covariance"))

    def __len__(self) -> int:
        return len(self.residuals)

    @property
    def outliers(self) -> np.ndarray:
        """Indices of the points that are no inliers, the farthest first."""
        rows = np.flatnonzero(~self.inliers)
        return rows[np.argsort(-np.linalg.norm(self.residuals[rows], axis=1), kind="stable")]
