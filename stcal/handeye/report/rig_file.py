"""The result file of a rig's calibration, with all of its results."""

from itertools import combinations
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

import stcal
from stcal.handeye.data.loop import FRAMES, Setup
from stcal.handeye.methods.rounds import kind
from stcal.handeye.report.file import (
    AdjustedCamera,
    BoardSize,
    PoseRow,
    RmsResidual,
    VerdictPart,
    board_part,
    camera_part,
    poses_part,
    verdict_part,
)
from stcal.handeye.report.rig_outcome import RigOutcome, rig_judged
from stcal.handeye.rig.validate import CameraHeldOut
from stcal.io.json import Finite, Matrix6, NamedReason, Part, Pose, ResultFile, Shape, Vector

Square = Annotated[np.ndarray, Shape((None, None))]


class RigErrors(Part):
    rotation_rad: float
    translation_mm: float
    board_mm: float
    pose_mm: float


class RigHeldOutMeans(Part):
    views: int
    joint: RigErrors
    alone: RigErrors | None
    gain: Finite


class RigSplits(Part):
    split: list[int]
    images: list[str]
    joint_board_mm: Vector
    alone_board_mm: list[Finite]


class RigCameraPart(Part):
    name: str
    flange_from_camera: Pose | None = None
    base_from_camera: Pose | None = None
    covariance: Matrix6
    corner_px: float
    corner_px_is_factor: bool
    sigma: dict[str, float]
    camera: AdjustedCamera | None
    rms: RmsResidual
    poses: list[PoseRow]
    outliers: list[str]
    left_out: list[NamedReason]
    held_out: RigHeldOutMeans | None
    splits: RigSplits | None = None


class RelativePose(Part):
    first: str
    second: str
    first_from_second: Pose
    covariance: Matrix6


class HandEyeRigFile(ResultFile):
    """Result file of ``handeye rig``: mm, rad, px; null where there is no value."""

    format: Literal["stcal handeye rig 1"] = Field(description="the file's form and its version")
    version: str = Field(description="of stcal")
    where: str = Field(alias="from", description="name of the rig's file")
    verdict: VerdictPart = Field(
        description="as of `handeye`: `word`, `sentence`, `findings` (`title`, `word`, `said`, `value`, `limit`, "
        "`remedy`), those of a camera with its name before them"
    )
    setup: Setup = Field(description="what carries the cameras")
    cameras: list[RigCameraPart] = Field(
        description="of each: `name`; `flange_from_camera` of eye-in-hand or `base_from_camera` of eye-to-hand, with "
        "`covariance`; `corner_px`, σ of its corners, or the factor of their own σ where `corner_px_is_factor`; other "
        "`sigma` as of `handeye`; `camera`, with `--refine-camera`: COLMAP `model`, `parameters`, `sigma`; `rms` "
        "(`rotation_rad`, `translation_mm`) and `poses` (`name` of the image, `used`, `rotation_rad`, "
        "`translation_mm`, `corner_rms_px`) of the residuals; `outliers`, `left_out` (`name`, `reason`); `held_out`: "
        "number of `views`, and means over them of the errors of all cameras solved together, `joint`, and of this one "
        "`alone` (`rotation_rad`, `translation_mm`, `board_mm`, `pose_mm` as of `handeye`; null where it cannot be "
        "found by itself), `gain`: 1 − `board_mm` of the first over that of the second; only in `--json` `splits`: "
        "which `split` each of the `images` was held out in, `joint_board_mm`, `alone_board_mm`"
    )
    covariance: Square = Field(
        description="(6c + 6)×(6c + 6), of `X` of all c cameras in their order and of `Z`: rotation, translation each"
    )
    relative: list[RelativePose] = Field(
        description="of every two cameras `first`, `second`: pose `first_from_second` and its `covariance`, with the "
        "correlation of both"
    )
    base_from_board: Pose | None = Field(None, description="`Z` of eye-in-hand")
    base_from_board_covariance: Matrix6 | None = Field(None, description="its covariance")
    flange_from_board: Pose | None = Field(None, description="`Z` of eye-to-hand")
    flange_from_board_covariance: Matrix6 | None = Field(None, description="its covariance")
    board: BoardSize = Field(description="`scale`, `scale_sigma`, `pitch_mm`, `unit_mm` as of `handeye`")
    sigma: dict[str, float] = Field(description="`robot_rad`, `robot_mm`, `board_mm`, of all cameras together")
    estimated: list[str] = Field(description="which σ were estimated, those of a camera with its name behind a colon")
    robot_poses: list[str] = Field(description="names of the robot's poses")
    outliers: list[str] = Field(description="which of them contradict the others and were left out")
    splits: int = Field(description="of the cross-validation over the robot's poses; 0 where there was none")
    split_poses: int = Field(description="poses of the robot held out in each")
    notes: list[str] = Field(description="what should be known about the result")
    understood: list[str] = Field(description="what each file of poses was taken for, and what cameras share")

    @classmethod
    def of(cls, outcome: RigOutcome, whole: bool = False) -> "HandEyeRigFile":
        """Returns the content of ``--out``, or, if ``whole``, of ``--json``: with every split too."""
        rig, frames, held = outcome.rig, FRAMES[outcome.rig.setup], outcome.held_out
        first_camera = rig.cameras[0]
        estimated = []
        for name, camera in zip(rig.names, rig.cameras, strict=True):
            estimated += [each if each in _shared(outcome) else f"{each}:{name}" for each in camera.estimated]
        shape = (0, 0) if held is None else held.rows.shape
        return cls.model_validate(
            {
                "format": "stcal handeye rig 1",
                "version": stcal.__version__,
                "where": outcome.where,
                "verdict": verdict_part(rig_judged(outcome)),
                "setup": rig.setup,
                "cameras": [_camera(outcome, i, whole) for i in range(len(rig.names))],
                "covariance": rig.covariance,
                "relative": [_relative(outcome, *pair) for pair in combinations(rig.names, 2)],
                frames.board: rig.stand_from_board,
                f"{frames.board}_covariance": first_camera.stand_covariance,
                "board": board_part(outcome.cameras[0]),
                "sigma": _shared(outcome),
                "estimated": list(dict.fromkeys(estimated)),
                "robot_poses": rig.poses,
                "outliers": [name for name, bad in zip(rig.poses, rig.outliers, strict=True) if bad],
                "splits": shape[0],
                "split_poses": shape[1],
                "notes": outcome.all_notes(),
                "understood": outcome.understood,
            }
        )


def _shared(outcome: RigOutcome) -> dict[str, float]:
    """Returns σ of robot and board, which are the same for all cameras."""
    every = outcome.rig.cameras[0].sigma
    return {name: value for name, value in every.items() if name.startswith(("robot", "board"))}


def _camera(outcome: RigOutcome, i: int, whole: bool) -> RigCameraPart:
    camera_outcome, result = outcome.cameras[i], outcome.rig.cameras[i]
    held = None if outcome.held_out is None else outcome.held_out.cameras[i]
    splits_part = {"splits": _splits(held, result.names)} if whole and held is not None else {}
    sigma = {name: value for name, value in result.sigma.items() if kind(name).startswith("camera")}
    return RigCameraPart.model_validate(
        {
            "name": outcome.rig.names[i],
            FRAMES[result.setup].camera: result.mount_from_camera,
            "covariance": result.covariance,
            "corner_px": result.sigma["corner_px"],
            "corner_px_is_factor": camera_outcome.own_sigmas,
            "sigma": sigma,
            "camera": camera_part(camera_outcome),
            "rms": dict(zip(RmsResidual.model_fields, result.rms(), strict=True)),
            "poses": poses_part(result),
            "outliers": camera_outcome.outliers(),
            "left_out": [NamedReason(name=name, reason=reason) for name, reason in camera_outcome.left_out],
            "held_out": _held_out(held),
            **splits_part,
        }
    )


def _held_out(found: CameraHeldOut | None) -> RigHeldOutMeans | None:
    if found is None or not found.means():
        return None
    alone = found.means("alone")
    return RigHeldOutMeans(
        views=len(found.view),
        joint=RigErrors(**found.means()),
        alone=RigErrors(**alone) if alone else None,
        gain=found.gain(),
    )


def _splits(found: CameraHeldOut, names: tuple[str, ...]) -> RigSplits:
    return RigSplits(
        split=found.split.tolist(),
        images=[names[v] for v in found.view],
        joint_board_mm=found.joint["board_mm"],
        alone_board_mm=[float(v) if np.isfinite(v) else None for v in found.alone["board_mm"]],
    )


def _relative(outcome: RigOutcome, first: str, second: str) -> RelativePose:
    pose, covariance = outcome.rig.relative(first, second)
    return RelativePose(first=first, second=second, first_from_second=pose.matrix(), covariance=covariance)
