"""Commands ``stcal-sfm``: calibration of a target from images, and related tasks."""

import typer

from stcal.cli.help import PLAIN, Commands
from stcal.cli.sfm import colmap, designs, measure, planning, run

app = typer.Typer(
    name="stcal-sfm",
    help="Calibrate a target from a folder of images. With --debug, any command prints a traceback.",
    cls=Commands,
    **PLAIN,
)
for part in (run, designs, colmap, planning, measure):
    app.add_typer(part.app)
