"""Command ``stcal handeye plan``: choice of the next robot poses."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import stcal.cli.handeye.inputs as params
from stcal.cli import options as shared
from stcal.cli.declare import WRITES, Opt
from stcal.cli.terminal import StageProgress, print_each, say, write_if


def plan(
    source: params.SourceFile = None,
    poses: params.PosesFile = None,
    camera: params.OwnCamera = None,
    board: params.OwnBoard = None,
    setup: params.SetupOption = None,
    rotation: params.RotationOption = None,
    length_unit: params.LengthUnit = None,
    poses_are: params.PosesAre = None,
    robot_file: Annotated[
        Path | None,
        "Plan only poses that this robot reaches within its joint limits (TOML), and give their joint values.",
        Opt("--robot"),
    ] = None,
    count: Annotated[int, "Name this many poses.", Opt(min=1, max=100)] = 3,
    seed: Annotated[int, "Draw the candidates with this seed.", Opt(min=0, max=shared.MOST_SEED)] = 0,
    out: Annotated[Path | None, "Write the poses to this file (CSV).", WRITES] = None,
    first: shared.FirstTable = None,
    second: shared.SecondTable = None,
    key: shared.Key = "image",
    columns: shared.ColumnsFile = None,
    columns_a: shared.FirstColumns = None,
    quaternions: shared.Quaternions = "wxyz",
    workers: shared.Workers = None,
    json_file: shared.JsonFile = None,
) -> None:
    """Name further robot poses that would lower the worst σ of a hand-eye calibration, at the board, most."""
    from stcal.handeye.data.formats.record import Said
    from stcal.handeye.report.planned import planned_csv, planned_file, planned_report
    from stcal.io.table import require_pose_table_written
    from stcal.robot import load_robot
    from stcal.workflows.handeye.inputs import read_handeye
    from stcal.workflows.handeye.plan import plan_handeye

    statements = Said.of_options(rotation or [], length_unit or [], poses_are or [], setup)
    pairs = params.source_of(source, first, second, key, statements, quaternions, None, columns, columns_a)
    statements = replace(statements, columns=columns) if isinstance(pairs, Path) and pairs.is_dir() else statements
    robot = load_robot(robot_file) if robot_file else None
    with StageProgress() as progress:
        inputs = read_handeye(
            pairs,
            poses,
            camera,
            board,
            setup=setup,
            rotation=rotation or (),
            length_unit=length_unit or (),
            poses_are=poses_are or (),
            quaternions=quaternions,
            columns=statements.columns,
            workers=workers,
            progress=progress,
        )
    for line in inputs.understood:
        say(line)
    planned = plan_handeye(inputs, count, robot, seed)
    say(planned_report(planned.result, planned.poses, planned.joints).text())
    for name, reason in inputs.left_out:
        say(f"left out {name}: {reason}")
    print_each("note", planned.notes)
    write_if(out, lambda: planned_csv(planned.poses, planned.joints))
    if out:
        frames = ("base_from_flange", "camera_from_board")
        require_pose_table_written(out, {f"{name}_": getattr(planned.poses, name) for name in frames})
    write_if(json_file, lambda: planned_file(planned.result, planned.poses, planned.joints))
