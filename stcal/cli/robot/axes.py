"""Command ``stcal robot axes``: the axis method."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from stcal.cli import options as shared
from stcal.cli.declare import WRITES, Arg, Opt
from stcal.cli.terminal import print_each, say, write_if
from stcal.errors import InputError

if TYPE_CHECKING:
    from stcal.robot.kinematics.measurements import Measurements


def axes(
    robot_file: shared.RobotFile,
    sweeps: Annotated[
        Path | None, "Read joint values and positions of reflectors in sweeps from this file (CSV).", Arg()
    ] = None,
    out: Annotated[Path | None, "Write the robot with these axes to this file (TOML).", WRITES] = None,
    still_deg: Annotated[
        float, "Treat joints that change by less than this as not moving, degrees.", Opt(min=1e-9, max=1.0)
    ] = 0.0015,
    orientations: Annotated[
        str,
        "Use measured orientations too, weighted like reflectors at this distance from the target, mm; auto uses "
        "them by their stated σ, if there are any, and off ignores them.",
    ] = "auto",
    rotation: shared.Rotation = None,
    first: shared.FirstTable = None,
    second: shared.SecondTable = None,
    key: shared.Key = "image",
    columns_a: shared.FirstColumns = None,
    columns: shared.ColumnsFile = None,
    json_file: shared.JsonFile = None,
    report: shared.ReportFile = None,
) -> None:
    """Find the axis of each joint from sweeps of that joint alone, and the robot with these axes (the axis method)."""
    from stcal.robot.axes.model import robot_from_sweeps
    from stcal.robot.axes.report import axes_file, axes_report
    from stcal.robot.axes.sweeps import ring
    from stcal.robot.kinematics.file import load_robot, require_robot_written, robot_toml
    from stcal.robot.kinematics.measurements import read_measurements

    nominal = load_robot(robot_file)
    source = shared.one_table(sweeps, first, second, key, "SWEEPS", columns=columns, columns_a=columns_a)
    data = read_measurements(source, nominal, rotation=rotation)
    if len(set(data.stations)) > 1:
        raise InputError(
            "E-STATION-SINGLE",
            f"{data.where}: stations {', '.join(data.by_station())}; sweeps are seen from one, so give one at a time",
        )
    length_mm = _length(orientations, data)
    result = robot_from_sweeps(data, nominal, math.radians(still_deg), None if length_mm is None else ring(length_mm))
    document = axes_report(result, data.where)
    say(document.text())
    if length_mm is not None:
        say(f"orientations: used, as points {length_mm:.0f} mm from the target")
    elif data.rotations is not None:
        say("orientations: not used; state σ (cov_… columns), or give --orientations a length")
    print_each(f"warning: {data.where}", result.notes)
    write_if(out, lambda: robot_toml(result.robot, [f"Identified by the axis method from {shared.name_of(source)}."]))
    if out:
        require_robot_written(out, result.robot, result.chain)
    write_if(json_file, lambda: axes_file(result))
    write_if(report, document.page)


def _length(text: str, data: "Measurements") -> float | None:
    """Returns the distance of virtual reflectors, mm; None for positions alone."""
    from stcal.robot.axes.sweeps import length_of

    if text in ("auto", "off"):
        return length_of(data) if text == "auto" else None
    try:
        return float(text)
    except ValueError as error:
        raise InputError("E-OPTION-VALUE", f"--orientations {text}: a length in mm, auto or off needed") from error
