"""The file that ``axes`` writes with ``--json``."""

from typing import Literal

from pydantic import Field

from stcal.io.json import ByName, Matrix, Part, Pose, ResultFile, Vector3


class ArcRow(Part):
    target: str
    points: int
    radius_mm: float | None
    height_mm: float | None


class OffRow(Part):
    line: int
    error_mm: float


class AxisRow(Part):
    joint: int
    direction: Vector3
    point_mm: Vector3
    world_from_axis: Pose
    covariance: Matrix
    residual_rms_mm: float
    residual_length_mean_mm: float
    residual_length_rms_mm: float
    sigma_mm: float
    dof: int
    span_mm: float | None = None
    span_rad: float | None = None
    arcs: list[ArcRow]
    outliers: list[OffRow]


class DhRow(Part):
    a_mm: float
    alpha_rad: float
    d_mm: float
    theta_rad: float
    beta_rad: float
    a_sigma_mm: float
    alpha_sigma_rad: float
    d_sigma_mm: float
    theta_sigma_rad: float
    beta_sigma_rad: float


class TargetRow(Part):
    xyz_flange_mm: Vector3
    rms_mm: float


class AxisPair(Part):
    joints: list[int]
    angle_rad: float
    angle_sigma_rad: float
    hayati: bool
    distance_mm: float | None
    distance_sigma_mm: float | None
    normal_mm: float | None
    normal_sigma_mm: float | None
    foot_mm: float | None
    foot_sigma_mm: float | None
    refused: str
    leave_one_out_distance_spread_mm: float | None
    leave_one_out_normal_spread_mm: float | None


class LeaveOneOutRows(Part):
    lines: list[int]
    distance_mm: list[list[float | None]]
    normal_mm: list[list[float | None]]


class AxesFile(ResultFile):
    """The result file of ``axes``."""

    format: Literal["stcal axes 1"] = Field(description="the file's form and its version")
    version: str = Field(description="of stcal")
    robot: str = Field(description="text of the robot file")
    axes: list[AxisRow] = Field(
        description="`joint`; `direction` of positive motion and `point_mm` of the axis in the instrument's frame, all "
        "joints at zero; `world_from_axis` 4×4, z along the axis; `covariance` of rx, ry (rad), tx, ty (mm) in that "
        "frame (prismatic: rx, ry) by the noise of its own sweeps; residuals of the points used: `residual_rms_mm` of "
        "a coordinate, `residual_length_mean_mm` and `residual_length_rms_mm` of the vectors (radial, axial); "
        "`sigma_mm` of a coordinate, `dof`; `span_rad` or `span_mm`; `arcs` with `target`, `points`, `radius_mm`, "
        "`height_mm`; `outliers`: rows off their arcs and left out, `line` and `error_mm`"
    )
    covariance: Matrix = Field(
        description="of all axes together, in the order of `axes`, with what each inherits from those before"
    )
    rows: list[DhRow] = Field(
        description="`a_mm`, `alpha_rad`, `d_mm`, `theta_rad`, `beta_rad` and their `a_sigma_mm`, `alpha_sigma_rad`, "
        "`d_sigma_mm`, `theta_sigma_rad`, `beta_sigma_rad`; σ 0: kept from the robot given"
    )
    targets: dict[ByName, TargetRow] = Field(
        description="`xyz_flange_mm`; `rms_mm` of all rows about it: encoders, gears and elasticity are in it"
    )
    pairs: list[AxisPair] = Field(
        description="`joints`; `angle_rad`, `angle_sigma_rad`; `hayati`: within 1° of parallel; `distance_mm`, "
        "`distance_sigma_mm`: along the common normal, of near-parallel axes in the plane of their row; `normal_mm`, "
        "`foot_mm` and their σ `normal_sigma_mm`, `foot_sigma_mm`: the common normal, and its foot along the first "
        'axis from where that was measured; `refused`: why these must not be used, or `""`; '
        "`leave_one_out_distance_spread_mm`, `leave_one_out_normal_spread_mm`"
    )
    leave_one_out: LeaveOneOutRows = Field(
        description="`lines` of the rows left out (with all reflectors), `distance_mm`, `normal_mm` of each pair "
        "without them, signed as `a`"
    )
    notes: list[str] = Field(
        description="rows left out as grossly wrong, reflectors too close to an axis, arcs too short; columns that "
        "were not read, angles by their convention"
    )
