"""Options and result of an identification."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import AliasPath, BeforeValidator, Field
from scipy.stats import t as t_distribution

from stcal.errors import InputError
from stcal.geometry.arrays import Array, Brief, freeze, require_fields
from stcal.io.files import require_written
from stcal.io.json import ByName, Finite, Matrix, Part, Pose, ResultFile, Vector
from stcal.robot.identification.adjustment import Kind, Observed, State, Weighting, position_errors, residuals
from stcal.robot.identification.observability import ObservabilityIndices, Predicted
from stcal.robot.identification.prior import Adjusted, Placed, dh_values
from stcal.robot.identification.problem import ArmSolution
from stcal.robot.identification.unexplained import Finding
from stcal.robot.kinematics.robot_file import WRITTEN_MM, RobotText, load_robot
from stcal.robot.kinematics.robot_model import Elasticity, Robot

Model = Literal["rigid", "elastic", "auto"]
LEAST_FOLDS = 2
BEYOND_CHANCE = 2.5
"""Standard errors by which one model must predict better; rows of one fold share the error of their solution."""
OUTLIER_WEIGHT = 0.5
"""Weight below which an observation is named as an outlier: its residual is over twice Huber's limit."""
NO_GAIN = 0.95
"""Errors of held-out rows over those of the nominal robot from which on nothing was gained."""
LEAST_SCALE, BY_CHANCE, LEAST_LENGTHS = 2e-4, 1e-3, 4
"""Common relative change of all lengths, its probability by chance, and number of adjusted lengths for a note."""
FAR_FROM_STATED = 3.0
"""Factor between the σ that residuals show and those that are stated from which on it is told."""
MEDIAN_OF_NORMAL = 0.6745
"""Median of the size of a normal error of σ 1."""


@dataclass(frozen=True, slots=True)
class IdentifyOptions:
    """Options of :func:`identify`.

    Parameters
    ----------
    observe : kind of observation to use; if not given, the richest one that was measured.
    sigma_mm, sigma_rad : σ of one coordinate of a position, mm, and of an orientation, rad; estimated where not given.
    robust : whether outliers weigh less (Huber), and gross errors nothing at all.
    folds : number of folds of the cross-validation; 0 for none.
    repeats : number of divisions into folds, in each of which every row is held out once; 5 for few rows, 1 for many,
        if not given.
    seed : seed of the divisions.
    partial : keep nominal what the data do not determine, instead of refusing the data.
    adjust : dimensions to adjust beside base and tools: all, all but the joints' zero positions, zero positions alone,
        or none. Dimensions that are fixed in the robot file stay in any case.
    model : ``elastic``: links bend under gravity and gears have periodic errors. ``auto`` takes the elastic model if it
        predicts held-out rows better by more than chance, else the rigid one.

    Raises
    ------
    InputError : a choice that does not exist; a σ that is not positive, or beyond 1 m or 1 rad; ``auto`` with fewer
        than two folds.
    """

    observe: Kind | None = None
    sigma_mm: float | None = None
    sigma_rad: float | None = None
    robust: bool = True
    folds: int = 6
    repeats: int | None = None
    seed: int = 0
    partial: bool = False
    model: Model = "rigid"
    adjust: Adjusted = "all"

    def __post_init__(self):
        require_fields(self, "identification", folds=0, repeats=1, seed=0)
        for name, value, most in (("sigma_mm", self.sigma_mm, 1e3), ("sigma_rad", self.sigma_rad, 1.0)):
            if value is not None and not 1e-12 <= value <= most:
                raise InputError("E-OPTION-RANGE", f"{name} is {value:g}; a number above 0, up to {most:g}, needed")
        if self.model == "auto" and self.folds < LEAST_FOLDS:
            raise InputError(
                "E-OPTION-RANGE",
                f"folds is {self.folds}: models are compared on held-out rows; {LEAST_FOLDS} or more folds needed",
            )


@dataclass(frozen=True, slots=True)
class Figures:
    """Summary of the errors of a number of rows; mm, or rad for orientations."""

    rows: int
    mean: float
    median: float
    rms: float
    p95: float
    max: float

    @classmethod
    def of(cls, errors: np.ndarray) -> "Figures":
        """Returns the summary of the errors that are finite."""
        errors = errors[np.isfinite(errors)]
        rms, p95 = np.sqrt((errors**2).mean()), np.percentile(errors, 95)
        return cls(len(errors), *(float(v) for v in (errors.mean(), np.median(errors), rms, p95, errors.max())))


@dataclass(frozen=True, slots=True, eq=False)
class HeldOutRows:
    """Errors of rows that were held out of a fit. ``position_mm``, ``rotation_rad`` : (repeats, r), nan where there is
    no error, such as for rotations where positions were measured."""

    folds: int
    position_mm: np.ndarray
    rotation_rad: np.ndarray


@dataclass(frozen=True, slots=True)
class Gain:
    """Gain of the elastic model over the rigid one in prediction: RMS errors of held-out rows by both, and the mean of
    the rows' differences with its standard error, mm."""

    rigid_mm: float
    elastic_mm: float
    gain_mm: float
    sigma_mm: float

    @classmethod
    def between(cls, rigid: HeldOutRows, elastic: HeldOutRows) -> "Gain":
        """Returns the gain from errors of the same rows by both models."""
        errors = [np.nanmean(each.position_mm, axis=0) for each in (rigid, elastic)]
        differences = errors[0] - errors[1]
        differences = differences[np.isfinite(differences)]
        before, after = (Figures.of(each.position_mm).rms for each in (rigid, elastic))
        return cls(before, after, float(differences.mean()), float(differences.std(ddof=1) / np.sqrt(len(differences))))

    @property
    def beyond_chance(self) -> bool:
        """True if the gain is larger than chance explains."""
        return self.gain_mm > BEYOND_CHANCE * self.sigma_mm


@dataclass(frozen=True, slots=True, eq=False, kw_only=True, repr=False)
class Identified(Brief):
    """The identified robot, and how far to trust it; r observations, k parameters, n joints.

    Parameters
    ----------
    robot, nominal : the robot with its base in the instrument's frame, tools by target; and as drawn. mm, rad.
    seen : the r observations.
    adjustment : solution, weights and σ; what is used often is a property, too.
    names : names (k,) of the parameters, small motions of each joint's frame and of the tools (J2 ry: axis of joint 2
        about its y, rad; tool x: mm).
    covariance : (k, k) array: covariance of the parameters, rad and mm.
    rank : number of parameters that the data used determine.
    ranks : number of parameters that these joint values determine, by kind of observation.
    undetermined : directions that were kept nominal, each named by its parameters.
    nominal_mm : (r,) array: errors with nominal axes, base and tools fitted.
    held_out : errors of the cross-validation.
    predicted : σ of the tool's position by the covariance; None for distances.
    placed : base and tools of the robot, with σ.
    left : effects found in the residuals; None if there are too few observations for a test.
    dh_sigma : (n, 5) array: σ of a, alpha, d, theta, beta; mm, rad.
    observability : indices of the determined parameters.
    deviations : σ of this robot's dimensions about nominal, as the data show them, by name; mm, rad. For elasticity: σ
        of the deflection of links at the usual torque, of gears and of hysteresis, rad.
    elasticity_sigma : σ of the robot's elasticity where it was adjusted.
    gain : comparison of both models, where both were tried.
    all_held_out : errors of the cross-validation with all dimensions adjusted, where some are kept.
    notes : rows left out, and remarks on the result.
    """

    format: ClassVar = "stcal identified 1"
    robot: Robot
    nominal: Robot
    seen: Observed
    adjustment: ArmSolution
    names: tuple[str, ...]
    covariance: Array
    rank: int
    ranks: dict[str, int]
    undetermined: tuple[str, ...]
    nominal_mm: np.ndarray
    held_out: HeldOutRows | None
    predicted: Predicted | None
    placed: tuple[Placed, ...]
    left: tuple[Finding, ...] | None
    dh_sigma: np.ndarray
    observability: ObservabilityIndices
    deviations: dict[str, float | None]
    elasticity_sigma: Elasticity | None
    gain: Gain | None
    all_held_out: HeldOutRows | None
    notes: tuple[str, ...]

    def __post_init__(self):
        k = len(self.names)
        freeze(self, "covariance", (k, k), "covariance")

    @property
    def model(self) -> Model:
        """The model that was adjusted."""
        return "elastic" if self.state.elastic else "rigid"

    @property
    def state(self) -> State:
        """Chain and tools as identified."""
        return self.adjustment.state

    @property
    def weighting(self) -> Weighting:
        """σ of the observations."""
        return self.adjustment.problem.weighting

    @property
    def sigma0(self) -> float:
        """Factor by which the given σ have to be multiplied; 1 where they were estimated."""
        return self.weighting.factor

    @property
    def weights(self) -> np.ndarray:
        """Huber weights (r,)."""
        return self.adjustment.weights

    @property
    def residuals(self) -> np.ndarray:
        """Residuals (r, 6), (r, 3) or (r, 1), measured minus modelled, rad and mm, in the instrument's axes."""
        return self.adjustment.residuals

    @property
    def fitted_mm(self) -> np.ndarray:
        """Errors (r,) with identified axes, mm."""
        return position_errors(self.residuals)

    def outliers(self) -> list[tuple[int, float]]:
        """Returns (row of the observations, error in mm) of each observation that weighs less than half."""
        return [(int(i), float(self.fitted_mm[i])) for i in np.flatnonzero(self.weights < OUTLIER_WEIGHT)]

    @property
    def errors(self) -> dict[str, Figures]:
        """Position errors, and their predicted σ, mm, by the keys of :data:`ERRORS`."""
        held_out, every, predicted = self.held_out, self.all_held_out, self.predicted
        found = {
            "nominal": self.nominal_mm,
            "identified": self.fitted_mm,
            "held_out": None if held_out is None else held_out.position_mm,
            "all_held_out": None if every is None else every.position_mm,
            "sigma": None if predicted is None else predicted.here_mm,
            "sigma_over_ranges": None if predicted is None else predicted.ranges_mm,
        }
        return {key: Figures.of(values) for key, values in found.items() if values is not None}

    @property
    def rows(self) -> np.ndarray:
        """Rows (n, 5) a, alpha, d, theta, beta; mm, rad."""
        return dh_values(self.robot)

    @property
    def nominal_rows(self) -> np.ndarray:
        """The same of the nominal robot."""
        return dh_values(self.nominal)


ERRORS = {
    "nominal": "nominal axes, base and tool fitted",
    "identified": "identified, the same rows",
    "held_out": "held out",
    "all_held_out": "held out, were all dimensions adjusted",
    "sigma": "σ of the position, the same rows",
    "sigma_over_ranges": "σ of the position, over the joints' ranges",
}


class ElasticityValues(Part):
    compliance: Matrix
    moment: Matrix
    periodic: Matrix
    hysteresis: Vector


class PlacedPose(Part):
    name: str
    pose: Pose
    sigma: Annotated[list[Finite], BeforeValidator(list)]


class IdentifiedFile(ResultFile):
    """The result file of ``identify``."""

    format: Literal["stcal identified 1"] = Field(description="the file's form and its version")
    robot: RobotText = Field(description="text of the robot file")
    observed: str = Field(validation_alias=AliasPath("seen", "used"), description="kind of observation used")
    rank: int = Field(description="parameters determined by the data used")
    ranks: dict[str, int] = Field(description="`rank` by kind of observation at the same joint values")
    undetermined: list[str] = Field(description="directions kept nominal (`--partial`): `J2 y (with tool z and J1 x)`")
    notes: list[str] = Field(description="rows left out, columns not read, and remarks on the result")
    model: Literal["rigid", "elastic"] = Field(description="that was identified")
    gain: Gain | None = Field(
        description="where both were tried: RMS errors of held-out rows, `rigid_mm` and `elastic_mm`; mean by which "
        "elastic errs less, `gain_mm`, and its standard error `sigma_mm`"
    )
    elasticity_sigma: ElasticityValues | None = Field(
        description="σ of the elasticity, a row for each joint: `compliance` (rad/Nm) about its axis and across it, "
        "`moment` (Nm), `periodic`, `hysteresis` (rad); null of the rigid model"
    )
    weighting: Weighting = Field(
        description="σ of a coordinate, `sigma_mm`, and of a rotation, `sigma_rad`, or `given` by covariances; "
        "`factor`: σ₀ by which these are multiplied; `estimated`: which of them"
    )
    deviations: dict[str, float | None] = Field(
        description="σ of this robot about nominal: `length_mm`, `twist_rad`, `zero_rad`, links by gravity `axis_rad`, "
        "`across_rad`, gears `periodic_rad`, `hysteresis_rad`; null where it has none"
    )
    errors: dict[ByName, Figures] = Field(
        description="position errors, mm: `rows`, `mean`, `median`, `rms`, `p95`, `max` of `nominal` (base and tools "
        "fitted), `identified`, `held_out`, `all_held_out` (were all dimensions adjusted); and of the predicted "
        "`sigma` of the tool's position, and `sigma_over_ranges` of the joints, with what is in `left`"
    )
    observability: ObservabilityIndices = Field(
        description="`o1` … `o5` (Borm & Menq; `o2` Driels & Pathre; `o3` Nahvi, Hollerbach & Hayward; `o4` Nahvi & "
        "Hollerbach; `o5` Sun & Hollerbach) of the Jacobian over σ, an angle being its arc at the arm's whole length; "
        "1/mm, `o2` without unit"
    )
    rows: Matrix = Field(description="`a` (mm), `alpha` (rad), `d`, `theta`, `beta` of each joint")
    dh_sigma: Matrix = Field(description="their σ; 0: not adjusted")
    placed: list[PlacedPose] = Field(
        description="base in the instrument's frame, tools in the flange's: `name`, `pose` (mm), `sigma` of rotation "
        "(rad, about the outer frame's axes) and translation (mm); null where not determined"
    )
    names: list[str] = Field(
        description="of parameters, small motions of each joint's frame (`J2 rx`: rad, `J2 x`: mm) and of the tools"
    )
    covariance: Matrix = Field(description="of these; of distances singular: 0 along what they never show")
    lines: list[int] = Field(validation_alias=AliasPath("seen", "lines"), description="of the observations in the file")
    fitted_mm: Vector = Field(description="their errors")
    weights: Vector = Field(description="their weights; below a half: outliers")
    left: list[Finding] | None = Field(
        description="what the residuals go with: `what` in words, `joint` and `turns` (0: none), `effect_mm`, "
        "`effect_rad` (amplitude where it turns, else RMS), `share` of their squares, `p` times the number of tests, "
        "`line` of the first row after a jump, `advice`; null where rows are too few to tell"
    )


OTHER_TYPE_MM, SHOWN_LENGTHS = 5.0, 4
"""Change of a length beyond what workshops make of one type of arm, and most lengths to be shown."""


def misgivings(result: Identified) -> tuple[str, ...]:
    """Returns notes on contradicted σ, no gain over the nominal robot, or lengths that differ by one factor."""
    notes = [] if (stated := _stated_otherwise(result)) is None else [stated]
    if result.held_out is not None:
        before, after = (result.errors[key].rms for key in ("nominal", "held_out"))
        if after > NO_GAIN * before > 0:
            notes.append(
                f"no gain: rows held out err by {after:.3g} mm (RMS) with the identified robot and by {before:.3g} mm "
                "with the nominal one, base and tool fitted: what errs is not the robot's dimensions; check joint "
                "values and measurements, rounding too"
            )
    lengths = result.nominal_rows[:, [0, 2]].ravel()
    changes = result.rows[:, [0, 2]].ravel() - lengths
    square, free = float(lengths @ lengths), len(lengths) - 1
    if square > 0 and (changes != 0).sum() >= LEAST_LENGTHS:
        scale = float(lengths @ changes) / square
        rest = float(np.linalg.norm(changes - scale * lengths)) / np.sqrt(free * square)
        if abs(scale) > LEAST_SCALE and 2 * t_distribution.sf(abs(scale) / max(rest, 1e-15), free) < BY_CHANCE:
            notes.append(
                f"all lengths of the robot are {1 + scale:.5f} ± {rest:.1g} times nominal: rather than of the arm, "
                "this is the scale of the instrument, or of a board or target by which positions were measured; check "
                "a known length"
            )
            return tuple(notes)
    far = np.flatnonzero(np.abs(changes) > OTHER_TYPE_MM)
    if len(far):
        which = ", ".join(f"{'ad'[i % 2]} of joint {i // 2 + 1} by {changes[i]:+.1f} mm" for i in far[:SHOWN_LENGTHS])
        notes.append(
            f"lengths are not those of the robot file: {which}; arms of one type differ by less than 2 mm: check that "
            "the file is of this type, and its units"
        )
    return tuple(notes)


def _stated_otherwise(result: Identified) -> str | None:
    """Returns a note on stated σ that are far from what the residuals show, None where they are not."""
    sigma, kind = result.weighting, result.seen.kind
    few = np.count_nonzero(result.weights < OUTLIER_WEIGHT)
    remedy = "check --sigma-mm and --sigma-rad, or covariances, and their units; or leave them out, to have σ estimated"
    if 2 * few > len(result.weights):
        return (
            f"{few} of {len(result.weights)} rows are outliers by the σ that are stated, which must be far too small: "
            f"{remedy}"
        )
    ratios = {"residuals": sigma.factor}
    if not sigma.given:
        medians = replace(sigma, estimated=()).medians(sigma.factor * sigma.whiten(result.residuals, result.seen))
        names = {"rad": "residuals of orientations", "mm": f"residuals of {kind}s".replace("poses", "positions")}
        ratios = {names[n]: v / MEDIAN_OF_NORMAL for n, v in medians.items() if n not in sigma.estimated}
    far = {what: ratio for what, ratio in ratios.items() if not 1 / FAR_FROM_STATED < ratio < FAR_FROM_STATED}
    what = max(far, key=lambda each: abs(np.log(max(far[each], 1e-12))), default="")
    return f"{what} are {far[what]:.2g} times the σ that are stated: {remedy}" if far else None


def require_identified_written(path: Path | str, result: Identified) -> None:
    """Read a written robot file again, and require that it predicts the reported residuals; raises ConvergenceError."""

    def again() -> np.ndarray:
        robot = load_robot(path)
        tools = {name: robot.tool(name) for name in result.state.tools}
        return residuals(State(robot.chain(), tools, stations=result.state.stations), result.seen)

    require_written(path, again, result.residuals, WRITTEN_MM, "mm or rad")
