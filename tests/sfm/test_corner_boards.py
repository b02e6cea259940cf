"""Runs whose board is one of squares or tags: its corners are what the scale rests on."""

import cv2
import numpy as np
import pytest

from stcal import Camera, Rigid
from stcal.boards.board_designs import AprilGridDesign, CharucoDesign, ChessboardDesign, CornerBoard
from stcal.boards.board_file import board_toml, load_board, load_flat_board
from stcal.boards.dictionaries import dictionary_of
from stcal.labels import DotLabel
from stcal.sfm import compare, load_run, run
from stcal.sfm.detect.candidates import EllipseOptions
from stcal.sfm.detect.image import detect_image
from stcal.sfm.runs.run_options import require_dots
from stcal.synthetic import Scene, SceneOptions, make_scene, second_design
from stcal.synthetic.dataset import image_name, write_dataset
from stcal.synthetic.render import RenderOptions, render
from tests.boards.drawn import aprilgrid_mm, chessboard_mm
from tests.outcome import refuses

BOARDS = {
    "aprilgrid": AprilGridDesign(3, 4, 40.0, 0.25, 2),
    "chessboard": ChessboardDesign(6, 8, 25.0),
    "charuco": CharucoDesign(7, 9, 24.0, 18.0, "DICT_4X4_50"),
}
PER_MM = 5
SAMPLES = 4
"""Samples of a pixel along each axis."""
BLUR_PX, NOISE = 0.6, 1.5


def sheet_of(board) -> tuple[np.ndarray, np.ndarray]:
    """The printed sheet, ``PER_MM`` pixels a millimetre, and the place of the board's origin on it, mm."""
    if isinstance(board, AprilGridDesign):
        return aprilgrid_mm(board, board.border_bits, per_mm=PER_MM, margin=30.0)
    if isinstance(board, ChessboardDesign):
        sheet, origin = chessboard_mm(board.rows, board.columns, board.square_mm, PER_MM)
        return sheet, np.array([origin, origin])
    side, margin = round(board.square_mm * PER_MM), 24
    plain = cv2.aruco.CharucoBoard(
        (board.columns, board.rows), board.square_mm, board.marker_mm, dictionary_of(board.dictionary)
    )
    drawn = plain.generateImage((board.columns * side, board.rows * side))
    edge = margin * PER_MM
    return cv2.copyMakeBorder(drawn, *[edge] * 4, cv2.BORDER_CONSTANT, value=255), np.array([margin, margin], float)


def with_sheet(picture: np.ndarray, camera: Camera, camera_from_board: Rigid, board, seed: int) -> np.ndarray:
    """The picture with the sheet of the board in front of it: each pixel is the mean of the points that it sees."""
    sheet, origin = sheet_of(board)
    extent = np.array(sheet.shape[::-1]) / PER_MM
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * extent - origin
    box = camera.project(camera_from_board @ np.pad(corners, ((0, 0), (0, 1))))
    low = np.maximum(np.floor(box.min(0)).astype(int) - 3, 0)
    high = np.minimum(np.ceil(box.max(0)).astype(int) + 4, [camera.width, camera.height])
    x, y = (np.arange(a, b) for a, b in zip(low, high, strict=True))
    middles = camera.normalised_from_pixel(np.stack(np.meshgrid(x, y), axis=-1))
    ideal = cv2.resize(middles, None, fx=SAMPLES, fy=SAMPLES, interpolation=cv2.INTER_LINEAR)
    board_from_camera = camera_from_board.inverse()
    rays = np.concatenate([ideal, np.ones((*ideal.shape[:2], 1))], axis=2) @ board_from_camera.rotation.T
    depth = -board_from_camera.translation[2] / rays[..., 2]
    place = ((board_from_camera.translation + depth[..., None] * rays)[..., :2] + origin) * PER_MM - 0.5
    seen = cv2.remap(sheet, *np.moveaxis(place.astype(np.float32), 2, 0), cv2.INTER_LINEAR, borderValue=255)
    # The lens blurs before the sensor samples: blurred pixels would put edges along their rows 0.04 px off.
    seen = cv2.GaussianBlur(seen.astype(np.float32), (0, 0), BLUR_PX * SAMPLES)
    shape = (high[1] - low[1], SAMPLES, high[0] - low[0], SAMPLES)
    there = ((place > -0.5) & (place < np.array(sheet.shape[::-1]) - 0.5)).all(2).reshape(shape).mean((1, 3))
    light = 20 + 0.75 * seen.reshape(shape).mean((1, 3))
    part = picture[low[1] : high[1], low[0] : high[0]]
    mixed = there * light + (1 - there) * part + np.random.default_rng(seed).normal(0, NOISE * (there > 0))
    part[:] = np.clip(np.rint(mixed), 0, 255).astype(np.uint8)
    return picture


def scene_with(board, **options) -> Scene:
    target, _, *rough = second_design()
    return make_scene(SceneOptions(**options), target, CornerBoard.of(board), *rough)


def photograph(scene: Scene, board, group: str, image: int) -> np.ndarray:
    where = scene.groups[group]
    picture = render(scene, group, image, RenderOptions(clutter=False))
    camera_from_board = where.camera_from_target[image] @ where.target_from_board
    return with_sheet(picture, scene.camera, camera_from_board, board, image)


def nees_of(detection, scene: Scene, camera_from_board: Rigid) -> np.ndarray:
    """Normalised squared errors of the board's points, mean 1, in the better of the numberings that fit the image."""
    (sighting,) = detection.boards
    errors = []
    for cells in sighting.numberings:
        xyz = scene.board.places_mm([DotLabel(*cell) for cell in cells.tolist()])
        off = detection.centres.centre_px[sighting.rows] - scene.camera.project(camera_from_board @ xyz)
        weight = np.linalg.inv(detection.centres.covariance_px2[sighting.rows])
        errors.append(np.einsum("ni,nij,nj->n", off, weight, off) / 2)
    return min(errors, key=np.mean)


@pytest.mark.parametrize(("kind", "low"), [("aprilgrid", 0.4), ("chessboard", 0.4), ("charuco", 0.05)])
def test_corners_of_one_image_are_as_good_as_they_say(kind, low):
    board = BOARDS[kind]
    scene = scene_with(board, seed=5, width=864, height=576, images_per_group=2, groups=(("top", "left"),))
    where = scene.groups["top-left"]
    camera_from_board = where.camera_from_target[0] @ where.target_from_board
    picture = with_sheet(np.full((576, 864), 90, np.uint8), scene.camera, camera_from_board, board, 0)
    detection = detect_image(picture, scene.camera, scene.target, scene.board, EllipseOptions())
    assert 44 <= len(detection.boards[0].rows) <= len(scene.board.labels()) == 48
    assert len(detection.boards[0].numberings) == (2 if kind == "chessboard" else 1)
    # The mean of 96 squares has a σ of 0.14. The ChArUco board has 1.8 px of white beside its corners: edges alone do
    # not tell some of them, and the σ of a saddle covers what its shape leaves.
    assert low < nees_of(detection, scene, camera_from_board).mean() < 1.6
    assert not detection.faces
    assert detection.candidates - len(detection.boards[0].rows) < 6, (
        "outlines of the board's own squares are not tried as circles"
    )


def written(folder, text):
    path = folder / "board.toml"
    path.write_text(text)
    return path


def test_a_run_reads_every_kind_of_board_and_writes_it_as_it_was_but_what_is_none(tmp_path):
    """A gap in metres is no ratio, and the published method needs dots."""
    for text in (
        'type = "chessboard"\nrows = 6\ncolumns = 9\nsquare_mm = 25.4\nsigma_mm = 0.02\n',
        'type = "charuco"\nrows = 5\ncolumns = 7\nsquare_mm = 20\nmarker_mm = 15\ndictionary = "4X4_50"\n',
        'type = "aprilgrid"\nrows = 3\ncolumns = 4\ntag_mm = 30\nspacing = 0.3\nborder_bits = 1\nfirst_id = 7\n',
        "target_type: 'aprilgrid'\ntagCols: 6\ntagRows: 5\ntagSize: 0.088\ntagSpacing: 0.3\n",
        "target_type: checkerboard\ntargetCols: 6\ntargetRows: 7\nrowSpacingMeters: 0.06\ncolSpacingMeters: 0.06\n",
        'type = "tags"\nunusual_size = true\ntag = [{ dictionary = "tag36h11", id = 3, size_mm = 4000, x_mm = 1.5, '
        "y_mm = 0.3, angle_deg = 20 }]\n",
    ):
        board = load_board(written(tmp_path, text))
        flat = load_flat_board(tmp_path / "board.toml")
        np.testing.assert_allclose(board.places_mm(board.labels())[:, :2], flat.xy_mm(), atol=1e-12)
        assert len(set(board.labels())) == len(flat.xy_mm())
        again = load_board(written(tmp_path, board_toml(board)))
        assert again.labels() == board.labels()
        assert type(again.printed) is type(flat)
        np.testing.assert_allclose(again.xy_mm(), flat.xy_mm(), atol=1e-12)
    text = "target_type: 'aprilgrid'\ntagCols: 6\ntagRows: 6\ntagSize: 0.088\ntagSpacing: 0.0264\n"
    refuses("E-BOARD-SPACING … tagSpacing 0.0264 … 0.1 … 0.3", load_board, written(tmp_path, text))
    for option in ("--solve paper", "--compare paper"):
        board = CornerBoard.of(BOARDS["chessboard"])
        refuses(f"E-OPTION-CONFLICT … {option} … squares or tags", require_dots, board, option)


def test_points_are_numbered_by_rows_and_columns_and_both_ways_where_a_board_looks_the_same_turned():
    board = CornerBoard.of(AprilGridDesign(2, 3, 40.0, 0.25, 2))
    assert (board.rows, board.columns) == (4, 6)
    # The bottom left tag of Kalibr has its corners at (0, 0) to (40, -40) mm; a gap of 10 mm follows.
    assert np.unique(board.xy_mm()[:, 0]).tolist() == [0, 40, 50, 90, 100, 140]
    np.testing.assert_allclose(board.places_mm([DotLabel(3, 0), DotLabel(0, 5)]), [[0, 0, 0], [140, -90, 0]])
    both = CornerBoard.of(ChessboardDesign(3, 5, 10.0)).numberings(np.array([0, 1]))
    assert both.tolist() == [[[0, 0], [0, 1]], [[2, 4], [2, 3]]]
    assert len(CornerBoard.of(ChessboardDesign(4, 5, 10.0)).numberings(np.array([0]))) == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind", ["charuco", *(pytest.param(kind, marks=pytest.mark.full) for kind in BOARDS if kind != "charuco")]
)
def test_faces_beside_a_board_of_corners_are_right(tmp_path, no_page, kind):
    board = BOARDS[kind]
    scene = scene_with(board, seed=5, width=1728, height=1152, images_per_group=3)
    data = tmp_path / "data"
    write_dataset(data, scene, image_format="png")
    for group, where in scene.groups.items():
        for image in range(len(where.camera_from_target)):
            path = data / "images" / image_name(group, image, "png")
            cv2.imwrite(str(path), photograph(scene, board, group, image))
    result = run(data / "images", data / "cameras.txt", tmp_path / "run", data / "target.toml", data / "board.toml")
    assert result.judgement.verdict != "no"
    comparison = compare(tmp_path / "run", data / "truth.json").content()
    assert not comparison["missing"]
    errors = [row for face, row in comparison["faces"].items() if face != comparison["reference_face"]]
    assert len(errors) == 2
    for row in errors:
        assert row["normalised_error"] < 2.0
        assert row["translation_um"] < 15
    assert load_run(tmp_path / "run").board_design.labels() == scene.board.labels()
