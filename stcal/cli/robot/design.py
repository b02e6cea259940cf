"""Command ``stcal robot design``: choice of measurement poses."""

from pathlib import Path
from typing import Annotated, Literal

from stcal.cli.declare import WRITES, Opt
from stcal.cli.options import MOST_SEED, JsonFile, ReportFile, RobotFile
from stcal.cli.terminal import say, write_if
from stcal.errors import InputError

ObservedKind = Literal["pose", "position"]
"""Quantity that the instrument measures."""


def design(
    robot_file: RobotFile,
    count: Annotated[int, "Choose this many poses.", Opt(min=1, max=2000)] = 40,
    seed: Annotated[int, "Draw the candidates with this seed.", Opt(min=0, max=MOST_SEED)] = 0,
    out: Annotated[Path | None, "Write the poses to this file (CSV).", WRITES] = None,
    observe: Annotated[ObservedKind, "Plan for an instrument that measures this."] = "position",
    candidates: Annotated[int, "Choose from this many random poses.", Opt(min=2, max=100_000)] = 1000,
    sigma_mm: Annotated[float, "Assume this σ of measured positions, mm per axis."] = 0.05,
    sigma_rad: Annotated[float, "Assume this σ of measured orientations, rad per axis."] = 2e-4,
    box: Annotated[str | None, "Keep the tool inside this box, mm in the base: xmin,ymin,zmin,xmax,ymax,zmax."] = None,
    target: Annotated[str, "Measure the target (tool) of this name."] = "",
    json_file: JsonFile = None,
    report: ReportFile = None,
) -> None:
    """Choose the measurement poses that determine the robot's parameters best."""
    from stcal.robot.kinematics.file import load_robot
    from stcal.robot.use import design as stage
    from stcal.robot.use.report import design_report

    options = stage.DesignOptions(
        count, seed, observe, candidates, sigma_mm, sigma_rad, _box(box) if box else None, target
    )
    robot = load_robot(robot_file)
    result = stage.design(robot, options)
    document = design_report(result, robot)
    say(document.text())
    also = f" and {sigma_rad:g} rad" if observe == "pose" else ""
    say(f"for an instrument whose {observe}s have σ {sigma_mm:g} mm{also} per axis (--sigma-mm, --sigma-rad)")
    write_if(out, lambda: stage.design_csv(result, robot))
    if out:
        stage.require_design_written(out, result, robot, target)
    write_if(json_file, lambda: stage.design_file(result))
    write_if(report, document.page)


def _box(text: str) -> tuple[float, ...]:
    try:
        return tuple(float(cell) for cell in text.split(","))
    except ValueError as error:
        raise InputError("E-OPTION-VALUE", f"--box {text}: six numbers with commas between needed, in mm") from error
