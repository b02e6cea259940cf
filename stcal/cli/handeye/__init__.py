"""Commands of hand-eye: ``handeye`` itself, and those whose names begin with it."""

import typer

from stcal.cli.handeye import calibrate

app = typer.Typer()
app.command("handeye")(calibrate.handeye)
