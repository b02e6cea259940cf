"""``stcal handeye plan``: which robot poses to take next."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from stcal.cli.handeye.inputs import (
    LengthUnit,
    OwnBoard,
    OwnCamera,
    PosesAre,
    PosesFile,
    RotationOption,
    SetupOption,
    SourceFile,
    source_of,
)
from stcal.cli.options import (
    MOST_SEED,
    ColumnsFile,
    FirstColumns,
    FirstTable,
    JsonFile,
    Key,
    QuaternionOrder,
    Quaternions,
    SecondTable,
    Workers,
)
from stcal.cli.terminal import StageProgress, print_each, say, write


def plan(
    source: SourceFile = None,
    poses: PosesFile = None,
    camera: OwnCamera = None,
    board: OwnBoard = None,
    setup: SetupOption = None,
    rotation: RotationOption = None,
    length_unit: LengthUnit = None,
    poses_are: PosesAre = None,
    robot_file: Annotated[
        Path | None,
        typer.Option(
            "--robot",
            help="Plan only what this robot reaches within its joint limits (TOML), and name its joint values.",
        ),
    ] = None,
    count: Annotated[int, typer.Option(min=1, max=100, help="Name so many poses.")] = 3,
    seed: Annotated[int, typer.Option(min=0, max=MOST_SEED, help="Draw the candidates with this seed.")] = 0,
    out: Annotated[
        Path | None, typer.Option("--out", writable=True, help="Write the poses to this file (CSV).")
    ] = None,
    first: FirstTable = None,
    second: SecondTable = None,
    key: Key = "image",
    columns: ColumnsFile = None,
    columns_a: FirstColumns = None,
    quaternions: Quaternions = QuaternionOrder.wxyz,
    workers: Workers = None,
    json_file: JsonFile = None,
) -> None:
    """Name the robot poses that would lower the worst σ at the board most, after those of a hand-eye calibration."""
    from stcal.handeye.data.formats.record import Said
    from stcal.handeye.report.planned import planned_csv, planned_file, planned_text
    from stcal.robot import load_robot
    from stcal.workflows.handeye.inputs import read_input, setup_of
    from stcal.workflows.handeye.plan import plan_next

    said = Said.of_options(rotation or [], length_unit or [], poses_are or [], setup and setup.value)
    pairs = source_of(source, first, second, key, said, quaternions.value, None, columns, columns_a)
    said = replace(said, columns=columns) if isinstance(pairs, Path) and pairs.is_dir() else said
    robot = load_robot(robot_file) if robot_file else None
    with StageProgress() as progress:
        given = read_input(pairs, poses, camera, board, workers, progress, quaternions.value, said)
    for line in given.understood:
        say(line)
    found = plan_next(given, setup_of(said, given.setup, given.where), count, robot, seed)
    say(planned_text(found.result, found.poses, found.joints))
    for name, reason in given.left_out:
        say(f"left out {name}: {reason}")
    print_each("note", found.notes)
    if out:
        write(out, planned_csv(found.poses, found.joints))
    if json_file:
        write(json_file, planned_file(found.result, found.poses, found.joints))
