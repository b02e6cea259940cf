"""Drawings that are written directly as SVG."""

import base64
from xml.etree import ElementTree

import numpy as np
import pytest

from stcal.report.svg import Axes, Drawing, save
from tests.outcome import refuses


def written(drawing: Drawing) -> ElementTree.Element:
    """The drawing as a reader of XML takes it."""
    return ElementTree.fromstring(base64.b64decode(drawing.uri().partition(",")[2]))


@pytest.mark.parametrize("name", ["$x^{", "面", "_$\\frac", "<a & 'b'>", "\x07bell", "\udcff.jpg"])
def test_any_name_can_be_written(name):
    drawing = Drawing(1, 1)
    drawing.words((0, 0), name)
    (text,) = written(drawing).iter("{http://www.w3.org/2000/svg}text")
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
