"""The content of a file of poses: which of its values are poses, of which side, and what the user states beside it; and
the pairs that both sides give."""

import re
from collections.abc import Mapping, Sequence
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
    ``own`` : whether it is a table of the package, whose columns state unit, rotation and direction; ``timed`` :
    whether ``names`` are times by the name of their column.
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
    ``prior``; ``pitch_mm`` of the board's file; ``left_out`` : (image or row, why); ``understood`` : lines on how files
    were read; ``setup`` : where the user or a file states it; ``timed`` : times of the pairs in the robot's stream,
    where its poses were taken by time; ``own`` : whether tables of the package were read, whose rows have equal names.
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
    own: bool = False

    @classmethod
    def of(
        cls, robot: PoseSide, camera: PoseSide, names: Sequence[str], where: str, lines: Sequence[str] = (), **more: Any
    ) -> "HandEyeInput":
        """Returns the rows of both sides, which belong together; ``lines`` : further ones on how they were read."""
        covariances = robot.covariance, camera.covariance
        pairs = HandEyePoses(robot.poses, camera.poses, *covariances, tuple(names), where, camera.common)
        understood, own = (
            (f"robot: {robot.understood}", f"camera: {camera.understood}", *lines),
            robot.own and camera.own,
        )
        return cls(where, pairs, understood=understood, own=own and not lines, **more)


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
    (re.compile(rf"(?:{_LEFT})_from_(?:{_RIGHT})"), "ab"),
    (re.compile(rf"(?:{_LEFT})(?:2|_wrt_|_in_)(?:{_RIGHT})"), "ba"),
)
"""Forms of names of transforms, and which frame is the first of ``a_from_b``."""
_PART = re.compile(r"^(?:rot|trans|rotation|translation|rvecs?|tvecs?|[rth])_(?=[a-z_]+2)")
"""Prefix for rotation, translation or the whole matrix, before a name like OpenCV's gripper2base."""
_ENDING = r"(_?(pose|transform|matri(x|ce)|sample)s?)*"
ROLES_BY_NAME: dict[Role, re.Pattern] = {
    "robot": re.compile(r"(robot|arm|hand|gripper|flange|eef?|end_?effector|tcp|hand_world)" + _ENDING),
    "camera": re.compile(
        r"(tracking|optical|camera|cam|board|target|marker|tag|object|pattern|camera_marker)" + _ENDING
    ),
}
"""Names that tell whether poses are the robot's or the camera's, but not in which direction."""


def frames_of(key: object) -> KnownName | None:
    """Returns the transform that a name means; not stated where it names a side only; None where it means none."""
    name = re.sub(r"[\s.\-/]+", "_", str(key).strip()).lower()
    if name in EVERY_FRAME:
        return KnownName(name, f"by its name {key}")
    for form, order in _FORMS:
        if match := form.fullmatch(_PART.sub("", name, count=1)):
            sides = {part[0]: part[2:] for part, text in match.groupdict().items() if text is not None}
            frames = f"{sides[order[0]]}_from_{sides[order[1]]}"
            if frames in EVERY_FRAME:
                return KnownName(frames, f"by its name {key}")
    role = next((role for role, names in ROLES_BY_NAME.items() if names.fullmatch(name)), None)
    return KnownName(SIDES[role][0], "by default", False) if role else None


def inverse_name(key: str) -> str:
    """Returns a name with its two frames exchanged, such as ``t_cam2target``; empty for a name of another form."""
    parts = r"((?:rot|trans|rotation|translation|[rt]vecs?|[rthRTH])_)?(.+?)(_from_|_wrt_|_in_|2)(.+)"
    match = re.fullmatch(parts, key)
    return match.expand(r"\1\4\3\2") if match else ""


NAME_KEYS = ("image", "image_name", "filename", "file", "name", "timestamp", "stamp", "time", "id", "index")
"""Keys, also in the plural, of what names each pose."""
HOLDERS = ("samples", "poses", "data", "transforms")
"""Keys that may hold the poses."""
SETUPS: dict[str, Setup] = {"eye_in_hand": "eye-in-hand", "eye_on_base": "eye-to-hand", "eye_to_hand": "eye-to-hand"}
"""Setups by easy_handeye's names of them."""


def read_tree(tree: Any, form: str, setup: Setup | None, where: str) -> PoseContent | None:
    """Returns the poses in plain values; None where there are none. ``setup`` : as the user states it."""
    if (content := _of_columns(*_columns(tree), form, setup, where)) is not None or not isinstance(tree, Mapping):
        return content
    own, parameters = None, tree.get("parameters")
    if isinstance(parameters, Mapping):  # of easy_handeye
        own = SETUPS.get(str(parameters.get("calibration_type", "")))
        if isinstance(in_hand := parameters.get("eye_on_hand"), bool):
            own = "eye-in-hand" if in_hand else "eye-to-hand"
    for key in HOLDERS:
        if (content := read_tree(tree.get(key), form, own or setup, where)) is not None:
            others = (str(other) for other in tree if other not in (key, "parameters"))
            return replace(content, setup=own, passed_over=(*content.passed_over, *others))
    return None


def _columns(tree: Any) -> tuple[dict[str, list], tuple[str, ...]]:
    """Returns values, one for each pose, by key, and the poses' names, if any: of a list of objects, of an object of
    lists, of poses by name, or of poses alone, whose key is empty."""
    if isinstance(tree, Mapping):
        lists = {str(k): list(v) for k, v in map(_listed, tree.items()) if isinstance(v, list | np.ndarray) and len(v)}
        poses = list(tree.values())
        if tree and not any(map(frames_of, tree)) and all(_row(pose) is not None for pose in poses):
            return {"": poses}, tuple(map(str, tree))
        columns = lists
    elif not isinstance(tree, list | np.ndarray) or not len(tree):
        return {}, ()
    elif _row(tree) is not None:
        return {"": [tree]}, ()
    elif isinstance(tree[0], Mapping) and _row(tree[0]) is None:
        records = [each if isinstance(each, Mapping) else {} for each in tree]
        columns = {str(key): [each.get(key) for each in records] for key in tree[0]}
    else:
        return {"": list(tree)}, ()
    naming = {key.lower(): key for key in map(str, columns)}
    for key in (naming[name] for one in NAME_KEYS for name in (one, f"{one}s") if name in naming):
        if all(isinstance(value, str | int | float) for value in columns[key]):
            return {other: columns[other] for other in columns if other != key}, tuple(map(str, columns[key]))
    return columns, ()


def _listed(item: tuple[Any, Any]) -> tuple[Any, Any]:
    """Returns a key with its values, which ROS 1 has one level deeper."""
    key, value = item
    return key, value.get("transforms", value) if isinstance(value, Mapping) else value


def _of_columns(
    columns: dict[str, list], names: tuple[str, ...], form: str, setup: Setup | None, where: str
) -> PoseContent | None:
    """Returns the sides that keys name, or the poses of the only key that has some."""
    parts: dict[str, dict[str, list]] = {}
    known: dict[str, KnownName | None] = {}
    for key, values in columns.items():
        frames = frames_of(key)
        if frames is not None and (frames.stated or _row(values[0]) is not None):
            parts.setdefault(frames.name, {})[key] = values
            known[frames.name] = frames
    if not parts:
        posed = {key: values for key, values in columns.items() if _row(values[0]) is not None}
        if len(posed) != 1:
            return None
        parts, known = {"": posed}, {"": None}
    keys = [key for item in parts.values() for key in item]
    roles = [frames.role for frames in known.values() if frames is not None]
    counts = {len(values) for item in parts.values() for values in item.values()}
    if len(set(roles)) < len(roles) or any(len(item) > 2 for item in parts.values()):
        said = f"{where}: {', '.join(keys)}: more than one set of the same poses; leave one of each"
        raise InputError("E-POSES-MIXED", said)
    if len(counts) > 1 or (names and len(names) not in counts):
        numbers = " and ".join(map(str, sorted({*counts, *([len(names)] if names else [])})))
        raise InputError("E-POSES-COUNT", f"{where}: {numbers} values of {', '.join(keys)}; one for each pose needed")
    places = tuple(f"pose {i}" for i in range(1, counts.pop() + 1))
    require_each_once(names, places[: len(names)], where)
    sides = tuple(_side(item, names or places, names, known[name], setup, where) for name, item in parts.items())
    if {"effector_wrt_world", "object_wrt_sensor"} == set(keys):
        form, sides = "MoveIt hand-eye samples", tuple(replace(side, unit=ROS) for side in sides)
    elif all(side.unit is ROS for side in sides):
        form = "easy_handeye samples"
    elif any("2" in key for key in keys):
        form = "OpenCV's hand-eye arrays"
    return PoseContent(form, sides, None, tuple(key for key in columns if key not in keys))


ROS = KnownName("m", "as in ROS", False)


def _side(
    parts: dict[str, list],
    places: tuple[str, ...],
    names: tuple[str, ...],
    frames: KnownName | None,
    setup: Setup | None,
    where: str,
) -> PoseSide:
    """Returns the poses under a key, or of matrices 3×3 and translations under two, as OpenCV takes them."""
    if len(parts) == 2:
        flat = {key: [numbers(value) for value in values] for key, values in parts.items()}
        sizes = {key: {0 if each is None else each.size for each in arrays} for key, arrays in flat.items()}
        of_turn, of_place = (next((k for k in flat if sizes[k] == {size}), "") for size in (9, 3))
        if not of_turn or not of_place:
            said = f"{where}: {', '.join(parts)}: a matrix 3×3 and a translation of 3 numbers for each pose needed"
            raise InputError("E-POSES-SHAPE", said)
        turn, at = (np.array([each.ravel() for each in flat[key] if each is not None]) for key in (of_turn, of_place))
        require_finite(at, places, where)
        poses = Poses(proper(turn.reshape(-1, 3, 3), places, where), at)
        return PoseSide(poses, places, "3×3 matrices", frames=frames, names=names)
    [(key, values)] = parts.items()
    rows = [_row(value) for value in values]
    sizes = [0 if row is None else row.size for row in rows]
    bad = next((i for i, size in enumerate(sizes) if size != sizes[0] or not size), None)
    if bad is not None:
        said = f"{where}: {' '.join(filter(None, (places[bad], key)))}: no 4×4 matrix, or one of another form than the "
        raise InputError("E-POSE-VALUE", f"{said}first; correct it, or take the pose out")
    array = np.array(rows)
    if array.ndim == 3:
        return PoseSide(of_matrices(array, places, where), places, "4×4 matrices", frames=frames, names=names)
    if frames is not None and not frames.stated:
        fixed = setup == "eye-to-hand"
        by = "as easy_handeye writes it" + f" of {'eye-to-hand' if fixed else 'eye-in-hand'}" * (frames.role == "robot")
        frames = KnownName(SIDES[frames.role][fixed and frames.role == "robot"], by, False)
    require_finite(array, places, where)
    poses = Poses(of_quaternions(array[:, 3:], places, where), array[:, :3])
    return PoseSide(poses, places, "quaternions x, y, z, w by name", ROS, frames, names)


def _row(value: Any) -> np.ndarray | None:
    """Returns a matrix (4, 4), or x, y, z, qw, qx, qy, qz (7,) of a transform of ROS; None for any other value."""
    if isinstance(value, Mapping) and "data" not in value:
        inner = value.get("transform", value)
        at, turn = (inner.get(name) if isinstance(inner, Mapping) else None for name in ("translation", "rotation"))
        if not isinstance(at, Mapping) or not isinstance(turn, Mapping):
            return None
        return numbers([*(at.get(c, "") for c in "xyz"), *(turn.get(c, "") for c in "wxyz")])
    array = numbers(value)
    if array is None or array.shape not in ((4, 4), (16,)):
        return None
    matrix = array.reshape(4, 4)
    # Sixteen numbers are by rows, or by columns as of Franka and OpenGL: the last row is 0 0 0 1.
    by_columns = array.ndim == 1 and not matrix[:3, 3].any() and matrix[3, :3].any()
    return matrix.T if by_columns else matrix


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
