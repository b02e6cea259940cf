"""Result file of a hand-eye calibration."""

from typing import Literal

import numpy as np
from pydantic import Field

import stcal
from stcal.geometry.camera import PARAMETER_NAMES, parameter_names
from stcal.handeye.choose import Choice
from stcal.handeye.data.pairs import FRAMES, Setup
from stcal.handeye.judge.remarks import Word
from stcal.handeye.report.outcome import ArmFound, Outcome, judged
from stcal.handeye.result import HandEye
from stcal.handeye.validate import Compared, HeldOutMotions, HeldOutPoses
from stcal.io.json import Finite, Matrix3, Matrix6, NamedReason, Part, Pose, ResultFile, Vector, Vector3


class FindingRow(Part):
    title: str
    word: Word
    said: str
    value: str
    limit: str
    remedy: str


class VerdictPart(Part):
    word: Word
    sentence: str
    findings: list[FindingRow]


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


class PredictedMotion(Part):
    first: str
    second: str
    rotation_rad: float
    translation_mm: float


class HeldOutMotionRows(Part):
    fitted: int
    rotation_rad: float
    translation_mm: float
    motions: list[PredictedMotion]


class SeenTurns(Part):
    turns_rad: Vector3
    axes_flange: Matrix3
    sigma_rad: Finite
    sigma_mm: Finite


class SplitErrors(Part):
    poses: list[str]
    rotation_rad: Vector
    translation_mm: Vector
    board_mm: Vector | None = None
    pose_mm: Vector | None = None


class MethodRow(Part):
    method: str
    reason: str | None
    held_out: HeldOutMeans | None
    flange_from_camera: Pose | None = None
    base_from_camera: Pose | None = None
    base_from_board: Pose | None = None
    flange_from_board: Pose | None = None
    splits: list[SplitErrors]


class TriedRow(Part):
    way: str
    splits: int
    error_mm: Finite
    reason: str | None


class ChoicePart(Part):
    chosen: str
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


class HandEyeFile(ResultFile):
    """Result file of ``handeye``: mm, rad, px; null where there is no value."""

    format: Literal["stcal handeye 1"] = Field(description="the file's form and its version")
    version: str = Field(description="of stcal")
    where: str = Field(alias="from", description="names of the files")
    verdict: VerdictPart = Field(
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
    outliers: list[str] = Field(
        description="names of poses that contradict the others and were left out of the solution"
    )
    left_out: list[NamedReason] = Field(description="`name`, `reason` of images and rows that did not take part")
    held_out: HeldOutMeans | None = Field(
        description="`splits`, `poses` in each, and means: `rotation_rad`, `translation_mm` of the board's origin; "
        "with images `board_mm`: the distance from each corner to the point where the camera's ray to it meets the "
        "board as placed by the robot, mean over the corners, and `pose_mm`: distance of the corners by the robot "
        "from those by "
        "the pose that the image gives alone; `agreeing`: the same means without `outliers`, null where there are none"
    )
    motions_held_out: HeldOutMotionRows | None = Field(
        None,
        description="with `--motions-held-out`: number of `fitted` motions; means `rotation_rad`, `translation_mm` of "
        "X B X⁻¹ against A over the others, and of each of the `motions`, which lead from pose `first` to `second`",
    )
    arm: ArmPart | None = Field(
        None,
        description="with `--with-kinematics`: name of the `robot`, `parameters` by which its axes are off its file, "
        "small motions of their frames (`J2 rx`: rad, `J2 x`: mm), their `sigma`, and `plain`: as `held_out` "
        "(`splits`, `poses`, `rotation_rad`, `translation_mm`, `board_mm`, `pose_mm`, `agreeing`), on the same poses, "
        "of the solution without them",
    )
    choice: ChoicePart | None = Field(
        None,
        description="where no method was named: the way of solving that was `chosen` by errors on poses held out, a "
        "`sentence` on it, and all that were `tried`: `way` (method, with camera and scale solved for), `splits`, mean "
        "`error_mm` (3-D at the board; of poses, of the board's origin), `reason` why it fails",
    )
    time_offset: TimeOffsetPart | None = Field(
        None,
        description="with `--time-offset`: `seconds` by which the robot's clock is ahead of the camera's, so that an "
        "image stamped t was taken at t + `seconds` of the robot's; `sigma_s`, which σ of `X` and `Z` hold; RMS "
        "`speed_mm_s`, `speed_rad_s` of the flange at the images",
    )
    observability: SeenTurns | None = Field(
        description="`turns_rad` RMS between poses about the principal `axes_flange`; `sigma_rad`, `sigma_mm` of the "
        "worst direction from poses of a common camera (1 mrad, 0.5 mm)"
    )
    notes: list[str] = Field(description="what should be known about the result")
    understood: list[str] = Field(
        [], description="only of files of other programs: what each was taken for, a sentence each"
    )
    splits: list[SplitErrors] = Field(
        [],
        description="only in `--json`: names of the `poses` held out, and the errors of each: `rotation_rad`, "
        "`translation_mm`, `board_mm`, `pose_mm`",
    )
    methods: list[MethodRow] = Field(
        [],
        description="only in `--json`, with `--method all`: `method`, `X` and `Z` (`flange_from_camera`, "
        "`base_from_board`, or `base_from_camera`, `flange_from_board`); `held_out` and `splits` with `poses`, "
        "`rotation_rad`, `translation_mm`, `board_mm`, `pose_mm`, `agreeing` as above; `reason` where it fails",
    )

    @classmethod
    def of(cls, outcome: Outcome, whole: bool = False) -> "HandEyeFile":
        """Returns the content of ``--out``, or, if ``whole``, of ``--json``: with every split and every method too."""
        found, seen = judged(outcome), outcome.result.observability
        result, names, board = outcome.result, outcome.result.names, FRAMES[outcome.result.setup].board
        poses = {name: pose.matrix() for name, pose in result.transforms.items()}
        compared = [_method(each, names) for each in outcome.compared]
        optional: dict = {} if outcome.motions is None else {"motions_held_out": _motions(outcome.motions)}
        optional |= {} if outcome.choice is None else {"choice": _choice(outcome.choice)}
        optional |= {} if outcome.arm is None else {"arm": _arm(outcome.arm)}
        optional |= {} if outcome.time_offset is None else {"time_offset": outcome.time_offset}
        optional |= {"understood": outcome.understood} if outcome.understood else {}
        optional |= {"splits": _splits(outcome.held_out, names), "methods": compared} if whole else {}
        return cls.model_validate(
            {
                "format": "stcal handeye 1",
                "version": stcal.__version__,
                "where": outcome.where,
                "verdict": {"word": found.word, "sentence": found.sentence(), "findings": found.findings},
                "setup": result.setup,
                "method": result.method,
                **poses,
                "covariance": result.covariance,
                f"{board}_covariance": result.stand_covariance,
                "board": board_part(outcome),
                "camera": camera_part(outcome),
                "sigma": result.sigma,
                "estimated": result.estimated,
                "corner_px_is_factor": outcome.own_sigmas,
                "rms": dict(zip(RmsResidual.model_fields, result.rms(), strict=True)),
                "poses": poses_part(result),
                "outliers": outcome.outliers(),
                "left_out": [NamedReason(name=name, reason=reason) for name, reason in outcome.left_out],
                "held_out": _held_out(outcome.held_out, result.outliers),
                "observability": seen
                and {
                    "turns_rad": seen.turns_rad,
                    "axes_flange": seen.axes,
                    "sigma_rad": seen.sigma_rad,
                    "sigma_mm": seen.sigma_mm,
                },
                "notes": outcome.all_notes(),
                **optional,
            }
        )


def board_part(outcome: Outcome) -> BoardSize:
    result = outcome.result
    pitch = None if outcome.pitch_mm is None else outcome.pitch_mm * result.scale
    return BoardSize(scale=result.scale, scale_sigma=result.sigma_scale, pitch_mm=pitch)


def camera_part(outcome: Outcome) -> AdjustedCamera | None:
    adjustment = outcome.result.reprojection
    if adjustment is None or adjustment.camera_covariance is None:
        return None
    names, sigma = parameter_names(outcome.colmap_model), np.sqrt(np.diag(adjustment.camera_covariance))
    return AdjustedCamera(
        model=outcome.colmap_model,
        parameters=dict(zip(PARAMETER_NAMES, adjustment.camera.parameters(), strict=True)),
        sigma=dict(zip(names, sigma, strict=True)),
    )


def poses_part(result: HandEye) -> list[PoseRow]:
    rows = []
    for i, (name, off) in enumerate(zip(result.names, result.residuals, strict=True)):
        rms = {} if result.reprojection is None else {"corner_rms_px": result.reprojection.rms_px(i)}
        row = {"name": name, "used": not result.outliers[i], "rotation_rad": off[:3], "translation_mm": off[3:]}
        rows.append(PoseRow.model_validate(row | rms))
    return rows


def _held_out(found: HeldOutPoses | None, outliers: np.ndarray) -> HeldOutMeans | None:
    if found is None:
        return None
    splits, poses = found.rows.shape
    agreeing = (found.means(~outliers) or None) if outliers.any() else None
    return HeldOutMeans(splits=splits, poses=poses, **found.means(), agreeing=agreeing)


def _motions(found: HeldOutMotions) -> HeldOutMotionRows:
    errors = zip(found.rotation_rad.tolist(), found.translation_mm.tolist(), strict=True)
    return HeldOutMotionRows(
        fitted=found.fitted,
        rotation_rad=float(found.rotation_rad.mean()),
        translation_mm=float(found.translation_mm.mean()),
        motions=[
            PredictedMotion(first=first, second=second, rotation_rad=turn, translation_mm=shift)
            for (first, second), (turn, shift) in zip(found.names, errors, strict=True)
        ],
    )


def _choice(found: Choice) -> ChoicePart:
    tried = [
        TriedRow(
            way=candidate.candidate.name,
            splits=len(candidate.error_mm),
            error_mm=candidate.mean_mm() if candidate.error_mm.size else None,
            reason=candidate.reason or None,
        )
        for candidate in found.tried
    ]
    return ChoicePart(chosen=found.chosen.name, sentence=found.sentence, tried=tried)


def _arm(found: ArmFound) -> ArmPart:
    return ArmPart(
        robot=found.robot,
        parameters=dict(zip(found.names, found.parameters.tolist(), strict=True)),
        sigma=dict(zip(found.names, found.sigma.tolist(), strict=True)),
        plain=_held_out(found.plain, np.zeros(0, bool)),
    )


def _splits(found: HeldOutPoses | None, names: tuple[str, ...]) -> list[SplitErrors]:
    """Returns the held-out poses of each split, and the errors on each."""
    if found is None:
        return []
    return [
        SplitErrors(poses=[names[i] for i in row], **{kind: getattr(found, kind)[k] for kind in found.means()})
        for k, row in enumerate(found.rows)
    ]


def _method(each: Compared, names: tuple[str, ...]) -> MethodRow:
    bad = np.zeros(len(names), bool) if each.result is None else each.result.outliers
    transforms = {} if each.result is None else each.result.transforms
    return MethodRow(
        method=each.method,
        reason=each.reason or None,
        held_out=_held_out(each.held_out, bad),
        **{name: pose.matrix() for name, pose in transforms.items()},
        splits=_splits(each.held_out, names),
    )
