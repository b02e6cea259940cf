"""What ``report.json`` holds of a cross-check with the native COLMAP."""

from dataclasses import asdict, dataclass

import numpy as np
from pydantic import Field

from stcal.errors import InputError
from stcal.io.json import ByFace, ByLabel, Part


@dataclass(frozen=True, slots=True)
class Tolerances:
    """Largest differences allowed: faces and circles in the target frame, cameras against the target."""

    face_um: float = 2.0
    face_mdeg: float = 1.0
    circle_um: float = 2.0
    camera_um: float = 20.0
    camera_mdeg: float = 2.0

    def __post_init__(self):
        for name, value in asdict(self).items():
            if not 0 <= value < np.inf:
                raise InputError(f"tolerance {name} {value:g}: a number of 0 or more needed; give another")


class ImagesRegistered(Part):
    native: int
    pycolmap: int
    run: int
    only_native: list[str]
    only_pycolmap: list[str]


class ResidualRms(Part):
    native: float
    pycolmap: float
    run: float


class FaceDifference(Part):
    translation_um: float
    rotation_mdeg: float


class CameraDifference(Part):
    image: str
    position_um: float
    rotation_mdeg: float


class FacesCompared(Part):
    faces: dict[ByFace, FaceDifference | None]


class ResultCompared(FacesCompared):
    circles_um: dict[ByLabel, float]


class MappingCompared(ResultCompared):
    cameras: list[CameraDifference]


class Crosscheck(Part):
    """``crosscheck`` of ``report.json``."""

    native: str = Field(description="version of the native program")
    pycolmap: str = Field(description="version of ours")
    schema_: str = Field(alias="schema", description="of the exported database")
    tolerances: Tolerances = Field(description="`face_um`, `face_mdeg`, `circle_um`, `camera_um`, `camera_mdeg`")
    images: ImagesRegistered = Field(
        description="registered by `native` and by `pycolmap`, and those of the `run`; `only_native`, `only_pycolmap`: "
        "names of those that the other did not register"
    )
    residual_rms_px: ResidualRms = Field(
        description="per coordinate, of the `native` model, of `pycolmap`'s, and of the `run`'s final one"
    )
    mapping: MappingCompared = Field(
        description="native against pycolmap, both as COLMAP adjusts them, through our scale and face stages, target "
        "frame: `faces` face → `translation_um`, `rotation_mdeg` (null where only one has it), `circles_um` label → "
        "distance, `cameras`: `image`, `position_um`, `rotation_mdeg`"
    )
    result: ResultCompared = Field(
        description="native models after our whole adjustment against `faces.json`: `faces` with `translation_um`, "
        "`rotation_mdeg`; `circles_um`"
    )
    plain: FacesCompared = Field(
        description="native models as they are against `faces.json`: `faces` with `translation_um`, `rotation_mdeg`; "
        "no tolerance applies"
    )
    notes: list[str] = Field(description="what was left out on the way")
    differences: list[str] = Field(description="what is outside of the tolerances")
