"""The file that ``identify`` writes with ``--json``."""

from typing import Literal

from pydantic import Field

from stcal.io.json import Matrix, Part, ResultFile


class Errors(Part):
    mean_mm: float
    rms_mm: float
    max_mm: float


class BothErrors(Part):
    nominal: Errors
    identified: Errors


class PredictedErrors(Part):
    same_rows: Errors
    ranges: Errors


class HeldOutErrors(Part):
    folds: int
    repeats: int
    mean_mm: float
    rms_mm: float
    max_mm: float
    mean_deg: float | None


class Element(Part):
    nominal: float
    identified: float
    sigma: float


class FixedDimension(Part):
    joint: int
    dimension: str
    reason: str | None


class ModelsCompared(Part):
    rigid_mm: float
    elastic_mm: float
    gain_mm: float
    sigma_mm: float


class ElasticJoint(Part):
    axis_rad_per_Nm: float
    across_rad_per_Nm: float
    moment_Nm: list[float]
    periodic_rad: list[float]
    hysteresis_rad: float


class ElasticityFound(Part):
    gravity: list[float]
    joints: list[ElasticJoint]
    sigma: list[ElasticJoint]


class RowErrors(Part):
    line: int
    error_mm: float
    weight: float


class OutlierMeasurementRow(Part):
    line: int
    place: str
    error_mm: float


class PlacedPart(Part):
    name: str
    pose: Matrix
    sigma: list[float | None] | None


class FoundLeft(Part):
    what: str
    joint: int
    turns: int
    effect_mm: float
    effect_rad: float
    share: float
    p: float


class IdentifiedFile(ResultFile):
    """The result file of ``identify``."""

    format: Literal["stcal identified 1"] = Field(description="the file's form and its version")
    robot: str = Field(description="name")
    observed: str = Field(description="kind of observation used")
    observations: int = Field(description="how many")
    rank: int = Field(description="parameters determined by the data used")
    parameters: int = Field(description="of how many")
    ranks: dict[str, int] = Field(description="`rank` by kind of observation at the same joint values")
    undetermined: list[str] = Field(
        description="directions kept nominal (`--partial`), each once, by its parameters: `J2 y (with tool z and J1 x)`"
    )
    notes: list[str] = Field(
        description="rows left out, columns that were not read, angles by their convention; what is to be known of the "
        "rows found"
    )
    fixed: list[FixedDimension] = Field(
        description="dimensions that were not adjusted (`--adjust`, or `fixed` in the robot file): `joint`, "
        "`dimension`, and the file's `reason`"
    )
    all_held_out_rms_mm: float | None = Field(
        description="RMS error of held-out rows were all adjusted; null where all are, or rows are too few"
    )
    stations: dict[str, Matrix] = Field(
        description="first_from_station by name, 4 × 4, mm: column `station`; the base is in the frame of the first, "
        "that of most rows; one without a name where there is no column"
    )
    model: Literal["rigid", "elastic"] = Field(description="that was identified")
    models: ModelsCompared | None = Field(
        description="where both were tried: RMS errors of held-out rows by both, `rigid_mm` and `elastic_mm`; mean by "
        "which elastic errs less, `gain_mm`, and its standard error `sigma_mm`"
    )
    elasticity: ElasticityFound | None = Field(
        description="of the elastic model: `gravity` in the base, and for each of the `joints` what stands in the "
        "robot file, `axis_rad_per_Nm`, `across_rad_per_Nm`, `moment_Nm`, `periodic_rad`, `hysteresis_rad`; `sigma` of "
        "the same"
    )
    sigma_mm: float | None = Field(
        description="of one coordinate, given or estimated (null where each row has its own)"
    )
    sigma_rad: float | None = Field(description="the same of one component of a rotation")
    sigma0: float = Field(description="σ₀ by which what was given is multiplied, else 1")
    deviations: dict[str, float | None] = Field(
        description="`length_mm`, `twist_rad`, `zero_rad`: σ of this robot's dimensions about nominal, as estimated; "
        "`axis_rad`, `across_rad`: of what links give way by about their joints' axes and across them, at the torque "
        "that is usual for an arm of this length; `periodic_rad`: of what gears err, `hysteresis_rad`: of "
        "what they do by where they came from; null where it has none"
    )
    errors: BothErrors = Field(
        description="`nominal` (with base and tools fitted) and `identified`: `mean_mm`, `rms_mm`, `max_mm`"
    )
    held_out: HeldOutErrors | None = Field(
        description="`folds`, `repeats`, `mean_mm`, `rms_mm`, `max_mm`, `mean_deg`; null where rows are too few"
    )
    predicted: PredictedErrors | None = Field(
        description="σ of the tool's position by the covariance (root of the summed variances of x, y, z): at the "
        "`same_rows`, and at random joint values over their `ranges`, there with what residuals go with (`left`); "
        "`mean_mm`, `rms_mm`, `max_mm` each; null of distances"
    )
    observability: dict[str, float] = Field(
        description="`O1` … `O5` (Borm & Menq; Driels & Pathre; Nahvi, Hollerbach & Hayward; Nahvi & Hollerbach; Sun & "
        "Hollerbach) of the Jacobian over σ, all parameters in mm, an angle being the arc that it makes at the arm's "
        "whole length; 1/mm, `O2` without unit; 1/`O3` is the σ in mm of the combination of parameters that is seen "
        "worst"
    )
    rows: list[dict[str, Element]] = Field(
        description="for each joint `a`, `d` (mm), `alpha`, `theta`, `beta` (rad): `nominal`, `identified`, `sigma`"
    )
    placed: list[PlacedPart] = Field(
        description="base and tools: `name`, `pose` (4×4, mm), `sigma` of rotation (rad, about the outer frame's axes) "
        "and translation (mm), as far as it is determined"
    )
    parameter_names: list[str] = Field(
        description="small motions of each joint's frame (`J2 rx`: rad, `J2 x`: mm) and of the tools"
    )
    covariance: Matrix = Field(description="of these; of distances singular: 0 along what they never show")
    residuals: list[RowErrors] = Field(description="`line`, `error_mm`, `weight`")
    left: list[FoundLeft] | None = Field(
        description="what the residuals go with, the strongest first: `what` in words, `joint` and `turns` (0: none), "
        "`effect_mm`, `effect_rad` (amplitude where it turns, else RMS), `share` of their squares, `p` times the "
        "number of tests; null where rows are too few to tell"
    )
    outliers: list[OutlierMeasurementRow] = Field(
        description="those of less than half weight: `line`, `place`, `error_mm`"
    )
