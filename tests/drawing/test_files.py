"""Lengths in files are exact, sheets of a paper cover what is split over them, and what cannot be drawn is refused."""

import re
from itertools import pairwise
from xml.etree import ElementTree

import numpy as np
import pytest

import stcal
from stcal.boards.board_designs import AprilGridDesign, CharucoDesign, ChessboardDesign
from stcal.boards.board_file import board_toml
from stcal.boards.target_file import target_toml
from stcal.design import reference_board, reference_target
from stcal.drawing.draw import EDGE, FOOT, OVERLAP, PAPERS, POINT_MM, SIDE, draw, framed, paper_sheets, seams_between
from stcal.drawing.parts import Disc, Outline, Text, parts_of
from tests.outcome import fails_with, refuses

SVG = "{http://www.w3.org/2000/svg}"
DIGITS = 1e-6
"""Half a nanometre either way is rounded off in SVG."""


@pytest.fixture
def files(tmp_path):
    (tmp_path / "target.toml").write_text(target_toml(reference_target()))
    (tmp_path / "board.toml").write_text(board_toml(reference_board()))
    return tmp_path


def assert_is_the_target(circles: dict[str, tuple[np.ndarray, float]]):
    """Each face's circles keep their places to one another, Y upwards, and their radii."""
    target = reference_target()
    assert set(circles) == set(target.radius_of())
    for face in target.faces:
        xy = np.array([circles[label][0] for label in face.labels()])
        np.testing.assert_allclose(xy - xy[0], face.xy_mm - face.xy_mm[0], atol=DIGITS)
        np.testing.assert_allclose([circles[label][1] for label in face.labels()], face.radius_mm, atol=DIGITS)


def test_a_design_is_drawn_like_its_file(files):
    of_file, of_design = files / "of-file.svg", files / "of-design.svg"
    draw(files / "target.toml", of_file)
    assert stcal.draw(stcal.load_target(files / "target.toml"), of_design).path == of_design
    assert of_design.read_bytes() == of_file.read_bytes()
    with fails_with("E-OPTION-RANGE … -1"):
        stcal.draw(files / "target.toml", of_design, margin_mm=-1.0)


def test_svg_has_the_target_in_mm(files):
    drawn = draw(files / "target.toml", files / "target.svg")
    root = ElementTree.parse(drawn.path).getroot()
    width, height = float(root.get("width", "").removesuffix("mm")), float(root.get("height", "").removesuffix("mm"))
    assert root.get("viewBox") == f"0 0 {width:g} {height:g}"
    circles = {}
    for each in root.iter(f"{SVG}circle"):
        x, y, radius = (float(each.get(key, "")) for key in ("cx", "cy", "r"))
        assert radius < x < width - radius
        circles[each.get("data-label")] = (np.array([x, -y]), radius)
    assert_is_the_target(circles)


@pytest.mark.slow
def test_pages_of_a_pdf_have_the_size_of_the_paper(files):
    drawn = draw(files / "target.toml", files / "target.pdf", "letter")
    sizes = re.findall(rb"/MediaBox \[ 0 0 ([\d.]+) ([\d.]+) \]", drawn.path.read_bytes())
    assert len(sizes) == len(drawn.sheets) == 5
    for sheet, size in zip(drawn.sheets, sizes, strict=True):
        np.testing.assert_allclose(np.array(size, float) * POINT_MM, [sheet.width, sheet.height], atol=1e-3)
        assert sorted([sheet.width, sheet.height]) == sorted(PAPERS["Letter"])


def test_sheets_cover_the_board_and_seams_run_between_dots():
    """Each dot is whole on a sheet, at its place against the others: a sheet's shift is that of all on it."""
    (part,) = parts_of(reference_board(), 10.0)
    sheets = paper_sheets([part], "A5", "board")
    assert len(sheets) == 6
    place = {s.name: np.array([s.x, s.y]) for s in part.shapes if isinstance(s, Disc)}
    whole, covered = set(), 0.0
    for sheet in sheets:
        (tile, furniture) = sheet.placed
        assert tile.clip is not None
        assert furniture.clip is None
        low, high = tile.clip
        assert (low >= [EDGE + SIDE - 1e-9, EDGE + FOOT - 1e-9]).all()
        assert (high <= np.array([sheet.width, sheet.height]) - EDGE + 1e-9).all()
        discs = [s for s in tile.shapes if isinstance(s, Disc)]
        shifts = np.array([[s.x, s.y] - place[s.name] for s in discs])
        np.testing.assert_allclose(shifts - shifts[0], 0, atol=1e-9)
        inner = [low + OVERLAP / 2 - 1e-9, high - OVERLAP / 2 + 1e-9]  # what is left when cut along the seams
        for disc in discs:
            box = disc.box()
            if (box[0] >= low).all() and (box[1] <= high).all():
                whole.add(disc.name)
            cut = ((box[0] < inner[0]) & (box[1] > inner[0])) | ((box[0] < inner[1]) & (box[1] > inner[1]))
            assert not cut.any(), disc.name
        marks = [s for s in tile.shapes if isinstance(s, Outline) and s.ink == "white"]
        assert len(marks) >= 6  # both strokes of at least three crosses
        covered += np.prod(high - low)
    assert whole == set(place)
    box = sheets[0].width * sheets[0].height
    assert covered < len(sheets) * box


@pytest.mark.parametrize("taken", [np.zeros((0, 2)), np.array([[40.0, 60.0], [90.0, 101.0]])])
def test_seams_leave_no_gap(taken):
    seams = seams_between(0.0, 250.0, 100.0, taken)
    ends = [0.0, *seams, 250.0]
    pieces = [(a - OVERLAP / 2 * (a > 0), b + OVERLAP / 2 * (b < 250)) for a, b in pairwise(ends)]
    assert max(b - a for a, b in pieces) <= 100.0
    assert not any(low < seam < high for seam in seams for low, high in taken.tolist())
    assert len(seams) == 2


def test_the_lengths_to_check_are_said():
    """Between the outermost inner corners: of 9 × 6 squares of 12 mm 7 × 4. 8 × 5 inner corners of 12 mm make 9 × 6
    squares: 108 mm × 72 mm, and a square around."""
    (part,) = parts_of(AprilGridDesign(3, 4, 20.0, 0.3, 2), 10.0)
    assert {words for *_, words in part.spans} == {"20, step 26"}
    (part,) = parts_of(CharucoDesign(6, 9, 12.0, 9.0, "DICT_4X4_50"), 10.0)
    lengths = {words: high - low for _, low, high, words in part.spans}
    assert lengths == {"7 × 12 = 84": 84.0, "4 × 12 = 48": 48.0}
    (part,) = parts_of(ChessboardDesign(5, 8, 12.0), 10.0)
    assert {"132", "96"} <= {shape.words for shape in framed(part) if isinstance(shape, Text)}


@pytest.mark.parametrize(
    ("name", "paper", "said"),
    [
        ("a.png", "", "E-OUTPUT-SUFFIX … .png … .pdf, .svg"),
        ("a", "", "E-OUTPUT-SUFFIX … missing"),
        ("a.pdf", "A9", "E-OPTION-VALUE … --paper … A9 … A5"),
        ("a.svg", "A4", "E-DRAW-SHEETS … 2"),
    ],
)
def test_what_cannot_be_drawn_is_refused(files, name, paper, said):
    (files / "board.svg").write_text("mine")
    with fails_with(said):
        draw(files / "board.toml", files / name, paper)
    assert (files / "board.svg").read_text() == "mine"
    assert len(list(files.iterdir())) == 3


def test_designs_that_cannot_be_drawn_are_refused(files):
    """One that is not there, one of too many sheets, and circles without a radius."""
    refuses("E-DRAW-DESIGN … nothing.toml … target.toml", draw, files / "nothing.toml", files / "a.svg")
    (files / "board.toml").write_text('type = "chessboard"\nrows = 60\ncolumns = 60\nsquare_mm = 100\n')
    refuses("E-DRAW-SHEETS … --paper … A4 … 500", draw, files / "board.toml", files / "board.pdf")
    refuses("E-DRAW-SHEETS … 5000", draw, files / "board.toml", files / "board.pdf", "own")
    (files / "grid.yaml").write_text(
        "target_type: circlegrid\ntargetCols: 4\ntargetRows: 5\nspacingMeters: 0.02\nasymmetricGrid: true\n"
    )
    refuses("E-BOARD-RADIUS … radius_mm", draw, files / "grid.yaml", files / "grid.pdf")
