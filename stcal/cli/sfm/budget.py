"""``stcal-sfm budget``: the uncertainty budget of a finished run."""

from pathlib import Path
from typing import Annotated

import typer

from stcal.cli.options import JsonFile, Run
from stcal.cli.terminal import say, write

app = typer.Typer()


@app.command()
def budget(
    run: Run,
    statement: Annotated[
        Path | None,
        typer.Option(
            "--statement",
            help="Read temperatures, expansion, the σ of the board's pitch and fields of the head from this file "
            "(TOML).",
        ),
    ] = None,
    field: Annotated[
        list[str] | None,
        typer.Option(
            "--field", help="Write NAME=VALUE into the head, such as operator='A. Smith'; may be given several times."
        ),
    ] = None,
    out: JsonFile = None,
) -> None:
    """Compute the uncertainty budget of faces and of the target's longest distances (GUM), each contribution apart."""
    from stcal.sfm.budget.combine import budget_of_run
    from stcal.sfm.budget.file import BudgetFile
    from stcal.sfm.budget.statement import statement_of
    from stcal.sfm.budget.text import budget_text
    from stcal.sfm.run.saved import load_run
    from stcal.sfm.run.verify import verify

    saved = load_run(run)
    stated = statement_of(saved.board.stated, statement, field or ())
    file = BudgetFile.of(budget_of_run(saved, stated), saved, verify(run))
    say(budget_text(file))
    if out:
        write(out, file, "as JSON")
