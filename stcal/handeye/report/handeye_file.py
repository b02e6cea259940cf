"""Result file of a hand-eye calibration."""

from typing import Annotated, Literal

import numpy as np
from pydantic import BeforeValidator, Field

import stcal
from stcal.handeye.choose import Way
from stcal.handeye.data.pose_pairs import FRAMES, Setup
from stcal.handeye.judge.remarks import Finding, Word
from stcal.handeye.report.outcome import Outcome, judged
from stcal.handeye.validate import Compared
from stcal.io.json import Finite, Matrix, Matrix3, Matrix6, NamedReason, Part, Pose, ResultFile, Vector, Vector3


class HandEyeVerdictPart(Part):
    word: Word
    sentence: Annotated[str, BeforeValidator(lambda said: said if isinstance(said, str) else said())]
    findings: list[Finding]


class BoardSize(Part):
    scale: float
    scale_sigma: Finite
    pitch_mm: float | None


class AdjustedCamera(Part):
    model: str
    parameters: dict[str, float]
    sigma: dict[str, float]


class RmsResidual(Part):
    rotation_rad: float
    translation_mm: float


class PoseRow(Part):
    name: str
    used: bool
    rotation_rad: Vector3
    translation_mm: Vector3
    corner_rms_px: Finite = None


class HeldOutMeans(Part):
    splits: int
    poses: int
    rotation_rad: float
    translation_mm: float
    board_mm: float | None = None
    pose_mm: float | None = None
    agreeing: dict[str, float] | None


class HeldOutMotionErrors(Part):
    fitted: int
    names: list[tuple[str, str]]
    rotation_rad: Vector
    translation_mm: Vector


class SeenTurns(Part):
    turns_rad: Vector3
    axes: Matrix3
    sigma_rad: Finite
    sigma_mm: Finite


class SplitErrors(Part):
    rows: Annotated[list[list[int]], BeforeValidator(lambda rows: np.asarray(rows).tolist())]
    rotation_rad: Matrix
    translation_mm: Matrix
    board_mm: Matrix | None
    pose_mm: Matrix | None


class MethodRow(Part):
    method: str
    reason: str
    held_out: HeldOutMeans | None
    flange_from_camera: Pose | None = None
    base_from_camera: Pose | None = None
    base_from_board: Pose | None = None
    flange_from_board: Pose | None = None
    splits: SplitErrors | None


class TriedRow(Part):
    candidate: Way
    mean_mm: Finite
    reason: str


class ChosenWayPart(Part):
    chosen: Way
    sentence: str
    tried: list[TriedRow]


class ArmPart(Part):
    robot: str
    parameters: dict[str, float]
    sigma: dict[str, float]
    plain: HeldOutMeans | None


class TimeOffsetPart(Part):
    seconds: float
    sigma_s: float
    speed_mm_s: float
    speed_rad_s: float


MEANS = "`splits`, `poses`, `rotation_rad`, `translation_mm`, `board_mm`, `pose_mm`, `agreeing`"


class HandEyeFile(ResultFile):
    """Result file of ``handeye``: mm, rad, px; null where there is no value."""

    format: Literal["stcal handeye 1"] = Field(description="the file's form and its version")
    version: str = Field(description="of stcal")
    where: str = Field(alias="from", description="names of the files")
    verdict: HandEyeVerdictPart = Field(
        description="`word`: `good`, `use with care` or `do not use`; a `sentence` with the reasons; `findings`, each "
        "with `title`, `word`, what was `said`, `value` and `limit`, `remedy`"
    )
    setup: Setup = Field(description="what carries the camera")
    method: str = Field(description="that found the result")
    flange_from_camera: Pose | None = Field(None, description="`X` of eye-in-hand")
    base_from_camera: Pose | None = Field(None, description="`X` of eye-to-hand")
    covariance: Matrix6 | None = Field(
        description="of `X`: rotation about the camera, rad, and its translation, mm, in the axes of flange or base; "
        "null for methods that give none"
    )
    base_from_board: Pose | None = Field(None, description="`Z` of eye-in-hand")
    base_from_board_covariance: Matrix6 | None = Field(None, description="its covariance, likewise")
    flange_from_board: Pose | None = Field(None, description="`Z` of eye-to-hand")
    flange_from_board_covariance: Matrix6 | None = Field(None, description="its covariance, likewise")
    board: BoardSize = Field(
        description="`scale`: true size over stated size, 1 where it was not solved for; `scale_sigma`; `pitch_mm` of "
        "dots or squares, times `scale`; null for tags and poses"
    )
    camera: AdjustedCamera | None = Field(
        description="with `--refine-camera`: COLMAP `model`; `parameters` fx, fy, cx, cy, k1, k2, p1, p2, k3 … k6, "
        "s1 … s4, OpenCV pixel origin; `sigma` of those of the model"
    )
    sigma: dict[str, float] = Field(
        description="`robot_rad`, `robot_mm`, `camera_rad`, `camera_mm`, `corner_px`, `board_mm` as far as the method "
        "weights by them; `arm_rad`, `arm_mm`: of the axes about the robot's file; "
        "`camera_factor`: by which the σ of given covariances of `camera_from_board` were multiplied; "
        "`camera_focal`, `camera_centre`, `camera_radial`, `camera_tangential` (`camera_all` where their covariance is "
        "stated): factors, 1 or more, by which the σ of the camera file were widened"
    )
    estimated: list[str] = Field(description="which of them were estimated")
    corner_px_is_factor: bool = Field(description="whether `corner_px` is the factor of the corners' own σ")
    rms: RmsResidual = Field(description="`rotation_rad`, `translation_mm` of the residuals of the poses used")
    poses: list[PoseRow] = Field(
        description="`name` (`line 7`, or the image), `used`, residual `rotation_rad` (rotation vector) and "
        "`translation_mm` at the board's origin, by which the chain through this pose misses `Z`; with method "
        "`reprojection` `corner_rms_px`"
    )
    outliers: list[str] = Field(description="names of poses that contradict the others and were left out")
    left_out: list[NamedReason] = Field(description="`name`, `reason` of images and rows that did not take part")
    held_out: HeldOutMeans | None = Field(
        description="`splits`, `poses` in each, and means: `rotation_rad`, `translation_mm` of the board's origin; "
        "with images `board_mm`: the distance from each corner to the point where the camera's ray to it meets the "
        "board as placed by the robot, mean over the corners, and `pose_mm`: distance of the corners by the robot "
        "from those by the pose that the image gives alone; `agreeing`: means without `outliers`, null without any"
    )
    motions: HeldOutMotionErrors | None = Field(
        None,
        description="with `--motions-held-out`: number of `fitted` motions; `names` of the poses from which and to "
        "which each other motion leads, and errors `rotation_rad`, `translation_mm` of X B X⁻¹ against A",
    )
    arm: ArmPart | None = Field(
        None,
        description="with `--with-kinematics`: name of the `robot`, `parameters` by which its axes are off its file, "
        "small motions of their frames (`J2 rx`: rad, `J2 x`: mm), their `sigma`, and `plain`: as `held_out` "
        f"({MEANS}), on the same poses, of the solution without them",
    )
    choice: ChosenWayPart | None = Field(
        None,
        description="where no method was named: the way of solving that was `chosen` by errors on poses held out "
        "(`method`, and whether `camera` and `scale` were solved for), a `sentence` on it, and all that were `tried`: "
        "`candidate`, `mean_mm` (3-D at the board; of poses, of the board's origin), `reason` why it fails",
    )
    time_offset: TimeOffsetPart | None = Field(
        None,
        description="with `--time-offset`: `seconds` by which the robot's clock is ahead of the camera's, so that an "
        "image stamped t was taken at t + `seconds` of the robot's; `sigma_s`, which σ of `X` and `Z` hold; RMS "
        "`speed_mm_s`, `speed_rad_s` of the flange at the images",
    )
    observability: SeenTurns | None = Field(
        description="`turns_rad` RMS between poses about the principal `axes`, rows, of the flange; `sigma_rad`, "
        "`sigma_mm` of the worst direction from poses of a common camera (1 mrad, 0.5 mm)"
    )
    notes: list[str] = Field(description="what should be known about the result")
    understood: list[str] = Field([], description="only of files of other programs: what each was taken for")
    splits: SplitErrors | None = Field(
        None,
        description="only in `--json`: `rows` of `poses` that each split held out, and the errors of each: "
        "`rotation_rad`, `translation_mm`, `board_mm`, `pose_mm`",
    )
    methods: list[MethodRow] = Field(
        [],
        description="only in `--json`, with `--method all`: `method`, `X` and `Z` (`flange_from_camera`, "
        f"`base_from_board`, or `base_from_camera`, `flange_from_board`); `held_out`, with {MEANS}, and `splits`, with "
        "`rows`, as above; `reason` where it fails",
    )

    @classmethod
    def of(cls, outcome: Outcome, whole: bool = False) -> "HandEyeFile":
        """Returns the content of ``--out``, or, if ``whole``, of ``--json``: with every split and every method too."""
        result, arm, held_out = outcome.result, outcome.arm, outcome.held_out
        optional = {name: getattr(outcome, name) for name in ("motions", "choice", "time_offset", "understood")}
        if arm is not None:
            parts = {"robot": arm.robot, "parameters": arm.parameters, "sigma": arm.sigma}
            optional["arm"] = parts | {"plain": arm.plain and arm.plain.summary()}
        if whole:
            optional |= {"splits": held_out, "methods": [_method(each) for each in outcome.compared]}
        adjusted, poses = result.reprojection, []
        for i, (name, out, off) in enumerate(zip(result.names, result.outliers, result.residuals, strict=True)):
            row = {"name": name, "used": not out, "rotation_rad": off[:3], "translation_mm": off[3:]}
            poses.append(row if adjusted is None else row | {"corner_rms_px": adjusted.rms_px(i)})
        content = {
            "format": "stcal handeye 1",
            "version": stcal.__version__,
            "where": outcome.where,
            "verdict": judged(outcome),
            "setup": result.setup,
            "method": result.method,
            **result.transforms,
            "covariance": result.covariance,
            f"{FRAMES[result.setup].board}_covariance": result.stand_covariance,
            "board": {"scale": result.scale, "scale_sigma": result.sigma_scale, "pitch_mm": outcome.true_pitch_mm},
            "camera": outcome.camera,
            "sigma": result.sigma,
            "estimated": result.estimated,
            "corner_px_is_factor": outcome.own_sigmas,
            "rms": dict(zip(RmsResidual.model_fields, result.rms(), strict=True)),
            "poses": poses,
            "outliers": outcome.outliers(),
            "left_out": [{"name": name, "reason": reason} for name, reason in outcome.left_out],
            "held_out": held_out and held_out.summary(result.outliers),
            "observability": result.observability,
            "notes": outcome.all_notes(),
        }
        return cls.model_validate(content | {name: value for name, value in optional.items() if value})


def _method(each: Compared) -> dict:
    result, held_out = each.result, each.held_out
    row = {"method": each.method, "reason": each.reason, "held_out": None, "splits": held_out}
    if result is None:
        return row
    return row | {"held_out": held_out and held_out.summary(result.outliers), **result.transforms}
