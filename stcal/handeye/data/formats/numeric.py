"""Readers of tables of numbers: 4×4 matrices, TUM's trajectories, CSV files with columns of other programs, and NumPy's
files npy and npz."""

import io
import re
import tokenize
import zipfile
import zlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from stcal.errors import InputError
from stcal.handeye.data.formats.record import (
    EVERY_FRAME,
    FRAMES,
    MATRICES,
    MATRICES_3X4,
    ROLES,
    Content,
    Frames,
    Role,
    Said,
    Side,
    Unit,
    frames_of,
    of_matrices,
    require_each_once,
    role_of,
)
from stcal.handeye.data.formats.tree import ROS
from stcal.io.files import MB, TABLE_BYTES
from stcal.io.poses.columns import MatrixColumns, find_column, find_matrices, places_of, read_rotations
from stcal.io.poses.rotations import of_quaternions, require_finite, said_convention, turned_values
from stcal.io.table import LENGTHS, Table

_SEPARATORS = re.compile(r"[\s,;]+")
_BRACKETS = str.maketrans("[]()", "    ")
_QUATERNION = re.compile(r"(?<![a-z])q[a-z_]*?([wxyz])\b")
TUM, MATRIX = 8, 16
"""Numbers in a line that holds a whole pose."""
PAIRS = (12, 14)
"""Numbers in a line that holds the poses of both sides, three angles or a quaternion each."""
NANOSECONDS = 19
"""Digits of a time in ns since 1970."""
QUATERNIONS_OPEN = "the last four numbers after a time in ns"
THREE_ROWS = 12
ORTHOGONAL = 0.05
"""Largest deviation of RRᵀ from the identity of numbers that are a rotation; six other numbers of a pose deviate by
their size."""
IDENTITY = 1e-6
"""Largest deviation of a first matrix that is the identity in what digits files have."""
COMMENTS = ("#", "//", "%")
_DECIMAL_COMMA = re.compile(r"[+-]?\d+(,\d+)?([eE][+-]?\d+)?")


@dataclass(frozen=True, slots=True)
class Line:
    """``number`` of the line in the file; ``label`` before the numbers; ``values``; ``first`` : first number as
    text."""

    number: int
    label: str
    values: list[float]
    first: str


def read_numbers(text: str, statements: Said, where: str) -> Content | None:
    """Returns the poses in lines of numbers, each with or without a name before them; None for any other text.

    Raises InputError: lines of unequal length, 3×4 matrices, no rotations, or a convention that must be stated.
    """
    lines, comments = [], []
    for i, raw in enumerate(_with_points(text.splitlines()), 1):
        stripped = raw.strip()
        if stripped.startswith(COMMENTS):
            comments.append(stripped)
        elif stripped:
            line = _line(i, stripped)
            if line is None or _half_commas(stripped):
                return None
            lines.append(line)
    if not any(line.values for line in lines):
        return None
    lines = _without_counts(lines, where)
    labels_alone = [line for line in lines if not line.values]
    widths = Counter(len(line.values) for line in lines if line.values)
    width = widths.most_common(1)[0][0]
    odd = next((line for line in lines if line.values and len(line.values) != width), None)
    if odd is not None:
        raise InputError(
            "E-MATRIX-ROWS",
            f"{where}: line {odd.number}: {len(odd.values)} numbers, {width} in most other lines; correct it",
        )
    if width == 4:
        return _blocks(lines, where)
    if labels_alone:
        return None
    if width == 3:
        raise InputError(
            "E-MATRIX-ROWS",
            f"{where}: 3 numbers in a line, as of a matrix 3×3, which has no place; write matrices 3×4 or 4×4",
        )
    values, places = np.array([line.values for line in lines]), tuple(f"line {line.number}" for line in lines)
    if width > TUM and any(_of_euroc(comment, width) for comment in comments):  # velocities and biases follow
        values, width = values[:, :TUM], TUM
    if width not in (6, 7, TUM, MATRIX, *PAIRS):
        return None
    require_finite(values, places, where)
    names = tuple(line.label for line in lines) if all(line.label for line in lines) else ()
    if width == TUM:
        return _tum(values, lines, places, comments, statements, where)
    require_each_once(names, places[: len(names)], where)
    if width == MATRIX:
        rotation, translation = of_matrices(values.reshape(-1, 4, 4), places, where)
        return Content("4×4 matrices, a row each", (Side(rotation, translation, places, MATRICES, names=names),))
    if width == THREE_ROWS and _three_rows(values):
        return _of_kitti(values.reshape(-1, 3, 4), places, names, where)
    if width in PAIRS:
        return _pairs(values, statements, places, names, where)
    rotation, words = turned_values(values[:, 3:], statements.rotation, "the numbers after x, y, z", places, where)
    return Content("rows of numbers", (Side(rotation, values[:, :3], places, words, names=names),))


def _pairs(
    values: np.ndarray, statements: Said, places: tuple[str, ...], names: tuple[str, ...], where: str
) -> Content:
    """Returns the poses of both sides in rows of numbers (m, 12) or (m, 14), the robot's first."""
    half, sides = values.shape[1] // 2, []
    for role, numbers in zip(ROLES, (values[:, :half], values[:, half:]), strict=True):
        what = f"the numbers after x, y, z of the {role}'s pose"
        rotation, words = turned_values(numbers[:, 3:], statements.of(role).rotation, what, places, where)
        frames = Frames(FRAMES[role][0], "by default", False)
        sides.append(Side(rotation, numbers[:, :3], places, words, None, frames, names))
    return Content(f"rows of {half} + {half} numbers, the robot's pose first", tuple(sides))


def _three_rows(values: np.ndarray) -> bool:
    """True if most rows of twelve numbers (m, 12) are 3×4 matrices; a row that is not can then be named."""
    turn = values.reshape(-1, 3, 4)[:, :, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.abs(turn @ np.swapaxes(turn, 1, 2) - np.eye(3)).max(axis=(1, 2))
    return bool(2 * np.count_nonzero(off < ORTHOGONAL) > len(off))


def _of_kitti(matrices: np.ndarray, places: tuple[str, ...], names: tuple[str, ...], where: str) -> Content:
    """Returns poses from matrices (m, 3, 4), a row each.

    If the first matrix is the identity, the file is odometry as in KITTI: poses of the camera in its first frame, in
    metres. It has no poses of a board, which cannot be at the camera's centre.
    """
    rotation, translation = of_matrices(matrices, places, where)
    first = bool(np.abs(matrices[0] - np.eye(4)[:3]).max() < IDENTITY)
    form = "3×4 matrices, a row each" + (", the first one at the origin, as KITTI writes trajectories" if first else "")
    unit = Unit("m", "as in KITTI") if first else None
    return Content(form, (Side(rotation, translation, places, MATRICES_3X4, unit, names=names, trajectory=first),))


def _without_counts(lines: list[Line], where: str) -> list[Line]:
    """Returns the lines without a first line that has only the number of poses. A single number before each matrix is
    its name.

    Raises InputError: there are not as many poses as the first line says.
    """
    single = [i for i, line in enumerate(lines) if len(line.values) == 1 and not line.label]
    wide = [line for line in lines if len(line.values) > 1]
    matrix_lines = 4 if len(wide) > 3 and list(wide[3].values) == [0, 0, 0, 1] else 3
    if not single or not wide:
        return lines
    if single[0] == 0 and (len(single) == 1 or single[1] == 1):
        poses = len(wide) // matrix_lines if len(wide[0].values) == 4 else len(wide)
        if lines[0].values[0] != poses:
            raise InputError(
                "E-POSES-COUNT",
                f"{where}: line {lines[0].number} says {lines[0].first} poses, {poses} follow; correct it",
            )
        lines, single = lines[1:], [i - 1 for i in single[1:]]
    if single and single == list(range(0, len(lines), matrix_lines + 1)):
        lines = [replace(line, label=line.first, values=[]) if i in single else line for i, line in enumerate(lines)]
    return lines


def _with_points(lines: list[str]) -> list[str]:
    """Returns lines of numbers with decimal points in place of decimal commas, where semicolons or white space stand
    between numbers."""
    used = [line.strip().translate(_BRACKETS).strip(" ;\t") for line in lines if not line.startswith(COMMENTS)]
    cells = [re.split(r"[;\s]+", line) for line in used if line]
    numbers = [cell for row in cells for cell in row if cell != row[0] or _number(cell.replace(",", ".")) is not None]
    if not numbers or not all(_DECIMAL_COMMA.fullmatch(cell) for cell in numbers):
        return lines
    if max(map(len, cells)) == 1 or not any("," in cell for cell in numbers):
        return lines
    return [line.replace(",", ".") for line in lines]


def _half_commas(line: str) -> bool:
    """True if commas may be those of decimals: between semicolons, one at most, with digits on both sides. In a matrix
    such as ``[1, 2; 3, 4]`` with more columns there are more."""
    cells = line.split(";")
    return len(cells) > 1 and max(cell.count(",") for cell in cells) == 1 and re.search(r"\d,\d", line) is not None


def _line(number: int, text: str) -> Line | None:
    """Returns a line of numbers, a name alone, or a name and numbers; None for any other text."""
    robot = re.fullmatch(r"p?\s*\[(.*)\]", text)  # as UR writes poses: p[x, y, z, rx, ry, rz]
    tokens = [t for t in _SEPARATORS.split((robot[1] if robot else text).translate(_BRACKETS)) if t]
    if not tokens:
        return Line(number, "", [], "")
    values = [_number(token) for token in tokens]
    label = ""
    if values[0] is None:
        label, values = tokens[0], values[1:]
        if label.endswith(":") or label == "-" or not (values or "." in label):  # a line of YAML, or a word
            return None
    numbers = [value for value in values if value is not None]
    return Line(number, label, numbers, tokens[0]) if len(numbers) == len(values) else None


def _number(token: str) -> float | None:
    try:
        return float(token)
    except ValueError:
        return None


def _blocks(lines: list[Line], where: str) -> Content | None:
    """Returns matrices of four lines each, or of three where no line is 0 0 0 1, with or without a name before each."""
    every = np.array([line.values for line in lines if line.values])
    three = len(every) % 3 == 0 and not (every == [0, 0, 0, 1]).all(axis=1).any() and _three_rows(every.reshape(-1, 12))
    names, rows, starts, height = [], [], [], 3 if three else 4
    for line in lines:
        if line.label:
            names.append(line.label)
        if line.values:
            if len(rows) % height == 0:
                starts.append(line.number)
            rows.append(line.values)
        if line.label and len(rows) % height > (1 if line.values else 0):
            raise InputError(
                "E-MATRIX-ROWS",
                f"{where}: line {line.number}: a name after {len(rows) % height} rows of a matrix, {height} needed",
            )
    if len(rows) % height:
        raise InputError(
            "E-MATRIX-ROWS", f"{where}: {len(rows)} rows of 4 numbers, 4 for each matrix needed; correct them"
        )
    if names and len(names) != len(starts):
        raise InputError(
            "E-NAMES-COUNT", f"{where}: {len(starts)} matrices and {len(names)} names; one each needed, or none"
        )
    places = tuple(f"line {number}" for number in starts)
    require_each_once(names, places[: len(names)], where)
    rotation, translation = of_matrices(every.reshape(-1, height, 4), places, where)
    words = MATRICES_3X4 if three else MATRICES
    return Content(f"{words} as text", (Side(rotation, translation, places, words, names=tuple(names)),))


def _of_euroc(comment: str, width: int) -> bool:
    """Returns True for a header of EuRoC's ground truth, of as many columns, with a pose in the first ones."""
    cells = comment.split(",")
    return len(cells) == width and len(_QUATERNION.findall(",".join(cells[4:TUM]).lower())) == len("wxyz")


def _tum(
    values: np.ndarray,
    lines: list[Line],
    places: tuple[str, ...],
    comments: list[str],
    statements: Said,
    where: str,
) -> Content:
    """Returns poses from lines of timestamp tx ty tz qx qy qz qw. A comment may state another order of the quaternion,
    as in EuRoC. Times in whole nanoseconds without such a comment leave the order open.

    Raises InputError: a row occurs twice, a quaternion is not of unit length, or its order must be stated.
    """
    order = next((letters for c in comments if len(letters := _QUATERNION.findall(c.lower())) == 4), [])
    if sorted(order) != sorted("wxyz"):
        order = list("xyzw")
        if statements.rotation or all(line.first.isdigit() and len(line.first) >= NANOSECONDS for line in lines):
            order = list(said_convention(statements.rotation, QUATERNIONS_OPEN, where, len("wxyz")).order)
    names = tuple(line.first for line in lines)
    require_each_once(names, places, where)
    wxyz = values[:, 4:][:, [order.index(component) for component in "wxyz"]]
    rotation = of_quaternions(wxyz, places, where)
    turned = f"quaternions {', '.join(order)}"
    side = Side(rotation, values[:, 1:4], places, turned, Unit("m", "as in TUM"), names=names, trajectory=True)
    return Content("TUM trajectory (timestamp, place, quaternion)", (side,))


TABLE = "table"
NAMES = (
    *("image", "image_name", "filename", "file", "name", "pose"),
    *("field.header.stamp", "header.stamp", "header_stamp", "timestamp", "stamp", "%time", "__time", "time_s", "time"),
)
"""Columns that name a row, in order of preference."""
NUMBERS = ("nr", "no", "number", "index", "id", "#")
"""Columns that name a row where no value occurs twice: elsewhere they number something else, such as the board."""
_MESSAGE = re.compile(r"(?P<of>.*?)[./_]?(?:position|translation)[./_]x", re.IGNORECASE)
_STAMP = (("secs", "nsecs"), ("sec", "nanosec"))


def todays(table: Table) -> bool:
    """True if the columns are those of the package's own tables: a place with its unit, and a quaternion."""
    prefixes = ("", *(f"{name}_" for name in EVERY_FRAME))
    placed = [prefix for prefix in prefixes if table.has(f"{prefix}x", LENGTHS)]
    return bool(placed) and all(f"{prefix}qw" in table for prefix in placed)


def read_columns(table: Table, key: str, statements: Said) -> Content | None:
    """Returns the poses in the columns of a table; None where it has none.

    Raises InputError: some columns of a pose are missing, rotations are missing, one file holds several topics, or the
    convention must be stated.
    """
    messages = _messages(table)
    if messages:
        return _of_messages(table, messages, _row_names(table, key))
    names = _row_names(table, key)
    sides = []
    for frame in EVERY_FRAME:
        side = _side(table, f"{frame}_", Frames(frame, f"by the columns {frame}_…"), names, statements)
        if side is not None:
            sides.append(side)
    if not sides:
        sides = _named_matrices(table, names)
    if not sides:
        side = _side(table, "", None, names, statements)
        sides = [side] if side is not None else []
    if not sides:
        return None
    roles = [side.frames.role for side in sides if side.frames is not None]
    if len(set(roles)) < len(roles):
        both = ", ".join(side.frames.name for side in sides if side.frames is not None)
        raise InputError(
            "E-POSES-MIXED", f"{table.where}: columns of {both}; one of each side needed, take the others out"
        )
    return Content(f"{TABLE} ({table.form})" if table.form else TABLE, tuple(sides))


def _row_names(table: Table, key: str) -> tuple[str, ...]:
    """Returns the image or time of each row as text, since nanoseconds have more digits than a float; empty where no
    column names the rows."""
    column = next((name for name in (key, *NAMES) if name in table), None)
    lower = {name.lower(): name for name in table.columns}
    if column is None:
        column = next((lower[name] for name in NAMES if name in lower), None)
    if column is not None:
        return _cells(column, table)
    for prefix in ("field.header.stamp.", "header.stamp.", "stamp."):
        for seconds, fractions in _STAMP:
            if f"{prefix}{seconds}" in table and f"{prefix}{fractions}" in table:
                whole, nanoseconds = (table.text(f"{prefix}{field}") for field in (seconds, fractions))
                return tuple(f"{s}.{n.zfill(9)}" for s, n in zip(whole, nanoseconds, strict=True))
    number = next((lower[name] for name in NUMBERS if name in lower), None)
    if number is not None and len(set(table.text(number))) == len(table):
        return tuple(table.text(number))
    return ()


def _cells(column: str, table: Table) -> tuple[str, ...]:
    values = tuple(table.text(column))
    require_each_once(values, places_of(table), table.where)
    return values


@dataclass(frozen=True, slots=True)
class _Message:
    """``of`` : topic or field of the message; ``place``, ``turn`` : its columns, x, y, z and w, x, y, z."""

    of: str
    place: tuple[str, ...]
    turn: tuple[str, ...]


def _messages(table: Table) -> list[_Message]:
    """Returns the poses and transforms of ROS among the columns, as ``rostopic echo -p``, PlotJuggler and pandas name
    them."""
    messages = []
    for column in table.columns:
        match = _MESSAGE.fullmatch(column)
        if not match:
            continue
        place = tuple(f"{column[:-1]}{axis}" for axis in "xyz")
        stem = column[:-1].lower()
        for at, turn in (("position", "orientation"), ("translation", "rotation")):
            if at in stem:
                start = stem.rindex(at)
                head = column[:start] + turn + column[start + len(at) : -1]
                turned = tuple(f"{head}{axis}" for axis in "wxyz")
                missing = [name for name in (*place, *turned) if name not in table]
                if missing:
                    raise InputError(
                        "E-TABLE-COLUMN-MISSING", f"{table.where}: {column} without {missing[0]}; export the whole pose"
                    )
                messages.append(_Message(match["of"], place, turned))
    return messages


def _of_messages(table: Table, messages: Sequence[_Message], names: tuple[str, ...]) -> Content:
    sides = []
    for message in messages:
        role: Role | None = None
        if len(messages) > 1:
            said_by: list[Role | None] = [role_of(word) for word in re.split(r"[./]+", message.of) if word]
            role = next((named_role for named_role in said_by if named_role is not None), None)
        frames = Frames(FRAMES[role][0], f"by the topic {message.of}", False) if role else None
        places = places_of(table)
        rotation = of_quaternions(np.column_stack([table.numbers(c) for c in message.turn]), places, table.where)
        at = np.column_stack([table.numbers(c) for c in message.place])
        sides.append(Side(rotation, at, places, "quaternions x, y, z, w by name", ROS, frames, names))
    roles = [side.frames.role if side.frames else None for side in sides]
    if len(sides) > 1 and (None in roles or len(set(roles)) < len(roles)):
        topics = ", ".join(message.of for message in messages)
        raise InputError(
            "E-POSES-MIXED",
            f"{table.where}: poses of {len(messages)} topics, {topics}; export the robot's and the camera's each to a "
            "file of its own, and give --a and --b",
        )
    for column in ("field.header.frame_id", "header.frame_id", "field.child_frame_id", "child_frame_id"):
        if column in table and len(named_role := sorted(set(table.text(column)))) > 1:
            raise InputError(
                "E-POSES-MIXED",
                f"{table.where}: {column} is {', '.join(named_role[:3])}; export the rows of one of them alone",
            )
    return Content("ROS bag export", tuple(sides))


def _side(table: Table, prefix: str, frames: Frames | None, names: tuple[str, ...], statements: Said) -> Side | None:
    """Returns the poses in the columns that begin with a prefix; None where place or rotation is missing."""
    full = [matrix for matrix in find_matrices(table, prefix) if matrix.translation]
    if len(full) > 1:
        raise InputError(
            "E-POSES-MIXED",
            f"{table.where}: columns of {len(full)} matrices, {', '.join(matrix.stem for matrix in full)}; begin their "
            f"names with the transforms, {FRAMES['robot'][0]}_ and {FRAMES['camera'][0]}_, or take the others out",
        )
    if full:
        return _of_matrix(table, full[0], frames, names)
    place = _place(table, prefix)
    if place is None:
        return None
    at, unit = place
    turned = read_rotations(table, prefix, statements.rotation)
    if turned is None:
        return None
    covariance = table.pose_covariances(prefix)
    side = Side(turned.rotation, at, places_of(table), turned.words, unit, frames, names)
    return replace(side, covariance=covariance, common=table.common_errors(covariance, prefix))


def _of_matrix(table: Table, matrix: MatrixColumns, frames: Frames | None, names: tuple[str, ...]) -> Side:
    """Returns the poses of matrices whose elements are columns."""
    rotation, translation = of_matrices(matrix.matrices(table), places_of(table), table.where)
    unit = Unit(matrix.unit, "by the columns", True) if matrix.unit else None
    return Side(rotation, translation, places_of(table), MATRICES, unit, frames, names)


def _named_matrices(table: Table, names: tuple[str, ...]) -> list[Side]:
    """Returns the matrices of both sides, identified by the names at the beginning of their columns. Returns none if
    there are not exactly two matrices, or if their names do not identify both sides."""
    full = [matrix for matrix in find_matrices(table) if matrix.translation]
    frames = [_frames_of_stem(matrix.stem) for matrix in full]
    if len(full) != len(ROLES) or {frame.role for frame in frames if frame is not None} != set(ROLES):
        return []
    return [_of_matrix(table, matrix, frame, names) for matrix, frame in zip(full, frames, strict=True)]


def _frames_of_stem(stem: str) -> Frames | None:
    """Returns the transform that the beginning of names of columns means, by ``gripper2base_T`` or ``robot_m``."""
    for name in (stem, re.sub(r"[\s_.\-]*(?:[TRHMrmh]|mat|matrix|pose)$", "", stem)):
        if frames := frames_of(name):
            return replace(frames, by=f"by the columns {stem}…")
        if role := role_of(name):
            return Frames(FRAMES[role][0], f"by the columns {stem}…", False)
    return None


def _place(table: Table, prefix: str) -> tuple[np.ndarray, Unit | None] | None:
    for form in ("{}", "t{}", "p{}", "pos_{}", "{}_pos"):
        for unit in LENGTHS:
            columns = [find_column(table, prefix, f"{form.format(axis)}_{unit}") for axis in "xyz"]
            present = [column for column in columns if column is not None]
            if len(present) == len("xyz"):
                values = np.column_stack([table.numbers(column) for column in present])
                return values, Unit(unit, "by the columns", True)
            if present and form == "{}":
                raise InputError(
                    "E-TABLE-COLUMN-MISSING",
                    f"{table.where}: {', '.join(present)} alone; x, y and z in one unit needed",
                )
        columns = [find_column(table, prefix, form.format(axis)) for axis in "xyz"]
        present = [column for column in columns if column is not None]
        if len(present) == len("xyz"):
            return np.column_stack([table.numbers(column) for column in present]), None
    return None


NPY, NPZ = b"\x93NUMPY", b"PK\x03\x04"
"""First bytes of the files."""
DAMAGED = (ValueError, TypeError, EOFError, OSError, MemoryError, OverflowError, SyntaxError, tokenize.TokenError)
"""Errors that NumPy raises for damaged files, whose heads are literals of Python."""


def load_npy(data: bytes, where: str) -> np.ndarray:
    """Returns the array of an npy file.

    Raises InputError: the file is damaged, or holds objects, which only a program could load.
    """
    stream = io.BytesIO(data)
    try:
        version = np.lib.format.read_magic(stream)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, kind = read(stream)
    except DAMAGED as error:
        raise _damaged(where, error) from error
    if kind.hasobject or kind.kind not in "iuf":
        raise InputError(
            "E-NUMPY-CONTENT", f"{where}: an array of {kind}, numbers needed; save it with np.save of a float array"
        )
    available, needed = len(data) - stream.tell(), int(np.prod([int(n) for n in shape], dtype=object)) * kind.itemsize
    if available != needed:
        raise InputError(
            "E-NUMPY-UNREADABLE", f"{where}: {available} bytes of numbers, {needed} needed by its head; save it again"
        )
    if not shape or not needed:
        raise InputError("E-NUMPY-CONTENT", f"{where}: an array of shape {shape}; poses needed")
    try:
        return np.array(np.load(io.BytesIO(data), allow_pickle=False), dtype=float)
    except DAMAGED as error:
        raise _damaged(where, error) from error


def load_npz(data: bytes, where: str) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Returns the arrays of an npz file by name, and the names of those that are not numbers.

    Raises InputError: the file is damaged, or larger than any such file is when unpacked.
    """
    arrays, others = {}, []
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = [member for member in archive.infolist() if member.filename.endswith(".npy")]
            size = sum(member.file_size for member in members)
            if size > TABLE_BYTES:
                raise InputError(
                    "E-FILE-TOO-LARGE", f"{where}: {size / MB:.0f} MB unpacked, at most {TABLE_BYTES // MB} MB are read"
                )
            for member in members:
                with archive.open(member) as stream:
                    content = stream.read(TABLE_BYTES + 1)
                name = member.filename.removesuffix(".npy")
                if _is_text(content):
                    arrays[name] = _texts(content)
                    continue
                try:
                    arrays[name] = load_npy(content, f"{where}: {name}")
                except InputError:
                    others.append(name)
    except (zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError, *DAMAGED) as error:
        raise _damaged(where, error) from error
    if not arrays:
        raise InputError("E-NUMPY-CONTENT", f"{where}: no arrays of numbers; save it with np.savez")
    return arrays, tuple(others)


def _is_text(content: bytes) -> bool:
    return b"'descr': '<U" in content[:128]


def _texts(content: bytes) -> list[str]:
    """Returns the strings of an array, which are mostly names of images."""
    try:
        return [str(text) for text in np.load(io.BytesIO(content), allow_pickle=False).ravel()]
    except MemoryError as error:
        raise ValueError("a head that is larger than its file") from error


def _damaged(where: str, error: Exception) -> InputError:
    return InputError(
        "E-NUMPY-UNREADABLE", f"{where}: not a file of NumPy ({' '.join(str(error).split())[:80]}); save it again"
    )
