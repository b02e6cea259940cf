"""Text, page and result file of an identified robot, and the table of mastering offsets for its controller."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field

from stcal.geometry.arrays import require_arguments
from stcal.io.files import require_written
from stcal.io.json import Matrix, Part, ResultFile
from stcal.io.poses.columns import fixed
from stcal.io.table import csv_text, read_table
from stcal.report.document import Block, Document, Notes, Section, Table, fold, listed, page_only, plot, subheading
from stcal.report.svg import COLOURS, Axes, Drawing, limits
from stcal.report.text import NONE, number
from stcal.robot.identification.drawings import Drawn, residual_plots
from stcal.robot.identification.observability import MEANING
from stcal.robot.identification.prior import DIMENSIONS, SHOWN, Placed, dh_values
from stcal.robot.identification.result import OUTLIER_WEIGHT, Gain, Identified
from stcal.robot.kinematics.forward import links, torques
from stcal.robot.kinematics.model import Elasticity, Robot


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
    line: int | None


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
    models: Gain | None = Field(
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
        "number of tests, `line` of the first row after a jump along their order (null: no jump); null where rows are "
        "too few to tell"
    )
    outliers: list[OutlierMeasurementRow] = Field(
        description="those of less than half weight: `line`, `place`, `error_mm`"
    )


DH = DIMENSIONS
UNITS = ("mm", "deg", "mm", "deg", "deg")
MDEG = 1000 * 180 / np.pi
ELASTIC = ["<joint, mdeg", "gravity", "across axis", "once a turn", "twice a turn"]


def identified_file(result: Identified, nominal: Robot) -> IdentifiedFile:
    """Returns the result for programs (keys: ``data_layout.md``)."""
    values, before = dh_values(result.robot), dh_values(nominal)
    held_out, predicted, is_pose = result.held_out, result.predicted, result.seen.kind == "pose"
    content = {
        "format": "stcal identified 1",
        "robot": nominal.name,
        "observed": result.seen.used,
        "observations": len(result.seen),
        "rank": result.rank,
        "parameters": len(result.names),
        "ranks": result.ranks,
        "undetermined": list(result.undetermined),
        "notes": list(result.notes),
        "fixed": [
            {"joint": i + 1, "dimension": DIMENSIONS[k], "reason": nominal.joints[i].fixed.get(DIMENSIONS[k])}
            for i, k in np.argwhere(result.adjustment.rows.fixed).tolist()
        ],
        "all_held_out_rms_mm": result.all_held_out and _statistics(result.all_held_out.position_mm)["rms_mm"],
        "stations": {name: pose.inverse().matrix() for name, pose in result.state.stations.items()},
        "model": result.model,
        "models": result.gain,
        "elasticity": _elasticity(result),
        "sigma_mm": None if result.weighting.given else result.weighting.sigma_mm,
        "sigma_rad": result.weighting.sigma_rad if is_pose and not result.weighting.given else None,
        "sigma0": result.sigma0,
        "deviations": result.deviations,
        "errors": {"nominal": _statistics(result.nominal_mm), "identified": _statistics(result.fitted_mm)},
        "held_out": held_out
        and {
            "folds": held_out.folds,
            "repeats": len(held_out.position_mm),
            **_statistics(held_out.position_mm),
            "mean_deg": float(np.degrees(np.nanmean(held_out.rotation_rad))) if is_pose else None,
        },
        "predicted": predicted
        and {"same_rows": _statistics(predicted.here_mm), "ranges": _statistics(predicted.ranges_mm)},
        "observability": result.observability.values(),
        "rows": [
            {name: {"nominal": b, "identified": v, "sigma": s} for name, b, v, s in zip(DH, *each, strict=True)}
            for each in zip(before.tolist(), values.tolist(), result.dh_sigma.tolist(), strict=True)
        ],
        "placed": placed_parts(result.placed),
        "parameter_names": list(result.names),
        "covariance": result.covariance,
        "residuals": [
            {"line": _line(result, i), "error_mm": float(e), "weight": float(w)}
            for i, (e, w) in enumerate(zip(result.fitted_mm, result.weights, strict=True))
        ],
        "left": result.left,
        "outliers": [
            {"line": _line(result, i), "place": _place(result, i), "error_mm": error} for i, error in result.outliers()
        ],
    }
    return IdentifiedFile.model_validate(content)


def identified_report(result: Identified, nominal: Robot) -> Document:
    """Returns the report of ``identify``."""
    seen = result.seen
    kinds = ", ".join(f"{kind}s {rank}" for kind, rank in result.ranks.items())
    errors = [[name, *(number(v, 4) for v in _statistics(each).values())] for name, each in _errors(result).items()]
    outliers = [[_place(result, i), number(error, 3), number(result.weights[i], 2)] for i, error in result.outliers()]
    sigma = [
        [name, f"{1000 * np.degrees(s):.3f} mdeg" if " r" in name else f"{1000 * s:.1f} µm"]
        for name, s in zip(result.names, np.sqrt(np.diag(result.covariance)), strict=True)
    ]
    indices = [[name, f"{value:.4g}", MEANING[name]] for name, value in result.observability.values().items()]
    accuracy = [
        _noise(result),
        *_price(result),
        *_model(result),
        Table(["<Error, mm", "mean", "RMS", "max"], errors),
        page_only(
            "Held out: rows that took no part in the fit that they judge. σ: of the tool's position, by the "
            "covariance of the parameters"
        ),
        plot(
            lambda: _figure(result),
            "Errors by row",
            "Error by observation; held out: mean over the divisions into folds",
        ),
        Notes(result.notes),
    ]
    rows = [
        page_only(f"Convention {result.robot.convention}. β (Hayati) where axes are nearly parallel; d is then kept"),
        *_dh_tables(result, nominal),
        *_elastic_blocks(result),
        subheading("Base in the instrument's frame, tools in the flange's"),
        placed_table(result.placed),
    ]
    determined = [
        f"{result.rank} of {len(result.names)} parameters; these joint values determine: {kinds}",
        listed("kept nominal, as the data do not determine it", result.undetermined),
        fold("σ of the minimal parameters", Table(["<Parameter", "σ"], sigma)),
        Table(["<Index", "value (1/mm, O2: none)", "<"], indices),
    ]
    good = result.weights >= OUTLIER_WEIGHT
    drawn = Drawn(result.state, result.robot.world_from_base, result.seen, result.residuals, good)
    nothing = (
        "too few observations to find what the residuals depend on"
        if result.left is None
        else "the residuals depend on nothing that was tested (joints, gravity, place)"
    )
    left = [residuals.sentence() for residuals in result.left or ()] or [nothing]
    return Document(
        f"{nominal.name}: identified",
        f"robot {nominal.name}: {len(seen)} {seen.kind}s{' by their distances' if seen.frameless else ''} from "
        f"{seen.data.where}, {result.rank} parameters determined",
        [
            Section("Accuracy", accuracy, terminal=True),
            Section("Denavit–Hartenberg rows", rows, terminal=True),
            Section("What the data determine", determined, terminal=True),
            Section("What the model leaves", [*left, *residual_plots(drawn, result.left or ())], name="left"),
            Section(
                "Outliers, of less than half weight", [Table(["<Where", "error mm", "weight"], outliers)], terminal=True
            ),
        ],
    )


def _price(result: Identified) -> list[str]:
    """Returns what was adjusted, and the held-out errors with and without the kept dimensions, if any."""
    rows = result.adjustment.rows
    if not rows.fixed.any():
        return []
    message = f"adjusted: base, tools and {int((rows.free & ~rows.fixed).sum())} of {int(rows.free.sum())} dimensions"
    if result.held_out is None or result.all_held_out is None:
        return [message]
    own, every = (_statistics(each.position_mm)["rms_mm"] for each in (result.held_out, result.all_held_out))
    return [f"{message}; rows held out err by {own:.3g} mm RMS, by {every:.3g} were all dimensions adjusted"]


def _model(result: Identified) -> list[str]:
    """Returns which model was chosen, and its gain."""
    gain = result.gain
    if gain is None:
        return ["model: elastic"] if result.model == "elastic" else []
    less, beyond = "less" if gain.gain_mm > 0 else "more", "" if gain.beyond_chance else "not "
    return [
        f"model: {result.model}; rows held out err by {gain.rigid_mm:.3g} mm RMS of a rigid arm and "
        f"{gain.elastic_mm:.3g} of an elastic one, {abs(gain.gain_mm):.2g} ± {gain.sigma_mm:.1g} mm {less} a row, "
        f"{beyond}beyond chance"
    ]


def _elastic_blocks(result: Identified) -> list[Block]:
    """Returns a table of each joint's deflection at the measured torques (RMS), gear error and hysteresis, with σ."""
    elasticity, sigma = result.state.chain.elasticity, result.elasticity_sigma
    if elasticity is None or sigma is None:
        return []
    chain, q = result.state.chain, result.seen.data.q
    conditions = result.seen.data.conditions
    rotation, origin = links(chain, q, conditions)
    torque = torques(chain, q, rotation, origin, conditions)
    axis = rotation[..., 2]
    about = (torque * axis).sum(2)
    square = (torque**2).sum(2)
    rms = np.sqrt(np.stack([(about**2).mean(1), (square - about**2).clip(0).mean(1)], axis=1))
    rows = []
    for i in range(len(chain)):
        cells = [(c * t, s * t) for c, s, t in zip(elasticity.compliance[i], sigma.compliance[i], rms[i], strict=True)]
        for pair in (slice(0, 2), slice(2, 4)):
            size, gear_sigma = float(np.linalg.norm(elasticity.periodic[i, pair])), sigma.periodic[i, pair]
            cells.append((size, float(np.sqrt((gear_sigma**2).mean()))))
        if result.state.hysteresis:
            cells.append((elasticity.hysteresis[i], sigma.hysteresis[i]))
        rows.append([str(i + 1), *(f"{MDEG * value:.1f} ± {MDEG * s:.1f}" for value, s in cells)])
    return [
        subheading("Elasticity"),
        page_only(
            "Deflection of the links at the torques of the measured rows (RMS), and amplitudes of the gears and their "
            "hysteresis"
        ),
        Table([*ELASTIC, *(["hysteresis"] if result.state.hysteresis else [])], rows),
    ]


def _elasticity(result: Identified) -> dict | None:
    """Returns the elasticity of the robot file, with σ; None if it was not adjusted."""
    elasticity, sigma = result.robot.elasticity, result.elasticity_sigma
    if elasticity is None or sigma is None:
        return None

    def joints(each: Elasticity) -> list[dict]:
        parts = (each.compliance, each.moment, each.periodic, each.hysteresis)
        return [
            {"axis_rad_per_Nm": a, "across_rad_per_Nm": b, "moment_Nm": m, "periodic_rad": p, "hysteresis_rad": h}
            for (a, b), m, p, h in zip(*(part.tolist() for part in parts), strict=True)
        ]

    return {"gravity": elasticity.gravity.tolist(), "joints": joints(elasticity), "sigma": joints(sigma)}


def placed_table(placed: Iterable[Placed]) -> Table:
    """Returns value ± σ of translation, mm, and rotation vector, deg, of base and tools; no σ where none is known."""
    rows = []
    for each in placed:
        values = np.append(each.pose.translation, np.degrees(each.pose.log()[:3]))
        sigma = np.append(each.sigma[3:], np.degrees(each.sigma[:3]))
        cells = (number(v, 4) + (f" ± {s:.4f}" if np.isfinite(s) else "") for v, s in zip(values, sigma, strict=True))
        rows.append([each.name.partition(" in the")[0], *cells])
    over = [("", 1), ("translation ± σ", 3), ("rotation vector ± σ about the axes", 3)]
    return Table(["<", "x mm", "y mm", "z mm", "x °", "y °", "z °"], rows, over)


def placed_parts(placed: Iterable[Placed]) -> list[dict]:
    """Returns poses with σ for result files."""
    return [{"name": each.name, "pose": each.pose.matrix(), "sigma": each.sigma_or_none()} for each in placed]


def _dh_tables(result: Identified, nominal: Robot) -> list[Table]:
    """Returns a table for each unit, with a row for each joint."""
    values, before, sigma = dh_values(result.robot) * SHOWN, dh_values(nominal) * SHOWN, result.dh_sigma * SHOWN
    tables = []
    for unit in dict.fromkeys(UNITS):
        kinds = [k for k in range(5) if UNITS[k] == unit]
        lines = []
        for i in range(len(values)):
            cells = []
            for k in kinds:
                change = NONE if sigma[i, k] == 0 else number(values[i, k] - before[i, k], 4)
                cells += [number(values[i, k], 4), change, _sigma(sigma[i, k])]
            lines.append([str(i + 1), *cells])
        heads = ["<joint", *["value", "change", "σ"] * len(kinds)]
        tables.append(Table(heads, lines, [("", 1), *((f"{DH[k]} ({unit})", 3) for k in kinds)]))
    return tables


def _figure(result: Identified) -> Drawing:
    drawing = Drawing(9, 2.6)
    rows = np.arange(1, len(result.seen) + 1)
    size = 4 if len(rows) <= 200 else 1.5
    held_out = None if result.held_out is None else _by_row(result.held_out.position_mm)
    highest = np.append(result.fitted_mm, [] if held_out is None else held_out)
    axes = Axes(drawing, drawing.panels(top=24)[0], (0, len(rows) + 1), limits(highest, low=0))
    axes.frame("observation", "error, mm")
    axes.marks(rows, result.fitted_mm, "dot", size, COLOURS[0])
    key = {"identified": ("dot", COLOURS[0])}
    if held_out is not None:
        axes.marks(rows, held_out, "dash", 2 * size, COLOURS[1])
        key["held out"] = "dash", COLOURS[1]
    drawing.key((axes.box[0], 10), key)
    return drawing


def _by_row(values: np.ndarray) -> np.ndarray:
    finite = np.isfinite(values)
    return np.where(finite, values, 0).sum(0) / np.where(finite.any(0), finite.sum(0), np.nan)


def _errors(result: Identified) -> dict[str, np.ndarray]:
    errors = {"nominal axes, base and tool fitted": result.nominal_mm, "identified, the same rows": result.fitted_mm}
    if result.held_out is not None:
        errors[f"held out, {result.held_out.folds} folds"] = result.held_out.position_mm
    if result.predicted is not None:
        errors["σ of the position, the same rows"] = result.predicted.here_mm
        errors["σ of the position, over the joints' ranges"] = result.predicted.ranges_mm
    return errors


def _statistics(errors: np.ndarray) -> dict[str, float]:
    rms = float(np.sqrt(np.nanmean(errors**2)))
    return {"mean_mm": float(np.nanmean(errors)), "rms_mm": rms, "max_mm": float(np.nanmax(errors))}


def _noise(result: Identified) -> str:
    weighting = result.weighting
    if weighting.given:
        noise = f"weights from the covariances given, σ₀ {result.sigma0:.2f}"
    else:
        rotation = f", {np.degrees(weighting.sigma_rad):.2g}°" if result.seen.kind == "pose" else ""
        noise = f"σ of a coordinate {weighting.sigma_mm:.3g} mm{rotation}, σ₀ {result.sigma0:.2f}"
    degrees = np.degrees(1.0)
    kinds = (
        *((" mm in lengths", 1.0), ("° in twists", degrees), ("° in zero positions", degrees)),
        *(("° by gravity about axes", degrees), ("° across them", degrees), ("° by gears", degrees)),
        ("° by hysteresis", degrees),
    )
    found = zip(result.deviations.values(), kinds, strict=True)
    shown = ", ".join(f"{sigma * unit:.2g}{what}" for sigma, (what, unit) in found if sigma is not None)
    return f"{noise}; the robot differs from nominal by σ of {shown}" if shown else noise


def _sigma(value: float) -> str:
    return "" if value == 0 else f"{value:.4f}"


def _line(result: Identified, row: int) -> int:
    return int(result.seen.data.lines[result.seen.first[row]])


def _place(result: Identified, row: int) -> str:
    seen = result.seen
    if seen.kind == "distance":
        return f"lines {seen.data.lines[seen.second[row]]} – {seen.data.lines[seen.first[row]]}"
    target = seen.data.targets[row]
    return f"line {seen.data.lines[row]}" + (f", target {target}" if target else "")


HEAD = ("joint", "parameter", "nominal", "identified", "difference", "sigma", "unit", "determined")
DIGITS = {"mm": 6, "deg": 9}
ZERO = "zero"
LENGTH_AT, ANGLE_AT = DH.index("d"), DH.index("theta")


def zeros(result: Identified, nominal: Robot) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns joint values that the controller should have at its present 0, their σ, and a mask of determined ones,
    (n,). Rows have θ + Δ where nominal ones have θ; with the coupling C, that is q + C⁻¹ Δ."""
    at = np.where(nominal.prismatic, LENGTH_AT, ANGLE_AT)
    joints, back = np.arange(len(at)), np.linalg.inv(nominal.coupling)
    change = back @ (dh_values(result.robot) - dh_values(nominal))[joints, at]
    jacobian = back @ result.adjustment.rows.by_parameters(result.robot)[joints, at]
    k = jacobian.shape[1]
    sigma = np.sqrt(np.einsum("nk,kl,nl->n", jacobian, result.covariance[:k, :k], jacobian).clip(0))
    open_ = result.dh_sigma[joints, at] == 0
    open_[[turn for turn, _ in result.adjustment.rows.coaxial]] = True
    return change, sigma, (np.abs(back) > 0) @ open_ == 0


@require_arguments
def offsets_csv(result: Identified, nominal: Robot) -> str:
    """Returns the table of mastering offsets and differences of D-H values.

    Parameters
    ----------
    result : Identified
        The robot as identified, of :func:`~stcal.robot.identify`.
    nominal : Robot
        The robot from which it was identified.

    Returns
    -------
    str
        CSV in mm and degrees, with σ (form: ``data_layout.md``).
    """
    before, values, sigma = dh_values(nominal) * SHOWN, dh_values(result.robot) * SHOWN, result.dh_sigma * SHOWN
    change, change_sigma, known = zeros(result, nominal)
    rows: list[Sequence] = [HEAD]

    def row(joint: int, name: str, old: float, new: float, deviation: float, unit: str, told: bool) -> None:
        shown = [fixed(v, DIGITS[unit]) for v in (old, new, new - old)]
        sigma_text = fixed(deviation, DIGITS[unit]) if told else ""
        rows.append([joint, name, *shown, sigma_text, unit, "yes" if told else "no"])

    for i, slides in enumerate(nominal.prismatic):
        for name, unit, old, new, deviation in zip(DH, UNITS, before[i], values[i], sigma[i], strict=True):
            row(i + 1, name, old, new, deviation, unit, deviation > 0)
        factor, unit = (1.0, "mm") if slides else (float(np.degrees(1.0)), "deg")
        row(i + 1, ZERO, 0.0, factor * change[i], factor * change_sigma[i], unit, bool(known[i]))
    return csv_text(rows)


def require_offsets_written(path: str | Path, result: Identified, nominal: Robot) -> None:
    """Read a written table of offsets again, and require the identified D-H values and offsets of zeros."""
    values, change = dh_values(result.robot) * SHOWN, zeros(result, nominal)[0]
    change = np.where(nominal.prismatic, change, np.degrees(change))
    require_written(
        path,
        lambda: read_table(path, "offsets").numbers("identified").reshape(len(values), -1),
        np.column_stack([values, change]),
        10.0 ** -DIGITS["mm"],
        "mm or deg",
    )
