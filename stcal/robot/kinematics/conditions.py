"""Conditions of joint vectors (load, direction of approach), and the columns that state them."""

import re
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from stcal.errors import InputError
from stcal.geometry.arrays import freeze
from stcal.geometry.rigid import Poses
from stcal.io.table import ANGLES, COMMON, COVARIANCE, LENGTHS, POSE, Table

PAYLOAD = "payload_kg"
APPROACH = "approach"
DIRECTIONS = (-1.0, 0.0, 1.0)
MOST_KG = 1e4
"""Largest mass at a flange. Arms carry up to 2.3 t."""


@dataclass(frozen=True, slots=True, eq=False)
class Conditions:
    """Payload and approach directions of m joint vectors. ``payload_kg`` : (m,) mass at the flange; ``approach`` : (m,
    n) direction in which each joint moved last: 1 upwards, −1 downwards, 0 unknown."""

    payload_kg: np.ndarray | None = None
    approach: np.ndarray | None = None

    def __post_init__(self):
        if self.approach is not None:
            freeze(self, "approach", (None, None), "approach")
            for value in self.approach[~np.isin(self.approach, DIRECTIONS)]:
                raise InputError("E-APPROACH-VALUE", f"approach is {value:g}; 1, -1 or 0 needed")
        if self.payload_kg is not None:
            freeze(self, "payload_kg", (None,), "payload")
            for value in self.payload_kg[(self.payload_kg < 0) | (self.payload_kg > MOST_KG)]:
                raise InputError("E-PAYLOAD-VALUE", f"payload is {value:g} kg; 0 … {MOST_KG:g} needed")

    def __getitem__(self, index) -> "Conditions":
        """Returns the conditions of the joint vectors selected by a mask, slice or list."""
        if self.payload_kg is None and self.approach is None:
            return self
        return Conditions(*(None if each is None else each[index] for each in (self.payload_kg, self.approach)))

    @property
    def approached(self) -> bool:
        """True if the approach direction of any joint is known."""
        return self.approach is not None and bool(self.approach.any())

    @property
    def loaded(self) -> bool:
        """True if a payload above 0 is known for any joint vector."""
        return self.payload_kg is not None and bool(self.payload_kg.any())

    def ignored(self, who: str) -> tuple[str, ...]:
        """Returns a note that the rigid arm ``who`` does not deflect under its payload; no note without payload."""
        if not self.loaded:
            return ()
        return (f"{who} is rigid, {PAYLOAD} moves nothing (`identify --model elastic` tells what links give way by)",)


USUAL = Conditions()
"""Default conditions: payload of the robot file, approach directions unknown."""


def loaded(payload_kg: ArrayLike | None, count: int) -> Conditions:
    """Returns conditions with one mass for all ``count`` joint vectors, or one for each; raises InputError."""
    if payload_kg is None:
        return USUAL
    values = np.asarray(payload_kg, float)
    if values.shape not in ((), (count,)):
        raise InputError("E-ARRAY-SHAPE", f"payload: shape {values.shape}, one number or ({count},) needed")
    return Conditions(np.broadcast_to(values, (count,)))


def read_conditions(table: Table, payload_kg: float | None = None, joints: int = 0) -> Conditions:
    """Reads payload and columns ``approach1`` … of a table; the payload is column ``payload_kg``, or the argument.
    Raises InputError naming the line."""

    def require(good: np.ndarray, code: str, name: str, values: np.ndarray, needed: str) -> None:
        for row in np.flatnonzero(~good).tolist():
            raise InputError(
                code, f"{table.where}: line {table.lines[row]}: {name} is {values[row]:g}; {needed} needed"
            )

    mass = None if payload_kg is None else loaded(payload_kg, len(table)).payload_kg
    if PAYLOAD in table:
        if payload_kg is not None:
            raise InputError(
                "E-OPTION-CONFLICT",
                f"{table.where}: a column {PAYLOAD}, and --payload-kg {payload_kg:g}; leave one of them out",
            )
        mass = table.numbers(PAYLOAD)
        require((mass >= 0) & (mass <= MOST_KG), "E-PAYLOAD-VALUE", PAYLOAD, mass, f"0 … {MOST_KG:g}")
    columns, approach = approach_columns(joints), None
    if any(name in table for name in columns):
        approach = np.zeros((len(table), joints))
        for i, name in enumerate(columns):
            if name in table:
                approach[:, i] = values = table.numbers(name)
                came = f"1 (joint {i + 1} came from below), -1 (from above) or 0 (not known)"
                require(np.isin(values, DIRECTIONS), "E-APPROACH-VALUE", name, values, came)
    return Conditions(mass, approach)


def approach_columns(joints: int) -> tuple[str, ...]:
    """Returns the column names ``approach1`` … of ``joints`` joints."""
    return tuple(f"{APPROACH}{i + 1}" for i in range(joints))


_UNITS = "|".join((*ANGLES, *LENGTHS))
_KNOWN = re.compile(
    rf"q\d+_({_UNITS})|([xyz]|distance)_({'|'.join(LENGTHS)})|{'|'.join((*POSE[3:], *COVARIANCE))}|{COMMON.pattern}|"
    "target|status|from_row|pose|image|name|scene|set|line|station|faces|circles|rms_px|chi2_per_dof|error_mm|"
    "error_deg|(commanded|nominal)_.*"
)
"""Columns that robot commands and ``stcal-sfm measure`` write. No command reports them as unread."""


def oriented(table: Table, rotation: str | None = None) -> tuple[Poses | None, tuple[str, ...], tuple[str, ...]]:
    """Returns m poses (None without orientations), the columns of their angles, and a note that names the convention.

    ``rotation`` : convention of angles whose column names do not state it, as for ``--rotation``.

    Raises InputError: the columns of a rotation are incomplete, ``rotation`` is given without such columns, or the
    convention is missing or given although the columns state it.
    """
    from stcal.io.rotations import read_rotations

    turned = None if table.has_rotation() else read_rotations(table, rotation=rotation)
    if rotation is not None and (turned is None or turned.stated):
        raise InputError(
            "E-OPTION-NEEDS", f"{table.where}: no columns of angles that --rotation {rotation} is of; leave it out"
        )
    if turned is None:
        return table.poses() if table.has_rotation() else None, (), ()
    columns = ", ".join(turned.columns)
    words = turned.words if turned.words.startswith(columns) else f"{columns} as {turned.words}"
    return Poses(turned.rotation, table.points()), turned.columns, (f"orientation: {words}",)


def unread(table: Table, read: Iterable[str] = ()) -> tuple[str, ...]:
    """Returns one note that lists the columns that are neither known nor in ``read``; no note if there are none."""
    ignored = [name for name in table.columns if name not in {*read} and not _KNOWN.fullmatch(name)]
    return (f"column{'s' * (len(ignored) > 1)} not read: {', '.join(ignored)}",) if ignored else ()
