"""Text and page of measured axes."""

import numpy as np

from stcal.geometry.arrays import rms
from stcal.report.document import Document, Section, Table, bullets, legend, page_only, plot
from stcal.report.svg import AXIS_COLOURS, Axes, Drawing, limits
from stcal.report.text import NONE, number
from stcal.robot.axes.checks import Pair
from stcal.robot.axes.fit import AxisFit
from stcal.robot.axes.model import AxesResult
from stcal.robot.axes.sweeps import called
from stcal.robot.identification.prior import SHOWN


def _axis_cells(fit: AxisFit) -> list[str]:
    length = fit.lengths()
    sliding = len(fit.gain) == 2
    deviation = np.sqrt(np.diag(fit.covariance))
    return [
        str(fit.joint + 1),
        str(len(fit.arcs)),
        str(len(length)),
        f"{fit.span:.1f} mm" if sliding else f"{np.degrees(fit.span):.1f}°",
        f"{fit.rms_mm:.4f}",
        f"{length.mean():.4f}",
        f"{rms(length):.4f}",
        f"{1e6 * np.linalg.norm(deviation[:2]):.1f}",
        NONE if sliding else f"{np.linalg.norm(deviation[2:]):.4f}",
    ]


def _pair_cells(pair: Pair, spread: np.ndarray) -> list[str]:
    metres = [None if v is None else v / 1e3 for v in (pair.foot_mm, pair.foot_sigma_mm)]
    lengths = (pair.distance_mm, pair.distance_sigma_mm, spread[0], pair.normal_mm, pair.normal_sigma_mm, spread[1])
    return [
        _names(pair),
        *(f"{np.degrees(angle):.4f}" for angle in (pair.angle_rad, pair.angle_sigma_rad)),
        *(number(value, 4) for value in (*lengths, metres[0])),
        number(metres[1], 5),
        ("Hayati β" if pair.parallel else "D-H") + (", D-H refused" if pair.parallel and pair.refused else ""),
    ]


def _names(pair: Pair) -> str:
    return f"{pair.joint}–{pair.joint + 1}"


def axes_report(result: AxesResult, where: str) -> Document:
    """Returns the report of ``axes``."""
    tools = [
        [called(name), *(number(v, 4) for v in tool.translation), number(result.tool_spread_mm[name], 3)]
        for name, tool in result.robot.tools.items()
    ]
    rows = [
        [str(i), *(f"{v:.4f}" + (f" ± {s:.4f}" if s > 0 else "") for v, s in zip(*row, strict=True))]
        for i, row in enumerate(zip(result.rows * SHOWN, result.row_sigma * SHOWN, strict=True), 1)
    ]
    spread = np.stack([result.without_one.spread(name) for name in ("distance", "normal")], axis=1)
    axis_heads = ("joint", "arcs", "points", "span", "RMS mm", "mean mm", "length RMS mm", "direction µrad", "place mm")
    pair_heads = ("joints", "angle °", "σ °", *("distance mm", "σ mm", "spread mm") * 2, "foot m", "σ m", "<row")
    axes = [
        page_only(
            "One fit for each joint over all arcs of all reflectors. Residuals: RMS of a coordinate (radial, axial), "
            "mean and RMS length of the points' vectors"
        ),
        Table(axis_heads, [_axis_cells(fit) for fit in result.fits], [("", 4), ("residuals", 3), ("σ", 2)]),
        legend({"radial": AXIS_COLOURS[0], "axial (both across, if prismatic)": AXIS_COLOURS[2]}),
        plot(lambda: _residuals(result), "residuals of each joint's points", "Residuals, reflector by reflector"),
    ]
    pairs = [
        *(f"D-H value of joints {_names(p)} refused: {p.refused}" for p in result.pairs if p.refused),
        Table(
            pair_heads,
            [_pair_cells(pair, spread[pair.joint - 1]) for pair in result.pairs],
            [("", 3), ("robust", 3), ("common normal", 5), ("", 1)],
        ),
        f"spread: largest less smallest value when each of {len(result.without_one.lines)} rows (with its reflectors) "
        "is left out",
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
            Section("Axes", axes, terminal=True),
            Section("Pairs of axes", pairs, terminal=True),
            Section("Robot", robot, terminal=True),
            Section("Notes", [bullets(result.notes)]),
        ],
    )


def _residuals(result: AxesResult) -> Drawing:
    drawing = Drawing(7.5, 2.9)
    shown = {fit.joint + 1: fit.residuals[fit.weights > 0] for fit in result.fits}
    values = np.concatenate([used[:, :2].ravel() for used in shown.values()])
    joints = list(range(1, len(result.fits) + 1))
    axes = Axes(drawing, drawing.panels()[0], (0.5, len(joints) + 0.5), limits([0, *values]))
    axes.frame("joint", "residual, mm", "y", (joints, list(map(str, joints))))
    axes.level(0)
    for joint, used in shown.items():
        at = joint + (np.linspace(-0.3, 0.3, len(used)) if len(used) > 1 else np.zeros(1))
        for k in range(2):
            axes.marks(at, used[:, k], "dot", 2.4, AXIS_COLOURS[2 * k])
    return drawing
