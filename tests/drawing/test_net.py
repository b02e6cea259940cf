"""Nets: plates at their edges, nothing covered, every circle where it was on its face; read back by detection."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from stcal.boards.target_file import target_toml
from stcal.design import TargetDesign, reference_target
from stcal.drawing.draw import draw, net_text, one_sheet
from stcal.drawing.parts import Disc, Text, _is_clear, net_part
from stcal.geometry.rigid import Rigid
from stcal.sfm.detect.candidates import EllipseOptions
from stcal.sfm.detect.image import detect_image
from stcal.sfm.make import make_pattern, sides_of
from stcal.synthetic.designs import tag_body
from tests.drawing.raster import camera_of, page_image
from tests.outcome import fails_with, refuses

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
    part = net_part(target)
    assert set(circles_of(part)) == set(target.radius_of())
    plates = places_of(target, part)
    assert all(_is_clear(a, [b]) for a, b in combinations(plates.values(), 2))
    folds = [line for line in part.lines if line.layer == "FOLD"]
    tabs = [s.words for s in part.shapes if isinstance(s, Text) and s.words.startswith("under ")]
    assert len(tabs) == 4  # of eight edges that two plates share four hold the net together
    assert len(folds) == 8  # and all eight are folded
    corners = np.concatenate(list(plates.values()))
    for line in folds:
        ends = [np.linalg.norm(corners - end, axis=1) < 1e-9 for end in line.lines[0]]
        assert all(end.any() for end in ends)
    lengths = sorted(float(np.linalg.norm(np.diff(line.lines[0], axis=0))) for line in folds)
    np.testing.assert_allclose(lengths, sorted([SIZE[0]] * 2 + [SIZE[2]] * 2 + [SIZE[1]] * 4), atol=1e-9)


@pytest.mark.slow
def test_a_net_is_on_one_sheet(target, tmp_path):
    """400 × 200 mm and more."""
    drawn = draw(target, tmp_path / "net.pdf", net=True)
    assert (drawn.paper, len(drawn.sheets)) == ("A2", 1)
    with fails_with("E-DRAW-SHEETS … --net … A3 … --paper A2"):
        draw(target, tmp_path / "a3.pdf", paper="A3", net=True)
    assert "larger than A0" in net_text(tag_body("cube", 500.0, "DICT_APRILTAG_36h11", 0))


@pytest.mark.parametrize(("width_mm", "paper"), [(30.0, "A4"), (90.0, "A2")])
def test_a_dodecahedron_is_one_net(width_mm, paper):
    body = tag_body("dodecahedron", width_mm, "DICT_APRILTAG_36h11", 0)
    assert net_text(body).endswith(f"one sheet of {paper}")


def test_plates_meet_in_the_net_as_they_do_in_space(target):
    """Folded circles' distances across an edge: at a fold both plates have the same corners."""
    part = net_part(target)
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
    sheet = one_sheet([net_part(target)], "net")
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
        net_part(TargetDesign("book", "dark", tuple(pages)))


def test_what_lacks_an_outline_or_a_place_is_refused(target, tmp_path):
    (tmp_path / "reference.toml").write_text(target_toml(reference_target()))
    refuses("E-DRAW-NET … --net … 1 … outline_mm", draw, tmp_path / "reference.toml", tmp_path / "net.pdf", net=True)
    nowhere = tuple(replace(face, rough_target_from_face=None) for face in target.faces)
    refuses("E-DRAW-NET … --net … front … rough_pose", net_part, TargetDesign("box", "dark", nowhere))
    (tmp_path / "board.toml").write_text('type = "chessboard"\nrows = 4\ncolumns = 5\nsquare_mm = 10\n')
    refuses("E-DRAW-DESIGN", draw, tmp_path / "board.toml", tmp_path / "net.pdf", net=True)
