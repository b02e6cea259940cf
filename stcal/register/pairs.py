"""Pairs of points of two instruments: their files and their noise."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from stcal.errors import InputError
from stcal.geometry.arrays import Array, Brief, freeze, require_arguments, require_fields
from stcal.io.covariance import OF_POINT, first_fault
from stcal.io.join import join_tables
from stcal.io.table import LENGTHS, Table, read_table
from stcal.register.models import Model, Transform, fit, squares, whitened

WHAT = "point pairs"
AXES = OF_POINT.names
COVARIANCE = tuple(f"cov_{a}_{b}" for i, a in enumerate(AXES) for b in AXES[i:])
"""Names of the upper triangle, mm², of the covariance of b − b_from_a a in frame b."""
KINDS = "weight, sigma_mm, or cov_x_x … cov_z_z"


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Pairs(Brief):
    """Pairs of points of two frames from a file, with weights, covariances or neither.

    Parameters
    ----------
    where : str
        Name of the file.
    lines : sequence of n int
        Lines of the file.
    xyz_a, xyz_b : (n, 3) arrays
        Points in mm, each in its own frame; row i of both is the same point.
    weights : (n,) array or None
        Weights, proportional to 1/σ².
    covariances : (n, 3, 3) or (n,) array, or None
        Covariances, or variances per axis, of b − b_from_a a in frame b, mm².
    notes : tuple of str
        On points of only one of two files.

    Raises
    ------
    InputError
        If shapes do not fit, or values are not finite.
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
def read_pairs(
    path: str | Path | Table,
    second: str | Path | Table | None = None,
    *,
    key: str = "name",
) -> Pairs:
    """Reads ``ax_mm, ay_mm, az_mm, bx_mm, by_mm, bz_mm`` and the stated noise (form: ``data_layout.md``).

    Parameters
    ----------
    path : str, Path or Table
        A table of both; or of the points of a alone, as ``x_mm, y_mm, z_mm``.
    second : str, Path or Table, optional
        Table of the points of b alone, as ``x_mm, y_mm, z_mm``.
    key : str
        Column of both tables that names the points; or ``name=Point Name``, that of a and that of b.

    Returns
    -------
    Pairs

    Raises
    ------
    InputError
        If columns are missing or a row is invalid: text, values that are not finite, a repeated pair, weights or σ that
        are not positive. The message names the line.
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
        raise InputError(
            "E-TABLE-COLUMNS-CONFLICT", f"{table.where}: columns {' and '.join(kinds)}; only one of {KINDS} needed"
        )
    weights = covariances = None
    if kinds == ["weight"]:
        weights = _positive(table, "weight", table.numbers("weight"))
    elif kinds == ["sigma"]:
        covariances = _positive(table, "sigma", table.quantity("sigma", LENGTHS)) ** 2
    elif kinds:
        covariances = _covariances(table)
    return Pairs(table.where, table.lines, xyz_a, xyz_b, weights, covariances, notes)


def _no_pair_twice(table: Table, rows: np.ndarray) -> None:
    """Refuses a repeated pair: equal rows have equal weighted sums, so that one sort replaces a table of tuples."""
    key = rows @ np.random.default_rng(0).uniform(1, 2, rows.shape[1])
    order = np.argsort(key, kind="stable")
    near = np.flatnonzero(np.diff(key[order]) == 0)
    same = near[(rows[order[near]] == rows[order[near + 1]]).all(1)]
    if len(same):
        first, again = sorted((int(order[same[0]]), int(order[same[0] + 1])))
        more = f" (and {len(same) - 1} more)" if len(same) > 1 else ""
        raise InputError(
            "E-TABLE-ROW-REPEATED",
            f"{table.where}: line {table.lines[again]}: the same pair as on line {table.lines[first]}{more}; remove "
            "it, or give one of them twice the weight",
        )


def _positive(table: Table, name: str, values: np.ndarray) -> np.ndarray:
    bad = np.flatnonzero(values <= 0)
    if len(bad):
        more = f" (and {len(bad) - 1} more)" if len(bad) > 1 else ""
        raise InputError(
            "E-SIGMA-VALUE",
            f"{table.where}: line {table.lines[bad[0]]}: {name} is {values[bad[0]]:g}, a positive number needed{more}; "
            "remove a row to give it no weight",
        )
    return values


def _covariances(table: Table) -> np.ndarray:
    missing = [name for name in COVARIANCE if name not in table]
    if missing:
        raise InputError(
            "E-TABLE-COLUMN-MISSING",
            f"{table.where}: {missing[0]} is missing; all {len(COVARIANCE)} columns cov_… or none needed",
        )
    full = np.empty((len(table), 3, 3))
    i, j = np.triu_indices(3)
    full[:, i, j] = full[:, j, i] = np.column_stack([table.numbers(name) for name in COVARIANCE])
    table.require_covariances(full, OF_POINT)
    return full


@dataclass(frozen=True, slots=True, eq=False)
class PointNoise:
    """``precision`` : (n,) inverse variances or covariances, frame b, scaled to mean σ 1 (the RMS of all σ), so that
    whitened residuals are mm of such a point; None if equal and isotropic; ``sigma_mm`` : mean σ if given."""

    precision: np.ndarray | None = None
    sigma_mm: float | None = None

    def __getitem__(self, rows: np.ndarray) -> "PointNoise":
        """Returns the noise of the points selected by a mask or by indices."""
        return self if self.precision is None else PointNoise(self.precision[rows], self.sigma_mm)


EXACT = 1e-11
"""Relative σ, as a share of the coordinates' size, below which residuals are rounding errors."""
SHOWN = 5
"""Number of rows that a message names."""


def some_of(items: Sequence | np.ndarray, say: Callable[[Any], str]) -> str:
    """Returns the first of some items in words, and the number of others."""
    more = f" and {len(items) - SHOWN} more" if len(items) > SHOWN else ""
    return ", ".join(say(item) for item in items[:SHOWN]) + more


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """Point pairs (n, 3) mm, neither copied nor checked, as subsets are taken in inner loops, and a model.

    ``lines`` : of a file, by which messages name all points; subsets have none.
    """

    model: Model
    xyz_a: np.ndarray
    xyz_b: np.ndarray
    noise: PointNoise
    lines: Sequence[int] | None = None

    def __len__(self) -> int:
        return len(self.xyz_a)

    def __getitem__(self, rows: np.ndarray) -> "Problem":
        """Returns the point pairs selected by a mask or by indices."""
        return Problem(self.model, self.xyz_a[rows], self.xyz_b[rows], self.noise[rows])

    def name(self, row: Any) -> str:
        """Returns a point's name for messages: its line in the file, else its row from 1."""
        return f"row {row + 1}" if self.lines is None else f"line {self.lines[row]}"

    def names(self, rows: np.ndarray) -> str:
        """Returns the names of the first of some points, and the number of others."""
        return some_of(rows, self.name)

    @property
    def redundancy(self) -> int:
        """Redundancy of a fit to all points."""
        return self.model.redundancy(len(self))

    def fit(self) -> Transform:
        """Returns the least-squares b_from_a; errors as in :func:`~stcal.register.models.fit`."""
        return fit(self.model, self.xyz_a, self.xyz_b, self.noise.precision)

    def residuals(self, b_from_a: Transform) -> np.ndarray:
        """Returns b − b_from_a a, (n, 3) mm, frame b."""
        return self.xyz_b - b_from_a @ self.xyz_a

    def squares(self, b_from_a: Transform) -> np.ndarray:
        """Returns rᵀ P r, (n,), mm² of a point of mean σ."""
        return squares(self.residuals(b_from_a), self.noise.precision)

    def whitened(self, b_from_a: Transform) -> np.ndarray:
        """Returns the whitened residuals (n, 3), mm of a point of mean σ."""
        return whitened(self.residuals(b_from_a), self.noise.precision)

    def rounding_mm(self) -> float:
        """Returns the rounding error of residuals, mm. It is robust against wrong points of any size."""
        return EXACT * float(max(np.median(np.abs(xyz).max(1)) for xyz in (self.xyz_a, self.xyz_b)))


def noise_of(n: int, weights: np.ndarray | None, covariances: np.ndarray | None) -> PointNoise:
    """Returns the noise that (n,) weights, in 1/σ², or (n, 3, 3) covariances, or variances per axis, of b − b_from_a a
    in frame b, mm², state. Raises InputError: both are given, a wrong shape, or not positive."""
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
    if matrices:
        fault = first_fault(given, OF_POINT, definite=True)
        trouble = fault and f"row {fault.row + 1}: {fault.reason}"
    else:
        bad = np.flatnonzero(~(np.isfinite(given) & (given > 0)))
        trouble = f"row {bad[0] + 1} has {given[bad[0]]:.3g}, a positive number needed" if len(bad) else None
    if trouble:
        raise InputError("E-REGISTER-WEIGHTS", f"registration: {name}: {trouble}; leave a row out to give it no weight")
    if name == "weights":
        return PointNoise(given * np.mean(1 / given))
    variance = float(np.mean(np.trace(given, axis1=1, axis2=2) / 3 if matrices else given))
    return PointNoise((np.linalg.inv(given) if matrices else 1 / given) * variance, float(np.sqrt(variance)))
