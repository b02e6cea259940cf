"""Result files of ``evaluate``, ``compensate``, ``verify`` and ``design``, written with ``--json``."""

from typing import Annotated, Literal

from pydantic import Field

from stcal.io.json import Part, ResultFile, Vector, Vector3
from stcal.robot.identification.report import FoundLeft, PlacedPart

ByStatus = Annotated[str, "status"]
BySet = Annotated[str, "set"]


class ErrorFigures(Part):
    rows: int
    mean: float
    median: float
    rms: float
    p95: float
    max: float


class EvaluatedRobot(Part):
    name: str
    position_mm: ErrorFigures
    good_mm: ErrorFigures
    orientation_rad: ErrorFigures | None
    placed: list[PlacedPart] = Field(description="as of `identify`: `name`, `pose`, `sigma`; null what is the file's")
    left: list[FoundLeft] | None = Field(
        description="what the residuals go with, the strongest first: `what` in words, `joint` and `turns` (0: none), "
        "`effect_mm`, `effect_rad` (amplitude where it turns, else RMS), `share` of their squares, `p` times the "
        "number of tests, `line` after a jump; null where rows are too few to tell"
    )
    beyond: list[FoundLeft] | None = Field(
        description="the same (`what`, `joint`, `turns`, `effect_mm`, `effect_rad`, `share`, `p`, `line`) of what "
        "parameters identified from these rows would leave"
    )
    residuals: list[Vector] = Field(
        description="of each row: measured minus modelled position, mm, in the axes of the robot's base; or of the "
        "distance"
    )


class RobotDifference(Part):
    better: str
    worse: str
    mm: float
    sigma_mm: float
    p: float


class EvaluationFile(ResultFile):
    """Result file of ``evaluate``."""

    format: Literal["stcal evaluation 1"] = Field(description="the file's form and its version")
    refit: str = Field(description="what was fitted: `none`, `base`, `tool` or `base-tool`")
    observed: str = Field(description="positions or distances")
    lines: list[int] = Field(description="of the data file, of each row")
    wrong: list[int] = Field(
        description="lines that no robot explains (wrong, or something all models lack); nothing was fitted to them"
    )
    best: str | None = Field(description="the robot that is better than all others by more than chance; null: none is")
    robots: list[EvaluatedRobot] = Field(
        description="`name`, and of their errors `position_mm` (of distances for those) of all rows, `good_mm` without "
        "the wrong ones, `orientation_rad` where measured: `rows`, `mean`, `median`, `rms`, `p95`, `max`"
    )
    differences: list[RobotDifference] = Field(
        description="`mm`: mean error of the `worse` robot less that of the `better` on the same rows without the "
        "wrong ones, its `sigma_mm`, and `p` times the number of comparisons"
    )


class CompensatedPose(Part):
    line: int
    target: str
    commanded_mm: Vector3
    commanded_quaternion: Vector
    status: str
    joints: dict[str, float] | None
    error_mm: float
    error_rad: float
    payload_kg: float | None = None
    nominal_status: str = ""
    nominal_joints: dict[str, float] | None = None
    nominal_error_mm: float | None = None
    nominal_error_rad: float | None = None


class CompensationFile(ResultFile):
    """Result file of ``compensate``."""

    format: Literal["stcal compensation 1"] = Field(description="the file's form and its version")
    robot: str = Field(description="name")
    counts: dict[ByStatus, int] = Field(description="number of poses")
    poses: list[CompensatedPose] = Field(
        description="the columns above: `line`, `target`, `commanded_mm`, `commanded_quaternion` (w first), `status`, "
        "`joints` (by column name, null where not reached), `error_mm`, `error_rad`, `payload_kg` (null: as the robot "
        "file has it), and with `--nominal` "
        "`nominal_status`, `nominal_joints`, `nominal_error_mm`, `nominal_error_rad`"
    )
    notes: list[str] = Field(
        description="columns that were not read, angles by their convention, and the warnings: doubts of targets and "
        "robots, and rows that are not simply reached"
    )


class ErrorReduction(Part):
    mean_percent: float | None
    std_percent: float | None
    max_percent: float | None
    all_pairs_rms_percent: float | None


class MeasuredSet(Part):
    set: str
    mean_mm: float
    std_mm: float
    max_mm: float
    all_pairs_rms_mm: float
    scale: float
    reduced: ErrorReduction | None = Field(
        description="each figure's reduction from the first set: `mean_percent`, `std_percent`, `max_percent`, "
        "`all_pairs_rms_percent`; null for the first"
    )
    error_mm: Vector


class VerificationFile(ResultFile):
    """Result file of ``verify``."""

    format: Literal["stcal verification 1"] = Field(description="the file's form and its version")
    poses: list[str] = Field(description="names, the first being the one that distances start from")
    distance_mm: Vector = Field(description="commanded distances of the others from it")
    sets: list[MeasuredSet] = Field(
        description="`set`; `mean_mm`, `std_mm` (sample), `max_mm` of the absolute errors of those distances, "
        "`error_mm` measured minus commanded; `all_pairs_rms_mm` of the distance errors of all pairs; `scale` measured "
        "over commanded distances of all pairs by least squares; `reduced`"
    )
    missing: dict[BySet, list[str]] = Field(description="poses that a set lacks")
    warnings: list[str] = Field(description="what to look at")
    notes: list[str] = Field(description="columns that were not read")


class DesignFile(ResultFile):
    """Result file of ``design``."""

    format: Literal["stcal pose design 1"] = Field(description="the file's form and its version")
    count: int = Field(description="number of poses")
    parameters: int = Field(description="of the robot and its tool")
    seen: int = Field(description="how many combinations of them any pose shows; the indices are of these")
    exchanges: int = Field(description="single poses exchanged after the greedy choice")
    chosen: dict[str, float] = Field(
        description="`O1` … `O5` of the chosen poses; defined and in units as `identify --json` has them"
    )
    random_median: dict[str, float] = Field(description="medians of `random`")
    random: list[dict[str, float]] = Field(description="`O1` … `O5` of 20 random sets of as many poses")
    predicted_sigma_mm: float = Field(
        description="σ per axis of the position that the identified robot predicts, RMS over random poses"
    )
    random_predicted_sigma_mm: float | None = Field(
        description="the same, median of the random sets (null where they leave parameters open)"
    )
