"""Comparisons of a run: with the published method of Zhang & Wei (2017), step by step on the same photographs, and with
the native COLMAP; both are sections of ``report.json``."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from pydantic import Field

from stcal.errors import InputError, StcalError
from stcal.geometry.arrays import require_fields, rms
from stcal.geometry.camera import Camera
from stcal.io.json import ByFace, ByLabel, Part
from stcal.sfm.adjust.calibration import calibrate
from stcal.sfm.adjust.chain import CalibratedTarget
from stcal.sfm.adjust.refine import Scale, refine
from stcal.sfm.adjust.uncertainty import calibrated_target
from stcal.sfm.data.group_model import GroupModel, WorldModel
from stcal.sfm.detect.published import EQUAL_SIGMA_PX

if TYPE_CHECKING:
    from stcal.sfm.runs.saved import RunResult

MICRO = 1e3
AS_PUBLISHED = "as published"
STEPS = ("centres of blurred edges", "eccentricity", "weights", "joint adjustment")
"""Steps in the order in which they are added to the published method."""


class FaceOff(Part):
    translation_um: float
    rotation_mdeg: float

    @classmethod
    def of(cls, difference: np.ndarray, **more: Any) -> Self:
        """Returns the lengths of turn and shift of a difference (6,) of two poses, rad and mm."""
        turn, shift = np.linalg.norm(difference.reshape(2, 3), axis=1).tolist()
        return cls(translation_um=MICRO * shift, rotation_mdeg=MICRO * math.degrees(turn), **more)


class ComparedRow(Part):
    method: str
    faces: dict[ByFace, FaceOff] = Field(default={})
    missing: list[str] = Field(default=[])
    board_mean_um: float | None = None
    board_spread_um: float | None = None
    residual_rms_px: float | None = None
    reason: str | None = None


class Comparison(Part):
    """Content that ``--compare paper`` adds to ``report.json``."""

    method: str = Field(alias="with", description="`paper`")
    rows: list[ComparedRow] = Field(
        description="`as published`, then with one step more each, all with three-point frames: `method`; `faces` "
        "face → `translation_um`, `rotation_mdeg` off the last row (empty in that), `missing` faces; length of the "
        "board's residuals, `board_mean_um` and `board_spread_um` (mean and standard deviation over all groups' dots, "
        "Table 1); "
        "`residual_rms_px` per coordinate; `reason` where a row has no result, null otherwise"
    )
    sigma: dict[ByFace, FaceOff] = Field(
        description="of the last row by face: `translation_um`, `rotation_mdeg`, lengths of σ over the three axes"
    )


@dataclass(frozen=True, slots=True, eq=False)
class MethodResult:
    target: CalibratedTarget
    models: tuple[WorldModel, ...]  # without unit, one per group
    scales: dict[str, Scale]  # by group


def compare_with_paper(result: "RunResult", published: MethodResult | StcalError) -> Comparison:
    """Compares faces, board and residuals of the published method, and of each step of this package added in turn, as
    three-point frames. ``published``: of ``--solve paper`` on the same photographs, or the error that prevents it."""
    joint = result.calibration.joint
    if joint is None:
        raise InputError("E-OPTION-CONFLICT", "--compare paper: no joint adjustment to compare with; leave --solve out")
    whole = calibrated_target(joint, result.target, result.target_design, "three-point")
    steps = {AS_PUBLISHED: published, **in_steps(result)}
    rows = [_row(name, answer, whole, result.camera) for name, answer in steps.items()]
    last = _residuals(joint.models, result.calibration.camera, result.calibration.scales)
    rows.append(ComparedRow(method=f"+ {STEPS[-1]}", **last))
    others = {face: c for face, c in whole.face_covariance.items() if face != whole.reference_face}
    sigma = {face: FaceOff.of(np.sqrt(np.diag(c))) for face, c in others.items()}
    return Comparison(method="paper", rows=[ComparedRow(**row.model_dump()) for row in rows], sigma=sigma)


def in_steps(result: "RunResult") -> dict[str, MethodResult | StcalError]:
    """Answers, or errors, from the run's own circles by the step added last, with λ by rows, three-point frames and
    single transforms, without the joint adjustment."""
    camera, designs = result.camera, (result.target_design, result.board_design)
    weighted, one = [solution.model for solution in result.solutions], EQUAL_SIGMA_PX**2 * np.eye(2)
    equal = [replace(model, covariance_px2=np.tile(one, (len(model.measured_px), 1, 1))) for model in weighted]
    # The models hold the corrections already; the calibration itself works without eccentricity.
    plain: dict[str, Any] = {"solve": "paper", "frame": "three-point", "eccentricity": False, "refine_camera": False}
    options = replace(result.options.adjustment(result.target_design), **plain)
    answers: dict[str, MethodResult | StcalError] = {}
    for step, models, eccentricity in zip(STEPS[:-1], (equal, equal, weighted), (False, True, True), strict=True):
        try:
            refined = tuple(refine(model, camera, *designs, eccentricity).model for model in models)
            calibration = calibrate(refined, camera, *designs, options)
            answers[f"+ {step}"] = MethodResult(calibration.target, refined, calibration.scales)
        except StcalError as error:
            answers[f"+ {step}"] = error
    return answers


def _row(name: str, found: MethodResult | StcalError, whole: CalibratedTarget, camera: Camera) -> ComparedRow:
    """Returns how far an answer is from the whole one."""
    others = [face for face in whole.target_from_face if face != whole.reference_face]
    if isinstance(found, StcalError):
        return ComparedRow(method=name, missing=others, reason=str(found))
    poses, known = found.target.target_from_face, whole.target_from_face
    faces = {face: FaceOff.of(poses[face].difference(known[face])) for face in poses if face in others}
    missing = [face for face in others if face not in faces]
    return ComparedRow(method=name, faces=faces, missing=missing, **_residuals(found.models, camera, found.scales))


def _residuals(models: Sequence[GroupModel], camera: Camera, scales: dict[str, Scale]) -> dict[str, Any]:
    """Returns the lengths of the board's residuals, and the RMS of the images' per coordinate."""
    board = MICRO * np.concatenate([np.linalg.norm(scale.residuals_mm, axis=1) for scale in scales.values()])
    residuals = np.concatenate([model.residuals_px(camera) for model in models])
    lengths = {"board_mean_um": float(board.mean()), "board_spread_um": float(board.std())}
    return lengths | {"residual_rms_px": rms(residuals)}


@dataclass(frozen=True, slots=True)
class Tolerances:
    """Largest differences that a cross-check accepts.

    Faces and circles are compared in the target frame, cameras against the target. Limits that are None do not apply;
    for a run without σ ``face_um``, ``face_mdeg`` and ``circle_um`` do, by default 2, 1 and 2.

    Parameters
    ----------
    face_um, face_mdeg : Of the position and the rotation of a face, µm and millidegrees.
    circle_um : Of a circle, µm.
    camera_um, camera_mdeg : Of the position and the attitude of a camera, µm and millidegrees.
    sigma : Of our result from the native models, faces and circles, in units of their own σ: half a σ, added to σ,
        makes 1.12 σ.
    mapped_sigma : Of the two programs' own results, in the same unit. They are computed group by group with iterations
        that end earlier: noise does not explain differences beyond 3 σ.

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
        require_fields(self, "tolerances", **dict.fromkeys((each.name for each in fields(self)), 0.0))


def allowed_text(tolerances: Tolerances) -> str:
    """Returns the limits in force as text."""
    parts = [f"faces and circles {tolerances.mapped_sigma:g} σ between the programs, {tolerances.sigma:g} σ adjusted"]
    for kind, um, mdeg in (
        ("faces", tolerances.face_um, tolerances.face_mdeg),
        ("circles", tolerances.circle_um, None),
        ("cameras", tolerances.camera_um, tolerances.camera_mdeg),
    ):
        given = [f"{value:g} {unit}" for value, unit in ((um, "µm"), (mdeg, "mdeg")) if value is not None]
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


class FaceDifference(FaceOff):
    sigmas: float | None = None


class CameraRow(Part):
    image: str
    position_um: float
    rotation_mdeg: float
    sigmas: float


class FacesCompared(Part):
    faces: dict[ByFace, FaceDifference | None]


class ResultCompared(FacesCompared):
    circles_um: dict[ByLabel, float] = Field(default={})
    circles_sigmas: dict[ByLabel, float] = Field(default={})


class MappingCompared(ResultCompared):
    """Differences of two results; the keys that were not given are not in the file."""

    cameras: list[CameraRow] = Field(default=[])


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
