"""Commands of hand-eye: ``handeye`` itself, and those whose names begin with it."""

import typer

from stcal.cli.handeye import calibrate, plan, rig

app = typer.Typer()
app.command("handeye")(calibrate.handeye)
app.command("handeye plan")(plan.plan)
app.command("handeye rig")(rig.rig)
