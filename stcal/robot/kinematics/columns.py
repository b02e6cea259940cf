"""Columns of robots' tables: orientations in any convention, and which columns a command passes over."""

import re
from collections.abc import Iterable

from stcal.errors import InputError
from stcal.geometry.rigid import Poses
from stcal.io.poses.columns import read_rotations
from stcal.io.table import ANGLES, COMMON, COVARIANCE, LENGTHS, POSE, Table

_UNITS = "|".join((*ANGLES, *LENGTHS))
_KNOWN = re.compile(
    rf"q\d+_({_UNITS})|([xyz]|distance)_({'|'.join(LENGTHS)})|{'|'.join((*POSE[3:], *COVARIANCE))}|{COMMON.pattern}|"
    "target|status|from_row|pose|image|name|scene|set|line|station|faces|circles|rms_px|chi2_per_dof|error_mm|"
    "error_deg|(commanded|nominal)_.*"
)
"""What the commands of robots and ``stcal-sfm measure`` write: not every command reads it, and all know it."""


def oriented(table: Table, rotation: str | None = None) -> tuple[Poses | None, tuple[str, ...], tuple[str, ...]]:
    """m poses where there are orientations beside the positions; the columns of these; and what is to be said of them.

    ``rotation`` : the convention, as of ``--rotation``, of angles whose columns do not say it.

    Raises
    ------
    InputError
        Some columns of a rotation only, none that is one, or a convention that must be said, or is and need not be.
    """
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
    """A note with the columns that neither belong to a table of robots nor were ``read`` beyond these; none if all."""
    passed = [name for name in table.columns if name not in {*read} and not _KNOWN.fullmatch(name)]
    return (f"column{'s' * (len(passed) > 1)} not read: {', '.join(passed)}",) if passed else ()
