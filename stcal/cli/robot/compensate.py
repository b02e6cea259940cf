"""``stcal robot compensate``: joint values that reach what was commanded."""

from pathlib import Path
from typing import Annotated

import typer

from stcal.cli.options import (
    FirstTable,
    JsonFile,
    Key,
    QuaternionOrder,
    Quaternions,
    ReportFile,
    Rotation,
    SecondTable,
    one_table,
)
from stcal.cli.terminal import print_each, say, write
from stcal.errors import DegenerateError


def compensate(
    robot_file: Annotated[Path, typer.Option("--robot", help="Read the identified robot from this file (TOML).")],
    targets: Annotated[
        Path | None, typer.Argument(help="Read commanded poses or joint values from this file (CSV).")
    ] = None,
    nominal: Annotated[
        Path | None, typer.Option("--nominal", help="Read the robot as its controller has it from this file (TOML).")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", writable=True, help="Write joint values to send, with status and errors, to this file (CSV)."
        ),
    ] = None,
    quaternions: Quaternions = QuaternionOrder.wxyz,
    rotation: Rotation = None,
    first: FirstTable = None,
    second: SecondTable = None,
    key: Key = "pose",
    json_file: JsonFile = None,
    report: ReportFile = None,
) -> None:
    """Compute joint values that really reach commanded poses, beside the nominal ones."""
    from stcal.robot.kinematics.file import load_robot
    from stcal.robot.use import compensation as stage
    from stcal.robot.use.targets import read_targets

    identified = load_robot(robot_file)
    source = one_table(targets, first, second, key, "TARGETS", quaternions=quaternions.value)
    wanted = read_targets(source, identified, quaternions.value, rotation)
    result = stage.compensate(identified, wanted, load_robot(nominal) if nominal else None)
    say(stage.compensated_text(result, identified))
    for line in stage.compensated_summary(result):
        say(line)
    print_each(f"note: {wanted.where}", wanted.notes)
    print_each(f"warning: {wanted.where}", result.notes())
    if out:
        write(out, stage.compensated_csv(result, identified))
    if json_file:
        write(json_file, stage.compensation_file(result, identified))
    if report:
        from stcal.robot.use.report import compensation_page

        write(report, compensation_page(result, identified))
    if not result.found.usable.any():
        raise DegenerateError(f"{wanted.where}: none of {len(result)} poses is reached; see the warnings above")
