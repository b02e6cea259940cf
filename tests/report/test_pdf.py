"""Pages printed: what poppler reads of the PDF."""

import shutil
import subprocess
import sys

import pytest

from stcal.report.document import Document, Html, Section, Table, fold, pdf_of
from tests.outcome import refuses

pytestmark = pytest.mark.skipif(shutil.which("pdftotext") is None, reason="poppler-utils is not installed")
OUTSIDE = (
    "<button>press me</button><script>never shown</script>"
    '<img src="http://192.0.2.1/from-elsewhere.png" alt="left out">'
)


def page(rows: int) -> str:
    one = [Table(["<Name", "Value"], [[f"row {i}", i] for i in range(rows)])]
    one += [fold("Hidden", Table(["<Name"], [["folded away"]])), Html(lambda: OUTSIDE)]
    return Document("The <target>", "counts", [Section("First", one), Section("Second", ["word " * 100])]).page()


def words(pdf: bytes, command: str = "pdftotext", *options: str) -> str:
    made = subprocess.run([command, *options, "-", *["-"] * (command == "pdftotext")], input=pdf, capture_output=True)
    assert made.returncode == 0, made.stderr
    return made.stdout.decode()


@pytest.mark.slow
def test_a_page_is_printed_on_a4_with_numbers_and_its_title_without_what_paper_cannot_do():
    pdf = pdf_of(page(110))
    text = words(pdf, "pdftotext", "-layout").split("\f")[:-1]
    assert "595.276 x 841.89 pts (A4)" in words(pdf, "pdfinfo")
    assert len(text) >= 3
    for i, each in enumerate(text, 1):
        foot = each.rstrip().splitlines()[-1].replace(" ", "")
        assert foot == f"The<target>{i}/{len(text)}"
    assert all("Name" in each for each in text[1:3])  # heads of a table again on each sheet
    assert "Hidden (folded: see the page on screen)" in "".join(text)
    for gone in ("folded away", "press me", "never shown", "Contents"):  # what paper cannot do
        assert gone not in "".join(text)


def test_without_the_library_one_line_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "weasyprint", None)
    refuses("E-EXTRA-MISSING", pdf_of, page(1))
