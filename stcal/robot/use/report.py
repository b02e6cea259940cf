"""Pages and plots of compensation and verification."""

import io

import numpy as np

from stcal.report.figure import COLOURS, FAINT, INK, SMALL, calm, locator, new_figure, uri
from stcal.report.page import render
from stcal.report.text import NONE, number
from stcal.robot.kinematics.inverse import Inverse
from stcal.robot.kinematics.model import Robot
from stcal.robot.use.compensation import Compensated, compensated_summary, joint_columns
from stcal.robot.use.verification import Verification

MOST_ROWS = 500
"""Rows of a table on a page; more are in the CSV file."""


def verification_figure(result: Verification):
    """Absolute distance error of each pose, a line for each set, and its mean (the paper's fig. 8)."""
    figure = new_figure(7.5, 3.4)
    axes = figure.add_axes((0.09, 0.16, 0.89, 0.7))
    at = np.arange(2, len(result.poses) + 1)
    for each, colour in zip(result.sets, _colours(len(result.sets)), strict=True):
        few = len(at) <= 120
        label = f"{each.name}: mean {each.mean_mm:.3f}, max {each.max_mm:.3f} mm"
        size = np.abs(each.error_mm)
        axes.plot(at, size, color=colour, lw=1.1, marker="o" if few else None, ms=2.6, label=label, clip_on=False)
        axes.axhline(each.mean_mm, color=colour, lw=0.9, ls=(0, (5, 4)), alpha=0.8)
    _pose_by_pose(axes, (1, at[-1] + 0.02 * len(at) + 0.5), "|distance error|, mm")
    if len(result.sets) <= 4:
        place = {"loc": "lower left", "bbox_to_anchor": (0, 1), "ncols": 2, "borderaxespad": 0.2}
        axes.legend(fontsize=SMALL + 0.5, frameon=False, **place)
    return figure


def figure_bytes(figure, kind: str) -> bytes:
    """The figure as ``png`` or ``svg``, the same bytes for the same figure."""
    import matplotlib

    stream = io.BytesIO()
    with matplotlib.rc_context({"svg.fonttype": "path", "svg.hashsalt": "stcal"}):
        metadata = {"Date": None, "Creator": None} if kind == "svg" else {"Software": None}
        figure.savefig(stream, format=kind, dpi=160, facecolor="white", metadata=metadata)
    return stream.getvalue()


def verification_page(result: Verification) -> str:
    """The report of ``verify``."""
    rows = []
    for k, each in enumerate(result.sets):
        reduced = result.reduction(k) if k else {}
        cells = [[number(v, 4), number(reduced.get(key), 1)] for key, v in each.figures().items()]
        rows.append([each.name, *(c for pair in cells for c in pair)])
    return render(
        "robot/use/verification.html.jinja",
        result=result,
        figures=rows,
        drawn=uri(verification_figure(result)),
        names=[f"{each.name}: error mm" for each in result.sets],
        every=[
            [result.poses[i + 1], number(result.distance_mm[i], 3), *(number(s.error_mm[i], 4) for s in result.sets)]
            for i in range(min(MOST_ROWS, len(result.distance_mm)))
        ],
    )


def compensation_page(result: Compensated, robot: Robot) -> str:
    """The report of ``compensate``."""
    return render(
        "robot/use/compensation.html.jinja",
        robot=robot.name,
        count=len(result),
        counts=", ".join(f"{s} {result.found.status.count(s)}" for s in dict.fromkeys(result.found.status)),
        summary=compensated_summary(result),
        before=_before_plot(result) if result.compared().any() else "",
        notes=[*result.targets.notes, *result.notes()],
        most_rows=MOST_ROWS,
        named=any(result.targets.tools),
        joints=[name.replace("_", " ") for name in joint_columns(robot)],
        rows=_joint_rows(result, robot),
    )


def _before_plot(result: Compensated) -> str:
    figure = new_figure(7.5, 2.8)
    axes = figure.add_axes((0.09, 0.18, 0.89, 0.76))
    rows = np.flatnonzero(result.compared())
    axes.vlines(rows + 1, 0, result.before_mm[rows], color=COLOURS[1], lw=max(0.5, min(3, 300 / len(result))))
    _pose_by_pose(axes, (0.2, len(result) + 0.8), "position error, mm")
    return uri(figure)


def _pose_by_pose(axes, limits: tuple[float, float], what: str) -> None:
    """Axes of an error of each pose."""
    axes.set_xlim(*limits)
    axes.set_ylim(0, None)
    calm(axes)
    axes.grid(axis="y", color=FAINT, lw=0.6)
    axes.set_axisbelow(True)
    axes.xaxis.set_major_locator(locator(integer=True))
    axes.set_xlabel("pose, in order of the file", fontsize=SMALL + 1, color=INK)
    axes.set_ylabel(what, fontsize=SMALL + 1, color=INK)


def _joint_rows(result: Compensated, robot: Robot) -> list[list[str]]:
    unit = np.where(robot.prismatic, 1.0, np.degrees(1.0))
    n, named = len(robot.prismatic), any(result.targets.tools)

    def values(found: Inverse, i: int) -> list[str]:
        return [number(v, 5) for v in found.q[i] * unit] if found.usable[i] else [NONE] * n

    rows = []
    for i in range(min(MOST_ROWS, len(result))):
        name = [
            str(result.targets.lines[i]),
            *([result.targets.tools[i] or NONE] if named else []),
            result.found.status[i],
        ]
        rows.append([*name, "compensated", *values(result.found, i), number(result.found.error_mm[i], 4)])
        if result.nominal:
            error = number(result.before_mm[i], 4) if result.nominal.usable[i] else NONE
            rows.append([*[""] * len(name), "nominal", *values(result.nominal, i), error])
    return rows


def _colours(count: int) -> list[str]:
    """Returns the colours: warm for before, cool for after, then the rest of the palette."""
    order = [COLOURS[1], COLOURS[0], *COLOURS[2:]]
    return [order[i % len(order)] for i in range(count)]
