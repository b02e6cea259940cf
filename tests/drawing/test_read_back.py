"""Drawings rendered as images are read by the detectors that read photographs, from the front and obliquely."""

import numpy as np
import pytest

from stcal.boards.board_designs import (
    AprilGridDesign,
    AsymmetricCirclesDesign,
    CharucoDesign,
    ChessboardDesign,
    TagLayout,
)
from stcal.boards.finders import find_charuco, find_chessboard
from stcal.boards.tags import find_aprilgrid, find_tags
from stcal.boards.target_file import target_toml
from stcal.design import BoardDesign, TargetDesign, reference_target
from stcal.drawing.draw import draw, one_sheet
from stcal.drawing.parts import Disc, Outline, parts_of
from stcal.geometry.plane import apply_homography
from stcal.sfm.detect.candidates import EllipseOptions
from stcal.sfm.detect.image import detect_image
from stcal.sfm.detect.labelling import label_single
from stcal.synthetic.designs import second_design
from tests.drawing.raster import camera_of, obliquely, page_image, pages_of, pixel_from_page, shapes_of
from tests.support.circle_images import area_and_centroid

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
    """The image, where ``places`` of the page are in it, and the camera; from the front and obliquely."""
    yield image, places, camera_of(image)
    seen, homography, camera = obliquely(image)
    yield seen, {name: apply_homography(homography, xy) for name, xy in places.items()}, camera


@pytest.mark.slow
@pytest.mark.parametrize("target", [reference_target(), second_design()[0]], ids=["bright", "dark"])
def test_faces_are_read_back(target: TargetDesign, tmp_path):
    """Every page of the PDF, drawn by another program: all circles of its face named, at their places."""
    (tmp_path / "target.toml").write_text(target_toml(target))
    drawn = draw(tmp_path / "target.toml", tmp_path / "target.pdf")
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
    page = page_image(sheet)
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


TAGS = TagLayout((("DICT_5X5_50", 3), ("DICT_5X5_50", 7)), [[[0, 0], [20, 0], [20, 20], [0, 20]],
                 [[40, 5], [60, 0], [65, 20], [45, 25]]])  # fmt: skip
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
    page = page_image(sheet)
    for image, places, camera in seen_ways(page, {"": points_px(sheet, part, board, page)}):
        xy = places[""]
        if isinstance(board, ChessboardDesign):
            view = find_chessboard(image, "page", board)
        elif isinstance(board, CharucoDesign):
            view = find_charuco(image, "page", board)
        elif isinstance(board, AprilGridDesign):
            view, _ = find_aprilgrid(image, "page", board, camera)
        else:
            tags = find_tags(image, ["DICT_5X5_50"])
            assert tags.tags == board.tags
            assert np.linalg.norm(tags.corners_px.reshape(-1, 2) - xy, axis=1).max() < CORNER_PX
            continue
        assert view is not None
        assert len(view) == len(xy)
        assert np.linalg.norm(view.xy_px - xy[view.ids], axis=1).max() < CORNER_PX


def test_asymmetric_circles_lie_where_the_design_has_them():
    board = AsymmetricCirclesDesign(5, 4, 10.0, 3.0, "dark")
    (part,) = parts_of(board, 10.0)
    places = np.array([[s.x, -s.y] for s in part.pattern() if isinstance(s, Disc)])
    np.testing.assert_allclose(places, board.xy_mm())


def test_rings_have_their_holes():
    board = AsymmetricCirclesDesign(5, 4, 10.0, 3.0, "dark", rings=((0, 1), (3, 2)))
    (part,) = parts_of(board, 10.0)
    holes = [s for s in part.pattern() if isinstance(s, Disc) and s.ink == "white"]
    np.testing.assert_allclose([[s.x, -s.y] for s in holes], board.xy_mm()[[1, 14]])
    assert [s.radius for s in holes] == [1.5, 1.5]


def test_plates_have_their_margin():
    for part, face in zip(parts_of(reference_target(), 7.0), reference_target().faces, strict=True):
        rims = face.xy_mm + np.array([[-1.0], [1.0]])[:, :, None] * face.radius_mm[:, None]
        np.testing.assert_allclose(part.outline.min(0), rims.min((0, 1)) - 7.0)
        np.testing.assert_allclose(part.outline.max(0), rims.max((0, 1)) + 7.0)
