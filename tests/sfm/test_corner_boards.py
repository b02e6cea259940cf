"""Runs whose board is one of squares or tags: its corners are what the scale rests on."""

import cv2
import numpy as np
import pytest

from stcal.boards.design import AprilGridDesign, CharucoDesign, ChessboardDesign, CornerBoard
from stcal.boards.dictionaries import dictionary_of
from stcal.boards.chessboard import find_chessboard
from stcal.boards.file import load_run_board, run_board_toml
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid
from stcal.labels import DotLabel
from stcal.sfm import run
from stcal.sfm.detect.circles.candidates import EllipseOptions
from stcal.sfm.detect.image import detect_image
from stcal.sfm.report.compare import compare
from stcal.sfm.runs.saved import load_run
from stcal.synthetic.dataset import image_name, write_dataset
from stcal.synthetic.render import RenderOptions, render
from stcal.synthetic.scene import Scene, SceneOptions, make_scene, second_design
from tests.boards.drawn import SHARPER, aprilgrid_mm, chessboard_mm
from tests.outcome import fails_with

BOARDS = {
    "aprilgrid": AprilGridDesign(3, 4, 40.0, 0.25, 2),
    "chessboard": ChessboardDesign(6, 8, 25.0),
    "charuco": CharucoDesign(7, 9, 24.0, 18.0, "DICT_4X4_50"),
}
PER_MM = 5
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
    step = (np.arange(SHARPER) + 0.5) / SHARPER - 0.5
    x, y = ((np.arange(a, b)[:, None] + step).ravel() for a, b in zip(low, high, strict=True))
    ideal = camera.normalised_from_pixel(np.stack(np.meshgrid(x, y), axis=-1))
    board_from_camera = camera_from_board.inverse()
    rays = np.concatenate([ideal, np.ones((*ideal.shape[:2], 1))], axis=2) @ board_from_camera.rotation.T
    depth = -board_from_camera.translation[2] / rays[..., 2]
    place = ((board_from_camera.translation + depth[..., None] * rays)[..., :2] + origin) * PER_MM - 0.5
    seen = cv2.remap(sheet, *np.moveaxis(place.astype(np.float32), 2, 0), cv2.INTER_LINEAR, borderValue=255)
    shape = (high[1] - low[1], SHARPER, high[0] - low[0], SHARPER)
    there = ((place > -0.5) & (place < np.array(sheet.shape[::-1]) - 0.5)).all(2).reshape(shape).mean((1, 3))
    light = cv2.GaussianBlur(20 + 0.75 * seen.reshape(shape).mean((1, 3)), (0, 0), BLUR_PX)
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


@pytest.mark.slow
@pytest.mark.parametrize("kind", BOARDS)
def test_faces_beside_a_board_of_corners_are_right(tmp_path, kind):
    board = BOARDS[kind]
    scene = scene_with(board, seed=5, width=1728, height=1152, images_per_group=4)
    data = tmp_path / "data"
    write_dataset(data, scene, image_format="png")
    for group, where in scene.groups.items():
        for image in range(len(where.camera_from_target)):
            path = data / "images" / image_name(group, image, "png")
            cv2.imwrite(str(path), photograph(scene, board, group, image))
    result = run(data / "images", data / "cameras.txt", tmp_path / "run", data / "target.toml", data / "board.toml")
    comparison = compare(tmp_path / "run", data / "truth.json").content()
    print(result.judgement)
    print(comparison)
