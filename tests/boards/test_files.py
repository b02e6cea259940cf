"""Board files of the newer kinds, Kalibr's, and of several boards in one frame."""

import numpy as np
import pytest

from stcal.boards.board_designs import (
    AprilGridDesign,
    AsymmetricCirclesDesign,
    BoardSet,
    CharucoDesign,
    ChessboardDesign,
    HexagonalCirclesDesign,
)
from stcal.boards.board_file import board_toml, load_board, load_flat_board
from stcal.boards.target_file import load_boards
from stcal.design import DOTS_SIGMA_MM, BoardDesign, reference_board
from stcal.errors import InputError
from tests.shared import written

APRILGRID = 'type = "aprilgrid"\nrows = 6\ncolumns = 7\ntag_mm = 80.0\nspacing = 0.3\n'
ASYMMETRIC = (
    'type = "asymmetric-circles"\nrows = 11\ncolumns = 4\nspacing_mm = 20.0\nradius_mm = 6.0\npolarity = "dark"\n'
)
HEXAGONAL = ASYMMETRIC.replace("asymmetric", "hexagonal").replace("rows = 11", "rows = 9")
DOTS = 'rows = 5\ncolumns = 7\npitch_mm = 20.0\nradius_mm = 5.0\npolarity = "dark"\n'
CIRCLES, RINGS = AsymmetricCirclesDesign(11, 4, 20.0, 6.0, "dark"), ((0, 3), (1, 2))
WITH_CORNER = [BoardDesign(3, 4, 12.5, 3.0, "dark", 0.02, place, 4.5) for place in ((0, 3), (2, 0))]
KALIBR = {
    "aprilgrid": "target_type: 'aprilgrid'\ntagCols: 6\ntagRows: 5\ntagSize: 0.08\ntagSpacing: 0.3\n",
    "checkerboard": "target_type: 'checkerboard'\ntargetCols: 7\ntargetRows: 6\n"
    "rowSpacingMeters: 0.05\ncolSpacingMeters: 0.05\n",
    "circlegrid": "target_type: 'circlegrid'\ntargetCols: 4\ntargetRows: 11\n"
    "spacingMeters: 0.02\nasymmetricGrid: True\n",
}
CHARUCO = 'type = "charuco"\nrows = 6\ncolumns = 8\nsquare_mm = 20.0\nmarker_mm = 10.0\ndictionary = "5X5_50"\n'
TAG = 'type = "tags"\n[[tag]]\ndictionary = "4X4_50"\nid = 1\nsize_mm = 9\nx_mm = 0\ny_mm = 0\n'
CORNERS = 'type = "tags"\n[[tag]]\ndictionary = "4X4_50"\nid = 1\ncorners_mm = [{}]\n'
IN_A_SET = CHARUCO.replace("type", "[[board]]\ntype")
BESIDE = "x_mm = 200.0\ny_mm = 0.0\nz_mm = 50.0\nrpy_deg = [0.0, 90.0, 0.0]\n"


@pytest.mark.parametrize(
    ("text", "board"),
    [
        ('type = "chessboard"\nrows = 5\ncolumns = 8\nsquare_mm = 20.0\n', ChessboardDesign(5, 8, 20.0)),
        (CHARUCO, CharucoDesign(6, 8, 20.0, 10.0, "DICT_5X5_50")),
        (APRILGRID, AprilGridDesign(6, 7, 80.0, 0.3)),
        (ASYMMETRIC, CIRCLES),
        (ASYMMETRIC.replace("radius_mm = 6.0", "diameter_mm = 12.0"), CIRCLES),
        (HEXAGONAL, HexagonalCirclesDesign(9, 4, 20.0, 6.0, "dark")),
        (HEXAGONAL + "rings = [[1, 2], [0, 3]]\n", HexagonalCirclesDesign(9, 4, 20.0, 6.0, "dark", rings=RINGS)),
        (DOTS + "rings = [[0, 3]]\n", BoardDesign(5, 7, 20.0, 5.0, "dark", DOTS_SIGMA_MM, rings=((0, 3),))),
        *((board_toml(board), board) for board in (reference_board(), *WITH_CORNER)),
        (KALIBR["aprilgrid"], AprilGridDesign(5, 6, 80.0, 0.3)),
        (KALIBR["checkerboard"], ChessboardDesign(6, 7, 50.0)),
        (KALIBR["circlegrid"], AsymmetricCirclesDesign(11, 4, 20.0, None, "dark")),
    ],
)
def test_files_of_every_kind_and_back(tmp_path, text, board):
    path = written(tmp_path / "board.toml", text)
    assert load_flat_board(path) == load_boards(path) == board
    if getattr(board, "radius_mm", 0.0) is not None:
        assert load_flat_board(written(tmp_path / "board.toml", board_toml(load_board(path)))) == board


def refused(load, path, said: str) -> None:
    with pytest.raises(InputError, match="board file") as caught:
        load(path)
    assert said in str(caught.value)


def test_opencvs_asymmetric_grid():
    """Its documented layout: x = (2 j + i mod 2) · spacing, y = i · spacing."""
    xy = CIRCLES.xy_mm()
    assert np.allclose(xy[[0, 1, 4, 5, 8, 43]], [[0, 0], [40, 0], [20, 20], [60, 20], [0, 40], [120, 200]])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('type = "checker"\n', "type 'checker'; one of circles, chessboard"),
        ('type = "chessboard"\nrows = 5\ncolumns = 8\n', "square_mm: key missing"),
        (CHARUCO.replace("10.0", "40.0"), "swapped"),
        (CHARUCO.replace("5X5_50", "5x5_20"), "DICT_5X5_250"),
        (TAG.replace("x_mm = 0\ny_mm = 0\n", ""), "tag 1: no place"),
        (TAG.replace("y_mm = 0\n", ""), "tag 1: x_mm, y_mm and size_mm"),
        (APRILGRID.replace("rows = 6", "rows = 100"), "tags 0 … 699, DICT_APRILTAG_36h11 has 0 … 586; correct rows"),
        (APRILGRID + "border_bits = 3\n", "border_bits"),
        (ASYMMETRIC.replace("radius_mm = 6.0", ""), "radius_mm or diameter_mm needed, one of them"),
        (ASYMMETRIC.replace("6.0", "15.0"), "radius 15 mm, under 14.1421 mm needed for circles apart"),
        (HEXAGONAL.replace("6.0", "10.5"), "radius 10.5 mm, under 10 mm needed for circles apart; spacing_mm is what"),
        (DOTS + "rings = [[5, 0]]\n", "rings has [5, 0] of 5 rows of 7 dots"),
        (DOTS + "rings = [[0, 0], [4, 6]]\n", "2 rings that look the same after a turn"),
        (KALIBR["aprilgrid"].replace("0.08", "800"), "tagSize"),
        (KALIBR["aprilgrid"].replace("tagRows: 5", "tagRows: 500"), "tags up to 2999, tag36h11 has 0 … 586"),
        (KALIBR["checkerboard"].replace("colSpacingMeters: 0.05", "colSpacingMeters: 0.04"), "squares needed"),
        (KALIBR["circlegrid"].replace("True", "False"), "asymmetricGrid false"),
        (KALIBR["aprilgrid"].replace("aprilgrid", "octagons"), "'octagons'; one of aprilgrid, checkerboard"),
        (KALIBR["checkerboard"].replace("targetRows: 6", "targetRows: 2"), "targetRows: 2: input should be greater"),
        ('type = "chessboard"\nrows = 2\ncolumns = 6\nsquare_mm = 20.0\n', "rows: 2: input should be greater"),
        (CHARUCO.replace("10.0", "19.9999999"), "marker_mm 20, under 0.99 of square_mm 20 needed"),
        (TAG.replace("id = 1", "id = 50"), "tag 50: DICT_4X4_50 has 0 … 49"),
        (TAG + TAG.removeprefix('type = "tags"\n'), "tag layout: tag 1 of DICT_4X4_50 occurs twice"),
        (CORNERS.format("[0, 0], [0, 9], [9, 9], [9, 0]"), "tag 1: corners_mm turn the other way"),
        (CORNERS.format("[0, 0], [9, 9], [9, 0], [0, 9]"), "tag 1: corners_mm turn the other way, cross"),
        (CORNERS.format("[0, 0], [9, 0], [12, 0], [3, 0]"), "cross or lie on a line; top left"),
        ('type = "boards"\n' + IN_A_SET, "several boards that are not in one plane; the file of a single board needed"),
    ],
)
def test_mistakes_in_files_are_named(tmp_path, text, said):
    refused(load_flat_board, written(tmp_path / "board.toml", text), said)


def test_several_boards_in_one_frame(tmp_path):
    """One written out, one in a file of its own, placed by angles, by a quaternion or by a matrix."""
    written(tmp_path / "april.yaml", KALIBR["aprilgrid"])
    first = 'type = "boards"\n' + IN_A_SET
    matrix = "common_from_board = [[0.0,0.0,1.0,200.0],[0.0,1.0,0.0,0.0],[-1.0,0.0,0.0,50.0],[0.0,0.0,0.0,1.0]]\n"
    root = "0.7071067811865476"
    quaternion = BESIDE.replace("rpy_deg = [0.0, 90.0, 0.0]", f"qw = {root}\nqx = 0.0\nqy = {root}\nqz = 0.0")
    places = []
    for place in (BESIDE, matrix, quaternion):
        found = load_boards(written(tmp_path / "board.toml", f'{first}[[board]]\nfile = "april.yaml"\n{place}'))
        assert isinstance(found, BoardSet)
        assert found.names == ("board 1", "board 2 (april.yaml)")
        assert found.first_ids() == [0, 35]
        places.append(found.xyz_mm())
    assert np.allclose(places[0], places[1])
    assert np.allclose(places[0], places[2])
    # corner 0 of tag 0, bottom right in Kalibr's printing: (80, 0) on the grid, Z into it looks along X
    assert np.allclose(places[0][35], [200, 0, 50 - 80])


@pytest.mark.parametrize(
    ("second", "said"),
    [
        (CHARUCO, "board 1 and board 2 look alike: both have tag 0 of DICT_5X5_50; other ids (first_id)"),
        (CHARUCO + "first_id = 30\n", "tags 30 … 53, DICT_5X5_50 has 0 … 49"),
        ('type = "chessboard"\nrows = 4\ncolumns = 6\nsquare_mm = 20.0\n', "board 2 looks the same when turned"),
        ('type = "chessboard"\nrows = 4\ncolumns = 5\nsquare_mm = 20.0\n', "4×5 inner corners are seen in 5×7 too"),
        (DOTS, "board 2 looks the same when turned"),
        ('file = "none.toml"\n', "board 2: board file"),
        ('file = "b.toml"\nrows = 5\n', "rows beside file"),
        ("file = 5\n", "file: a string needed"),
        (APRILGRID + "qw = 1.0\nqx = 0.0\nqy = 0.0\nqz = 0.0\nrpy_deg = [0.0, 0.0, 0.0]\n", "rpy_deg and a quaternion"),
        (APRILGRID + "common_from_board = [[1.0, 0.0], [0.0, 1.0]]\n", "4 rows of 4 numbers needed"),
    ],
)
def test_mistakes_in_sets_are_named(tmp_path, second, said):
    path = written(tmp_path / "board.toml", f'type = "boards"\n{IN_A_SET}[[board]]\n{second}')
    refused(load_boards, path, said)
