"""Boards of every kind in a folder of images."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stcal.boards.board_designs import (
    AprilGridDesign,
    AsymmetricCirclesDesign,
    CharucoDesign,
    ChessboardDesign,
    TagLayout,
)
from stcal.design import BoardDesign
from stcal.geometry.rigid import Rigid
from stcal.io.cameras.camera_model import CameraModel
from stcal.io.images import find_images
from stcal.workflows.board_views import detect_boards, images_of_centres, symmetries
from tests.boards.drawn import aprilgrid_mm, photograph_of_several
from tests.handeye.photographed import (
    CAMERA,
    MARGIN_MM,
    PER_MM,
    image_from_sheet,
    looks,
    photographs,
    sheet_of_dots,
    take,
)
from tests.handeye.test_cli import CHANCE, EXACT, in_sigmas
from tests.outcome import fails_with, refuses
from tests.support.areas import circle_conic, ellipse_of_conic
from tests.support.handeye import FLANGE_FROM_CAMERA

MODEL = CameraModel(CAMERA.focal, CAMERA.centre, CAMERA.distortion, "PINHOLE", None, None, "cameras.txt")
SLANTED = Rigid(Rotation.from_rotvec([0.5, -0.3, 0.2]).as_matrix(), [-60, -50, 420])
FAMILY = "DICT_APRILTAG_36h11"
GRID = AprilGridDesign(3, 4, 25.0, 0.3)
CORNER_PX = 0.12
"""As in the tests of the detectors: what drawing in steps of 1/32 px, blur and noise leave."""


def dots(rows=6, columns=8, corner=None) -> BoardDesign:
    return BoardDesign(rows, columns, 20.0, 6.0, "dark", 0.0, corner, 9.0 if corner else None)


def charuco() -> tuple[CharucoDesign, np.ndarray, float]:
    design = CharucoDesign(6, 8, 20.0, 10.0, "DICT_5X5_50")
    plain = cv2.aruco.CharucoBoard((8, 6), 20.0, 10.0, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_50))
    sheet = plain.generateImage((160 * PER_MM, 120 * PER_MM))
    edge = int(MARGIN_MM * PER_MM)
    return design, cv2.copyMakeBorder(sheet, *[edge] * 4, cv2.BORDER_CONSTANT, value=255), MARGIN_MM


def tags() -> tuple[TagLayout, np.ndarray, float]:
    sheet, places = np.full((150 * PER_MM, 190 * PER_MM), 255, np.uint8), []
    square = np.array([[0, 0], [40, 0], [40, 40], [0, 40]], float)
    for tag, (x, y) in enumerate([(20, 20), (120, 30), (40, 90)]):
        side = 40 * PER_MM
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, FAMILY))
        sheet[y * PER_MM :, x * PER_MM :][:side, :side] = cv2.aruco.generateImageMarker(dictionary, tag, side)
        places.append(square + np.array([x, y]))
    return TagLayout(tuple((FAMILY, tag) for tag in range(3)), np.array(places)), sheet, 0.0


def of_corner() -> tuple[BoardDesign, np.ndarray, float]:
    board = dots(corner=(0, 0))
    return board, *sheet_of_dots(board.xy_mm(), board.radii_mm())


@pytest.mark.parametrize("drawn", [of_corner, charuco, tags])
def test_a_board_is_found_where_it_was_drawn(drawn, tmp_path):
    """Other kinds: in the tests of their detectors."""
    board, sheet, first = drawn()
    cv2.imwrite(str(tmp_path / "a.png"), take(sheet, first, SLANTED))
    cv2.imwrite(str(tmp_path / "blank.png"), np.full((600, 800), 200, np.uint8))
    cv2.imwrite(str(tmp_path / "small.png"), np.full((90, 120), 200, np.uint8))
    (tmp_path / "torn.png").write_bytes((tmp_path / "a.png").read_bytes()[:5000])
    files, _ = find_images(tmp_path)
    found = detect_boards(files, MODEL, board, (FAMILY,), workers=1)
    assert (found.camera.width, found.camera.height) == (800, 600)
    view = found.views()["a.png"]
    assert len(view) == len(board.xy_mm())
    assert 1e-4 < np.abs(CAMERA.project(SLANTED @ view.xyz_board) - view.xy_px).max() < CORNER_PX
    assert {each.name: each.gate for each in found.skipped} == {
        "blank.png": "board",
        "small.png": "image_size",
        "torn.png": "readable",
    }
    assert [len(each.tags) for each in found.images if each.name == "a.png"] == [3 if drawn is tags else 0]
    assert found.symmetries == ()


def test_images_of_centres_are_exact_and_those_of_another_camera_and_unreadable_ones_are_said(tmp_path):
    """Against the conics of circles seen aslant from near: their centres are off by a tenth of a pixel."""
    board = dots(corner=(0, 0))
    xyz = np.column_stack([board.xy_mm(), np.zeros(len(board.xy_mm()))])
    normal = SLANTED.rotation[:, 2]
    conics = [
        circle_conic(centre, normal, radius) for centre, radius in zip(SLANTED @ xyz, board.radii_mm(), strict=True)
    ]
    seen = CAMERA.pixel_from_normalised(np.array([ellipse_of_conic(conic)[0] for conic in conics]))
    true = CAMERA.project(SLANTED @ xyz)
    assert np.linalg.norm(seen - true, axis=1).max() > 0.1
    found = images_of_centres(seen, xyz, board.radii_mm(), CAMERA)
    assert np.linalg.norm(found - true, axis=1).max() < 1e-5
    cv2.imwrite(str(tmp_path / "a.png"), np.full((300, 400), 200, np.uint8))
    refuses("E-CAMERA-CENTRE … 406 … 293 … a.png", detect_boards, find_images(tmp_path)[0], MODEL, dots(), workers=1)
    (tmp_path / "a.png").write_bytes(b"")
    with fails_with("E-IMAGES-NONE-USABLE … 1 … a.png … empty"):
        detect_boards(find_images(tmp_path)[0], MODEL, dots(), workers=1)


@pytest.mark.parametrize(
    ("board", "count"), [(dots(), 1), (dots(6, 6), 3), (dots(6, 6, (0, 0)), 0), (ChessboardDesign(5, 7, 1.0), 1)]
)
def test_symmetries_bring_the_board_onto_itself(board, count):
    xyz = np.column_stack([board.xy_mm(), np.zeros(len(board.xy_mm()))])
    every = symmetries(board)
    assert len(every) == count
    for turn in every:
        apart = np.linalg.norm((turn @ xyz)[:, None] - xyz, axis=2)
        assert apart.min(1).max() < 1e-9
        assert apart.argmin(1).tolist() != list(range(len(xyz)))


CIRCLES = AsymmetricCirclesDesign(8, 4, 18.0, 6.0, "dark")


@pytest.mark.parametrize(("board", "stated"), [(dots(), dots()), (CIRCLES, replace(CIRCLES, radius_mm=None))])
def test_a_board_that_looks_the_same_after_half_a_turn_is_numbered_up_to_it(tmp_path, board, stated):
    """The radius may be unknown, as of Kalibr's circle grids: the images tell it, and the eccentricity of steep views
    is corrected by it."""
    sheet, first = sheet_of_dots(board.xy_mm(), board.radii_mm())
    cv2.imwrite(str(tmp_path / "a.png"), take(sheet, first, SLANTED))
    found = detect_boards(find_images(tmp_path)[0], MODEL, stated, workers=1)
    assert len(found.symmetries) == 1
    view = found.views()["a.png"]
    errors = [
        np.linalg.norm(CAMERA.project(SLANTED @ (turn @ view.xyz_board)) - view.xy_px, axis=1).max()
        for turn in (Rigid(), *found.symmetries)
    ]
    assert min(errors) < CORNER_PX < 20 < max(errors)


COMMON_FROM_GRID = Rigid(Rotation.from_euler("y", 30, degrees=True).as_matrix(), [-165, 105, 30])


def photograph_of_both(pose: Rigid) -> np.ndarray:
    (_, sheet, first), (grid, origin) = charuco(), aprilgrid_mm(GRID, 2)
    drawn = [(grid, image_from_sheet(origin, pose @ COMMON_FROM_GRID)), (sheet, image_from_sheet(first, pose))]
    return photograph_of_several(drawn, PER_MM, (CAMERA.width, CAMERA.height))


SET = """type = "boards"
[[board]]
type = "charuco"
rows = 6
columns = 8
square_mm = 20.0
marker_mm = 10.0
dictionary = "5X5_50"
[[board]]
type = "aprilgrid"
rows = 3
columns = 4
tag_mm = 25.0
spacing = 0.3
x_mm = -165.0
y_mm = 105.0
z_mm = 30.0
rpy_deg = [0.0, 30.0, 0.0]
"""


@pytest.mark.slow
def test_several_boards_are_solved_as_one(command, tmp_path):
    """Eye-in-hand, without errors of the robot: within chance of its σ, and within 0.2 mm; `--dry-run` says what the
    board is."""
    seen = looks(np.random.default_rng(21), 5, np.array([10, 60]), 1.0)
    _, sheet, first = charuco()
    files, out = photographs(tmp_path, sheet, first, seen, SET), tmp_path / "h.json"
    for i, pose in enumerate(seen):
        cv2.imwrite(str(files.images / f"{i}.png"), photograph_of_both(pose))
    code, shown, _ = command(*files.arguments(), "--dry-run")
    assert code == 0
    assert "2 boards" in shown
    options = ("--workers", 1, "--splits", 0, "--method", "reprojection", "--out", out)
    code, shown, err = command(*files.arguments(), *options, *EXACT)
    assert code == 0, err
    data = json.loads(out.read_text())
    assert data["left_out"] == []
    assert in_sigmas(data, "flange_from_camera", FLANGE_FROM_CAMERA) < CHANCE
    off = Rigid.from_matrix(data["flange_from_camera"]).translation - FLANGE_FROM_CAMERA.translation
    assert np.linalg.norm(off) < 0.2
