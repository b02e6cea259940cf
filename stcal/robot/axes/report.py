"""Text, page and result file of measured axes."""

from collections.abc import Mapping
from typing import Literal

import numpy as np
from pydantic import Field

import stcal
from stcal.geometry.arrays import rms
from stcal.io.json import ByName, Finite, Matrix, Part, Pose, ResultFile, Vector3
from stcal.report.document import Document, Section, Table, bullets, legend, page_only, plot
from stcal.report.svg import AXIS_COLOURS, Axes, Drawing, limits
from stcal.report.text import number
from stcal.robot.axes.checks import LeaveOneOut, Pair
from stcal.robot.axes.fit import AxisFit
from stcal.robot.axes.model import AxesResult
from stcal.robot.axes.sweeps import called
from stcal.robot.identification.prior import DIMENSIONS, SHOWN, dh_values
from stcal.robot.kinematics.file import robot_toml


class ArcRow(Part):
    target: str
    points: int
    radius_mm: Finite
    height_mm: Finite


class OffRow(Part):
    line: int
    error_mm: float


class AxisRow(Part):
    joint: int
    direction: Vector3
    point_mm: Vector3
    world_from_axis: Pose
    covariance: Matrix
    residual_rms_mm: float
    residual_length_mean_mm: float
    residual_length_rms_mm: float
    sigma_mm: float
    dof: int
    span_mm: float | None = None
    span_rad: float | None = None
    arcs: list[ArcRow]
    outliers: list[OffRow]


class DhRow(Part):
    a_mm: float
    alpha_rad: float
    d_mm: float
    theta_rad: float
    beta_rad: float
    a_sigma_mm: float
    alpha_sigma_rad: float
    d_sigma_mm: float
    theta_sigma_rad: float
    beta_sigma_rad: float


class TargetRow(Part):
    xyz_flange_mm: Vector3
    rms_mm: float


class AxisPair(Part):
    joints: list[int]
    angle_rad: float
    angle_sigma_rad: float
    hayati: bool
    distance_mm: float | None
    distance_sigma_mm: float | None
    normal_mm: float | None
    normal_sigma_mm: float | None
    foot_mm: float | None
    foot_sigma_mm: float | None
    refused: str
    leave_one_out_distance_spread_mm: Finite
    leave_one_out_normal_spread_mm: Finite


class LeaveOneOutRows(Part):
    lines: list[int]
    distance_mm: list[list[Finite]]
    normal_mm: list[list[Finite]]


class AxesFile(ResultFile):
    """The result file of ``axes``."""

    format: Literal["stcal axes 1"] = Field(description="the file's form and its version")
    version: str = Field(description="of stcal")
    robot: str = Field(description="text of the robot file")
    axes: list[AxisRow] = Field(
        description="`joint`; `direction` of positive motion and `point_mm` of the axis in the instrument's frame, all "
        "joints at zero; `world_from_axis` 4×4, z along the axis; `covariance` of rx, ry (rad), tx, ty (mm) in that "
        "frame (prismatic: rx, ry) by the noise of its own sweeps; residuals of the points used: `residual_rms_mm` of "
        "a coordinate, `residual_length_mean_mm` and `residual_length_rms_mm` of the vectors (radial, axial); "
        "`sigma_mm` of a coordinate, `dof`; `span_rad` or `span_mm`; `arcs` with `target`, `points`, `radius_mm`, "
        "`height_mm`; `outliers`: rows off their arcs and left out, `line` and `error_mm`"
    )
    covariance: Matrix = Field(
        description="of all axes together, in the order of `axes`, with what each inherits from those before"
    )
    rows: list[DhRow] = Field(
        description="`a_mm`, `alpha_rad`, `d_mm`, `theta_rad`, `beta_rad` and their `a_sigma_mm`, `alpha_sigma_rad`, "
        "`d_sigma_mm`, `theta_sigma_rad`, `beta_sigma_rad`; σ 0: kept from the robot given"
    )
    targets: dict[ByName, TargetRow] = Field(
        description="`xyz_flange_mm`; `rms_mm` of all rows about it: encoders, gears and elasticity are in it"
    )
    pairs: list[AxisPair] = Field(
        description="`joints`; `angle_rad`, `angle_sigma_rad`; `hayati`: within 1° of parallel; `distance_mm`, "
        "`distance_sigma_mm`: along the common normal, of near-parallel axes in the plane of their row; `normal_mm`, "
        "`foot_mm` and their σ `normal_sigma_mm`, `foot_sigma_mm`: the common normal, and its foot along the first "
        'axis from where that was measured; `refused`: why these must not be used, or `""`; '
        "`leave_one_out_distance_spread_mm`, `leave_one_out_normal_spread_mm`"
    )
    leave_one_out: LeaveOneOutRows = Field(
        description="`lines` of the rows left out (with all reflectors), `distance_mm`, `normal_mm` of each pair "
        "without them, signed as `a`"
    )
    notes: list[str] = Field(
        description="rows left out as grossly wrong, reflectors too close to an axis, arcs too short; columns that "
        "were not read, angles by their convention"
    )


def _axis_cells(fit: AxisFit) -> list[str]:
    length = fit.lengths()
    sliding = len(fit.gain) == 2
    deviation = np.sqrt(np.diag(fit.covariance))
    return [
        str(fit.joint + 1),
        str(len(fit.arcs)),
        str(len(length)),
        f"{fit.span:.1f} mm" if sliding else f"{np.degrees(fit.span):.1f}°",
        f"{rms(length) / np.sqrt(2):.4f}",
        f"{length.mean():.4f}",
        f"{rms(length):.4f}",
        f"{1e6 * np.linalg.norm(deviation[:2]):.1f}",
        "–" if sliding else f"{np.linalg.norm(deviation[2:]):.4f}",
    ]


def _names(pair: Pair) -> str:
    return f"{pair.joint + 1}–{pair.joint + 2}"


def _pair_cells(pair: Pair) -> list[str]:
    metres = [None if v is None else v / 1e3 for v in (pair.foot, pair.foot_sigma)]
    return [
        _names(pair),
        f"{np.degrees(pair.angle):.4f}",
        f"{np.degrees(pair.angle_sigma):.4f}",
        number(pair.distance, 4),
        number(pair.distance_sigma, 4),
        number(pair.normal, 4),
        number(pair.normal_sigma, 4),
        number(metres[0], 4),
        number(metres[1], 5),
        ("Hayati β" if pair.parallel else "D-H") + (", D-H refused" if pair.parallel and pair.refused else ""),
    ]


def _row_cells(result: AxesResult) -> list[list[str]]:
    values, sigma = dh_values(result.robot) * SHOWN, result.row_sigma * SHOWN
    return [
        [str(i), *(f"{v:.4f}" + (f" ± {s:.4f}" if s > 0 else "") for v, s in zip(*row, strict=True))]
        for i, row in enumerate(zip(values, sigma, strict=True), 1)
    ]


def axes_file(result: AxesResult) -> AxesFile:
    """Returns the result as plain values: mm, rad; None where there is no value."""
    return AxesFile.model_validate(
        {
            "format": "stcal axes 1",
            "version": stcal.__version__,
            "robot": robot_toml(result.robot),
            "axes": [_axis_json(fit, off) for fit, off in zip(result.fits, result.off, strict=True)],
            "covariance": result.covariance,
            "rows": [
                {f"{key}{_unit(key)}": value for key, value in zip(DIMENSIONS, row, strict=True)}
                | {f"{key}_sigma{_unit(key)}": value for key, value in zip(DIMENSIONS, sigma, strict=True)}
                for row, sigma in zip(dh_values(result.robot).tolist(), result.row_sigma.tolist(), strict=True)
            ],
            "targets": {
                name: {"xyz_flange_mm": tool.translation, "rms_mm": result.tool_spread_mm[name]}
                for name, tool in result.robot.tools.items()
            },
            "pairs": [_pair_json(pair, result.without_one) for pair in result.pairs],
            "leave_one_out": {
                "lines": list(result.without_one.lines),
                "distance_mm": result.without_one.distance.tolist(),
                "normal_mm": result.without_one.normal.tolist(),
            },
            "notes": list(result.notes),
        }
    )


def _unit(key: str) -> str:
    return "_mm" if key in ("a", "d") else "_rad"


def _axis_json(fit: AxisFit, off: Mapping[int, float]) -> dict:
    length = fit.lengths()
    return {
        "joint": fit.joint + 1,
        "direction": fit.world_from_axis.rotation[:, 2].tolist(),
        "point_mm": fit.world_from_axis.translation.tolist(),
        "world_from_axis": fit.world_from_axis.matrix().tolist(),
        "covariance": fit.covariance.tolist(),
        "residual_rms_mm": rms(length) / np.sqrt(2),
        "residual_length_mean_mm": float(length.mean()),
        "residual_length_rms_mm": rms(length),
        "sigma_mm": fit.sigma_mm,
        "dof": fit.redundancy,
        "span_mm" if len(fit.gain) == 2 else "span_rad": fit.span,
        "arcs": [
            {"target": arc.target, "points": len(arc.rows), "radius_mm": r, "height_mm": h}
            for arc, r, h in zip(fit.arcs, fit.radii, fit.heights, strict=True)
        ],
        "outliers": [{"line": line, "error_mm": size} for line, size in off.items()],
    }


def _pair_json(pair: Pair, without_one: LeaveOneOut) -> dict:
    lengths = ("distance", "distance_sigma", "normal", "normal_sigma", "foot", "foot_sigma")
    return {
        "joints": [pair.joint + 1, pair.joint + 2],
        "angle_rad": pair.angle,
        "angle_sigma_rad": pair.angle_sigma,
        "hayati": pair.parallel,
        **{f"{name}_mm": getattr(pair, name) for name in lengths},
        "refused": pair.refused,
        **{f"leave_one_out_{name}_spread_mm": without_one.spread(name)[pair.joint] for name in ("distance", "normal")},
    }


def axes_report(result: AxesResult, where: str) -> Document:
    """Returns the report of ``axes``."""
    tools = [
        [called(name), *(number(v, 4) for v in tool.translation), number(result.tool_spread_mm[name], 3)]
        for name, tool in result.robot.tools.items()
    ]
    distance, normal = (result.without_one.spread(name) for name in ("distance", "normal"))
    spreads = [[_names(p), number(distance[p.joint], 4), number(normal[p.joint], 4)] for p in result.pairs]
    axis_heads = ("joint", "arcs", "points", "span", "RMS mm", "mean mm", "length RMS mm", "direction µrad", "place mm")
    pair_heads = ("joints", "angle °", "σ °", "distance mm", "σ mm", "a mm", "σ mm", "foot m", "σ m", "<row")
    return Document(
        f"Axes of {result.robot.name}",
        where,
        [
            Section(
                "Axes",
                [
                    page_only(
                        "One fit for each joint over all arcs of all reflectors. Residuals: RMS of a coordinate "
                        "(radial, axial), mean and RMS length of the points' vectors"
                    ),
                    Table(
                        axis_heads,
                        [_axis_cells(fit) for fit in result.fits],
                        [("", 4), ("residuals", 3), ("σ", 2)],
                    ),
                    legend({"radial": AXIS_COLOURS[0], "axial (both across, if prismatic)": AXIS_COLOURS[2]}),
                    plot(
                        lambda: _residuals(result),
                        "residuals of each joint's points",
                        "Residuals, reflector by reflector",
                    ),
                ],
                terminal=True,
            ),
            Section(
                "Pairs of axes",
                [
                    *(f"D-H value of joints {_names(p)} refused: {p.refused}" for p in result.pairs if p.refused),
                    Table(
                        pair_heads,
                        [_pair_cells(pair) for pair in result.pairs],
                        [("", 3), ("robust", 2), ("common normal", 4), ("", 1)],
                    ),
                    page_only(
                        "Distance: of nearly parallel axes in the plane across the first that its row in the robot "
                        "has (Hayati), of others along their common normal. Foot: of the common normal, along the "
                        "first axis from where that was measured"
                    ),
                ],
                terminal=True,
            ),
            Section(
                "Leave-one-out",
                [
                    f"largest less smallest value when each of {len(result.without_one.lines)} rows (with its "
                    "reflectors) is left out",
                    Table(("joints", "distance mm", "D-H a mm"), spreads),
                ],
                terminal=True,
            ),
            Section(
                "Robot",
                [
                    f"convention {result.robot.convention}; ± σ where the axes determine the value, the others are "
                    "kept from the robot file",
                    Table(("joint", "a mm", "alpha °", "d mm", "theta °", "beta °"), _row_cells(result)),
                    Table(["<on the flange", "x mm", "y mm", "z mm", "RMS over all rows mm"], tools),
                ],
                terminal=True,
            ),
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
