"""Commands ``stcal robot evaluate`` and ``verify``: robots are judged by new measurements."""

from pathlib import Path
from typing import Annotated, Literal

from stcal.cli import options as shared
from stcal.cli.declare import WRITES, Arg, Opt
from stcal.cli.terminal import print_each, say, write, write_if
from stcal.errors import InputError

RefitParts = Literal["none", "base", "tool", "base-tool"]
"""Transforms that are fitted again to the new measurements."""


def evaluate(
    robot_files: Annotated[
        list[Path], "Read a robot from this file (TOML); repeat it for more robots.", Opt("--robot")
    ],
    data_file: Annotated[
        Path | None, "Read joint values, and the measurements at each, from this file (CSV).", Arg("DATA")
    ] = None,
    refit: Annotated[
        RefitParts, "Fit this to the data, keeping each robot's own axes; everything else comes from its file."
    ] = "base-tool",
    out: Annotated[Path | None, "Write the residuals of each row to this file (CSV).", WRITES] = None,
    quaternions: shared.Quaternions = "wxyz",
    payload_kg: shared.PayloadKg = None,
    first: shared.FirstTable = None,
    second: shared.SecondTable = None,
    key: shared.Key = "image",
    columns: shared.ColumnsFile = None,
    columns_a: shared.FirstColumns = None,
    json_file: shared.JsonFile = None,
    report: shared.ReportFile = None,
) -> None:
    """Compare robot files on new measurements, and tell what their residuals depend on."""
    from stcal.robot.kinematics.file import load_robot
    from stcal.robot.kinematics.measurements import read_measurements
    from stcal.robot.use import report as shown
    from stcal.robot.use.evaluation import evaluate as evaluated

    robots = dict(zip(shown.names_of(robot_files), map(load_robot, robot_files), strict=True))
    source = shared.one_table(
        data_file, first, second, key, "DATA", quaternions=quaternions, columns=columns, columns_a=columns_a
    )
    data = [  # within reach of each
        read_measurements(source, robot, quaternions, payload_kg=payload_kg) for robot in robots.values()
    ]
    result = evaluated(robots, data[0], refit)
    document = shown.evaluation_report(result)
    say(document.text())
    print_each("note", data[0].notes)
    write_if(out, lambda: shown.evaluated_csv(result))
    if out:
        shown.require_evaluated_written(out, result)
    write_if(json_file, lambda: shown.evaluation_file(result))
    write_if(report, document.page)


def verify(
    measured: Annotated[
        Path | None, "Read commanded_x_mm …, measured x_mm … and set (before or after) from this file (CSV).", Arg()
    ] = None,
    plot: Annotated[Path | None, "Draw the error of each pose and set to this file (.png or .svg).", WRITES] = None,
    first: shared.FirstTable = None,
    seconds: Annotated[
        list[Path] | None,
        "Read the measurements from this file (CSV); several files are sets, named after the files.",
        Opt("--b", metavar="<path>"),
    ] = None,
    key: shared.Key = "pose",
    columns_a: shared.FirstColumns = None,
    columns: shared.ColumnsFile = None,
    json_file: shared.JsonFile = None,
    report: shared.ReportFile = None,
) -> None:
    """Compare distances of positions from the first one, measured and commanded, before and after compensation."""
    from stcal.io.join import stack_tables
    from stcal.robot.use import verification as stage
    from stcal.robot.use.report import verification_report

    if plot and plot.suffix.lower() not in (".png", ".svg"):
        raise InputError("E-OUTPUT-SUFFIX", f"--plot {plot}: a name ending in .png or .svg needed")
    tables = shared.several_tables(
        measured, first, seconds or [], key, "MEASURED", ("commanded_", ""), columns=columns, columns_a=columns_a
    )
    if isinstance(tables, list):
        tables = stack_tables(tables, [path.stem for path in seconds or ()], {"pose": key})
    result = stage.verify(stage.read_measured(tables))
    document = verification_report(result)
    say(document.text())
    print_each("note", result.notes)
    print_each("warning", result.warnings())
    if plot:
        from stcal.robot.use.report import figure_bytes, verification_figure

        write(plot, figure_bytes(verification_figure(result), plot.suffix.lower()[1:]))
    write_if(json_file, lambda: stage.verification_file(result))
    write_if(report, document.page)
