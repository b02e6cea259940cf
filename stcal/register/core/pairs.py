"""Files of corresponding points: the same points as two instruments saw them, one pair a line."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stcal.errors import InputError
from stcal.geometry.arrays import Array, freeze
from stcal.io.covariance import OF_POINT
from stcal.io.table import LENGTHS, Table, read_table

WHAT = "point pairs"
AXES = OF_POINT.names
COVARIANCE = tuple(f"cov_{a}_{b}" for i, a in enumerate(AXES) for b in AXES[i:])
"""Upper triangle, mm², of the covariance of b − b_from_a a in frame b."""
KINDS = "weight, sigma_mm, or cov_x_x … cov_z_z"


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """The corresponding points of two frames, as read from a file, with weights, covariances or neither.

    Parameters
    ----------
    where : str
        The file.
    lines : sequence of n int
        Its lines.
    xyz_a, xyz_b : (n, 3) arrays
        mm, each in its own frame; row i of both is the same point.
    weights : (n,) array or None
        ~ 1/σ².
    covariances : (n, 3, 3) or (n,) array, or None
        Covariances, or variances per axis, of b − b_from_a a in frame b, mm².

    Raises
    ------
    InputError
        Shapes that do not fit, or values that are not finite.
    """

    where: str
    lines: Sequence[int]
    xyz_a: Array
    xyz_b: Array
    weights: np.ndarray | None = None
    covariances: np.ndarray | None = None

    def __post_init__(self):
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


def read_pairs(path: str | Path | Table) -> Pairs:
    """Read ``ax_mm, ay_mm, az_mm, bx_mm, by_mm, bz_mm`` and what noise they have (form: ``data_layout.md``).

    Parameters
    ----------
    path : str or Path
        A table.

    Returns
    -------
    Pairs

    Raises
    ------
    InputError
        Missing columns, or bad rows: text, values that are not finite, a pair twice, weights or σ that are not
        positive; the message names the line.
    """
    table = read_table(path, WHAT)
    xyz_a, xyz_b = table.points("a"), table.points("b")
    _no_pair_twice(table, np.hstack([xyz_a, xyz_b]))
    given = [
        name
        for name, there in (
            ("weight", "weight" in table),
            ("sigma", table.has("sigma", LENGTHS)),
            ("cov_…", any(name in table for name in COVARIANCE)),
        )
        if there
    ]
    if len(given) > 1:
        raise InputError(
            "E-TABLE-COLUMNS-CONFLICT", f"{table.where}: columns {' and '.join(given)}; only one of {KINDS} needed"
        )
    weights = covariances = None
    if given == ["weight"]:
        weights = _positive(table, "weight", table.numbers("weight"))
    elif given == ["sigma"]:
        covariances = _positive(table, "sigma", table.quantity("sigma", LENGTHS)) ** 2
    elif given:
        covariances = _covariances(table)
    return Pairs(table.where, table.lines, xyz_a, xyz_b, weights, covariances)


def _no_pair_twice(table: Table, rows: np.ndarray) -> None:
    """Equal rows have equal sums of any weights: one sort, and no table of a million tuples."""
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
