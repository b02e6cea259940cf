"""``stcal robot``: kinematics from measured data, and joint values that reach what was commanded."""

import math
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stcal.cli.help import PLAIN, Commands
from stcal.cli.options import (
    MOST_SEED,
    FirstTable,
    JsonFile,
    Key,
    QuaternionOrder,
    Quaternions,
    ReportFile,
    RobotFile,
    SecondTable,
    name_of,
    one_table,
    several_tables,
)
from stcal.cli.terminal import print_each, say, write
from stcal.errors import DegenerateError, InputError

if TYPE_CHECKING:
    from stcal.robot.kinematics.measurements import Measurements

app = typer.Typer(
    name="stcal robot",
    help="Calibrate a robot from measured data of any instrument, and compensate it.",
    cls=Commands,
    **PLAIN,
)


@app.command()
def init(
    file: Annotated[Path, typer.Argument(writable=True, help="Write the robot file here; it must not exist.")] = Path(
        "robot.toml"
    ),
) -> None:
    """Write an example of a robot file, to edit: a six-axis arm of 2 m reach."""
    from stcal.robot.kinematics.example import mh80
    from stcal.robot.kinematics.file import robot_toml

    if file.exists():
        raise InputError(f"robot file {file}: exists already; give another name or move it away")
    comments = (
        "One [[joint]] for each joint, from the base; of type revolute or prismatic (then min_mm and max_mm).",
        "Optional: min_deg, max_deg, beta_deg, base, tool, [[target]] for more tools, and coupling, which makes",
        "kinematic joint values of the controller's (Fanuc: its third row is [0, 1, 1, 0, 0, 0]).",
    )
    write(file, robot_toml(mh80(), comments))


@app.command()
def axes(
    robot_file: RobotFile,
    sweeps: Annotated[
        Path | None,
        typer.Argument(help="Read joint values and positions of reflectors in sweeps from this file (CSV)."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", writable=True, help="Write the robot that the axes make to this file (TOML)."),
    ] = None,
    still_deg: Annotated[
        float,
        typer.Option(min=1e-9, max=1.0, help="Take joints that change by less than this as standing still, degrees."),
    ] = 0.0015,
    orientations: Annotated[
        str,
        typer.Option(
            help="Use measured orientations too, as reflectors so far from the target, mm, where an error of rotation "
            "is worth one of position; auto, by their stated σ and not without, or off."
        ),
    ] = "auto",
    first: FirstTable = None,
    second: SecondTable = None,
    key: Key = "image",
    json_file: JsonFile = None,
    report: ReportFile = None,
) -> None:
    """Find each joint's axis from sweeps of that joint alone, and the robot that follows (the axis method)."""
    from stcal.robot.axes.model import robot_from_sweeps
    from stcal.robot.axes.report import axes_file, axes_page, axes_text
    from stcal.robot.kinematics.file import load_robot, robot_toml
    from stcal.robot.kinematics.measurements import read_measurements

    nominal = load_robot(robot_file)
    source = one_table(sweeps, first, second, key, "SWEEPS")
    data = read_measurements(source, nominal)
    length_mm = _length(orientations, data)
    result = robot_from_sweeps(data, nominal, math.radians(still_deg), length_mm)
    say(axes_text(result))
    if length_mm is not None:
        say(f"orientations: used, as points {length_mm:.0f} mm from the target")
    elif data.rotations is not None:
        say("orientations: not used; state σ (cov_… columns), or give --orientations a length")
    print_each(f"warning: {data.where}", result.notes)
    if out:
        write(out, robot_toml(result.robot, [f"Identified by the axis method from {name_of(source)}."]))
    if json_file:
        write(json_file, axes_file(result))
    if report:
        write(report, axes_page(result, data.where))


def _length(text: str, data: "Measurements") -> float | None:
    """Distance of virtual reflectors, mm; None for positions alone."""
    from stcal.robot.axes.orientations import length_of

    if text in ("auto", "off"):
        return length_of(data) if text == "auto" else None
    try:
        return float(text)
    except ValueError as error:
        raise InputError(f"--orientations {text}: a length in mm, auto or off needed") from error


class Kind(StrEnum):
    """What is taken of the measurements."""

    pose = "pose"
    position = "position"
    distance = "distance"


@app.command()
def identify(
    robot_file: RobotFile,
    data_file: Annotated[
        Path | None,
        typer.Argument(metavar="DATA", help="Read joint values with what was measured there from this file (CSV)."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", writable=True, help="Write the identified robot to this file (TOML).")
    ] = None,
    observe: Annotated[
        Kind | None, typer.Option(help="Use this of the measurements; the most that was measured if not given.")
    ] = None,
    sigma_mm: Annotated[
        float | None,
        typer.Option(
            "--sigma-mm", min=1e-9, max=1e4, help="Set σ of a measured position, mm per axis; estimated if not given."
        ),
    ] = None,
    sigma_rad: Annotated[
        float | None,
        typer.Option(
            "--sigma-rad",
            min=1e-12,
            max=4,
            help="Set σ of a measured orientation, rad per axis; estimated if not given.",
        ),
    ] = None,
    folds: Annotated[
        int, typer.Option(min=0, max=100_000, help="Cross-validate with this many folds; 0 for none.")
    ] = 6,
    seed: Annotated[int, typer.Option(min=0, max=MOST_SEED, help="Divide the rows into folds with this seed.")] = 0,
    robust: Annotated[
        bool, typer.Option("--robust/--least-squares", help="Give outliers less weight, or all rows the same.")
    ] = True,
    partial: Annotated[
        bool,
        typer.Option(
            "--partial", help="Keep parameters nominal that the data leave open, rather than refuse the data."
        ),
    ] = False,
    quaternions: Quaternions = QuaternionOrder.wxyz,
    first: FirstTable = None,
    second: SecondTable = None,
    key: Key = "image",
    json_file: JsonFile = None,
    report: ReportFile = None,
) -> None:
    """Identify the kinematics from poses, positions or distances; σ not given are estimated."""
    from stcal.robot.identify.report import identified_file, identified_page, identified_text
    from stcal.robot.identify.result import IdentifyOptions
    from stcal.robot.identify.solve import identify as identified_from
    from stcal.robot.kinematics.file import load_robot, robot_toml
    from stcal.robot.kinematics.measurements import read_measurements

    nominal = load_robot(robot_file)
    source = one_table(data_file, first, second, key, "DATA", quaternions=quaternions.value)
    data = read_measurements(source, nominal, quaternions.value)
    kind = observe.value if observe else None
    options = IdentifyOptions(kind, sigma_mm, sigma_rad, robust, folds, seed=seed, partial=partial)
    result = identified_from(nominal, data, options)
    say(identified_text(result, nominal))
    if out:
        write(
            out,
            robot_toml(result.robot, [f"Identified from {name_of(source)}: {result.rank} parameters."]),
        )
    if json_file:
        write(json_file, identified_file(result, nominal))
    if report:
        write(report, identified_page(result, nominal))


@app.command()
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
    wanted = read_targets(source, identified, quaternions.value)
    result = stage.compensate(identified, wanted, load_robot(nominal) if nominal else None)
    say(stage.compensated_text(result, identified))
    for line in stage.compensated_summary(result):
        say(line)
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


@app.command()
def verify(
    measured: Annotated[
        Path | None,
        typer.Argument(help="Read commanded_x_mm … beside measured x_mm … from this file; set: before, after (CSV)."),
    ] = None,
    plot: Annotated[
        Path | None,
        typer.Option("--plot", writable=True, help="Draw the error of each pose and set to this file (.png or .svg)."),
    ] = None,
    first: FirstTable = None,
    seconds: Annotated[
        list[Path] | None,
        typer.Option(
            "--b",
            metavar="<path>",
            help="Read what was measured from this file (CSV); several are sets, called like them.",
        ),
    ] = None,
    key: Key = "pose",
    json_file: JsonFile = None,
    report: ReportFile = None,
) -> None:
    """Compare distances of measured positions from the first with the commanded ones, before and after."""
    from stcal.io.join import stack
    from stcal.robot.use import verification as stage

    if plot and plot.suffix.lower() not in (".png", ".svg"):
        raise InputError(f"--plot {plot}: a name ending in .png or .svg needed")
    tables = several_tables(measured, first, seconds or [], key, "MEASURED", ("commanded_", ""))
    source = tables if isinstance(tables, Path) else stack(tables, [path.stem for path in seconds or ()], {"pose": key})
    result = stage.verify(stage.read_measured(source))
    say(stage.verified_text(result))
    print_each("warning", result.warnings())
    if plot:
        from stcal.robot.use.report import figure_bytes, verification_figure

        write(plot, figure_bytes(verification_figure(result), plot.suffix.lower()[1:]))
    if json_file:
        write(json_file, stage.verification_file(result))
    if report:
        from stcal.robot.use.report import verification_page

        write(report, verification_page(result))


class ObservedKind(StrEnum):
    """What the instrument measures."""

    pose = "pose"
    position = "position"


@app.command()
def design(
    robot_file: RobotFile,
    count: Annotated[int, typer.Option(min=1, max=2000, help="Choose this many poses.")] = 40,
    seed: Annotated[int, typer.Option(min=0, max=MOST_SEED, help="Draw the candidates with this seed.")] = 0,
    out: Annotated[
        Path | None, typer.Option("--out", writable=True, help="Write the poses to this file (CSV).")
    ] = None,
    observe: Annotated[
        ObservedKind, typer.Option(help="Plan for an instrument that measures this.")
    ] = ObservedKind.position,
    candidates: Annotated[int, typer.Option(min=2, max=100_000, help="Choose from this many random poses.")] = 1000,
    sigma_mm: Annotated[
        float, typer.Option("--sigma-mm", help="Assume this σ of measured positions, mm per axis.")
    ] = 0.05,
    sigma_rad: Annotated[
        float, typer.Option("--sigma-rad", help="Assume this σ of measured orientations, rad per axis.")
    ] = 2e-4,
    box: Annotated[
        str | None, typer.Option(help="Keep the tool inside this box, mm in the base: xmin,ymin,zmin,xmax,ymax,zmax.")
    ] = None,
    target: Annotated[str, typer.Option(help="Measure the target (tool) of this name.")] = "",
    json_file: JsonFile = None,
    report: ReportFile = None,
) -> None:
    """Choose measurement poses that show the robot's parameters best."""
    from stcal.robot.kinematics.file import load_robot
    from stcal.robot.use import design as stage

    options = stage.DesignOptions(
        count, seed, observe.value, candidates, sigma_mm, sigma_rad, _box(box) if box else None, target
    )
    robot = load_robot(robot_file)
    result = stage.design(robot, options)
    say(stage.design_text(result))
    also = f" and {sigma_rad:g} rad" if observe is ObservedKind.pose else ""
    say(f"for an instrument whose {observe.value}s have σ {sigma_mm:g} mm{also} per axis (--sigma-mm, --sigma-rad)")
    if out:
        write(out, stage.design_csv(result, robot))
    if json_file:
        write(json_file, stage.design_file(result))
    if report:
        from stcal.robot.use.design_report import design_page

        write(report, design_page(result, robot))


def _box(text: str) -> tuple[float, ...]:
    try:
        return tuple(float(cell) for cell in text.split(","))
    except ValueError as error:
        raise InputError(f"--box {text}: six numbers with commas between needed, in mm") from error
