"""Effect of each step from the method of Zhang & Wei (2017) to the run's own, on the same photographs."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from stcal.errors import InputError, StcalError
from stcal.geometry.arrays import rms
from stcal.geometry.camera import Camera
from stcal.sfm.adjust.calibration import AdjustOptions, Calibration, calibrate
from stcal.sfm.adjust.chain import CalibratedTarget
from stcal.sfm.adjust.refine import Scale, refine
from stcal.sfm.adjust.uncertainty import calibrated_target
from stcal.sfm.data.group_model import GroupModel, WorldModel
from stcal.sfm.detect.published import EQUAL_SIGMA_PX
from stcal.sfm.runs.groups import GroupSolution
from stcal.sfm.runs.run_result import ComparedRow, Comparison, FaceOff, RunResult

MICRO = 1e3
AS_PUBLISHED = "as published"
STEPS = ("centres of blurred edges", "eccentricity", "weights", "joint adjustment")
"""Steps in the order in which they are added to the published method."""


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """Result of one method."""

    target: CalibratedTarget
    models: tuple[WorldModel, ...]  # without unit, one per group
    scales: dict[str, Scale]  # by group

    @classmethod
    def of(cls, solutions: Sequence[GroupSolution], calibration: Calibration) -> "Answer":
        """Returns the answer of a run, group by group."""
        return cls(calibration.target, tuple(s.model for s in solutions), calibration.scales)


def require_comparable(options: AdjustOptions) -> None:
    """Refuses to compare a run that is itself a part of the published method."""
    if options.solve != "joint" or not options.eccentricity:
        raise InputError(
            "E-OPTION-CONFLICT",
            f"--compare paper: compares with the joint adjustment, but --solve is {options.solve}"
            f"{'' if options.eccentricity else ' without eccentricity'}; leave --solve and --no-eccentricity out",
        )


def compare_with_paper(result: RunResult, published: Answer | StcalError) -> Comparison:
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
    sigma = {
        face: _off(np.trace(c[3:, 3:]) ** 0.5, np.trace(c[:3, :3]) ** 0.5)
        for face, c in whole.face_covariance.items()
        if face != whole.reference_face
    }
    filled = [row.model_dump() for row in rows]
    return Comparison.model_validate({"with": "paper", "rows": filled, "sigma": sigma})


def in_steps(result: RunResult) -> dict[str, Answer | StcalError]:
    """Answers, or errors, from the run's own circles by the step added last, without the joint adjustment."""
    weighted = [solution.model for solution in result.solutions]
    equal = [_alike(model) for model in weighted]
    answers: dict[str, Answer | StcalError] = {}
    for step, models, eccentricity in zip(STEPS[:-1], (equal, equal, weighted), (False, True, True), strict=True):
        try:
            answers[f"+ {step}"] = _chained(result, models, eccentricity)
        except StcalError as error:
            answers[f"+ {step}"] = error
    return answers


def _alike(model: WorldModel) -> WorldModel:
    """Returns the model with the same σ for all centres."""
    n = len(model.measured_px)
    return replace(model, covariance_px2=np.tile(EQUAL_SIGMA_PX**2 * np.eye(2), (n, 1, 1)))


def _chained(result: RunResult, models: Sequence[WorldModel], eccentricity: bool) -> Answer:
    """Returns the answer with λ by rows, three-point frames, and single transforms."""
    designs = result.target_design, result.board_design
    models = tuple(refine(model, result.camera, *designs, eccentricity).model for model in models)
    # The models hold the corrections already; the calibration itself works without eccentricity.
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
    """Returns how far an answer is from the whole one."""
    others = [face for face in whole.target_from_face if face != whole.reference_face]
    if isinstance(found, StcalError):
        return ComparedRow(method=name, missing=others, reason=str(found))
    pairs = (
        (face, pose, whole.target_from_face[face])
        for face, pose in found.target.target_from_face.items()
        if face in others
    )
    faces = {
        face: _off(np.linalg.norm(pose.translation - known.translation), (pose @ known.inverse()).angle_rad())
        for face, pose, known in pairs
    }
    missing = [face for face in others if face not in faces]
    return ComparedRow(method=name, faces=faces, missing=missing, **_residuals(found.models, camera, found.scales))


def _off(translation_mm: float | np.floating, rotation_rad: float) -> FaceOff:
    return FaceOff(translation_um=MICRO * float(translation_mm), rotation_mdeg=MICRO * float(np.degrees(rotation_rad)))


def _residuals(models: Sequence[GroupModel], camera: Camera, scales: dict[str, Scale]) -> dict[str, Any]:
    """Returns the lengths of the board's residuals, and the RMS of the images' per coordinate."""
    board = MICRO * np.concatenate([np.linalg.norm(scale.residuals_mm, axis=1) for scale in scales.values()])
    residuals = np.concatenate([model.residuals_px(camera) for model in models])
    return {
        "board_mean_um": float(board.mean()),
        "board_spread_um": float(board.std()),
        "residual_rms_px": rms(residuals),
    }
