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
    from stcal.report.page import pdf_of
    from stcal.sfm.budget.combine import budget_of_run
    from stcal.sfm.budget.file import BudgetFile, refusals
    from stcal.sfm.budget.lengths import against_run, against_stated
    from stcal.sfm.budget.page import budget_report
    from stcal.sfm.budget.sources import statement_of
    from stcal.sfm.runs.saved import load_run
    from stcal.sfm.runs.verify import verify

    if columns is not None and check_lengths is None:
        raise InputError(
            "E-OPTION-NEEDS", f"--columns {columns}: it describes a table of lengths; give it with --check-lengths"
        )
    saved = load_run(run)
    stated = statement_of(saved.board_design.stated, statement, field or ())
    if pdf:
        _require_pdf(page, run)
    if lengths_statement is not None and lengths is None:
        raise InputError(
            "E-OPTION-NEEDS",
            f"--lengths-statement {lengths_statement}: it is for a second calibration; give it with --lengths",
        )
    computed, tests, others = budget_of_run(saved, stated), [], []
    if check_lengths is not None:
        tests.append(against_stated(computed, check_lengths, columns))
    if lengths is not None:
        second = load_run(lengths)
        others.append(second)
        statement_of_second = statement_of(second.board_design.stated, lengths_statement or statement)
        tests.append(
            against_run(
                computed, budget_of_run(second, statement_of_second), lengths, (saved.board_design, second.board_design)
            )
        )
    file = BudgetFile.of(computed, saved, verify(run), tests, *others)
    document = budget_report(file)
    say(document.text())
    write_if(out, lambda: file, "as JSON")
    if page:
        html = document.page()
        write(page, html, "report")
        if pdf:
            write(page.with_suffix(".pdf"), pdf_of(html), "PDF")
    require_usable(strict, refusals([saved, *others], file.length_tests), page)


def _require_pdf(page: Path | None, run: Path) -> None:
    """Refuses, before the work, a PDF without a page or a place.

    Raises InputError if there is no page, the page itself has the suffix of a PDF, or the extra ``pdf`` is not
    installed.
    """
    from stcal.report.page import require_pdf

    if page is None:
        raise InputError("E-OPTION-NEEDS", "--pdf: the PDF stands beside the page; give that with --report FILE.html")
    if page.suffix.lower() == ".pdf":
        raise InputError(
            "E-OUTPUT-SUFFIX",
            f"--report {page}: the page is HTML; give {page.with_suffix('.html')}, and --pdf for the PDF",
        )
    keep_apart([("--pdf", page.with_suffix(".pdf"))], [("RUN", run)])
    require_pdf()
