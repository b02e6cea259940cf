"""Board and tags in the photographs of a target's calibration."""

from dataclasses import dataclass

from stcal.boards.design import BoardView
from stcal.boards.tags import Tags
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationImages:
    """Images of a target's calibration.

    ``names`` : names of m readable images of one size; ``views`` : views of the board in them, None if it is not seen;
    ``symmetries`` : rotations that map the board onto itself; ``left_out`` : files that are not used, and why.
    """

    names: tuple[str, ...]
    views: tuple[BoardView | None, ...]
    tags: tuple[Tags, ...]
    camera: Camera
    symmetries: tuple[Rigid, ...] = ()
    left_out: tuple[str, ...] = ()
