"""Columns of robot tables: orientations in any convention, and the columns that a command does not read."""

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
"""Columns that the robot commands and ``stcal-sfm measure`` write. Not every command reads them; none reports them."""


def oriented(table: Table, rotation: str | None = None) -> tuple[Poses | None, tuple[str, ...], tuple[str, ...]]:
    """Returns m poses (None without orientations), the columns of their angles, and a note that names the convention.

    ``rotation`` : convention of angles whose column names do not state it, as for ``--rotation``.

    Raises
    ------
    InputError
        The columns of a rotation are incomplete, ``rotation`` is given without such columns, or the convention is
        missing or given although the columns state it.
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
    """Returns one note that lists the columns neither known nor in ``read``; no note if there are none."""
    ignored = [name for name in table.columns if name not in {*read} and not _KNOWN.fullmatch(name)]
    return (f"column{'s' * (len(ignored) > 1)} not read: {', '.join(ignored)}",) if ignored else ()
