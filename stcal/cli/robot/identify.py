"""Command ``stcal robot identify``: kinematics from poses, positions or distances."""

from pathlib import Path
from typing import Annotated, Literal

from stcal.cli import options as shared
from stcal.cli.declare import WRITES, Arg, Opt
from stcal.cli.terminal import say, write, write_if

Kind = Literal["pose", "position", "distance"]
"""Quantity that is used of the measurements."""


Model = Literal["rigid", "elastic", "auto"]
"""Model of the arm."""


def identify(
    robot_file: shared.RobotFile,
    data_file: Annotated[
        Path | None, "Read joint values, and the measurements at each, from this file (CSV).", Arg("DATA")
    ] = None,
    out: Annotated[Path | None, "Write the identified robot to this file (TOML).", WRITES] = None,
    offsets: Annotated[
        Path | None, "Write mastering offsets and differences of D-H values to this file (CSV).", WRITES
    ] = None,
    observe: Annotated[
        Kind | None, "Use this part of the measurements; if not given, everything that was measured."
    ] = None,
    sigma_mm: Annotated[
        float | None, "Set σ of a measured position, mm per axis; estimated if not given.", Opt(min=1e-9, max=1e4)
    ] = None,
    sigma_rad: Annotated[
        float | None, "Set σ of a measured orientation, rad per axis; estimated if not given.", Opt(min=1e-12, max=4)
    ] = None,
    folds: Annotated[int, "Cross-validate with this many folds; 0 for none.", Opt(min=0, max=100_000)] = 6,
    seed: Annotated[int, "Divide the rows into folds with this seed.", Opt(min=0, max=shared.MOST_SEED)] = 0,
    robust: Annotated[
        bool, "Give outliers less weight, or weight all rows equally.", Opt("--robust/--least-squares")
    ] = True,
    partial: Annotated[
        bool, "Keep parameters that the data do not determine nominal, instead of refusing the data."
    ] = False,
    adjust: Annotated[
        str,
        "Adjust only base and tools (base,tool), also the zero positions of joints (zeros), or their geometry, or all.",
        Opt(metavar="WHAT"),
    ] = "all",
    model: Annotated[
        Model,
        "Take the arm as rigid, or as elastic: links bend under gravity, gears have periodic errors. auto chooses by "
        "held-out rows.",
    ] = "rigid",
    quaternions: shared.Quaternions = "wxyz",
    rotation: shared.Rotation = None,
    payload_kg: shared.PayloadKg = None,
    first: shared.FirstTable = None,
    second: shared.SecondTable = None,
    key: shared.Key = "image",
    columns_a: shared.FirstColumns = None,
    columns: shared.ColumnsFile = None,
    json_file: shared.JsonFile = None,
    report: shared.ReportFile = None,
) -> None:
    """Identify the kinematics from poses, positions or distances; estimate σ that are not given."""
    from stcal.robot.identification.prior import adjusted
    from stcal.robot.identification.report import identified_file, identified_report
    from stcal.robot.identification.result import IdentifyOptions, require_identified_written
    from stcal.robot.identification.solve import identify as identified_from
    from stcal.robot.kinematics.file import load_robot, robot_toml
    from stcal.robot.kinematics.measurements import read_measurements

    nominal = load_robot(robot_file)
    source = shared.one_table(
        data_file, first, second, key, "DATA", quaternions=quaternions, columns=columns, columns_a=columns_a
    )
    data = read_measurements(source, nominal, quaternions, rotation, payload_kg)
    options = IdentifyOptions(
        observe, sigma_mm, sigma_rad, robust, folds, seed=seed, partial=partial, model=model, adjust=adjusted(adjust)
    )
    result = identified_from(nominal, data, options)
    document = identified_report(result, nominal)
    say(document.text())
    if out:
        write(
            out,
            robot_toml(result.robot, [f"Identified from {shared.name_of(source)}: {result.rank} parameters."]),
        )
        require_identified_written(out, result)
    if offsets:
        from stcal.robot.export.files import offsets_csv, require_offsets_written

        write(offsets, offsets_csv(result, nominal))
        require_offsets_written(offsets, result, nominal)
    write_if(json_file, lambda: identified_file(result, nominal))
    write_if(report, document.page)
