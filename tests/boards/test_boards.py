"""Boards and tags drawn in perspective, out of focus, partly hidden and turned: every corner where the drawing puts it,
with σ that say how well."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from PIL import Image

from stcal.boards.board_designs import UNIT_SQUARE, CharucoDesign, ChessboardDesign, TagLayout
from stcal.boards.finders import find_charuco, find_chessboard
from stcal.boards.tags import find_tags, view_of_tags
from stcal.geometry.camera import Camera
from stcal.geometry.plane import apply_homography
from stcal.io.cameras.camera_model import camera_from_opencv
from stcal.io.images import find_images
from stcal.workflows.board_views import detect_boards, find_board
from tests.boards.drawn import IMAGE_FROM_MM, chessboard_mm, photograph
from tests.levels import sampled

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
    ("printed", "declared", "said"),
    [
        (CHARUCO, replace(CHARUCO, rows=10, columns=9), "rows = 9, columns = 10; correct"),
        (EVEN, replace(EVEN, legacy=True), "rows = 10, columns = 8, legacy = false"),
        (replace(EVEN, legacy=True), EVEN, "rows = 10, columns = 8, legacy = true"),
    ],
    ids=["turned", "not legacy", "legacy"],
)
def test_a_wrong_file_is_told_what_fits(printed, declared, said):
    view, why = find_board(photograph(sheet_of(printed), PER_MM, IMAGE_FROM_MM), "a", CAMERA, declared)
    assert view is None
    assert said in why


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
