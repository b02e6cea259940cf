"""Reader of poses in JSON, YAML and npz files: it finds which values are poses, and of which side."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
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
    frames_of,
    of_matrices,
    require_each_once,
    role_of,
)
from stcal.handeye.data.formats.single import ROS, One, name_in, numbers, one
from stcal.io.poses.rotations import ROTATION_VECTOR, Convention, proper, require_finite, rotations, turned_values

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
