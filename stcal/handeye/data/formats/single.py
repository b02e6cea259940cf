"""Reader of one pose as JSON and YAML files hold it: a matrix, a message of ROS, a file of Zivid, OpenCV's matrix."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from stcal.errors import InputError
from stcal.handeye.data.formats.record import MATRICES, MATRICES_3X4, Said, Unit, of_matrices
from stcal.io.poses.rotations import (
    ROTATION_VECTOR,
    Convention,
    of_quaternions,
    proper,
    require_finite,
    rotations,
    turned_values,
)

PLACE_KEYS = ("translation", "position", "t", "tvec", "trans", "xyz")
TURN_KEYS = ("rotation", "orientation", "quaternion", "R", "rvec", "rot", "q")
WRAPPED = ("pose", "transform", "matrix", "T", "H", "homogeneous", "transformation", "pose_matrix", "robot_pose")
"""Keys that may hold a pose in an object that also has its name or header."""
NAME_KEYS = (
    *("image", "img", "image_name", "image_file", "image_path", "filename", "file", "name"),
    *("timestamp", "stamp", "time", "id", "index"),
)
ROS = Unit("m", "as in ROS")
ZIVID = Unit("mm", "as in Zivid")


@dataclass(frozen=True, slots=True, eq=False)
class One:
    """``rotation`` (3, 3), ``translation`` (3,), ``turned`` and ``unit`` as in :class:`.record.Side`; ``form`` : of the
    file, where the pose shows it; ``name``."""

    rotation: np.ndarray
    translation: np.ndarray
    turned: str
    unit: Unit | None = None
    form: str = ""
    name: str = ""


def numbers(value: Any) -> np.ndarray | None:
    """Returns an array of numbers from lists, arrays or OpenCV's matrix; None for anything else, and for ragged
    lists."""
    if isinstance(value, Mapping):
        if not {"rows", "cols", "data"} <= value.keys():
            return None
        flat = numbers(value["data"])
        rows, columns = value["rows"], value["cols"]
        fits = isinstance(rows, int) and isinstance(columns, int) and flat is not None and flat.size == rows * columns
        return flat.reshape(rows, columns) if fits and flat is not None else None
    if not isinstance(value, list | tuple | np.ndarray) or not len(value):
        return None
    if not isinstance(value, np.ndarray) and not _all_numbers(value):
        return None
    try:
        return np.array(value, dtype=float)
    except (ValueError, TypeError):
        return None


def _all_numbers(value: Any) -> bool:
    """True if all values are numbers or null. Text that looks like a number is not a number; a null is reported later
    with its place."""
    if isinstance(value, list | tuple):
        return all(_all_numbers(item) for item in value)
    return value is None or (isinstance(value, int | float) and not isinstance(value, bool))


def one(value: Any, statements: Said, place: str, where: str) -> One | None:
    """Returns the pose in a value; None where the value does not have the shape of one.

    Raises InputError: the value has the shape of a pose, but is not valid; or its convention must be stated.
    """
    array = numbers(value)
    if array is not None:
        return _of_array(array, statements, place, where)
    if not isinstance(value, Mapping):
        return None
    if isinstance(value.get("FloatMatrix"), Mapping):
        pose = one(value["FloatMatrix"].get("Data"), statements, place, where)
        return pose and _named(pose, value, unit=ZIVID, form="Zivid pose file")
    pose = _of_parts(value, statements, place, where) or _of_scalars(value, place, where)
    if pose is None:
        inside = [value[key] for key in WRAPPED if key in value]
        if not inside:  # OpenCV's FileStorage: one matrix under any name
            inside = [item for item in value.values() if isinstance(item, Mapping) and "rows" in item]
            inside = inside if len(inside) == 1 else []
        if len(inside) == 1:
            pose = one(inside[0], statements, place, where)
    return pose and _named(pose, value)


def _named(found: One, value: Mapping, unit: Unit | None = None, form: str = "") -> One:
    name = found.name or name_in(value)
    return One(found.rotation, found.translation, found.turned, unit or found.unit, form or found.form, name)


def name_in(value: Mapping) -> str:
    """Returns the image, timestamp or number that belongs to a pose; for a message of ROS, its stamp."""
    for key in NAME_KEYS:
        value_of_key = value.get(key)
        if isinstance(value_of_key, str | int | float) and not isinstance(value_of_key, bool):
            return str(value_of_key).strip()
    header = value.get("header")
    stamp = header.get("stamp") if isinstance(header, Mapping) else value.get("stamp")
    if isinstance(stamp, Mapping):
        seconds, nanoseconds = stamp.get("secs", stamp.get("sec")), stamp.get("nsecs", stamp.get("nanosec"))
        if isinstance(seconds, int) and isinstance(nanoseconds, int):
            return f"{seconds}.{nanoseconds:09d}"
    return str(stamp) if isinstance(stamp, int | float) and not isinstance(stamp, bool) else ""


def _of_array(array: np.ndarray, statements: Said, place: str, where: str) -> One | None:
    if array.shape == (16,):
        array = array.reshape(4, 4)
    if array.shape == (12,):
        array = array.reshape(3, 4)
    if array.shape in ((4, 4), (3, 4)):
        rotation, translation = of_matrices(array[None], (place,), where)
        return One(rotation[0], translation[0], MATRICES if len(array) == 4 else MATRICES_3X4)
    if array.shape in ((6,), (7,)):
        require_finite(array[None], (place,), where)
        rotation, turned = turned_values(
            array[None, 3:], statements.rotation, "the numbers after x, y, z", (place,), where
        )
        return One(rotation[0], array[:3], turned)
    return None


def _of_parts(value: Mapping, statements: Said, place: str, where: str) -> One | None:
    """Returns the pose from a translation and a rotation under two keys."""
    at = next((value[key] for key in PLACE_KEYS if key in value), None)
    turn_key = next((key for key in TURN_KEYS if key in value), None)
    if at is None or turn_key is None:
        return None
    turn, unit, form = value[turn_key], None, ""
    if isinstance(at, Mapping) and {"x", "y", "z"} <= at.keys():
        at, unit, form = [at["x"], at["y"], at["z"]], ROS, "ROS messages"
    translation = numbers(at)
    if translation is None or translation.size != len("xyz"):
        raise InputError("E-POSE-VALUE", f"{where}: {place}: a translation of three numbers needed; correct it")
    require_finite(translation.reshape(1, 3), (place,), where)
    if isinstance(turn, Mapping) and {"x", "y", "z", "w"} <= turn.keys():
        wxyz = numbers([turn["w"], turn["x"], turn["y"], turn["z"]])
        if wxyz is None:
            raise InputError("E-POSE-VALUE", f"{where}: {place}: a quaternion of four numbers needed; correct it")
        rotation, turned = of_quaternions(wxyz[None], (place,), where), "quaternions x, y, z, w by name"
        return One(rotation[0], translation.ravel(), turned, unit, form)
    array = numbers(turn)
    if array is not None and array.size == 9:
        rotation = proper(array.reshape(1, 3, 3), (place,), where)
        return One(rotation[0], translation.ravel(), "3×3 matrices", unit, form)
    if array is None or array.size not in (3, 4):
        raise InputError(
            "E-POSE-VALUE", f"{where}: {place}: {turn_key} is no rotation; 3×3, a quaternion or three angles needed"
        )
    values = array.reshape(1, -1)
    if turn_key == "rvec":
        rotation, turned = rotations(values, Convention(ROTATION_VECTOR, "rad"), (place,), where)
    else:
        rotation, turned = turned_values(values, statements.rotation, turn_key, (place,), where)
    return One(rotation[0], translation.ravel(), turned, unit, form)


def _of_scalars(value: Mapping, place: str, where: str) -> One | None:
    """Returns the pose of an object with keys x, y, z, qw, qx, qy, qz; lengths in metres, as in data of
    ROS-Industrial."""
    keys = ("x", "y", "z", "qw", "qx", "qy", "qz")
    if not set(keys) <= value.keys():
        return None
    row = numbers([value[key] for key in keys])
    if row is None:
        raise InputError("E-POSE-VALUE", f"{where}: {place}: {', '.join(keys)} must be numbers; correct them")
    require_finite(row[None], (place,), where)
    rotation = of_quaternions(row[None, 3:], (place,), where)
    return One(rotation[0], row[:3], "quaternions by name", Unit("m", "as in ROS"), "ROS-Industrial poses")
