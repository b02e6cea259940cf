"""Result file of a registration: the keys of ``data_layout.md``, which are those of its result."""

from typing import Annotated, Literal

import numpy as np
from pydantic import BeforeValidator, Field

from stcal.geometry.rigid import Affine, Rigid, Similarity
from stcal.io.json import Finite, Matrix, Matrix4, Part, Points, Pose, ResultFile, Vector, Vector3
from stcal.register.registered import ErrorFigures

DIGITS = 9
"""Decimals of residuals, mm: there may be a million."""
Rows = Annotated[list[int], BeforeValidator(lambda rows: np.asarray(rows, int).tolist())]
"""Rows of the file of points, from 0."""
FIGURES = "`points`, `mean_mm`, `rms_mm`, `max_mm`"
Marks = Annotated[list[bool], BeforeValidator(lambda marks: np.asarray(marks, bool).tolist())]
Rounded = Annotated[Points, BeforeValidator(lambda values: np.round(values, DIGITS))]
TransformMatrix = Annotated[
    Matrix4, BeforeValidator(lambda given: given.matrix() if isinstance(given, Rigid | Similarity | Affine) else given)
]


class HeldOutPart(Part):
    folds: int
    rows: Rows
    error_mm: Vector
    of_inliers: ErrorFigures
    of_all: ErrorFigures


class AlternativePart(Part):
    b_from_a: TransformMatrix
    rows: Rows
    apart_mm: float
    turn_rad: float


class FieldGrid(Part):
    xyz_a_mm: Points
    error_mm: Points
    sigma_mm: Vector


class FieldPart(Part):
    seen: bool
    p_value: float
    length_mm: float
    size_mm: float
    noise_mm: float
    rows: Rows
    taken_back: Rows
    plain: ErrorFigures
    corrected: ErrorFigures
    sigma_ratio: float
    grid: FieldGrid


class CubesPart(Part):
    middle: Vector3
    sides_mm: Vector
    errors: list[list[ErrorFigures | None]]


class WeightingPart(Part):
    sigma_mm: float | None


class IdentifiedPart(Part):
    rank: int
    names: list[str]
    undetermined: list[str]
    weighting: WeightingPart


class RobotPart(Part):
    """Base and kinematics, solved in addition to the transform."""

    b_from_base: Pose
    identified: IdentifiedPart
    off_mm: float
    better: bool
    folds: int
    rows: Rows
    transform_mm: Vector
    kinematics_mm: Vector
    wild: Marks
    transform: ErrorFigures
    kinematics: ErrorFigures


class RegistrationFile(ResultFile):
    """Result file of ``register``; lengths in mm, angles in rad; rows are those of the file of points, from 0."""

    format: Literal["stcal registration 1"] = Field(description="the file's form and its version")
    pairs: str = Field(description="the file of the points")
    model: str = Field(description="as asked for (`liu2017` is always affine)")
    method: str = Field(description="as asked for")
    b_from_a: TransformMatrix = Field(description="row-major: `xyz_b = b_from_a @ xyz_a`")
    covariance: Matrix = Field(
        description="of a left perturbation in the axes of b (rotation about the origin of a, translation of that "
        "origin, then the relative scale of a similarity), or of the rows of the 3×4 matrix of an affine transform"
    )
    covariance_of: list[str] = Field(description="names of its rows: `rx_rad … z_mm`, `scale`, `m11 … m34_mm`")
    scales: Vector3 = Field(description="ratios of lengths in b to those in a, along three axes")
    sigma_mm: float = Field(description="σ per axis of a residual, estimated")
    redundancy: Finite = Field(
        description="degrees of freedom of the σ that the covariance rests on (null: given)",
    )
    sigma_factor: float | None = Field(description="by how much residuals exceed the σ given with the data")
    scaled: bool = Field(description="whether the covariance rests on the residuals")
    threshold_mm: float | None = Field(description="inliers are nearer than this; null by least squares")
    inlier_errors: ErrorFigures = Field(description=f"lengths of the inliers' residuals: {FIGURES}")
    held_out: HeldOutPart | None = Field(
        description=f"`folds`; `rows` and `error_mm` of each point tried; {FIGURES} `of_inliers` and `of_all`"
    )
    ambiguous: bool = Field(description="whether `alternative` is about as good")
    alternative: AlternativePart | None = Field(
        description="another transform that other points agree on: `b_from_a`, `rows`, `apart_mm` (RMS), `turn_rad`"
    )
    notes: list[str] = Field(description="what to look at")
    seed: int = Field(description="of the random samples")
    samples: int = Field(description="how many were drawn, 0: all there are")
    lines: Rows = Field(description="for each row of the file its line")
    inliers: Marks = Field(description="whether it is an inlier")
    residuals: Rounded = Field(description="b − b_from_a a, frame b")
    outliers: Rows = Field(description="rows of the outliers, the farthest first")
    field: FieldPart | None = Field(
        description="systematic residuals over the workspace, null with too few points: `seen` (chance below 1 %), "
        "`p_value`; `size_mm` RMS length, `length_mm` over which they change, `noise_mm` σ per axis beside them; "
        "`rows` used (at most 500), `taken_back` rows of outliers that follow the field of the others; "
        f"{FIGURES} of errors of points by the transform, `plain`, and by transform and field, `corrected`, "
        "fitted to the others, and "
        "`sigma_ratio`, RMS of the latter over their σ; `grid`: `xyz_a_mm` in frame a (7³ places over the box of the "
        "points and a quarter beyond), `error_mm` to expect of b − b_from_a a there, frame b, and its `sigma_mm` per "
        "axis"
    )
    cubes: CubesPart | None = Field(
        description="null with too few points: `middle` in a and `sides_mm` of cubes along the axes of a; in row i and "
        f"column j of `errors`: {FIGURES} of the fit in cube i at the points of cube j that are not in cube j − 1; "
        "points that the fit used are held out in turn"
    )
    robot: RobotPart | None = Field(
        None,
        description="with `--robot`: `b_from_base` of the identified robot; `identified`: `rank`, `names`, "
        "`undetermined`, and `weighting` with `sigma_mm`, as of `identify`; `off_mm`: RMS of a off the robot file's "
        "positions after a rigid fit; `better` than the transform, held out; `folds`, `rows`, `transform_mm`, "
        "`kinematics_mm` of each row held out, `wild`: outliers of both; without these, errors of `transform` and "
        f"`kinematics`: {FIGURES}",
    )
