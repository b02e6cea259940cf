"""The page of a budget and its PDF."""

import json
import re

import pytest

from stcal.report import document as pdf
from stcal.report.text import significant
from stcal.sfm.budget.budget_file import BudgetFile
from stcal.sfm.budget.budget_page import REQUIRED, as_exact, budget_report
from stcal.sfm.budget.combine import budget_of_run
from stcal.sfm.runs.saved import load_run, verify
from tests.outcome import INPUT, assert_error

STATED = "[board]\nexpansion_ppm_per_k = 8\ntemperature_c = 25\ntemperature_sigma_k = 0.5\n"


def test_page_and_pdf(stcal_sfm, small_run, tmp_path, monkeypatch):
    """Fields are text, not markup; a contribution stands in the page as in the terminal."""
    monkeypatch.setattr(pdf, "pdf_of", lambda page: b"%PDF-" + page[:15].encode())
    statement, page = tmp_path / "lab.toml", tmp_path / "budget.html"
    statement.write_text(STATED)
    field = "operator=<b>A & B</b>"
    words = ("--statement", statement, "--field", field, "--lengths", small_run, "--report", page, "--pdf")
    code, text, _ = stcal_sfm("budget", small_run, *words, "-v")
    assert code == 0
    html = page.read_text(encoding="utf-8")
    assert "&lt;b&gt;A &amp; B&lt;/b&gt;" in html
    assert "<b>A &" not in html
    combined = next(line for line in text.splitlines() if line.startswith("combined standard")).split()[4:]
    row = re.search(r'<th scope="row" class="l">combined standard uncertainty u</th>(.*?)</tr>', html, re.DOTALL)
    assert row is not None
    assert re.findall(r"<td>([\d.]+)</td>", row[1]) == combined
    assert "+40.0 ppm" in html
    assert "not a certificate: nothing is stated of" in html
    expanded = next(line for line in text.splitlines() if line.startswith("expanded uncertainty")).split()[6:]
    assert len(expanded) == 3
    assert all(len(value.replace(".", "").strip("0")) <= 2 for value in expanded), expanded
    circle = next(iter(json.loads((small_run / "faces.json").read_text())["circles"]))
    assert re.search(rf'<th scope="row" class="l">{circle}</th>(<td>-?[\d.]+</td>){{3}}(<td>\d[\d.]*</td>){{3}}', html)
    assert re.search(r"SHA-256 of faces.json</th><td[^>]*>[0-9a-f]{64}<", html)
    assert not re.search(r'(?:src|href)="(?!data:|#)', html)
    assert (tmp_path / "budget.pdf").read_bytes() == b"%PDF-<!DOCTYPE html>"


def test_a_pdf_stands_beside_a_page(stcal_sfm, small_run, tmp_path):
    assert_error(stcal_sfm("budget", small_run, "--pdf"), INPUT, "E-OPTION-NEEDS", "--report", "FILE.html")
    words = ("--report", tmp_path / "budget.pdf", "--pdf")
    assert_error(stcal_sfm("budget", small_run, *words), INPUT, "E-OUTPUT-SUFFIX", "budget.html, and --pdf")
    assert_error(stcal_sfm("budget", small_run, *words[:2]), INPUT, "E-OUTPUT-SUFFIX", "budget.html, and --pdf")


@pytest.mark.parametrize(
    ("value", "shown"), [(14.26, "14"), (9.96, "10"), (0.01234, "0.012"), (126.0, "130"), (None, "–")]
)
def test_uncertainties_have_two_significant_digits_and_values_end_with_the_last_of_them(value, shown):
    assert significant(value) == shown
    assert [as_exact(166.18664, 0.031), as_exact(236.457, 15.0), as_exact(1.23456, 0.0)] == ["166.187", "236", "1.2346"]


def test_a_certificate_has_all_inputs_stated_and_a_traceability(small_run, tmp_path):
    """Of a sound run with lengths at 20 °C; its head has the answer, its end the definitions and the board."""
    run = load_run(small_run)
    file = BudgetFile.of(budget_of_run(run), run, verify(run.folder))
    stated = [row.model_copy(update={"origin": "stated"}) for row in file.sources]
    full = file.model_copy(update={"sources": stated, "fields": dict.fromkeys(REQUIRED, "rule 7")})
    for one, lacks in (
        *((full.model_copy(update={"fields": full.fields | {name: " "}}), name) for name in REQUIRED),
        (file.model_copy(update={"fields": full.fields}), "board's pitch"),
    ):
        page = budget_report(one).page()
        assert "Certificate" not in page
        assert re.search(
            f"not a certificate: nothing is stated of [^<]*{re.escape(lacks.replace(chr(39), '&#39;'))}", page
        )
    care = full.model_copy(update={"reserved": True})
    assert "not a certificate: the run says that it is to be used with care" in budget_report(care).page()
    page = budget_report(full).page()
    assert re.search("<h1>Certificate of calibration no. rule 7, with uncertainty budget: .*</h1>", page)
    assert "not a certificate" not in page
    assert page.index("May the run be used?") < page.index("<h2>")
    assert "origin at circle" in page
    assert run.folder.parent.name not in page
    assert [row.value for row in file.stated if row.key == "pitch_mm"] == [run.board_design.pitch_mm]
