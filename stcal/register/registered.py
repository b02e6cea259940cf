"""What a registration takes and gives: pairs of points from files, the result, and its cross-validation."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement
from pathlib import Path

import numpy as np

from stcal.cross_validation import dealt, held_out_errors
from stcal.errors import InputError
from stcal.geometry.arrays import OF_POINT, Array, Brief, ByValue, freeze, require_arguments, require_fields, rms
from stcal.io.join import join_tables
from stcal.io.table import LENGTHS, Table, read_table
from stcal.register.consensus import Problem, Transform, linear_part

WHAT = "point pairs"
COVARIANCE = tuple(f"cov_{a}_{b}" for a, b in combinations_with_replacement(OF_POINT.names, 2))
"""Names of the upper triangle, mm², of the covariance of b − b_from_a a in frame b."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Pairs(Brief):
    """Pairs of points of two frames from a file, with weights, covariances or neither.

    ``where`` : name of the file; ``lines`` : lines of the file; ``xyz_a``, ``xyz_b`` : (n, 3) points in mm, each in its
    own frame; row i of both is the same point; ``weights`` : (n,) weights, proportional to 1/σ²; ``covariances`` : (n,
    3, 3) or (n,) covariances, or variances per axis, of b − b_from_a a in frame b, mm²; ``notes`` : on points of only
    one of two files. Raises InputError: shapes do not fit, or values are not finite.
    """

    where: str
    lines: Sequence[int]
    xyz_a: Array
    xyz_b: Array
    weights: np.ndarray | None = None
    covariances: np.ndarray | None = None
    notes: tuple[str, ...] = ()

    def __post_init__(self):
        require_fields(self, "point pairs")
        n = len(self.lines)
        freeze(self, "xyz_a", (n, 3), "points of a")
        freeze(self, "xyz_b", (n, 3), "points of b")
        if self.weights is not None:
            freeze(self, "weights", (n,), "weights")
        if self.covariances is not None:
            shape = (n,) if np.ndim(self.covariances) == 1 else (n, 3, 3)
            freeze(self, "covariances", shape, "covariances")

    def __len__(self) -> int:
        return len(self.lines)


@require_arguments
def read_pairs(path: str | Path | Table, second: str | Path | Table | None = None, *, key: str = "name") -> Pairs:
    """Reads ``ax_mm, ay_mm, az_mm, bx_mm, by_mm, bz_mm`` and the stated noise (form: ``data_layout.md``).

    Parameters
    ----------
    path : A table of both; or of the points of a alone, as ``x_mm, y_mm, z_mm``.
    second : table of the points of b alone, as ``x_mm, y_mm, z_mm``.
    key : column of both tables that names the points; or ``name=Point Name``, that of a and that of b.

    Raises InputError: columns are missing or a row is invalid: text, values that are not finite, a repeated pair,
    weights or σ that are not positive. The message names the line.
    """
    notes = ()
    if second is not None:
        joined = join_tables(path, second, key, ("a", "b"))
        table, notes = joined.table, joined.notes
    else:
        table = read_table(path, WHAT)
    xyz_a, xyz_b = table.points("a"), table.points("b")
    _no_pair_twice(table, np.hstack([xyz_a, xyz_b]))
    given = {
        "weight": "weight" in table,
        "sigma": table.has("sigma", LENGTHS),
        "cov_…": any(name in table for name in COVARIANCE),
    }
    kinds = [name for name, there in given.items() if there]
    if len(kinds) > 1:
        fault = f"{table.where}: columns {' and '.join(kinds)}"
        remedy = "only one of weight, sigma_mm, or cov_x_x … cov_z_z needed"
        raise InputError("E-TABLE-COLUMNS-CONFLICT", f"{fault}; {remedy}")
    weights = covariances = None
    if kinds == ["weight"]:
        weights = _positive(table, "weight", table.numbers("weight"))
    elif kinds == ["sigma"]:
        covariances = _positive(table, "sigma", table.quantity("sigma", LENGTHS)) ** 2
    elif kinds:
        missing = [name for name in COVARIANCE if name not in table]
        if missing:
            fault = f"{table.where}: {missing[0]} is missing"
            raise InputError("E-TABLE-COLUMN-MISSING", f"{fault}; all {len(COVARIANCE)} columns cov_… or none needed")
        covariances = np.empty((len(table), 3, 3))
        i, j = np.triu_indices(3)
        covariances[:, i, j] = covariances[:, j, i] = np.column_stack([table.numbers(name) for name in COVARIANCE])
        table.require_covariances(covariances, OF_POINT)
    return Pairs(table.where, table.lines, xyz_a, xyz_b, weights, covariances, notes)


def _no_pair_twice(table: Table, rows: np.ndarray) -> None:
    order = np.lexsort(rows.T)
    same = np.flatnonzero((rows[order[1:]] == rows[order[:-1]]).all(1))
    first_of = dict(zip(order[same + 1].tolist(), order[same].tolist(), strict=True))
    remedy = "remove it, or give one of them twice the weight"
    table.refuse(
        np.isin(np.arange(len(rows)), list(first_of)),
        "E-TABLE-ROW-REPEATED",
        lambda i: f"the same pair as on line {table.lines[first_of[i]]}; {remedy}",
    )


def _positive(table: Table, name: str, values: np.ndarray) -> np.ndarray:
    needed = "a positive number needed; remove a row to give it no weight"
    table.refuse(values <= 0, "E-SIGMA-VALUE", lambda i: f"{name} is {values[i]:g}, {needed}")
    return values


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
        figures = (lengths.mean(), rms(lengths), lengths.max()) if len(lengths) else [np.nan] * 3
        return cls(len(lengths), *map(float, figures))


@dataclass(frozen=True, slots=True, eq=False)
class HeldOutPoints(ByValue):
    """Errors |b − b_from_a a| of points that were left out of the fit, by cross-validation.

    ``folds`` : parts, each left out once; ``rows`` : (m,) of the tested points, a sample of very many; ``error_mm`` :
    (m,); ``of_inliers``, ``of_all`` : their figures.
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
    """Another transform ``b_from_a`` that fits other points as well as the result fits its own.

    ``rows`` : (m,) of its points; ``apart_mm`` : RMS distance between the transforms over all points; ``turn_rad`` :
    angle between their rotations.
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
    model, method : ``rigid``, ``similarity`` or ``affine``; ``robust``, ``least-squares`` or ``liu2017``.
    b_from_a : Rigid, Similarity or Affine
    covariance : (6, 6), (7, 7) or (12, 12) covariance of a left perturbation in frame b: rotation vector (rad),
        translation (mm), and a similarity's relative scale; affine: rows of the 3×4 matrix. σ is estimated with
        ``redundancy`` degrees of freedom, so that a confidence region takes its bound from F(p, redundancy), not from
        χ².
    inliers : (n,) points that the transform is fitted to.
    residuals : (n, 3) b − b_from_a a of all points, mm, frame b.
    sigma_mm : σ per axis of a residual; the RMS for points of different σ.
    sigma_factor : ratio of the inliers' residuals to the σ given with the data; None if none was given. The covariance
        is scaled by it only if the data contradict the given σ (``scaled``).
    scaled : whether the covariance is derived from the residuals; False if it is derived from the given σ.
    redundancy : degrees of freedom of the σ that the covariance is derived from; infinite if this σ was given.
    threshold_mm : largest distance of inliers, for a point of the σ above at the points' middle; None without a
        threshold.
    held_out : cross-validation; None if it was not requested, or there are too few points.
    ambiguous : whether the alternative is about as good.
    alternative : Alternative or None
    notes : notes on what the user should check.
    seed, samples : seed and number of the random samples; 0 samples if all possible ones were tried.
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
        return np.linalg.svd(linear_part(self.b_from_a), compute_uv=False)


TRIED = 20_000
"""Largest number of points that are all cross-validated. Of more, a sample is, whose errors are known to 1 %."""


def held_out(
    problem: Problem, fit_rows: Callable[[np.ndarray], Transform], inliers: np.ndarray, folds: int, seed: int
) -> HeldOutPoints | None:
    """Returns the errors of points left out of the fit in turn; None if too few are left, or every fold fails.
    ``fit_rows`` : fit to given rows; ``inliers`` : (n,) of the fit to all; ``folds`` : parts; ``seed`` : of these."""
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
