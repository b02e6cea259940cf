"""What each step from the method of Zhang & Wei (2017) to the run's own is worth, on the same photographs."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stcal.errors import InputError, StcalError
from stcal.geometry.camera import Camera
from stcal.sfm.adjust.calibration import calibrate
from stcal.sfm.adjust.chain import CalibratedTarget
from stcal.sfm.adjust.options import AdjustOptions
from stcal.sfm.adjust.refine import refine
from stcal.sfm.adjust.scale import Scale
from stcal.sfm.adjust.uncertainty import calibrated_target
from stcal.sfm.data.model import GroupModel, WorldModel
from stcal.sfm.detect.published import EQUAL_SIGMA_PX
from stcal.sfm.runs.comparison import ComparedRow, Comparison, FaceOff, SigmaRow
from stcal.sfm.runs.result import RunResult

MICRO = 1e3
AS_PUBLISHED = "as published"
STEPS = ("centres of blurred edges", "eccentricity", "weights", "joint adjustment")
"""In the order in which they are added."""


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """Of one method: the target, and by group the models without unit that it rests on, and their scales."""

    target: CalibratedTarget
    models: tuple[WorldModel, ...]
    scales: dict[str, Scale]


def require_comparable(options: AdjustOptions) -> None:
    """Refuse to compare what is itself a part of the published method.

    Raises
    ------
    InputError
        Not the joint adjustment with eccentricity.
    """
    if options.solve != "joint" or not options.eccentricity:
        raise InputError(
            "E-OPTION-CONFLICT",
            f"--compare paper: compares the joint adjustment, the solve is {options.solve}"
            f"{'' if options.eccentricity else ' without eccentricity'}; leave --solve and --no-eccentricity out",
        )


def compare_with_paper(result: RunResult, published: RunResult | StcalError) -> Comparison:
    """Faces, board and residuals by the published method, and with each step of this package added in turn.

    Parameters
    ----------
    result
        Of the joint adjustment.
    published
        Of the same photographs by ``--solve paper``, or why there is none.

    Returns
    -------
    Comparison
        Poses as three-point frames, against those of ``result``'s circles.
    """
    whole = _jointly(result)
    steps = {AS_PUBLISHED: published if isinstance(published, StcalError) else answer_of(published), **in_steps(result)}
    rows = [_row(name, each, whole, result.camera) for name, each in steps.items()]
    rows.append(_last_row(f"+ {STEPS[-1]}", result))
    sigma = {
        face: SigmaRow(
            translation_um=MICRO * float(np.sqrt(np.trace(c[3:, 3:]))),
            rotation_mdeg=MICRO * float(np.degrees(np.sqrt(np.trace(c[:3, :3])))),
        )
        for face, c in whole.face_covariance.items()
        if face != whole.reference_face
    }
    return Comparison.model_validate({"with": "paper", "rows": rows, "sigma": sigma})


def in_steps(result: RunResult) -> dict[str, Answer | StcalError]:
    """With the run's own circles, by the step added last, all but the joint adjustment; or why there is none."""
    alike = [_alike(each.model) for each in result.solutions]
    own = [each.model for each in result.solutions]
    found: dict[str, Answer | StcalError] = {}
    for step, models, eccentricity in zip(STEPS[:-1], (alike, alike, own), (False, True, True), strict=True):
        try:
            found[f"+ {step}"] = _chained(result, models, eccentricity)
        except StcalError as error:
            found[f"+ {step}"] = error
    return found


def answer_of(run: RunResult) -> Answer:
    """What a run answers, group by group."""
    return Answer(run.target, tuple(each.model for each in run.solutions), run.calibration.scales)


def _jointly(result: RunResult) -> CalibratedTarget:
    """The run's own target with three-point frames."""
    joint = result.calibration.joint
    if joint is None:
        raise InputError("E-OPTION-CONFLICT", "--compare paper: no joint adjustment to compare with; leave --solve out")
    return calibrated_target(joint, result.target, result.target_design, "three-point")


def _alike(model: WorldModel) -> WorldModel:
    """With centres of one σ."""
    n = len(model.measured_px)
    return replace(model, covariance_px2=np.tile(EQUAL_SIGMA_PX**2 * np.eye(2), (n, 1, 1)))


def _chained(result: RunResult, models: Sequence[WorldModel], eccentricity: bool) -> Answer:
    """λ by rows, three-point frames, single transforms."""
    designs = result.target_design, result.board_design
    models = tuple(refine(model, result.camera, *designs, eccentricity).model for model in models)
    # The corrections are in the models; this step of the calibration knows nothing of them.
    options = replace(
        result.options.adjustment(result.target_design),
        solve="paper",
        frame="three-point",
        eccentricity=False,
        refine_camera=False,
    )
    calibration = calibrate(models, result.camera, *designs, options)
    return Answer(calibration.target, models, calibration.scales)


def _row(name: str, found: Answer | StcalError, whole: CalibratedTarget, camera: Camera) -> ComparedRow:
    others = [face for face in whole.target_from_face if face != whole.reference_face]
    if isinstance(found, StcalError):
        return _compared(name, {}, others, None, None, str(found))
    faces = {}
    for face in others:
        if face in found.target.target_from_face:
            pose, own = found.target.target_from_face[face], whole.target_from_face[face]
            faces[face] = FaceOff(
                translation_um=MICRO * float(np.linalg.norm(pose.translation - own.translation)),
                rotation_mdeg=MICRO * float(np.degrees((pose @ own.inverse()).angle_rad())),
            )
    missing = [face for face in others if face not in faces]
    return _compared(name, faces, missing, found.scales, residual_rms_px(found.models, camera), None)


def _last_row(name: str, result: RunResult) -> ComparedRow:
    """The run's own: the board by least squares in each group."""
    joint = result.calibration.joint
    models = () if joint is None else joint.models
    rms = residual_rms_px(models, result.calibration.camera)
    return _compared(name, {}, [], result.calibration.scales, rms, None)


def residual_rms_px(models: Sequence[GroupModel], camera: Camera) -> float:
    """Per coordinate."""
    return float(np.sqrt(np.concatenate([model.residuals_px(camera).ravel() ** 2 for model in models]).mean()))


def _compared(
    name: str,
    faces: dict[str, FaceOff],
    missing: list[str],
    scales: dict[str, Scale] | None,
    rms_px: float | None,
    reason: str | None,
) -> ComparedRow:
    lengths = [np.linalg.norm(each.residuals_mm, axis=1) for each in scales.values()] if scales else []
    board = MICRO * np.concatenate(lengths) if lengths else None
    return ComparedRow(
        method=name,
        faces=faces,
        missing=missing,
        board_mean_um=None if board is None else float(board.mean()),
        board_spread_um=None if board is None else float(board.std()),
        residual_rms_px=rms_px,
        reason=reason,
    )
