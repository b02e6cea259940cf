"""Content of ``report.json`` about a cross-check with the native COLMAP."""

from dataclasses import asdict, dataclass, replace

import numpy as np
from pydantic import Field

from stcal.errors import InputError
from stcal.geometry.arrays import require_fields
from stcal.io.json import ByFace, ByLabel, Part


@dataclass(frozen=True, slots=True)
class Tolerances:
    """Largest differences that a cross-check accepts.

    Faces and circles are compared in the target frame, cameras against the target. Limits that are None do not apply;
    for a run without σ ``face_um``, ``face_mdeg`` and ``circle_um`` do, by default 2, 1 and 2.

    Parameters
    ----------
    face_um, face_mdeg : float, optional
        Of the position and the rotation of a face, µm and millidegrees.
    circle_um : float, optional
        Of a circle, µm.
    camera_um, camera_mdeg : float, optional
        Of the position and the attitude of a camera, µm and millidegrees.
    sigma : float
        Of our result from the native models, faces and circles, in units of their own σ: half a σ, added to σ, makes
        1.12 σ.
    mapped_sigma : float
        Of the two programs' own results, in the same unit. They are computed group by group with iterations that end
        earlier: noise does not explain differences beyond 3 σ.

    Raises
    ------
    InputError
        A limit is negative or no number.
    """

    face_um: float | None = None
    face_mdeg: float | None = None
    circle_um: float | None = None
    camera_um: float | None = None
    camera_mdeg: float | None = None
    sigma: float = 0.5
    mapped_sigma: float = 3.0

    def without_sigma(self) -> "Tolerances":
        """Returns the tolerances for a run that states no σ."""
        defaults = {"face_um": 2.0, "face_mdeg": 1.0, "circle_um": 2.0}
        return replace(self, **{name: value for name, value in defaults.items() if getattr(self, name) is None})

    def __post_init__(self):
        for name, value in asdict(self).items():
            if isinstance(value, int | float) and not 0 <= value < np.inf:
                raise InputError(
                    "E-OPTION-RANGE", f"tolerance {name} {value:g}: a number of 0 or more needed; give another"
                )
        require_fields(self, "tolerances")


def allowed_text(tolerances: Tolerances) -> str:
    """Returns the limits in force as text."""
    parts = [f"faces and circles {tolerances.mapped_sigma:g} σ between the programs, {tolerances.sigma:g} σ adjusted"]
    for kind, values in (
        ("faces", ((tolerances.face_um, "µm"), (tolerances.face_mdeg, "mdeg"))),
        ("circles", ((tolerances.circle_um, "µm"),)),
        ("cameras", ((tolerances.camera_um, "µm"), (tolerances.camera_mdeg, "mdeg"))),
    ):
        given = [f"{value:g} {unit}" for value, unit in values if value is not None]
        parts += [f"{kind} {' and '.join(given)}"] if given else []
    return ", ".join(parts)


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
    sigmas: float | None = None


class CameraDifference(Part):
    image: str
    position_um: float
    rotation_mdeg: float
    sigmas: float


class FacesCompared(Part):
    faces: dict[ByFace, FaceDifference | None]


class ResultCompared(FacesCompared):
    circles_um: dict[ByLabel, float]
    circles_sigmas: dict[ByLabel, float] = Field({})


class MappingCompared(ResultCompared):
    cameras: list[CameraDifference]


class Crosscheck(Part):
    """Section ``crosscheck`` of ``report.json``."""

    native: str = Field(description="version of the native program")
    pycolmap: str = Field(description="version of ours")
    schema_: str = Field(alias="schema", description="of the exported database")
    tolerances: Tolerances = Field(
        description="`face_um`, `face_mdeg`, `circle_um`, `camera_um`, `camera_mdeg` as given, else null; `sigma` of "
        "faces and circles of our answer from the native models, `mapped_sigma` of the programs' own, in σ"
    )
    images: ImagesRegistered = Field(
        description="registered by `native` and by `pycolmap`, and those of the `run`; `only_native`, `only_pycolmap`: "
        "names of those that the other did not register"
    )
    residual_rms_px: ResidualRms = Field(
        description="per coordinate, of the `native` model, of `pycolmap`'s, and of the `run`'s final one"
    )
    mapping: MappingCompared = Field(
        description="native against pycolmap, both as COLMAP adjusts them, through our scale and face stages, target "
        "frame: `faces` face → `translation_um`, `rotation_mdeg`, `sigmas` (null where only one has it), `circles_um` "
        "label → distance, `circles_sigmas`, `cameras`: `image`, `position_um`, `rotation_mdeg`, `sigmas`. `sigmas`: "
        "√(dᵀC⁻¹d/k) of the k components of the difference, with the run's own covariance of the face or circle, and "
        "with that of the camera in its group, circles held together"
    )
    result: ResultCompared = Field(
        description="native models after our whole adjustment against `faces.json`: `faces` with `translation_um`, "
        "`rotation_mdeg`, `sigmas`; `circles_um`, `circles_sigmas`"
    )
    plain: FacesCompared = Field(
        description="native models as they are against `faces.json`: `faces` with `translation_um`, `rotation_mdeg`, "
        "`sigmas`; no tolerance applies"
    )
    notes: list[str] = Field(
        description="what was left out on the way; cameras that differ by more than their σ, and what becomes of faces"
    )
    differences: list[str] = Field(description="what is outside of the tolerances: what matters for the faces")
