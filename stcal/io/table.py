"""Tables with a header: units are in the names of the columns, and messages name the line of a bad row."""

import csv
import io
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from stcal.errors import InputError
from stcal.geometry.arrays import OF_POSE, TWIST, ByValue, CovarianceRows, first_fault
from stcal.geometry.rigid import UNIT_WITHIN, Order, Poses, Rigid
from stcal.io.files import TABLE_BYTES, read_bytes, require_written, text_of

LENGTHS = {"mm": 1.0, "m": 1000.0, "um": 1e-3, "cm": 10.0, "in": 25.4}
UNIT_WORDS = {"m": "metres", "in": "inches", "cm": "centimetres"}
"""Names of units in which lengths are stated by mistake."""
ANGLES = {"rad": 1.0, "deg": np.pi / 180}
FARTHEST = 1e12
"""Largest value in any unit: it exceeds anything that is measured, and its square does not overflow."""
COVARIANCE = tuple(f"cov_{a}_{b}" for i, a in enumerate(TWIST) for b in TWIST[i:])
"""Upper triangle of a pose covariance, rows first: rotation vector (rad) and translation (mm), left perturbation."""
COMMON = re.compile(r"common\d+_.+")  # names of columns with errors that all poses have in common
QUATERNION = ("qw", "qx", "qy", "qz")
POSE = ("x_mm", "y_mm", "z_mm", *QUATERNION)


@dataclass(frozen=True, slots=True, eq=False)
class Table(ByValue):
    """The rows of a table, as of :func:`stcal.load_table`.

    Parameters
    ----------
    where : Name of the file, for messages.
    columns : dict of list of str or (m,) array. Cells by the name of the column, which holds the unit.
    lines : Line number of each row in the file, from 1.
    quaternions : Order of quaternion components.
    rows : Text of the lines if all columns are numbers, since a name such as 01 must be kept.
    form : Form in words, if it is not that of the package: ``; between columns, decimal commas``.
    """

    where: str
    columns: dict[str, list[str] | np.ndarray]
    lines: Sequence[int]
    quaternions: Order = "wxyz"
    rows: Sequence[str] = ()
    form: str = ""

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

    def kept(self, column: str) -> "list[str] | np.ndarray":
        """Return a column for another table, without rows: as text if its numbers are names, such as 0001, or times in
        nanoseconds, that no float writes alike."""
        values = self.columns[column]
        if isinstance(values, list) or not self.rows:
            return values
        text = self.text(column)
        named = any(word.isdecimal() and word != f"{value:.15g}" for word, value in zip(text, values, strict=True))
        return text if named else values

    def numbers(self, column: str) -> np.ndarray:
        """Return the finite numbers (m,) of a column."""
        self._need(column)
        text = self.columns[column]
        try:
            values = np.asarray(text, float)
        except ValueError:
            values = np.array([_number(v) for v in text])
        bad, code = ~np.isfinite(values), "E-TABLE-NUMBER"
        self.refuse(bad, code, lambda i: f"{column} is {str(text[i])!r}, a finite number needed")
        return values

    def refuse(self, bad: np.ndarray, code: str, said: Callable[[int], str]) -> None:
        """Refuse rows, by a mask (m,), by the line of the first one; ``said`` : returns what is wrong in row i."""
        refuse(bad, code, lambda i: f"{self.where}: line {self.lines[i]}", said)

    def quantity(self, name: str, units: dict[str, float]) -> np.ndarray:
        """Return the values (m,) of the column ``name_unit``, in mm or rad."""
        unit = self.unit(name, units)
        return self._near(f"{name}_{unit}") * units[unit]

    def _near(self, column: str) -> np.ndarray:
        values, far = self.numbers(column), f"up to {FARTHEST:g} possible"
        self.refuse(np.abs(values) > FARTHEST, "E-VALUE-TOO-FAR", lambda i: f"{column} is {values[i]:g}, {far}")
        return values

    def unit(self, name: str, units: dict[str, float]) -> str:
        """Return the unit in which ``name`` is given."""
        given = [unit for unit in units if f"{name}_{unit}" in self.columns]
        if len(given) != 1:
            wanted = " or ".join(f"{name}_{unit}" for unit in units)
            fault = f"{self.where}: {f'{len(given)} of them' if given else 'no such column'}, {wanted} needed"
            header = f"the header is {self.header()}{self.open_unit(name, units)}"
            raise InputError("E-TABLE-COLUMN-MISSING", f"{fault}; {header}")
        return given[0]

    def open_unit(self, name: str, units: dict[str, float]) -> str:
        """Return the remedy for a column ``name`` without a unit, or for any other header."""
        bare_name = name[-1:] if name[-1:] in "xyz" else name
        bare = next((column for column in self.columns if column.lower() in (name, bare_name)), None)
        return f"; the unit of {bare} is open: call it {bare_name}_{next(iter(units))} …" if bare else ""

    def has(self, name: str, units: dict[str, float]) -> bool:
        """Return True if there is a column ``name_unit``."""
        return any(f"{name}_{unit}" in self.columns for unit in units)

    def points(self, prefix: str = "") -> np.ndarray:
        """Return the points (m, 3), mm, of the columns ``prefix + x``, ``y``, ``z``."""
        return np.column_stack([self.quantity(prefix + axis, LENGTHS) for axis in "xyz"])

    def has_rotation(self, prefix: str = "") -> bool:
        """Return True if there are quaternions; raise an error if only some of their columns exist."""
        names = [prefix + c for c in QUATERNION]
        present, missing = ([name for name in names if (name in self) is there] for there in (True, False))
        if present and missing:
            both = f"{', '.join(present)} without {', '.join(missing)}"
            raise InputError("E-TABLE-COLUMN-MISSING", f"{self.where}: {both}; all four or none needed")
        return bool(present)

    def quaternion_columns(self, prefix: str) -> list[str]:
        """Return the names, without prefix, of the columns that hold w, x, y and z."""
        present = [c.removeprefix(prefix) for c in self.columns if c in {prefix + q for q in QUATERNION}]
        in_order = self.quaternions == "wxyz" or len(present) < len(QUATERNION)
        return list(QUATERNION) if in_order else [present[3], *present[:3]]

    def poses(self, prefix: str = "") -> Poses:
        """Return the m transforms of the columns ``prefix + x`` … and ``prefix + qw`` …."""
        self.has_rotation(prefix)
        wxyz = np.column_stack([self._near(prefix + c) for c in self.quaternion_columns(prefix)])
        require_unit(wxyz, lambda i: f"{self.where}: line {self.lines[i]}", "is the order qw, qx, qy, qz?")
        return Poses.from_quaternions(wxyz, self.points(prefix))

    def pose_covariances(self, prefix: str = "") -> np.ndarray | None:
        """Return the covariances (m, 6, 6) of the columns :data:`COVARIANCE`; None if there are none."""
        names = [prefix + name for name in COVARIANCE]
        if not any(name in self for name in names):
            return None
        self._need_all(names, f"{len(COVARIANCE)} columns cov_…")
        full = np.zeros((len(self), 6, 6))
        i, j = np.triu_indices(6)
        full[:, i, j] = full[:, j, i] = np.column_stack([self.numbers(name) for name in names])
        self.require_covariances(full, OF_POSE)
        return full

    def require_covariances(self, full: np.ndarray, rows: CovarianceRows) -> None:
        """Refuse covariances (m, n, n) unless all are positive definite, by the first bad line."""
        if fault := first_fault(full, rows, definite=True):
            where = f"{self.where}: line {self.lines[fault.row]}"
            raise InputError("E-TABLE-COVARIANCE", f"{where}: covariance: {fault.reason}; correct it")

    def common_errors(self, covariance: np.ndarray | None, prefix: str = "") -> np.ndarray | None:
        """Return the common errors (m, 6, r) of the columns ``common1_rx`` … ``common1_z``, ``common2_rx`` …, or
        None. ``prefix`` : of these columns' names. The covariance (m, 6, 6) must include them."""
        stems = (name.removeprefix(prefix) for name in self.columns if name.startswith(prefix))
        count = len({stem.split("_")[0] for stem in stems if COMMON.fullmatch(stem)})
        if not count:
            return None
        if covariance is None:
            fault = f"{self.where}: columns common1_… without cov_…, which include them"
            raise InputError("E-TABLE-COVARIANCE", f"{fault}; give both")
        names = [prefix + name for name in common_columns(count)]
        self._need_all(names, "columns common1_rx …")
        values = np.column_stack([self.numbers(name) for name in names])
        full = np.swapaxes(values.reshape(len(self), count, 6), 1, 2)
        if fault := first_fault(covariance - full @ np.swapaxes(full, 1, 2), OF_POSE, definite=True):
            too_large = f"{self.where}: line {self.lines[fault.row]}: common errors are larger than the covariance"
            raise InputError("E-TABLE-COVARIANCE", f"{too_large}; correct them")
        return full

    def header(self) -> str:
        """Return the names of the columns, shortened, for messages."""
        text = ",".join(self.columns)
        return repr(text if len(text) <= 100 else text[:99] + "…")

    def _need_all(self, names: Iterable[str], which: str) -> None:
        for name in names:
            if name not in self:
                raise InputError("E-TABLE-COLUMN-MISSING", f"{self.where}: no {name}; all {which} or none needed")

    def _need(self, column: str) -> None:
        if column not in self.columns:
            fault = f"{self.where}: no column {column}"
            raise InputError("E-TABLE-COLUMN-MISSING", f"{fault}; the header is {self.header()}")


def read_table(path: "str | Path | Table", what: str, quaternions: Order = "wxyz") -> Table:
    """Read a table with a header line; empty lines and lines that start with ``#``, ``//`` or ``%`` with a space are
    ignored. Commas, semicolons, tabs or spaces separate columns, as in the header; without commas between columns,
    numbers may have decimal commas. Points of SpatialAnalyzer, ``Collection::Group::Target x y z``, need no header.
    Units in brackets, or in another case, are read as the package writes them: ``X [mm]`` is ``x_mm``. A
    :class:`Table` is returned unchanged; ``quaternions`` : ``xyzw`` if their columns hold x, y, z, w in this order,
    whatever their names."""
    if isinstance(path, Table):
        return path
    where = f"{what} {path}"
    try:
        text = text_of(read_bytes(path, TABLE_BYTES))
    except OSError as error:
        raise InputError("E-FILE-UNREADABLE", f"{where}: {error.strerror or error}; check the path") from error
    except UnicodeDecodeError as error:
        raise InputError("E-TABLE-ENCODING", f"{where}: not UTF-8 text; save it as CSV in UTF-8") from error
    lines = [(i, line) for i, line in enumerate(text.splitlines(), 1) if line.strip()]
    comments = [line for _, line in lines if is_comment(line)]
    used = [(i, line) for i, line in lines if not is_comment(line)]
    if not used:
        raise InputError("E-TABLE-EMPTY", f"{where}: empty; a header and rows needed")
    if "::" in used[0][1] and (points := _points_of_analyzer(used, comments, where, quaternions)) is not None:
        return points
    between = _separator([line for _, line in used])
    if separator_stated(used[0][1]):
        used = used[1:] or used
    if between != " " and used[0][1].rstrip(" ").endswith(between):  # behind the last column, too
        used = [(i, line.rstrip(" ").removesuffix(between)) for i, line in used]
    try:
        names = [name.strip() for name in cells_of(used[0][1], between)]
    except csv.Error as error:
        raise InputError("E-TABLE-HEADER", f"{where}: line {used[0][0]}: {error}; a header needed") from error
    if len(names) > MOST_COLUMNS:
        fault = f"{where}: line {used[0][0]} has {len(names)} columns"
        raise InputError("E-TABLE-HEADER", f"{fault}, at most {MOST_COLUMNS} are read; check the file")
    names, used = _with_units_of_a_row(names, used, between)
    names = canonical(names if names[0] else ["index", *names[1:]], comments)  # pandas writes its index without a name
    if 2 * sum(np.isfinite(_number(name.replace(",", "."))) for name in names) > len(names):
        fault = f"{where}: line {used[0][0]} is numbers"
        raise InputError("E-TABLE-HEADER", f"{fault}, a header with units needed, like x_mm")
    for name, count in Counter(names).items():
        if count > 1 or not name:
            shown = name or "without a name"
            raise InputError("E-TABLE-HEADER", f"{where}: column {shown} occurs {count} times; once needed")
    if len(names) == 1 and len(used) > 2 and len(cells_of(used[1][1], _separator([used[1][1]]))) > 1:
        raise InputError("E-TABLE-HEADER", f"{where}: line {used[0][0]} is no header of the rows below it; remove it")
    if len(used) == 1:
        raise InputError("E-TABLE-EMPTY", f"{where}: a header but no rows; rows needed")
    numbers, rows = [i for i, _ in used[1:]], [line for _, line in used[1:]]
    if between == ",":
        try:
            fast = np.loadtxt(io.StringIO("\n".join(rows)), delimiter=",", ndmin=2, comments=None)
            if fast.shape == (len(rows), len(names)):
                return Table(where, {name: fast[:, k] for k, name in enumerate(names)}, numbers, quaternions, rows)
        except ValueError:
            pass  # there is text among the numbers: parse row by row
    try:
        split = map(str.split, rows) if between == " " else csv.reader(rows, delimiter=between)
        cells = [[plain(cell.strip()) for cell in row] for row in split]
    except csv.Error:  # an unclosed cell, longer than any may be
        cells = []
    if len(cells) != len(rows):
        first = next((i for i, line in used[1:] if line.count('"') % 2), numbers[0])
        open_cell = "a quoted cell goes over several lines; one row on one line needed"
        raise InputError("E-TABLE-CELLS", f"{where}: line {first}: {open_cell}")
    for line, row in zip(numbers, cells, strict=True):
        if len(row) != len(names):
            raise InputError("E-TABLE-CELLS", f"{where}: line {line}: {len(row)} cells, the header has {len(names)}")
    columns, form = {name: [row[k] for row in cells] for k, name in enumerate(names)}, ""
    if between != ",":
        columns, commas = decimal_points(columns, between, where)
        form = SEPARATORS[between] + (", decimal commas" if commas else "")
    return Table(where, dict(columns), numbers, quaternions, form=form)


MOST_COLUMNS = 2000
SEPARATORS = {";": "';' between columns", "\t": "tabs between columns", " ": "spaces between columns"}
"""Separators beside the comma, in words."""
_LONG = {"mm": "millimet", "cm": "centimet", "m": "met", "in": "inch", "deg": "degree", "rad": "radian"}
"""Beginnings of units in full."""
_UNIT_WORD = "mm|cm|um|µm|m|in|rad|deg|°|(?:milli|centi)?met(?:er|re)s?|inch(?:es)?|degrees?|radians?"
_UNIT = re.compile(rf"(.*?)\s*(?:[\[(]\s*({_UNIT_WORD})\s*[\])]|/\s*({_UNIT_WORD}))", re.I)
_IN_A_ROW = re.compile(rf"[\[(]?\s*({_UNIT_WORD}|)\s*[\])]?", re.I)
"""A cell of a row of units below the header."""
_ENDS_IN_UNIT = re.compile(r".+_(mm|cm|um|m|in|rad|deg)")
_UNIT_SAID = re.compile(
    r"\bunits?\b(?:\W+(?:are|is|in|of|lengths?|distances?))*\W+"
    r"(mm|millimet(?:er|re)s?|cm|centimet(?:er|re)s?|met(?:er|re)s?|m|inch(?:es)?|(?<=[:=] )in|(?<=[:=])in)\b",
    re.I,
)
"""What a comment says of the unit of lengths."""
_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_COMMA_NUMBER = r"[+-]?\d+(?:,\d+)?(?:[eE][+-]?\d+)?"
_POINT = re.compile(rf"(.*?::.*?)[\s,;]+({_NUMBER})[\s,;]+({_NUMBER})[\s,;]+({_NUMBER})[\s,;]*")
_COMMA_POINT = re.compile(rf"(.*?::.*?)[\s;]+({_COMMA_NUMBER})[\s;]+({_COMMA_NUMBER})[\s;]+({_COMMA_NUMBER})[\s;]*")
_STATES_SEPARATOR = re.compile(r"sep=([,;\t])")  # first line of a table that Excel wrote, or is to read
_THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2},\d{3}")
"""A number that may be of thousands as well as a decimal."""


def is_comment(line: str) -> bool:
    """Return True if a line of a table is a comment; `rostopic echo -p` begins its header with ``%time``."""
    return line.lstrip().startswith(("#", "//", "% ", "%%"))


def separator_stated(line: str) -> str:
    """Return the separator that the first line of a table states, as Excel takes it; empty for other lines."""
    stated = _STATES_SEPARATOR.fullmatch(line.strip(" \r"))
    return stated[1] if stated else ""


def cells_of(line: str, between: str) -> list[str]:
    """Return the cells of a line, without surrounding white space; ``between`` : comma, ``;``, tab or space."""
    if between == " ":
        return line.split()
    return [plain(cell.strip()) for cell in next(csv.reader([line], delimiter=between))]


FORMULA = re.compile(r"'*[=+\-@\t\r]")
"""Text that a spreadsheet takes as a formula, or does not because of an apostrophe."""


def csv_text(rows: Iterable[Iterable[object]]) -> str:
    """Return CSV of rows; an apostrophe keeps a spreadsheet from running names that begin as formulas do."""
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerows([_shown(str(cell)) for cell in row] for row in rows)
    return out.getvalue()


def _shown(text: str) -> str:
    try:
        float(text)
        return text
    except ValueError:
        return text if FORMULA.match(text) is None else "'" + text


def plain(cell: str) -> str:
    """Return the text of a cell that :func:`csv_text` wrote."""
    return cell[1:] if cell[:1] == "'" and FORMULA.match(cell) else cell


def csv_rows(text: str) -> Iterator[dict[str, Any]]:
    """Yield the rows of CSV by the names of its columns; a row that is cut has None, as of ``csv.DictReader``. Raises
    ValueError: a cell is longer than any may be."""
    try:
        for row in csv.DictReader(io.StringIO(text)):
            yield {name and plain(name): cell and plain(cell) for name, cell in row.items()}
    except csv.Error as error:
        raise ValueError(str(error)) from error


def canonical(names: Sequence[str], comments: Sequence[str] = ()) -> list[str]:
    """Return names of columns as the package writes them, where they differ in case or form of the unit alone; one of
    the ``comments`` may state the unit of x, y, z. In ``euler_ZYX_1_deg`` the case means turned axes: it stays."""
    said = [match[1].lower() for line in comments for match in _UNIT_SAID.finditer(line)]
    units = {next(u for u in ("mm", "cm", "m", "in") if word.startswith((u, _LONG[u]))) for word in said}
    unit = units.pop() if len(units) == 1 else ""
    found = []
    for name in names:
        bracketed = _UNIT.fullmatch(name)
        if bracketed is not None:
            word = (bracketed[2] or bracketed[3]).lower().replace("µ", "u").replace("°", "deg")
            name = f"{bracketed[1]}_{next((short for short, long in _LONG.items() if word.startswith(long)), word)}"
        new = RTDE.get(name, name)
        lower = new.lower()
        if unit and lower in ("x", "y", "z"):
            lower = new = f"{lower}_{unit}"
        known = (_ENDS_IN_UNIT.fullmatch(lower) and "euler" not in lower) or lower in QUATERNION
        found.append(lower if known and lower not in names else new)
    return found


RTDE = {f"actual_TCP_pose_{i}": name for i, name in enumerate(("x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad"))}
RTDE |= {f"actual_q_{i}": f"q{i + 1}_rad" for i in range(6)}
"""Names of columns in recordings of Universal Robots' interface RTDE: the pose of the tool, and joint values."""


def _with_units_of_a_row(
    names: list[str], used: list[tuple[int, str]], between: str
) -> tuple[list[str], list[tuple[int, str]]]:
    """Return the names with the units of a row of units below them, and the lines without that row."""
    try:
        row = cells_of(used[1][1], between) if len(used) > 2 else []
    except csv.Error:
        return names, used
    units = [match[1] for cell in row if (match := _IN_A_ROW.fullmatch(cell))]
    if len(units) != len(names) or not any(units):
        return names, used
    return [f"{name} [{unit}]" if unit else name for name, unit in zip(names, units, strict=True)], [used[0], *used[2:]]


def decimal_points(columns: dict[str, list[str]], between: str, where: str) -> tuple[dict[str, list[str]], bool]:
    """Return the columns with decimal points in place of decimal commas, and whether there were such. Semicolons
    stand between columns where commas are decimal. Tabs and spaces do elsewhere too, so that a number must show that
    its comma is not of thousands; decimal points beside it are refused."""
    numeric = {name: cells for name, cells in columns.items() if all(re.fullmatch(_COMMA_NUMBER, c) for c in cells)}
    with_comma = {name: cells for name, cells in numeric.items() if any("," in cell for cell in cells)}
    if not with_comma:
        return columns, False
    commas = [cell for cells in with_comma.values() for cell in cells if "," in cell]
    points = [cell for cells in columns.values() for cell in cells if "." in cell and re.fullmatch(_NUMBER, cell)]
    if points or (between != ";" and all(_THOUSANDS.fullmatch(cell) for cell in commas)):
        beside = f" beside {points[0]}" if points else ""
        fault = f"{where}: {commas[0]}{beside}: the comma may separate decimals or thousands"
        raise InputError("E-TABLE-DECIMAL", f"{fault}; write points")
    return columns | {n: [cell.replace(",", ".") for cell in cells] for n, cells in with_comma.items()}, True


def _separator(lines: Sequence[str]) -> str:
    """Return what separates the columns of a table, by its header; a comma where nothing does."""
    header = lines[0]
    if stated := separator_stated(header):
        return stated
    if ";" in header and header.count(";") >= header.count(","):
        return ";"
    if "," in header:
        return ","
    if "\t" in header.strip():
        return "\t"
    count = len(header.split())
    return " " if count > 1 and len(lines) > 1 and all(len(line.split()) == count for line in lines[1:]) else ","


def _points_of_analyzer(
    used: Sequence[tuple[int, str]], comments: Sequence[str], where: str, quaternions: Order
) -> Table | None:
    """Return the points of SpatialAnalyzer, a name of one or three parts and three numbers each; None for others."""
    both = ([form.fullmatch(line.strip()) for _, line in used] for form in (_COMMA_POINT, _POINT))
    with_commas, points = ([match.groups() for match in matches if match] for matches in both)
    commas = len(with_commas) == len(used) and any("," in number for point in with_commas for number in point[1:])
    points = with_commas if commas else points
    if len(points) < len(used):
        return None
    names = [point[0].strip() for point in points]
    columns = {"name": names}
    parts = [name.split("::") for name in names]
    if all(len(part) == 3 for part in parts):
        columns |= {key: [part[k] for part in parts] for k, key in enumerate(("collection", "group", "target"))}
    axes = canonical("xyz", comments)
    columns |= {axis: [point[k] for point in points] for k, axis in enumerate(axes, 1)}
    if commas:
        columns, _ = decimal_points(columns, " ", where)
    return Table(where, dict(columns), [line for line, _ in used], quaternions, form="points of SpatialAnalyzer")


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


LEVER_MM = 1000.0  # distance at which an error of rotation is compared as one of position, mm
POSE_MM = 1e-6
"""Largest difference of a written pose, mm at :data:`LEVER_MM`. Decimals of degrees and quaternions cause less."""


def pose_values(poses: Poses) -> np.ndarray:
    """Returns poses as lengths (m, 3, 4), mm: rotations at :data:`LEVER_MM`, and translations."""
    return poses.matrix()[:, :3] * np.array([LEVER_MM] * 3 + [1.0])


def require_pose_table_written(path: str | Path, poses: Mapping[str, Poses]) -> None:
    """Read a written table again, and require that its poses are ``poses``, by the prefix of their columns."""
    for prefix, own in poses.items():
        again = partial(lambda prefix: pose_values(read_table(path, "poses").poses(prefix)), prefix)
        require_written(path, again, pose_values(own), POSE_MM, "mm")


def refuse(
    bad: np.ndarray, code: str, place: Callable[[int], str], said: Callable[[int], str], remedy: str = ""
) -> None:
    """Refuse rows, by a mask (m,); ``place``, ``said`` : return where row i is, and what is wrong in it; ``remedy`` :
    ends the message, after the number of further rows."""
    rows = np.flatnonzero(bad).tolist()
    if rows:
        more = f" (and {len(rows) - 1} more)" if len(rows) > 1 else ""
        raise InputError(code, f"{place(rows[0])}: {said(rows[0])}{more}{remedy}")


def require_unit(wxyz: np.ndarray, place: Callable[[int], str], remedy: str) -> None:
    """Refuse quaternions (m, 4) that are not of unit length; ``place``, ``remedy`` : as of :func:`refuse`."""
    with np.errstate(over="ignore"):  # quaternions that are refused
        length = np.linalg.norm(wxyz, axis=1)
    bad, needed = ~(np.abs(length - 1) <= UNIT_WITHIN), f"1 ± {UNIT_WITHIN:g} needed"
    said = "quaternion of length {:.4g}, {}".format
    refuse(bad, "E-QUATERNION-LENGTH", place, lambda i: said(length[i], needed), f"; {remedy}")
