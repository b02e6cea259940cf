"""The page of a budget and its PDF."""

import re

import pytest

from stcal.report import document as pdf
from stcal.report.text import significant
from tests.outcome import INPUT, assert_error

STATED = "[board]\nexpansion_ppm_per_k = 8\ntemperature_c = 25\ntemperature_sigma_k = 0.5\n"


def test_page_and_pdf(stcal_sfm, small_run, tmp_path, monkeypatch):
    """Fields are text, not markup; a contribution stands in the page as in the terminal."""
    monkeypatch.setattr(pdf, "pdf_of", lambda page: b"%PDF-" + page[:15].encode())
    statement, page = tmp_path / "lab.toml", tmp_path / "budget.html"
    statement.write_text(STATED)
    field = "operator=<b>A & B</b>"
    words = ("--statement", statement, "--field", field, "--lengths", small_run, "--report", page, "--pdf")
    code, text, _ = stcal_sfm("budget", small_run, *words)
    assert code == 0
    html = page.read_text(encoding="utf-8")
    assert "&lt;b&gt;A &amp; B&lt;/b&gt;" in html
    assert "<b>A &" not in html
    combined = next(line for line in text.splitlines() if line.startswith("combined standard")).split()[4:]
    row = re.search(r'<th scope="row" class="l">combined standard uncertainty u</th>(.*?)</tr>', html, re.DOTALL)
    assert row is not None
    assert re.findall(r"<td>([\d.]+)</td>", row[1]) == combined
    assert "by +40.0 ppm" in html
    assert "hold at the temperature at which the target was photographed, with a correction of +40.0 ppm" in html
    assert "<h1>Certificate of calibration and uncertainty budget: " in html
    expanded = next(line for line in text.splitlines() if line.startswith("expanded uncertainty")).split()[6:]
    assert len(expanded) == 3
    assert all(len(value.replace(".", "").strip("0")) <= 2 for value in expanded), expanded
    assert text.index("position of face") < text.index("distance of circles")
    assert "agrees: all 10 lengths within U" in html
    assert re.search(r"SHA-256 of faces.json</th><td[^>]*>[0-9a-f]{64}<", html)
    assert not re.search(r'(?:src|href)="(?!data:|#)', html)
    assert (tmp_path / "budget.pdf").read_bytes() == b"%PDF-<!DOCTYPE html>"


def test_a_pdf_stands_beside_a_page(stcal_sfm, small_run, tmp_path):
    assert_error(stcal_sfm("budget", small_run, "--pdf"), INPUT, "E-OPTION-NEEDS", "--report", "FILE.html")
    words = ("--report", tmp_path / "budget.pdf", "--pdf")
    assert_error(stcal_sfm("budget", small_run, *words), INPUT, "E-OUTPUT-SUFFIX")


@pytest.mark.parametrize(
    ("value", "shown"),
    [(14.26, "14"), (9.96, "10"), (5.24, "5.2"), (0.01234, "0.012"), (126.0, "130"), (0.0, "0.00"), (None, "–")],
)
def test_uncertainties_have_two_significant_digits(value, shown):
    assert significant(value) == shown
