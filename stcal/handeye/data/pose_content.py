"""The content of a file of poses: which of its values are poses, of which side, and what the user states beside it; and
the pairs that both sides give."""

import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from stcal.errors import InputError
from stcal.geometry.rigid import Poses, Rigid
from stcal.handeye.data.corner_views import Views
from stcal.handeye.data.pose_pairs import SIDES, HandEyePoses, Role, Setup
from stcal.handeye.data.stream import Timed
from stcal.io.cameras.camera_model import CameraPrior
from stcal.io.rotations import of_quaternions, proper, require_finite
from stcal.io.table import LENGTHS

EVERY_FRAME = tuple(name for names in SIDES.values() for name in names)
BY_DEFAULT = "by default"


@dataclass(frozen=True, slots=True)
class KnownName:
    """``name`` of a transform, of :data:`EVERY_FRAME`, or of a unit, of :data:`stcal.io.table.LENGTHS`; ``by`` : how it
    is known, in words; ``stated`` : whether the file itself states it, so that an option cannot contradict it."""

    name: str
    by: str
    stated: bool = True

    @property
    def role(self) -> Role:
        """The side that has this transform."""
        return "robot" if self.name in SIDES["robot"] else "camera"


@dataclass(frozen=True, slots=True, eq=False)
class PoseSide:
    """Poses of the robot or of the camera, as a file has them, or in the direction that is needed and mm.

    ``poses`` : m, lengths in ``unit``; ``places`` : place of each pose in its file, like ``line 7``; ``turned`` : how
    rotations are written; ``unit``, ``frames`` : None where the file does not say; ``names`` : image or timestamp of
    each pose, if any; ``trajectory`` : whether poses are those of a moving body in a world; ``covariance`` : (m, 6, 6),
    mm and rad; ``common`` : (m, 6, k) errors that the poses have in common, contained in their covariances; ``where``,
    ``understood`` : the file, and how it was read; ``guessed`` : the unit that was guessed from the size of lengths;
    ``own`` : whether the file is a table of the package; ``timed`` : whether ``names`` are times by the name of their
    column.
    """

    poses: Poses
    places: tuple[str, ...]
    turned: str
    unit: KnownName | None = None
    frames: KnownName | None = None
    names: tuple[str, ...] = ()
    trajectory: bool = False
    covariance: np.ndarray | None = None
    common: np.ndarray | None = None
    where: str = ""
    understood: str = ""
    guessed: str = ""
    own: bool = False
    timed: bool = False

    def __len__(self) -> int:
        return len(self.places)

    def __getitem__(self, rows: Sequence[int]) -> "PoseSide":
        at = list(rows)
        names, places = (tuple(every[i] for i in at) if every else () for every in (self.names, self.places))
        covariance, common = (None if each is None else each[at] for each in (self.covariance, self.common))
        return replace(self, poses=self.poses[at], names=names, places=places, covariance=covariance, common=common)

    def called(self) -> tuple[str, ...]:
        """Returns the names of the rows, or their places."""
        return self.names or self.places


@dataclass(frozen=True, slots=True, eq=False)
class HandEyeInput:
    """Input of a hand-eye calibration.

    ``where`` : its files; ``views`` : of the board, where images were given, with its ``symmetries`` and the camera's
    ``prior``; ``pitch_mm`` of the board's file; ``left_out`` : (image or row, why); ``understood`` : a line for each
    file that is not a table of the package; ``setup`` : where the user or a file states it; ``timed`` : times of the
    pairs in the robot's stream, where its poses were taken by time; ``notes`` : on rows of only one of two files.
    """

    where: str
    pairs: HandEyePoses
    views: Views | None = None
    symmetries: tuple[Rigid, ...] = ()
    prior: CameraPrior | None = None
    pitch_mm: float | None = None
    left_out: tuple[tuple[str, str], ...] = ()
    understood: tuple[str, ...] = ()
    setup: Setup | None = None
    timed: Timed | None = None
    notes: tuple[str, ...] = ()

    @classmethod
    def of(
        cls, robot: PoseSide, camera: PoseSide, names: Sequence[str], where: str, lines: Sequence[str] = (), **more: Any
    ) -> "HandEyeInput":
        """Returns the rows of both sides, which belong together; ``lines`` : further ones on how they were read."""
        covariances = robot.covariance, camera.covariance
        pairs = HandEyePoses(robot.poses, camera.poses, *covariances, tuple(names), where, camera.common)
        understood = (f"robot: {robot.understood}", f"camera: {camera.understood}", *lines)
        return cls(where, pairs, understood=understood, **more)


@dataclass(frozen=True, slots=True)
class PoseContent:
    """Content of a file of poses. ``form`` : format of the file, in words; ``sides`` : one side whose role is not
    known, or one side of each role; ``setup`` : setup that the file states, if any; ``passed_over`` : other content of
    the file that is not used."""

    form: str
    sides: tuple[PoseSide, ...]
    setup: Setup | None = None
    passed_over: tuple[str, ...] = ()

    def of(self, role: Role) -> PoseSide | None:
        """Returns the side that is stated to be of this role."""
        return next((side for side in self.sides if side.frames is not None and side.frames.role == role), None)


@dataclass(frozen=True, slots=True)
class Said:
    """The user's statements about files that do not state these themselves.

    ``rotation`` : a name of :data:`stcal.io.rotations.ALIASES` or an order of axes; ``length_unit`` : one of
    :data:`stcal.io.table.LENGTHS`; ``frames`` : names of :data:`EVERY_FRAME`, at most one of each role; ``setup``;
    ``own`` : ``rotation`` and ``length_unit`` of one role's poses, where they differ.
    """

    rotation: str | None = None
    length_unit: str | None = None
    frames: tuple[str, ...] = ()
    setup: Setup | None = None
    own: Mapping[str, dict[str, str]] = field(default_factory=dict)

    @classmethod
    def of_options(
        cls, rotation: Sequence[str], length_unit: Sequence[str], frames: Sequence[str], setup: Setup | None = None
    ) -> "Said":
        """Returns the statements in the values of ``--rotation`` and ``--length-unit``, each for all poses or as
        ``robot=`` and ``camera=``, and of ``--poses-are``."""
        own: dict[str, dict[str, str]] = {role: {} for role in ("", *SIDES)}
        for option, value in (*(("rotation", v) for v in rotation), *(("length_unit", v) for v in length_unit)):
            role, equals, name = value.partition("=") if "=" in value else ("", "", value)
            typed = f"--{option.replace('_', '-')} {value}"
            if equals and role not in SIDES:
                raise InputError("E-OPTION-VALUE", f"{typed}: robot= or camera= needed before the name")
            if option in own[role]:
                raise InputError("E-OPTION-REPEATED", f"{typed}: given twice; one for each of robot and camera")
            own[role][option] = name
        return cls(**own.pop(""), frames=tuple(frames), setup=setup, own=own)

    def of(self, role: Role) -> "Said":
        """Returns the statements that hold for poses of this role."""
        return replace(self, own={}, **self.own.get(role, {}))

    def options(self) -> list[str]:
        """Returns the names of the options that were given."""
        every = {"rotation": self.rotation, "length_unit": self.length_unit, "poses_are": self.frames}
        given = [name for name, value in every.items() if value or any(name in own for own in self.own.values())]
        return [f"--{name.replace('_', '-')}" for name in given]

    def __post_init__(self):
        for name in self.frames:
            if name not in EVERY_FRAME:
                raise InputError("E-OPTION-VALUE", f"--poses-are {name}: unknown; {', '.join(EVERY_FRAME)} needed")
        for unit in (self.length_unit, *(own.get("length_unit") for own in self.own.values())):
            if unit and unit not in LENGTHS:
                raise InputError("E-OPTION-VALUE", f"--length-unit {unit}: unknown; {', '.join(LENGTHS)} needed")
        if len({KnownName(name, "").role for name in self.frames}) < len(self.frames):
            raise InputError("E-OPTION-VALUE", f"--poses-are {', '.join(self.frames)}: one of each side at most")


def of_matrices(matrices: np.ndarray, places: Sequence[str], where: str) -> Poses:
    """Returns the poses of homogeneous matrices (m, 4, 4)."""
    require_finite(matrices, places, where)
    bad = np.flatnonzero(np.abs(matrices[:, 3:] - [0, 0, 0, 1]).max(axis=(1, 2)) > 0)
    if len(bad):
        i = bad[0]
        turned = " (the last column is: the matrix is transposed)" if not matrices[i, :3, 3].any() else ""
        row = " ".join(f"{v:g}" for v in matrices[i, 3])
        raise InputError("E-MATRIX-LAST-ROW", f"{where}: {places[i]}: last row {row}, 0 0 0 1 needed{turned}; mend it")
    return Poses(proper(matrices[:, :3, :3], places, where), matrices[:, :3, 3])


def require_each_once(names: Sequence[str], places: Sequence[str], where: str, kind: str = "") -> None:
    """Refuse a name that two poses have. ``kind`` says whether it names an image or a time stamp."""
    first: dict[str, str] = {}
    for name, place in zip(names, places, strict=True):
        if name in first:
            said = f"{first[name]} and {place} are both {kind}{name!r}"
            raise InputError("E-POSE-REPEATED", f"{where}: {said}; one needed")
        first[name] = place


_WORDS = {
    "base": "base|robot_?base|robotbase|world",
    "flange": "flange|gripper|hand|ee|eef|effector|end_?effector|endeffector|tool0?|tcp",
    "camera": "camera|cam|sensor|optical",
    "board": "board|target|marker|tag|object|pattern|checkerboard|chessboard|charuco|aruco",
}
"""Words that name each frame."""
_LEFT, _RIGHT = ("|".join(f"(?P<{side}_{frame}>{words})" for frame, words in _WORDS.items()) for side in "ab")
_FORMS = (
    (re.compile(rf"(?:{_LEFT})_from_(?:{_RIGHT})"), "ab", True),
    (re.compile(rf"(?:{_LEFT})2(?:{_RIGHT})"), "ba", True),
    (re.compile(rf"(?:{_LEFT})_(?:wrt|in)_(?:{_RIGHT})"), "ba", True),
    (re.compile(rf"(?:{_LEFT})_?t_?(?:{_RIGHT})"), "ab", False),
    (re.compile(rf"t_(?:{_LEFT})_(?:{_RIGHT})"), "ab", False),
)
"""Forms of names of transforms; which frame is the first of ``a_from_b``; whether no other reading is possible."""
_PART = re.compile(r"^(?:rot|trans|rotation|translation|rvecs?|tvecs?|[rth])_(?=[a-z_]+2)")
"""Prefix for rotation, translation or the whole matrix, before a name like OpenCV's gripper2base."""
_ENDING = r"(_?(pose|transform|matri(x|ce))s?)?"
ROLES_BY_NAME: dict[Role, re.Pattern] = {
    "robot": re.compile(r"(robot|arm|hand|gripper|flange|eef?|end_?effector|tcp)" + _ENDING),
    "camera": re.compile(r"(tracking|optical|camera|cam|board|target|marker|tag|object|pattern)" + _ENDING),
}
"""Names that tell whether poses are the robot's or the camera's, but not in which direction."""


def frames_of(key: object) -> KnownName | None:
    """Returns the transform that a name means; not stated where it names a side only; None where it means none."""
    name = re.sub(r"[\s.\-/]+", "_", str(key).strip()).lower()
    if name in EVERY_FRAME:
        return KnownName(name, f"by its name {key}")
    for form, order, only in _FORMS:
        if match := form.fullmatch(_PART.sub("", name, count=1)):
            sides = {part[0]: part[2:] for part, text in match.groupdict().items() if text is not None}
            frames = f"{sides[order[0]]}_from_{sides[order[1]]}"
            if frames in EVERY_FRAME:
                return KnownName(frames, f"by its name {key}", only)
    role = next((role for role, names in ROLES_BY_NAME.items() if names.fullmatch(name)), None)
    return KnownName(SIDES[role][0], BY_DEFAULT, False) if role else None


def inverse_name(key: str) -> str:
    """Returns a name with its two frames exchanged, such as ``t_cam2target``; empty for a name of another form."""
    parts = r"((?:rot|trans|rotation|translation|[rt]vecs?|[rthRTH])_)?(.+?)(_from_|_wrt_|_in_|2)(.+)"
    match = re.fullmatch(parts, key)
    return match.expand(r"\1\4\3\2") if match else ""


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
ROS = KnownName("m", "as in ROS", False)


def read_tree(value: Any, form: str, statements: Said, where: str) -> PoseContent | None:
    """Returns the poses in plain values; None where there are none."""
    content = None
    if isinstance(value, Mapping):
        content = _easy_handeye(value, statements, where) or _of_keys(value, form, where)
    elif isinstance(value, list) and value and isinstance(value[0], Mapping):
        content = _of_pairs(value, form, where)
    if content is None and (side := _side_of(value, where)) is not None:
        return PoseContent(form, (side,))
    if content is not None or not isinstance(value, Mapping):
        return content
    for key in HOLDERS:
        if (content := read_tree(value.get(key), form, statements, where)) is not None:
            others = tuple(str(unused_key) for unused_key in value if unused_key != key)
            return replace(content, passed_over=(*content.passed_over, *others))
    return None


def numbers(value: Any) -> np.ndarray | None:
    """Returns an array of numbers from lists, arrays or OpenCV's matrix; None for others, and for ragged lists."""
    if isinstance(value, Mapping):
        flat, rows, columns = numbers(value.get("data")), value.get("rows"), value.get("cols")
        if flat is None or not (isinstance(rows, int) and isinstance(columns, int)):
            return None
        return flat.reshape(rows, columns) if flat.size == rows * columns else None
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
        array = array.reshape(4, 4)  # by rows, or by columns as of Franka and OpenGL: the last row is 0 0 0 1
        array = array.T if not array[:3, 3].any() and array[3, :3].any() else array
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


def _side_of(value: Any, where: str, frames: KnownName | None = None) -> PoseSide | None:
    """Returns the matrices of a list, of a stack, or of a mapping by name; None for anything else."""
    names: tuple[str, ...] = ()
    if isinstance(value, Mapping) and _matrix(value) is not None:
        values, places = [value], ("the pose",)
    elif isinstance(value, Mapping):
        names = places = tuple(map(str, value))
        values = list(value.values())
        if any(_matrix(item) is None for item in values):
            return None
    elif isinstance(value, list | np.ndarray):
        array = numbers(value)
        values = [array] if array is not None and array.shape in ((4, 4), (16,)) else list(value)
        places = tuple(f"pose {i}" for i in range(1, len(values) + 1))
    else:
        return None
    found = [_matrix(item) for item in values]
    if not found or found[0] is None:
        return None
    bad = [place for place, each in zip(places, found, strict=True) if each is None]
    if bad:
        raise InputError("E-POSE-VALUE", f"{where}: {bad[0]}: not a 4×4 matrix like the one before; take it out")
    matrices, named = zip(*filter(None, found), strict=True)
    names = names or (named if all(named) else ())
    require_each_once(names, places[: len(names)], where)
    return PoseSide(of_matrices(np.array(matrices), places, where), places, "4×4 matrices", None, frames, names)


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
    frames = KnownName(SIDES["robot"][fixed], f"{by} of {of_setup}", False), KnownName("camera_from_board", by, False)
    sides = [_of_messages(entry, where, side) for entry, side in zip(lists, frames, strict=True)]
    return PoseContent("easy_handeye samples", _same_count(sides, where), setup)


def _of_messages(values: Any, where: str, frames: KnownName) -> PoseSide:
    """Returns the poses of a list of ROS's transforms, metres."""
    if not isinstance(values, list) or not values:
        raise InputError("E-POSES-NOT-FOUND", f"{where}: samples of easy_handeye without transforms; save them anew")
    places, rows = tuple(f"sample {i}" for i in range(1, len(values) + 1)), []
    for value, place in zip(values, places, strict=True):
        row = None
        with suppress(AttributeError):  # of what is no mapping
            parts = value.get("transform", value)
            at, turn = parts.get("translation"), parts.get("rotation")
            row = numbers([*(at.get(c, "") for c in "xyz"), *(turn.get(c, "") for c in "wxyz")])
        if row is None:
            said = "no translation x, y, z and rotation x, y, z, w; correct it"
            raise InputError("E-POSE-VALUE", f"{where}: {place}: {said}")
        rows.append(row)
    require_finite(np.array(rows), places, where)
    poses = Poses(of_quaternions(np.array(rows)[:, 3:], places, where), np.array(rows)[:, :3])
    return PoseSide(poses, places, "quaternions x, y, z, w by name", ROS, frames)


def _of_keys(value: Mapping, form: str, where: str) -> PoseContent | None:
    """Returns stacks of poses, each side under keys that name it."""
    parts: dict[str, dict[str, Any]] = {}
    named: dict[str, KnownName] = {}
    others, names = [], ()
    for key, item in value.items():
        if str(key).lower() in LISTED_NAMES and isinstance(item, list | np.ndarray):
            names = tuple(str(name) for name in item)
            continue
        frames, shaped = frames_of(key), isinstance(item, list | Mapping | np.ndarray)
        if frames is None or not shaped or (frames.by == BY_DEFAULT and _side_of(item, where) is None):
            others.append(str(key))
            continue
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


def _of_rotations(parts: dict[str, Any], where: str, frames: KnownName) -> PoseSide:
    """Returns the poses of matrices 3×3 and translations under two keys, as ``cv2.calibrateHandEye`` takes them."""
    arrays: dict[str, np.ndarray] = {}
    for key, item in parts.items():
        rows = [value if (of_pose := numbers(value)) is None else of_pose.ravel().tolist() for value in item]
        if (array := numbers(rows if isinstance(item, list) else item)) is None:
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
    poses = Poses(proper(turn.reshape(-1, 3, 3), places, where), at)
    return PoseSide(poses, places, "3×3 matrices", frames=frames)


def _of_pairs(value: Sequence[Mapping], form: str, where: str) -> PoseContent | None:
    """Returns the poses of a list whose entries hold the poses of both sides, or of one, under keys that name them."""
    stacks: dict[str, Any] = {}
    for key, entry in value[0].items():
        if frames_of(key) is None or _matrix(entry) is None:
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
