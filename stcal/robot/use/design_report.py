"""The page of a pose design: the indices against random choices, and where the poses are."""

import numpy as np

from stcal.report.figure import COLOURS, FAINT, INK, SMALL, calm, locator, new_figure, plane, uri
from stcal.report.page import render
from stcal.report.text import NONE, number
from stcal.robot.identification.observability import MEANING
from stcal.robot.kinematics.model import Robot
from stcal.robot.use.compensation import joint_cells, joint_columns
from stcal.robot.use.design import PoseDesign


def design_page(result: PoseDesign, robot: Robot) -> str:
    """The report of ``design``."""
    known = np.isfinite(result.random_sigma_mm)
    return render(
        "robot/use/design.html.jinja",
        robot=robot.name,
        result=result,
        times=(result.random_sigma_mm / result.sigma_mm) ** 2 if known else None,
        indices=_indices(result),
        index_plot=uri(_index_figure(result)),
        views=[(_places(result, 1), "from above"), (_places(result, 2), "from the side")],
        joints=[name.replace("_", " ") for name in joint_columns(robot)],
        poses=[
            [str(i), *(number(float(v), 3) for v in joint_cells(robot, q)), *(number(v, 2) for v in pose.translation)]
            for i, (q, pose) in enumerate(zip(result.q, result.poses, strict=True), 1)
        ],
    )


def _indices(result: PoseDesign) -> list[list[str]]:
    median = result.median()
    rows = []
    for name, value in result.chosen.values().items():
        every = [each.values()[name] for each in result.random]
        ratio = number(value / median[name], 2) if median[name] > 0 else NONE
        unit = "" if name == "O2" else "1/mm"
        rows.append([name, *(f"{v:.4g}" for v in (value, median[name], min(every), max(every)))])
        rows[-1] += [ratio, unit, MEANING[name]]
    return rows


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


def _places(result: PoseDesign, up: int) -> str:
    """Plot of the tool's positions and z axes: x against the coordinate ``up``."""
    at, z = result.poses.translation[:, [0, up]], result.poses.rotation[:, [0, up], 2]
    length = 0.12 * float(np.ptp(result.poses.translation, axis=0).max())
    figure = new_figure(5, 4.2)
    axes = figure.add_axes((0.15, 0.12, 0.83, 0.86))
    axes.quiver(
        *at.T, *(z * length).T, angles="xy", scale_units="xy", scale=1,
        color=COLOURS[2], width=0.003, headwidth=4, headlength=5, clip_on=False,
    )  # fmt: skip
    axes.plot(*at.T, "o", ms=4, color=COLOURS[0], mew=0)
    axes.plot(0, 0, "s", ms=6, color=INK, mew=0)
    plane(axes, "x, mm", f"{'xyz'[up]}, mm", 0.16)
    return uri(figure)
