"""Boards and tags drawn in perspective, out of focus, partly hidden and turned: every corner where the drawing puts it,
with σ that say how well. AprilGrids as Kalibr prints them. Hexagonal grids of circles: views drawn by their definition,
each pixel from where its ray meets the board."""

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest
from PIL import Image
from scipy.spatial import cKDTree

from stcal.boards.board_designs import (
    UNIT_SQUARE,
    AprilGridDesign,
    CharucoDesign,
    ChessboardDesign,
    HexagonalCirclesDesign,
    TagLayout,
)
from stcal.boards.finders import find_charuco, find_chessboard
from stcal.boards.tags import find_aprilgrid, find_tags, view_of_tags
from stcal.geometry.camera import Camera
from stcal.geometry.plane import apply_homography
from stcal.geometry.rigid import Rigid
from stcal.io.cameras.camera_model import camera_from_opencv
from stcal.io.images import find_images
from stcal.workflows import board_views
from stcal.workflows.board_views import detect_boards, find_board
from tests.boards.drawn import IMAGE_FROM_MM, aprilgrid_mm, chessboard_mm, photograph
from tests.levels import sampled
from tests.support.areas import squares_nees

CORNER_PX = 0.12
"""cv2 warps in steps of 1/32 px, here of a third; blur and 1.5 grey values of noise do the rest (0.08 px seen)."""


def turn(degrees: float) -> np.ndarray:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    about = np.array([[1, 0, 600], [0, 1, 450], [0, 0, 1.0]])
    return about @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ np.linalg.inv(about) @ IMAGE_FROM_MM


def errors_px(board: ChessboardDesign, view, image_from_mm: np.ndarray, first: float) -> list[float]:
    """Largest errors by each numbering that looks the same, the smallest first."""
    flat = np.pad(board.xy_mm(), ((0, 0), (0, 1)))
    numberings = [flat[:, :2]] + [(turned @ flat)[:, :2] for turned in board.symmetries()]
    return sorted(np.abs(apply_homography(image_from_mm, xy + first) - view.xy_px).max() for xy in numberings)


@pytest.mark.parametrize(
    ("rows", "columns", "degrees"),
    sampled(
        [(*size, degrees) for size in ((5, 8), (6, 6), (6, 7), (7, 7), (6, 8)) for degrees in (170, 0, 90, -100)],
        kept=(0, 5, 10, 15, 17),
    ),
)
def test_chessboard_corners_are_numbered(rows, columns, degrees):
    board = ChessboardDesign(rows, columns, 20.0)
    sheet, first = chessboard_mm(rows, columns, 20.0)
    image_from_mm = turn(degrees)
    view = find_chessboard(photograph(sheet, 4, image_from_mm), "a", board)
    errors = errors_px(board, view, image_from_mm, first)
    assert errors[0] < CORNER_PX
    assert all(error > 20 for error in errors[1:])  # another numbering, not the same
    assert len(errors) == {(5, 8): 1, (6, 7): 1, (7, 7): 2, (6, 6): 4, (6, 8): 2}[rows, columns]


def spoiled(grey: np.ndarray, blur_px: float, contrast: float, noise: float) -> np.ndarray:
    """Out of focus, dim and noisy."""
    seen = cv2.GaussianBlur(grey.astype(float), (0, 0), blur_px) if blur_px else grey.astype(float)
    noisy = 40 + contrast * seen + np.random.default_rng(1).normal(0, noise, seen.shape)
    return np.clip(noisy, 0, 255).astype(np.uint8)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("blur_px", "contrast", "noise", "enlarged"),
    [(4.0, 0.8, 2.0, 1), (0.0, 0.4, 15.0, 1), (0.0, 0.08, 2.0, 1), (8.0, 0.8, 3.0, 3)],
)
def test_chessboards_out_of_focus_dim_and_noisy(blur_px, contrast, noise, enlarged):
    """σ of a corner by the gradients of its window, noise / (rise · √pixels): below 0.1 px in all; three times that,
    and of the large image, whose grey values stem from fewer pixels, as much in pixels before it was enlarged."""
    board = ChessboardDesign(5, 8, 20.0)
    sheet, first = chessboard_mm(5, 8, 20.0)
    image_from_mm = turn(20)
    grey = photograph(sheet, 4, image_from_mm)
    size = (enlarged * grey.shape[1], enlarged * grey.shape[0])
    larger = cv2.resize(grey, size, interpolation=cv2.INTER_CUBIC)
    view = find_chessboard(spoiled(larger, blur_px, contrast, noise), "a", board)
    true = enlarged * (apply_homography(image_from_mm, board.xy_mm() + first) + 0.5) - 0.5
    error = np.linalg.norm(true - view.xy_px, axis=1)
    assert np.sqrt((error**2).mean()) < 0.3 * enlarged


@pytest.mark.slow
def test_a_steep_chessboard_is_found():
    """65° off its normal, seen from 1.2 m: squares of 17 × 8 px at the far edge."""
    board = ChessboardDesign(6, 9, 20.0)
    sheet, first = chessboard_mm(6, 9, 20.0)
    middle = first + 20 * np.array([4, 2.5])
    tilt, away = np.radians(65), 1200.0
    turned = np.array([[1, 0], [0, np.cos(tilt)], [0, np.sin(tilt)]])
    eye = np.column_stack([turned, np.array([0, 0, away]) - turned @ middle])
    image_from_mm = np.array([[1500.0, 0, 599.5], [0, 1500.0, 449.5], [0, 0, 1]]) @ eye
    view = find_chessboard(photograph(sheet, 4, image_from_mm), "a", board)
    assert errors_px(board, view, image_from_mm, first)[0] < 3 * CORNER_PX


def test_tags_of_two_families_and_sizes_and_one_seen_twice_which_is_left_out():
    families = ("DICT_6X6_250", "DICT_APRILTAG_36h11")
    places = {(families[0], 3): (60, 50, 40), (families[1], 3): (150, 60, 30), (families[0], 9): (80, 130, 50)}
    sheet = np.full((200 * 4, 220 * 4), 255, np.uint8)
    corners = []
    for (name, tag), (x, y, size) in places.items():
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
        drawn = cv2.aruco.generateImageMarker(dictionary, tag, size * 4)
        left, top = 4 * x - 2 * size, 4 * y - 2 * size
        sheet[top : top + 4 * size, left : left + 4 * size] = drawn
        corners.append(size * UNIT_SQUARE + [x, y])
    layout = TagLayout(tuple(places), np.array(corners))
    tags = find_tags(photograph(sheet, 4, IMAGE_FROM_MM), families)
    assert set(tags.tags) == set(places)
    view = view_of_tags("a", tags, layout)
    error = apply_homography(IMAGE_FROM_MM, view.xyz_board[:, :2]) - view.xy_px
    assert np.abs(error).max() < CORNER_PX
    # squared errors over their covariance; the image has one noise, and corners of 3 tags are 24 numbers
    square = np.einsum("ki,kij,kj->k", error, np.linalg.inv(view.covariance_px2), error).sum() / error.size
    assert 0.2 < square < 4.0
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    tag = cv2.copyMakeBorder(cv2.aruco.generateImageMarker(dictionary, 7, 160), 40, 40, 40, 40, 0, value=255)
    sheet = np.hstack([tag, tag])
    found = find_tags(photograph(sheet, 2, IMAGE_FROM_MM), ["DICT_4X4_50"])
    assert len(found) == 0
    assert found.repeated == (("DICT_4X4_50", 7),)


@pytest.mark.parametrize("spread", [1, pytest.param(200, marks=pytest.mark.slow)])
def test_nothing_in_an_empty_or_noisy_image(spread):
    grey = np.random.default_rng(2).integers(40, 40 + spread, (400, 600)).astype(np.uint8)
    assert find_chessboard(grey, "a", ChessboardDesign(5, 8, 20.0)) is None
    assert find_charuco(grey, "a", CharucoDesign(7, 5, 30.0, 20.0, "DICT_6X6_250")) is None
    assert len(find_tags(grey, ["DICT_6X6_250"])) == 0


@pytest.mark.slow
def test_all_corners_of_a_real_charuco_board(shared_data):
    """24 corners in each of 16 real images, of which every fourth is read here; OpenCV's own settings lose 28 %."""
    board = CharucoDesign(7, 5, 36.195, 18.256, "DICT_6X6_250")
    images = sorted(shared_data("charuco_handeye/test_set_charuco/images").glob("*.png"))[::4]
    views = [find_charuco(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), path.name, board) for path in images]
    assert list(map(len, views)) == [24] * 4


CHARUCO = CharucoDesign(9, 10, 20.0, 16.0, "DICT_4X4_250")
"""The white around its tags is a tenth of a square wide: 5 px in the view."""
EVEN = replace(CHARUCO, rows=10, columns=8)
PER_MM, MARGIN_MM = 4, 20.0
CAMERA = Camera(1200, 900, [1440.0, 1440.0], [599.5, 449.5], np.zeros(8))


def sheet_of(board: CharucoDesign) -> np.ndarray:
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    plain = cv2.aruco.CharucoBoard((board.columns, board.rows), board.square_mm, board.marker_mm, dictionary)
    plain.setLegacyPattern(board.legacy)
    side = board.square_mm * PER_MM
    sheet = plain.generateImage((round(board.columns * side), round(board.rows * side)))
    return cv2.copyMakeBorder(sheet, *[round(MARGIN_MM * PER_MM)] * 4, cv2.BORDER_CONSTANT, value=255)


@pytest.fixture(scope="module")
def sharp() -> np.ndarray:
    return photograph(sheet_of(CHARUCO), PER_MM, IMAGE_FROM_MM)


def charuco_errors_px(view) -> np.ndarray:
    return np.linalg.norm(apply_homography(IMAGE_FROM_MM, view.xyz_board[:, :2] + MARGIN_MM) - view.xy_px, axis=1)


@pytest.mark.parametrize(("blur_px", "most_px"), [(0.0, 0.1), (1.5, 0.15), (2.5, 0.2), (3.0, 0.2)])
def test_corners_out_of_focus(sharp, blur_px, most_px):
    """Blur moves no corner of a symmetric pattern. Windows of 3 px that stay clear of the tags, as OpenCV's, are off by
    2 px and more from a blur of 2.5 px on; noise is 1.5 of 200 grey values."""
    seen = cv2.GaussianBlur(sharp, (0, 0), blur_px) if blur_px else sharp
    view = find_charuco(seen, "a", CHARUCO)
    error = charuco_errors_px(view)
    assert len(view) > 40
    assert np.percentile(error, 95) < most_px
    assert error.max() < 2 * most_px
    sigma = np.sqrt(np.trace(view.covariance_px2, axis1=1, axis2=2) / 2)
    assert np.median(error / sigma) < 2.4  # twice the median length of two coordinates


def test_blurred_corners_have_larger_sigma_and_a_hidden_one_is_left_out(sharp):
    """The right half out of focus; and under a grey rectangle with a checkered edge, from which no corner is taken."""
    seen, middle = sharp.copy(), 600
    seen[:, middle:] = cv2.GaussianBlur(sharp, (0, 0), 3.0)[:, middle:]
    view = find_charuco(seen, "a", CHARUCO)
    sigma, right = np.sqrt(np.trace(view.covariance_px2, axis1=1, axis2=2) / 2), view.xy_px[:, 0] > middle + 10
    assert np.median(sigma[right]) > 1.5 * np.median(sigma[~right])
    hidden = sharp.copy()
    whole = find_charuco(sharp, "a", CHARUCO)
    x, y = np.rint(whole.xy_px[len(whole) // 2]).astype(int)
    hidden[y - 60 : y + 8, x - 60 : x + 8] = 120
    view = find_charuco(hidden, "a", CHARUCO)
    assert len(view) > 0.8 * len(whole)
    assert charuco_errors_px(view).max() < 1.0
    wrong = replace(CAMERA, focal=[500.0, 500.0])  # no camera changes the corners
    assert np.array_equal(find_board(sharp, "a", wrong, CHARUCO)[0].xy_px, whole.xy_px)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("printed", "declared"),
    [
        (CHARUCO, replace(CHARUCO, rows=10, columns=9)),
        (EVEN, replace(EVEN, legacy=True)),
        (replace(EVEN, legacy=True), EVEN),
    ],
    ids=["turned", "not legacy", "legacy"],
)
def test_a_wrong_file_is_told(printed, declared):
    view, why = find_board(photograph(sheet_of(printed), PER_MM, IMAGE_FROM_MM), "a", CAMERA, declared)
    assert view is None
    assert "not where rows, columns and legacy of its file put them" in why


PLAIN = ChessboardDesign(5, 7, 20.0)
WIDTH, HEIGHT = 400, 300


def flat_photograph() -> np.ndarray:
    squares = np.kron(np.indices((6, 8)).sum(axis=0) % 2, np.ones((30, 30))) * 180 + 40
    image = np.full((HEIGHT, WIDTH), 220.0)
    image[60:240, 80:320] = squares
    return cv2.GaussianBlur(image, (0, 0), 1.0).astype(np.uint8)


@pytest.mark.slow
@pytest.mark.parametrize("size", [(0, 0), (WIDTH, HEIGHT)])
@pytest.mark.parametrize("orientation", [1, 6])
def test_one_turned_photograph_in_front_drops_itself_alone(tmp_path, size, orientation):
    """EXIF says of 6 how to turn it back, and of 1 nothing."""
    grey = flat_photograph()
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(np.rot90(grey).copy()).save(tmp_path / "0.png", exif=exif)
    for i in range(1, 6):
        cv2.imwrite(str(tmp_path / f"{i}.png"), grey)
    files, _ = find_images(tmp_path)
    model = camera_from_opencv([500, 500, 199.5, 149.5], np.zeros(0), False, *size)
    found = detect_boards(files, model, PLAIN, workers=1)
    turned_back = orientation == 6
    assert (found.camera.width, found.camera.height) == (WIDTH, HEIGHT)
    assert len(found.views()) == 5 + turned_back
    assert [each.name for each in found.skipped] == ([] if turned_back else ["0.png"])
    if turned_back:
        turned, upright = (found.views()[name].xy_px for name in ("0.png", "1.png"))
        # The board looks the same after half a turn, and OpenCV's detector begins at either end.
        same_end = np.linalg.norm(turned[0] - upright[0]) < np.linalg.norm(turned[0] - upright[-1])
        np.testing.assert_allclose(turned, upright if same_end else upright[::-1], atol=1e-9)
    else:
        assert "sides swapped" in found.skipped[0].reason


FAR = Camera(1200, 900, [1500, 1500], [600, 450], np.zeros(8))
GRID = AprilGridDesign(3, 4, 30.0, 0.3)


@cache
def photographed(board: AprilGridDesign, border: int, squares: bool = True) -> tuple[np.ndarray, np.ndarray]:
    sheet, origin = aprilgrid_mm(board, border, squares)
    image = photograph(sheet, 4, IMAGE_FROM_MM)
    image.flags.writeable = False  # several tests share it
    return image, origin


def off_px(view, origin) -> np.ndarray:
    return apply_homography(IMAGE_FROM_MM, view.xyz_board[:, :2] + origin) - view.xy_px


@pytest.mark.slow
@pytest.mark.parametrize(
    ("border", "squares", "upright", "stated"),
    [(2, True, False, None), (1, True, False, None), (1, False, False, 1), (2, True, True, 2)],
)
def test_every_corner_is_where_it_was_drawn(border, squares, upright, stated):
    board = replace(GRID, upright=upright, border_bits=stated)
    image, origin = photographed(board, border, squares)
    view, why = find_aprilgrid(image, "a", board, FAR)
    assert (len(view), why, view.unused) == (48, "", ())
    off = off_px(view, origin)
    assert np.abs(off).max() < CORNER_PX
    # squared errors over their covariance, 96 numbers of one noise
    assert 0.2 < squares_nees(off, view.covariance_px2).mean() < 4.0


def test_the_frame_is_kalibrs_turned_about_x():
    """Tag 0 bottom left, ids along the row, then upwards; a tag's corners begin at its bottom right (Kalibr's turn)."""
    xy = GRID.xy_mm().reshape(3, 4, 4, 2)
    step = 30.0 * 1.3
    assert np.allclose(xy[0, 0], [[30, 0], [0, 0], [0, -30], [30, -30]])
    assert np.allclose(xy[0, 1] - xy[0, 0], [step, 0])
    assert np.allclose(xy[1, 0] - xy[0, 0], [0, -step])


@pytest.mark.slow
def test_a_border_that_is_not_the_boards_is_said_and_a_part_is_enough():
    image, _ = photographed(GRID, 1)
    view, why = find_aprilgrid(image, "a", replace(GRID, border_bits=2), FAR)
    assert view is None
    assert "no tag of the AprilGrid: DICT_APRILTAG_36h11, border of 2 cells" in why
    image, origin = photographed(GRID, 2)
    hidden = image.copy()
    hidden[:, :560] = 230
    view, _ = find_aprilgrid(hidden, "a", GRID, FAR)
    assert 8 <= len(view) < 48
    assert np.abs(off_px(view, origin)).max() < CORNER_PX


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"upright": True}, "turned by half a turn; write upright = false into its file"),
        ({"columns": 3, "rows": 4}, "12 tags of the AprilGrid, but not where rows, columns and spacing put them"),
        ({"first_id": 100}, "tag 0 of DICT_APRILTAG_36h11, none of 100 … 111 of the AprilGrid"),
        ({"dictionary": "DICT_APRILTAG_25h9"}, "no tag of the AprilGrid: DICT_APRILTAG_25h9, border of 1 or 2 cells"),
    ],
)
def test_why_there_is_none(changed, said):
    image, _ = photographed(GRID, 2)
    view, why = find_aprilgrid(image, "a", replace(GRID, **changed), FAR)
    assert view is None
    assert said in why


@pytest.mark.slow
def test_a_stranger_is_named_and_left_out():
    """A tag beside the board that is none of it, and one of its own on a slip of paper in the wrong place."""
    board = replace(GRID, rows=2)
    image, origin = photographed(GRID, 2)  # the third row is none of the board
    view, _ = find_aprilgrid(image, "a", board, FAR)
    assert len(view) == 32
    assert view.unused == tuple(f"tag {tag} is none of its 8" for tag in range(8, 12))
    assert np.abs(off_px(view, origin)).max() < CORNER_PX
    sheet, (x, y) = aprilgrid_mm(GRID, 2, squares=False)
    bottom, left = round(4 * y), round(4 * x)
    slip = sheet[bottom - 120 : bottom, left : left + 120].copy()
    sheet[bottom - 120 : bottom, left : left + 120] = 255
    sheet[bottom - 80 : bottom + 40, left - 40 : left + 80] = slip  # 10 mm to the left and down
    view, _ = find_aprilgrid(photograph(sheet, 4, IMAGE_FROM_MM), "a", GRID, FAR)
    assert view.unused == ("tag 0 lies off the board's plane",)
    assert len(view) == 44


@pytest.mark.slow
def test_corners_lie_on_edges_that_the_lens_curves(monkeypatch):
    """Straight lines along curved edges meet beside the corners, all of them farther out or in: a bias, not a noise."""
    board, lens = AprilGridDesign(3, 4, 60.0, 0.3), replace(FAR, distortion=np.array([-0.3, 0.1, 0, 0, 0, 0, 0, 0]))
    image_from_mm = np.array([[2.9, -0.2, 60.0], [0.1, 2.8, 40.0], [0, 0, 1.0]])
    sheet, origin = aprilgrid_mm(board, 1)
    ideal = photograph(sheet, 4, image_from_mm)
    grid = np.stack(np.meshgrid(np.arange(1200.0), np.arange(900.0)), axis=-1).reshape(-1, 2)
    source = FAR.pixel_from_normalised(lens.normalised_from_pixel(grid)).astype(np.float32).reshape(900, 1200, 2)
    image = cv2.remap(ideal, source[..., 0], source[..., 1], cv2.INTER_CUBIC, borderValue=255)
    straight, _ = find_aprilgrid(image, "a", board, lens)
    monkeypatch.setattr(board_views, "find_aprilgrid", lambda *_: (straight, ""))
    bias = []
    for view in (straight, board_views.find_board(image, "a", lens, board)[0]):
        true = apply_homography(image_from_mm, view.xyz_board[:, :2] + origin)
        off = view.xy_px - lens.pixel_from_normalised(FAR.normalised_from_pixel(true))
        tags = view.xy_px.reshape(-1, 4, 2)
        outwards = (tags - tags.mean(1, keepdims=True)).reshape(-1, 2)
        bias.append(float(np.mean((off * outwards).sum(1) / np.linalg.norm(outwards, axis=1))))
    assert abs(bias[1]) < 0.25 * abs(bias[0])


NEAR = Camera(800, 600, [900.0, 905.0], [390.0, 305.0], np.zeros(12))
FINER, AROUND_MM = 2, 25.0
TILTS = [(0.0, 0.0, 0.1), (0.5, 0.0, 0.3), (0.0, 0.6, -1.2), (0.3, -0.4, 2.5)]


def view_of(
    board: HexagonalCirclesDesign, tilt, hidden_from_mm=(np.inf, np.inf), hole: float = 0.4
) -> tuple[np.ndarray, Rigid]:
    """A grey image, and camera_from_board; what lies beyond ``hidden_from_mm`` along X and Y is covered. Rings have a
    hole of ``hole`` times their radius."""
    xy = board.xy_mm()
    turn = Rigid.exp([*tilt, 0, 0, 0]).rotation
    middle = np.append((xy.min(0) + xy.max(0)) / 2, 0.0)
    pose = Rigid(turn, np.array([0, 0, 470.0]) - turn @ middle)
    y, x = (np.mgrid[: NEAR.height * FINER, : NEAR.width * FINER] + 0.5) / FINER - 0.5
    xy_px = np.column_stack([x.ravel(), y.ravel()])
    rays = np.pad((xy_px - NEAR.centre) / NEAR.focal, ((0, 0), (0, 1)), constant_values=1.0)
    normal = turn[:, 2]
    met = ((rays * (normal @ pose.translation / (rays @ normal))[:, None]) - pose.translation) @ turn
    on_board = ((met[:, :2] > xy.min(0) - AROUND_MM) & (met[:, :2] < xy.max(0) + AROUND_MM)).all(1)
    away, nearest = cKDTree(xy).query(met[:, :2], distance_upper_bound=1.01 * board.radius_mm)
    in_hole = np.isin(nearest, [row * board.columns + place for row, place in board.rings])
    in_hole &= away < hole * board.radius_mm
    grey = np.where(on_board & ((away > board.radius_mm) | in_hole), 220.0, 40.0)
    grey[(met[:, :2] > hidden_from_mm).all(1)] = 130.0
    small = cv2.resize(grey.reshape(x.shape), (NEAR.width, NEAR.height), interpolation=cv2.INTER_AREA)
    noise = np.random.default_rng(0).normal(0, 1.5, small.shape)
    return np.clip(cv2.GaussianBlur(small, (0, 0), 0.7) + noise, 0, 255).astype(np.uint8), pose


def test_six_neighbours_are_one_spacing_away_and_a_covered_strip_is_said():
    board = HexagonalCirclesDesign(5, 6, 20.0, 6.0, "dark")
    for xy in (board.xy_mm(), board.lattice().xy_mm()):
        apart = np.linalg.norm(xy[:, None] - xy, axis=2)
        assert np.isclose(apart[14], 20.0).sum() == 6
        assert np.sort(apart[14])[7] == pytest.approx(20 * np.sqrt(3))
    lattice = board.lattice()
    np.testing.assert_allclose(lattice.xy_mm() - lattice.xy_mm()[0], board.xy_mm() - board.xy_mm()[0], atol=1e-12)
    np.testing.assert_allclose(lattice.places_mm(lattice.labels())[:, :2], lattice.xy_mm(), atol=1e-12)
    # Of a covered strip it is open which columns are seen: they are all alike.
    board = HexagonalCirclesDesign(9, 8, 20.0, 6.0, "dark")
    view, why = find_board(view_of(board, TILTS[1], (112.0, -np.inf))[0], "a", NEAR, board)
    assert view is None
    assert "strip of the board is hidden" in why


@pytest.mark.parametrize(("rows", "tilt"), sampled([(r, t) for r in (7, 8) for t in TILTS], kept=(1, 7)))
def test_a_view_has_its_circles_where_they_are(rows, tilt):
    """An even number of rows looks the same after half a turn, an odd one does not."""
    board = HexagonalCirclesDesign(rows, 8, 20.0, 6.0, "dark")
    image, pose = view_of(board, tilt)
    view, why = find_board(image, "a", NEAR, board)
    assert view is not None, why
    assert len(view) == 8 * rows
    turned = [Rigid(), *board.symmetries()]
    assert len(turned) == 2 - rows % 2
    off = [view.xy_px - NEAR.project(pose @ (turn @ view.xyz_board)) for turn in turned]
    nearest = min(off, key=np.max)
    assert np.abs(nearest).max() < 0.06  # px; noise of 1.5 grey levels of 180
    in_sigma = np.einsum("ni,nij,nj->n", nearest, np.linalg.inv(view.covariance_px2), nearest) / 2
    assert 0.4 < in_sigma.mean() < 2.5


END_RINGS, COLUMN_RINGS = ((1, 2), (1, 3), (4, 6)), ((2, 1), (5, 3))


@pytest.mark.parametrize(
    ("rows", "rings", "hole", "tilt", "hidden_from_mm", "least", "most"),
    [
        (9, (), 0.4, TILTS[1], (100.0, 80.0), 56, 67),  # a covered corner is no harm
        (9, COLUMN_RINGS, 0.4, TILTS[1], (112.0, -np.inf), 41, 55),  # rings tell which columns are seen
        *sampled(
            [(8, END_RINGS, share, tilt, (np.inf, np.inf), 61, 64) for share in (0.35, 0.6) for tilt in TILTS[1:]],
            kept=(2,),
        ),  # an even number of rows looks the same turned, but for its rings
    ],
)
def test_covered_boards_and_rings_are_numbered_as_they_are(rows, rings, hole, tilt, hidden_from_mm, least, most):
    board = HexagonalCirclesDesign(rows, 8, 20.0, 6.0, "dark", rings=rings)
    image, pose = view_of(board, tilt, hidden_from_mm, hole)
    view, why = find_board(image, "a", NEAR, board)
    assert view is not None, why
    assert board.symmetries() == []
    assert least <= len(view) <= most
    assert np.abs(view.xy_px - NEAR.project(pose @ view.xyz_board)).max() < 0.06
