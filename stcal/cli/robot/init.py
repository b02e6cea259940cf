"""``stcal robot init``: an example of a robot file."""

from pathlib import Path
from typing import Annotated

import typer

from stcal.cli.terminal import write


def init(
    file: Annotated[Path, typer.Argument(writable=True, help="Write the robot file here.")] = Path("robot.toml"),
) -> None:
    """Write an example of a robot file, to edit: a six-axis arm of 2 m reach."""
    from stcal.robot.kinematics.example import mh80
    from stcal.robot.kinematics.file import robot_toml

    comments = (
        "One [[joint]] for each joint, from the base; of type revolute or prismatic (then min_mm and max_mm).",
        "Optional: min_deg, max_deg, beta_deg, base, tool, [[target]] for more tools, and coupling, which makes",
        "kinematic joint values of the controller's (Fanuc: its third row is [0, 1, 1, 0, 0, 0]).",
    )
    write(file, robot_toml(mh80(), comments))
