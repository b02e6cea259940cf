"""Command ``stcal robot compensate``: joint values that reach commanded poses."""

from pathlib import Path
from typing import Annotated, Literal

from stcal.cli import options as shared
from stcal.cli.declare import WRITES, Arg, Opt
from stcal.cli.terminal import print_each, say, write, write_if
from stcal.errors import DegenerateError, InputError

ExportAs = Literal["joints", "poses"]
"""Content of the files for controllers."""


def compensate(
    robot_file: Annotated[Path, "Read the identified robot from this file (TOML).", Opt("--robot")],
    targets: Annotated[Path | None, "Read commanded poses or joint values from this file (CSV).", Arg()] = None,
    nominal: Annotated[Path | None, "Read the controller's model of the robot from this file (TOML)."] = None,
    out: Annotated[
        Path | None, "Write the joint values to send, with status and errors, to this file (CSV).", WRITES
    ] = None,
    export: Annotated[
        list[str] | None,
        "Write the reachable points to this file; repeat it for more files. Forms: yaskawa (JBI), fanuc (LS), kuka "
        "(dat), abb (mod), ur (script).",
        Opt(metavar="FORM=FILE"),
    ] = None,
    export_as: Annotated[
        ExportAs, "Write joint values, or the poses of the nominal robot at these joint values, to command instead."
    ] = "joints",
    pulses_per_deg: Annotated[
        str | None,
        "Write joint values for yaskawa with these pulses per degree of each joint, separated by commas; poses if "
        "not given.",
    ] = None,
    quaternions: shared.Quaternions = "wxyz",
    rotation: shared.Rotation = None,
    payload_kg: shared.PayloadKg = None,
    first: shared.FirstTable = None,
    second: shared.SecondTable = None,
    key: shared.Key = "pose",
    columns: shared.ColumnsFile = None,
    columns_a: shared.FirstColumns = None,
    json_file: shared.JsonFile = None,
    report: shared.ReportFile = None,
) -> None:
    """Compute the joint values with which the real robot reaches the commanded poses."""
    from stcal.io.files import require_same
    from stcal.robot.export import require_form, robot_program
    from stcal.robot.kinematics.file import load_robot
    from stcal.robot.use import compensation as stage
    from stcal.robot.use.report import compensation_report
    from stcal.robot.use.targets import read_targets

    exports, pulses = shared.exports_of(export or [], require_form), _pulses(pulses_per_deg)
    identified = load_robot(robot_file)
    source = shared.one_table(
        targets, first, second, key, "TARGETS", quaternions=quaternions, columns=columns, columns_a=columns_a
    )
    wanted = read_targets(source, identified, quaternions, rotation, payload_kg)
    result = stage.compensate(identified, wanted, load_robot(nominal) if nominal else None)
    document = compensation_report(result, identified)
    say(document.text())
    print_each(f"note: {wanted.where}", wanted.notes)
    print_each(f"warning: {wanted.where}", result.notes())
    write_if(out, lambda: stage.compensated_csv(result, identified))
    if out:
        stage.require_compensated_written(out, result, identified)
    write_if(json_file, lambda: stage.compensation_file(result, identified))
    write_if(report, document.page)
    for form, path in exports if result.found.usable.any() else ():
        exported_file = robot_program(result, identified, form, path, export_as, pulses)
        write(path, exported_file.text)
        require_same(path, path.read_bytes, exported_file.text.encode())  # which gave the points back
        print_each("note", exported_file.notes)
    if not result.found.usable.any():
        raise DegenerateError(
            "E-ROBOT-UNREACHED", f"{wanted.where}: none of {len(result)} poses is reached; see the warnings above"
        )


def _pulses(text: str | None) -> list[float] | None:
    try:
        return None if text is None else [float(cell) for cell in text.split(",")]
    except ValueError as error:
        raise InputError(
            "E-OPTION-VALUE", f"--pulses-per-deg {text}: numbers with commas between needed, one for each joint"
        ) from error
