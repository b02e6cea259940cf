"""CSV files with a header: units stand in the names of the columns, and messages name the line of a bad row."""

import csv
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stcal.errors import InputError
from stcal.geometry.rigid import Poses, Rigid
from stcal.io.covariance import OF_POSE, TWIST, Rows, first_fault
from stcal.io.files import TABLE_BYTES, read_bytes
from stcal.io.quaternions import COLUMNS as QUATERNION
from stcal.io.quaternions import Order, require_unit

LENGTHS = {"mm": 1.0, "m": 1000.0, "um": 1e-3, "cm": 10.0, "in": 25.4}
UNIT_WORDS = {"m": "metres", "in": "inches", "cm": "centimetres"}
"""Names of units in which lengths are stated by mistake."""
ANGLES = {"rad": 1.0, "deg": np.pi / 180}
FARTHEST = 1e12
"""Largest value in any unit: it exceeds anything that is measured, and its square does not overflow."""
COVARIANCE = tuple(f"cov_{a}_{b}" for i, a in enumerate(TWIST) for b in TWIST[i:])
"""Upper triangle of a pose covariance, rows first: rotation vector (rad) and translation (mm), left perturbation."""
COMMON = re.compile(r"common\d+_.+")
"""Names of columns with errors that all poses have in common."""
POSE = ("x_mm", "y_mm", "z_mm", *QUATERNION)


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """The rows of a CSV file.

    ``lines`` : (m,) line number of each row in the file, from 1; ``quaternions`` : order of quaternion components;
    ``rows`` : (m,) text of the lines if all columns are numbers, since a name such as 01 must be kept.
    """

    where: str
    columns: dict[str, list[str] | np.ndarray]
    lines: Sequence[int]
    quaternions: Order = "wxyz"
    rows: Sequence[str] = ()

    def __len__(self) -> int:
        return len(self.lines)

    def __contains__(self, column: str) -> bool:
        return column in self.columns

    def text(self, column: str) -> list[str]:
        """Return the text of a column, without surrounding white space."""
        self._need(column)
        values = self.columns[column]
        if isinstance(values, list):
            return values
        if self.rows:
            at = list(self.columns).index(column)
            return [row.split(",")[at].strip() for row in self.rows]
        return [f"{v:.15g}" for v in values]

    def numbers(self, column: str) -> np.ndarray:
        """Return the finite numbers (m,) of a column."""
        self._need(column)
        values = self.columns[column]
        if not isinstance(values, np.ndarray):
            try:
                values = np.array(values, dtype=float)
            except ValueError:
                values = np.array([_number(v) for v in values])
        bad = np.flatnonzero(~np.isfinite(values))
        if len(bad):
            shown = self.columns[column][bad[0]]
            suffix = f" (and {len(bad) - 1} more)" if len(bad) > 1 else ""
            raise InputError(
                "E-TABLE-NUMBER",
                f"{self.where}: line {self.lines[bad[0]]}: {column} is {str(shown)!r}, a finite number needed{suffix}",
            )
        return values

    def quantity(self, name: str, units: dict[str, float]) -> np.ndarray:
        """Return the values (m,) of the column ``name_unit``, in mm or rad."""
        column = f"{name}_{self.unit(name, units)}"
        return self._near(column) * units[self.unit(name, units)]

    def _near(self, column: str) -> np.ndarray:
        """Return the values (m,) of a column; refuse values whose squares may overflow."""
        values = self.numbers(column)
        far = np.flatnonzero(np.abs(values) > FARTHEST)
        if len(far):
            raise InputError(
                "E-VALUE-TOO-FAR",
                f"{self.where}: line {self.lines[far[0]]}: {column} is {values[far[0]]:g}, up to {FARTHEST:g} possible",
            )
        return values

    def unit(self, name: str, units: dict[str, float]) -> str:
        """Return the unit in which ``name`` is given."""
        given = [unit for unit in units if f"{name}_{unit}" in self.columns]
        if len(given) != 1:
            wanted = " or ".join(f"{name}_{unit}" for unit in units)
            finding = "no such column" if not given else f"{len(given)} of them"
            raise InputError(
                "E-TABLE-COLUMN-MISSING", f"{self.where}: {finding}, {wanted} needed; the header is {self.header()}"
            )
        return given[0]

    def has(self, name: str, units: dict[str, float]) -> bool:
        """Return True if there is a column ``name_unit``."""
        return any(f"{name}_{unit}" in self.columns for unit in units)

    def points(self, prefix: str = "") -> np.ndarray:
        """Return the points (m, 3), mm, of the columns ``prefix + x``, ``y``, ``z``."""
        return np.column_stack([self.quantity(prefix + axis, LENGTHS) for axis in "xyz"])

    def has_rotation(self, prefix: str = "") -> bool:
        """Return True if there are quaternions; raise an error if only some of their columns exist."""
        present = [prefix + c for c in QUATERNION if prefix + c in self.columns]
        if present and len(present) < 4:
            missing = ", ".join(prefix + c for c in QUATERNION if prefix + c not in self.columns)
            raise InputError(
                "E-TABLE-COLUMN-MISSING",
                f"{self.where}: {', '.join(present)} without {missing}; all four or none needed",
            )
        return bool(present)

    def _order(self, prefix: str) -> list[str]:
        """Return the names, without prefix, of the columns that hold w, x, y and z."""
        quaternion_columns = [c.removeprefix(prefix) for c in self.columns if c in {prefix + q for q in QUATERNION}]
        if self.quaternions == "wxyz" or len(quaternion_columns) < len(QUATERNION):
            return list(QUATERNION)
        return [quaternion_columns[3], *quaternion_columns[:3]]

    def poses(self, prefix: str = "") -> Poses:
        """Return the m transforms of the columns ``prefix + x`` … and ``prefix + qw`` …."""
        self.has_rotation(prefix)
        wxyz = np.column_stack([self._near(prefix + c) for c in self._order(prefix)])
        require_unit(wxyz, lambda i: f"line {self.lines[i]}", self.where, "is the order qw, qx, qy, qz?")
        return Poses.from_quaternions(wxyz, self.points(prefix))

    def pose_covariances(self, prefix: str = "") -> np.ndarray | None:
        """Return the covariances (m, 6, 6) of the columns :data:`COVARIANCE`; None if there are no such columns.

        Raises
        ------
        InputError
            Only some of the columns exist, or a matrix is not positive definite.
        """
        present = [name for name in COVARIANCE if prefix + name in self.columns]
        if not present:
            return None
        if len(present) < len(COVARIANCE):
            missing = next(prefix + name for name in COVARIANCE if prefix + name not in self.columns)
            raise InputError(
                "E-TABLE-COLUMN-MISSING",
                f"{self.where}: {missing} is missing; all {len(COVARIANCE)} columns cov_… or none needed",
            )
        full = np.zeros((len(self), 6, 6))
        i, j = np.triu_indices(6)
        full[:, i, j] = full[:, j, i] = np.column_stack([self.numbers(prefix + name) for name in COVARIANCE])
        self.require_covariances(full, OF_POSE)
        return full

    def require_covariances(self, full: np.ndarray, rows: Rows) -> None:
        """Refuse covariances (m, n, n) of the rows unless all are positive definite.

        Raises
        ------
        InputError
            The message names the first bad line and its fault.
        """
        fault = first_fault(full, rows, definite=True)
        if fault is not None:
            raise InputError(
                "E-TABLE-COVARIANCE",
                f"{self.where}: line {self.lines[fault.row]}: covariance: {fault.reason}; correct it",
            )

    def common_errors(self, covariance: np.ndarray | None) -> np.ndarray | None:
        """Return the common errors (m, 6, r) of the columns ``common1_rx`` … ``common1_z``, ``common2_rx`` …, or None.

        Raises
        ------
        InputError
            Only some of the columns exist, or they exceed the covariance (m, 6, 6), which includes them.
        """
        count = len({name.split("_")[0] for name in self.columns if COMMON.fullmatch(name)})
        if not count:
            return None
        if covariance is None:
            raise InputError(
                "E-TABLE-COVARIANCE",
                f"{self.where}: columns common1_… without columns cov_…, which must hold them; give both",
            )
        for name in common_columns(count):
            if name not in self.columns:
                raise InputError(
                    "E-TABLE-COLUMN-MISSING",
                    f"{self.where}: {name} is missing; all columns common1_rx … or none needed",
                )
        values = np.column_stack([self.numbers(name) for name in common_columns(count)])
        full = np.swapaxes(values.reshape(len(self), count, 6), 1, 2)
        fault = first_fault(covariance - full @ np.swapaxes(full, 1, 2), OF_POSE, definite=True)
        if fault is not None:
            where = f"{self.where}: line {self.lines[fault.row]}"
            raise InputError(
                "E-TABLE-COVARIANCE", f"{where}: common errors are larger than the covariance; correct them"
            )
        return full

    def header(self) -> str:
        """Return the names of the columns, shortened, for messages."""
        text = ",".join(self.columns)
        return repr(text if len(text) <= 100 else text[:99] + "…")

    def _need(self, column: str) -> None:
        if column not in self.columns:
            raise InputError(
                "E-TABLE-COLUMN-MISSING", f"{self.where}: column {column} is missing; the header is {self.header()}"
            )


def read_table(path: "str | Path | Table", what: str, quaternions: Order = "wxyz") -> Table:
    """Read a CSV file with a header line; empty lines and lines that start with ``#`` are ignored.

    ``path`` : a :class:`Table` is returned unchanged; ``quaternions`` : ``xyzw`` if the quaternion columns hold x, y,
    z, w in this order, whatever their names.

    Raises
    ------
    InputError
        The file is unreadable, not UTF-8, has no header, no rows or another separator, a column name occurs twice, or
        a row has another length than the header.
    """
    if isinstance(path, Table):
        return path
    where = f"{what} {path}"
    try:
        text = read_bytes(path, TABLE_BYTES).decode("utf-8-sig")
    except OSError as error:
        raise InputError("E-FILE-UNREADABLE", f"{where}: {error.strerror or error}; check the path") from error
    except UnicodeDecodeError as error:
        raise InputError("E-TABLE-ENCODING", f"{where}: not UTF-8 text; save it as CSV in UTF-8") from error
    lines = text.splitlines()
    used = [(i, line) for i, line in enumerate(lines, 1) if line.strip() and not line.lstrip().startswith("#")]
    if not used:
        raise InputError("E-TABLE-EMPTY", f"{where}: empty; a header and rows needed")
    try:
        names = [name.strip() for name in next(csv.reader([used[0][1]]))]
    except csv.Error as error:
        raise InputError(
            "E-TABLE-HEADER", f"{where}: line {used[0][0]}: {error}; a header with names and units needed"
        ) from error
    if len(names) == 1 and any(separator in names[0] for separator in ";\t"):
        raise InputError(
            "E-TABLE-DELIMITER", f"{where}: columns separated by ';' or tabs; commas needed, and '.' in numbers"
        )
    for name in names:
        if names.count(name) > 1 or not name:
            shown = name or "without a name"
            raise InputError(
                "E-TABLE-HEADER", f"{where}: column {shown} occurs {names.count(name)} times; every name once needed"
            )
    if all(_is_number(name) for name in names):
        raise InputError(
            "E-TABLE-HEADER",
            f"{where}: line {used[0][0]} is numbers, a header with names and units needed, like x_mm,y_mm",
        )
    if len(used) == 1:
        raise InputError("E-TABLE-EMPTY", f"{where}: a header but no rows; rows needed")
    numbers = [i for i, _ in used[1:]]
    rows = [line for _, line in used[1:]]
    try:
        fast = np.loadtxt(io.StringIO("\n".join(rows)), delimiter=",", ndmin=2, comments=None)
        if fast.shape == (len(rows), len(names)):
            return Table(where, {name: fast[:, k] for k, name in enumerate(names)}, numbers, quaternions, rows)
    except ValueError:
        pass  # there is text among the numbers: parse row by row
    try:
        cells = list(csv.reader(rows))
    except csv.Error:  # an unclosed cell, longer than any may be
        cells = []
    if len(cells) != len(rows):
        open_one = next((i for i, line in used[1:] if line.count('"') % 2), numbers[0])
        raise InputError(
            "E-TABLE-CELLS",
            f"{where}: line {open_one}: a quoted cell goes over several lines; one row on one line needed",
        )
    for line, row in zip(numbers, cells, strict=True):
        if len(row) != len(names):
            raise InputError(
                "E-TABLE-CELLS", f"{where}: line {line}: {len(row)} cells, {len(names)} needed as in the header"
            )
    return Table(where, {n: [row[k].strip() for row in cells] for k, n in enumerate(names)}, numbers, quaternions)


def common_columns(count: int) -> list[str]:
    """Return the names of the columns of ``count`` common errors."""
    return [f"common{k}_{axis}" for k in range(1, count + 1) for axis in TWIST]


def pose_cells(pose: Rigid, covariance: np.ndarray | None = None) -> list[str]:
    """Return the cells of the columns :data:`POSE`, and of :data:`COVARIANCE` if a covariance is given."""
    values = [*pose.translation, *Poses.of([pose]).quaternions()[0]]
    if covariance is not None:
        values += list(covariance[np.triu_indices(6)])
    return [repr(float(v)) for v in values]


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return np.nan


def _is_number(text: str) -> bool:
    return np.isfinite(_number(text))
