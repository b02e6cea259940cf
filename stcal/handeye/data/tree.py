"""Readers of 4×4 matrices in JSON, YAML and npz: they find which values are poses, and of which side."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from stcal.errors import InputError
from stcal.handeye.data.pose_pairs import Setup
from stcal.handeye.data.record import (
    FRAMES,
    Known,
    PoseContent,
    PoseSide,
    Said,
    frames_of,
    of_matrices,
    require_each_once,
    role_of,
)
from stcal.io.rotations import of_quaternions, proper, require_finite

WRAPPED = ("pose", "transform", "matrix", "T", "H", "homogeneous", "transformation", "pose_matrix", "robot_pose")
"""Keys that may hold a pose in an object that also has its name."""
NAME_KEYS = (
    *("image", "img", "image_name", "image_file", "image_path", "filename", "file", "name"),
    *("timestamp", "stamp", "time", "id", "index"),
)
HOLDERS = ("poses", "data", "samples", "pairs", "frames", "transforms", "measurements", "captures", "robot_poses")
"""Keys that may hold the list of poses."""
LISTED_NAMES = ("images", "image_names", "names", "files", "filenames", "timestamps", "stamps")
"""Keys of lists that name the poses of a stack in the same object."""
MOVEIT = {"effector_wrt_world", "object_wrt_sensor"}
SETUPS: dict[str, Setup] = {"eye_in_hand": "eye-in-hand", "eye_on_base": "eye-to-hand", "eye_to_hand": "eye-to-hand"}
"""Setups by easy_handeye's names of them."""
ROS = Known("m", "as in ROS", False)


def read_tree(value: Any, form: str, statements: Said, where: str) -> PoseContent | None:
    """Returns the poses in plain values; None where there are none."""
    if isinstance(value, Mapping):
        if "parameters" in value and "transform" in value:
            said = "the result of an easy_handeye calibration; give its samples, NAME.samples"
            raise InputError("E-POSES-NOT-FOUND", f"{where}: {said}")
        content = _easy_handeye(value, statements, where) or _of_keys(value, form, where)
        if content is not None:
            return content
        if (side := _side_of(value, where)) is not None:
            return PoseContent(form, (side,))
        for key in HOLDERS:
            if isinstance(value.get(key), Mapping | list | np.ndarray):
                content = read_tree(value[key], form, statements, where)
                if content is not None:
                    others = tuple(str(unused_key) for unused_key in value if unused_key != key)
                    return replace(content, passed_over=(*content.passed_over, *others))
        return None
    if not isinstance(value, list | np.ndarray) or not len(value):
        return None
    listed = isinstance(value, list) and isinstance(value[0], Mapping)
    if (content := _of_pairs(list(value), form, where) if listed else None) is not None:
        return content
    side = _side_of(value, where)
    return None if side is None else PoseContent(form, (side,))


def numbers(value: Any) -> np.ndarray | None:
    """Returns an array of numbers from lists, arrays or OpenCV's matrix; None for others, and for ragged lists."""
    if isinstance(value, Mapping):
        if not {"rows", "cols", "data"} <= value.keys():
            return None
        flat = numbers(value["data"])
        rows, columns = value["rows"], value["cols"]
        fits = isinstance(rows, int) and isinstance(columns, int) and flat is not None and flat.size == rows * columns
        return flat.reshape(rows, columns) if fits and flat is not None else None
    if not isinstance(value, list | np.ndarray) or not len(value):
        return None
    try:
        return np.array(value, dtype=float) if isinstance(value, np.ndarray) or _all_numbers(value) else None
    except (ValueError, TypeError):
        return None


def _all_numbers(value: Any) -> bool:
    """True if all values are numbers or null, which is reported later with its place; text is no number."""
    if isinstance(value, list):
        return all(_all_numbers(item) for item in value)
    return value is None or (isinstance(value, int | float) and not isinstance(value, bool))


def _matrix(value: Any) -> tuple[np.ndarray, str] | None:
    """Returns the matrix (4, 4) in a value and its name, empty where it has none; None for any other value."""
    array = numbers(value)
    if array is not None and array.shape == (16,):
        square = array.reshape(4, 4)  # by rows, or by columns as of Franka and OpenGL: the last row is 0 0 0 1
        by_columns = not square[:3, 3].any() and square[3, :3].any()
        return square.T if by_columns else square, ""
    if array is not None:
        return (array, "") if array.shape == (4, 4) else None
    if not isinstance(value, Mapping):
        return None
    named = [each for each in value.values() if (own := numbers(each)) is not None and own.size == 16]
    inside = [value[key] for key in WRAPPED if key in value] or (named if _name_in(value) else [])
    found = _matrix(inside[0]) if len(inside) == 1 else None
    return found and (found[0], found[1] or _name_in(value))


def _name_in(value: Mapping) -> str:
    """Returns the image, timestamp or number that belongs to a pose."""
    given = (value.get(key) for key in NAME_KEYS)
    return next((str(v).strip() for v in given if isinstance(v, str | int | float) and not isinstance(v, bool)), "")


def _side_of(value: Any, where: str, frames: Known | None = None) -> PoseSide | None:
    """Returns the matrices of a list, of a stack, or of a mapping by name; None for anything else."""
    names: tuple[str, ...] = ()
    if isinstance(value, Mapping):
        if _matrix(value) is not None:
            value, places = [value], ("the pose",)
        else:
            names = places = tuple(map(str, value))
            value = list(value.values())
            if any(_matrix(item) is None for item in value):
                return None
    elif isinstance(value, list | np.ndarray):
        array = numbers(value)
        value = [array] if array is not None and array.shape in ((4, 4), (16,)) else value
        places = tuple(f"pose {i}" for i in range(1, len(value) + 1))
    else:
        return None
    found = [_matrix(item) for item in value]
    if not found or found[0] is None:
        return None
    bad = [place for place, each in zip(places, found, strict=True) if each is None]
    if bad:
        raise InputError("E-POSE-VALUE", f"{where}: {bad[0]}: not a 4×4 matrix like the one before; take it out")
    matrices, named = zip(*filter(None, found), strict=True)
    names = names or (named if all(named) else ())
    require_each_once(names, places[: len(names)], where)
    rotation, translation = of_matrices(np.array(matrices), places, where)
    return PoseSide(rotation, translation, places, "4×4 matrices", None, frames, names)


def _easy_handeye(value: Mapping, statements: Said, where: str) -> PoseContent | None:
    """Returns easy_handeye's samples, in which the robot's poses are inverted for a camera that stands still."""
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
                needed = f"robot and {camera_key} needed; take it out"
                raise InputError("E-POSE-INCOMPLETE", f"{where}: sample {i}: {needed}")
        lists = [[entry["robot"] for entry in samples], [entry[camera_key] for entry in samples]]
    else:
        return None
    setup: Setup | None = None
    if isinstance(parameters, Mapping):
        setup = SETUPS.get(str(parameters.get("calibration_type", "")))
        if isinstance(parameters.get("eye_on_hand"), bool):
            setup = "eye-in-hand" if parameters["eye_on_hand"] else "eye-to-hand"
    fixed = (setup or statements.setup) == "eye-to-hand"
    of_setup = "eye-to-hand" if fixed else "eye-in-hand"
    by = "as easy_handeye writes it"
    frames = Known(FRAMES["robot"][fixed], f"{by} of {of_setup}", False), Known("camera_from_board", by, False)
    sides = [_of_messages(entry, where, side) for entry, side in zip(lists, frames, strict=True)]
    return PoseContent("easy_handeye samples", _same_count(sides, where), setup)


def _of_messages(values: Any, where: str, frames: Known) -> PoseSide:
    """Returns the poses of a list of ROS's transforms, metres."""
    if not isinstance(values, list) or not values:
        raise InputError("E-POSES-NOT-FOUND", f"{where}: samples of easy_handeye without transforms; save them anew")
    places, rows = tuple(f"sample {i}" for i in range(1, len(values) + 1)), []
    for value, place in zip(values, places, strict=True):
        parts = value.get("transform", value) if isinstance(value, Mapping) else {}
        at, turn = (parts.get(key) for key in ("translation", "rotation")) if isinstance(parts, Mapping) else ({}, {})
        row = None
        if isinstance(at, Mapping) and isinstance(turn, Mapping):
            row = numbers([*(at.get(c, "") for c in "xyz"), *(turn.get(c, "") for c in "wxyz")])
        if row is None:
            said = "no translation x, y, z and rotation x, y, z, w; correct it"
            raise InputError("E-POSE-VALUE", f"{where}: {place}: {said}")
        rows.append(row)
    require_finite(np.array(rows), places, where)
    rotation = of_quaternions(np.array(rows)[:, 3:], places, where)
    return PoseSide(rotation, np.array(rows)[:, :3], places, "quaternions x, y, z, w by name", ROS, frames)


def _of_keys(value: Mapping, form: str, where: str) -> PoseContent | None:
    """Returns stacks of poses, each side under keys that name it."""
    parts: dict[str, dict[str, Any]] = {}
    named: dict[str, Known] = {}
    others, names = [], ()
    for key, item in value.items():
        if str(key).lower() in LISTED_NAMES and isinstance(item, list | np.ndarray):
            names = tuple(str(name) for name in item)
            continue
        frames = frames_of(key)
        role = role_of(key) if frames is None else frames.role
        shaped = isinstance(item, list | Mapping | np.ndarray)
        if role is None or not shaped or (frames is None and _side_of(item, where) is None):
            others.append(str(key))
            continue
        frames = frames or Known(FRAMES[role][0], "by default", False)
        parts.setdefault(frames.name, {})[str(key)] = item
        named[frames.name] = frames
    if not parts:
        return None
    roles = [frames.role for frames in named.values()]
    if len(set(roles)) < len(roles) or any(len(item) > 2 for item in parts.values()):
        keys = ", ".join(key for item in parts.values() for key in item)
        raise InputError("E-POSES-MIXED", f"{where}: {keys}: more than one set of the same poses; leave one of each")
    sides = []
    for name, item in parts.items():
        [first, *more] = item.values()
        side = _of_rotations(item, where, named[name]) if more else _side_of(first, where, named[name])
        if side is None:
            needed = "4×4 matrices, or matrices 3×3 and translations, needed"
            raise InputError("E-POSES-NOT-FOUND", f"{where}: {', '.join(item)}: no poses; {needed}")
        sides.append(side)
    if names and len(names) != len(sides[0]):
        raise InputError("E-NAMES-COUNT", f"{where}: {len(names)} names of {len(sides[0])} poses; one each needed")
    if names:
        require_each_once(names, sides[0].places, where)
        sides = [replace(side, names=names) for side in sides]
    opencv = any("2" in key for item in parts.values() for key in item)
    return PoseContent("OpenCV's hand-eye arrays" if opencv else form, _same_count(sides, where), None, tuple(others))


def _of_rotations(parts: dict[str, Any], where: str, frames: Known) -> PoseSide:
    """Returns the poses of matrices 3×3 and translations under two keys, as ``cv2.calibrateHandEye`` takes them."""
    arrays = {}
    for key, value in parts.items():
        array = numbers([_flat(item) for item in value] if isinstance(value, list) else value)
        if array is None:
            raise InputError("E-POSES-COUNT", f"{where}: {key}: not as many numbers for each pose; correct it")
        arrays[key] = array
    turn_key, at_key = sorted(arrays, key=lambda key: -arrays[key].size)
    turn, at = arrays[turn_key], arrays[at_key]
    count = 1 if at.size == len("xyz") else len(at)
    if at.size != 3 * count or turn.size != 9 * count:
        shapes = f"{where}: {turn_key} of shape {turn.shape}, {at_key} of {at.shape}"
        raise InputError("E-POSES-SHAPE", f"{shapes}; a matrix 3×3 and a translation of 3 numbers for each pose needed")
    places = tuple(f"pose {i}" for i in range(1, count + 1))
    at = at.reshape(count, 3)
    require_finite(at, places, where)
    return PoseSide(proper(turn.reshape(-1, 3, 3), places, where), at, places, "3×3 matrices", frames=frames)


def _flat(value: Any) -> Any:
    array = numbers(value)
    return value if array is None else array.ravel().tolist()


def _of_pairs(value: Sequence[Mapping], form: str, where: str) -> PoseContent | None:
    """Returns the poses of a list whose entries hold the poses of both sides, or of one, under keys that name them."""
    stacks: dict[str, Any] = {}
    for key, entry in value[0].items():
        if (frames_of(key) is None and role_of(key) is None) or _matrix(entry) is None:
            continue
        if without := [i for i, other in enumerate(value, 1) if key not in other]:
            said = f"pose {without[0]}: {key} is missing, which pose 1 has; add it, or take the pose out"
            raise InputError("E-POSE-INCOMPLETE", f"{where}: {said}")
        stacks[key] = [other[key] for other in value]
    if not stacks:
        return None
    moveit, names = stacks.keys() == MOVEIT, [_name_in(entry) for entry in value]
    naming = ("image", "name", "header", "timestamp", "stamp", "id") if all(names) else ()
    unused = tuple(key for key in value[0] if key not in stacks and key not in naming)
    content = _of_keys(stacks | ({"names": names} if all(names) else {}), form, where)
    if content is None:
        return None
    sides = tuple(replace(side, unit=ROS) for side in content.sides) if moveit else content.sides
    return PoseContent("MoveIt hand-eye samples" if moveit else content.form, sides, None, unused)


def _same_count(sides: list[PoseSide], where: str) -> tuple[PoseSide, ...]:
    if len({len(side) for side in sides}) > 1:
        counts = " and ".join(f"{len(side)} of {side.frames.name if side.frames else 'one side'}" for side in sides)
        raise InputError("E-POSES-COUNT", f"{where}: {counts}; pairs needed")
    return tuple(sides)
