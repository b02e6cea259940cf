"""The page of a pose design: the indices against random choices, and where the poses are."""

from html import escape

import numpy as np

from stcal.report.figure import COLOURS, FAINT, INK, SMALL, calm, locator, new_figure, plane, uri
from stcal.report.page import page, plot, table
from stcal.report.text import NONE, number
from stcal.robot.identify.observability import MEANING
from stcal.robot.kinematics.model import Robot
from stcal.robot.use.compensation import joint_cells, joint_columns
from stcal.robot.use.design import PoseDesign


def design_page(result: PoseDesign, robot: Robot) -> str:
    """The report of ``design``."""
    banner = (
        f"<h1>Measurement poses for {escape(robot.name)}</h1>"
        f'<p class="counts">{len(result.q)} poses for {result.seen} parameters, {result.exchanges} exchanges after the '
        "greedy choice</p>\n"
    )
    sections = [
        ("indices", "Against random poses", _indices(result)),
        ("places", "Where the tool is", _places(result)),
        ("poses", "Poses", _poses(result, robot)),
    ]
    return page(f"Measurement poses for {robot.name}", banner, sections)


def _indices(result: PoseDesign) -> str:
    chosen, median = result.chosen.values(), result.median()
    rows = []
    for name, value in chosen.items():
        every = [each.values()[name] for each in result.random]
        ratio = number(value / median[name], 2) if median[name] > 0 else NONE
        unit = "" if name == "O2" else "1/mm"
        cells = [f"{v:.4g}" for v in (value, median[name], min(every), max(every))]
        rows.append([name, *cells, ratio, unit, MEANING[name]])
    heads = ["<", "chosen", "median", "least", "most", "chosen / median", "<unit", "<"]
    over = [("", 2), (f"{len(result.random)} random sets", 3), ("", 3)]
    figures = _sigma_text(result)
    if result.seen < result.parameters:
        figures += (
            f"<p>{result.parameters - result.seen} of {result.parameters} combinations of parameters move nothing that "
            "is measured, in any pose, and are left out.</p>\n"
        )
    text = (
        "<p>Larger is better. Of the Jacobian over the σ of the instrument, parameters in mm, an angle being the arc "
        "that it makes at the arm's whole reach.</p>\n"
    )
    drawn = uri(_index_figure(result))
    caption = "Each index over the median of the random sets; grey: the random sets, of as many poses each"
    drawn = plot(drawn, "indices of chosen and random poses", caption)
    return figures + table(heads, rows, over) + text + f'<div class="plots">{drawn}</div>\n'


def _sigma_text(result: PoseDesign) -> str:
    text = f"σ of predicted positions: {1000 * result.sigma_mm:.1f} µm per axis"
    if np.isfinite(result.random_sigma_mm):
        times = (result.random_sigma_mm / result.sigma_mm) ** 2
        text += (
            f", of random poses {1000 * result.random_sigma_mm:.1f} µm; to be as good these would have to be "
            f"{times:.2f} times as many"
        )
    return f"<p>{text}. Collisions are not looked at.</p>\n"


def _index_figure(result: PoseDesign):
    figure = new_figure(5, 2.9)
    axes = figure.add_axes((0.12, 0.12, 0.86, 0.82))
    chosen, median = result.chosen.values(), result.median()
    for i, (name, value) in enumerate(chosen.items()):
        if median[name] <= 0:
            continue
        every = np.array([each.values()[name] for each in result.random]) / median[name]
        axes.plot(i + np.linspace(-0.15, 0.15, len(every)), every, "o", ms=3, color="#9aa0a8", mew=0)
        axes.plot(i, value / median[name], "D", ms=6, color=COLOURS[0], mew=0, clip_on=False)
    axes.axhline(1, color=INK, lw=0.6)
    axes.set_xticks(range(len(chosen)), list(chosen))
    axes.set_xlim(-0.5, len(chosen) - 0.5)
    axes.set_ylim(0, None)
    axes.yaxis.set_major_locator(locator())
    axes.set_ylabel("over the median of random sets", fontsize=SMALL + 1, color=INK)
    calm(axes)
    axes.grid(axis="y", color=FAINT, lw=0.6)
    axes.set_axisbelow(True)
    return figure


def _places(result: PoseDesign) -> str:
    at, z = result.poses.translation, result.poses.rotation[:, :, 2]
    views = (("from above", 0, 1), ("from the side", 0, 2))
    figures = []
    length = 0.12 * float(np.ptp(at, axis=0).max())
    for title, i, j in views:
        figure = new_figure(5, 4.2)
        axes = figure.add_axes((0.15, 0.12, 0.83, 0.86))
        axes.quiver(
            at[:, i], at[:, j], z[:, i] * length, z[:, j] * length, angles="xy", scale_units="xy", scale=1,
            color=COLOURS[2], width=0.003, headwidth=4, headlength=5, clip_on=False,
        )  # fmt: skip
        axes.plot(at[:, i], at[:, j], "o", ms=4, color=COLOURS[0], mew=0)
        axes.plot(0, 0, "s", ms=6, color=INK, mew=0)
        plane(axes, "x, mm", f"{'xyz'[j]}, mm", 0.16)
        figures.append(plot(uri(figure), f"tool positions {title}", title.capitalize()))
    text = "<p>Tool in the robot's base (square: its origin); the arrow is the tool's z axis.</p>\n"
    return text + f'<div class="plots">{"".join(figures)}</div>\n'


def _poses(result: PoseDesign, robot: Robot) -> str:
    columns = [name.replace("_", " ") for name in joint_columns(robot)]
    rows = [
        [str(i), *(number(float(v), 3) for v in joint_cells(robot, q)), *(number(v, 2) for v in pose.translation)]
        for i, (q, pose) in enumerate(zip(result.q, result.poses, strict=True), 1)
    ]
    text = "<p>In order of choice: the first ones alone are a good set too.</p>\n"
    return text + table(["pose", *columns, "x mm", "y mm", "z mm"], rows)
