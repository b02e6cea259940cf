"""Options and result of an identification, its file, and the remarks on it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import AliasPath, Field
from scipy.special import stdtr

from stcal.errors import InputError
from stcal.geometry.arrays import Array, Brief, freeze, require_fields, rms
from stcal.geometry.rigid import Rigid
from stcal.io.files import require_written
from stcal.io.json import ByName, Matrix, Named, ResultFile, Vector
from stcal.robot.identification.adjustment import (
    WIDTH,
    Kind,
    ObservabilityIndices,
    Observed,
    State,
    Weighting,
    over_ranges,
    position_errors,
    sigma_of,
)
from stcal.robot.identification.prior import Adjusted, PlacedFrame, dh_values
from stcal.robot.identification.problem import GROSS, ArmSolution
from stcal.robot.identification.unexplained import Effect
from stcal.robot.kinematics.robot_file import WRITTEN_MM, RobotText, load_robot
from stcal.robot.kinematics.robot_model import USUAL, Conditions, Elasticity, Robot

Model = Literal["rigid", "elastic", "auto"]
LEAST_FOLDS = 2
BEYOND_CHANCE = 2.5
"""Standard errors by which one model must predict better; rows of one fold share the error of their solution."""
NO_GAIN = 0.95  # errors of held-out rows over those of the nominal robot from which on nothing was gained
LEAST_SCALE, BY_CHANCE, LEAST_LENGTHS = 2e-4, 1e-3, 4
"""Common relative change of all lengths, its probability by chance, and number of adjusted lengths for a note."""
FAR_FROM_STATED = 3.0  # factor between the σ that residuals show and those that are stated from which on it is told
MEDIAN_OF_NORMAL = 0.6745  # median of the size of a normal error of σ 1
OTHER_TYPE_MM, SHOWN_LENGTHS = 5.0, 4
"""Change of a length beyond what workshops make of one type of arm, and most lengths to be shown."""
TOGETHER, MOST_BESIDE = 0.2, 2
"""Share of a direction's largest motion from which on a parameter is named with it, and largest number of those."""
SAMPLES = 200  # number of joint vectors over the ranges for which σ is predicted
ELSEWHERE = 3.0
"""Largest ratio of σ over the ranges to σ at the rows without a warning: 40 rows over 60 % of the ranges have 1.6."""
FEW = 2.0  # number of measured values per parameter below which σ may come out at a tenth of the true ones
REPEATED = "joint values were measured several times: what the model lacks there counts once in σ"
COMPUTED = (
    "orientations are the robot file's, to rounding, and positions are not: the controller computed them. "
    "Positions alone are used, as with --observe position; with --observe pose orientations count as measured"
)
TRY_ELASTIC = "gravity and gears may explain it: --model auto tries whether they predict rows held out better"


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
            fault = f"folds is {self.folds}: models are compared on held-out rows"
            raise InputError("E-OPTION-RANGE", f"{fault}; {LEAST_FOLDS} or more folds needed")


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
        found = errors.mean(), np.median(errors), rms(errors), np.percentile(errors, 95), errors.max()
        return cls(len(errors), *(float(v) for v in found))


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


@dataclass(frozen=True, slots=True, eq=False)
class Predicted:
    """σ of the tool's position, mm (root of the summed variances of x, y, z). ``here_mm`` : (m,) at the measured joint
    values; ``model_mm`` : (s,) at random ones over the joints' ranges, and ``ranges_mm`` with ``left_mm``, the RMS of
    effects in the residuals; ``covariance`` : (k, k) of all parameters, rad and mm."""

    here_mm: np.ndarray
    model_mm: np.ndarray
    covariance: np.ndarray
    left_mm: float = 0.0

    @classmethod
    def of(cls, state: State, robot: Robot, seen: Observed, covariance: np.ndarray, left: Sequence[Effect]):
        """Returns σ for the target of most rows; None for distances, which do not place the arm."""
        if seen.kind == "distance":
            return None
        data = seen.data
        target = max(dict.fromkeys(data.targets), key=data.targets.count)
        q = over_ranges(replace(robot, tools={"": Rigid()}), SAMPLES)

        def sigma(q: np.ndarray, targets: Sequence[str], conditions: Conditions = USUAL) -> np.ndarray:
            return position_errors(sigma_of(state.tip_jacobian(q, targets, seen.kind, conditions)[1], covariance))

        here, ranges = sigma(data.q, data.targets, data.conditions), sigma(q, (target,) * SAMPLES)
        effects = np.array([finding.effect_mm / (np.sqrt(2) if finding.turns else 1.0) for finding in left])
        return cls(here, ranges, covariance, float(np.sqrt((effects**2).sum())))

    @property
    def ranges_mm(self) -> np.ndarray:
        """σ (s,) at random joint values over the ranges, with what the model lacks."""
        return np.hypot(self.model_mm, self.left_mm)

    def at(self, state: State, kind: Kind, q: np.ndarray, targets: Sequence[str]) -> np.ndarray:
        """Returns σ (r,) of the position, mm, at joint values (r, n) that were not measured, with the effects found in
        the residuals; nan for tools that were not measured."""
        sigma, known = np.full(len(q), np.nan), np.array([name in state.tools for name in targets], bool)
        if known.any():
            moves = state.tip_jacobian(q[known], [name for name in targets if name in state.tools], kind)[1]
            sigma[known] = np.hypot(position_errors(sigma_of(moves, self.covariance)), self.left_mm)
        return sigma


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
    placed: tuple[PlacedFrame, ...]
    left: tuple[Effect, ...] | None
    dh_sigma: np.ndarray
    observability: ObservabilityIndices
    deviations: dict[str, float | None]
    elasticity_sigma: Elasticity | None
    gain: Gain | None
    all_held_out: HeldOutRows | None
    notes: tuple[str, ...] = ()

    def __post_init__(self):
        freeze(self, "covariance", (len(self.names), len(self.names)), "covariance")

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
        return [(int(i), float(self.fitted_mm[i])) for i in np.flatnonzero(self.weights < GROSS)]

    @property
    def errors(self) -> dict[str, Figures]:
        """Position errors, and their predicted σ, mm, by the keys of :data:`ERRORS`."""
        found = {"nominal": self.nominal_mm, "identified": self.fitted_mm}
        for key, rows in (("held_out", self.held_out), ("all_held_out", self.all_held_out)):
            found |= {} if rows is None else {key: rows.position_mm}
        if self.predicted is not None:
            found |= {"sigma": self.predicted.here_mm, "sigma_over_ranges": self.predicted.ranges_mm}
        return {key: Figures.of(values) for key, values in found.items()}

    @property
    def rows(self) -> np.ndarray:
        """Rows (n, 5) a, alpha, d, theta, beta; mm, rad."""
        return dh_values(self.robot)


ERRORS = {
    "nominal": "nominal axes, base and tool fitted",
    "identified": "identified, the same rows",
    "held_out": "held out",
    "all_held_out": "held out, were all dimensions adjusted",
    "sigma": "σ of the position, the same rows",
    "sigma_over_ranges": "σ of the position, over the joints' ranges",
}


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
    elasticity_sigma: Annotated[Elasticity, Named("compliance moment periodic hysteresis")] | None = Field(
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
    placed: list[Annotated[PlacedFrame, Named()]] = Field(
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
    left: list[Effect] | None = Field(
        description="what the residuals go with: `what` in words, `joint` and `turns` (0: none), `effect_mm`, "
        "`effect_rad` (amplitude where it turns, else RMS), `share` of their squares, `p` times the number of tests, "
        "`line` of the first row after a jump, `advice`; null where rows are too few to tell"
    )


def directions_named(directions: np.ndarray, names: tuple[str, ...] | list[str]) -> tuple[str, ...]:
    """Returns names of directions (k, d), ``J2 y (with tool z)``, each led by a parameter of its own."""
    reduced = directions.copy()
    lead: list[int] = []
    for column in range(reduced.shape[1]):
        free = np.abs(reduced)
        free[lead] = 0
        i, j = map(int, np.unravel_index(free[:, column:].argmax(), free[:, column:].shape))
        reduced[:, [column, column + j]] = reduced[:, [column + j, column]]
        reduced[:, column] /= reduced[i, column]
        others = np.arange(reduced.shape[1]) != column
        reduced[:, others] -= np.outer(reduced[:, column], reduced[i, others])
        lead.append(int(i))
    named = []
    for i, direction in zip(lead, np.abs(reduced.T), strict=True):
        order = np.argsort(-direction)
        strong = [names[k] for k in order if k != i and direction[k] > TOGETHER * direction.max()]
        beside = " and ".join(strong[:MOST_BESIDE]) + (" …" if len(strong) > MOST_BESIDE else "")
        named.append(f"{names[i]} (with {beside})" if beside else names[i])
    return tuple(named)


def remarks(result: Identified, tested: bool, computed: bool) -> tuple[str, ...]:
    """Returns the notes on a result; ``tested`` : rows were held out, or none were asked for; ``computed`` : the
    controller computed the orientations."""
    left, rows, predicted = result.left or (), result.adjustment.rows, result.predicted
    notes = [*result.seen.data.notes, *([COMPUTED] if computed else []), *rows.notes(result.robot)]
    notes += [*result.adjustment.notes, *([REPEATED] if result.adjustment.places() is not None else [])]
    notes += [*_little_known(result, tested), *(each.sentence() for each in left)]
    if predicted is not None and left:
        remains = f"the model leaves {predicted.left_mm:.2g} mm RMS that goes with what is named above"
        known = f"the tool's position is known to {rms(predicted.ranges_mm):.2g} mm (σ, with that in it)"
        notes.append(f"σ hold for these rows, and for places like theirs: {remains}; over the joints' ranges {known}")
        if not result.state.elastic and any(not each.advice for each in left):
            notes.append(TRY_ELASTIC)
    if result.robot.elasticity is None:
        notes += result.seen.data.conditions.ignored("the arm as identified")
    notes += _stated_otherwise(result)
    if result.held_out is not None:
        before, after = (result.errors[key].rms for key in ("nominal", "held_out"))
        if after > NO_GAIN * before > 0:
            errs = f"{after:.3g} mm (RMS) with the identified robot and by {before:.3g} mm with the nominal one"
            fault = f"no gain: rows held out err by {errs}, base and tool fitted"
            remedy = "check joint values and measurements, rounding too"
            notes.append(f"{fault}: what errs is not the robot's dimensions; {remedy}")
    return (*notes, *_lengths(result))


def _little_known(result: Identified, tested: bool) -> list[str]:
    """Returns notes on few rows, or on rows of a small part of the ranges."""
    seen, names, found = result.seen, result.names, result.predicted
    numbers, notes = WIDTH[seen.kind] * len(seen), []
    few = "σ estimated from so few may be several times too small; state --sigma-mm, or measure more"
    if not tested:
        few = "none can be held out to test the result, and errors of the same rows say nothing; measure twice as many"
    if not tested or numbers < FEW * len(names):
        notes.append(f"{len(seen)} {seen.kind}s give {numbers} numbers for {len(names)} parameters: {few}")
    if found is None:
        return notes
    here, ranges = rms(found.here_mm), rms(found.model_mm)
    times = ranges / max(here, 1e-9)
    if times > ELSEWHERE:
        units = result.adjustment.units[: len(names)]
        sizes, directions = np.linalg.eigh(result.covariance / units[:, None] / units)
        worst = f"{directions_named(directions[:, -1:], names)[0]}, ± {np.sqrt(sizes[-1]):.2g} mm"
        notes.append(
            f"over the joints' ranges the tool's position is known to {ranges:.2g} mm (σ), {times:.0f} times that at "
            f"the measured rows, {here:.2g} mm: they are few, or of a small part of the ranges; least known: {worst}; "
            "add rows (`stcal robot design`), or use the result where it was measured only"
        )
    return notes


def _lengths(result: Identified) -> list[str]:
    """Returns a note on lengths that all differ by one factor, or that are of another type of arm."""
    lengths = dh_values(result.nominal)[:, [0, 2]].ravel()
    changes = result.rows[:, [0, 2]].ravel() - lengths
    square, free = float(lengths @ lengths), len(lengths) - 1
    if square > 0 and (changes != 0).sum() >= LEAST_LENGTHS:
        scale = float(lengths @ changes) / square
        rest = float(np.linalg.norm(changes - scale * lengths)) / np.sqrt(free * square)
        if abs(scale) > LEAST_SCALE and 2 * stdtr(free, -abs(scale) / max(rest, 1e-15)) < BY_CHANCE:
            whose = "the scale of the instrument, or of a board or target by which positions were measured"
            times = f"all lengths of the robot are {1 + scale:.5f} ± {rest:.1g} times nominal"
            return [f"{times}: rather than of the arm, this is {whose}; check a known length"]
    far = np.flatnonzero(np.abs(changes) > OTHER_TYPE_MM)
    which = ", ".join(f"{'ad'[i % 2]} of joint {i // 2 + 1} by {changes[i]:+.1f} mm" for i in far[:SHOWN_LENGTHS])
    remedy = "arms of one type differ by less than 2 mm: check that the file is of this type, and its units"
    return [f"lengths are not those of the robot file: {which}; {remedy}"] if len(far) else []


def _stated_otherwise(result: Identified) -> list[str]:
    """Returns a note on stated σ that are far from what the residuals show."""
    sigma, kind = result.weighting, result.seen.kind
    remedy = "check --sigma-mm and --sigma-rad, or covariances, and their units; or leave them out, to have σ estimated"
    ratios = {"residuals": sigma.factor}
    if not sigma.given:
        medians = replace(sigma, estimated=()).medians(sigma.factor * sigma.whiten(result.residuals, result.seen))
        names = {"rad": "residuals of orientations", "mm": f"residuals of {kind}s".replace("poses", "positions")}
        ratios = {names[n]: v / MEDIAN_OF_NORMAL for n, v in medians.items() if n not in sigma.estimated}
    far = {what: ratio for what, ratio in ratios.items() if not 1 / FAR_FROM_STATED < ratio < FAR_FROM_STATED}
    what = max(far, key=lambda each: abs(np.log(max(far[each], 1e-12))), default="")
    return [f"{what} are {far[what]:.2g} times the σ that are stated: {remedy}"] if far else []


def require_identified_written(path: Path | str, result: Identified) -> None:
    """Read a written robot file again, and require that it predicts the reported residuals; raises ConvergenceError."""

    def again() -> np.ndarray:
        robot = load_robot(path)
        tools = {name: robot.tool(name) for name in result.state.tools}
        return State(robot.chain(), tools, stations=result.state.stations).residuals(result.seen)

    require_written(path, again, result.residuals, WRITTEN_MM, "mm or rad")
