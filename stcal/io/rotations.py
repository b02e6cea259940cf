"""Rotations as numbers and columns of tables: names, conventions, units, mistakes in the order of quaternions."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.errors import InputError
from stcal.geometry.rigid import UNIT_WITHIN, Poses
from stcal.io.table import ANGLES, Table, refuse, require_unit

ROTATION_VECTOR = "rotvec"
MOST_RADIANS = 4 * np.pi
"""Largest angle or length of a rotation vector of a pose, in radians; programs that count turns stay below two."""
QUATERNIONS = ("wxyz", "xyzw")
ALIASES: dict[str, tuple[str, str]] = {
    "kuka-abc": ("ZYX", "deg"),
    "fanuc-wpr": ("xyz", "deg"),
    "yaskawa": ("xyz", "deg"),
    "mitsubishi-abc": ("xyz", "deg"),
    "staubli": ("XYZ", "deg"),
    "kawasaki-oat": ("ZYZ", "deg"),
    "kinova": ("xyz", "deg"),
    "ur-rotvec": (ROTATION_VECTOR, "rad"),
    "rpy": ("xyz", ""),
    "abb-quaternion": ("wxyz", ""),
}
"""Conventions by name of the robot: form and unit of the angles, empty if it is open. The form is an order of axes as
in SciPy (lower case: fixed axes, upper case: rotated axes), a rotation vector or a quaternion."""
LIKELY = {
    "abc": "kuka-abc or mitsubishi-abc",
    "wpr": "fanuc-wpr",
    "oat": "kawasaki-oat",
    "theta_x, theta_y, theta_z": "kinova",
    "roll, pitch, yaw": "rpy",
    "rx, ry, rz": "ur-rotvec, yaskawa, staubli, xyz, XYZ or ZYX",
    "quaternions": "wxyz or xyzw",
}
"""Suggestions for ``--rotation`` by the names of the columns."""
MOST_RAD = 2 * np.pi * 1.01
"""Largest angle up to which numbers without a unit may be radians: a turn."""
_ORDER = re.compile(r"[xyz]{3}|[XYZ]{3}")


@dataclass(frozen=True, slots=True)
class Convention:
    """A convention for rotations: rotation vector, quaternion or order of axes; and the unit, empty if open."""

    order: str
    unit: str = ""

    @property
    def count(self) -> int:
        """The count of numbers that state a rotation."""
        return 4 if self.order in QUATERNIONS else 3

    def words(self) -> str:
        """Return the convention in words, for messages."""
        if self.order in QUATERNIONS:
            return f"quaternions {', '.join(self.order)}"
        if self.order == ROTATION_VECTOR:
            return "rotation vectors"
        about = "fixed axes" if self.order.islower() else "turned axes"
        return f"Euler angles {self.order} (about {about})"


def convention_of(name: str) -> Convention:
    """Return the convention of a name that the user gives, such as ``kuka-abc``, ``ZYX`` or ``rotvec-deg``."""
    if name in ALIASES:
        return Convention(*ALIASES[name])
    order, _, unit = name.partition("-")
    known = order in (ROTATION_VECTOR, *QUATERNIONS)
    euler = bool(_ORDER.fullmatch(order)) and order[0] != order[1] != order[2]
    if not (known or euler) or unit not in ("", *ANGLES) or (order in QUATERNIONS and unit):
        orders = "rotvec, an order of axes (xyz … about fixed axes, ZYX … about turned ones)"
        others = f"each also with -deg or -rad, wxyz, xyzw, {', '.join(ALIASES)}"
        raise InputError("E-OPTION-VALUE", f"--rotation {name}: unknown; {orders}, {others}")
    return Convention(order, unit)


def said_convention(rotation: str | None, what: str, where: str, count: int = 3) -> Convention:
    """Return the convention of the option ``--rotation``; ``what`` : names of the columns, or their description."""
    if rotation is None:
        likely = LIKELY["quaternions"] if count == len("wxyz") else LIKELY.get(what, "kuka-abc, ur-rotvec, xyz or ZYX")
        form = "quaternions" if count == len("wxyz") else "Euler angles in any order of axes or rotation vectors"
        raise InputError("E-ROTATION-AMBIGUOUS", f"{where}: {what} may be {form}; give --rotation, like {likely}")
    convention = convention_of(rotation)
    if convention.count != count:
        fault = f"{where}: {what} are {count} numbers, --rotation {rotation} is of {convention.count}"
        raise InputError("E-OPTION-CONTRADICTS", f"{fault}; correct the option")
    return convention


def rotations(
    values: np.ndarray, convention: Convention, places: tuple[str, ...], where: str, by_axis: bool = False
) -> tuple[np.ndarray, str]:
    """Return matrices (m, 3, 3) of Euler angles or rotation vectors (m, 3), and the convention used, in words;
    ``by_axis`` : True if the columns are named by the axes x, y, z and not in the order of the rotations."""
    if convention.order in QUATERNIONS:
        order = [0, 1, 2, 3] if convention.order == "wxyz" else [3, 0, 1, 2]
        return of_quaternions(values[:, order], places, where), convention.words()
    require_finite(values, places, where)
    unit, guessed, largest = convention.unit, False, float(np.abs(values).max(initial=0.0))
    if not unit:
        if largest <= MOST_RAD:
            either = f"{where}: angles up to {largest:.3g} may be radians or degrees"
            option = f"{convention.order}-rad or {convention.order}-deg, or name the columns _rad or _deg"
            raise InputError("E-ROTATION-AMBIGUOUS", f"{either}; give --rotation {option}")
        unit, guessed = "deg", True
    if unit == "rad" and largest > MOST_RADIANS:
        fault = f"{where}: angles up to {largest:.4g} rad, a turn is 6.28"
        remedy = f"if they are degrees, name the columns _deg, or give --rotation {convention.order}-deg"
        raise InputError("E-ANGLE-UNIT", f"{fault}; {remedy}")
    angles = values * ANGLES[unit]
    words = f"{convention.words()}, {'degrees' if unit == 'deg' else 'radians'}{' by their size' if guessed else ''}"
    if convention.order == ROTATION_VECTOR:
        return Rotation.from_rotvec(angles).as_matrix(), words
    if by_axis and len(set(convention.order)) == len("xyz"):
        angles = angles[:, ["xyz".index(axis) for axis in convention.order.lower()]]
        words += ", each about the axis of its name"
    return Rotation.from_euler(convention.order, angles).as_matrix(), words


def proper(rotation: np.ndarray, places: Sequence[str], where: str) -> np.ndarray:
    """Return matrices (m, 3, 3) projected onto rotations, since files state few digits."""
    require_finite(rotation, places, where)
    u, size, vt = np.linalg.svd(rotation)
    off = np.abs(size - 1).max(axis=1)
    with np.errstate(over="ignore", invalid="ignore"):  # matrices that are refused by their size
        determinant = np.linalg.det(rotation)

    def said(i: int) -> str:
        if off[i] <= UNIT_WITHIN:
            return "the 3×3 part is a reflection, determinant −1; a rotation, +1, needed: change the sign of one axis"
        stretched = f"its axes are stretched by {size[i].min():.4g} to {size[i].max():.4g}, 1 ± {UNIT_WITHIN:g} needed"
        return f"the 3×3 part is not a rotation: {stretched}; correct it, or write more digits"

    bad = (off > UNIT_WITHIN) | (determinant < 0)
    refuse(bad, "E-ROTATION-IMPROPER", lambda i: f"{where}: {places[i]}", said)
    return u @ vt


def of_quaternions(wxyz: np.ndarray, places: Sequence[str], where: str) -> np.ndarray:
    """Return the rotations (m, 3, 3) of quaternions (m, 4), w first."""
    require_finite(wxyz, places, where)
    require_unit(wxyz, lambda i: f"{where}: {places[i]}", "correct it")
    return Rotation.from_quat(wxyz, scalar_first=True).as_matrix()


def require_finite(values: np.ndarray, places: Sequence[str], where: str) -> None:
    """Refuse values (m, …) that are not finite; the message names the row."""
    finite, said = np.isfinite(values.reshape(len(values), -1)), "a value that is not finite, numbers needed"
    bad = np.any(~finite, axis=1)
    refuse(bad, "E-TABLE-NUMBER", lambda i: f"{where}: {places[i]}", lambda _: said, "; take it out")


EXPLAINS = 0.2  # a mistake explains a misfit if its correction reduces the misfit below this share


@dataclass(frozen=True, slots=True)
class Reading:
    """What columns that were read as w, x, y, z may truly hold, in words, with the remedy: w, x, y, z at the indices
    ``order`` among the components read, with the sign of the vector part inverted if ``conjugated``."""

    held: str
    remedy: str
    order: tuple[int, ...] = (0, 1, 2, 3)
    conjugated: bool = False

    def rotations(self, read: np.ndarray) -> np.ndarray:
        """Return the rotations (m, 3, 3) that this hypothesis makes of the rotations ``read`` (m, 3, 3)."""
        wxyz = Poses(read, np.zeros((len(read), 3))).quaternions()[:, self.order]
        corrected = Poses.from_quaternions(wxyz, np.zeros((len(read), 3))).rotation
        return np.swapaxes(corrected, 1, 2) if self.conjugated else corrected

    def poses(self, read: Poses) -> Poses:
        """Return the poses ``read`` with corrected rotations; translations are unchanged."""
        return Poses(self.rotations(read.rotation), read.translation)


LAST = Reading("x, y, z, w in the order of their columns", "give --quaternions xyzw", (3, 0, 1, 2))
_RENAME = "leave --quaternions xyzw out, or rename them"
FIRST = Reading("z, w, x, y in the columns qw, qx, qy, qz", _RENAME, (1, 2, 3, 0))
ORDERS = (LAST, FIRST)
_SIGN = "change the sign of qw"
INVERTED = Reading("conjugated (the first frame seen from the second)", _SIGN, conjugated=True)
_BOTH = (Reading(f"{one.held}, and conjugated", f"{one.remedy} and {_SIGN}", one.order, True) for one in ORDERS)
READINGS = (*ORDERS, INVERTED, *_BOTH)
TRIPLES = {
    ("rx", "ry", "rz"): {"rad": "ur-rotvec"},
    ("a", "b", "c"): {"deg": "kuka-abc"},
    ("w", "p", "r"): {"deg": "fanuc-wpr"},
    ("o", "a", "t"): {"deg": "kawasaki-oat"},
    ("theta_x", "theta_y", "theta_z"): {"deg": "kinova"},
    ("roll", "pitch", "yaw"): {"deg": "rpy", "rad": "rpy"},
    ("rpy_roll", "rpy_pitch", "rpy_yaw"): {"deg": "rpy", "rad": "rpy"},
    ("q1", "q2", "q3", "q4"): {},
}
"""Conventions of columns by names and unit; with another unit, or none, the convention is open."""
NAMED_BY_AXES = [names for names in TRIPLES if names[0] in ("rx", "theta_x", "roll", "rpy_roll")]
_EULER = re.compile(r"euler_([xyz]{3}|[XYZ]{3})_1_(deg|rad)")


@dataclass(frozen=True, slots=True, eq=False)
class Turned:
    """Rotations (m, 3, 3) of columns, and the convention in words; ``stated`` : without an option."""

    rotation: np.ndarray
    words: str
    columns: tuple[str, ...]
    stated: bool = True


def places_of(table: Table) -> tuple[str, ...]:
    """Return the place of each row, for messages."""
    return tuple(f"line {line}" for line in table.lines)


def find_column(table: Table, prefix: str, name: str) -> str | None:
    """Return the column of a name, also with capital letters; None if there is none."""
    wanted = f"{prefix}{name}"
    return wanted if wanted in table else next((c for c in table.columns if c.lower() == wanted.lower()), None)


def read_rotations(table: Table, prefix: str = "", rotation: str | None = None) -> Turned | None:
    """Return the rotations of columns with a prefix, None if none; ``rotation`` : the option for open angles."""
    places, where = places_of(table), table.where
    if f"{prefix}qw" in table or f"{prefix}qx" in table:
        table.has_rotation(prefix)
        columns = [prefix + name for name in table.quaternion_columns(prefix)]
        by_order = table.quaternions != "wxyz"
        words = "quaternions x, y, z, w by the order of their columns" if by_order else "quaternions by name"
        matrices = of_quaternions(np.column_stack([table.numbers(c) for c in columns]), places, where)
        return Turned(matrices, words, tuple(columns))
    stated = [(ROTATION_VECTOR, "rotvec_{}", "xyz", unit) for unit in ANGLES]
    stems = (column.removeprefix(prefix) for column in table.columns if column.startswith(prefix))
    stated += [(found[1], f"euler_{found[1]}_{{}}", "123", found[2]) for s in stems if (found := _EULER.fullmatch(s))]
    for order, name, axes, unit in stated:
        columns = [f"{prefix}{name.format(axis)}_{unit}" for axis in axes]
        if (values := _all(table, columns)) is not None:
            if rotation and said_convention(rotation, columns[0], where, 3).order != order:
                fault = f"{where}: the column {columns[0]} states another rotation than --rotation {rotation}"
                raise InputError("E-OPTION-CONTRADICTS", f"{fault}; rename the columns, or leave the option out")
            return Turned(*rotations(values, Convention(order, unit), places, where), tuple(columns))
    matrix = [f"{prefix}r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3)]
    if (values := _all(table, matrix)) is not None:
        return Turned(proper(values.reshape(-1, 3, 3), places, where), "3×3 matrices", tuple(matrix))
    return _by_convention(table, prefix, rotation)


def _all(table: Table, columns: list[str]) -> np.ndarray | None:
    """Return the values (m, k) of columns; None if all columns are missing, an error if only some are."""
    missing = [column for column in columns if column not in table]
    if len(missing) == len(columns):
        return None
    if missing:
        present = ", ".join(column for column in columns if column in table)
        without = f"{table.where}: {present} without {missing[0]}; all {len(columns)} needed"
        raise InputError("E-TABLE-COLUMN-MISSING", without)
    return np.column_stack([table.numbers(column) for column in columns])


def _by_convention(table: Table, prefix: str, rotation: str | None) -> Turned | None:
    for triple, stated in TRIPLES.items():
        for unit in (*ANGLES, "") if len(triple) == 3 else ("",):
            wanted = [f"{name}_{unit}" if unit else name for name in triple]
            names = tuple(column for name in wanted if (column := find_column(table, prefix, name)) is not None)
            if len(names) < len(wanted):
                continue
            what = "".join(triple) if len(triple[0]) == 1 else ", ".join(triple)
            by_names = rotation is None and unit in stated
            said = stated[unit] if by_names else rotation
            convention = said_convention(said, what, table.where, len(triple))
            says_unit = (rotation or "").endswith(tuple(f"-{name}" for name in ANGLES))  # a robot's name implies one
            if unit and says_unit and convention.unit not in ("", unit):
                both = f"{table.where}: {names[0]} and --rotation {rotation} are of two units; correct one"
                raise InputError("E-OPTION-CONTRADICTS", both)
            convention = Convention(convention.order, unit or convention.unit)
            values = np.column_stack([table.numbers(column) for column in names])
            turned, words = rotations(values, convention, places_of(table), table.where, triple in NAMED_BY_AXES)
            return Turned(turned, f"{', '.join(names)} as {words}", names, stated=False)
    return None


def fixed(value: float, digits: int) -> str:
    """Return a number with a fixed number of digits, and no minus before zero."""
    text = f"{value:.{digits}f}"
    return text.lstrip("-") if not text.strip("-0.") else text
