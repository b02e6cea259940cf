"""Text, pages and tables of axes, compensation, verification, evaluation and pose design."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import astuple
from itertools import cycle
from pathlib import Path

import numpy as np

from stcal.errors import InputError
from stcal.geometry.arrays import require_arguments, rms
from stcal.io.table import POSE, QUATERNION, csv_text
from stcal.report.document import (
    Answer,
    Block,
    Document,
    Section,
    Table,
    alarms,
    bullets,
    legend,
    page_only,
    plot,
    subheading,
)
from stcal.report.svg import AXIS_COLOURS, COLOURS, DASH, INK, Axes, Drawing, count_ticks, limits, log_limits
from stcal.report.text import NONE, number
from stcal.robot.axes.axes_model import AxesResult
from stcal.robot.axes.fit import called
from stcal.robot.descriptions import few
from stcal.robot.identification.adjustment import MEANING
from stcal.robot.identification.prior import SHOWN
from stcal.robot.identification.result import Figures
from stcal.robot.identified_report import left_lines, placed_table, residual_plot
from stcal.robot.kinematics.inverse import Inverse
from stcal.robot.kinematics.robot_model import Robot
from stcal.robot.use.compensation import Compensated, compensated_summary, joint_cells, joint_columns
from stcal.robot.use.evaluation import Evaluation, Verification
from stcal.robot.use.pose_design import PoseDesign


def axes_report(result: AxesResult, where: str) -> Document:
    """Returns the report of ``axes``."""
    axes, pairs = [], []
    for fit in result.fits:
        length, sliding = fit.lengths(), fit.prismatic
        deviation = np.sqrt(np.diag(fit.covariance))
        span = f"{fit.span:.1f} mm" if sliding else f"{np.degrees(fit.span):.1f}°"
        lengths = (f"{value:.4f}" for value in (fit.rms_mm, length.mean(), rms(length)))
        place = NONE if sliding else f"{np.linalg.norm(deviation[2:]):.4f}"
        cells = [str(fit.joint + 1), str(len(fit.arcs)), str(len(length)), span, *lengths]
        axes.append([*cells, f"{1e6 * np.linalg.norm(deviation[:2]):.1f}", place])
    spreads = [result.without_one.spread(name) for name in ("distance", "normal")]
    for pair, distance, normal in zip(result.pairs, *spreads, strict=True):
        angles = (f"{np.degrees(angle):.4f}" for angle in (pair.angle_rad, pair.angle_sigma_rad))
        foot, foot_sigma = (None if v is None else v / 1e3 for v in (pair.foot_mm, pair.foot_sigma_mm))
        lengths = (pair.distance_mm, pair.distance_sigma_mm, distance, pair.normal_mm, pair.normal_sigma_mm, normal)
        kind = ("Hayati β" if pair.parallel else "D-H") + (", D-H refused" if pair.parallel and pair.refused else "")
        cells = [*angles, *(number(value, 4) for value in (*lengths, foot)), number(foot_sigma, 5), kind]
        pairs.append([f"{pair.joint}–{pair.joint + 1}", *cells])
    tools = [
        [called(name), *(number(v, 4) for v in tool.translation), number(result.tool_spread_mm[name], 3)]
        for name, tool in result.tools.items()
    ]
    rows = [
        [str(i), *(f"{v:.4f}" + (f" ± {s:.4f}" if s > 0 else "") for v, s in zip(*row, strict=True))]
        for i, row in enumerate(zip(result.rows * SHOWN, result.row_sigma * SHOWN, strict=True), 1)
    ]
    axis_heads = ("joint", "arcs", "points", "span", "RMS mm", "mean mm", "length RMS mm", "direction µrad", "place mm")
    pair_heads = ("joints", "angle °", "σ °", *("distance mm", "σ mm", "spread mm") * 2, "foot m", "σ m", "<row")
    of_axes = [
        page_only(
            "One fit for each joint over all arcs of all reflectors. Residuals: RMS of a coordinate (radial, axial), "
            "mean and RMS length of the points' vectors"
        ),
        Table(axis_heads, axes, [("", 4), ("residuals", 3), ("σ", 2)]),
        legend({"radial": AXIS_COLOURS[0], "axial (both across, if prismatic)": AXIS_COLOURS[2]}),
        plot(lambda: _residuals(result), "residuals of each joint's points", "Residuals, reflector by reflector"),
    ]
    of_pairs = [
        *(f"D-H value of joints {p.joint}–{p.joint + 1} refused: {p.refused}" for p in result.pairs if p.refused),
        Table(pair_heads, pairs, [("", 3), ("robust", 3), ("common normal", 5), ("", 1)]),
        f"spread: largest less smallest value when each of {len(result.without_one.lines)} rows (with its reflectors) "
        "is left out (to first order)",
        page_only(
            "Distance: of nearly parallel axes in the plane across the first that its row in the robot has (Hayati), "
            "of others along their common normal. Foot: of the common normal, along the first axis from where that was "
            "measured"
        ),
    ]
    robot = [
        f"convention {result.robot.convention}; ± σ where the axes determine the value, the others are kept from the "
        "robot file",
        Table(("joint", "a mm", "alpha °", "d mm", "theta °", "beta °"), rows),
        Table(["<on the flange", "x mm", "y mm", "z mm", "RMS over all rows mm"], tools),
    ]
    return Document(
        f"Axes of {result.robot.name}",
        where,
        [
            Section("Axes", of_axes, terminal=True),
            Section("Pairs of axes", of_pairs, terminal=True),
            Section("Robot", robot, terminal=True),
            Section("Notes", [bullets(result.notes)]),
        ],
    )


def _residuals(result: AxesResult) -> Drawing:
    drawing = Drawing(7.5, 2.9)
    shown = [fit.residuals[fit.weights > 0, :2] for fit in result.fits]
    joints = list(range(1, len(shown) + 1))
    extent = limits([0, *np.concatenate(shown).ravel()])
    axes = Axes(drawing, drawing.panels()[0], (0.5, len(joints) + 0.5), extent)
    axes.frame("joint", "residual, mm", "y", (joints, list(map(str, joints))))
    axes.level(0)
    for joint, used in zip(joints, shown, strict=True):
        at = joint + (np.linspace(-0.3, 0.3, len(used)) if len(used) > 1 else np.zeros(1))
        for k in range(2):
            axes.marks(at, used[:, k], "dot", 2.4, AXIS_COLOURS[2 * k])
    return drawing


def verification_figure(result: Verification) -> Drawing:
    """Returns the absolute distance error of each pose, with its mean, by set (figure 8 of Zhang & Wei 2017)."""
    drawing = Drawing(7.5, 3.4)
    at = np.arange(2, len(result.poses) + 1)
    sizes = [np.abs(each.error_mm) for each in result.sets]
    box = drawing.panels(top=12 + 14 * -(-len(sizes) // 2))[0]
    x, y = (1, at[-1] + 0.02 * len(at) + 0.5), limits(np.concatenate(sizes), low=0)
    axes = Axes(drawing, box, x, y)
    axes.frame("pose, in order of the file", "|distance error|, mm", "y", count_ticks(*x))
    colours = cycle([COLOURS[1], COLOURS[0], *COLOURS[2:]])  # warm for before, cool for after, then the others
    for k, (each, size, colour) in enumerate(zip(result.sets, sizes, colours, strict=False)):
        axes.lines([(at, size)], colour, 1.1)
        axes.marks(at, size, "dot", 2.6 if len(at) <= 120 else 1.1, colour)
        axes.level(each.mean_mm, colour, 0.9, DASH)
        if len(sizes) <= 4:
            label = f"{each.name}: mean {each.mean_mm:.3f}, max {each.max_mm:.3f} mm"
            drawing.key((box[0] + 240 * (k % 2), 10 + 14 * (k // 2)), {label: ("dot", colour)})
    return drawing


def verification_report(result: Verification, where: str) -> Document:
    """Returns the report of ``verify``."""

    def reduced(k: int, name: str) -> str:
        """Returns by how much a figure is less, per cent; none where the first one is 0."""
        less = result.reduction(k)[name] if k else np.nan
        return NONE if not np.isfinite(less) else f"{less:.1f} %" if less >= 0 else f"{-less:.1f} % more"

    rows = []
    for k, each in enumerate(result.sets):
        pairs = ((number(value, 4), reduced(k, name)) for name, value in each.figures().items())
        rows.append([each.name, *(cell for pair in pairs for cell in pair)])
    over = [("", 1), ("mean", 2), ("std", 2), ("max", 2), ("RMS of all pairs", 2)]
    errors = [
        [pose, number(distance, 3), *(number(each.error_mm[i], 4) for each in result.sets)]
        for i, (pose, distance) in enumerate(zip(result.poses[1:], result.distance_mm, strict=True))
    ]
    answer = [
        alarms(result.warnings),
        Table(["<set"] + ["mm", "less by"] * 4, rows, over),
        "mean, std and max are of absolute errors, which all include the error of the first position; the RMS over all "
        "pairs depends less on any one",
        plot(
            lambda: verification_figure(result),
            "distance error of each pose",
            "Dashed: mean of the set of the same colour",
        ),
    ]
    table = Table(["pose", "commanded distance mm", *(f"{e.name}: error mm" for e in result.sets)], errors)
    return Document(
        "Verification",
        f"{where}: distances of {len(result.poses) - 1} positions from the first (pose {result.poses[0]}), "
        "measured against commanded",
        [Section("Result", answer, terminal=True), Section("Poses", [table])],
    )


def compensation_report(result: Compensated) -> Document:
    """Returns the report of ``compensate``: nominal and compensated joint values of each pose."""
    robot, found, named = result.identified, result.found, any(result.targets.tools)

    def values(inverse: Inverse, i: int, error_mm: np.ndarray) -> list[str]:
        shown = [number(v, 5) if inverse.usable[i] else NONE for v in inverse.q[i] * robot.shown]
        return [*shown, number(error_mm[i], 4) if inverse.usable[i] or inverse is found else NONE]

    rows = []
    for i, (line, tool) in enumerate(zip(result.targets.lines, result.targets.tools, strict=True)):
        name = [str(line), *([tool or NONE] if named else []), found.status[i]]
        rows.append([*name, "compensated", *values(found, i, found.error_mm)])
        if result.nominal:
            rows.append([*[""] * len(name), "nominal", *values(result.nominal, i, result.before_mm)])
    counts = ", ".join(f"{s} {found.status.count(s)}" for s in dict.fromkeys(found.status))
    joints = (name.replace("_", " ") for name in joint_columns(robot))
    heads = ["line", *(["<target"] if named else []), "<status", "<", *joints, "error mm"]
    reached, *summary = compensated_summary(result)
    answer = Answer("yes" if found.usable.all() else "part" if found.usable.any() else "no", reached)
    return Document(
        f"Compensation of {robot.name}",
        f"{len(result)} poses: {counts}",
        [
            Section("Result", summary, terminal=True),
            Section("To know", [bullets(result.remarks[:MOST_NOTES])]),
            Section("Joint values", [Table(heads, rows)], terminal=True),
        ],
        [answer],
    )


def design_report(result: PoseDesign, robot: Robot) -> Document:
    """Returns the report of ``design``: indices of the chosen poses against random ones, places, joint values."""
    sigma_sentence = f"σ of predicted positions: {1000 * result.sigma_mm:.1f} µm per axis"
    if np.isfinite(result.random_sigma_mm):
        times = f"{(result.random_sigma_mm / result.sigma_mm) ** 2:.2f} times as many"
        of_random = f"of random poses {1000 * result.random_sigma_mm:.1f} µm"
        sigma_sentence += f", {of_random}; to be as good, these would have to be {times}"
    unseen = result.parameters - result.seen
    still = f"{unseen} of {result.parameters} combinations of parameters move nothing that is measured"
    left_out = f"{still}, in any pose (as with a tool on the last axis), and are left out"
    indices, median = [], result.median()
    for name, value in result.chosen.values().items():
        every = [each.values()[name] for each in result.random]
        ratio = number(value / median[name], 2) if median[name] > 0 else NONE
        cells = (f"{v:.4g}" for v in (value, median[name], min(every), max(every)))
        indices.append([name, *cells, ratio, "" if name == "O2" else "1/mm", MEANING[name]])
    heads = ["<", "chosen", "median", "least", "most", "chosen / median", "<unit", "<"]
    poses = [
        [str(i), *(number(float(v), 3) for v in (*joint_cells(robot, q), *pose.translation))]
        for i, (q, pose) in enumerate(zip(result.q, result.poses, strict=True), 1)
    ]
    against = [
        sigma_sentence,
        left_out if unseen else "",
        Table(heads, indices, [("", 2), (f"{len(result.random)} random sets", 3), ("", 3)]),
        page_only(
            "Larger is better. Of the Jacobian over the σ of the instrument, parameters in mm, an angle being the arc "
            "that it makes at the arm's whole reach"
        ),
        "collisions are not checked: only joint limits and the box of the tool",
    ]
    joints = (name.replace("_", " ") for name in joint_columns(robot))
    chosen = Table(["pose", *joints, "x mm", "y mm", "z mm"], poses)
    return Document(
        f"Measurement poses for {robot.name}",
        f"{len(result.q)} poses for {result.seen} parameters, {result.exchanges} exchanges after the greedy choice",
        [
            Section("Against random poses", against, terminal=True),
            Section("Poses", ["In order of choice: the first ones alone are a good set too", chosen]),
        ],
    )


MOST_NOTES = 500  # largest number of notes on single poses on a page
MOST_WRONG = 10  # largest number of wrong rows that are named in the terminal
FAR_APART = 5  # ratio of robots' median errors above which the axis is logarithmic
FITTED = {
    "none": "base and tool as the files have them",
    "base": "base fitted, tool as the files have it",
    "tool": "tool fitted, base as the files have it",
    "base-tool": "base and tool fitted by each robot's own axes",
}
HEADS = ("rows", "mean", "median", "RMS", "95 %", "max")


def names_of(files: Sequence[Path]) -> list[str]:
    """Returns names of robots by their files. An identified robot keeps the name of the nominal one."""
    stems, whole = [file.stem for file in files], [str(file) for file in files]
    for again in (name for name in whole if whole.count(name) > 1):
        raise InputError("E-OPTION-REPEATED", f"--robot {again}: given twice; give each file once")
    return stems if len(set(stems)) == len(stems) else whole


def _errors(result: Evaluation) -> Table:
    """Returns the errors of all observations, and of those without the wrong ones if there are any."""
    turned = any(each.orientation_rad for each in result.robots)
    heads, rows = ["<error, mm", *HEADS, *(("orientation, deg: RMS", "max") if turned else ())], []
    for each in result.robots:
        parts = {"": np.ones_like(each.good)} | ({", without unexplained": each.good} if result.wrong.any() else {})
        for said, taken in parts.items():
            count, *figures = astuple(Figures.of(each.errors_mm[taken]))
            if turned:
                rotation = Figures.of(np.degrees(each.rotation_rad[taken]))
                figures += [rotation.rms, rotation.max]
            rows.append([each.name + said, str(count), *(number(value, 4) for value in figures)])
    return Table(heads, rows)


def _verdicts(result: Evaluation) -> list[str]:
    """Returns which robot is better, and the rows that no robot explains."""
    found = []
    for each in result.differences:
        size = f"{each.mm:.3g} ± {each.sigma_mm:.2g} mm"
        if each.real:
            found.append(f"robot {each.better} is better than {each.worse}: mean error {size} less, on the same rows")
        else:
            found.append(f"robots {each.better} and {each.worse} differ by no more than chance: mean error {size}")
    if result.best and len(result.robots) > 2:
        found.append(f"best: {result.best}")
    least = np.min([each.errors_mm for each in result.robots], axis=0)
    at = sorted(np.flatnonzero(result.wrong).tolist(), key=lambda row: -least[row])
    if at:
        named = few([f"line {result.lines[i]} ({least[i]:.3g} mm)" for i in at], MOST_WRONG)
        fitted = "" if result.refit == "none" or result.seen.kind == "distance" else "; nothing is fitted to them"
        which = f"rows that no robot explains (the least error that any of them leaves): {named}{fitted}"
        found.append(f"{which}; the rows are wrong, or all models lack something")
    return found


@require_arguments
def evaluated_csv(result: Evaluation) -> str:
    """Returns the CSV of the residuals of ``result``, with a row for each measurement, mm and degrees (form:
    ``data_layout.md``)."""
    data, robots, seen = result.seen.data, result.robots, result.seen.first
    columns: list[tuple[str, Iterable]] = [("line", data.lines), ("target", data.targets)]

    def add(heads: Iterable[str], values: np.ndarray, digits: int = 6) -> None:
        """Adds a column for each of the values (m, c)."""
        columns.extend(zip(heads, [[f"{v:.{digits}f}" for v in each] for each in values.T], strict=True))

    add(joint_columns(robots[0].robot), data.q * robots[0].robot.shown, 9)
    if data.positions is not None:
        add(POSE[:3], data.positions)
    else:
        distances, from_row = data.lengths()
        add(["distance_mm"], distances[:, None])
        columns.append(("from_row", from_row + 1))
    if data.rotations is not None:
        add(QUATERNION, data.poses().quaternions(), 12)
    wrong = dict(zip(seen.tolist(), result.wrong.astype(int).tolist(), strict=True))
    columns.append(("wrong", [wrong.get(row, "") for row in range(len(data))]))  # a distance from itself is not judged
    for each in robots:
        name = re.sub(r"\W+", "_", each.name)
        residuals = np.zeros((len(data), each.residuals.shape[1]))
        residuals[seen] = each.residuals
        if data.positions is not None:
            place = "commanded" if len(robots) == 1 else name
            add([f"{place}_{column}" for column in POSE[:3]], each.state.tips_of(data).translation)
            add([f"{name}_residual_{column}" for column in POSE[:3]], residuals)
        else:
            add([f"{name}_residual_mm"], residuals)
        add([f"{name}_error_mm"], np.linalg.norm(residuals, axis=1)[:, None])
        if data.rotations is not None:
            add([f"{name}_error_deg"], np.degrees(each.rotation_rad)[:, None])
    heads, values = zip(*columns, strict=True)
    return csv_text([heads, *zip(*values, strict=True)])


def evaluation_report(result: Evaluation) -> Document:
    """Returns the report of ``evaluate``: errors of each robot, the better one, and the effects found in residuals."""
    seen = result.seen
    rigid = (each for each in result.robots if each.robot.elasticity is None)
    answer: list[Block] = [
        _errors(result),
        *_verdicts(result),
        *(note for each in rigid for note in seen.data.conditions.ignored(f"robot {each.name}")),
        page_only(
            "95 %: limit that 95 of 100 rows do not exceed. A few bad rows do not change the median, and the lines "
            "without rows that no robot explains"
        ),
        plot(lambda: _row_figure(result), "Error of each row"),
    ]
    robots: list[Block] = []
    for each, colour in zip(result.robots, cycle(COLOURS)):
        base = each.robot.world_from_base
        found = each.residuals @ base.rotation.T if each.residuals.shape[1] == 3 else each.residuals
        lines = left_lines(each.left)
        if each.left and each.beyond is not None:
            beyond = "; ".join(finding.what for finding in each.beyond)
            said = f"parameters of the kinematics do not explain all of it; what remains depends on {beyond}"
            lines.append(said if beyond else "parameters identified from these rows would explain all of it")
        robots += [
            subheading(each.name),
            *(f"{each.name}: {line}" for line in lines),
            residual_plot(each.state, seen, found, each.good, colour),
            page_only("Base in the instrument's frame, tools in the flange's; without σ: as the file has them"),
            page_only(placed_table(each.placed)),
        ]
    kind = "pose" if seen.data.rotations is not None else seen.kind
    return Document(
        "Robots evaluated",
        f"{seen.data.where}: {len(seen)} {kind}s; {FITTED[result.refit]}",
        [Section("Result", answer, terminal=True), Section("What each robot leaves", robots, terminal=True)],
    )


def _row_figure(result: Evaluation) -> Drawing:
    """Returns the errors of all robots by row, with unexplained rows ringed, logarithmically if needed."""
    drawing, rows = Drawing(9, 2.8), result.seen.first + 1
    every = np.concatenate([each.errors_mm for each in result.robots])
    middle = [each.position_mm.median for each in result.robots]
    wide = min(middle) > 0 and (max(middle) > FAR_APART * min(middle) or every.max() > 4 * FAR_APART * max(middle))
    y = log_limits(every) if wide else limits(every, low=0)
    axes = Axes(drawing, drawing.panels(top=24)[0], limits(rows), y, "y" if wide else "")
    axes.frame("row, in order of the file", "error, mm", "y")
    key = {}
    for each, colour in zip(result.robots, cycle(COLOURS)):
        axes.marks(rows, each.errors_mm, "dot", 3.6 if len(rows) <= 200 else 1.6, colour, 0.85)
        axes.marks(rows[result.wrong], each.errors_mm[result.wrong], "ring", 7, INK)
        key[each.name] = "dot", colour
    drawing.key((46, 10), key | ({"no robot explains": ("ring", INK)} if result.wrong.any() else {}))
    return drawing
