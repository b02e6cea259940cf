"""Options of the adjustment."""

from dataclasses import dataclass
from typing import Literal

from stcal.errors import InputError
from stcal.geometry.arrays import require_fields
from stcal.io.toml import LEAST
from stcal.sfm.adjust.faces import FrameKind

FLATNESS_MM = 0.02
"""σ of the circles off the plane of their face where none is stated."""
MOST_FLATNESS_MM = 1e6
Solve = Literal["joint", "chain", "paper"]


@dataclass(frozen=True, slots=True)
class AdjustOptions:
    """Options of the adjustment of models to a calibrated target, with every default decided.

    ``reference_face`` : id of the face whose frame is the target frame; ``solve`` : ``joint`` (one adjustment over all
    groups), ``chain`` (group by group, weighted over all ways to a face) or ``paper`` (Zhang & Wei 2017: group by
    group, λ by rows, faces by single transforms); ``frame`` : ``plane`` (Z from the plane of all circles of a face) or
    ``three-point`` (as in the paper); ``eccentricity`` : whether it is corrected; ``flatness_mm`` : σ of a circle about
    the plane of its face, None if it is unknown; ``refine_camera`` : adjust the intrinsics, with the given ones as
    observations.

    Raises
    ------
    InputError
        A choice does not exist, σ is out of range, an option contradicts ``paper``, or intrinsics are to be refined
        without the joint adjustment.
    """

    reference_face: str
    solve: Solve = "joint"
    frame: FrameKind = "plane"
    eccentricity: bool = True
    flatness_mm: float | None = FLATNESS_MM
    refine_camera: bool = False

    def __post_init__(self):
        require_fields(self, "options")
        if self.flatness_mm is not None and not LEAST <= self.flatness_mm <= MOST_FLATNESS_MM:
            raise InputError(
                "E-OPTION-RANGE",
                f"--flatness {self.flatness_mm:g}: a σ in mm, {LEAST:g} to {MOST_FLATNESS_MM:g} needed, or off",
            )
        if self.solve == "paper" and (self.eccentricity or self.frame != "three-point"):
            raise InputError(
                "E-OPTION-CONFLICT",
                "--solve paper: three-point frames without eccentricity, as published; leave --frame out, or use chain",
            )
        if self.refine_camera and self.solve != "joint":
            raise InputError(
                "E-OPTION-NEEDS",
                f"--refine-camera: part of the joint adjustment, the solve is {self.solve}; use --solve joint",
            )
