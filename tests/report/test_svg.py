"""Drawings that are written directly as SVG, and pages printed: what poppler reads of the PDF."""

import base64
import shutil
import subprocess
import sys
from xml.etree import ElementTree

import numpy as np
import pytest

from stcal.report.document import Document, Html, Section, Table, fold, pdf_of
from stcal.report.svg import Axes, Drawing, save
from tests.outcome import refuses


@pytest.mark.parametrize("name", ["$x^{", "面", "_$\\frac", "<a & 'b'>", "\x07bell", "\udcff.jpg"])
def test_any_name_can_be_written(name):
    drawing = Drawing(1, 1)
    drawing.words((0, 0), name)
    tree = ElementTree.fromstring(base64.b64decode(drawing.uri().partition(",")[2]))
    (text,) = tree.iter("{http://www.w3.org/2000/svg}text")
    assert text.text == name.replace("\x07", "\ufffd").replace("\udcff", "\\udcff")


def test_axes_hold_their_data():
    axes = Axes(Drawing(2, 2), (10, 20, 110, 70), (0, 4), (5, -5))  # downwards
    np.testing.assert_allclose(axes.at([0, 4, 1], [5, -5, 0]), [[10, 70], [110, 20], [35, 45]])
    axes = Axes(Drawing(2, 2), (10, 20, 110, 70), (1, 100), (0, 1), log="x")
    np.testing.assert_allclose(axes.at([1, 10, 100, -1], 0), [[10, 70], [60, 70], [110, 70], [10, 70]])
    xy = np.array([[0.0, 0.0], [300.0, 10.0]])
    axes = Axes.equal(Drawing(3, 3), (10, 20, 110, 70), xy, 0.0, down=True)
    np.testing.assert_allclose(axes.at(*xy.T), [[10, 45 - 5 / 3], [110, 45 + 5 / 3]])


def test_a_figure_is_saved_as_svg_and_in_no_other_form(tmp_path):
    save(Drawing(2, 2), tmp_path / "new" / "plot.svg")
    assert (tmp_path / "new" / "plot.svg").read_text().startswith("<svg")
    refuses("E-OUTPUT-SUFFIX … plot.png … .svg", save, Drawing(2, 2), tmp_path / "plot.png")


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
@pytest.mark.skipif(shutil.which("pdftotext") is None, reason="poppler-utils is not installed")
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
