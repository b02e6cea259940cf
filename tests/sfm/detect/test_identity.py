"""Candidates of either polarity, from 8 to 400 px across, and what is none, within bounds of time and memory; faces and
boards among them: naming, hiding, reflections, clutter, numbering; the published rules on drawn patterns; and the
board's grid among the outlines of a photograph."""

from dataclasses import replace
from operator import itemgetter

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stcal import BoardDesign, Camera, FaceDesign, Rigid, TargetDesign, reference_board, reference_target
from stcal.io.cameras.read import read_camera
from stcal.io.images import decode
from stcal.sfm.detect import image as stage
from stcal.sfm.detect.candidates import (
    OPTION_RANGES,
    BoardSighting,
    Candidates,
    EllipseOptions,
    Ellipses,
    ImageDetection,
    find_ellipses,
)
from stcal.sfm.detect.dot_grid import by_rings, contradiction, find_boards
from stcal.sfm.detect.face_patterns import find_faces, find_mirrored, mirror_images
from stcal.sfm.detect.image import image_corners
from stcal.sfm.detect.published import EQUAL_SIGMA_PX, PublishedPattern, detect_published
from stcal.sfm.mapping.pairs import PairOptions
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


def test_every_face_is_named_at_any_tilt_by_enough_of_its_circles():
    """Six circles are left at least: four make a homography, two confirm it, and nothing else reads like them. One
    twice as large as designed is left out, of circles of 20 px, where the outline's error is a hundredth of it. Nothing
    is named without the circle that tells the faces apart or five others, nor by a design without faces."""
    for face_id in ("1", "2", "3", "4", "5"):
        for tilt, azimuth, roll in ((0, 0, 0), (68, 200, 250)):
            (found,), _ = found_in(face_ellipses(face_id, pose(tilt, azimuth, roll)))
            assert found.face == face_id
            assert found.rows.tolist() == found.circles.tolist() == list(range(10))
    for hidden in ("1", "a", "126", "457b"):
        (found,), _ = found_in(face_ellipses("4", pose(50, 120, 30), hidden))
        assert found.face == "4"
        assert {TARGET.face("4").ids[i] for i in set(range(10)) - set(found.circles)} == set(hidden)
    face, at = TARGET.face("3"), pose(30, 20, 100, depth=500.0)
    radius = face.radius_mm * np.where(np.array(face.ids) == "2", 2.0, 1.0)
    (found,), _ = found_in(ellipses_of(at, face.xy_mm, radius))
    assert [face.ids[i] for i in set(range(10)) - set(found.circles)] == ["2"]
    faces, unnamed = found_in(face_ellipses("3", pose(), hidden="c"))
    assert faces == []
    assert {each.face for several in unnamed for each in several} > {"3"}
    assert found_in(face_ellipses("3", pose(), hidden="126a4"))[0] == []
    assert found_in(face_ellipses("1", pose()), TargetDesign("none", "bright", ())) == ([], [])


def test_a_second_board_counts_if_it_is_of_similar_size_and_a_printed_grid_of_equal_discs_is_no_face():
    """Between the large and the small circles' radius, equal discs are of neither size by less than 1.45."""
    for dots, repeated in ((63, True), (51, True), (50, False)):
        cells = np.array([[r, c] for r in range(7) for c in range(9)])
        boards = [BoardSighting(np.arange(n), cells[None, :n]) for n in (63, dots)]
        found = ImageDetection(centres_of(np.zeros((0, 2)), np.zeros((0, 2))), (), tuple(boards))
        assert found.repeated == (("board",) if repeated else ())
        assert (found.board is None) == repeated
    for radius in (4.0, 5.66, 8.0):
        grid = np.array([[x, y] for x in range(0, 120, 20) for y in range(0, 120, 20)], float)
        assert found_in(ellipses_of(pose(20, 10, 30), grid, np.full(len(grid), radius)))[0] == []
        own = TARGET.face("5")
        assert found_in(ellipses_of(pose(20, 10, 30), own.xy_mm, np.full(10, radius)))[0] == []


def test_faces_of_any_light_number_and_circles_are_found_together_but_one_that_looks_the_same_turned(monkeypatch):
    """Light on one face is unrelated to that on another."""
    for ratio in (0.15, 5.0):
        dim = face_ellipses("5", pose(30, 0, 0, x=200), contrast=40.0)
        other = face_ellipses("2", pose(40, 10, 0, x=-250), contrast=40.0 * ratio)
        assert {r.face for r in found_in(Ellipses.concatenate([dim, other]))[0]} == {"5", "2"}
    faces, _ = found_in(Ellipses.concatenate([face_ellipses("1", pose(x=-200)), face_ellipses("1", pose(x=150))]))
    assert [r.face for r in faces] == ["1", "1"]
    face = TARGET.face("2")
    few = FaceDesign("few", tuple("abcde"), [[0, 0], [31, 0], [64, 7], [5, 38], [36, 52]], [5.0] * 5, "a", "c", "d")
    target = TargetDesign("mixed", "bright", (few, face))
    own = ellipses_of(pose(20, 30, 40, x=200), few.xy_mm, few.radius_mm)
    both = Ellipses.concatenate([own, face_ellipses("2", pose(40, 10, 0, x=-250))])
    assert {reading.face: len(reading.rows) for reading in found_in(both, target)[0]} == {"few": 5, "2": 10}
    monkeypatch.setattr("stcal.design.require_distinct", lambda *_: None)  # which refuses the design first
    xy = [[0, 0], [30, 0], [60, 0], [0, 40], [30, 40], [60, 40]]
    square = FaceDesign("s", tuple("abcdef"), xy, [5.0] * 6, "a", "c", "d")
    target = TargetDesign("symmetric", "bright", (square,))
    assert found_in(ellipses_of(pose(), square.xy_mm, square.radius_mm), target)[0] == []


@pytest.mark.slow
def test_random_discs_are_no_faces_and_hide_none():
    assert found_in(junk(150))[0] == []
    (found,), _ = found_in(Ellipses.concatenate([junk(150), face_ellipses("2", pose(60, 40, 200))]))
    assert found.face == "2"
    assert (found.rows >= 150).all()


def test_a_mirrored_image_is_told_by_a_face_without_a_mirror_image():
    """Swapping x and y turns the pattern of face 5 into that of face 3, and that of face 4 into that of face 2."""
    assert mirror_images(TARGET) == {"2": ("4",), "4": ("2",), "3": ("5",), "5": ("3",)}
    for face_id in ("1", "2"):
        faces = face_ellipses("1", pose(30, 0, 0, x=200)), face_ellipses(face_id, pose(40, 10, 0, x=-250))
        candidates = Candidates(Ellipses.concatenate([*faces]), CAMERA)
        for each, mirrored in ((candidates, set()), (candidates.mirrored(), {"1"})):
            assert set(find_mirrored(each, TARGET, find_faces(each, TARGET)[0])) == mirrored


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


def test_a_board_has_all_numberings_that_fit_and_takes_no_discs_around_it():
    """Two or four up to half a turn, one with a larger corner dot. Hidden dots leave those open that fit; of a strip
    cut off by the image, the column beyond the border is the missing one: the other side is in view and empty."""
    for tilt, azimuth, roll in ((0, 0, 0), (65, 200, 30)):
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
    for corner in ((0, 0), (0, 9)):
        board = BoardDesign(10, 10, 20.0, 5.0, "dark", 0.05, corner, 7.5)
        keep, ellipses = board_ellipses(board, pose(40, 60, 70, facing=False))
        (reading,) = find(ellipses, board)
        assert numberings_of(reading, keep) == [{i: divmod(i, 10) for i in range(100)}]
    for hidden, count in (({(0, 0), (3, 4)}, 2), ({(r, 0) for r in range(7)}, 4)):
        keep, ellipses = board_ellipses(BOARD, pose(20, 80, 0, facing=False), hidden)
        (reading,) = find(ellipses, BOARD)
        numberings = numberings_of(reading, keep)
        assert {i: divmod(i, 9) for i in keep} in numberings
        assert len(numberings) == count
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


BITS = 8


def drawn(ellipses, grey=200):
    image = np.full((CAMERA.height, CAMERA.width), 20, np.uint8)
    for centre, shape in zip(ellipses.centre_px, ellipses.shape_px, strict=True):
        values, axes = np.linalg.eigh(shape)
        angle = np.degrees(np.arctan2(axes[1, 1], axes[0, 1]))
        scaled = [tuple(np.round(2**BITS * np.array(v)).astype(int).tolist()) for v in (centre, values[::-1])]
        cv2.ellipse(image, *scaled, angle, 0, 360, grey, -1, cv2.LINE_AA, BITS)
    return image


def detect(image, target=TARGET):
    return detect_published(image, CAMERA, target, None, EllipseOptions())


def test_faces_as_published_but_where_perspective_breaks_the_name():
    """A square seen from the side: what was perpendicular is not."""
    for face_id in ("1", "5"):
        ellipses = face_ellipses(face_id, pose(5, 40, 30.0 * int(face_id)))
        found = detect(drawn(ellipses))
        assert [each.face for each in found.faces] == [face_id]
        assert found.notes == ()
        labels = found.faces[0].circles
        seen = found.centres.centre_px[found.faces[0].rows]
        assert np.abs(seen - ellipses.centre_px[labels]).max() < 0.15  # of a contour, to what pixels leave
        assert (found.centres.covariance_px2 == EQUAL_SIGMA_PX**2 * np.eye(2)).all()
    found = detect(drawn(face_ellipses("1", pose(60, 0, 0))))
    assert [each.face for each in found.faces] == ["1"]
    (note,) = found.notes
    assert note.startswith("a pattern about (")
    assert "perspective breaks the published name" in note
    assert "its own plane says face 1, which was taken" in note


@pytest.mark.parametrize(
    ("hidden", "moved", "said"),
    [
        ("3", "", "circle 3 not found in its direction"),
        ("6", "", "circle 6 not found in its direction"),
        ("c", "", "0 small circles beside circle 7, 1 needed"),
        ("", "2", "radii off in the plane of the others, 0.25 allowed"),  # half a radius along its line
    ],
)
def test_a_pattern_that_lacks_a_circle_or_has_one_out_of_place_is_no_face(hidden, moved, said):
    ellipses = face_ellipses("2", pose(10, 40), tuple(hidden))
    centre = ellipses.centre_px.copy()
    for i in [TARGET.face("2").ids.index(circle) for circle in moved]:
        centre[i] += 0.5 * ellipses.radius_px()[i] * (centre[i] - centre[0]) / np.linalg.norm(centre[i] - centre[0])
    found = detect(drawn(replace(ellipses, centre_px=centre)))
    assert found.faces == ()
    (note,) = found.notes
    assert said in note
    assert note.endswith("left out by the published rules")


def test_the_published_rules_know_the_reference_design_alone():
    """Dot product zero: 1; positive: 2 and 4, negative: 3 and 5, each two told apart by the vector product."""
    found = detect(np.full((CAMERA.height, CAMERA.width), 90, np.uint8))
    assert (len(found.centres), found.faces, found.notes) == (0, (), ())
    names = PublishedPattern(reference_target()).names
    assert names == {(0, 0): "1", (1, -1): "2", (1, 1): "4", (-1, 1): "3", (-1, -1): "5"}
    face = TARGET.face("1")
    xy = face.xy_mm.copy()
    xy[face.ids.index("6")] = (50.0, 30.0)
    sizes = [face.radius_mm * np.where(np.array(face.ids) == i, share, 1) for i, share in (("a", 2), ("4", 0.5))]
    first = [replace(face, xy_mm=xy), *(replace(face, radius_mm=radius) for radius in sizes)]
    for faces in ((), *((each, TARGET.face("2")) for each in first)):
        refuses("E-TARGET-NOT-PUBLISHED … other", PublishedPattern, TargetDesign("other", "bright", faces))
    ids = [tuple({"2": "3", "3": "2"}.get(i, i) for i in each.ids) for each in TARGET.faces]
    turned = [replace(each, ids=own, x="2") for each, own in zip(TARGET.faces, ids, strict=True)]
    lines = PublishedPattern(TargetDesign("other", "bright", tuple(turned))).lines
    assert [*map(itemgetter(0), lines[0])] == ["3", "2"]  # the nearer one first


@pytest.fixture(scope="module")
def dots(sample):
    grey = decode((sample / "images/12/IMG_1000.jpg").read_bytes(), "sample")
    camera = read_camera(sample / "cameras.txt").calibrated(grey.shape[1], grey.shape[0])
    return Candidates(find_ellipses(grey, "bright", EllipseOptions()), camera), image_corners(camera)


def test_another_pitch_than_stated_is_named_with_the_true_ratio_and_a_grid_of_other_dots_is_not_the_board(dots):
    """Of the sample, 30 mm with radii of 7.5 mm; blur makes dots a little larger."""
    for factor in (0.52, 1.5, 3.0):
        board = replace(reference_board(), pitch_mm=30.0 * factor, corner=None)
        note = contradiction(dots[0], board, dots[1], find_boards(dots[0], board, dots[1]))
        assert float(note.partition("its pitch ")[2].partition(" times")[0]) == pytest.approx(4.0, rel=0.03)
    board = replace(reference_board(), rows=12, columns=14, pitch_mm=60.0, corner=None)
    tiny = replace(board, pitch_mm=0.5, radius_mm=0.1, unusual_size=True)  # as its file says
    small = replace(board, pitch_mm=1.0, radius_mm=0.06)  # smaller radii are tried than a file may state
    for other in (board, replace(reference_board(), corner=None), tiny, small):
        assert contradiction(dots[0], other, dots[1], []) == ""


def picture(size=(900, 1200), level=40):
    return np.full(size, level, np.uint8)


def add_ellipse(image, centre, axes, angle=0.0, value=200):
    """Anti-aliased: drawn eight times finer and averaged."""
    big = np.zeros((int(2 * max(axes)) + 12, int(2 * max(axes)) + 12))
    half = big.shape[0] // 2
    fine = np.zeros((big.shape[0] * 8,) * 2, np.uint8)
    cv2.ellipse(fine, (half * 8, half * 8), (int(axes[0] * 8), int(axes[1] * 8)), angle, 0, 360, 255, -1)
    share = cv2.resize(fine, big.shape[::-1], interpolation=cv2.INTER_AREA) / 255.0
    y, x = int(centre[1]) - half, int(centre[0]) - half
    patch = image[y : y + big.shape[0], x : x + big.shape[1]]
    patch[:] = np.round(patch + share * (float(value) - patch)).astype(np.uint8)
    return image


def test_circles_of_every_size_and_tilt_are_found_but_beyond_limits_and_faint_blobs():
    for polarity in ("bright", "dark"):
        for diameter in (8, 40, 400):
            level, value = (40, 200) if polarity == "bright" else (200, 40)
            image = add_ellipse(picture(level=level), (600, 450), (diameter / 2, diameter / 2), value=value)
            found = find_ellipses(cv2.GaussianBlur(image, (3, 3), 0.8), polarity, EllipseOptions())
            assert len(found) == 1
            assert np.linalg.norm(found.centre_px[0] - [600, 450]) < 0.02 * diameter + 1
            assert found.radius_px()[0] == pytest.approx(diameter / 2, rel=0.1, abs=0.8)
            assert found.contrast[0] == pytest.approx(160, abs=40)
    for tilt_deg in (30, 70):
        image = add_ellipse(picture(), (600, 450), (30, 30 * np.cos(np.radians(tilt_deg))), angle=35)
        found = find_ellipses(image, "bright", EllipseOptions())
        assert len(found) == 1
        axes = np.linalg.eigvalsh(found.shape_px[0])
        assert axes[0] / axes[1] == pytest.approx(np.cos(np.radians(tilt_deg)), abs=0.06)
    image = add_ellipse(add_ellipse(picture(), (300, 300), (10, 10)), (700, 500), (60, 60))
    add_ellipse(image, (1000, 300), (30, 30), value=48)
    found = find_ellipses(image, "bright", EllipseOptions(min_diameter_px=40))
    assert [round(r) for r in found.radius_px()] == [60]


def of_a_square_and_a_bar():
    image = picture()
    cv2.rectangle(image, (200, 200), (260, 260), 200, -1)
    return cv2.rectangle(image, (500, 200), (700, 215), 200, -1)


def test_what_is_no_circle_is_not_found_and_no_grey_image_of_the_camera_refused():
    for image, polarity in (
        (picture(), "bright"),
        (add_ellipse(picture(), (600, 450), (20, 20)), "dark"),
        (of_a_square_and_a_bar(), "bright"),
        (cv2.circle(picture(), (5, 400), 25, 200, -1), "bright"),
    ):
        assert len(find_ellipses(image, polarity, EllipseOptions())) == 0
    for image, error in (
        (checkerboard()[::2, ::2], "E-IMAGE-SIZE … 200×150 px, camera 400×300"),
        (np.dstack([checkerboard()] * 3), "E-IMAGE-TYPE … (300, 400, 3) … green"),
        (checkerboard() / 255, "E-IMAGE-TYPE … float64"),
    ):
        refuses(error, stage.detect_image, image, SMALL_CAMERA, reference_target(), None, EllipseOptions())


SMALL_CAMERA = Camera(400, 300, np.array([500.0, 500.0]), np.array([200.0, 150.0]), np.zeros(8))


def checkerboard(side: int = 6) -> np.ndarray:
    y, x = np.mgrid[: SMALL_CAMERA.height, : SMALL_CAMERA.width]
    return cv2.GaussianBlur((((x // side) + (y // side)) % 2 * 160 + 40).astype(np.uint8), (0, 0), 0.7)


@pytest.mark.slow
def test_of_a_fine_pattern_the_largest_outlines_are_tried_and_it_is_said(monkeypatch):
    monkeypatch.setattr(stage, "MAX_FREE", 30)
    found = stage.detect_image(checkerboard(), SMALL_CAMERA, reference_target(), reference_board(), EllipseOptions())
    assert found.candidates > 1000
    assert "the 30 largest were tried for faces; keep fine patterns out of view, or raise --min-d" in found.notes[0]
    assert found.boards == found.faces == ()


@pytest.mark.parametrize("value", [0.0, 1e308, np.nan])
@pytest.mark.parametrize(
    ("options", "name"), [*((EllipseOptions, name) for name in OPTION_RANGES), (PairOptions, "max_angle_rad")]
)
def test_options_have_ranges(options, name, value):
    refuses(f"{'E-OPTION-RANGE' if np.isfinite(value) else 'E-FIELD-TYPE'} … {name}", options, **{name: value})
