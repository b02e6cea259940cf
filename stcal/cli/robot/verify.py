"""``stcal robot verify``: measured against commanded distances."""

from pathlib import Path
from typing import Annotated

import typer

from stcal.cli.options import ColumnsFile, FirstTable, JsonFile, Key, ReportFile, several_tables
from stcal.cli.terminal import print_each, say, write
from stcal.errors import InputError


def verify(
    measured: Annotated[
        Path | None,
        typer.Argument(help="Read commanded_x_mm … beside measured x_mm … from this file; set: before, after (CSV)."),
    ] = None,
    plot: Annotated[
        Path | None,
        typer.Option("--plot", writable=True, help="Draw the error of each pose and set to this file (.png or .svg)."),
    ] = None,
    first: FirstTable = None,
    seconds: Annotated[
        list[Path] | None,
        typer.Option(
            "--b",
            metavar="<path>",
            help="Read what was measured from this file (CSV); several are sets, called like them.",
        ),
    ] = None,
    key: Key = "pose",
    columns: ColumnsFile = None,
    json_file: JsonFile = None,
    report: ReportFile = None,
) -> None:
    """Compare distances of measured positions from the first with the commanded ones, before and after."""
    from stcal.io.join import stack
    from stcal.robot.use import verification as stage

    if plot and plot.suffix.lower() not in (".png", ".svg"):
        raise InputError("E-OUTPUT-SUFFIX", f"--plot {plot}: a name ending in .png or .svg needed")
    tables = several_tables(measured, first, seconds or [], key, "MEASURED", ("commanded_", ""), columns=columns)
    source = (
        tables if not isinstance(tables, list) else stack(tables, [path.stem for path in seconds or ()], {"pose": key})
    )
    result = stage.verify(stage.read_measured(source))
    say(stage.verified_text(result))
    print_each("note", result.notes)
    print_each("warning", result.warnings())
    if plot:
        from stcal.robot.use.report import figure_bytes, verification_figure

        write(plot, figure_bytes(verification_figure(result), plot.suffix.lower()[1:]))
    if json_file:
        write(json_file, stage.verification_file(result))
    if report:
        from stcal.robot.use.report import verification_page

        write(report, verification_page(result))
