"""Commands ``stcal robot init`` and ``convert``: robot files."""

from pathlib import Path
from typing import Annotated, Literal

from stcal.cli.declare import Arg
from stcal.cli.terminal import print_each, say, write
from stcal.errors import InputError

XML = (".urdf", ".xml")


ConventionName = Literal["standard", "modified"]
"""Convention of Denavit–Hartenberg rows."""


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
    convention: Annotated[ConventionName, "Write Denavit-Hartenberg rows in this convention."] = "standard",
    nominal: Annotated[
        Path | None, "Add the deviations of a calibration.conf to the rows of this robot file (TOML)."
    ] = None,
) -> None:
    """Write a robot file as URDF, or a URDF or the calibration of a Universal Robots arm as a robot file."""
    from stcal.robot.kinematics.file import load_robot, require_robot_written, robot_toml
    from stcal.robot.urdf.read import load_urdf
    from stcal.robot.urdf.universal import read_universal
    from stcal.robot.urdf.write import coupled, require_urdf_written, robot_urdf

    if out.suffix.lower() not in (*XML, ".toml"):
        raise InputError("E-OUTPUT-SUFFIX", f"{out}: a name ending in .urdf or .toml needed")
    made = None if source.suffix.lower() in (*XML, ".toml") else read_universal(source, nominal, convention)
    if made is None and nominal is not None:
        raise InputError("E-OPTION-NEEDS", "--nominal: only with a calibration.conf; leave it out")
    if made is not None:
        if from_link or to_link:
            raise InputError("E-OPTION-NEEDS", "--from-link, --to-link: only for reading a URDF; leave them out")
        robot = made.robot
        say(f"robot {robot.name}: {len(robot.rows)} joints, of Universal Robots")
        print_each(f"note: {source}", made.notes)
        if out.suffix.lower() in XML:
            write(out, robot_urdf(robot))
            require_urdf_written(out, robot)
        else:
            write(out, robot_toml(robot, [f"From {source.name}, calibration of Universal Robots."]))
            require_robot_written(out, robot)
        return
    if _is_xml(source) == (out.suffix.lower() in XML):
        raise InputError(
            "E-OPTION-FILES",
            f"{source}, {out}: both are {'URDF' if _is_xml(source) else 'robot files'}; one of each needed",
        )
    if _is_xml(source):
        urdf = load_urdf(source, from_link, to_link or "", convention)
        joints = ", ".join(urdf.joints)
        say(f"robot {urdf.robot.name}: {len(urdf.joints)} joints from {urdf.from_link} to {urdf.to_link}: {joints}")
        print_each(f"note: {source}", urdf.notes)
        write(out, robot_toml(urdf.robot, [f"From {source.name}, {urdf.from_link} to {urdf.to_link}: {joints}."]))
        require_robot_written(out, urdf.robot)
        return
    if from_link or to_link or convention != "standard":
        raise InputError(
            "E-OPTION-NEEDS", "--from-link, --to-link, --convention: only for reading a URDF; leave them out"
        )
    robot = load_robot(source)
    text = robot_urdf(robot)
    ends = f"flange, and {len(robot.tools)} tools" if robot.tree is None else f"{len(robot.tools)} tools on branches"
    say(f"robot {robot.name}: {len(robot.rows)} joints from base_link to {ends}")
    if coupled(robot):
        say("note: URDF has no coupling; its joint values are the coupling times the controller's, with wider limits")
    write(out, text)
    require_urdf_written(out, robot)


def _is_xml(path: Path) -> bool:
    if path.suffix.lower() in (*XML, ".toml"):
        return path.suffix.lower() in XML
    try:
        with path.open("rb") as file:
            return file.read(200).lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"<")
    except OSError as error:
        raise InputError("E-FILE-UNREADABLE", f"{path}: {error.strerror or error}; check the path") from error


def init(
    file: Annotated[Path, "Write the robot file to this file.", Arg(writes=True)] = Path("robot.toml"),
) -> None:
    """Write an example of a robot file, to edit: a six-axis arm of 2 m reach."""
    from stcal.robot.kinematics.file import require_robot_written, robot_toml
    from stcal.robot.kinematics.model import mh80

    comments = (
        "One [[joint]] for each joint, from the base; of type revolute or prismatic (then min_mm and max_mm).",
        "Optional: min_deg, max_deg, beta_deg, base, tool, [[target]] for more tools, and coupling, which makes",
        "kinematic joint values of the controller's (Fanuc: its third row is [0, 1, 1, 0, 0, 0]).",
    )
    write(file, robot_toml(robot := mh80(), comments))
    require_robot_written(file, robot)
