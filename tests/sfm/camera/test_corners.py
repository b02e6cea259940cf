"""Cameras from photographs of a chessboard and of a ChArUco board: drawn, and measured."""

import json

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stcal.boards.board_designs import (
    AprilGridDesign,
    AsymmetricCirclesDesign,
    CharucoDesign,
    ChessboardDesign,
    HexagonalCirclesDesign,
    TagLayout,
)
from stcal.labels import DotLabel
from stcal.workflows.board_views import corner_grid
from tests.boards.drawn import aprilgrid_mm, photograph
from tests.outcome import fails_with

FOCAL, CENTRE = (1500.0, 1490.0), (610.0, 440.0)


@pytest.mark.slow
def test_photographs_of_a_drawn_board_give_the_camera_with_its_sigma(tmp_path, stcal_sfm):
    """Photographs of 1200×900 px, 4 px a millimetre, of an AprilGrid as Kalibr has it."""
    sheet, origin_mm = aprilgrid_mm(AprilGridDesign(3, 4, 20.0, 0.3), 2)
    middle_mm = (52.0, -36.0, 0.0)
    board = "target_type: 'aprilgrid'\ntagCols: 4\ntagRows: 3\ntagSize: 0.02\ntagSpacing: 0.3\n"
    images = tmp_path / "photographs"
    images.mkdir()
    (tmp_path / "april.yaml").write_text(board, encoding="utf-8")
    rng = np.random.default_rng(5)
    inner = np.array([[FOCAL[0], 0, CENTRE[0]], [0, FOCAL[1], CENTRE[1]], [0, 0, 1]])
    board_from_sheet = np.array([[1, 0, -origin_mm[0]], [0, 1, -origin_mm[1]], [0, 0, 1.0]])
    for i in range(8):
        turn = Rotation.from_euler("xyz", [*rng.uniform(-30, 30, 2), rng.uniform(-30, 30)], degrees=True).as_matrix()
        place = np.array([rng.uniform(-15, 15), rng.uniform(-12, 12), rng.uniform(230, 300)]) - turn @ middle_mm
        image_from_mm = inner @ np.column_stack([turn[:, :2], place])
        cv2.imwrite(str(images / f"{i}.png"), photograph(sheet, 4, image_from_mm @ board_from_sheet))
    files = "--board", tmp_path / "april.yaml", "--out", tmp_path / "cameras.txt"
    code, text, error = stcal_sfm("calibrate-camera", images, *files, "--model", "PINHOLE")
    assert code == 0, error
    assert "8 views of the board" in text
    assert "photographs differ" in text
    found = json.loads((tmp_path / "cameras.json").read_text())["parameters"]
    for name, true in zip(("fx", "fy", "cx", "cy"), (*FOCAL, *CENTRE), strict=True):
        assert 0 < found[name]["sigma"] < 5
        assert abs(found[name]["value"] - true) < 4 * found[name]["sigma"] + 0.5  # half a pixel of drawing


def test_points_keep_their_places_and_corners_are_dots_without_extent():
    """The label of each point of a view stands where the board has the point."""
    for board in (
        AprilGridDesign(3, 4, 20.0, 0.3),
        AsymmetricCirclesDesign(5, 3, 8.0, 2.0, "dark"),
        AsymmetricCirclesDesign(4, 3, 8.0, None, "dark"),
        HexagonalCirclesDesign(5, 4, 8.0, 2.0, "dark"),
        ChessboardDesign(4, 6, 25.0),
        CharucoDesign(5, 7, 30.0, 20.0, "DICT_4X4_50"),
    ):
        grid = corner_grid(board)
        labels = [DotLabel(*cell) for cell in grid.cells().tolist()]
        places = grid.places_mm(labels)[:, :2]
        np.testing.assert_allclose(places - places[0], board.xy_mm() - board.xy_mm()[0], atol=1e-5)
        assert len(set(labels)) == len(board.xy_mm())
    grid = corner_grid(ChessboardDesign(4, 6, 25.0, 0.02))
    assert (grid.rows, grid.columns, grid.pitch_mm, grid.sigma_mm) == (4, 6, 25.0, 0.02)
    with fails_with("E-BOARD-TYPE … tags"):
        corner_grid(TagLayout((("DICT_4X4_50", 1),), np.zeros((1, 4, 2))))


@pytest.mark.slow
def test_a_measured_charuco_board(shared_data, tmp_path, stcal_sfm):
    """Mako camera, whose makers of the set state fx 1352, fy 1356 px: another calibration, to some per cent."""
    images = shared_data("charuco_handeye/test_set_charuco/images")
    (tmp_path / "board.toml").write_text(
        'type = "charuco"\nrows = 7\ncolumns = 5\nsquare_mm = 36.195\nmarker_mm = 18.256\ndictionary = "DICT_6X6_250"\n'
    )
    code, text, error = stcal_sfm(
        "calibrate-camera", images, "--board", tmp_path / "board.toml", "--out", tmp_path / "cameras.txt"
    )
    assert code == 0, error
    found = json.loads((tmp_path / "cameras.json").read_text())["parameters"]
    assert found["fx"]["value"] == pytest.approx(1352, rel=0.02)
    assert found["fy"]["value"] == pytest.approx(1356, rel=0.02)
    assert "16 views of the board, 384 dots" in text
