"""Files of pairs of points of two instruments, with their noise."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement
from pathlib import Path

import numpy as np

from stcal.errors import InputError
from stcal.geometry.arrays import OF_POINT, Array, Brief, freeze, require_arguments, require_fields
from stcal.io.join import join_tables
from stcal.io.table import LENGTHS, Table, read_table

WHAT = "point pairs"
COVARIANCE = tuple(f"cov_{a}_{b}" for a, b in combinations_with_replacement(OF_POINT.names, 2))
"""Names of the upper triangle, mm², of the covariance of b − b_from_a a in frame b."""


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
            "E-TABLE-COLUMNS-CONFLICT",
            f"{table.where}: columns {' and '.join(kinds)}; only one of weight, sigma_mm, or cov_x_x … cov_z_z needed",
        )
    weights = covariances = None
    if kinds == ["weight"]:
        weights = _positive(table, "weight", table.numbers("weight"))
    elif kinds == ["sigma"]:
        covariances = _positive(table, "sigma", table.quantity("sigma", LENGTHS)) ** 2
    elif kinds:
        missing = [name for name in COVARIANCE if name not in table]
        if missing:
            raise InputError(
                "E-TABLE-COLUMN-MISSING",
                f"{table.where}: {missing[0]} is missing; all {len(COVARIANCE)} columns cov_… or none needed",
            )
        covariances = np.empty((len(table), 3, 3))
        i, j = np.triu_indices(3)
        covariances[:, i, j] = covariances[:, j, i] = np.column_stack([table.numbers(name) for name in COVARIANCE])
        table.require_covariances(covariances, OF_POINT)
    return Pairs(table.where, table.lines, xyz_a, xyz_b, weights, covariances, notes)


def _no_pair_twice(table: Table, rows: np.ndarray) -> None:
    """Refuses a repeated pair: equal rows have equal weighted sums, so that one sort replaces a table of tuples."""
    key = rows @ np.random.default_rng(0).uniform(1, 2, rows.shape[1])
    order = np.argsort(key, kind="stable")
    near = np.flatnonzero(np.diff(key[order]) == 0)
    same = near[(rows[order[near]] == rows[order[near + 1]]).all(1)]
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
