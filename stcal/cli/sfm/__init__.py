"""Commands ``stcal-sfm``: calibration of a target from images, and related tasks."""

from stcal.cli.help import group
from stcal.cli.sfm import design_commands as designs
from stcal.cli.sfm import measure, run

app = group("stcal-sfm", "Calibrate a target from a folder of images. With --debug, any command prints a traceback.")
for part in (run, designs, measure):
    app.add_typer(part.app)
