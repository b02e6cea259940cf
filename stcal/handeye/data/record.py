"""The content of a file of poses, and what the user states where the file does not."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from stcal.errors import InputError
from stcal.geometry.arrays import freeze
from stcal.handeye.data.pose_pairs import Setup
from stcal.io.rotations import proper, require_finite
from stcal.io.table import LENGTHS

Role = Literal["robot", "camera"]
ROLES: tuple[Role, ...] = get_args(Role)
FRAMES: dict[Role, tuple[str, str]] = {
    "robot": ("base_from_flange", "flange_from_base"),
    "camera": ("camera_from_board", "board_from_camera"),
}
"""The transform that is needed for each side, and its inverse."""
EVERY_FRAME = tuple(name for names in FRAMES.values() for name in names)


@dataclass(frozen=True, slots=True)
class Known:
    """``name`` of a transform, of :data:`EVERY_FRAME`, or of a unit, of :data:`stcal.io.table.LENGTHS`; ``by`` : how it
    is known, in words; ``stated`` : whether the file itself states it, so that an option cannot contradict it."""

    name: str
    by: str
    stated: bool = True

    @property
    def role(self) -> Role:
        """The side that has this transform."""
        return "robot" if self.name in FRAMES["robot"] else "camera"


@dataclass(frozen=True, slots=True, eq=False)
class PoseSide:
    """Poses of the robot or of the camera.

    ``rotation``, ``translation`` : (m, 3, 3), (m, 3), lengths in ``unit``; ``places`` : place of each pose in its file,
    like ``line 7``; ``turned`` : how rotations are written, in words; ``unit``, ``frames`` : None where the file does
    not say; ``names`` : image or timestamp of each pose, if any; ``trajectory`` : whether poses are those of a moving
    body in a world; ``covariance`` : (m, 6, 6) of the transforms of ``frames``, mm and rad; ``common`` : (m, 6, k)
    errors that these have in common, contained in their covariances.
    """

    rotation: np.ndarray
    translation: np.ndarray
    places: tuple[str, ...]
    turned: str
    unit: Known | None = None
    frames: Known | None = None
    names: tuple[str, ...] = ()
    trajectory: bool = False
    covariance: np.ndarray | None = None
    common: np.ndarray | None = None

    def __post_init__(self):
        m = len(self.places)
        freeze(self, "rotation", (m, 3, 3), "rotations")
        freeze(self, "translation", (m, 3), "translations")

    def __len__(self) -> int:
        return len(self.places)


@dataclass(frozen=True, slots=True)
class PoseContent:
    """PoseContent of a file of poses. ``form`` : format of the file, in words; ``sides`` : one side whose role is not
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
    ``own`` : rotation and unit of one role's poses, where they differ.
    """

    rotation: str | None = None
    length_unit: str | None = None
    frames: tuple[str, ...] = ()
    setup: Setup | None = None
    own: tuple[tuple[Role, str, str], ...] = ()

    @classmethod
    def of_options(
        cls, rotation: Sequence[str], length_unit: Sequence[str], frames: Sequence[str], setup: Setup | None = None
    ) -> "Said":
        """Returns the statements in the values of ``--rotation`` and ``--length-unit``, each for all poses or as
        ``robot=`` and ``camera=``, and of ``--poses-are``."""
        values: dict[tuple[str, str], str] = {}
        for option, value in (*(("rotation", v) for v in rotation), *(("length_unit", v) for v in length_unit)):
            role, equals, name = value.partition("=")
            typed = f"--{option.replace('_', '-')} {value}"
            if equals and role not in ROLES:
                raise InputError("E-OPTION-VALUE", f"{typed}: robot= or camera= needed before the name")
            place, name = (role, option) if equals else ("", option), name if equals else role
            if place in values:
                raise InputError("E-OPTION-REPEATED", f"{typed}: given twice; one for each of robot and camera")
            values[place] = name
        own: tuple[tuple[Role, str, str], ...] = tuple(
            (role, option, name) for role in ROLES for (of, option), name in values.items() if of == role
        )
        return cls(values.get(("", "rotation")), values.get(("", "length_unit")), tuple(frames), setup, own)

    def of(self, role: Role) -> "Said":
        """Returns the statements that hold for poses of this role."""
        return replace(self, own=(), **{name: value for entry_role, name, value in self.own if entry_role == role})

    def options(self) -> list[str]:
        """Returns the names of the options that were given."""
        every = {"--rotation": self.rotation, "--length-unit": self.length_unit, "--poses-are": self.frames}
        of_one_role = {f"--{name.replace('_', '-')}" for _, name, _ in self.own}
        return [name for name, value in every.items() if value or name in of_one_role]

    def __post_init__(self):
        for name in self.frames:
            if name not in EVERY_FRAME:
                raise InputError("E-OPTION-VALUE", f"--poses-are {name}: unknown; {', '.join(EVERY_FRAME)} needed")
        for unit in (self.length_unit, *(value for _, name, value in self.own if name == "length_unit")):
            if unit and unit not in LENGTHS:
                raise InputError("E-OPTION-VALUE", f"--length-unit {unit}: unknown; {', '.join(LENGTHS)} needed")
        if len({Known(name, "").role for name in self.frames}) < len(self.frames):
            raise InputError("E-OPTION-VALUE", f"--poses-are {', '.join(self.frames)}: one of each side at most")

    def frames_of(self, role: Role) -> str | None:
        """Returns the transform that poses of this role are stated to be; None where it is not stated."""
        return next((name for name in self.frames if name in FRAMES[role]), None)


def of_matrices(matrices: np.ndarray, places: Sequence[str], where: str) -> tuple[np.ndarray, np.ndarray]:
    """Returns the rotations and translations of homogeneous matrices (m, 4, 4)."""
    require_finite(matrices, places, where)
    bad = np.flatnonzero(np.abs(matrices[:, 3:] - [0, 0, 0, 1]).max(axis=(1, 2)) > 0)
    if len(bad):
        i = bad[0]
        turned = " (the last column is: the matrix is transposed)" if not matrices[i, :3, 3].any() else ""
        row = " ".join(f"{v:g}" for v in matrices[i, 3])
        raise InputError("E-MATRIX-LAST-ROW", f"{where}: {places[i]}: last row {row}, 0 0 0 1 needed{turned}; mend it")
    return proper(matrices[:, :3, :3], places, where), matrices[:, :3, 3]


def require_each_once(names: Sequence[str], places: Sequence[str], where: str, kind: str = "") -> None:
    """Refuse a name that two poses have. ``kind`` says whether it names an image or a time stamp."""
    first: dict[str, str] = {}
    for name, place in zip(names, places, strict=True):
        if name in first:
            raise InputError(
                "E-POSE-REPEATED", f"{where}: {first[name]} and {place} are both {kind}{name!r}; one needed"
            )
        first[name] = place


_WORDS = {
    "base": "base|robot_?base|robotbase|world",
    "flange": "flange|gripper|hand|ee|eef|effector|end_?effector|endeffector|tool0?|tcp",
    "camera": "camera|cam|sensor|optical",
    "board": "board|target|marker|tag|object|pattern|checkerboard|chessboard|charuco|aruco",
}
"""Words that name each frame."""
_ANY = "|".join(f"(?P<{{0}}_{frame}>{words})" for frame, words in _WORDS.items())
_LEFT, _RIGHT = _ANY.replace("{0}", "a"), _ANY.replace("{0}", "b")
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
ROLES_BY_NAME: dict[Role, re.Pattern] = {
    "robot": re.compile(r"(robot|arm|hand|gripper|flange|eef?|end_?effector|tcp)(_?(pose|transform|matri(x|ce))s?)?"),
    "camera": re.compile(
        r"(tracking|optical|camera|cam|board|target|marker|tag|object|pattern)(_?(pose|transform|matri(x|ce))s?)?"
    ),
}
"""Names that tell whether poses are the robot's or the camera's, but not in which direction."""


def frames_of(key: str) -> Known | None:
    """Returns the transform that a name means; None where it means none."""
    name = _plain(key)
    if name in EVERY_FRAME:
        return Known(name, f"by its name {key}")
    for form, order, only in _FORMS:
        if match := form.fullmatch(_PART.sub("", name, count=1)):
            sides = {part[0]: part[2:] for part, text in match.groupdict().items() if text is not None}
            frames = f"{sides[order[0]]}_from_{sides[order[1]]}"
            if frames in EVERY_FRAME:
                return Known(frames, f"by its name {key}", only)
    return None


def _plain(key: object) -> str:
    return re.sub(r"[\s.\-/]+", "_", str(key).strip()).lower()


def inverse_name(key: str) -> str:
    """Returns a name with its two frames exchanged, such as ``t_cam2target``; empty for a name of another form."""
    for between in ("_from_", "_wrt_", "_in_", "2"):
        head, separator, tail = key.partition(between)
        if separator:
            prefix = next(iter(re.findall(r"^(?:rot|trans|rotation|translation|rvecs?|tvecs?|[rthRTH])_", head)), "")
            return f"{prefix}{tail}{separator}{head.removeprefix(prefix)}"
    return ""


def role_of(key: str) -> Role | None:
    """Returns the side whose poses a name means, where the name has no direction."""
    return next((role for role, form in ROLES_BY_NAME.items() if form.fullmatch(_plain(key))), None)
