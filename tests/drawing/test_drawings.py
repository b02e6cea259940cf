"""Drawings: lengths in files are exact, sheets cover what is split over them, nets cover nothing, and detection reads
back what another program draws of a page, from the front and obliquely."""

import re
from dataclasses import replace
from itertools import combinations
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
from pypdfium2 import PdfDocument

import stcal
from stcal.boards.board_designs import (
    AprilGridDesign,
    AsymmetricCirclesDesign,
    CharucoDesign,
    ChessboardDesign,
    TagLayout,
)
from stcal.boards.board_file import board_toml
from stcal.boards.finders import find_on_faces
from stcal.boards.target_file import target_toml
from stcal.design import BoardDesign, TargetDesign, reference_board, reference_target
from stcal.drawing.draw import (
    EDGE,
    FOOT,
    OVERLAP,
    PAPERS,
    POINT_MM,
    SIDE,
    draw,
    drawn_text,
    framed,
    net_text,
    one_sheet,
    paper_sheets,
    pdf,
)
from stcal.drawing.parts import Disc, Outline, Text, _is_clear, net_part, parts_of
from stcal.geometry.camera import COEFFICIENTS, Camera
from stcal.geometry.plane import apply_homography
from stcal.geometry.rigid import Rigid
from stcal.labels import BOARD
from stcal.sfm.detect.candidates import EllipseOptions
from stcal.sfm.detect.image import detect_image
from stcal.sfm.detect.labelling import label_single
from stcal.sfm.make import make_pattern, sides_of
from stcal.synthetic.designs import second_design, tag_body
from tests.outcome import refuses
from tests.shared import written
from tests.support.areas import area_and_centroid

PER_MM = 4
"""With fewer, the letters beside a plate pass for circles seen from the side."""
FINE = 4
"""Pixels in which a page is drawn in a pixel of its image, along each side."""
OBLIQUE_RAD = np.radians(50)


def shapes_of(sheet) -> list:
    """All shapes of a page."""
    return [*sheet.shapes, *sheet.furniture]


def pages_of(content: bytes) -> list[np.ndarray]:
    """Pages of a PDF as another program draws them, grey: pixels ``PER_MM`` a millimetre."""
    scale, pages = PER_MM * POINT_MM, []
    for page in PdfDocument(content):
        whole = np.ceil(np.array(page.get_size()) * scale - 1e-3)  # else the page is stretched to whole pixels
        page.set_mediabox(0, 0, *(whole / scale).tolist())
        # PDFium moves the sides of rectangles to whole pixels: these are made small.
        fine = page.render(scale=FINE * scale * (1 - 1e-7), grayscale=True).to_numpy()
        pages.append(cv2.resize(fine, None, fx=1 / FINE, fy=1 / FINE, interpolation=cv2.INTER_AREA))
    return pages


def pixel_from_page(image: np.ndarray, xy_mm: np.ndarray) -> np.ndarray:
    """Places on a page in its image; centres of pixels are integers."""
    return PER_MM * np.asarray(xy_mm) * [1, -1] + [0, len(image)] - 0.5


def camera_of(image: np.ndarray) -> Camera:
    """One that sees the page as it is from the front."""
    height, width = image.shape
    focal = 1.5 * max(height, width)
    return Camera(width, height, [focal, focal], [(width - 1) / 2, (height - 1) / 2], np.zeros(COEFFICIENTS))


CIRCLE_PX, CORNER_PX = 0.1, 0.3
"""How well centres and corners are found again in an image without noise, blurred a little: edges of 8-bit pixels, and
of the oblique ones twice interpolated."""


ANGLES = np.arange(64) * np.pi / 32


def rims_px(sheet, page) -> dict[str, np.ndarray]:
    """Rims of the circles in the page's image, by label, (64, 2)."""
    rim = np.stack([np.cos(ANGLES), np.sin(ANGLES)], 1)
    discs = [s for s in shapes_of(sheet) if isinstance(s, Disc)]
    return {s.name: pixel_from_page(page, [s.x, s.y] + s.radius * rim) for s in discs}


def seen_ways(image, places):
    """The image, where ``places`` of the page are in it, and the camera; from the front, and turned about a slanted
    axis."""
    camera = camera_of(image)
    yield image, places, camera
    matrix = camera.to_opencv()[0]
    turn = cv2.Rodrigues(OBLIQUE_RAD * np.array([0.6, 0.8, 0.0]))[0]
    turn[:, 2] = [0, 0, 1.0]  # the plane's points x, y at depth 1: columns 1 and 2 of the turn, then the shift
    homography = matrix @ turn @ np.linalg.inv(matrix)
    seen = cv2.warpPerspective(cv2.GaussianBlur(image, (0, 0), 0.7), homography, image.shape[::-1], borderValue=255)
    yield seen, {name: apply_homography(homography, xy) for name, xy in places.items()}, camera


@pytest.mark.slow
@pytest.mark.parametrize("target", [reference_target(), second_design()[0]], ids=["bright", "dark"])
def test_faces_are_read_back(target: TargetDesign, tmp_path):
    """Every page of the PDF, drawn by another program: all circles of its face named, at their places."""
    drawn = draw(written(tmp_path / "target.toml", target_toml(target)), tmp_path / "target.pdf")
    pages = pages_of(drawn.path.read_bytes())
    assert len(pages) == len(target.faces)
    for sheet, page in zip(drawn.sheets, pages, strict=True):
        for image, rims, camera in seen_ways(page, rims_px(sheet, page)):
            detection = detect_image(image, camera, target, None, EllipseOptions())
            found = label_single("page", ".", detection, target).observations
            assert set(found.labels) == set(rims)
            expected = [area_and_centroid(rims[label])[1] for label in found.labels]
            assert np.linalg.norm(found.centre_px - expected, axis=1).max() < CIRCLE_PX


def test_dots_are_read_back():
    board = BoardDesign(5, 7, 12.0, 3.0, "bright", 0.005, (0, 6), 4.5)
    sheet = one_sheet(parts_of(board, 10.0), "board")
    page = pages_of(pdf([sheet]))[0]
    for image, rims, camera in seen_ways(page, rims_px(sheet, page)):
        detection = detect_image(image, camera, reference_target(), board, EllipseOptions())
        (sighting,) = detection.boards
        (cells,) = sighting.numberings.tolist()
        assert {f"board:{row}:{column}" for row, column in cells} == set(rims)
        expected = [area_and_centroid(rims[f"board:{row}:{column}"])[1] for row, column in cells]
        off = detection.centres.centre_px[sighting.rows] - expected
        assert np.linalg.norm(off, axis=1).max() < CIRCLE_PX


def points_px(sheet, part, board, page) -> np.ndarray:
    """Where the points of a board of squares are in the page's image."""
    areas = [s for s in part.shapes if isinstance(s, Outline) and not s.width]
    there = [s for s in shapes_of(sheet) if isinstance(s, Outline) and not s.width]
    shift = there[0].lines[0][0] - areas[0].lines[0][0]
    return pixel_from_page(page, board.xy_mm() * [1, -1] + shift)


TAGS = TagLayout.from_tags("5X5_50", [3, 7], [[10, 10], [52.5, 12.5]], [20, 20.6], [0, -14])
BOARDS = {
    "chessboard": ChessboardDesign(5, 8, 12.0),
    "charuco of even rows": CharucoDesign(6, 5, 12.0, 9.0, "DICT_5X5_50", first_id=4),
    "charuco before 4.6": CharucoDesign(6, 5, 12.0, 9.0, "DICT_4X4_50", legacy=True),
    "aprilgrid": AprilGridDesign(3, 4, 20.0, 0.3, 2),
    "aprilgrid, upright": AprilGridDesign(3, 4, 20.0, 0.3, 1, upright=True),
    "tags": TAGS,
}


@pytest.mark.slow
@pytest.mark.parametrize("board", BOARDS.values(), ids=BOARDS)
def test_squares_and_tags_are_read_back(board):
    (part,) = parts_of(board, 10.0)
    sheet = one_sheet([part], "board")
    page = pages_of(pdf([sheet]))[0]
    for image, places, camera in seen_ways(page, {"": points_px(sheet, part, board, page)}):
        xy = places[""]
        views, _ = find_on_faces(image, "page", {BOARD: board}, camera)
        assert len(views[BOARD]) == len(xy)
        assert np.linalg.norm(views[BOARD].xy_px - xy[views[BOARD].ids], axis=1).max() < CORNER_PX


def test_plates_have_their_margin_and_circles_and_holes_lie_where_the_design_has_them():
    for part, face in zip(parts_of(reference_target(), 7.0), reference_target().faces, strict=True):
        rims = face.xy_mm + np.array([[-1.0], [1.0]])[:, :, None] * face.radius_mm[:, None]
        np.testing.assert_allclose(part.outline.min(0), rims.min((0, 1)) - 7.0)
        np.testing.assert_allclose(part.outline.max(0), rims.max((0, 1)) + 7.0)
    board = AsymmetricCirclesDesign(5, 4, 10.0, 3.0, "dark", rings=((0, 1), (3, 2)))
    (part,) = parts_of(board, 10.0)
    discs = [(s.x, -s.y, s.radius, s.ink) for s in part.shapes if s.layer == "PATTERN" and isinstance(s, Disc)]
    holes = [(x, y, 1.5, "white") for x, y in board.xy_mm()[[1, 14]]]
    wanted = [*((x, y, 3.0, "black") for x, y in board.xy_mm()), *holes]
    assert [ink for *_, ink in discs] == [ink for *_, ink in wanted]
    np.testing.assert_allclose([numbers for *numbers, _ in discs], [numbers for *numbers, _ in wanted])


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


def test_svg_has_the_target_in_mm_of_a_design_as_of_its_file(files):
    of_file, of_design = files / "of-file.svg", files / "of-design.svg"
    draw(files / "target.toml", of_file)
    assert stcal.draw(stcal.load_target(files / "target.toml"), of_design).path == of_design
    assert of_design.read_bytes() == of_file.read_bytes()
    refuses("E-OPTION-RANGE … -1", stcal.draw, files / "target.toml", of_design, margin_mm=-1.0)
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
def test_pages_of_a_pdf_have_the_size_of_the_paper_and_a_net_is_on_one_sheet(files, target, tmp_path):
    drawn = draw(files / "target.toml", files / "target.pdf", "letter")
    sizes = re.findall(rb"/MediaBox \[ 0 0 ([\d.]+) ([\d.]+) \]", drawn.path.read_bytes())
    assert len(sizes) == len(drawn.sheets) == 5
    for sheet, size in zip(drawn.sheets, sizes, strict=True):
        np.testing.assert_allclose(np.array(size, float) * POINT_MM, [sheet.width, sheet.height], atol=1e-3)
        assert sorted([sheet.width, sheet.height]) == sorted(PAPERS["Letter"])
    said = drawn_text(draw(files / "board.toml", tmp_path / "board.pdf", "A5"))
    assert said.endswith("off at the seams: state it in sigma_mm, or print with --paper A3")
    drawn = draw(target, tmp_path / "net.pdf", net=True)  # 400 × 200 mm and more
    assert (drawn.paper, len(drawn.sheets)) == ("A2", 1)
    refuses("E-DRAW-SHEETS … --net … A3 … --paper A2", draw, target, tmp_path / "a3.pdf", paper="A3", net=True)
    assert "larger than A0" in net_text(tag_body("cube", 500.0, "DICT_APRILTAG_36h11", 0))


def test_sheets_cover_the_board_and_seams_run_between_dots():
    """Each dot is whole on a sheet, at its place against the others: a sheet's shift is that of all on it."""
    (part,) = parts_of(reference_board(), 10.0)
    sheets = paper_sheets([part], "A5", "board")
    assert len(sheets) == 6
    place = {s.name: np.array([s.x, s.y]) for s in part.shapes if isinstance(s, Disc)}
    whole, covered = set(), 0.0
    for sheet in sheets:
        assert sheet.clip is not None
        low, high = sheet.clip
        assert (low >= [EDGE + SIDE - 1e-9, EDGE + FOOT - 1e-9]).all()
        assert (high <= np.array([sheet.width, sheet.height]) - EDGE + 1e-9).all()
        discs = [s for s in sheet.shapes if isinstance(s, Disc)]
        shifts = np.array([[s.x, s.y] - place[s.name] for s in discs])
        np.testing.assert_allclose(shifts - shifts[0], 0, atol=1e-9)
        inner = [low + OVERLAP / 2 - 1e-9, high - OVERLAP / 2 + 1e-9]  # what is left when cut along the seams
        for disc in discs:
            box = disc.box()
            if (box[0] >= low).all() and (box[1] <= high).all():
                whole.add(disc.name)
            cut = ((box[0] < inner[0]) & (box[1] > inner[0])) | ((box[0] < inner[1]) & (box[1] > inner[1]))
            assert not cut.any(), disc.name
        marks = [s for s in sheet.shapes if isinstance(s, Outline) and s.ink == "white"]
        assert len(marks) >= 6  # both strokes of at least three crosses
        covered += np.prod(high - low)
    assert whole == set(place)
    box = sheets[0].width * sheets[0].height
    assert covered < len(sheets) * box


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
    refuses(said, draw, files / "board.toml", files / name, paper)
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


SIZE = (120.0, 100.0, 80.0)


@pytest.fixture(scope="module")
def target():
    return make_pattern(sides_of(SIZE), 9, 4.0, "bright", 3, "box")[0]


def circles_of(part) -> dict[str, np.ndarray]:
    return {s.name: np.array([s.x, s.y]) for s in part.shapes if isinstance(s, Disc)}


def places_of(target, part) -> dict[str, np.ndarray]:
    """Corners of the plates in the net, by where the circles are; proper turns only."""
    found, circles = {}, circles_of(part)
    for face in target.faces:
        xy = np.array([circles[label] for label in face.labels()])
        middle, own = xy.mean(0), face.xy_mm.mean(0)
        u, _, vt = np.linalg.svd((xy - middle).T @ (face.xy_mm - own))
        turn = u @ np.diag([1, np.linalg.det(u @ vt)]) @ vt
        np.testing.assert_allclose((face.xy_mm - own) @ turn.T + middle, xy, atol=1e-9)
        found[face.id] = (face.outline_mm - own) @ turn.T + middle
    return found


def test_a_box_is_one_net_whose_plates_meet_as_they_do_in_space_and_are_read_from_it(target):
    """At a fold both plates have the same corners."""
    part = net_part(target)
    assert set(circles_of(part)) == set(target.radius_of())
    plates = places_of(target, part)
    assert all(_is_clear(a, [b]) for a, b in combinations(plates.values(), 2))
    folds = [line for line in part.lines if line.layer == "FOLD"]
    tabs = [s.words for s in part.shapes if isinstance(s, Text) and s.words.startswith("under ")]
    names = {s.words for s in part.shapes if isinstance(s, Text)}
    assert {face.id for face in target.faces} <= names  # in the sketch beside it
    assert len(tabs) == 4  # of eight edges that two plates share four hold the net together
    assert len(folds) == 8  # and all eight are folded
    corners = np.concatenate(list(plates.values()))
    for line in folds:
        ends = [np.linalg.norm(corners - end, axis=1) < 1e-9 for end in line.lines[0]]
        assert all(end.any() for end in ends)
    lengths = sorted(float(np.linalg.norm(np.diff(line.lines[0], axis=0))) for line in folds)
    np.testing.assert_allclose(lengths, sorted([SIZE[0]] * 2 + [SIZE[2]] * 2 + [SIZE[1]] * 4), atol=1e-9)
    space = {f.id: f.rough_target_from_face @ np.pad(f.outline_mm, ((0, 0), (0, 1))) for f in target.faces}
    together = 0
    for one, other in combinations(plates, 2):
        flat = np.linalg.norm(plates[one][:, None] - plates[other], axis=2) < 1e-9
        real = np.linalg.norm(space[one][:, None] - space[other], axis=2) < 1e-9
        assert not (flat & ~real).any() or flat.sum() == 1  # two plates may touch at a corner of a third
        together += (flat & real).sum() == 2
    assert together == 4
    sheet = one_sheet([net_part(target)], "net")
    image = pages_of(pdf([sheet]))[0]
    found = detect_image(image, camera_of(image), target, None, EllipseOptions())
    assert sorted(each.face for each in found.faces) == sorted(face.id for face in target.faces)
    assert all(len(each.circles) == 9 for each in found.faces)


@pytest.mark.parametrize(("width_mm", "paper"), [(30.0, "A4"), (90.0, "A2")])
def test_a_dodecahedron_is_one_net(width_mm, paper):
    body = tag_body("dodecahedron", width_mm, "DICT_APRILTAG_36h11", 0)
    assert net_text(body).endswith(f"one sheet of {paper}")


def test_plates_that_run_the_same_way_do_not_share_an_edge_and_what_lacks_an_outline_is_refused(target, tmp_path):
    """Two pages of a book: one would cover the other."""
    outline = [[-50, -50], [150, -50], [150, 150], [-50, 150]]
    pages = []
    for number in range(2):
        angle = np.radians(30 * number)
        turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
        pose = Rigid(turn, turn @ [50.0, 0, 0])
        pages.append(replace(reference_target().faces[number], outline_mm=outline, rough_target_from_face=pose))
    refuses("E-DRAW-NET", net_part, TargetDesign("book", "dark", tuple(pages)))
    (tmp_path / "reference.toml").write_text(target_toml(reference_target()))
    refuses("E-DRAW-NET … --net … 1 … outline_mm", draw, tmp_path / "reference.toml", tmp_path / "net.pdf", net=True)
    nowhere = tuple(replace(face, rough_target_from_face=None) for face in target.faces)
    refuses("E-DRAW-NET … --net … front … rough_pose", net_part, TargetDesign("box", "dark", nowhere))
    (tmp_path / "board.toml").write_text('type = "chessboard"\nrows = 4\ncolumns = 5\nsquare_mm = 10\n')
    refuses("E-DRAW-DESIGN", draw, tmp_path / "board.toml", tmp_path / "net.pdf", net=True)
