"""Board and tags in the photographs of a calibration, whatever found them."""

from dataclasses import dataclass

from stcal.boards.design import BoardView
from stcal.boards.tags import Tags
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationImages:
    """``names`` of m readable images of one size, ``views`` of the board in them, None where it is not seen, ``tags``;
    ``camera``; ``symmetries`` : turns after which the board looks the same; ``left_out`` : files not used, and why."""

    names: tuple[str, ...]
    views: tuple[BoardView | None, ...]
    tags: tuple[Tags, ...]
    camera: Camera
    symmetries: tuple[Rigid, ...] = ()
    left_out: tuple[str, ...] = ()
