"""Pose pairs from files, whose format is recognised by their content: one direction, mm, rows that belong together."""

import io
import json
import re
import tokenize
import zipfile
import zlib
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from stcal.errors import InputError
from stcal.geometry.rigid import Order, Poses
from stcal.handeye.data.pose_content import (
    EVERY_FRAME,
    HandEyeInput,
    KnownName,
    PoseContent,
    PoseSide,
    Said,
    inverse_name,
    read_tree,
    require_each_once,
)
from stcal.handeye.data.pose_pairs import SIDES, Role, inverted, read_poses, read_side
from stcal.handeye.data.pose_partners import matched
from stcal.handeye.data.stream import LONGEST_S, TOLERANCE_S, Stream, Timed, stamps_of, taken_at
from stcal.io.files import MB, SETTINGS_BYTES, TABLE_BYTES, read_bytes, text_of
from stcal.io.join import keys_of
from stcal.io.rotations import (
    find_column,
    of_quaternions,
    places_of,
    read_rotations,
    require_finite,
    rotations,
    said_convention,
)
from stcal.io.table import FARTHEST, LENGTHS, Table, is_comment, read_table, separator_stated
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
    names, sides = _row_names(table, key), []
    prefixes = {f"{frame}_": KnownName(frame, f"by the columns {frame}_…") for frame in EVERY_FRAME}
    for prefix, frames in (*prefixes.items(), ("", None)):
        if (sides and not prefix) or (place := _place(table, prefix)) is None:
            continue
        if (turned := read_rotations(table, prefix, statements.rotation)) is None:
            continue
        covariance, (at, unit) = table.pose_covariances(prefix), place
        common, poses = table.common_errors(covariance, prefix), Poses(turned.rotation, at)
        sides.append(PoseSide(poses, places_of(table), turned.words, unit, frames, names, False, covariance, common))
    if not sides:
        return None
    known = [side.frames for side in sides if side.frames is not None]
    if len({frames.role for frames in known}) < len(known):
        both = ", ".join(frames.name for frames in known)
        raise InputError("E-POSES-MIXED", f"{table.where}: columns of {both}; one of each side needed; drop the others")
    return PoseContent(f"{TABLE} ({table.form})" if table.form else TABLE, tuple(sides))


def _row_names(table: Table, key: str) -> tuple[str, ...]:
    """Returns image or time of each row, as text: nanoseconds have more digits than a float; empty without a column."""
    lower = {name.lower(): name for name in table.columns}
    column = next((name for name in (key, *NAMES) if name in table), None)
    if column := column or next((lower[name] for name in NAMES if name in lower), None):
        values = tuple(table.text(column))
        require_each_once(values, places_of(table), table.where)
        return values
    number = next((lower[name] for name in NUMBERS if name in lower), None)
    values = tuple(table.text(number)) if number is not None else ()
    return values if len(set(values)) == len(table) else ()


def _place(table: Table, prefix: str) -> tuple[np.ndarray, KnownName | None] | None:
    for form in ("{}", "t{}", "p{}", "pos_{}", "{}_pos"):
        for unit in (*LENGTHS, ""):
            names = (form.format(axis) + f"_{unit}" * bool(unit) for axis in "xyz")
            present = [column for name in names if (column := find_column(table, prefix, name)) is not None]
            if len(present) == len("xyz"):
                values = np.column_stack([table.numbers(column) for column in present])
                return values, KnownName(unit, "by the columns") if unit else None
            if present and unit and form == "{}":
                alone = f"{table.where}: {', '.join(present)} alone"
                raise InputError("E-TABLE-COLUMN-MISSING", f"{alone}; x, y and z in one unit needed")
    return None


KNOWN = (
    "a table with named columns, a TUM trajectory, 4×4 matrices in JSON, npy, npz or OpenCV's FileStorage, samples of "
    "easy_handeye or MoveIt, or lines p[x, y, z, rx, ry, rz] of Universal Robots"
)
NPY, NPZ = b"\x93NUMPY", b"PK\x03\x04"  # first bytes of the files
DAMAGED = (ValueError, TypeError, EOFError, OSError, MemoryError, OverflowError, SyntaxError, tokenize.TokenError)
"""Errors that NumPy raises for damaged files, whose heads are literals of Python."""
TUM = 8  # numbers in a line of a TUM trajectory
NANOSECONDS = 19  # digits of a time in ns since 1970
_QUATERNION = re.compile(r"(?<![a-z])q[a-z_]*?([wxyz])\b")
_UNIVERSAL = re.compile(r"p\s*\[(.*)\]")
_BRACKETED_UNIT = re.compile(r"(?<=\w)\s*\[[a-zµ°]{1,3}\]", re.I)
"""A unit in the header of a table, which is no list of YAML."""
_HEADER = re.compile(r"[^:\[{]*[,;\t]")
_SPACED = re.compile(r"([A-Za-z_]\w*\s+){5,}[A-Za-z_]\w*")
"""A header of columns between which spaces stand, of six names at least, as a pose needs."""


def read_content(path: Path, statements: Said, key: str = "image", quaternions: Order = "wxyz") -> PoseContent | None:
    """Returns the content of a file. Returns None for the package's own tables, and for tables whose readers give
    better messages. ``key`` : the column that names rows, where there is one; ``quaternions`` as in
    :func:`~stcal.io.table.read_table`."""
    if path.is_dir():
        raise InputError("E-POSES-NOT-FOUND", f"{path}: a folder; one file needed: {KNOWN}")
    try:
        data = read_bytes(path, TABLE_BYTES)
    except OSError as error:
        raise InputError("E-FILE-UNREADABLE", f"{path}: {error.strerror or error}; check the path") from error
    content = _content(path, data, statements, key, quaternions)
    if content is not None and quaternions != "wxyz" and not content.form.startswith(TABLE):
        said = f"--quaternions {quaternions} is of a CSV file's columns, not of {content.form}; leave it out"
        raise InputError("E-OPTION-NEEDS", f"{path}: {said}")
    return content


def _content(path: Path, data: bytes, said: Said, key: str, quaternions: Order) -> PoseContent | None:
    """Returns the content as of the first format that the file may be of."""
    where = str(path)
    if data.startswith(NPY):
        return _of_values(_array(data, where), "NumPy array", said, where)
    if data.startswith(NPZ):
        return _of_npz(data, said, where)
    try:
        text = text_of(data)
    except UnicodeDecodeError:
        return None
    lines = [(i, line) for i, line in enumerate(text.splitlines(), 1) if line.strip() and not is_comment(line)]
    first = next((line.strip() for _, line in lines if not separator_stated(line)), "")
    if not first:
        return None
    if text.lstrip().startswith(("{", "[")):
        value = None
        with suppress(ValueError, RecursionError):  # YAML may begin so, too
            value = json.loads(text)
        if value is not None:
            return _of_values(value, "JSON", said, where)
    if _UNIVERSAL.fullmatch(first):
        inside = [(number, _UNIVERSAL.fullmatch(line.strip())) for number, line in lines]
        values, places = _rows_of([(number, match[1] if match else "") for number, match in inside], 6, where)
        convention = said_convention(said.rotation, "the numbers after x, y, z", where)
        rotation, words = rotations(values[:, 3:], convention, places, where)
        return PoseContent("rows of numbers", (PoseSide(Poses(rotation, values[:, :3]), places, words),))
    name, *others = re.split(r"[\s,;]+", first, maxsplit=1)
    named = _numbers(others[0]) if others and ":" not in name and name != "-" else None
    if numbers := _numbers(first) or named:
        if len(_numbers(first) or ()) == TUM:
            return _of_tum(lines, [line for line in text.splitlines() if is_comment(line)], said, where)
        raise _not_known(where, f"rows of {len(numbers)} numbers without a header")
    if _HEADER.match(_BRACKETED_UNIT.sub("", first)) or _SPACED.fullmatch(first):
        table = read_table(path, "pose file", quaternions)
        return None if todays(table) else read_columns(table, key, said)
    return _of_yaml(text, said, where)


def _not_known(where: str, found: str) -> InputError:
    return InputError("E-POSES-NOT-FOUND", f"{where}: {found}; {KNOWN} needed")


def _numbers(line: str) -> list[float] | None:
    """Returns the numbers of a line; None where a cell is no number."""
    try:
        return [float(cell) for cell in re.split(r"[\s,;]+", line.strip(" \t,;"))]
    except ValueError:
        return None


def _rows_of(lines: list[tuple[int, str]], count: int, where: str) -> tuple[np.ndarray, tuple[str, ...]]:
    """Returns the numbers (m, count) of all lines, and their places; refuses a line that holds something else."""
    values = []
    for number, line in lines:
        row = _numbers(line)
        if row is None or len(row) != count:
            held = "no numbers" if row is None else f"{len(row)} numbers"
            raise InputError("E-POSES-ROWS", f"{where}: line {number}: {held}, {count} as in the first one needed")
        values.append(row)
    places = tuple(f"line {number}" for number, _ in lines)
    require_finite(np.array(values), places, where)
    return np.array(values), places


def _of_tum(lines: list[tuple[int, str]], comments: list[str], said: Said, where: str) -> PoseContent:
    """Returns poses of lines timestamp tx ty tz qx qy qz qw; a comment, or --rotation, may state another order."""
    values, places = _rows_of(lines, TUM, where)
    names = tuple(re.split(r"[\s,;]+", line.strip())[0] for _, line in lines)
    order = next((letters for c in comments if len(letters := _QUATERNION.findall(c.lower())) == 4), [])
    if sorted(order) != sorted("wxyz"):
        order = list("xyzw")
        if said.rotation or all(name.isdigit() and len(name) >= NANOSECONDS for name in names):
            what = "the last four numbers after a time in ns"
            order = list(said_convention(said.rotation, what, where, len("wxyz")).order)
    require_each_once(names, places, where)
    wxyz = values[:, 4:][:, [order.index(component) for component in "wxyz"]]
    turned, unit = f"quaternions {', '.join(order)}", KnownName("m", "as in TUM", False)
    poses = Poses(of_quaternions(wxyz, places, where), values[:, 1:4])
    side = PoseSide(poses, places, turned, unit, names=names, trajectory=True)
    return PoseContent("TUM trajectory (timestamp, place, quaternion)", (side,))


def _of_values(value: Any, form: str, said: Said, where: str) -> PoseContent:
    content = read_tree(value, form, said, where)
    if content is None:
        held = f"keys {', '.join(map(str, list(value)[:SHOWN]))} …" if isinstance(value, dict) else form
        raise _not_known(where, f"no poses in {held}")
    return content


def _of_yaml(text: str, said: Said, where: str) -> PoseContent:
    if len(text.encode("utf-8")) > SETTINGS_BYTES:
        sizes = f"{len(text) // MB} MB of YAML, at most {SETTINGS_BYTES // MB} MB are read"
        raise InputError("E-FILE-TOO-LARGE", f"{where}: {sizes}")
    try:
        documents = [each for each in load_documents(text) if each is not None]
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        reason = " ".join(str(error).split())[:100]
        raise InputError("E-YAML-INVALID", f"{where}: not YAML ({reason}); {KNOWN} needed") from error
    if len(documents) != 1 or not isinstance(documents[0], list | dict):
        raise _not_known(where, f"{len(documents)} documents of YAML" if documents[1:] else "not understood")
    return _of_values(documents[0], "YAML", said, where)


def _of_npz(data: bytes, said: Said, where: str) -> PoseContent:
    """Returns the poses of an archive of arrays; arrays of other things than numbers are passed over."""
    arrays: dict[str, Any] = {}
    others = []
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = [member for member in archive.infolist() if member.filename.endswith(".npy")]
            size = sum(member.file_size for member in members)
            if size > TABLE_BYTES:
                sizes = f"{size / MB:.0f} MB unpacked, at most {TABLE_BYTES // MB} MB are read"
                raise InputError("E-FILE-TOO-LARGE", f"{where}: {sizes}")
            for member in members:
                name, content = member.filename.removesuffix(".npy"), archive.read(member)
                try:
                    arrays[name] = _array(content, where)
                except InputError:
                    others.append(name)
    except (zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError, *DAMAGED) as error:
        raise _damaged(where, error) from error
    if not any(isinstance(array, np.ndarray) for array in arrays.values()):
        raise InputError("E-NUMPY-CONTENT", f"{where}: no arrays of numbers; save it with np.savez")
    form, [first, *more] = "NumPy arrays", arrays.values()
    single = None if more else read_tree(first, form, said, where)
    content = single or _of_values(arrays, form, said, where)
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


METRES_UP_TO, MILLIMETRES_FROM = 5.0, 50.0
"""Lengths are metres if all are below the first limit, and millimetres if one is above the second. Flanges and boards
are farther from base and camera than 5 mm, and nearer than 50 m."""
MIXED = 100.0  # ratio of the farthest to the nearest pose above which poses are in two units
SHOWN = 4  # keys that a message names


def read_pairs(source: Path | Table, statements: Said, quaternions: Order = "wxyz") -> HandEyeInput:
    """Returns the pose pairs of one file, or of a table of the package's own.

    Raises InputError: the message says what is wrong with the file, or that it holds poses of one side only.
    """
    if isinstance(source, Table) or (content := read_content(source, statements, "image", quaternions)) is None:
        pairs = read_poses(source, quaternions)  # first: a table that is not understood states nothing
        require_unsaid(statements, str(source))
        return HandEyeInput(pairs.where, pairs)
    if len(content.sides) == 1:
        frames = content.sides[0].frames
        held = f"{frames.name} alone" if frames is not None else "poses of one side, robot or camera"
        said = f"{source}: {content.form} with {held}"
        raise InputError("E-POSES-MIXED", f"{said}; give the robot's file as --a and the camera's as --b")
    robot, camera = (settled(content, role, source, statements) for role in SIDES)
    if robot.guessed != camera.guessed and robot.guessed and camera.guessed:
        said = (
            f"{source}: by their size the robot's lengths are in {robot.guessed} and the camera's in {camera.guessed}"
        )
        raise InputError("E-POSES-UNITS", f"{said}; write both in one unit, or to two files for --a and --b")
    return HandEyeInput.of(robot, camera, robot.names or camera.called(), source.name, setup=content.setup)


def read_two(
    first: Path,
    second: Path,
    statements: Said,
    key: str,
    quaternions: Order = "wxyz",
    tolerance_s: float = TOLERANCE_S,
    timed: bool = False,
) -> HandEyeInput | None:
    """Returns the robot's poses and the camera's, from two files, as pairs, joined by image or time, or by order where
    neither has names; None where both are the package's own tables. Where times are not equal, and for all rows where
    ``timed``, the robot's poses are those at the camera's times, within ``tolerance_s``."""
    files = tuple(zip(SIDES, (first, second), keys_of(key), strict=True))
    contents = [read_content(path, statements.of(role), own, quaternions) for role, path, own in files]
    if not any(contents):
        return None
    sides, setup = [], next((each.setup for each in contents if each is not None and each.setup), None)
    for (role, path, own), content in zip(files, contents, strict=True):
        if content is None:
            table = read_table(path, "table", quaternions)
            content = read_columns(table, own, statements)
            if content is None:
                raise _no_poses(table)
        sides.append(settled(content, role, path, statements))
    (robot, camera), where = sides, f"{first.name} with {second.name}"
    times, wanted = (stamps_of(side.names) if side.names else None for side in sides)
    if timed and (times is None or wanted is None):
        untimed = (robot if times is None else camera).where
        raise InputError("E-POSES-UNTIMED", f"{untimed}: no times of its poses; with --time-offset both need them")
    if times is not None and wanted is not None and (timed or not set(wanted) <= set(times)):
        stream = Stream.of(times, robot.poses, first.name)
        seconds = stream.after_origin(wanted)
        taken = taken_at(stream, seconds, camera.names, tolerance_s)
        if not taken.rows:
            said = f"no pose has one of the robot: first {', '.join(taken.left_out[0])}"
            raise InputError("E-POSES-UNMATCHED", f"{camera.where}: {said}")
        lines = [taken.said]
        if robot.covariance is not None:
            lines.append("covariances of the robot's poses are not used: they are of other times")
        robot, camera = replace(robot, poses=taken.base_from_flange, covariance=None), camera[taken.rows]
        more = {"left_out": taken.left_out, "timed": Timed(stream, seconds[taken.rows])}
        return HandEyeInput.of(robot, camera, camera.names, where, lines, setup=setup, **more)
    rows, how = matched(robot, camera, key)
    a, b = ([row[k] for row in rows] for k in (0, 1))
    stamped = None
    if times is not None and wanted is not None and len(set(times)) >= max(len(times), len(rows) + 1):
        stream = Stream.of(times, robot.poses, first.name)
        if stream.spacing_s() <= LONGEST_S:
            stamped = Timed(stream, stream.after_origin([wanted[j] for j in b]))
    alone = [(robot, first, a)] if stamped is None else []  # samples between images are no mistake
    left_out = []
    for side, path, used in (*alone, (camera, second, b)):
        left_out += [(name, f"in {path.name} alone") for i, name in enumerate(side.called()) if i not in used]
    more = {"setup": setup, "left_out": tuple(left_out), "timed": stamped}
    lines = [f"rows joined {how}"] if how else []
    return HandEyeInput.of(robot[a], camera[b], robot[a].called(), where, lines, **more)


TIME = "time_s"  # column of a stream of poses, in place of ``image``


def read_robot(path: Path, statements: Said, quaternions: Order = "wxyz") -> PoseSide:
    """Returns the robot's poses of a file; a table of the package's own has a column ``image``, or ``time_s``, and
    ``base_from_flange_x_mm`` … (or the inverse). ``statements`` : what the user says of another program's file."""
    content = read_content(path, statements.of("robot"), "image", quaternions)
    if content is not None:
        return settled(content, "robot", path, statements)
    if statements.options():
        require_own(path, quaternions)
        require_unsaid(statements, f"robot poses {path}")
    table = read_table(path, "robot poses", quaternions)
    timed = "image" not in table and TIME in table
    names = tuple(table.text(TIME if timed else "image"))
    require_each_once(names, places_of(table), table.where, "image ")
    poses, covariance, _ = read_side(table, *SIDES["robot"])
    frame = next(name for name in SIDES["robot"] if any(column.startswith(f"{name}_") for column in table.columns))
    understood = f"{path.name}: table; {len(names)} poses; {frame} by its columns; {table.unit(f'{frame}_x', LENGTHS)}"
    read = {"names": names, "covariance": covariance, "where": str(path), "understood": understood, "own": True}
    return PoseSide(poses, places_of(table), "quaternions by name", timed=timed, **read)


def require_unsaid(statements: Said, where: str) -> None:
    """Refuse statements on a table whose columns state the same."""
    if statements.options():
        said = f"{where}: the names of columns state unit, rotation and direction; leave "
        said += f"{', '.join(statements.options())} out, and "
        said += "rename columns that are wrong (base_from_flange_x_m in place of …_x_mm, or flange_from_base_x_mm)"
        raise InputError("E-OPTION-NEEDS", said)


def own_told(source: Path | Table, quaternions: Order = "wxyz") -> list[str]:
    """Returns lines that describe a table of pose pairs of the package's own."""
    table = read_table(source, "pose file", quaternions)
    content, place = read_columns(table, "image", Said()), Path(table.where.removeprefix("pose file "))
    return [f"{role}: {settled(content, role, place, Said()).understood}" for role in SIDES] if content else []


def require_own(path: Path, quaternions: Order = "wxyz") -> None:
    """Refuse a table without poses in its columns."""
    table = read_table(path, "table", quaternions)
    if not todays(table):
        raise _no_poses(table)


def _no_poses(table: Table) -> InputError:
    said = f"{table.where}: no poses in its columns; a place (x, y, z or x_mm …) and a rotation (qw … qz, rx, ry, rz, "
    said += f"a, b, c …) needed; the header is {table.header()}; rename them"
    return InputError("E-POSES-NOT-FOUND", said)


def settled(content: PoseContent, role: Role, path: Path, statements: Said) -> PoseSide:
    """Returns poses of a role, or of the only side, in the direction that is needed, mm, and how they were read."""
    wanted, first, statements = SIDES[role][0], content.sides[0], statements.of(role)
    side = content.of(role) or (first if len(content.sides) == 1 and first.frames is None else None)
    if side is None:
        held = first.frames.name if first.frames else "poses"
        raise InputError("E-POSES-MIXED", f"{path}: {content.form} of {held}, {wanted} needed here; give another file")
    lengths = side.poses.translation
    far = np.flatnonzero(np.abs(lengths).max(axis=1) > FARTHEST)
    if len(far):
        said = f"length {np.abs(lengths[far[0]]).max():.3g}, at most {FARTHEST:g}"
        raise InputError("E-VALUE-TOO-FAR", f"{path}: {side.places[far[0]]}: {said}")
    frames = _direction(side, role, path, statements)
    unit, guessed = _unit(side, frames.name, path, statements)
    poses, covariance, common = Poses(side.poses.rotation, LENGTHS[unit.name] * lengths), side.covariance, side.common
    if frames.name != wanted:
        poses, covariance, common = inverted(poses, covariance, common)
    parts = [f"{path.name}: {content.form}", f"{len(side)} poses", f"{frames.name} {frames.by}", side.turned]
    parts.append(f"{unit.name} {unit.by}")
    if content.passed_over:
        ellipsis = " …" if len(content.passed_over) > SHOWN else ""
        parts.append(f"passed over: {', '.join(content.passed_over[:SHOWN])}{ellipsis}")
    read = {"where": str(path), "understood": "; ".join(parts), "guessed": guessed}
    return replace(side, poses=poses, covariance=covariance, common=common, **read)


def _direction(side: PoseSide, role: Role, path: Path, statements: Said) -> KnownName:
    """Returns the direction that the user or the file states; by default that of the method, or of a trajectory."""
    option, frames = next((name for name in statements.frames if name in SIDES[role]), None), side.frames
    if option is not None and frames is not None and frames.stated and frames.name != option:
        said = f"{path}: {frames.name} {frames.by}, --poses-are {option}; if the name is wrong, change it in the file"
        name = inverse_name(frames.by.rpartition(" ")[2])
        raise InputError("E-OPTION-CONTRADICTS", f"{said}{f', to {name}' if name else ''}; else leave the option out")
    if option is not None:
        return KnownName(option, "as you say")
    if frames is None and side.trajectory and role == "camera":
        return KnownName("board_from_camera", "by default, the camera's trajectory")
    return frames or KnownName(SIDES[role][0], "by default")


def _unit(side: PoseSide, name: str, path: Path, statements: Said) -> tuple[KnownName, str]:
    """Returns the unit, and its name again if it was guessed from the size of lengths."""
    option = statements.length_unit
    if side.unit is not None and (option is None or side.unit.stated):
        return side.unit, ""
    if option is not None:
        return KnownName(option, "as you say", False), ""
    distances = np.linalg.norm(side.poses.translation, axis=1)
    farthest, nearest = float(distances.max()), float(distances.min())
    if 0 < nearest < farthest / MIXED:
        near, far = side.places[int(distances.argmin())], side.places[int(distances.argmax())]
        said = f"{path}: {name}: {near} is {nearest:.3g} away and {far} {farthest:.3g}, as if in two units"
        raise InputError("E-POSES-UNITS", f"{said}; write all in the same unit and give --length-unit mm or m")
    if METRES_UP_TO < farthest < MILLIMETRES_FROM or farthest == 0:
        said = f"{path}: {name}: lengths up to {farthest:.3g}, {METRES_UP_TO:g} or less for metres and "
        said += f"{MILLIMETRES_FROM:g} or more for mm needed to tell the unit; give --length-unit mm, cm or m"
        raise InputError("E-POSES-UNITS", said)
    guess = "m" if farthest <= METRES_UP_TO else "mm"
    return KnownName(guess, f"by their size, up to {farthest:.4g}", False), guess
