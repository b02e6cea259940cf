"""Result file of a registration: the keys of ``data_layout.md``."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from stcal.geometry.rigid import Affine, Rigid
from stcal.io.files import require_written
from stcal.io.json import Finite, Matrix, Matrix4, Part, Points, Pose, ResultFile, Vector, Vector3, read_result
from stcal.io.table import POSE_MM
from stcal.register.models import Transform, parts
from stcal.register.result import Alternative, ErrorFigures, HeldOutPoints
from stcal.register.workspace import Cubes, Findings
from stcal.register.workspace import Field as ResidualField

NAMES = {
    6: ("rx", "ry", "rz", "x", "y", "z"),
    7: ("rx", "ry", "rz", "x", "y", "z", "scale"),
    12: tuple(f"m{row}{column}" for row in "123" for column in "1234"),
}
UNIT = {"r": "rad", "s": "1", "m": "1"}
DIGITS = 9
"""Decimals of residuals, mm: there may be a million."""
GRID = 7
"""Number of places along each side of the grid of the field."""
MARGIN = 0.25
"""Margin of this grid beyond the box of the points, as a share of its sides."""


def matrix_of(transform: Transform) -> np.ndarray:
    """Returns the transform as a matrix (4, 4)."""
    whole = np.eye(4)
    whole[:3, :3], whole[:3, 3] = parts(transform)
    return whole


class Units(Part):
    b_from_a: Literal["mm"] = "mm"
    residuals: Literal["mm"] = "mm"
    covariance: list[str]


class MeanRmsMax(Part):
    """Mean, RMS and maximum of lengths; null if there are none."""

    mean_mm: Finite
    rms_mm: Finite
    max_mm: Finite


class HeldOutPart(Part):
    folds: int
    inliers: MeanRmsMax
    all: MeanRmsMax
    lines: list[int]
    error_mm: Vector


class OtherTransform(Part):
    b_from_a: Matrix4
    lines: list[int]
    apart_mm: float
    turn_rad: float


class WrongPairRow(Part):
    line: int
    residual_mm: Vector3
    length_mm: float


class LeftOutErrors(Part):
    transform: MeanRmsMax
    transform_and_field: MeanRmsMax
    sigma_ratio: float


class GridErrors(Part):
    xyz_a_mm: Points
    error_mm: Points
    sigma_mm: Vector


class FieldPart(Part):
    seen: bool
    p_value: float
    length_mm: float
    size_mm: float
    noise_mm: float
    points: int
    taken_back_lines: list[int]
    left_out: LeftOutErrors
    grid: GridErrors


class CubeRow(Part):
    side_mm: float
    errors: list[ErrorFigures | None]


class CubesPart(Part):
    middle_a_mm: Vector3
    sides_mm: Vector
    fitted_in: list[CubeRow]


class FiguresRow(Part):
    rows: str
    points: int
    transform: MeanRmsMax
    kinematics: MeanRmsMax


class HeldOutBoth(Part):
    folds: int
    lines: list[int]
    transform_mm: Vector
    kinematics_mm: Vector
    outliers_of_both: list[int]
    figures: list[FiguresRow]


class RobotPart(Part):
    """Base and kinematics, solved in addition to the transform."""

    name: str
    b_from_base: Pose
    rank: int
    parameters: int
    undetermined: list[str]
    sigma_mm: float | None
    a_off_robot_file_mm: float
    better: bool
    held_out: HeldOutBoth


class RegistrationFile(ResultFile):
    """Result file of ``register``; lengths in mm, angles in rad."""

    format: Literal["stcal registration 1"] = Field(description="the file's form and its version")
    pairs: str = Field(description="the file of the points")
    model: str = Field(description="as asked for (`liu2017` is always affine)")
    method: str = Field(description="as asked for")
    b_from_a: Matrix4 = Field(description="row-major: `xyz_b = b_from_a @ xyz_a`")
    covariance: Matrix = Field(
        description="of a left perturbation in the axes of b (rotation about the origin of a, translation of that "
        "origin, then the relative scale of a similarity), or of the rows of the 3×4 matrix of an affine transform"
    )
    covariance_of: list[str] = Field(description="names of its rows: `rx … z`, `scale`, `m11 … m34`")
    units: Units = Field(description="of `b_from_a`, of `residuals`, and of each row of `covariance`")
    scale: float | None = Field(None, description="of a similarity")
    scales: Vector3 | None = Field(None, description="singular values of an affine transform's 3×3 part")
    sigma_mm: float = Field(description="σ per axis of a residual, estimated")
    dof: Finite = Field(
        description="degrees of freedom of the σ that the covariance rests on (null: given)",
    )
    sigma_factor: float | None = Field(description="by how much residuals exceed the σ given with the data")
    scaled: bool = Field(description="whether the covariance rests on the residuals")
    threshold_mm: float | None = Field(description="inliers are nearer than this; null by least squares")
    mean_mm: Finite = Field(description="mean length of the inliers' residuals")
    rms_mm: Finite = Field(description="RMS length")
    max_mm: Finite = Field(description="largest length")
    held_out: HeldOutPart | None = Field(
        description="`folds`; `inliers` and `all` with `mean_mm`, `rms_mm`, `max_mm`; `lines` and `error_mm` of each "
        "point tried"
    )
    ambiguous: bool = Field(description="whether `alternative` is about as good")
    alternative: OtherTransform | None = Field(
        description="another transform that other points agree on: `b_from_a`, `lines`, `apart_mm` (RMS), `turn_rad`"
    )
    notes: list[str] = Field(description="what to look at")
    seed: int = Field(description="of the random samples")
    samples: int = Field(description="how many were drawn, 0: all there are")
    lines: list[int] = Field(description="for each row of the file its line")
    inliers: list[bool] = Field(description="whether it is an inlier")
    residuals: Points = Field(description="b − b_from_a a, frame b")
    outliers: list[WrongPairRow] = Field(description="`line`, `residual_mm`, `length_mm`, the farthest first")
    field: FieldPart | None = Field(
        description="systematic residuals over the workspace, null with too few points: `seen` (chance below 1 %), "
        "`p_value`; `size_mm` RMS length, `length_mm` over which they change, `noise_mm` σ per axis beside them; "
        "`points` used (at most 500), `taken_back_lines` of outliers that follow the field of the others; `left_out`: "
        "errors (`mean_mm`, `rms_mm`, `max_mm`) of points by the `transform`, and by `transform_and_field`, fitted to "
        "the others, and `sigma_ratio`, RMS of the latter over their σ; `grid`: `xyz_a_mm` in frame a (7³ places over "
        "the box of the points and a quarter beyond), `error_mm` to expect of b − b_from_a a there, frame b, and its "
        "`sigma_mm` per axis"
    )
    cubes: CubesPart | None = Field(
        description="null with too few points: `middle_a_mm`, `sides_mm` of cubes along the axes of a; `fitted_in` for "
        "each cube (`side_mm`) the `errors` of the points within the first cube, between the first and the second, …: "
        "`points`, `mean_mm`, `rms_mm`, `max_mm`; those that the fit used are held out in turn"
    )
    robot: RobotPart | None = Field(
        None,
        description="with `--robot`: `name`; `b_from_base` of the identified robot; `rank`, `parameters`, "
        "`undetermined`, `sigma_mm` as of `identify`; `a_off_robot_file_mm`: RMS of a off the robot file's positions "
        "after a rigid fit; `better` than the transform, held out; `held_out`: `folds`, `lines`, `transform_mm`, "
        "`kinematics_mm` of each row, `outliers_of_both` (lines), `figures`: `rows`, `points`, and `transform` and "
        "`kinematics` with `mean_mm`, `rms_mm`, `max_mm`",
    )

    @classmethod
    def of(cls, findings: Findings) -> "RegistrationFile":
        """Returns the file of a registration."""
        result, lines = findings.registration, findings.lines
        names = NAMES[len(result.covariance)]
        same = ("model", "method", "covariance", "sigma_mm", "sigma_factor", "scaled", "threshold_mm", "ambiguous")
        same += ("notes", "seed", "samples")
        return cls.model_validate(
            {name: getattr(result, name) for name in same}
            | {
                "format": "stcal registration 1",
                "pairs": findings.where,
                "b_from_a": matrix_of(result.b_from_a),
                "covariance_of": names,
                "units": {
                    "b_from_a": "mm",
                    "residuals": "mm",
                    "covariance": ["mm" if n in "xyz" or n.endswith("4") else UNIT[n[0]] for n in names],
                },
                **_scale(result.b_from_a),
                "dof": result.redundancy,
                **dict(MeanRmsMax.model_validate(result.inlier_errors)),
                "held_out": result.held_out and _held_out(result.held_out, lines),
                "alternative": result.alternative and _alternative(result.alternative, lines),
                "residuals": np.round(result.residuals, DIGITS),
                "lines": lines,
                "inliers": result.inliers.tolist(),
                "outliers": _outliers(findings),
                "field": findings.field and _field(findings.field, findings),
                "cubes": findings.cubes and _cubes(findings.cubes),
            }
        )


def _scale(transform: Transform) -> dict[str, Any]:
    """Returns the values that a matrix hides: scale of a similarity, shear and scales of an affine transform."""
    if isinstance(transform, Rigid):
        return {}
    if isinstance(transform, Affine):
        return {"scales": np.linalg.svd(transform.linear, compute_uv=False)}
    return {"scale": transform.scale}


def _held_out(held: HeldOutPoints, lines: Sequence[int]) -> HeldOutPart:
    return HeldOutPart(
        folds=held.folds,
        inliers=MeanRmsMax.model_validate(held.of_inliers),
        all=MeanRmsMax.model_validate(held.of_all),
        lines=[lines[i] for i in held.rows],
        error_mm=held.error_mm,
    )


def _alternative(other: Alternative, lines: Sequence[int]) -> OtherTransform:
    return OtherTransform(
        b_from_a=matrix_of(other.b_from_a),
        lines=[lines[i] for i in other.rows],
        apart_mm=other.apart_mm,
        turn_rad=other.turn_rad,
    )


def _outliers(findings: Findings) -> list[WrongPairRow]:
    """Returns the rows of outliers without validation: residuals are finite, and there may be many thousands."""
    rows = findings.registration.outliers
    residuals, lengths = findings.registration.residuals[rows], np.round(findings.length_mm[rows], DIGITS).tolist()
    return [
        WrongPairRow.model_construct(line=findings.lines[row], residual_mm=np.round(residual, DIGITS), length_mm=length)
        for row, residual, length in zip(rows.tolist(), residuals, lengths, strict=True)
    ]


def _field(field: ResidualField, findings: Findings) -> FieldPart:
    grid = grid_of(findings.xyz_a[field.rows])
    error, covariance = field.at(grid)
    plain, corrected = (ErrorFigures.of(lengths) for lengths in (field.plain_mm, field.corrected_mm))
    return FieldPart(
        seen=field.seen,
        p_value=field.p_value,
        length_mm=field.length_mm,
        size_mm=field.size_mm,
        noise_mm=field.noise_mm,
        points=len(field.rows),
        taken_back_lines=[findings.lines[i] for i in field.taken_back],
        left_out=LeftOutErrors(
            transform=MeanRmsMax.model_validate(plain),
            transform_and_field=MeanRmsMax.model_validate(corrected),
            sigma_ratio=field.sigma_ratio,
        ),
        grid=GridErrors(xyz_a_mm=grid, error_mm=error, sigma_mm=np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 3)),
    )


def grid_of(own: np.ndarray) -> np.ndarray:
    """Returns places (g, 3) in and around the points used (n, 3), frame a, mm."""
    low, high = own.min(0), own.max(0)
    side = MARGIN * (high - low)
    axes = [np.linspace(a, b, GRID) if b > a else [a] for a, b in zip(low - side, high + side, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def _cubes(cubes: Cubes) -> CubesPart:
    rows = zip(cubes.sides_mm, cubes.errors, strict=True)
    return CubesPart(
        middle_a_mm=cubes.middle,
        sides_mm=cubes.sides_mm,
        fitted_in=[CubeRow(side_mm=side, errors=list(errors)) for side, errors in rows],
    )


def require_registration_written(path: str | Path, findings: Findings) -> None:
    """Read a written registration again, and require that it maps the points as was reported."""

    def again() -> np.ndarray:
        read = read_result(path, RegistrationFile, "registration file", "report this with its data")
        return findings.xyz_a @ read.b_from_a[:3, :3].T + read.b_from_a[:3, 3]

    require_written(path, again, findings.registration.b_from_a @ findings.xyz_a, POSE_MM, "mm")
