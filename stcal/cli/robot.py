"""``stcal robot``: kinematics from measured data, and joint values that reach what was commanded."""

from pathlib import Path
from typing import Annotated

import typer

from stcal.errors import InputError

app = typer.Typer(
    name="stcal robot",
    help="Calibrate a robot from measured data of any instrument, and compensate it.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

RobotFile = Annotated[Path, typer.Option("--robot", help="Robot file (TOML); `stcal robot init` writes one.")]
JsonFile = Annotated[Path | None, typer.Option("--json", help="Also write everything as JSON.")]
ReportFile = Annotated[Path | None, typer.Option("--report", help="Also write a page with tables and plots (HTML).")]


@app.command()
def init(
    file: Annotated[Path, typer.Argument(help="Robot file to write; must not exist.")] = Path("robot.toml"),
) -> None:
    """Write an example of a robot file, to edit: a six-axis arm of 2 m reach."""
    from stcal.robot.robot_file import robot_toml
    from stcal.robot.simulated import mh80

    if file.exists():
        raise InputError(f"robot file {file}: exists already; give another name or move it away")
    file.parent.mkdir(parents=True, exist_ok=True)
    comments = (
        "One [[joint]] for each joint, from the base; of type revolute or prismatic (then min_mm and max_mm).",
        "Optional: min_deg, max_deg, beta_deg, base, tool, [[target]] for more tools, and coupling, which makes",
        "kinematic joint values of the controller's (Fanuc: its third row is [0, 1, 1, 0, 0, 0]).",
    )
    file.write_text(robot_toml(mh80(), comments), encoding="utf-8")
    print(f"written: {file}")
