"""Recognises the format of a file of poses by its content, whatever its name, and reads tables; read this first."""

import io
import json
import re
import tokenize
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from stcal.errors import InputError
from stcal.geometry.rigid import Order
from stcal.handeye.data.record import EVERY_FRAME, Known, PoseContent, PoseSide, Said, require_each_once
from stcal.handeye.data.tree import read_tree
from stcal.io.files import MB, SETTINGS_BYTES, TABLE_BYTES, read_bytes, text_of
from stcal.io.rotations import (
    find_column,
    of_quaternions,
    places_of,
    read_rotations,
    require_finite,
    said_convention,
    turned_values,
)
from stcal.io.table import LENGTHS, Table, is_comment, read_table, separator_stated
from stcal.io.toml import load_documents

TABLE = "table"
NAMES = (
    *("image", "image_name", "filename", "file", "name", "pose"),
    *("field.header.stamp", "header.stamp", "header_stamp", "timestamp", "stamp", "%time", "__time", "time_s", "time"),
)
"""Columns that name a row, in order of preference."""
NUMBERS = ("nr", "no", "number", "index", "id", "#")
"""Columns that name a row where no value occurs twice: elsewhere they number something else, such as the board."""


def todays(table: Table) -> bool:
    """True if the columns are those of the package's own tables: a place with its unit, and a quaternion."""
    prefixes = ("", *(f"{name}_" for name in EVERY_FRAME))
    placed = [prefix for prefix in prefixes if table.has(f"{prefix}x", LENGTHS)]
    return bool(placed) and all(f"{prefix}qw" in table for prefix in placed)


def read_columns(table: Table, key: str, statements: Said) -> PoseContent | None:
    """Returns the poses in the columns of a table; None where it has none."""
    names = _row_names(table, key)
    prefixes = {f"{frame}_": Known(frame, f"by the columns {frame}_…") for frame in EVERY_FRAME}
    read = [_side(table, prefix, frames, names, statements) for prefix, frames in prefixes.items()]
    sides = [side for side in read if side is not None]
    if not sides and (side := _side(table, "", None, names, statements)) is not None:
        sides = [side]
    if not sides:
        return None
    roles = [side.frames.role for side in sides if side.frames is not None]
    if len(set(roles)) < len(roles):
        both = ", ".join(side.frames.name for side in sides if side.frames is not None)
        raise InputError("E-POSES-MIXED", f"{table.where}: columns of {both}; one of each side needed; drop the others")
    return PoseContent(f"{TABLE} ({table.form})" if table.form else TABLE, tuple(sides))


def _row_names(table: Table, key: str) -> tuple[str, ...]:
    """Returns image or time of each row, as text: nanoseconds have more digits than a float; empty without a column."""
    lower = {name.lower(): name for name in table.columns}
    column = next((name for name in (key, *NAMES) if name in table), None)
    column = column or next((lower[name] for name in NAMES if name in lower), None)
    if column is not None:
        values = tuple(table.text(column))
        require_each_once(values, places_of(table), table.where)
        return values
    number = next((lower[name] for name in NUMBERS if name in lower), None)
    if number is not None and len(set(table.text(number))) == len(table):
        return tuple(table.text(number))
    return ()


def _side(table: Table, prefix: str, frames: Known | None, names: tuple[str, ...], statements: Said) -> PoseSide | None:
    """Returns the poses in the columns that begin with a prefix; None where place or rotation is missing."""
    place = _place(table, prefix)
    turned = None if place is None else read_rotations(table, prefix, statements.rotation)
    if place is None or turned is None:
        return None
    covariance = table.pose_covariances(prefix)
    common = table.common_errors(covariance, prefix)
    at, unit = place
    side = PoseSide(turned.rotation, at, places_of(table), turned.words, unit, frames, names)
    return replace(side, covariance=covariance, common=common)


def _place(table: Table, prefix: str) -> tuple[np.ndarray, Known | None] | None:
    for form in ("{}", "t{}", "p{}", "pos_{}", "{}_pos"):
        for unit in (*LENGTHS, ""):
            names = (form.format(axis) + f"_{unit}" * bool(unit) for axis in "xyz")
            present = [column for name in names if (column := find_column(table, prefix, name)) is not None]
            if len(present) == len("xyz"):
                values = np.column_stack([table.numbers(column) for column in present])
                return values, Known(unit, "by the columns") if unit else None
            if present and unit and form == "{}":
                alone = f"{table.where}: {', '.join(present)} alone"
                raise InputError("E-TABLE-COLUMN-MISSING", f"{alone}; x, y and z in one unit needed")
    return None


KNOWN = (
    "a table with named columns, a TUM trajectory, 4×4 matrices in JSON, npy, npz or OpenCV's FileStorage, samples of "
    "easy_handeye or MoveIt, or lines p[x, y, z, rx, ry, rz] of Universal Robots"
)
NPY, NPZ = b"\x93NUMPY", b"PK\x03\x04"
"""First bytes of the files."""
DAMAGED = (ValueError, TypeError, EOFError, OSError, MemoryError, OverflowError, SyntaxError, tokenize.TokenError)
"""Errors that NumPy raises for damaged files, whose heads are literals of Python."""
SHOWN = 4
"""Keys that are named in an error."""
TUM = 8
"""Numbers in a line of a TUM trajectory."""
NANOSECONDS = 19
"""Digits of a time in ns since 1970."""
_QUATERNION = re.compile(r"(?<![a-z])q[a-z_]*?([wxyz])\b")
_UNIVERSAL = re.compile(r"p\s*\[(.*)\]")
_BRACKETED_UNIT = re.compile(r"(?<=\w)\s*\[[a-zµ°]{1,3}\]", re.I)
"""A unit in the header of a table, which is no list of YAML."""
_HEADER = re.compile(r"[^:\[{]*[,;\t]")
_SPACED = re.compile(r"([A-Za-z_]\w*\s+){5,}[A-Za-z_]\w*")
"""A header of columns between which spaces stand, of six names at least, as a pose needs."""


@dataclass(frozen=True, slots=True)
class File:
    """A file of poses. ``lines`` : those that are neither empty nor comments, by their number; ``key``,
    ``quaternions`` : see :func:`read_content`."""

    path: Path
    data: bytes
    text: str
    lines: tuple[tuple[int, str], ...]
    said: Said
    key: str
    quaternions: Order

    @property
    def where(self) -> str:
        return str(self.path)

    @property
    def first(self) -> str:
        return next((line.strip() for _, line in self.lines if not separator_stated(line)), "")


def read_content(path: Path, statements: Said, key: str = "image", quaternions: Order = "wxyz") -> PoseContent | None:
    """Returns the content of a file. Returns None for the package's own tables, and for tables whose readers give
    better messages.

    ``key`` : the column that names rows, where there is one; ``quaternions`` as in :func:`~stcal.io.table.read_table`.
    """
    if path.is_dir():
        raise InputError("E-POSES-NOT-FOUND", f"{path}: a folder; one file needed: {KNOWN}")
    try:
        data = read_bytes(path, TABLE_BYTES)
    except OSError as error:
        raise InputError("E-FILE-UNREADABLE", f"{path}: {error.strerror or error}; check the path") from error
    try:
        text = "" if data.startswith((NPY, NPZ)) else text_of(data)
    except UnicodeDecodeError:
        return None
    used = ((i, line) for i, line in enumerate(text.splitlines(), 1) if line.strip() and not is_comment(line))
    file = File(path, data, text, tuple(used), statements, key, quaternions)
    if (text and not file.first) or not data:
        return None
    content = next(reader(file) for is_of, reader in FORMATS if is_of(file))
    if content is not None and quaternions != "wxyz" and not content.form.startswith(TABLE):
        said = f"--quaternions {quaternions} is of a CSV file's columns, not of {content.form}; leave it out"
        raise InputError("E-OPTION-NEEDS", f"{path}: {said}")
    return content


def _not_known(where: str, found: str) -> InputError:
    return InputError("E-POSES-NOT-FOUND", f"{where}: {found}; {KNOWN} needed")


def _numbers(line: str) -> list[float] | None:
    """Returns the numbers of a line; None where a cell is no number."""
    try:
        return [float(cell) for cell in re.split(r"[\s,;]+", line.strip(" \t,;"))]
    except ValueError:
        return None


def _table_of(file: File, of_line: Callable[[str], list[float] | None], count: int) -> tuple[np.ndarray, tuple]:
    """Returns the numbers (m, count) of all lines, and their places; refuses a line that holds something else."""
    values = []
    for number, line in file.lines:
        row = of_line(line)
        if row is None or len(row) != count:
            held = "no numbers" if row is None else f"{len(row)} numbers"
            raise InputError("E-POSES-ROWS", f"{file.where}: line {number}: {held}, {count} as in the first one needed")
        values.append(row)
    places = tuple(f"line {number}" for number, _ in file.lines)
    require_finite(np.array(values), places, file.where)
    return np.array(values), places


def _of_universal(file: File) -> PoseContent:
    """Returns the poses of lines ``p[x, y, z, rx, ry, rz]``."""

    def inside(line: str) -> list[float] | None:
        match = _UNIVERSAL.fullmatch(line.strip())
        return match and _numbers(match[1])

    values, places = _table_of(file, inside, 6)
    rotation, words = turned_values(values[:, 3:], file.said.rotation, "the numbers after x, y, z", places, file.where)
    return PoseContent("rows of numbers", (PoseSide(rotation, values[:, :3], places, words),))


def _of_tum(file: File) -> PoseContent:
    """Returns poses of lines timestamp tx ty tz qx qy qz qw; a comment, or --rotation, may state another order."""
    values, places = _table_of(file, _numbers, TUM)
    names = tuple(re.split(r"[\s,;]+", line.strip())[0] for _, line in file.lines)
    comments = (line for line in file.text.splitlines() if is_comment(line))
    order = next((letters for c in comments if len(letters := _QUATERNION.findall(c.lower())) == 4), [])
    if sorted(order) != sorted("wxyz"):
        order = list("xyzw")
        if file.said.rotation or all(name.isdigit() and len(name) >= NANOSECONDS for name in names):
            what = "the last four numbers after a time in ns"
            order = list(said_convention(file.said.rotation, what, file.where, len("wxyz")).order)
    require_each_once(names, places, file.where)
    wxyz = values[:, 4:][:, [order.index(component) for component in "wxyz"]]
    turned, unit = f"quaternions {', '.join(order)}", Known("m", "as in TUM", False)
    rotation = of_quaternions(wxyz, places, file.where)
    side = PoseSide(rotation, values[:, 1:4], places, turned, unit, names=names, trajectory=True)
    return PoseContent("TUM trajectory (timestamp, place, quaternion)", (side,))


def _row_of_numbers(file: File) -> list[float] | None:
    """Returns the numbers of the first line, with or without a name before them; None for any other line."""
    name, *others = re.split(r"[\s,;]+", file.first, maxsplit=1)
    named = others and ":" not in name and name != "-"
    return _numbers(file.first) or (_numbers(others[0]) if named else None)


def _refuse_rows(file: File) -> PoseContent:
    raise _not_known(file.where, f"rows of {len(_row_of_numbers(file) or [])} numbers without a header")


def _of_table(file: File) -> PoseContent | None:
    table = read_table(file.path, "pose file", file.quaternions)
    return None if todays(table) else read_columns(table, file.key, file.said)


def _is_json(file: File) -> bool:
    try:
        return file.text.lstrip().startswith(("{", "[")) and json.loads(file.text) is not None
    except (ValueError, RecursionError):
        return False


def _of_values(file: File, value: Any, form: str) -> PoseContent:
    content = read_tree(value, form, file.said, file.where)
    if content is None:
        held = f"keys {', '.join(map(str, list(value)[:SHOWN]))} …" if isinstance(value, dict) else form
        raise _not_known(file.where, f"no poses in {held}")
    return content


def _of_yaml(file: File) -> PoseContent:
    if len(file.text.encode("utf-8")) > SETTINGS_BYTES:
        sizes = f"{len(file.text) // MB} MB of YAML, at most {SETTINGS_BYTES // MB} MB are read"
        raise InputError("E-FILE-TOO-LARGE", f"{file.where}: {sizes}")
    try:
        documents = [each for each in load_documents(file.text) if each is not None]
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise InputError(
            "E-YAML-INVALID", f"{file.where}: not YAML ({' '.join(str(error).split())[:100]}); {KNOWN} needed"
        ) from error
    if len(documents) != 1 or not isinstance(documents[0], list | dict):
        raise _not_known(file.where, f"{len(documents)} documents of YAML" if documents[1:] else "not understood")
    return _of_values(file, documents[0], "YAML")


def _of_npz(file: File) -> PoseContent:
    """Returns the poses of an archive of arrays; arrays of other things than numbers are passed over."""
    arrays: dict[str, Any] = {}
    others = []
    try:
        with zipfile.ZipFile(io.BytesIO(file.data)) as archive:
            members = [member for member in archive.infolist() if member.filename.endswith(".npy")]
            size = sum(member.file_size for member in members)
            if size > TABLE_BYTES:
                sizes = f"{size / MB:.0f} MB unpacked, at most {TABLE_BYTES // MB} MB are read"
                raise InputError("E-FILE-TOO-LARGE", f"{file.where}: {sizes}")
            for member in members:
                name, content = member.filename.removesuffix(".npy"), archive.read(member)
                try:
                    arrays[name] = _array(content, file.where)
                except InputError:
                    others.append(name)
    except (zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError, *DAMAGED) as error:
        raise _damaged(file.where, error) from error
    numeric = [array for array in arrays.values() if isinstance(array, np.ndarray)]
    if not numeric:
        raise InputError("E-NUMPY-CONTENT", f"{file.where}: no arrays of numbers; save it with np.savez")
    form = "NumPy arrays"
    single = read_tree(numeric[0], form, file.said, file.where) if len(arrays) == 1 else None
    content = single or _of_values(file, arrays, form)
    return replace(content, passed_over=(*content.passed_over, *others))


def _array(data: bytes, where: str) -> np.ndarray | list[str]:
    """Returns the array of an npy file, or its strings, which are mostly names of images."""
    stream = io.BytesIO(data)
    try:
        array = np.load(stream, allow_pickle=False)
    except DAMAGED as error:
        raise _damaged(where, error) from error
    if stream.tell() != len(data):
        raise InputError("E-NUMPY-UNREADABLE", f"{where}: {len(data) - stream.tell()} bytes after its array; save anew")
    if array.dtype.kind == "U":
        return [str(text) for text in array.ravel()]
    if array.dtype.kind not in "iuf" or not array.ndim or not array.size:
        raise InputError("E-NUMPY-CONTENT", f"{where}: array of {array.dtype}, shape {array.shape}; numbers needed")
    return np.array(array, dtype=float)


def _damaged(where: str, error: Exception) -> InputError:
    said = " ".join(str(error).split())[:80]
    return InputError("E-NUMPY-UNREADABLE", f"{where}: not a file of NumPy ({said}); save it again")


FORMATS: tuple[tuple[Callable[[File], object], Callable[[File], PoseContent | None]], ...] = (
    (
        lambda file: file.data.startswith(NPY),
        lambda file: _of_values(file, _array(file.data, file.where), "NumPy array"),
    ),
    (lambda file: file.data.startswith(NPZ), _of_npz),
    (_is_json, lambda file: _of_values(file, json.loads(file.text), "JSON")),
    (lambda file: bool(_UNIVERSAL.fullmatch(file.first)), _of_universal),
    (lambda file: len(_numbers(file.first) or ()) == TUM, _of_tum),
    (_row_of_numbers, _refuse_rows),
    (lambda file: bool(_HEADER.match(_BRACKETED_UNIT.sub("", file.first)) or _SPACED.fullmatch(file.first)), _of_table),
    (lambda file: True, _of_yaml),
)
"""Whether a file is of a format, by its content, and the reader of that format, in this order."""
