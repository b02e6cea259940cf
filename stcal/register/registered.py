"""Result of a registration, and its cross-validation."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from stcal.cross_validation import dealt, held_out_errors
from stcal.geometry.arrays import Array, Brief, ByValue, freeze, rms
from stcal.register.transforms import Problem, Transform, parts


@dataclass(frozen=True, slots=True)
class ErrorFigures:
    """Summary of the lengths |b − b_from_a a| of points' errors; NaN if there are no points."""

    points: int
    mean_mm: float
    rms_mm: float
    max_mm: float

    @classmethod
    def of(cls, lengths: np.ndarray) -> "ErrorFigures":
        """Returns the figures of lengths (n,), mm."""
        if not len(lengths):
            return cls(0, np.nan, np.nan, np.nan)
        return cls(len(lengths), float(lengths.mean()), rms(lengths), float(lengths.max()))


@dataclass(frozen=True, slots=True, eq=False)
class HeldOutPoints(ByValue):
    """Errors |b − b_from_a a| of points that were left out of the fit, by cross-validation.

    Parameters
    ----------
    folds : int
        Number of parts, each of which is left out once.
    rows : (m,) int array
        Indices of the tested points, a sample of very many.
    error_mm : (m,) array
    of_inliers, of_all : ErrorFigures
    """

    folds: int
    rows: Array
    error_mm: Array
    of_inliers: ErrorFigures
    of_all: ErrorFigures

    def __post_init__(self):
        freeze(self, "rows", (None,), "rows", int)
        freeze(self, "error_mm", (len(self.rows),), "held-out errors")


@dataclass(frozen=True, slots=True, eq=False)
class Alternative(ByValue):
    """Another transform that fits other points as well as the result fits its own.

    Parameters
    ----------
    b_from_a : Rigid, Similarity or Affine
        Transform as in :class:`Registration`.
    rows : (m,) int array
        Indices of its points.
    apart_mm : float
        RMS distance between the two transforms over all points.
    turn_rad : float
        Angle between their rotations.
    """

    b_from_a: Transform
    rows: Array
    apart_mm: float
    turn_rad: float

    def __post_init__(self):
        freeze(self, "rows", (None,), "rows", int)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True, repr=False)
class Registration(Brief):
    """The transform between two instruments' frames.

    Parameters
    ----------
    model, method : str
        ``rigid``, ``similarity`` or ``affine``; ``robust``, ``least-squares`` or ``liu2017``.
    b_from_a : Rigid, Similarity or Affine
    covariance : (6, 6), (7, 7) or (12, 12) array
        Covariance of a left perturbation in frame b: rotation vector (rad), translation (mm), and a similarity's
        relative scale; affine: rows of the 3×4 matrix. σ is estimated with ``redundancy`` degrees of freedom, so that a
        confidence region takes its bound from F(p, redundancy), not from χ².
    inliers : (n,) bool array
        Points that the transform is fitted to.
    residuals : (n, 3) array
        b − b_from_a a of all points, mm, frame b.
    sigma_mm : float
        σ per axis of a residual; the RMS for points of different σ.
    sigma_factor : float or None
        Ratio of the inliers' residuals to the σ given with the data; None if none was given. The covariance is scaled
        by it only if the data contradict the given σ (``scaled``).
    scaled : bool
        Whether the covariance is derived from the residuals; False if it is derived from the given σ.
    redundancy : float
        Degrees of freedom of the σ that the covariance is derived from; infinite if this σ was given.
    threshold_mm : float or None
        Largest distance of inliers, for a point of the σ above at the points' middle; None without a threshold.
    held_out : HeldOutPoints or None
        Cross-validation; None if it was not requested, or there are too few points.
    ambiguous : bool
        Whether the alternative is about as good.
    alternative : Alternative or None
    notes : tuple of str
        Notes on what the user should check.
    seed, samples : int
        Seed and number of the random samples; 0 samples if all possible ones were tried.
    """

    model: str
    method: str
    b_from_a: Transform
    covariance: Array
    inliers: Array
    residuals: Array
    sigma_mm: float
    redundancy: float
    threshold_mm: float | None
    sigma_factor: float | None = None
    scaled: bool = True
    held_out: HeldOutPoints | None = None
    ambiguous: bool = False
    alternative: Alternative | None = None
    notes: tuple[str, ...] = ()
    seed: int = 0
    samples: int = 0

    def __post_init__(self):
        freeze(self, "residuals", (None, 3), "residuals")
        freeze(self, "inliers", (len(self.residuals),), "inliers", bool)
        p = len(self.covariance)
        freeze(self, "covariance", (p, p), "covariance")

    def __len__(self) -> int:
        return len(self.residuals)

    @property
    def inlier_errors(self) -> ErrorFigures:
        """Summary of the inliers' residuals."""
        return ErrorFigures.of(np.linalg.norm(self.residuals[self.inliers], axis=1))

    @property
    def outliers(self) -> np.ndarray:
        """Indices of the outliers, the farthest first."""
        rows = np.flatnonzero(~self.inliers)
        return rows[np.argsort(-np.linalg.norm(self.residuals[rows], axis=1), kind="stable")]

    @property
    def scales(self) -> np.ndarray:
        """Ratios (3,) of lengths in b to those in a, along the principal axes of the transform."""
        return np.linalg.svd(parts(self.b_from_a)[0], compute_uv=False)


TRIED = 20_000
"""Largest number of points that are all cross-validated. Of more, a sample is, whose errors are known to 1 %."""


def held_out(
    problem: Problem, fit_rows: Callable[[np.ndarray], Transform], inliers: np.ndarray, folds: int, seed: int
) -> HeldOutPoints | None:
    """Returns the errors of points left out of the fit in turn; None if too few are left, or every fold fails.

    ``fit_rows`` : fit to given rows; ``inliers`` : (n,) of the fit to all; ``folds`` : number of parts to leave out;
    ``seed`` : of the division.
    """
    rng = np.random.default_rng([seed, 2])
    sample = np.sort(rng.permutation(len(problem))[:TRIED])
    parts = [sample[part] for part in dealt(len(sample), folds, rng)]

    def errors(rest: np.ndarray, own: np.ndarray) -> np.ndarray:
        return np.linalg.norm(problem[own].residuals(fit_rows(rest)), axis=1)

    if not parts or len(sample) - len(parts[0]) <= problem.model.sample:
        return None
    done, rows, (error,) = held_out_errors([errors], parts)
    if not done:
        return None
    return HeldOutPoints(done, rows, error, ErrorFigures.of(error[inliers[rows]]), ErrorFigures.of(error))
