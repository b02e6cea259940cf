"""Recognises the format of a file of poses by its content, whatever its name; read this first. Also reads programs of
controllers, and the images of a COLMAP model: camera_from_world, in lengths without a unit."""

import json
import re
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import yaml

from stcal.errors import InputError
from stcal.geometry.rigid import Order
from stcal.handeye.data.formats.numeric import NPY, NPZ, TABLE, load_npy, load_npz, read_columns, read_numbers, todays
from stcal.handeye.data.formats.record import Content, Frames, Said, Side, Unit, require_each_once
from stcal.handeye.data.formats.tree import read_tree
from stcal.io.files import MB, MODEL_BYTES, SETTINGS_BYTES, TABLE_BYTES, read_bytes, text_of
from stcal.io.poses.columns import without_comments
from stcal.io.poses.programs import floats_of, image_lines
from stcal.io.poses.rotations import of_quaternions, require_finite, turned_values
from stcal.io.table import is_comment, read_table, separator_stated
from stcal.io.toml import load_yaml

IMAGES_TEXT, IMAGES_BINARY = "images.txt", "images.bin"
_IMAGE = re.compile(r"\d+(?:\s+\S+){7}\s+\d+\s+\S.*")
_IMAGE_HEAD = struct.Struct("<I7dI")
_POINT_BYTES = 24
MODEL_FORM = "COLMAP model"


def model_file(folder: Path) -> Path | None:
    """Returns the file of the images in a folder that is a model; None for other folders."""
    return next((folder / name for name in (IMAGES_TEXT, IMAGES_BINARY) if (folder / name).is_file()), None)


def is_model(text: str) -> bool:
    """True if these are the lines of images.txt."""
    first = next((line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")), "")
    if not _IMAGE.fullmatch(first.strip()) or floats_of(first.split()) is not None:
        return False
    return floats_of(first.split()[1:8]) is not None


def read_model(text: str, where: str) -> Content:
    """Returns the poses in images.txt, which has two lines for each image; the second holds its points.

    Raises InputError: a line does not have the form of the format.
    """
    images = image_lines(text, where)
    places = [f"line {image.number}" for image in images]
    return _content_of_model([image.pose for image in images], [image.name for image in images], places, where)


def read_model_binary(path: Path, where: str) -> Content:
    """Returns the poses in images.bin.

    Raises InputError: the file ends too early, or has bytes after its end.
    """
    try:
        data = read_bytes(path, MODEL_BYTES)
    except OSError as error:
        raise InputError("E-MODEL-UNREADABLE", f"{where}: {error.strerror or error}; give a readable model") from error
    rows, names, at = [], [], 8
    try:
        (count,) = struct.unpack_from("<Q", data, 0)
        while len(rows) < count:
            _, *row, _ = _IMAGE_HEAD.unpack_from(data, at)
            at += _IMAGE_HEAD.size
            end = data.index(b"\0", at)
            names.append(data[at:end].decode("utf-8"))
            (points,) = struct.unpack_from("<Q", data, end + 1)
            at = end + 9 + points * _POINT_BYTES
            rows.append(row)
            if at > len(data):
                raise ValueError("it ends too early")
        if at != len(data):
            raise ValueError(f"{len(data) - at} bytes too many")
    except (struct.error, ValueError) as error:
        raise InputError(
            "E-MODEL-UNREADABLE", f"{where}: not a COLMAP model's images.bin ({error}); export the model anew"
        ) from error
    return _content_of_model(rows, names, [f"image {name}" for name in names], where)


def _content_of_model(rows: list, names: list[str], places: list[str], where: str) -> Content:
    if not rows:
        raise InputError("E-MODEL-EMPTY", f"{where}: a model without images; map them first")
    require_each_once(names, places, where)
    values = np.array(rows, dtype=float)
    require_finite(values, places, where)
    rotation = of_quaternions(values[:, :4], places, where)
    frames = Frames("camera_from_board", "the model's camera_from_world, its world for the board", False)
    turned = "quaternions w, x, y, z"
    side = Side(rotation, values[:, 4:], tuple(places), turned, None, frames, tuple(names), scaled=True)
    return Content(MODEL_FORM, (side,))


_N = r"([+-]?\d+\.?\d*(?:[eE][+-]?\d+)?)"

_ABB = r"(?:robtarget|pose)\b[^\[\n]*\[\s*\[" + r"\s*,\s*".join("NNN")


def _form(between: str, *parts: str) -> re.Pattern[str]:
    return re.compile(between.join(part.replace("N", _N) for part in parts))


PROGRAMS = {
    "points of KUKA": (_form(r"\s*,\s*", *(rf"\b{name}\s+N" for name in "XYZABC")), "kuka-abc"),
    "targets of ABB": (_form(r"\s*\]\s*,\s*\[", _ABB, r"\s*,\s*".join("NNNN")), "wxyz"),
    "positions of FANUC": (_form(r"\s*,\s*", *(rf"\b{name}\s*=\s*N\s*(?:mm|deg)" for name in "XYZWPR")), "fanuc-wpr"),
    "points of Doosan": (_form("", r"\bposx\(\s*", r"\s*,\s*".join("NNNNNN")), "ZYZ-deg"),
    "points of Epson": (_form(r"\s+", *(rf"\br{name}=N" for name in "XYZUVW")), "ZYX-deg"),
}
"""Form of a pose in a program of each controller, x, y, z first, and the convention of its rotation."""


def read_program(text: str, where: str) -> Content | None:
    """Returns the poses in a program of a controller, in their order; None for any other text.

    Raises InputError: a quaternion is not of unit length.
    """
    lines = [line if without_comments(line) else "" for line in text.splitlines()]
    plain = "\n".join(lines)
    for called, (form, rotation) in PROGRAMS.items():
        if matches := list(form.finditer(plain)):
            values = np.array([match.groups() for match in matches], float)
            places = tuple(f"line {plain.count(chr(10), 0, match.start()) + 1}" for match in matches)
            turn, words = turned_values(values[:, 3:], rotation, called, places, where)
            return Content(called, (Side(turn, values[:, :3], places, words, Unit("mm", "as in these", True)),))
    return None


KNOWN = (
    "4×4 matrices (text, npy, npz, JSON, YAML), CSV with a header, samples of easy_handeye or MoveIt, TUM, Zivid, a "
    "ROS bag as CSV, or COLMAP's images.txt"
)
SUFFIXES = (".yaml", ".yml", ".json", ".txt", ".csv", ".npy", ".npz")
"""Endings of files with one pose each, in a folder."""


_BRACKETED_UNIT = re.compile(r"(?<=\w)\s*\[[a-zµ°]{1,3}\]", re.I)
"""A unit in the header of a table, which is no list of YAML."""
_INDEX = re.compile(r"(?<=[\w\]])\[\d\]")
"""Index of an element in the header of a table, as in ``T[0][3]``."""

_SPACED = re.compile(r"([A-Za-z_]\w*\s+){5,}[A-Za-z_]\w*")
"""A header of columns between which spaces stand, of six names at least, as a pose needs."""


class NotToldError(InputError):
    """An error for a file whose format is not known here; another reader may know it."""


def read_content(path: Path, statements: Said, key: str = "image", quaternions: Order = "wxyz") -> Content | None:
    """Returns the content of a file, of a folder of files with a pose each, or of a COLMAP model. Returns None for the
    package's own tables, and for tables whose readers give better messages.

    ``key`` : the column that names rows, where there is one; ``quaternions`` as in :func:`~stcal.io.table.read_table`.

    Raises InputError: the message says what is wrong with the file.
    """
    content = _read(path, statements, key, quaternions)
    if content is not None and quaternions != "wxyz" and not content.form.startswith(TABLE):
        raise InputError(
            "E-OPTION-NEEDS",
            f"{path}: --quaternions {quaternions} is of a CSV file's columns, not of {content.form}; leave it out",
        )
    return content


def _read(path: Path, statements: Said, key: str, quaternions: Order) -> Content | None:
    where = str(path)
    if path.is_dir():
        model = model_file(path)
        return read_content(model, statements) if model is not None else _of_folder(path, statements)
    try:
        if path.name == IMAGES_BINARY:
            return read_model_binary(path, where)
        data = read_bytes(path, TABLE_BYTES)
    except OSError as error:
        raise InputError("E-FILE-UNREADABLE", f"{where}: {error.strerror or error}; check the path") from error
    if data.startswith(NPY):
        return _required(read_tree(load_npy(data, where), "NumPy array", statements, where), where)
    if data.startswith(NPZ):
        arrays, others = load_npz(data, where)
        content = read_tree(
            next(iter(arrays.values())) if len(arrays) == 1 else arrays, "NumPy arrays", statements, where
        )
        if content is None:
            content = read_tree(arrays, "NumPy arrays", statements, where)
        return replace(_required(content, where), passed_over=(*_required(content, where).passed_over, *others))
    try:
        text = text_of(data)
    except UnicodeDecodeError:
        return None
    return _of_text(text, path, statements, key, quaternions)


def _of_text(text: str, path: Path, statements: Said, key: str, quaternions: Order) -> Content | None:
    where = str(path)
    used = (line for line in text.splitlines() if line.strip() and not is_comment(line))
    first = next((line.strip() for line in used if not separator_stated(line)), "")
    if not first:
        return None
    if first[0] in "{[" and (content := _json(text)) is not None:
        return _required(read_tree(content, "JSON", statements, where), where)
    if (content := read_program(text, where)) is not None:
        return content
    if is_model(text):
        return read_model(text, where)
    content = read_numbers(text, statements, where)
    if content is not None:
        return content
    if re.match(r"[^:\[{]*[,;\t]", _INDEX.sub("", _BRACKETED_UNIT.sub("", first))) or _SPACED.fullmatch(first):
        table = read_table(path, "pose file", quaternions)
        return None if todays(table) else read_columns(table, key, statements)
    value = _yaml(text, where)
    if not isinstance(value, list | dict):
        return None
    content = read_tree(value, "YAML", statements, where)
    if content is None:
        raise NotToldError("E-POSES-NOT-FOUND", f"{where}: no poses found in it; {KNOWN} needed")
    return content


def _required(found: Content | None, where: str) -> Content:
    if found is None:
        raise NotToldError("E-POSES-NOT-FOUND", f"{where}: no poses found in it; {KNOWN} needed")
    return found


def _json(text: str):
    """Returns the content of JSON, or of an object on each line; None where the text is neither."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        pass
    try:
        lines = [json.loads(line) for line in text.splitlines() if line.strip()]
    except (ValueError, RecursionError):
        return None
    return lines if lines and all(isinstance(line, dict) for line in lines) else None


def _yaml(text: str, where: str):
    """Returns the content of YAML. Several documents, as ``rostopic echo`` prints messages, are a list."""
    if len(text.encode("utf-8")) > SETTINGS_BYTES:
        raise InputError(
            "E-FILE-TOO-LARGE", f"{where}: {len(text) // MB} MB of YAML, at most {SETTINGS_BYTES // MB} MB are read"
        )
    headless = re.sub(r"\A\s*%YAML:?\s*[\d.]+\s*\n", "", text)
    parts = [part for part in re.split(r"^---[ \t]*$", headless, flags=re.MULTILINE) if part.strip()]
    try:
        documents = [load_yaml(part) for part in parts]
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise NotToldError(
            "E-YAML-INVALID", f"{where}: not YAML ({' '.join(str(error).split())[:100]}); {KNOWN} needed"
        ) from error
    return documents[0] if len(documents) == 1 else documents


def _of_folder(folder: Path, statements: Said) -> Content | None:
    """Returns a pose from each file, named by the file; None for a folder without such files."""
    files = sorted(path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES and path.is_file())
    if not files:
        return None
    read = []
    for file in files:
        content = read_content(file, statements)
        if content is None or len(content.sides) != 1 or len(content.sides[0]) != 1:
            count = "no pose" if content is None else f"{sum(len(side) for side in content.sides)} poses"
            raise InputError(
                "E-POSES-COUNT", f"{folder}: {file.name}: {count}, one in each file needed; take it out of the folder"
            )
        read.append((file, content))
    kinds = {content.form for _, content in read}
    if len(kinds) > 1:
        raise InputError(
            "E-POSES-MIXED", f"{folder}: files of {len(kinds)} kinds: {', '.join(sorted(kinds))}; one needed"
        )
    sides = [content.sides[0] for _, content in read]
    names, places = tuple(file.stem for file in files), tuple(file.name for file in files)
    require_each_once(names, places, str(folder))
    turned = {(side.turned, side.unit) for side in sides}
    if len(turned) > 1:
        raise InputError("E-POSES-MIXED", f"{folder}: rotations or units written in {len(turned)} ways; one needed")
    joined = Side(
        [side.rotation[0] for side in sides],  # type: ignore[arg-type]
        [side.translation[0] for side in sides],  # type: ignore[arg-type]
        places,
        sides[0].turned,
        sides[0].unit,
        sides[0].frames,
        names,
    )
    return Content(f"folder of {read[0][1].form}", (joined,))
