"""Readers of poses in JSON, YAML and npz files: they find which values are poses, and of which side. A pose is a
matrix, a message of ROS, a file of Zivid, or OpenCV's matrix."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from stcal.errors import InputError
from stcal.handeye.data.formats.record import (
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
    pose = _one_of_parts(value, statements, place, where) or _of_scalars(value, place, where)
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


def _one_of_parts(value: Mapping, statements: Said, place: str, where: str) -> One | None:
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


HOLDERS = ("poses", "data", "samples", "pairs", "frames", "transforms", "measurements", "captures", "robot_poses")
"""Keys that may hold the list of poses."""
LISTED_NAMES = ("images", "image_names", "names", "files", "filenames", "timestamps", "stamps")
"""Keys of lists that name the poses of a stack in the same object."""
MOVEIT = {"effector_wrt_world", "object_wrt_sensor"}
_CAMODOCAL = re.compile(r"T([12])_(\d+)")
OPENCV = "OpenCV's hand-eye arrays"


def read_tree(value: Any, form: str, statements: Said, where: str) -> Content | None:
    """Returns the poses in plain values; None where there are none.

    Raises InputError: a pose is not valid, there are more than two sides, or the convention must be stated.
    """
    if isinstance(value, Mapping):
        if "parameters" in value and "transform" in value:
            raise InputError(
                "E-POSES-NOT-FOUND",
                f"{where}: the result of an easy_handeye calibration; give its samples, NAME.samples",
            )
        if (content := easy_handeye(value, statements, where)) is not None:
            return content
        if (content := camodocal(value, where)) is not None:
            return content
        if (content := _of_keys(value, form, statements, where)) is not None:
            return content
        if (single := one(value, statements, "the pose", where)) is not None:
            return Content(single.form or form, (_side([single], ("the pose",), where),))
        if (content := _by_name(value, form, statements, where)) is not None:
            return content
        for key in HOLDERS:
            if isinstance(value.get(key), Mapping | list | np.ndarray):
                content = read_tree(value[key], form, statements, where)
                if content is not None:
                    others = tuple(str(unused_key) for unused_key in value if unused_key != key)
                    return Content(content.form, content.sides, content.setup, (*content.passed_over, *others))
        return None
    return _of_list(value, form, statements, where) if isinstance(value, list | np.ndarray) and len(value) else None


def easy_handeye(value: Mapping, statements: Said, where: str) -> Content | None:
    """Returns the samples of easy_handeye, ROS 1 and 2. For a camera that stands still it writes the robot's poses
    inverted."""
    samples, parameters = value.get("samples", value), value.get("parameters")
    if isinstance(samples, Mapping) and {"hand_world_samples", "camera_marker_samples"} <= samples.keys():
        lists = [samples["hand_world_samples"], samples["camera_marker_samples"]]
        lists = [entry.get("transforms") if isinstance(entry, Mapping) else entry for entry in lists]
    elif isinstance(samples, list) and samples and all(isinstance(entry, Mapping) for entry in samples):
        camera_key = next((key for key in ("tracking", "optical") if key in samples[0]), None)
        if camera_key is None or "robot" not in samples[0]:
            return None
        for i, sample in enumerate(samples, 1):
            if "robot" not in sample or camera_key not in sample:
                raise InputError(
                    "E-POSE-INCOMPLETE", f"{where}: sample {i}: robot and {camera_key} needed; take it out"
                )
        lists = [[entry["robot"] for entry in samples], [entry[camera_key] for entry in samples]]
    else:
        return None
    setup = None
    if isinstance(parameters, Mapping):
        by_type = {"eye_in_hand": "eye-in-hand", "eye_on_base": "eye-to-hand", "eye_to_hand": "eye-to-hand"}
        setup = by_type.get(str(parameters.get("calibration_type", "")))
        if isinstance(parameters.get("eye_on_hand"), bool):
            setup = "eye-in-hand" if parameters["eye_on_hand"] else "eye-to-hand"
    fixed = (setup or statements.setup) == "eye-to-hand"
    of_setup = "eye-to-hand" if fixed else "eye-in-hand"
    frames = (
        Frames(FRAMES["robot"][fixed], f"as easy_handeye writes it of {of_setup}", False),
        Frames("camera_from_board", "as easy_handeye writes it", False),
    )
    sides = []
    for entry, frames_of_side in zip(lists, frames, strict=True):
        side = _listed(entry if isinstance(entry, list) else [], statements, where, frames_of_side, "sample")
        if side is None:
            raise InputError(
                "E-POSES-NOT-FOUND", f"{where}: samples of easy_handeye without transforms; take samples, and save them"
            )
        sides.append(side)
    return Content("easy_handeye samples", _same_count(sides, where), setup)


def camodocal(value: Mapping, where: str) -> Content | None:
    """Returns the pairs that handeye_calib_camodocal records: ``T1_0``, ``T2_0`` …, tip in base and tag in camera.

    Raises InputError: a matrix is missing or not valid, or ``frameCount`` is another number.
    """
    matches = {key: match for key in value if (match := _CAMODOCAL.fullmatch(str(key)))}
    if "frameCount" not in value or not matches:
        return None
    count = value["frameCount"]
    sides = []
    for role, number in zip(ROLES, ("1", "2"), strict=True):
        keys = sorted(
            (key for key, match in matches.items() if match[1] == number), key=lambda key: int(matches[key][2])
        )
        if [int(matches[key][2]) for key in keys] != list(range(count if isinstance(count, int) else 0)):
            raise InputError(
                "E-POSES-COUNT",
                f"{where}: {len(keys)} matrices T{number}_…, frameCount is {count}; as many from T{number}_0 on needed",
            )
        matrices = [numbers(value[key]) for key in keys]
        wrong = next((key for key, m in zip(keys, matrices, strict=True) if m is None or m.shape != (4, 4)), None)
        if wrong is not None:
            raise InputError("E-POSE-VALUE", f"{where}: {wrong}: not a 4×4 matrix; record the pairs again")
        rotation, translation = of_matrices(np.array(matrices), keys, where)
        frames = Frames(FRAMES[role][0], "as handeye_calib_camodocal writes it", False)
        sides.append(
            Side(rotation, translation, tuple(f"pose {matches[key][2]}" for key in keys), MATRICES, ROS, frames)
        )
    return Content("pairs of handeye_calib_camodocal", tuple(sides))


def _of_keys(value: Mapping, form: str, statements: Said, where: str) -> Content | None:
    """Returns stacks of poses, each side under keys that name it."""
    parts: dict[str, dict[str, Any]] = {}
    named: dict[str, Frames] = {}
    others, names = [], ()
    for key, item in value.items():
        if str(key).lower() in LISTED_NAMES and isinstance(item, list | np.ndarray):
            names = tuple(str(name) for name in item)
            continue
        frames = frames_of(key)
        role = role_of(key) if frames is None else frames.role
        shaped = isinstance(item, list | Mapping | np.ndarray)
        if role is None or not shaped or (frames is None and _side_of(item, statements, where, None) is None):
            others.append(str(key))
            continue
        frames = frames or Frames(FRAMES[role][0], "by default", False)
        parts.setdefault(frames.name, {})[str(key)] = item
        named[frames.name] = frames
    if not parts:
        return None
    roles = [frames.role for frames in named.values()]
    if len(set(roles)) < len(roles):
        keys = ", ".join(key for item in parts.values() for key in item)
        raise InputError(
            "E-POSES-MIXED", f"{where}: {keys}: more than one set of the same poses; leave one of each side in the file"
        )
    sides = []
    for name, item in parts.items():
        side = _of_parts(item, statements, where, named[name])
        if side is None:
            keys = ", ".join(item)
            raise InputError(
                "E-POSES-NOT-FOUND", f"{where}: {keys}: no poses; 4×4 matrices, or rotations and translations, needed"
            )
        sides.append(side)
    if names and len(names) != len(sides[0]):
        raise InputError("E-NAMES-COUNT", f"{where}: {len(names)} names of {len(sides[0])} poses; one each needed")
    if names:
        sides = [_renamed(side, names, where) for side in sides]
    opencv = any("2" in key for item in parts.values() for key in item)
    return Content(OPENCV if opencv else form, _same_count(sides, where), None, tuple(others))


def _of_parts(parts: dict[str, Any], statements: Said, where: str, frames: Frames) -> Side | None:
    """Returns the poses under one key, or those of rotations and translations under two."""
    if len(parts) == 1:
        return _side_of(next(iter(parts.values())), statements, where, frames)
    if len(parts) != 2:
        raise InputError(
            "E-POSES-MIXED", f"{where}: {', '.join(parts)}: more than one set of the same poses; leave one in the file"
        )
    arrays = {}
    for key, value in parts.items():
        array = numbers([_flat(item) for item in value] if isinstance(value, list) else value)
        if array is None:
            raise InputError("E-POSES-COUNT", f"{where}: {key}: not as many numbers for each pose; correct it")
        arrays[key] = array
    keys = sorted(arrays, key=lambda key: (-arrays[key].size, not key.lower().startswith("r")))
    sizes = [arrays[key].size for key in keys]
    count = 1 if sizes[1] == len("xyz") else len(arrays[keys[1]])
    if sizes[1] != len("xyz") * count or sizes[0] % count or sizes[0] // count not in (3, 4, 9):
        raise InputError(
            "E-POSES-SHAPE",
            f"{where}: {keys[0]} of shape {arrays[keys[0]].shape}, {keys[1]} of {arrays[keys[1]].shape}; a rotation of "
            "9, 4 or 3 numbers and a translation of 3 for each pose needed",
        )
    turn, at = (arrays[key].reshape(count, -1) for key in keys)
    places = tuple(f"pose {i}" for i in range(1, len(at) + 1))
    require_finite(at, places, where)
    if turn.shape[1] == 9:
        return Side(proper(turn.reshape(-1, 3, 3), places, where), at, places, "3×3 matrices", frames=frames)
    if turn.shape[1] == 3 and keys[0].lower().startswith("r"):  # OpenCV takes rotation vectors in place of matrices
        rotation, words = rotations(turn, Convention(ROTATION_VECTOR, "rad"), places, where)
    else:
        rotation, words = turned_values(turn, statements.rotation, keys[0], places, where)
    return Side(rotation, at, places, words, frames=frames)


def _flat(value: Any) -> Any:
    array = numbers(value)
    return value if array is None else array.ravel().tolist()


def _by_name(value: Mapping, form: str, statements: Said, where: str) -> Content | None:
    """Returns a pose for each name; the names are mostly those of images."""
    if not value or not all(isinstance(item, Mapping | list | np.ndarray) for item in value.values()):
        return None
    poses = []
    for key, item in value.items():
        single = one(item, statements, str(key), where)
        if single is None:
            return None
        poses.append(One(single.rotation, single.translation, single.turned, single.unit, single.form, str(key)))
    return Content(poses[0].form or form, (_side(poses, tuple(map(str, value)), where),))


def _of_list(value: Any, form: str, statements: Said, where: str) -> Content | None:
    if all(isinstance(item, Mapping) for item in value):
        content = _of_pairs(value, form, statements, where)
        if content is not None:
            return content
    side = _side_of(value, statements, where, None)
    if side is None:
        return None
    singles = [one(item, statements, "pose", where) for item in value[:1]] if isinstance(value, list) else []
    return Content((singles[0].form if singles and singles[0] else "") or form, (side,))


def _of_pairs(value: Sequence[Mapping], form: str, statements: Said, where: str) -> Content | None:
    """Returns the poses of a list whose entries hold the poses of both sides, or of one, under keys that name them."""
    sides: dict[Role, tuple[str, Frames]] = {}
    others = []
    for key, entry in value[0].items():
        frames = frames_of(key)
        role = role_of(key) if frames is None else frames.role
        if role is None or one(entry, statements, "pose 1", where) is None:
            others.append(str(key))
            continue
        if role in sides:
            raise InputError(
                "E-POSE-REPEATED",
                f"{where}: {sides[role][0]} and {key}: poses of one side twice; leave one in the file",
            )
        sides[role] = (key, frames or Frames(FRAMES[role][0], "by default", False))
    if not sides:
        return None
    names = [name_in(entry) for entry in value]
    named = all(names)
    read = []
    for key, frames in sides.values():
        for i, entry in enumerate(value, 1):
            if key not in entry:
                raise InputError(
                    "E-POSE-INCOMPLETE",
                    f"{where}: pose {i}: {key} is missing, which pose 1 has; add it, or take the pose out",
                )
        side = _listed([entry[key] for entry in value], statements, where, frames, "pose")
        if side is None:
            raise InputError("E-POSE-VALUE", f"{where}: {key}: not a pose in every entry; correct it")
        read.append(_renamed(side, tuple(names), where) if named else side)
    moveit = {key for key, _ in sides.values()} == MOVEIT
    if moveit:
        read = [replace(side, unit=ROS) for side in read]
    unused = tuple(
        key for key in others if not (named and key in ("image", "name", "header", "timestamp", "stamp", "id"))
    )
    return Content("MoveIt hand-eye samples" if moveit else form, tuple(read), None, unused)


def _renamed(side: Side, names: tuple[str, ...], where: str) -> Side:
    require_each_once(names, side.places, where)
    return replace(side, names=names)


def _side_of(value: Any, statements: Said, where: str, frames: Frames | None) -> Side | None:
    """Returns one side from a list, a stack or a mapping by name; None if it has no poses."""
    if isinstance(value, Mapping):
        single = one(value, statements, "the pose", where)
        if single is not None:
            return _side([single], ("the pose",), where, frames)
        content = _by_name(value, "", statements, where)
        return content and replace(content.sides[0], frames=frames)
    if not isinstance(value, list | np.ndarray) or not len(value):
        return None
    if isinstance(value, list) and any(isinstance(item, Mapping) for item in value):
        return _listed(value, statements, where, frames, "pose")
    array = numbers(value)
    if array is None:
        return _listed(value, statements, where, frames, "pose") if isinstance(value, list) else None
    if array.shape in ((4, 4), (16,), (3, 4)):
        array = array.reshape(1, -1, 4)
    if array.ndim == 2 and array.shape[1] == 16:
        array = array.reshape(-1, 4, 4)
    if array.ndim == 2 and array.shape[1] in (6, 7):
        places = tuple(f"pose {i}" for i in range(1, len(array) + 1))
        require_finite(array, places, where)
        turned, words = turned_values(array[:, 3:], statements.rotation, "the numbers after x, y, z", places, where)
        return Side(turned, array[:, :3], places, words, frames=frames)
    if array.ndim != 3 or array.shape[1:] not in ((4, 4), (3, 4)):
        return None
    places = tuple(f"pose {i}" for i in range(1, len(array) + 1))
    rotation, translation = of_matrices(array, places, where)
    return Side(rotation, translation, places, MATRICES if array.shape[1] == 4 else MATRICES_3X4, frames=frames)


def _listed(values: Sequence, statements: Said, where: str, frames: Frames | None, what: str) -> Side | None:
    """Returns poses one by one; None where the first value is not a pose."""
    places = tuple(f"{what} {i}" for i in range(1, len(values) + 1))
    poses = []
    for value, place in zip(values, places, strict=True):
        single = one(value, statements, place, where)
        if single is None and not poses:
            return None
        if single is None:
            raise InputError(
                "E-POSE-VALUE",
                f"{where}: {place}: not a pose of the same form as the one before it; correct it, or take it out",
            )
        poses.append(single)
    return _side(poses, places, where, frames) if poses else None


def _side(found: Sequence[One], places: tuple[str, ...], where: str, frames: Frames | None = None) -> Side:
    units = {(pose.unit.name if pose.unit else "", pose.turned) for pose in found}
    if len(units) > 1:
        raise InputError(
            "E-POSES-MIXED",
            f"{where}: poses of {len(units)} kinds: {'; '.join(sorted(t for _, t in units))}; one needed",
        )
    names = tuple(pose.name for pose in found)
    if not all(names):
        names = ()
    require_each_once(names, places[: len(names)], where)
    rotation, translation = np.array([e.rotation for e in found]), np.array([e.translation for e in found])
    return Side(rotation, translation, places, found[0].turned, found[0].unit, frames, names)


def _same_count(sides: list[Side], where: str) -> tuple[Side, ...]:
    if len({len(side) for side in sides}) > 1:
        counts = " and ".join(f"{len(side)} of {side.frames.name if side.frames else 'one side'}" for side in sides)
        raise InputError("E-POSES-COUNT", f"{where}: {counts}; pairs needed")
    return tuple(sides)
