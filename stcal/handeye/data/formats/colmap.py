"""Poses of the images of a COLMAP model: camera_from_world, in lengths without a unit."""

import re
import struct
from pathlib import Path

import numpy as np

from stcal.errors import InputError
from stcal.handeye.data.formats.record import Content, Frames, Side, require_each_once
from stcal.io.files import MODEL_BYTES, read_bytes
from stcal.io.poses.colmap_images import floats_of, image_lines
from stcal.io.poses.rotations import of_quaternions, require_finite

TEXT, BINARY = "images.txt", "images.bin"
_IMAGE = re.compile(r"\d+(?:\s+\S+){7}\s+\d+\s+\S.*")
_HEAD = struct.Struct("<I7dI")
_POINT_BYTES = 24
FORM = "COLMAP model"


def model_file(folder: Path) -> Path | None:
    """Returns the file of the images in a folder that is a model; None for other folders."""
    return next((folder / name for name in (TEXT, BINARY) if (folder / name).is_file()), None)


def is_text(text: str) -> bool:
    """True if these are the lines of images.txt."""
    first = next((line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")), "")
    if not _IMAGE.fullmatch(first.strip()) or floats_of(first.split()) is not None:
        return False
    return floats_of(first.split()[1:8]) is not None


def read_text(text: str, where: str) -> Content:
    """Returns the poses in images.txt, which has two lines for each image; the second holds its points.

    Raises InputError: a line does not have the form of the format.
    """
    images = image_lines(text, where)
    places = [f"line {image.number}" for image in images]
    return _content([image.pose for image in images], [image.name for image in images], places, where)


def read_binary(path: Path, where: str) -> Content:
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
            _, *row, _ = _HEAD.unpack_from(data, at)
            at += _HEAD.size
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
    return _content(rows, names, [f"image {name}" for name in names], where)


def _content(rows: list, names: list[str], places: list[str], where: str) -> Content:
    if not rows:
        raise InputError("E-MODEL-EMPTY", f"{where}: a model without images; map them first")
    require_each_once(names, places, where)
    values = np.array(rows, dtype=float)
    require_finite(values, places, where)
    rotation = of_quaternions(values[:, :4], places, where)
    frames = Frames("camera_from_board", "the model's camera_from_world, its world for the board", False)
    turned = "quaternions w, x, y, z"
    side = Side(rotation, values[:, 4:], tuple(places), turned, None, frames, tuple(names), scaled=True)
    return Content(FORM, (side,))
