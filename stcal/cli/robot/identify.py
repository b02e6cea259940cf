"""Command ``stcal robot identify``: kinematics from poses, positions or distances."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

from stcal.cli.declare import WRITES, Arg, Opt
from stcal.cli.options import (
    MOST_SEED,
    ColumnsFile,
    FirstColumns,
    FirstTable,
    JsonFile,
    Key,
    PayloadKg,
    QuaternionOrder,
    Quaternions,
    ReportFile,
    RobotFile,
    Rotation,
    SecondTable,
    name_of,
    one_table,
)
from stcal.cli.terminal import say, write, write_if


class Kind(StrEnum):
    """Quantity that is used of the measurements."""

    pose = "pose"
    position = "position"
    distance = "distance"


class Model(StrEnum):
    """Model of the arm."""

    rigid = "rigid"
    elastic = "elastic"
    auto = "auto"


def identify(
    robot_file: RobotFile,
    data_file: Annotated[
        Path | None, "Read joint values with what was measured there from this file (CSV).", Arg("DATA")
    ] = None,
    out: Annotated[Path | None, "Write the identified robot to this file (TOML).", WRITES] = None,
    offsets: Annotated[
        Path | None, "Write mastering offsets and differences of D-H values to this file (CSV).", WRITES
    ] = None,
    observe: Annotated[Kind | None, "Use this of the measurements; the most that was measured if not given."] = None,
    sigma_mm: Annotated[
        float | None, "Set σ of a measured position, mm per axis; estimated if not given.", Opt(min=1e-9, max=1e4)
    ] = None,
    sigma_rad: Annotated[
        float | None, "Set σ of a measured orientation, rad per axis; estimated if not given.", Opt(min=1e-12, max=4)
    ] = None,
    folds: Annotated[int, "Cross-validate with this many folds; 0 for none.", Opt(min=0, max=100_000)] = 6,
    seed: Annotated[int, "Divide the rows into folds with this seed.", Opt(min=0, max=MOST_SEED)] = 0,
    robust: Annotated[bool, "Give outliers less weight, or all rows the same.", Opt("--robust/--least-squares")] = True,
    partial: Annotated[bool, "Keep parameters nominal that the data leave open, rather than refuse the data."] = False,
    adjust: Annotated[
        str,
        "Adjust base and tools (base,tool), also zero positions of joints (zeros), or their geometry, or all.",
        Opt(metavar="WHAT"),
    ] = "all",
    model: Annotated[
        Model,
        "Take the arm as rigid, or as elastic: links give way to gravity, gears turn unevenly; auto chooses by "
        "rows held out.",
    ] = Model.rigid,
    quaternions: Quaternions = QuaternionOrder.wxyz,
    rotation: Rotation = None,
    payload_kg: PayloadKg = None,
    first: FirstTable = None,
    second: SecondTable = None,
    key: Key = "image",
    columns_a: FirstColumns = None,
    columns: ColumnsFile = None,
    json_file: JsonFile = None,
    report: ReportFile = None,
) -> None:
    """Identify the kinematics from poses, positions or distances; σ not given are estimated."""
    from stcal.robot.identification.prior import adjusted
    from stcal.robot.identification.report import identified_file, identified_report
    from stcal.robot.identification.result import IdentifyOptions, require_identified_written
    from stcal.robot.identification.solve import identify as identified_from
    from stcal.robot.kinematics.file import load_robot, robot_toml
    from stcal.robot.kinematics.measurements import read_measurements

    nominal = load_robot(robot_file)
    source = one_table(
        data_file, first, second, key, "DATA", quaternions=quaternions.value, columns=columns, columns_a=columns_a
    )
    data = read_measurements(source, nominal, quaternions.value, rotation, payload_kg)
    kind = observe.value if observe else None
    options = IdentifyOptions(
        kind, sigma_mm, sigma_rad, robust, folds, seed=seed, partial=partial, model=model.value, adjust=adjusted(adjust)
    )
    result = identified_from(nominal, data, options)
    document = identified_report(result, nominal)
    say(document.text())
    if out:
        write(
            out,
            robot_toml(result.robot, [f"Identified from {name_of(source)}: {result.rank} parameters."]),
        )
        require_identified_written(out, result)
    if offsets:
        from stcal.robot.export.files import offsets_csv, require_offsets_written

        write(offsets, offsets_csv(result, nominal))
        require_offsets_written(offsets, result, nominal)
    write_if(json_file, lambda: identified_file(result, nominal))
    write_if(report, document.page)
