"""``target.toml`` and board files, Kalibr's too, and of several boards in one frame: what is written is read, frames
are normalised, and every mistake is named."""

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stcal.boards.board_designs import (
    AprilGridDesign,
    AsymmetricCirclesDesign,
    BoardSet,
    CharucoDesign,
    ChessboardDesign,
    HexagonalCirclesDesign,
)
from stcal.boards.board_file import board_toml, load_board, load_dots, load_flat_board
from stcal.boards.target_file import load_boards, load_target, target_toml
from stcal.design import (
    DOTS_SIGMA_MM,
    MIN_SINE,
    BoardDesign,
    FaceDesign,
    TargetDesign,
    reference_board,
    reference_target,
)
from stcal.errors import InputError
from tests.outcome import fails_with, refuses
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


ALONE = (
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
)
"""Files of a single board, and why they are refused."""
IN_SETS = (
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
)
"""Second boards beside a ChArUco board, and why they are refused."""


@pytest.mark.parametrize(
    ("load", "text", "said"),
    [
        *((load_boards, f'type = "boards"\n{IN_A_SET}[[board]]\n{second}', said) for second, said in IN_SETS),
        *((load_flat_board, *each) for each in ALONE),
    ],
)
def test_mistakes_in_files_are_named(tmp_path, load, text, said):
    with pytest.raises(InputError, match="board file") as caught:
        load(written(tmp_path / "board.toml", text))
    assert said in str(caught.value)


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


ROUNDED_MM = 1e-9
"""Lengths are written with nine decimals: half a unit of the last is 5e-10 mm."""
SQUARE, SQUARE_OF_60 = (
    "".join(
        f'  {{ id = "{k}", x_mm = {x * side}, y_mm = {y * side}, radius_mm = {radius} }},\n'
        for k, x, y, radius in ((1, 0, 0, large), (2, 1, 0, large), (3, 0, 1, large), (4, 1, 1, large // 2))
    )
    for side, large in ((40, 8), (60, 12))
)
HEAD = 'name = "t"\npolarity = "bright"\n'
FACE = f'[[face]]\nid = "1"\norigin = "1"\nx = "2"\ny = "3"\ncircles = [\n{SQUARE}]\n'
FACE_OF_60 = FACE.replace(SQUARE, SQUARE_OF_60).replace('[[face]]\nid = "1"', '[[face]]\nid = "2"')
TARGET = HEAD + FACE
BOARD = 'rows = 7\ncolumns = 9\npitch_mm = 30.0\nradius_mm = 7.5\npolarity = "bright"\n'


def corner(row=0, column=0, radius_mm=11.0) -> str:
    return f"[corner]\nrow = {row}\ncolumn = {column}\nradius_mm = {radius_mm}\n"


def rough(x: str, normal: str) -> str:
    return f'y = "3"\nrough_pose = {{ origin_mm = [7, 8, 9], x = {x}, normal = {normal} }}'


def target_of(tmp_path, content: str | bytes) -> TargetDesign:
    return load_target(written(tmp_path / "target.toml", content))


def board_of(tmp_path, content: str | bytes) -> BoardDesign:
    return load_dots(written(tmp_path / "board.toml", content))


def changed(old: str, new: str, text: str = TARGET) -> str:
    assert old in text
    return text.replace(old, new)


def test_reference_target_round_trip(tmp_path):
    """Faces 2 and 4 are mirror images, and all five share nine of ten circles."""
    found, expected = target_of(tmp_path, target_toml(reference_target())), reference_target()
    assert (found.name, found.polarity) == (expected.name, expected.polarity)
    assert [face.id for face in found.faces] == [face.id for face in expected.faces]
    for one, other in zip(found.faces, expected.faces, strict=True):
        assert (one.ids, one.origin, one.x, one.y) == (other.ids, other.origin, other.x, other.y)
        np.testing.assert_allclose(one.xy_mm, other.xy_mm, rtol=0, atol=2 * ROUNDED_MM)
        np.testing.assert_allclose(one.radius_mm, other.radius_mm, rtol=0, atol=ROUNDED_MM)
        poses = (face.rough_target_from_face.matrix() for face in (one, other))
        np.testing.assert_allclose(*poses, atol=2 * ROUNDED_MM)


def test_the_reference_and_opencvs_grid_have_the_published_layout_and_boards_have_arrays():
    # Zhang & Wei 2017, fig. 1: five faces, each of seven big (r = 8 mm) and three small (r = 4 mm) circles.
    target = reference_target()
    assert len(target.faces) == 5
    for face in target.faces:
        assert sorted(face.radius_mm.tolist()) == [4.0] * 3 + [8.0] * 7
        assert face.labels()[0] == f"{face.id}:1"
    assert target.radius_of()["3:c"] == 4
    assert target.face("2").id == "2"
    refuses("E-TARGET-NO-FACE … 9 … 1, 2, 3, 4, 5", target.face, "9")
    board = BoardDesign(2, 3, 10.0, 2.0, "dark", 0.005, (1, 2), 3.0)
    np.testing.assert_array_equal(board.xy_mm(), [[0, 0], [10, 0], [20, 0], [0, 10], [10, 10], [20, 10]])
    assert board.labels() == ["board:0:0", "board:0:1", "board:0:2", "board:1:0", "board:1:1", "board:1:2"]
    assert board.radius_of() == dict(zip(board.labels(), [2.0, 2, 2, 2, 2, 3], strict=True))
    # OpenCV's documented layout: x = (2 j + i mod 2) · spacing, y = i · spacing.
    xy = CIRCLES.xy_mm()
    assert np.allclose(xy[[0, 1, 4, 5, 8, 43]], [[0, 0], [40, 0], [20, 20], [60, 20], [0, 40], [120, 200]])


def test_comments_are_right_once_uncommented(tmp_path):
    text = re.sub(r"^# (\[corner\]|row|column|radius_mm)", r"\1", board_toml(reference_board()), flags=re.MULTILINE)
    found = board_of(tmp_path, text)
    assert (found.corner, found.corner_radius_mm) == ((0, 0), 11.25)
    text = target_toml(target_of(tmp_path, TARGET))
    assert target_of(tmp_path, text).rough_poses() == {}
    uncommented = text.replace("# rough_pose", "rough_pose")
    assert target_of(tmp_path, uncommented).rough_poses()["1"].matrix() == pytest.approx(np.eye(4))


@pytest.mark.slow
@given(st.floats(-np.pi, np.pi), st.floats(-500, 500), st.floats(-500, 500))
def test_any_right_handed_drawing_frame_gives_the_same_face(tmp_path_factory, angle, x, y):
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    reference = reference_target()
    drawn = [
        FaceDesign(f.id, f.ids, f.xy_mm @ turn.T + [x, y], f.radius_mm, f.origin, f.x, f.y) for f in reference.faces
    ]
    text = target_toml(TargetDesign(reference.name, reference.polarity, tuple(drawn)))
    found = load_target(written(tmp_path_factory.getbasetemp() / "drawn.toml", text))
    for face, expected in zip(found.faces, reference.faces, strict=True):
        # Nine decimals over a frame of 80 mm, at circles up to 130 mm from its origin: a few roundings.
        np.testing.assert_allclose(face.xy_mm, expected.xy_mm, atol=5 * ROUNDED_MM)


identifiers = st.text(
    st.characters(codec="utf-8", exclude_categories=["C", "Z"], exclude_characters=":,/\\"), min_size=1
)


@pytest.mark.slow
@given(st.lists(identifiers, min_size=4, max_size=4, unique=True), st.text(st.characters(codec="utf-8")))
def test_any_allowed_id_and_any_name_survive(tmp_path_factory, ids, name):
    xy = [[0, 0], [40, 0], [0, 40], [40, 40]]
    target = TargetDesign(name, "dark", (FaceDesign("f", tuple(ids), xy, [5.0, 5, 5, 8], *ids[:3]),))
    found = load_target(written(tmp_path_factory.getbasetemp() / "names.toml", target_toml(target)))
    assert found.name == " ".join(name.split())  # a name is one line
    assert found.faces[0].ids == tuple(ids)


def test_whole_numbers_are_ids_small_likenesses_are_taken_and_no_negative_zero_is_written(tmp_path):
    text = re.sub(r'"(\d)"', r"\1", TARGET)
    face = target_of(tmp_path, text).faces[0]
    assert (face.id, face.ids, face.x) == ("1", ("1", "2", "3", "4"), "2")
    moved = changed("x_mm = 40, y_mm = 40, radius_mm = 4", "x_mm = 44, y_mm = 40, radius_mm = 4", FACE)
    two = target_of(tmp_path, TARGET + moved.replace('[[face]]\nid = "1"', '[[face]]\nid = "2"'))
    assert [face.id for face in two.faces] == ["1", "2"]  # 4 mm are more than half a radius
    face = FaceDesign(
        "f", ("1", "2", "3", "4"), [[-0.0, 0], [40, -1e-12], [0, 40], [40, 40]], [5.0, 5, 5, 8], "1", "2", "3"
    )
    assert "-0.0" not in target_toml(TargetDesign("t", "dark", (face,)))


def test_a_frame_just_inside_the_smallest_angle_is_taken_and_a_rough_pose_wherever_its_origin_is(tmp_path):
    def bent(sine):
        # Origin at (100, 50): the angle is at the origin circle, wherever it was drawn.
        xy = np.array([[0, 0], [40, 0], [80 * np.sqrt(1 - sine**2), 80 * sine], [40, 40]]) + np.array([100, 50])
        face = FaceDesign("f", ("1", "2", "3", "4"), xy, [5.0] * 4, "1", "2", "3")
        return target_toml(TargetDesign("bent", "dark", (face,)))

    # y of the third circle is 80 mm times the sine
    assert target_of(tmp_path, bent(1.01 * MIN_SINE)).faces[0].xy_mm[2, 1] == pytest.approx(80.8 * MIN_SINE, abs=1e-8)
    refuses("E-TARGET-FRAME", lambda: target_of(tmp_path, bent(0.99 * MIN_SINE)))
    # The drawing's X points along -y and its normal along +x, so its Y along -z; drawn from a corner at (-100, -50).
    moved = SQUARE.replace("x_mm = 0", "x_mm = 100").replace("x_mm = 40", "x_mm = 140")
    moved = moved.replace("y_mm = 0", "y_mm = 50").replace("y_mm = 40", "y_mm = 90")
    text = TARGET.replace(SQUARE, moved).replace('y = "3"', rough("[0.03, -2, 0]", "[1, 0, 0]"))
    face = target_of(tmp_path, text).faces[0]
    assert face.xy_mm[3] == pytest.approx([40, 40])
    pose = face.rough_target_from_face
    assert pose @ np.zeros(3) == pytest.approx([7, 8 - 100, 9 - 50])
    assert pose @ np.array([40.0, 40, 0]) == pytest.approx([7, 8 - 140, 9 - 90])


# fmt: off
WRONG_TARGETS = {
    "empty": ("", "E-KEY-MISSING … 1"),
    "JSON": ('{"rows": 7}', "E-TOML-INVALID … JSON … TOML"),
    "YAML": ("board:\n  rows: 7\n", "E-TOML-INVALID … YAML … TOML"),
    "face not a list": (changed("[[face]]", "[face]"), "E-KEY-VALUE … 'id' … '1'"),
    "three circles": (changed('  { id = "4", x_mm = 40, y_mm = 40, radius_mm = 4 },\n', ""),
                      "E-KEY-VALUE … 4"),
    "misspelt radius": (changed("radius_mm = 4", "radius = 4"), "E-KEY-MISSING … radius_mm … unknown key radius"),
    "polarity": (changed('"bright"', '"grey"'), "E-KEY-VALUE … 'grey' … 'bright' … 'dark'"),
    "fractional id": (changed('{ id = "4"', "{ id = 1.5"), "E-KEY-VALUE … 1. … 4. … 1.5"),
    "id with colon": (changed('{ id = "4"', '{ id = "a:b"'), "E-KEY-NAME … 'a:b'"),
    "id with invisible space": (changed('{ id = "4"', '{ id = "a\\u200b"'), "E-KEY-NAME"),
    "duplicate faces": (TARGET + FACE, "E-TARGET-ID … face id 1"),
    "duplicate circles": (changed('{ id = "4"', '{ id = "2"'), "E-TARGET-ID … face 1: circle id 2"),
    "face named board": (changed('[[face]]\nid = "1"', '[[face]]\nid = "board"'), "E-TARGET-ID … board"),
    "negative radius": (changed("radius_mm = 4", "radius_mm = -4"), "E-KEY-VALUE … radius_mm … -4 … 0"),
    "NaN position": (changed("y_mm = 40, radius_mm = 4", "y_mm = nan, radius_mm = 4"), "E-KEY-VALUE … 4. … y_mm"),
    "position of a kilometre": (changed("y_mm = 40, radius_mm = 4", "y_mm = 1e7, radius_mm = 4"),
                                "E-KEY-VALUE … 4. … y_mm … 10000000.0"),
    "touching": (changed("x_mm = 40, y_mm = 0", "x_mm = 16, y_mm = 0"), "E-TARGET-OVERLAP … face 1 … 1 … 2"),
    "frame circle missing": (changed('y = "3"', 'y = "9"'), "E-TARGET-FRAME … face 1: y … 9 … 1, 2, 3, 4"),
    "x and y the same": (changed('y = "3"', 'y = "2"'), "E-TARGET-FRAME … 1 … 2 … 2"),
    "collinear": (changed("x_mm = 0, y_mm = 40", "x_mm = 80, y_mm = 0"), "E-TARGET-FRAME … 1 … 2 … 3"),
    "left-handed": (changed("x_mm = 0, y_mm = 40", "x_mm = 0, y_mm = -40"), "E-TARGET-FRAME"),
    "two faces alike": (TARGET + changed('[[face]]\nid = "1"', '[[face]]\nid = "2"', FACE),
                        "E-TARGET-LIKENESS … 1 … 2 too; change one"),
    "a face at another size": (
        TARGET + FACE_OF_60, "E-TARGET-LIKENESS … 1 … 2 … 1.50"),
    "a face among more circles": (
        TARGET + FACE_OF_60.replace("},\n]\n", "},\n"  '{ id = "5", x_mm = 90, y_mm = 90, radius_mm = 6 }]\n'),
        "E-TARGET-LIKENESS … 1 … 2 … 1.50"),
    "a face of half a turn": (changed("radius_mm = 4", "radius_mm = 8"), "E-TARGET-LIKENESS … 1 … 90"),
    "rough pose without normal": (changed('y = "3"', 'y = "3"\nrough_pose = { origin_mm = [0, 0, 0], x = [1, 0, 0] }'),
                                  "E-KEY-MISSING … 1. … rough_pose"),
    "rough pose with a zero": (changed('y = "3"', rough("[0, 0, 0]", "[0, 0, 1]")),
                               "E-TARGET-ROUGH-POSE … face 1 … rough_pose … [0.0, 0.0, 0.0]"),
    "rough pose askew": (changed('y = "3"', rough("[1, 0, 1]", "[0, 0, 1]")),
                         "E-TARGET-ROUGH-POSE … face 1 … rough_pose … 45 … 5"),
}
WRONG_BOARDS = {
    "one row": (changed("rows = 7", "rows = 1", BOARD), "E-KEY-VALUE … 1 … 2"),
    "negative radius": (changed("radius_mm = 7.5", "radius_mm = -1", BOARD), "E-KEY-VALUE … radius_mm … -1"),
    "dots that touch": (changed("radius_mm = 7.5", "radius_mm = 15", BOARD), "E-BOARD-RADIUS … 15"),
    "zero sigma": (BOARD + "sigma_mm = 0\n", "E-KEY-VALUE … sigma_mm … 0 … 0"),
    "corner inside": (BOARD + corner(3, 3), "E-BOARD-CORNER … 3 … 3"),
    "a ring off the board": ("rings = [[99, 0]]\n" + BOARD, "E-BOARD-RINGS … [99, 0]"),
    "corner outside": (BOARD + corner(0, 9), "E-BOARD-CORNER … 0 … 9"),
    "corner no larger": (BOARD + corner(0, 0, 8), "E-BOARD-CORNER … 8 … 8.625 … 22.5"),
    "corner touches": (BOARD + corner(0, 0, 22.5), "E-BOARD-CORNER … 22.5 … 8.625 … 22.5"),
}
# fmt: on


WRONG = {f"target: {case}": (target_of, *each) for case, each in WRONG_TARGETS.items()}
WRONG |= {f"board: {case}": (board_of, *each) for case, each in WRONG_BOARDS.items()}


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_file_is_named_in_one_line(tmp_path, case):
    load, content, message = WRONG[case]
    with fails_with(message) as caught:
        load(tmp_path, content)
    text = str(caught.value)
    assert re.match(r"(target|board) file \S+\.toml: ", text)
    assert len(text.splitlines()) == 1
    assert len(text) < 400  # a line to read, not a dump of the file


@pytest.mark.parametrize("load", [load_target, load_dots])
def test_a_path_that_cannot_be_read(tmp_path, load):
    refuses("E-FILE-UNREADABLE … Is a directory", load, tmp_path)
    refuses("E-FILE-UNREADABLE", load, tmp_path / "missing.toml")


@pytest.mark.parametrize("radius_mm", [8.625, 22.49])
def test_corner_radii_at_the_bounds_are_taken(tmp_path, radius_mm):
    assert board_of(tmp_path, BOARD + corner(6, 8, radius_mm)).radii_mm()[-1] == radius_mm


CHESSBOARD = 'type = "chessboard"\nrows = 3\ncolumns = 4\nsquare_mm = 20.0\n'
TAGS = "target_type: 'aprilgrid'\ntagCols: 6\ntagRows: 6\ntagSize: 0.03\ntagSpacing: 0.3\n"


@pytest.mark.parametrize("text", [CHESSBOARD, TAGS])
def test_another_kind_of_board_is_named(tmp_path, text):
    refuses("E-BOARD-TYPE … board of dots needed … calibrate-camera", board_of, tmp_path, text)
