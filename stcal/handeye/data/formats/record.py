"""What a file of poses holds, as it stands there; and what the user says where the file cannot."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from stcal.errors import InputError
from stcal.geometry.arrays import frozen
from stcal.io.poses.rotations import proper, require_finite
from stcal.io.table import LENGTHS

Role = Literal["robot", "camera"]
ROLES: tuple[Role, ...] = get_args(Role)
FRAMES: dict[Role, tuple[str, str]] = {
    "robot": ("base_from_flange", "flange_from_base"),
    "camera": ("camera_from_board", "board_from_camera"),
}
"""What is wanted of each side, and its inverse."""
EVERY_FRAME = tuple(name for names in FRAMES.values() for name in names)
MATRICES = "4×4 matrices"


@dataclass(frozen=True, slots=True)
class Frames:
    """``name`` : one of :data:`FRAMES`; ``by`` : how it is known, in words; ``stated`` : by the file itself, so that an
    option cannot say otherwise."""

    name: str
    by: str
    stated: bool = True

    @property
    def role(self) -> Role:
        return "robot" if self.name in FRAMES["robot"] else "camera"


@dataclass(frozen=True, slots=True)
class Unit:
    """Of lengths: ``name`` as in :data:`stcal.io.table.LENGTHS`; ``by``, ``stated`` as of :class:`Frames`."""

    name: str
    by: str
    stated: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Side:
    """Poses of the robot or of the camera.

    Parameters
    ----------
    rotation, translation : (m, 3, 3), (m, 3) arrays
        Of each; lengths in ``unit``.
    places : tuple of str
        Where each stands in its file: ``line 7``.
    turned : str
        How rotations are written, in words.
    unit, frames
        None where the file does not say.
    names : tuple of str
        Image or timestamp of each, where there are such.
    trajectory : bool
        Whether poses are those of what moves, in a world, as in files of trajectories.
    scaled : bool
        Whether the lengths have no unit at all, like those of a model of COLMAP.
    covariance : (m, 6, 6) array, optional
        mm and rad, of what ``frames`` says.
    """

    rotation: np.ndarray
    translation: np.ndarray
    places: tuple[str, ...]
    turned: str
    unit: Unit | None = None
    frames: Frames | None = None
    names: tuple[str, ...] = ()
    trajectory: bool = False
    scaled: bool = False
    covariance: np.ndarray | None = None

    def __post_init__(self):
        m = len(self.places)
        object.__setattr__(self, "rotation", frozen(self.rotation, (m, 3, 3), "rotations"))
        object.__setattr__(self, "translation", frozen(self.translation, (m, 3), "translations"))

    def __len__(self) -> int:
        return len(self.places)


@dataclass(frozen=True, slots=True)
class Content:
    """``form`` : of the file, in words; ``sides`` : one that is not told apart, or one of each role; ``setup`` : where
    the file says so; ``passed_over`` : what else stands in it."""

    form: str
    sides: tuple[Side, ...]
    setup: str | None = None
    passed_over: tuple[str, ...] = ()

    def of(self, role: Role) -> Side | None:
        """The side that is said to be of this role."""
        return next((each for each in self.sides if each.frames is not None and each.frames.role == role), None)

    @property
    def both(self) -> bool:
        """Whether these are pose pairs."""
        return len(self.sides) == len(ROLES)


@dataclass(frozen=True, slots=True)
class Said:
    """What the user says of files that do not say it themselves.

    ``rotation`` : a name of :data:`stcal.io.poses.rotations.ALIASES` or an order of axes; ``length_unit`` : one of
    :data:`stcal.io.table.LENGTHS`; ``frames`` : names of :data:`EVERY_FRAME`, at most one of each role; ``setup`` ;
    ``own`` : rotation and unit of one role's poses, where they differ.
    """

    rotation: str | None = None
    length_unit: str | None = None
    frames: tuple[str, ...] = ()
    setup: str | None = None
    own: tuple[tuple[Role, str, str], ...] = ()

    @classmethod
    def of_options(
        cls, rotation: Sequence[str], length_unit: Sequence[str], frames: Sequence[str], setup: str | None = None
    ) -> "Said":
        """Of the values of ``--rotation``, ``--length-unit``, each for all poses or as ``robot=`` and ``camera=``, and
        ``--poses-are``.

        Raises
        ------
        InputError
            A name that is none, or two of the same.
        """
        whole: dict[str, str] = {}
        own: list[tuple[Role, str, str]] = []
        for option, values in (("rotation", rotation), ("length_unit", length_unit)):
            for value in values:
                role, equals, name = value.partition("=")
                given = [each for each in own if each[:2] == (role, option)] if equals else option in whole
                if given:
                    raise InputError(
                        "E-OPTION-REPEATED",
                        f"--{option.replace('_', '-')} {value}: given twice; one for each of robot and camera",
                    )
                if not equals:
                    whole[option] = role
                elif role in ROLES:
                    own.append(("robot" if role == "robot" else "camera", option, name))
                else:
                    raise InputError(
                        "E-OPTION-VALUE",
                        f"--{option.replace('_', '-')} {value}: robot= or camera= needed before the name",
                    )
        return cls(whole.get("rotation"), whole.get("length_unit"), tuple(frames), setup, tuple(own))

    def of(self, role: Role) -> "Said":
        """What holds for poses of this role."""
        own = {name: value for each, name, value in self.own if each == role}
        return Said(
            own.get("rotation", self.rotation), own.get("length_unit", self.length_unit), self.frames, self.setup
        )

    def options(self) -> list[str]:
        """Names of those given."""
        every = {"--rotation": self.rotation, "--length-unit": self.length_unit, "--poses-are": self.frames}
        own = {f"--{name.replace('_', '-')}" for _, name, _ in self.own}
        return [name for name, value in every.items() if value or name in own]

    def __post_init__(self):
        unknown = [name for name in self.frames if name not in EVERY_FRAME]
        if unknown:
            raise InputError("E-OPTION-VALUE", f"--poses-are {unknown[0]}: unknown; {', '.join(EVERY_FRAME)} needed")
        units = [value for value in (self.length_unit, *(v for _, n, v in self.own if n == "length_unit")) if value]
        wrong = [value for value in units if value not in LENGTHS]
        if wrong:
            raise InputError("E-OPTION-VALUE", f"--length-unit {wrong[0]}: unknown; {', '.join(LENGTHS)} needed")
        roles = [Frames(name, "").role for name in self.frames]
        if len(set(roles)) < len(roles):
            raise InputError(
                "E-OPTION-VALUE", f"--poses-are {', '.join(self.frames)}: one of each of robot and camera at most"
            )

    def frames_of(self, role: Role) -> str | None:
        """What poses of this role are said to be."""
        return next((name for name in self.frames if name in FRAMES[role]), None)


def of_matrices(matrices: np.ndarray, places: Sequence[str], where: str) -> tuple[np.ndarray, np.ndarray]:
    """Rotations and translations of homogeneous matrices (m, 4, 4).

    Raises
    ------
    InputError
        A last row that is not 0 0 0 1, or no rotation.
    """
    require_finite(matrices, places, where)
    bad = np.flatnonzero(np.abs(matrices[:, 3] - [0, 0, 0, 1]).max(axis=1) > 0)
    if len(bad):
        i = bad[0]
        turned = " (the last column is: the matrix is transposed)" if not matrices[i, :3, 3].any() else ""
        row = " ".join(f"{v:g}" for v in matrices[i, 3])
        raise InputError(
            "E-MATRIX-LAST-ROW", f"{where}: {places[i]}: last row {row}, 0 0 0 1 needed{turned}; correct it"
        )
    return proper(matrices[:, :3, :3], places, where), matrices[:, :3, 3]


def require_each_once(names: Sequence[str], places: Sequence[str], where: str, kind: str = "") -> None:
    """Refuse a name, of an image or a time stamp as ``kind`` says, that has two poses."""
    first: dict[str, str] = {}
    for name, place in zip(names, places, strict=True):
        if name in first:
            raise InputError(
                "E-POSE-REPEATED", f"{where}: {first[name]} and {place}: both are of {kind}{name!r}; one row needed"
            )
        first[name] = place
