"""Which format a file of poses has, told by its content whatever its name; read this first."""

import json
import re
from dataclasses import replace
from pathlib import Path

import yaml

from stcal.errors import InputError
from stcal.handeye.data.formats import colmap
from stcal.handeye.data.formats.arrays import NPY, NPZ, load_npy, load_npz
from stcal.handeye.data.formats.columns import TABLE, read_columns, todays
from stcal.handeye.data.formats.numeric import read_numbers
from stcal.handeye.data.formats.record import Content, Said, Side, require_each_once
from stcal.handeye.data.formats.tree import read_tree
from stcal.io.files import MB, SETTINGS_BYTES, TABLE_BYTES, read_bytes
from stcal.io.plain_yaml import load_yaml
from stcal.io.quaternions import Order
from stcal.io.table import read_table

KNOWN = (
    "4×4 matrices (text, npy, npz, JSON, YAML), CSV with a header, samples of easy_handeye or MoveIt, TUM, Zivid, a "
    "ROS bag as CSV, or COLMAP's images.txt"
)
SUFFIXES = (".yaml", ".yml", ".json", ".txt", ".csv", ".npy", ".npz")
"""Of files with one pose each, in a folder."""


class NotToldError(InputError):
    """No format that is known; another reader may know it."""


def read_content(path: Path, said: Said, key: str = "image", quaternions: Order = "wxyz") -> Content | None:
    """What a file, a folder of files with a pose each, or a COLMAP model holds; None of the package's own tables, and
    of tables that their readers explain better.

    ``key`` : the column that names rows, where there is one; ``quaternions`` as of
    :func:`~stcal.io.table.read_table`.

    Raises
    ------
    InputError
        What is wrong with it.
    """
    found = _read(path, said, key, quaternions)
    if found is not None and quaternions != "wxyz" and found.form != TABLE:
        raise InputError(
            "E-OPTION-NEEDS",
            f"{path}: --quaternions {quaternions} is of a CSV file's columns, not of {found.form}; leave it out",
        )
    return found


def _read(path: Path, said: Said, key: str, quaternions: Order) -> Content | None:
    where = str(path)
    if path.is_dir():
        model = colmap.model_file(path)
        return read_content(model, said) if model is not None else _of_folder(path, said)
    try:
        if path.name == colmap.BINARY:
            return colmap.read_binary(path, where)
        data = read_bytes(path, TABLE_BYTES)
    except OSError as error:
        raise InputError("E-FILE-UNREADABLE", f"{where}: {error.strerror or error}; check the path") from error
    if data.startswith(NPY):
        return _required(read_tree(load_npy(data, where), "NumPy array", said, where), where)
    if data.startswith(NPZ):
        arrays, other = load_npz(data, where)
        found = read_tree(next(iter(arrays.values())) if len(arrays) == 1 else arrays, "NumPy arrays", said, where)
        if found is None:
            found = read_tree(arrays, "NumPy arrays", said, where)
        return replace(_required(found, where), passed_over=(*_required(found, where).passed_over, *other))
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return None
    return _of_text(text, path, said, key, quaternions)


def _of_text(text: str, path: Path, said: Said, key: str, quaternions: Order) -> Content | None:
    where = str(path)
    first = next((line.strip() for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")), "")
    if not first:
        return None
    if first[0] in "{[" and (found := _json(text)) is not None:
        return _required(read_tree(found, "JSON", said, where), where)
    if colmap.is_text(text):
        return colmap.read_text(text, where)
    found = read_numbers(text, said, where)
    if found is not None:
        return found
    if re.match(r"[^:\[{]*,", first):
        table = read_table(path, "pose file", quaternions)
        return None if todays(table) else read_columns(table, text, key, said)
    value = _yaml(text, where)
    if not isinstance(value, list | dict):
        return None
    found = read_tree(value, "YAML", said, where)
    if found is None:
        raise NotToldError("E-POSES-NOT-FOUND", f"{where}: no poses found in it; {KNOWN} needed")
    return found


def _required(found: Content | None, where: str) -> Content:
    if found is None:
        raise NotToldError("E-POSES-NOT-FOUND", f"{where}: no poses found in it; {KNOWN} needed")
    return found


def _json(text: str):
    """JSON, or an object on each line; None where it is none."""
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
    """YAML; several documents, as ``rostopic echo`` prints messages, are a list."""
    if len(text.encode("utf-8")) > SETTINGS_BYTES:
        raise InputError(
            "E-FILE-TOO-LARGE", f"{where}: {len(text) // MB} MB of YAML, at most {SETTINGS_BYTES // MB} MB are read"
        )
    headless = re.sub(r"\A\s*%YAML:?\s*[\d.]+\s*\n", "", text)
    parts = [part for part in re.split(r"^---[ \t]*$", headless, flags=re.MULTILINE) if part.strip()]
    try:
        found = [load_yaml(part) for part in parts]
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise NotToldError(
            "E-YAML-INVALID", f"{where}: not YAML ({' '.join(str(error).split())[:100]}); {KNOWN} needed"
        ) from error
    return found[0] if len(found) == 1 else found


def _of_folder(folder: Path, said: Said) -> Content | None:
    """A pose from each file, named by the file; None of a folder without such files."""
    files = sorted(each for each in folder.iterdir() if each.suffix.lower() in SUFFIXES and each.is_file())
    if not files:
        return None
    read = []
    for file in files:
        content = read_content(file, said)
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
