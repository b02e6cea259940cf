"""Nets: plates at their edges, nothing covered, every circle where it was on its face; read back by detection."""

import re
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from stcal.design import TargetDesign, reference_target
from stcal.drawing.draw import OWN, Drawn, draw, drawn_text, net_for, sheets_of
from stcal.drawing.net import _overlap, net_parts
from stcal.drawing.parts import Disc, Text
from stcal.drawing.sheets import OVERLAP, framed, paper_sheets
from stcal.geometry.rigid import Rigid
from stcal.io.design import target_toml
from stcal.sfm.detect.circles.candidates import EllipseOptions
from stcal.sfm.detect.image import detect_image
from stcal.sfm.make.pattern import make_pattern, sides_of
from stcal.synthetic.designs import tag_body
from tests.drawing.raster import camera_of, page_image
from tests.outcome import fails_with

SIZE = (120.0, 100.0, 80.0)


@pytest.fixture(scope="module")
def target():
    return make_pattern(sides_of(SIZE), 9, 4.0, "bright", 3, "box").target


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


def test_a_box_is_one_net(target):
    (part,) = net_parts(target)
    assert set(circles_of(part)) == set(target.radius_of())
    plates = places_of(target, part)
    assert not any(_overlap(a, b) for a, b in combinations(plates.values(), 2))
    folds = [line for line in part.lines if line.layer == "FOLD"]
    tabs = [s.words for s in part.shapes if isinstance(s, Text) and s.words.startswith("under ")]
    assert len(tabs) == 4  # of eight edges that two plates share four hold the net together
    assert len(folds) == 8  # and all eight are folded
    corners = np.concatenate(list(plates.values()))
    for line in folds:
        ends = [np.linalg.norm(corners - end, axis=1) < 1e-9 for end in line.points]
        assert all(end.any() for end in ends)
    lengths = sorted(float(np.linalg.norm(np.diff(line.points, axis=0))) for line in folds)
    np.testing.assert_allclose(lengths, sorted([SIZE[0]] * 2 + [SIZE[2]] * 2 + [SIZE[1]] * 4), atol=1e-9)


def test_the_sketch_has_the_numbers_of_all_circles(target):
    """Where they are on the face, at a fifth; the letters do not overlap."""
    (part,) = net_parts(target)
    words = [s for s in part.shapes if isinstance(s, Text) and not s.words.startswith("under ")]
    numbers = [s for s in words if s.height < 2]
    ids = [circle for face in target.faces for circle in face.ids]
    assert sorted(s.words for s in numbers) == sorted(ids)
    assert sorted(s.words for s in words if s not in numbers) == sorted(face.id for face in target.faces)
    circles = circles_of(part)
    xy = np.array([circles[label] for face in target.faces for label in face.labels()])
    places = np.array([[s.x, s.y + s.height / 2] for s in numbers])
    for place, circle in zip(places.mean(0) + (xy - xy.mean(0)) / 5, ids, strict=True):
        same = places[[s.words == circle for s in numbers]]
        assert np.linalg.norm(same - place, axis=1).min() < 1e-6
    boxes = [s.box() for s in words]
    assert not any((a[0] < b[1]).all() and (b[0] < a[1]).all() for a, b in combinations(boxes, 2))


def test_words_of_tabs_stand_on_them(target):
    three = replace(target, faces=tuple(face for face in target.faces if face.id in ("front", "right", "top")))
    turned = set()
    for (part,) in (net_parts(target), net_parts(three)):
        tabs = [line.points for line in part.lines if line.layer == "CUT" and len(line.points) == 4]
        for word in (s for s in part.shapes if isinstance(s, Text) and s.words.startswith("under ")):
            turned.add(word.turned)
            across = word.height / 2
            middle = np.array([word.x - across, word.y] if word.turned else [word.x, word.y + across])
            (tab,) = (tab for tab in tabs if np.linalg.norm(tab.mean(0) - middle) < 0.1)
            along = np.abs(tab[3] - tab[0])
            assert (along[1] > along[0]) == word.turned
    assert turned == {True, False}


@pytest.mark.slow
def test_the_paper_for_a_whole_net_is_named(target, tmp_path):
    (tmp_path / "target.toml").write_text(target_toml(target))
    text = drawn_text(draw(tmp_path / "target.toml", tmp_path / "net.pdf", net=True))
    assert "state it in sigma_mm, or print with --paper A2, or one by one" in text  # 400 × 200 mm and more
    whole = draw(tmp_path / "target.toml", tmp_path / "a2.pdf", paper="A2", net=True)
    assert len(whole.sheets) == 1
    assert len(draw(tmp_path / "target.toml", tmp_path / "a3.pdf", paper="A3", net=True).sheets) > 1


def test_plates_meet_in_the_net_as_they_do_in_space(target):
    """Folded circles' distances across an edge: at a fold both plates have the same corners."""
    (part,) = net_parts(target)
    plates = places_of(target, part)
    space = {f.id: f.rough_target_from_face @ np.pad(f.outline_mm, ((0, 0), (0, 1))) for f in target.faces}
    together = 0
    for one, other in combinations(plates, 2):
        flat = np.linalg.norm(plates[one][:, None] - plates[other], axis=2) < 1e-9
        real = np.linalg.norm(space[one][:, None] - space[other], axis=2) < 1e-9
        assert not (flat & ~real).any() or flat.sum() == 1  # two plates may touch at a corner of a third
        together += (flat & real).sum() == 2
    assert together == 4


def test_all_faces_are_read_from_the_net(target):
    (sheet,) = sheets_of(net_parts(target), OWN, "net", apart=True)
    image = page_image(sheet)
    found = detect_image(image, camera_of(image), target, None, EllipseOptions())
    assert sorted(each.face for each in found.faces) == sorted(face.id for face in target.faces)
    assert all(len(each.circles) == 9 for each in found.faces)


def test_plates_that_run_the_same_way_along_an_edge_do_not_share_it():
    """Two pages of a book: one would cover the other."""
    outline = [[-50, -50], [150, -50], [150, 150], [-50, 150]]
    pages = []
    for number in range(2):
        angle = np.radians(30 * number)
        turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
        pose = Rigid(turn, turn @ [50.0, 0, 0])
        pages.append(replace(reference_target().faces[number], outline_mm=outline, rough_target_from_face=pose))
    with fails_with("E-DRAW-NET"):
        net_parts(TargetDesign("book", "dark", tuple(pages)))


def test_plates_that_touch_do_not_overlap():
    square = np.array([[0.0, 0], [10, 0], [10, 10], [0, 10]])
    assert not _overlap(square, square + np.array([10, 0]))
    assert not _overlap(square, square + np.array([10, 10]))
    assert _overlap(square, square + np.array([9.9, 3]))
    assert _overlap(square, 0.1 * square + 4)


def test_what_lacks_an_outline_or_a_place_is_refused(target, tmp_path):
    (tmp_path / "reference.toml").write_text(target_toml(reference_target()))
    with fails_with("E-DRAW-NET … --net … 1 … outline_mm"):
        draw(tmp_path / "reference.toml", tmp_path / "net.pdf", net=True)
    nowhere = tuple(replace(face, rough_target_from_face=None) for face in target.faces)
    with fails_with("E-DRAW-NET … --net … front … rough_pose"):
        net_parts(TargetDesign("box", "dark", nowhere))
    (tmp_path / "board.toml").write_text('type = "chessboard"\nrows = 4\ncolumns = 5\nsquare_mm = 10\n')
    with fails_with("E-DRAW-DESIGN"):
        draw(tmp_path / "board.toml", tmp_path / "net.pdf", net=True)


def test_a_net_of_two_plates_apart_has_two_pieces():
    """A pair of sides that share an edge, and another pair elsewhere."""
    four = make_pattern(sides_of(SIZE)[:4], 9, 4.0, "dark", 3, "box").target
    away = Rigid(np.eye(3), np.array([500.0, 0, 0]))
    moved = []
    for number, face in enumerate(four.faces):
        assert face.rough_target_from_face is not None
        pose = away @ face.rough_target_from_face if number > 1 else face.rough_target_from_face
        moved.append(replace(face, rough_target_from_face=pose))
    parts = net_parts(TargetDesign("two", "dark", tuple(moved)))
    assert [part.name for part in parts] == ["net 1 of 2", "net 2 of 2"]
    assert [len(circles_of(part)) for part in parts] == [18, 18]


@pytest.mark.parametrize(
    ("body", "width_mm", "pieces"),
    [("cube", 93.0, 1), ("cube", 200.0, 1), ("dodecahedron", 90.0, 1), ("dodecahedron", 160.0, 10)],
)
def test_no_seam_runs_through_a_tag_of_a_net(body, width_mm, pieces):
    """Each tag is whole on a sheet that is cut along its seams. Of the large dodecahedron, only small nets can be."""
    target = tag_body(body, width_mm, "DICT_APRILTAG_36h11", 0)
    parts = net_for(target, "A4")
    assert len(parts) == pieces
    for part in parts:
        whole, sheets = 0, paper_sheets([part], "A4", "net")
        for sheet in sheets:
            low, high = cut_along_seams(sheet, sheets)
            boxes = [shape.box() for shape in sheet.shapes() if shape.layer == "PATTERN"]
            whole += sum((box[0] > low).all() and (box[1] < high).all() for box in boxes)
        assert whole == len(part.pattern())
        assert not any(sheet.cuts for sheet in sheets)


def test_a_tag_that_fits_on_no_sheet_is_cut_and_this_is_said(tmp_path):
    target = tag_body("cube", 250.0, "DICT_APRILTAG_36h11", 0)
    parts = net_for(target, "A4")
    drawn = Drawn(tmp_path / "net.pdf", parts, paper_sheets(parts, "A4", "net"), "A4")
    assert len(parts) == 1
    assert "one runs through a pattern: state it in sigma_mm, or print with --paper" in drawn_text(drawn)


def cut_along_seams(sheet, sheets) -> tuple[np.ndarray, np.ndarray]:
    """What is left of a sheet, lower left and upper right corner; beyond all bounds where there is no other sheet."""
    places = [tuple(map(int, place)) for s in sheets for place in re.findall(r"row (\d), column (\d)", s.title)]
    if not places:
        return np.full(2, -np.inf), np.full(2, np.inf)
    clip, (row, column), (rows, columns) = sheet.placed[0].clip, places[sheets.index(sheet)], np.max(places, axis=0)
    low = np.where([column > 1, row < rows], clip[0] + OVERLAP / 2, -np.inf)
    return low, np.where([column < columns, row > 1], clip[1] - OVERLAP / 2, np.inf)


@pytest.mark.parametrize("edge_mm", [62.0, 75.0, 93.0])
def test_no_seam_runs_through_the_words_of_a_net(edge_mm):
    """Every word of a net on several sheets of A4 is on one of them alone when these are cut along the seams."""
    (part,) = net_parts(tag_body("cube", edge_mm, "DICT_APRILTAG_36h11", 0))
    sheets = paper_sheets([part], "A4", "net")
    every = [shape.words for shape in framed(part) if isinstance(shape, Text)]
    found = []
    for sheet in sheets:
        low, high = cut_along_seams(sheet, sheets)
        boxes = [(shape.words, shape.box()) for shape in sheet.placed[0].shapes if isinstance(shape, Text)]
        found += [words for words, box in boxes if (box[1] > low).all() and (box[0] < high).all()]
    assert len(sheets) > 1
    assert sorted(found) == sorted(every)
