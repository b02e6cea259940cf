"""Commands of robots."""

import typer

from stcal.cli.help import PLAIN, Commands
from stcal.cli.robot import axes, compensate, design, identify, init, verify

app = typer.Typer(
    name="stcal robot",
    help="Calibrate a robot from measured data of any instrument, and compensate it.",
    cls=Commands,
    **PLAIN,
)
for command in (init.init, axes.axes, identify.identify, compensate.compensate, verify.verify, design.design):
    app.command()(command)
