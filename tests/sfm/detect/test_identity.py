"""Faces and boards among candidates, without pixels: naming, hiding, reflections, clutter, numbering."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stcal.design import BoardDesign, FaceDesign, TargetDesign, reference_board, reference_target
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid
from stcal.sfm.detect.candidates import (
    BoardSighting,
    Candidates,
    EllipseOptions,
    Ellipses,
    ImageDetection,
    find_ellipses,
)
from stcal.sfm.detect.dot_grid import by_rings, find_boards
from stcal.sfm.detect.face_patterns import find_faces, find_mirrored, mirror_images
from stcal.sfm.detect.image import image_corners
from tests.outcome import refuses
from tests.sfm.detect.test_arrangement import centres_of
from tests.support.areas import circle_conic, ellipse_of_conic

CAMERA = Camera(2592, 1728, [2785.0, 2785.0], [1295.5, 863.5], np.zeros(8))
TARGET = reference_target()
BOARD = reference_board()


def pose(tilt_deg=40.0, azimuth_deg=30.0, roll_deg=0.0, x=0.0, y=0.0, depth=1000.0, facing=True):
    """camera_from_plane with the plane's Z towards the camera (faces) or away from it (boards)."""
    base = Rotation.from_euler("x", 180 if facing else 0, degrees=True)
    tilt = Rotation.from_rotvec(
        np.radians(tilt_deg) * np.array([np.cos(np.radians(azimuth_deg)), np.sin(np.radians(azimuth_deg)), 0])
    )
    return Rigid((tilt * base * Rotation.from_euler("z", roll_deg, degrees=True)).as_matrix(), [x, y, depth])


def ellipses_of(camera_from_plane, xy_mm, radius_mm, contrast=100.0):
    centres, shapes = [], []
    for (x, y), r in zip(xy_mm, radius_mm, strict=True):
        conic = circle_conic(camera_from_plane @ np.array([x, y, 0.0]), camera_from_plane.rotation[:, 2], r)
        centre, shape = ellipse_of_conic(conic)
        centres.append(centre * CAMERA.focal + CAMERA.centre)
        shapes.append(shape * CAMERA.focal[0])
    return Ellipses(np.array(centres), np.array(shapes), np.full(len(centres), contrast))


def junk(count, seed=0, contrast=100.0):
    rng = np.random.default_rng(seed)
    size = rng.uniform(4, 40, count)
    return Ellipses(
        rng.uniform(20, [2570, 1700], (count, 2)), size[:, None, None] * np.eye(2), np.full(count, contrast)
    )


def face_ellipses(face_id, camera_from_face, hidden=(), **kwargs):
    face = TARGET.face(face_id)
    keep = [i for i, circle in enumerate(face.ids) if circle not in hidden]
    return ellipses_of(camera_from_face, face.xy_mm[keep], face.radius_mm[keep], **kwargs)


def found_in(ellipses, target=TARGET):
    """Faces with a name, and patterns without one."""
    return find_faces(Candidates(ellipses, CAMERA), target)


@pytest.mark.parametrize("face_id", ["1", "2", "3", "4", "5"])
@pytest.mark.parametrize(("tilt", "azimuth", "roll"), [(0, 0, 0), (68, 200, 250)])
def test_every_face_is_named_at_any_tilt(face_id, tilt, azimuth, roll):
    (found,), _ = found_in(face_ellipses(face_id, pose(tilt, azimuth, roll)))
    assert found.face == face_id
    assert found.rows.tolist() == found.circles.tolist() == list(range(10))


@pytest.mark.parametrize("hidden", ["1", "a", "126", "457b"])
def test_up_to_four_hidden_circles_leave_the_name(hidden):
    """Six circles are left at least: four make a homography, two confirm it, and nothing else reads like them."""
    (found,), _ = found_in(face_ellipses("4", pose(50, 120, 30), hidden))
    assert found.face == "4"
    assert {TARGET.face("4").ids[i] for i in set(range(10)) - set(found.circles)} == set(hidden)


def test_a_circle_of_another_size_is_left_out_of_its_face():
    """Twice as large as designed, on circles of 20 px, where the outline's error is a hundredth of it."""
    face, at = TARGET.face("3"), pose(30, 20, 100, depth=500.0)
    radius = face.radius_mm * np.where(np.array(face.ids) == "2", 2.0, 1.0)
    (found,), _ = found_in(ellipses_of(at, face.xy_mm, radius))
    assert [face.ids[i] for i in set(range(10)) - set(found.circles)] == ["2"]


@pytest.mark.parametrize(("dots", "repeated"), [(63, True), (51, True), (50, False)])
def test_a_second_board_counts_if_it_is_of_similar_size(dots, repeated):
    cells = np.array([[r, c] for r in range(7) for c in range(9)])
    boards = [BoardSighting(np.arange(n), cells[None, :n]) for n in (63, dots)]
    found = ImageDetection(centres_of(np.zeros((0, 2)), np.zeros((0, 2))), (), tuple(boards))
    assert found.repeated == (("board",) if repeated else ())
    assert (found.board is None) == repeated


def test_without_the_circle_that_tells_the_faces_apart_or_five_others_nothing_is_named():
    """Nor by a design without faces."""
    faces, unnamed = found_in(face_ellipses("3", pose(), hidden="c"))
    assert faces == []
    assert {each.face for several in unnamed for each in several} > {"3"}
    assert found_in(face_ellipses("3", pose(), hidden="126a4"))[0] == []
    assert found_in(face_ellipses("1", pose()), TargetDesign("none", "bright", ())) == ([], [])


@pytest.mark.parametrize("ratio", [0.15, 5.0])
def test_faces_differ_in_brightness(ratio):
    """Light on one face is unrelated to that on another."""
    dim = face_ellipses("5", pose(30, 0, 0, x=200), contrast=40.0)
    other = face_ellipses("2", pose(40, 10, 0, x=-250), contrast=40.0 * ratio)
    assert {r.face for r in found_in(Ellipses.concatenate([dim, other]))[0]} == {"5", "2"}


@pytest.mark.parametrize("radius", [4.0, 5.66, 8.0])
def test_a_printed_grid_of_equal_discs_is_no_face(radius):
    """Between the large and the small circles' radius, equal discs are of neither size by less than 1.45."""
    grid = np.array([[x, y] for x in range(0, 120, 20) for y in range(0, 120, 20)], float)
    assert found_in(ellipses_of(pose(20, 10, 30), grid, np.full(len(grid), radius)))[0] == []
    own = TARGET.face("5")
    assert found_in(ellipses_of(pose(20, 10, 30), own.xy_mm, np.full(10, radius)))[0] == []


@pytest.mark.slow
def test_random_discs_are_no_faces_and_hide_none():
    assert found_in(junk(150))[0] == []
    (found,), _ = found_in(Ellipses.concatenate([junk(150), face_ellipses("2", pose(60, 40, 200))]))
    assert found.face == "2"
    assert (found.rows >= 150).all()


def test_a_face_in_view_twice_has_two_readings():
    faces, _ = found_in(Ellipses.concatenate([face_ellipses("1", pose(x=-200)), face_ellipses("1", pose(x=150))]))
    assert [r.face for r in faces] == ["1", "1"]


def test_which_faces_a_mirror_makes_of_faces():
    """Swapping x and y turns the pattern of face 5 into that of face 3, and that of face 4 into that of face 2."""
    assert mirror_images(TARGET) == {"2": ("4",), "4": ("2",), "3": ("5",), "5": ("3",)}


@pytest.mark.parametrize("face_id", ["1", "2"])
def test_a_mirrored_image_is_told_by_a_face_without_a_mirror_image(face_id):
    faces = face_ellipses("1", pose(30, 0, 0, x=200)), face_ellipses(face_id, pose(40, 10, 0, x=-250))
    candidates = Candidates(Ellipses.concatenate([*faces]), CAMERA)
    for each, mirrored in ((candidates, set()), (candidates.mirrored(), {"1"})):
        assert set(find_mirrored(each, TARGET, find_faces(each, TARGET)[0])) == mirrored


def test_faces_of_few_and_of_many_circles_are_found_together():
    face = TARGET.face("2")
    few = FaceDesign("few", tuple("abcde"), [[0, 0], [31, 0], [64, 7], [5, 38], [36, 52]], [5.0] * 5, "a", "c", "d")
    target = TargetDesign("mixed", "bright", (few, face))
    own = ellipses_of(pose(20, 30, 40, x=200), few.xy_mm, few.radius_mm)
    both = Ellipses.concatenate([own, face_ellipses("2", pose(40, 10, 0, x=-250))])
    assert {reading.face: len(reading.rows) for reading in found_in(both, target)[0]} == {"few": 5, "2": 10}


def test_a_face_that_looks_the_same_after_half_a_turn_is_never_named(monkeypatch):
    monkeypatch.setattr("stcal.design.require_distinct", lambda *_: None)  # which refuses the design first
    xy = [[0, 0], [30, 0], [60, 0], [0, 40], [30, 40], [60, 40]]
    square = FaceDesign("s", tuple("abcdef"), xy, [5.0] * 6, "a", "c", "d")
    target = TargetDesign("symmetric", "bright", (square,))
    assert found_in(ellipses_of(pose(), square.xy_mm, square.radius_mm), target)[0] == []


# Boards ---------------------------------------------------------------------------------------------------------

CORNERS = (np.array([[-0.5, -0.5], [2591.5, -0.5], [2591.5, 1727.5], [-0.5, 1727.5]]) - CAMERA.centre) / CAMERA.focal


def board_ellipses(board, camera_from_board, hidden=()):
    keep = [i for i in range(board.rows * board.columns) if divmod(i, board.columns) not in hidden]
    centred = board.xy_mm() - board.xy_mm().mean(0)
    return keep, ellipses_of(camera_from_board, centred[keep], board.radii_mm()[keep])


def find(ellipses, board):
    return find_boards(Candidates(ellipses, CAMERA), board, CORNERS)


def numberings_of(reading, keep) -> list[dict]:
    """Row and column by the number of the dot on the board."""
    return [{keep[c]: tuple(rc) for c, rc in zip(reading.rows, own, strict=True)} for own in reading.numberings]


@pytest.mark.parametrize(("tilt", "azimuth", "roll"), [(0, 0, 0), (65, 200, 30)])
def test_a_plain_board_is_numbered_up_to_half_a_turn(tilt, azimuth, roll):
    keep, ellipses = board_ellipses(BOARD, pose(tilt, azimuth, roll, facing=False))
    (reading,) = find(ellipses, BOARD)
    assert reading.numberings.shape == (2, 63, 2)
    truth = {i: divmod(i, 9) for i in range(63)}
    turned = {i: (6 - r, 8 - c) for i, (r, c) in truth.items()}
    both = numberings_of(reading, keep)
    assert truth in both
    assert turned in both
    square = BoardDesign(7, 7, 30.0, 7.5, "bright", 0.005)
    (reading,) = find(board_ellipses(square, pose(tilt, azimuth, roll, facing=False))[1], square)
    assert len(reading.numberings) == 4


@pytest.mark.parametrize("corner", [(0, 0), (0, 9)])
def test_a_larger_corner_dot_settles_the_numbering(corner):
    board = BoardDesign(10, 10, 20.0, 5.0, "dark", 0.05, corner, 7.5)
    keep, ellipses = board_ellipses(board, pose(40, 60, 70, facing=False))
    (reading,) = find(ellipses, board)
    assert numberings_of(reading, keep) == [{i: divmod(i, 10) for i in range(100)}]


@pytest.mark.parametrize(
    ("hidden", "count"),
    [({(0, 0), (3, 4)}, 2), ({(r, 0) for r in range(7)}, 4)],  # nothing tells on which side a hidden column was
)
def test_hidden_dots_leave_the_numberings_open_that_fit(hidden, count):
    keep, ellipses = board_ellipses(BOARD, pose(20, 80, 0, facing=False), hidden)
    (reading,) = find(ellipses, BOARD)
    numberings = numberings_of(reading, keep)
    assert {i: divmod(i, 9) for i in keep} in numberings
    assert len(numberings) == count


def test_a_strip_cut_off_by_the_image_is_known():
    """The column beyond the border is the missing one: the other side is in view and empty."""
    camera_from_board = pose(0, 0, 0, x=-365, facing=False)
    keep, ellipses = board_ellipses(BOARD, camera_from_board)
    inside = ellipses.centre_px[:, 0] - ellipses.radius_px() > 0
    keep = [k for k, ok in zip(keep, inside, strict=True) if ok]
    assert 0 < 63 - len(keep) <= 14
    (reading,) = find(ellipses.select(inside), BOARD)
    numberings = numberings_of(reading, keep)
    assert {i: divmod(i, 9) for i in keep} in numberings
    # The other one is the same place after half a turn of the board; no numbering is shifted by a column.
    assert len(numberings) == 2


def test_discs_around_the_board_are_not_taken_into_it():
    keep, ellipses = board_ellipses(BOARD, pose(45, 80, 20, facing=False))
    assert find(junk(300), BOARD) == []
    readings = find(Ellipses.concatenate([ellipses, junk(120)]), BOARD)
    assert len(readings) == 1
    assert set(readings[0].rows) == set(range(len(keep)))


def test_rings_at_other_places_than_stated_are_refused():
    """A board seen from the front, three of its dots with a hole: the file that states them orients it, one that states
    them a column further is named with their places."""
    stated = replace(BOARD, corner=None, corner_radius_mm=None, rings=((2, 4), (3, 2), (3, 3)))
    camera = Camera(960, 760, [1000.0, 1000.0], [479.5, 379.5], np.zeros(8))
    scale = 3.0  # px a mm
    large = np.zeros((4 * camera.height, 4 * camera.width), np.uint8)
    for (row, column), xy in zip(stated.cells().tolist(), stated.xy_mm(), strict=True):
        centre = tuple((4 * (scale * xy + 110)).astype(int).tolist())
        cv2.circle(large, centre, round(4 * scale * stated.radius_mm), 220, -1)
        if (row, column) in stated.rings:
            cv2.circle(large, centre, round(2 * scale * stated.radius_mm), 0, -1)
    grey = cv2.GaussianBlur(cv2.resize(large, (camera.width, camera.height), interpolation=cv2.INTER_AREA), None, 0.7)
    dots = Candidates(find_ellipses(grey, "bright", EllipseOptions()), camera)
    (reading,) = find_boards(dots, stated, image_corners(camera))
    assert len(reading.numberings) == 2
    assert len(by_rings(reading, stated, grey, camera, dots.xy).numberings) == 1
    further = replace(stated, rings=tuple((row, column + 1) for row, column in stated.rings))
    refuses("E-RINGS-ELSEWHERE … [2, 4], [3, 2], [3, 3]", by_rings, reading, further, grey, camera, dots.xy)
