"""``stcal-sfm``: targets and boards to be made."""

from pathlib import Path
from typing import Annotated

import typer

from stcal.cli.terminal import say

app = typer.Typer()


@app.command()
def draw(
    design: Annotated[
        Path, typer.Argument(metavar="DESIGN", help="Read this target.toml, or this board file of any kind.")
    ],
    out: Annotated[
        Path,
        typer.Option(
            "--out", writable=True, help="Write this new file; its suffix tells the form: .pdf, .svg or .dxf."
        ),
    ],
    paper: Annotated[
        str,
        typer.Option(
            help="Print on sheets of this paper, as many as needed: A5 … A0, Letter, Legal or Tabloid; own for pages "
            "as large as what they show. A4 for .pdf and own for the others if not given."
        ),
    ] = "",
    margin: Annotated[
        float, typer.Option("--margin-mm", min=0, max=1e4, help="Add this around the outermost circles, mm.")
    ] = 10.0,
) -> None:
    """Draw a target or a board 1:1, with dimensions, cut marks and scale bars, to print, cut or mill."""
    from stcal.drawing.draw import draw as drawn
    from stcal.drawing.text import drawn_text

    say(drawn_text(drawn(design, out, paper, margin)))
