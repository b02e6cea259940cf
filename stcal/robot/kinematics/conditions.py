"""Under which conditions joint vectors were reached: what the flange carried."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from stcal.errors import InputError
from stcal.geometry.arrays import freeze
from stcal.io.table import Table

PAYLOAD = "payload_kg"
MOST_KG = 1e4
"""Arms carry up to 2.3 t."""


@dataclass(frozen=True, slots=True, eq=False)
class Conditions:
    """Of m joint vectors.

    Parameters
    ----------
    payload_kg : (m,) array, optional
        Mass at the flange; that of the robot file where not given.

    Raises
    ------
    InputError
        A mass that is not finite, below 0, or beyond all that arms carry.
    """

    payload_kg: np.ndarray | None = None

    def __post_init__(self):
        if self.payload_kg is not None:
            freeze(self, "payload_kg", (None,), "payload")
            for value in self.payload_kg[(self.payload_kg < 0) | (self.payload_kg > MOST_KG)]:
                raise InputError(f"payload is {value:g} kg; 0 … {MOST_KG:g} needed")

    def __getitem__(self, index) -> "Conditions":
        """Of the joint vectors at a mask, slice or list."""
        return self if self.payload_kg is None else Conditions(self.payload_kg[index])

    @property
    def loaded(self) -> bool:
        """Whether anything is known to have been carried."""
        return self.payload_kg is not None and bool(self.payload_kg.any())

    def ignored(self, who: str) -> tuple[str, ...]:
        """A note that a rigid arm gives way to no load, where there is one."""
        if not self.loaded:
            return ()
        return (f"{who} is rigid, {PAYLOAD} moves nothing (`identify --model elastic` tells what links give way by)",)


USUAL = Conditions()
"""What the robot file says."""


def loaded(payload_kg: ArrayLike | None, count: int) -> Conditions:
    """With a mass for all ``count`` joint vectors, or one for each.

    Raises
    ------
    InputError
        As :class:`Conditions`, and masses of another number.
    """
    if payload_kg is None:
        return USUAL
    values = np.asarray(payload_kg, float)
    if values.shape not in ((), (count,)):
        raise InputError(f"payload: shape {values.shape}, one number or ({count},) needed")
    return Conditions(np.broadcast_to(values, (count,)))


def read_conditions(table: Table, payload_kg: float | None = None) -> Conditions:
    """Of a table's rows: column ``payload_kg``, or one mass for all.

    Raises
    ------
    InputError
        Both, or a mass that cannot be; the message names the line.
    """
    if PAYLOAD not in table:
        return loaded(payload_kg, len(table))
    if payload_kg is not None:
        raise InputError(f"{table.where}: a column {PAYLOAD}, and --payload-kg {payload_kg:g}; leave one of them out")
    values = table.numbers(PAYLOAD)
    for line, value in zip(table.lines, values.tolist(), strict=True):
        if not 0 <= value <= MOST_KG:
            raise InputError(f"{table.where}: line {line}: {PAYLOAD} is {value:g}; 0 … {MOST_KG:g} needed")
    return Conditions(values)
