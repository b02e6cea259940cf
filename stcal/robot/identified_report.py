"""Text and page of an identified robot, and the table of mastering offsets for its controller."""

from collections.abc import Iterable, Sequence
from functools import partial

import numpy as np

from stcal.geometry.arrays import require_arguments
from stcal.io.rotations import fixed
from stcal.io.table import csv_text
from stcal.report.document import (
    Answer,
    Block,
    Document,
    Html,
    Notes,
    Section,
    Table,
    listed,
    page_only,
    plot,
    subheading,
)
from stcal.report.svg import COLOURS, Axes, Drawing, limits
from stcal.report.text import NONE, number
from stcal.robot.identification.adjustment import MEANING, Observed, State, sigma_of
from stcal.robot.identification.prior import DIMENSIONS, SHOWN, PlacedFrame, dh_values
from stcal.robot.identification.problem import GROSS
from stcal.robot.identification.result import ERRORS, Identified
from stcal.robot.identification.unexplained import Effect
from stcal.robot.kinematics.forward import joint_motions, links, torques
from stcal.robot.kinematics.robot_model import Robot

UNITS = ("mm", "deg", "mm", "deg", "deg")
MDEG = 1000 * 180 / np.pi
DEVIATIONS = (" mm in lengths", " in twists", " in zero positions")
DEVIATIONS += (" by gravity about axes", " across them", " by gears", " by hysteresis")  # of each σ of `Deviations`


def identified_report(result: Identified) -> Document:
    """Returns the report of ``identify``."""
    seen = result.seen
    kinds = ", ".join(f"{kind}s {rank}" for kind, rank in result.ranks.items())
    names = ERRORS
    if result.held_out:
        names = ERRORS | {"held_out": f"{ERRORS['held_out']}, {result.held_out.folds} folds"}
    errors = [
        [names[key], *(number(value, 4) for value in (each.mean, each.rms, each.max))]
        for key, each in result.errors.items()
    ]
    outliers = [[_place(result, i), number(error, 3), number(result.weights[i], 2)] for i, error in result.outliers()]
    indices = [[name, f"{value:.4g}", MEANING[name]] for name, value in result.observability.values().items()]
    rows = result.adjustment.rows
    gain, model = result.gain, "model: elastic" if result.model == "elastic" else ""
    if gain is not None:
        less, beyond = "less" if gain.gain_mm > 0 else "more", "" if gain.beyond_chance else "not "
        errs = f"{gain.rigid_mm:.3g} mm RMS of a rigid arm and {gain.elastic_mm:.3g} of an elastic one"
        by = f"{abs(gain.gain_mm):.2g} ± {gain.sigma_mm:.1g} mm {less} a row, {beyond}beyond chance"
        model = f"model: {result.model}; rows held out err by {errs}, {by}"
    adjusted = f"adjusted: base, tools and {(rows.free & ~rows.fixed).sum()} of {rows.free.sum()} dimensions"
    accuracy = [
        _noise(result),
        adjusted if rows.fixed.any() else "",
        model,
        Table(["<Error, mm", "mean", "RMS", "max"], errors),
        page_only(
            "Held out: rows that took no part in the fit that they judge. σ: of the tool's position, by the "
            "covariance of the parameters"
        ),
        Notes(result.notes),
    ]
    rows = [
        page_only(f"Convention {result.robot.convention}. β (Hayati) where axes are nearly parallel; d is then kept"),
        *_dh_tables(result),
        *_elastic_blocks(result),
        subheading("Base in the instrument's frame, tools in the flange's"),
        placed_table(result.placed),
    ]
    determined = [
        f"{result.rank} of {len(result.names)} parameters; these joint values determine: {kinds}",
        listed("kept nominal, as the data do not determine it", result.undetermined),
        Table(["<Index", "value (1/mm, O2: none)", "<"], indices),
    ]
    drawn = result.state, seen, result.residuals, result.weights >= GROSS
    weak = Table(["<Where", "error mm", "weight"], outliers)
    data = f"{len(seen)} {seen.kind}s{' by their distances' if seen.frameless else ''} from {seen.data.where}"
    return Document(
        f"{result.nominal.name}: identified",
        f"robot {result.nominal.name}: {data}, {result.rank} parameters determined",
        [
            Section("Accuracy", accuracy, terminal=True),
            Section("Denavit–Hartenberg rows", rows, terminal=True),
            Section("What the data determine", determined, terminal=True),
            Section("What the model leaves", [*left_lines(result.left), residual_plot(*drawn)], name="left"),
            Section("Outliers, of less than half weight", [weak], terminal=True),
        ],
        [_verdict(result)],
    )


def _verdict(result: Identified) -> Answer:
    """Returns whether the robot may be used: no where rows held out err no less than by nominal axes."""
    held_out, nominal = result.errors.get("held_out"), result.errors["nominal"].rms
    if held_out is None:
        return Answer("with care", "no rows were held out: nothing but the fit itself shows the errors")
    errs = f"rows that are held out err by {held_out.rms:.3g} mm RMS, by nominal axes {nominal:.3g}"
    if held_out.rms >= nominal:
        return Answer("no", errs)
    if result.left:
        return Answer("with care", f"{errs}; {result.left[0].sentence()}")
    if result.undetermined:
        return Answer("with care", f"{errs}; the data do not determine {', '.join(result.undetermined)}")
    return Answer("yes", errs)


def left_lines(left: Sequence[Effect] | None) -> list[str]:
    """Returns sentences on what residuals depend on."""
    if left is None:
        return ["too few rows to find what the residuals depend on"]
    nothing = "the residuals depend on nothing that was tested (joints, gravity, place)"
    return [finding.sentence() for finding in left] or [nothing]


def _elastic_blocks(result: Identified) -> list[Block]:
    """Returns a table of each joint's deflection at the measured torques (RMS), gear error and hysteresis, with σ."""
    elasticity, sigma = result.state.chain.elasticity, result.elasticity_sigma
    if elasticity is None or sigma is None:
        return []
    chain, q, conditions = result.state.chain, result.seen.data.q, result.seen.data.conditions
    rotation, origin = links(chain, q, conditions)
    torque = torques(chain, q, rotation, origin, conditions)
    about = (torque * rotation[..., 2]).sum(2)
    across = (torque**2).sum(2) - about**2
    rms = np.sqrt(np.stack([(about**2).mean(1), across.clip(0).mean(1)], axis=1))
    pairs, size = (slice(0, 2), slice(2, 4)), np.linalg.norm
    own = [*(elasticity.compliance * rms).T, *(size(elasticity.periodic[:, p], axis=1) for p in pairs)]
    deviation = [*(sigma.compliance * rms).T, *(size(sigma.periodic[:, p], axis=1) / np.sqrt(2) for p in pairs)]
    heads = ["<joint, mdeg", "gravity", "across axis", "once a turn", "twice a turn"]
    if result.state.hysteresis:
        heads, own, deviation = [*heads, "hysteresis"], [*own, elasticity.hysteresis], [*deviation, sigma.hysteresis]
    cells = MDEG * np.array([own, deviation]).T  # (n, columns, 2)
    return [
        subheading("Elasticity"),
        page_only(
            "Deflection of the links at the torques of the measured rows (RMS), and amplitudes of the gears and their "
            "hysteresis"
        ),
        Table(heads, [[str(i), *(f"{value:.1f} ± {s:.1f}" for value, s in row)] for i, row in enumerate(cells, 1)]),
    ]


def placed_table(placed: Iterable[PlacedFrame]) -> Table:
    """Returns value ± σ of translation, mm, and rotation vector, deg, of base and tools; no σ where none is known."""
    rows, unit = [], np.repeat([np.degrees(1.0), 1.0], 3)
    for each in placed:
        pairs = zip(np.roll(each.pose.log() * unit, 3), np.roll(each.sigma * unit, 3), strict=True)
        cells = (number(v, 4) + (f" ± {s:.4f}" if np.isfinite(s) else "") for v, s in pairs)
        rows.append([each.name, *cells])
    over = [("", 1), ("translation ± σ", 3), ("rotation vector ± σ about the axes", 3)]
    return Table(["<", "x mm", "y mm", "z mm", "x °", "y °", "z °"], rows, over)


def _dh_tables(result: Identified) -> list[Table]:
    """Returns a table for each unit, with a row for each joint."""
    values, before, sigma = (each * SHOWN for each in (result.rows, dh_values(result.nominal), result.dh_sigma))
    tables = []
    for unit in dict.fromkeys(UNITS):
        kinds, lines = [k for k in range(5) if UNITS[k] == unit], []
        for i, kept in enumerate(sigma == 0, 1):
            cells = [str(i)]
            for k in kinds:
                value, change = number(values[i - 1, k], 4), number(values[i - 1, k] - before[i - 1, k], 4)
                cells += [value, NONE, ""] if kept[k] else [value, change, f"{sigma[i - 1, k]:.4f}"]
            lines.append(cells)
        heads = ["<joint", *["value", "change", "σ"] * len(kinds)]
        tables.append(Table(heads, lines, [("", 1), *((f"{DIMENSIONS[k]} ({unit})", 3) for k in kinds)]))
    return tables


def _noise(result: Identified) -> str:
    weighting = result.weighting
    if weighting.given:
        noise = f"weights from the covariances given, σ₀ {result.sigma0:.2f}"
    else:
        rotation = f", {np.degrees(weighting.sigma_rad):.2g}°" if result.seen.kind == "pose" else ""
        noise = f"σ of a coordinate {weighting.sigma_mm:.3g} mm{rotation}, σ₀ {result.sigma0:.2f}"
    shown = ", ".join(
        f"{sigma:.2g}{what}" if what.startswith(" mm") else f"{np.degrees(sigma):.2g}°{what}"
        for sigma, what in zip(result.deviations.values(), DEVIATIONS, strict=True)
        if sigma is not None
    )
    return f"{noise}; the robot differs from nominal by σ of {shown}" if shown else noise


def _place(result: Identified, row: int) -> str:
    seen, lines = result.seen, result.seen.data.lines
    if seen.kind == "distance":
        return f"lines {lines[seen.second[row]]} – {lines[seen.first[row]]}"
    target = seen.data.targets[row]
    return f"line {lines[row]}" + (f", target {target}" if target else "")


HEAD = ("joint", "parameter", "nominal", "identified", "difference", "sigma", "unit", "determined")
DIGITS = {"mm": 6, "deg": 9}
ZERO = "zero"


def zeros(result: Identified, nominal: Robot) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns the controller's values at its present 0, their σ, and a mask (n,) of determined ones: q + C⁻¹ Δθ."""
    at = np.where(nominal.prismatic, DIMENSIONS.index("d"), DIMENSIONS.index("theta"))
    joints, back = np.arange(len(at)), np.linalg.inv(nominal.coupling)
    change = back @ (dh_values(result.robot) - dh_values(nominal))[joints, at]
    jacobian = back @ result.adjustment.rows.by_parameters(result.robot)[joints, at]
    k = jacobian.shape[1]
    sigma = sigma_of(jacobian, result.covariance[:k, :k])
    open_ = result.dh_sigma[joints, at] == 0
    open_[[turn for turn, _ in result.adjustment.rows.coaxial]] = True
    return change, sigma, (np.abs(back) > 0) @ open_ == 0


@require_arguments
def offsets_csv(result: Identified, nominal: Robot) -> str:
    """Returns the CSV of mastering offsets, and of differences of D-H values, of ``result`` from the ``nominal`` robot
    from which it was identified, in mm and degrees, with σ (form: ``data_layout.md``)."""
    before, values, sigma = dh_values(nominal) * SHOWN, dh_values(result.robot) * SHOWN, result.dh_sigma * SHOWN
    change, change_sigma, known = zeros(result, nominal)
    unit, of_zeros = np.where(nominal.prismatic, "mm", "deg"), (nominal.shown * change, nominal.shown * change_sigma)
    rows: list[Sequence] = [HEAD]
    for i, (*zero, told) in enumerate(zip(*of_zeros, known, strict=True)):
        cells = [*zip(DIMENSIONS, UNITS, before[i], values[i], sigma[i], sigma[i] > 0, strict=True)]
        for name, of, old, new, deviation, yes in (*cells, (ZERO, unit[i], 0.0, *zero, told)):
            shown = [fixed(v, DIGITS[of]) for v in (old, new, new - old)]
            text = fixed(deviation, DIGITS[of]) if yes else ""
            rows.append([i + 1, name, *shown, text, of, "yes" if yes else "no"])
    return csv_text(rows)


LEAST_MOTION = 1e-6  # share of the largest motion of the tool below which a joint counts as not moving it
FEW = 200  # number of rows beyond which points are drawn small


def joints_figure(
    state: State, seen: Observed, residuals: np.ndarray, good: np.ndarray, colour: str = COLOURS[0]
) -> Drawing:
    """Returns a figure of residuals (r, w) of good rows (r,), in the world, along each joint's motion by its value."""
    data, chain, points = seen.data, state.chain, []
    tip, errors = state.tips_of(data), residuals[:, -3:]
    twists = joint_motions(chain, data.q, tip, data.conditions) * chain.carries(data.targets)[:, :, None]
    values = (data.q @ chain.coupling.T).T * np.where(chain.prismatic, 1, np.degrees(1))[:, None]
    for twist, value in zip(twists, values, strict=True):
        motion = state.as_seen(seen, tip, twist[:, :, None])[:, -errors.shape[1] :, 0]
        size = np.linalg.norm(motion, axis=1)
        moves = good & (size > LEAST_MOTION * max(size.max(), 1e-300))
        along = np.einsum("rw,rw->r", motion[moves], errors[moves]) / size[moves]
        points.append((value[seen.first[moves]], along))
    y, across = limits(np.concatenate([along for _, along in points])), min(len(chain), 3)
    down = -(-len(chain) // across)
    drawing = Drawing(9, 0.35 + 1.75 * down)
    for i, (box, (at, along)) in enumerate(zip(drawing.panels(across, down, gap=34), points, strict=False)):
        axes = Axes(drawing, box, limits(at), y)
        unit = "mm" if chain.prismatic[i] else "deg"
        axes.frame(f"joint {i + 1}, {unit}", "" if i % across else "along its motion, mm")
        axes.level(0, "#9aa0a8")
        axes.marks(at, along, "dot", 3 if len(at) <= FEW else 1.4, colour)
    return drawing


def residual_plot(*drawn) -> Html:
    """Returns the figure of residuals by joint, of the arguments of :func:`joints_figure`."""
    caption = "Residual along each joint's own motion, by the joint's value"
    return plot(partial(joints_figure, *drawn), "Residuals by joint", caption)
