"""Commands of robots."""

import math
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from stcal import robot as arms
from stcal.cli import options as shared
from stcal.cli.help import group
from stcal.cli.options import WRITES, Arg, Opt
from stcal.cli.terminal import StageProgress, print_each, say, write, write_if
from stcal.errors import DegenerateError, InputError

if TYPE_CHECKING:
    from collections.abc import Callable

    from stcal.robot.kinematics.robot_model import Chain


XML = (".urdf", ".xml")


def convert(
    source: Annotated[
        Path,
        "Read the robot from this file: a robot file (TOML), URDF, or the calibration of an arm of Universal "
        "Robots: YAML of ur_calibration, or calibration.conf.",
        Arg("A"),
    ],
    out: Annotated[Path, "Write the other form to this file: .toml or .urdf.", Arg("B", writes=True)],
    from_link: Annotated[str, "Begin at this link of a URDF; if not given, at its root."] = "",
    to_link: Annotated[
        list[str] | None,
        "End at this link of a URDF; if not given, at the only possible one. Repeat it for the hands of several arms "
        "on a trunk.",
    ] = None,
    convention: Annotated[
        Literal["standard", "modified"], "Write Denavit-Hartenberg rows in this convention."
    ] = "standard",
    nominal: Annotated[
        Path | None, "Add the deviations of a calibration.conf to the rows of this robot file (TOML)."
    ] = None,
) -> None:
    """Write a robot file as URDF, or a URDF or the calibration of a Universal Robots arm as a robot file."""
    from stcal.robot.descriptions import coupled, require_urdf_written

    if out.suffix.lower() not in (*XML, ".toml"):
        raise InputError("E-OUTPUT-SUFFIX", f"{out}: a name ending in .urdf or .toml needed")
    suffix, to_xml = source.suffix.lower(), out.suffix.lower() in XML
    begin = source.read_bytes()[:100] if source.is_file() else b""
    from_xml = suffix in XML or begin.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"<")
    made = None if from_xml or suffix == ".toml" else arms.load_universal(source, nominal, convention)
    if made is None and nominal is not None:
        raise InputError("E-OPTION-NEEDS", "--nominal: only with a calibration.conf; leave it out")
    if (from_link or to_link) and (made is not None or not from_xml):
        raise InputError("E-OPTION-NEEDS", "--from-link, --to-link: only for reading a URDF; leave them out")
    if made is not None:
        robot, comment = made.robot, f"From {source.name}, calibration of Universal Robots."
        say(f"robot {robot.name}: {len(robot.rows)} joints, of Universal Robots")
        print_each(f"note: {source}", made.notes)
    elif from_xml == to_xml:
        both = "URDF" if to_xml else "robot files"
        raise InputError("E-OPTION-FILES", f"{source}, {out}: both are {both}; one of each needed")
    elif from_xml:
        urdf = arms.load_urdf(source, from_link, to_link or "", convention)
        robot, way = urdf.robot, f"{urdf.from_link} to {urdf.to_link}: {', '.join(urdf.joints)}"
        comment = f"From {source.name}, {way}."
        say(f"robot {robot.name}: {len(urdf.joints)} joints from {way}")
        print_each(f"note: {source}", urdf.notes)
        tool = robot.tools.get("")
        if tool is not None and max(*map(abs, tool.translation.tolist()), tool.angle_rad()) > 1e-6:
            at = ", ".join(f"{value:.4g}" for value in tool.translation)
            place = f"{at} mm from it, turned by {math.degrees(tool.angle_rad()):.4g}°"
            say(f"note: {urdf.to_link} is not the frame of the last row but [tool] of the robot file: {place}")
    else:
        if convention != "standard":
            raise InputError("E-OPTION-NEEDS", "--convention: only for reading a URDF; leave it out")
        robot, comment = arms.load_robot(source), ""
        tools = f"{len(robot.tools)} tools"
        ends = f"{tools} on branches" if robot.tree else f"flange, and {tools}"
        say(f"robot {robot.name}: {len(robot.rows)} joints from base_link to {ends}")
        if coupled(robot):
            meant = "its joint values are the coupling times the controller's, with wider limits"
            say(f"note: URDF has no coupling; {meant}")
    if to_xml:
        write(out, arms.robot_urdf(robot))
        require_urdf_written(out, robot)
    else:
        _write_robot(out, robot, comment)


def _write_robot(path: Path | None, robot: "arms.Robot", *comments: str, chain: "Chain | None" = None) -> None:
    """Writes a robot file, and reads it again, if a path is given."""
    from stcal.robot.kinematics.robot_file import require_robot_written

    if path is not None:
        write(path, arms.robot_toml(robot, comments))
        require_robot_written(path, robot, chain)


def _write_table(path: Path | None, text: "Callable[[], str]") -> None:
    """Writes a table, and reads it again, if a path is given."""
    from stcal.io.files import require_text_written

    if path is not None:
        write(path, content := text())
        require_text_written(path, content)


def init(file: Annotated[Path, "Write the robot file to this file.", Arg(writes=True)] = Path("robot.toml")) -> None:
    """Write an example of a robot file, to edit: a six-axis arm of 2 m reach."""
    from stcal.robot.kinematics.robot_model import mh80

    comments = (
        "One [[joint]] for each joint, from the base; of type revolute or prismatic (then min_mm and max_mm).",
        "Optional: min_deg, max_deg, beta_deg, base, tool, [[target]] for more tools, and coupling, which makes",
        "kinematic joint values of the controller's (Fanuc: its third row is [0, 1, 1, 0, 0, 0]).",
    )
    _write_robot(file, mh80(), *comments)


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
    joined: shared.JoinOptions = shared.JOINED,
    json_file: shared.JsonFile = None,
    report: shared.ReportFile = None,
) -> None:
    """Find the axis of each joint from sweeps of that joint alone, and the robot with these axes (the axis method)."""
    from stcal.robot.axes.axes_model import AxesFile
    from stcal.robot.axes.fit import ring
    from stcal.robot.robot_report import axes_report

    nominal = arms.load_robot(robot_file)
    source = joined.table(sweeps, "SWEEPS")
    data = arms.read_measurements(source, nominal, rotation=rotation)
    length_mm = _length(orientations, data)
    places = None if length_mm is None else ring(length_mm)
    result = arms.robot_from_sweeps(data, nominal, math.radians(still_deg), places)
    document = axes_report(result, data.where)
    say(document.text())
    if length_mm is not None:
        say(f"orientations: used, as points {length_mm:.0f} mm from the target")
    elif data.rotations is not None:
        say("orientations: not used; state σ (cov_… columns), or give --orientations a length")
    print_each(f"warning: {data.where}", result.notes)
    _write_robot(out, result.robot, f"Identified by the axis method from {shared.name_of(source)}.", chain=result.chain)
    write_if(json_file, lambda: AxesFile.model_validate(result))
    write_if(report, document.page)


def _length(text: str, data: "arms.Measurements") -> float | None:
    """Returns the distance of virtual reflectors, mm; None for positions alone."""
    from stcal.robot.axes.fit import length_of

    if text in ("auto", "off"):
        return length_of(data) if text == "auto" else None
    try:
        return float(text)
    except ValueError as error:
        raise InputError("E-OPTION-VALUE", f"--orientations {text}: a length in mm, auto or off needed") from error


Model = Literal["rigid", "elastic", "auto"]  # model of the arm
DataFile = Annotated[Path | None, "Read joint values, and the measurements at each, from this file (CSV).", Arg("DATA")]


def identify(
    robot_file: shared.RobotFile,
    data_file: DataFile = None,
    out: Annotated[Path | None, "Write the identified robot to this file (TOML).", WRITES] = None,
    offsets: Annotated[
        Path | None, "Write mastering offsets and differences of D-H values to this file (CSV).", WRITES
    ] = None,
    observe: Annotated[
        Literal["pose", "position", "distance"] | None,
        "Use this part of the measurements; if not given, everything that was measured.",
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
    joined: shared.JoinOptions = shared.JOINED,
    json_file: shared.JsonFile = None,
    report: shared.ReportFile = None,
) -> None:
    """Identify the kinematics from poses, positions or distances; estimate σ that are not given."""
    from stcal.robot.identification.prior import adjusted
    from stcal.robot.identification.result import IdentifiedFile, require_identified_written
    from stcal.robot.identified_report import identified_report

    nominal = arms.load_robot(robot_file)
    source = joined.table(data_file, "DATA", quaternions=quaternions)
    data = arms.read_measurements(source, nominal, quaternions, rotation, payload_kg)
    options = arms.IdentifyOptions(
        observe, sigma_mm, sigma_rad, robust, folds, seed=seed, partial=partial, model=model, adjust=adjusted(adjust)
    )
    result = arms.identify(nominal, data, options)
    document = identified_report(result)
    say(document.text())
    if out:
        comment = f"Identified from {shared.name_of(source)}: {result.rank} parameters."
        write(out, arms.robot_toml(result.robot, [comment]))
        require_identified_written(out, result)
    _write_table(offsets, lambda: arms.offsets_csv(result, nominal))
    write_if(json_file, lambda: IdentifiedFile.model_validate(result))
    write_if(report, document.page)


def evaluate(
    robot_files: Annotated[
        list[Path], "Read a robot from this file (TOML); repeat it for more robots.", Opt("--robot")
    ],
    data_file: DataFile = None,
    refit: Annotated[
        Literal["none", "base", "tool", "base-tool"],
        "Fit this to the data, keeping each robot's own axes; everything else comes from its file.",
    ] = "base-tool",
    out: Annotated[Path | None, "Write the residuals of each row to this file (CSV).", WRITES] = None,
    quaternions: shared.Quaternions = "wxyz",
    payload_kg: shared.PayloadKg = None,
    joined: shared.JoinOptions = shared.JOINED,
    json_file: shared.JsonFile = None,
    report: shared.ReportFile = None,
) -> None:
    """Compare robot files on new measurements, and tell what their residuals depend on."""
    from stcal.robot.robot_report import evaluation_report, names_of
    from stcal.robot.use.evaluation import EvaluationFile

    robots = dict(zip(names_of(robot_files), map(arms.load_robot, robot_files), strict=True))
    source = joined.table(data_file, "DATA", quaternions=quaternions)
    read = partial(arms.read_measurements, source, quaternions=quaternions, payload_kg=payload_kg)
    data = [read(robot) for robot in robots.values()]  # within reach of each
    result = arms.evaluate(robots, data[0], refit)
    document = evaluation_report(result)
    say(document.text())
    print_each("note", data[0].notes)
    _write_table(out, lambda: arms.evaluated_csv(result))
    write_if(json_file, lambda: EvaluationFile.model_validate(result))
    write_if(report, document.page)


def verify(
    measured: Annotated[
        Path | None, "Read commanded_x_mm …, measured x_mm … and set (before or after) from this file (CSV).", Arg()
    ] = None,
    plot: Annotated[Path | None, "Draw the error of each pose and set to this file (.svg).", WRITES] = None,
    first: shared.FirstTable = None,
    seconds: Annotated[
        list[Path] | None,
        "Read the measurements from this file (CSV); several files are sets, named after the files.",
        Opt("--b", metavar="<path>"),
    ] = None,
    key: shared.Key = "pose",
    json_file: shared.JsonFile = None,
    report: shared.ReportFile = None,
) -> None:
    """Compare distances of positions from the first one, measured and commanded, before and after compensation."""
    from stcal.io.join import stack_tables
    from stcal.robot.robot_report import verification_figure, verification_report

    tables = shared.several_tables(measured, first, seconds or [], key, "MEASURED", ("commanded_", ""))
    if isinstance(tables, list):
        tables = stack_tables(tables, [path.stem for path in seconds or ()], {"pose": key})
    data = arms.read_measured(tables)
    result = arms.verify(data)
    document = verification_report(result, data.where)
    say(document.text())
    print_each("note", result.notes)
    print_each("warning", result.warnings)
    if plot:
        from stcal.report.svg import save

        save(verification_figure(result), plot)
        say(f"written: {plot}")
    write_if(json_file, lambda: result)
    write_if(report, document.page)


def compensate(
    robot_file: Annotated[Path, "Read the identified robot from this file (TOML).", Opt("--robot")],
    targets: Annotated[Path | None, "Read commanded poses or joint values from this file (CSV).", Arg()] = None,
    nominal: Annotated[Path | None, "Read the controller's model of the robot from this file (TOML)."] = None,
    out: Annotated[
        Path | None, "Write the joint values to send, with status and errors, to this file (CSV).", WRITES
    ] = None,
    quaternions: shared.Quaternions = "wxyz",
    rotation: shared.Rotation = None,
    payload_kg: shared.PayloadKg = None,
    joined: shared.JoinOptions = shared.JOINED_BY_POSE,
    json_file: shared.JsonFile = None,
    report: shared.ReportFile = None,
) -> None:
    """Compute the joint values with which the real robot reaches the commanded poses."""
    from stcal.robot.robot_report import compensation_report
    from stcal.robot.use.compensation import CompensationFile

    identified = arms.load_robot(robot_file)
    source = joined.table(targets, "TARGETS", quaternions=quaternions)
    wanted = arms.read_targets(source, identified, quaternions, rotation, payload_kg)
    result = arms.compensate(identified, wanted, arms.load_robot(nominal) if nominal else None)
    document = compensation_report(result)
    say(document.text())
    print_each(f"note: {wanted.where}", wanted.notes)
    print_each(f"warning: {wanted.where}", result.notes())
    _write_table(out, lambda: arms.compensated_csv(result, identified))
    write_if(json_file, lambda: CompensationFile.model_validate(result))
    write_if(report, document.page)
    if not result.found.usable.any():
        raise DegenerateError("E-ROBOT-UNREACHED", f"{wanted.where}: none of {len(result)} poses is reached; see above")


def design(
    robot_file: shared.RobotFile,
    count: Annotated[int, "Choose this many poses.", Opt(min=1, max=2000)] = 40,
    seed: Annotated[int, "Draw the candidates with this seed.", Opt(min=0, max=shared.MOST_SEED)] = 0,
    out: Annotated[Path | None, "Write the poses to this file (CSV).", WRITES] = None,
    observe: Annotated[Literal["pose", "position"], "Plan for an instrument that measures this."] = "position",
    candidates: Annotated[int, "Choose from this many random poses.", Opt(min=2, max=100_000)] = 1000,
    sigma_mm: Annotated[float, "Assume this σ of measured positions, mm per axis."] = 0.05,
    sigma_rad: Annotated[float, "Assume this σ of measured orientations, rad per axis."] = 2e-4,
    box: Annotated[str | None, "Keep the tool inside this box, mm in the base: xmin,ymin,zmin,xmax,ymax,zmax."] = None,
    target: Annotated[str, "Measure the target (tool) of this name."] = "",
    json_file: shared.JsonFile = None,
    report: shared.ReportFile = None,
) -> None:
    """Choose the measurement poses that determine the robot's parameters best."""
    from stcal.robot.robot_report import design_report
    from stcal.robot.use.pose_design import DesignFile

    inside = _box(box) if box else None
    options = arms.DesignOptions(count, seed, observe, candidates, sigma_mm, sigma_rad, inside, target)
    robot = arms.load_robot(robot_file)
    result = arms.design(robot, options)
    document = design_report(result, robot)
    say(document.text())
    also = f" and {sigma_rad:g} rad" if observe == "pose" else ""
    say(f"for an instrument whose {observe}s have σ {sigma_mm:g} mm{also} per axis (--sigma-mm, --sigma-rad)")
    _write_table(out, lambda: arms.design_csv(result, robot))
    write_if(json_file, lambda: DesignFile.model_validate(result))
    write_if(report, document.page)


def _box(text: str) -> tuple[float, ...]:
    try:
        return tuple(float(cell) for cell in text.split(","))
    except ValueError as error:
        raise InputError("E-OPTION-VALUE", f"--box {text}: six numbers with commas between needed, in mm") from error


def from_photos(
    images: Annotated[Path, "Read the photographs of this folder and of its subfolders.", Arg("VIEWS")],
    camera: shared.CameraFile,
    faces: Annotated[Path, "Read the calibrated target from this faces.json."],
    joints: Annotated[Path, "Read the joint values of each photograph from this file, matched by --key (CSV)."],
    robot_file: shared.RobotFile,
    out: Annotated[
        Path,
        "Write all results to this new folder. For more options, use its poses.csv, which has the joint values, in "
        "robot axes and identify, and its identified.toml in robot compensate.",
    ],
    targets: Annotated[
        Path | None, "Compute joint values for the poses in this file, or for the poses at its joint values (CSV)."
    ] = None,
    target: shared.TargetFile = None,
    board: Annotated[Path | None, "Identify the dots of the board in this board.toml, if the board is in view."] = None,
    model: Annotated[Model, "Take the arm as rigid, or as elastic; auto chooses by held-out rows."] = "rigid",
    partial: Annotated[bool, "Keep parameters that the photographs do not determine nominal."] = False,
    key: Annotated[str, "Match photographs and joint values by this column."] = "image",
    workers: shared.Workers = None,
) -> None:
    """Measure the target on an arm in photographs, find axes and kinematics, and compensate poses, in one folder."""
    shared.load_ahead(workers)
    from stcal.boards.board_file import load_dots
    from stcal.boards.target_file import target_of
    from stcal.io.cameras.read import read_camera
    from stcal.io.files import require_new_folder, save_folder
    from stcal.sfm import MeasureOptions, read_target
    from stcal.workflows.from_photos import files_of, require_files_written, robot_from_photos, story

    require_new_folder(out, images)
    design = target_of(target, printed=False)
    with StageProgress() as progress:
        seen = images, read_camera(camera), read_target(faces, design), design
        arm, dots = arms.load_robot(robot_file), load_dots(board) if board else None
        how = MeasureOptions(workers=workers), arms.IdentifyOptions(model=model, partial=partial)
        result = robot_from_photos(*seen, joints, arm, targets, dots, key, *how, progress)
    print_each("note", result.notes)
    for line in story(result):
        say(line)
    save_folder(out, files_of(result))
    require_files_written(out, result)
    say(f"report: {out / 'report.html'}")


app = group("stcal robot", "Calibrate a robot from measured data of any instrument, and compensate it.")
for command in (init, axes, identify, evaluate, compensate, verify, design, convert, from_photos):
    app.command()(command)
