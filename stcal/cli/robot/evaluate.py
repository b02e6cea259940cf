"""``stcal robot evaluate``: robot files on measurements that they were not made from."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from stcal.cli.options import (
    FirstTable,
    JsonFile,
    Key,
    PayloadKg,
    QuaternionOrder,
    Quaternions,
    ReportFile,
    SecondTable,
    one_table,
)
from stcal.cli.terminal import print_each, say, write


class RefitParts(StrEnum):
    """What is fitted anew."""

    none = "none"
    base = "base"
    tool = "tool"
    both = "base-tool"


def evaluate(
    robot_files: Annotated[
        list[Path], typer.Option("--robot", help="Read a robot from this file (TOML); give it again for others.")
    ],
    data_file: Annotated[
        Path | None,
        typer.Argument(metavar="DATA", help="Read joint values with what was measured there from this file (CSV)."),
    ] = None,
    refit: Annotated[
        RefitParts,
        typer.Option(help="Fit this to the data with each robot's own axes; the rest is taken from its file."),
    ] = RefitParts.both,
    out: Annotated[
        Path | None, typer.Option("--out", writable=True, help="Write the residuals of each row to this file (CSV).")
    ] = None,
    quaternions: Quaternions = QuaternionOrder.wxyz,
    payload_kg: PayloadKg = None,
    first: FirstTable = None,
    second: SecondTable = None,
    key: Key = "image",
    json_file: JsonFile = None,
    report: ReportFile = None,
) -> None:
    """Compare robot files on new measurements, and tell what their residuals go with."""
    from stcal.robot.kinematics.file import load_robot
    from stcal.robot.kinematics.measurements import read_measurements
    from stcal.robot.use import report as shown
    from stcal.robot.use.evaluation import evaluate as evaluated

    robots = dict(zip(shown.names_of(robot_files), map(load_robot, robot_files), strict=True))
    source = one_table(data_file, first, second, key, "DATA", quaternions=quaternions.value)
    data = [  # within reach of each
        read_measurements(source, robot, quaternions.value, payload_kg=payload_kg) for robot in robots.values()
    ]
    result = evaluated(robots, data[0], refit.value)
    say(shown.evaluated_text(result))
    print_each("note", data[0].notes)
    if out:
        write(out, shown.evaluated_csv(result))
    if json_file:
        write(json_file, shown.evaluation_file(result))
    if report:
        write(report, shown.evaluation_page(result))
