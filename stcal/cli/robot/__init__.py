"""Commands of robots."""

import typer

from stcal.cli.help import PLAIN, Commands
from stcal.cli.robot import axes, compensate, convert, design, evaluate, from_photos, identify

app = typer.Typer(
    name="stcal robot",
    help="Calibrate a robot from measured data of any instrument, and compensate it.",
    cls=Commands,
    **PLAIN,
)
COMMANDS = (
    convert.init,
    axes.axes,
    identify.identify,
    evaluate.evaluate,
    compensate.compensate,
    evaluate.verify,
    design.design,
    convert.convert,
    from_photos.from_photos,
)
for command in COMMANDS:
    app.command()(command)
