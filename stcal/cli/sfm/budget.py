"""Command ``stcal-sfm budget``: the uncertainty budget of a finished run."""

from pathlib import Path
from typing import Annotated

import typer

from stcal.cli.options import JsonFile, ReportFile, Run, StrictByDefault, require_usable
from stcal.cli.terminal import say, write, write_if
from stcal.errors import InputError
from stcal.io.files import keep_apart

app = typer.Typer()


@app.command()
def budget(
    run: Run,
    statement: Annotated[
        Path | None,
        "Read temperatures, expansion, the σ of the board's pitch and fields of the header from this file (TOML).",
    ] = None,
    field: Annotated[
        list[str] | None, "Write NAME=VALUE into the header, such as operator='A. Smith'; may be given several times."
    ] = None,
    check_lengths: Annotated[
        Path | None,
        "Compare distances between circles with the lengths in this file (CSV: from, to, length_mm, sigma_mm).",
    ] = None,
    columns: Annotated[Path | None, "Read --check-lengths with the columns, delimiter … of this file (TOML)."] = None,
    lengths: Annotated[Path | None, "Compare the longest distances with the second calibration in this folder."] = None,
    lengths_statement: Annotated[
        Path | None, "Read the statement of that second calibration from this file; if not given, --statement is used."
    ] = None,
    page: ReportFile = None,
    pdf: Annotated[bool, "Also write the page as PDF beside it (needs the extra `pdf`)."] = False,
    out: JsonFile = None,
    strict: StrictByDefault = True,
) -> None:
    """Compute the uncertainty budget (GUM) of the faces and of the target's longest distances, by contributions."""
    from stcal.report.document import pdf_of
    from stcal.sfm.budget.of_run import uncertainty_budget
    from stcal.sfm.budget.sources import fields_of

    if pdf:
        _require_pdf(page, run)
    fields = fields_of(field or ())
    result = uncertainty_budget(run, statement, fields, check_lengths, columns, lengths, lengths_statement)
    document = result.document()
    say(document.text())
    write_if(out, lambda: result.file, "as JSON")
    if page:
        html = document.page()
        write(page, html, "report")
        if pdf:
            write(page.with_suffix(".pdf"), pdf_of(html), "PDF")
    require_usable(strict, result.refusals, page)


def _require_pdf(page: Path | None, run: Path) -> None:
    """Refuses, before the work, a PDF without a page or a place.

    Raises InputError if there is no page, the page itself has the suffix of a PDF, or the extra ``pdf`` is not
    installed.
    """
    from stcal.report.document import require_pdf

    if page is None:
        raise InputError("E-OPTION-NEEDS", "--pdf: the PDF stands beside the page; give that with --report FILE.html")
    if page.suffix.lower() == ".pdf":
        raise InputError(
            "E-OUTPUT-SUFFIX",
            f"--report {page}: the page is HTML; give {page.with_suffix('.html')}, and --pdf for the PDF",
        )
    keep_apart([("--pdf", page.with_suffix(".pdf"))], [("RUN", run)])
    require_pdf()
