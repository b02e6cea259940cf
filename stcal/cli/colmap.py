"""``stcal-sfm``: what goes to and comes from COLMAP, and why something was left out."""

from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer()

Run = Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a finished run.")]
