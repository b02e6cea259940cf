"""Rigs before boards of every kind: photographs drawn pixel by pixel, and the pose between the cameras by truth."""

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from stcal.boards.design import AprilGridDesign, AsymmetricCirclesDesign, HexagonalCirclesDesign
from stcal.design import BoardDesign, TargetDesign
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid
from stcal.workflows.calibrate_camera import calibrate_rig
from tests.boards.drawn import aprilgrid_mm, photograph
from tests.levels import sampled

CAMERAS = {
    "left": Camera(800, 600, [880.0, 883.0], [397.0, 302.0], np.zeros(12)),
    "right": Camera(800, 600, [920.0, 920.0], [405.0, 297.0], np.zeros(12)),
}
RIGHT_FROM_LEFT = Rigid.exp([0.02, -0.12, 0.05, -80.0, 4.0, 6.0])
INSTANTS, FINER, MARGIN_MM, HOLE = 10, 2, 25.0, 0.4
RINGS = ((1, 2), (1, 3), (4, 1))
NONE = TargetDesign("none", "dark", ())
SHEET_PER_MM = 4


def of_circles(board, camera: Camera, pose: Rigid, rng) -> np.ndarray:
    """Each pixel from where its ray meets the board."""
    xy, y_x = board.xy_mm(), (np.mgrid[: camera.height * FINER, : camera.width * FINER] + 0.5) / FINER - 0.5
    y, x = y_x
    rays = np.column_stack([camera.normalised_from_pixel(np.column_stack([x.ravel(), y.ravel()])), np.ones(x.size)])
    normal = pose.rotation[:, 2]
    met = ((rays * (normal @ pose.translation / (rays @ normal))[:, None]) - pose.translation) @ pose.rotation
    on_board = ((met[:, :2] > xy.min(0) - MARGIN_MM) & (met[:, :2] < xy.max(0) + MARGIN_MM)).all(1)
    off, nearest = cKDTree(xy).query(met[:, :2])
    ring = np.isin(np.arange(len(xy)), [row * board.columns + place for row, place in board.rings])
    dark = (off < board.radii_mm()[0]) & ~(ring[nearest] & (off < HOLE * board.radii_mm()[0]))
    grey = np.where(on_board & ~dark, 220.0, 40.0).reshape(x.shape)
    small = cv2.resize(grey, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    small = cv2.GaussianBlur(small, (0, 0), 0.7) + rng.normal(0, 1.5, small.shape)
    return np.clip(small, 0, 255).astype(np.uint8)


def of_tags(board: AprilGridDesign, camera: Camera, pose: Rigid) -> np.ndarray:
    sheet, origin = aprilgrid_mm(board, 1, per_mm=SHEET_PER_MM)
    board_from_sheet = np.array([[1, 0, -origin[0]], [0, 1, -origin[1]], [0, 0, 1.0]])
    plane = np.column_stack([pose.rotation[:, :2], pose.translation])
    matrix = np.array([[camera.focal[0], 0, camera.centre[0]], [0, camera.focal[1], camera.centre[1]], [0, 0, 1]])
    return photograph(sheet, SHEET_PER_MM, matrix @ plane @ board_from_sheet, (camera.width, camera.height))


BOARDS = {
    "hexagonal, odd": HexagonalCirclesDesign(7, 8, 22.0, 6.5, "dark"),
    "hexagonal, even": HexagonalCirclesDesign(8, 8, 22.0, 6.5, "dark"),
    "hexagonal, rings": HexagonalCirclesDesign(8, 8, 22.0, 6.5, "dark", rings=RINGS),
    "asymmetric, rings": AsymmetricCirclesDesign(8, 4, 20.0, 7.0, "dark", rings=RINGS),
    "dots, rings": BoardDesign(7, 8, 22.0, 6.5, "dark", 0.005, rings=RINGS),
    "AprilGrid": AprilGridDesign(3, 4, 32.0, 0.25),
}


@pytest.mark.parametrize("name", sampled(BOARDS, (2, 5)))
def test_the_pose_between_the_cameras(tmp_path, name):
    """Centres to 0.02 px and corners to 0.1 px; the error is tested over its own σ."""
    board, rng = BOARDS[name], np.random.default_rng(3)
    xy = board.xy_mm()
    middle = np.append((xy.min(0) + xy.max(0)) / 2, 0.0)
    for camera_name in CAMERAS:
        (tmp_path / camera_name).mkdir()
    for instant in range(INSTANTS):
        angles = [rng.uniform(-180, 180), *rng.uniform(-28, 28, 2)]
        turn = Rotation.from_euler("zxy", angles, degrees=True).as_matrix()
        place = np.array([40.0, 0, 430.0]) + rng.uniform(-1, 1, 3) * [18, 15, 40]
        left_from_board = Rigid(turn, place - turn @ middle)
        for camera_name, from_left in (("left", Rigid()), ("right", RIGHT_FROM_LEFT)):
            camera, pose = CAMERAS[camera_name], from_left @ left_from_board
            tags = isinstance(board, AprilGridDesign)
            image = of_tags(board, camera, pose) if tags else of_circles(board, camera, pose, rng)
            cv2.imwrite(str(tmp_path / camera_name / f"{instant:03}.png"), image)
    rig = calibrate_rig(tmp_path, NONE, board, "PINHOLE", workers=1)
    assert rig.names == ("left", "right")
    assert max(rig.alone_rms_px) < 0.12
    off = (rig.camera_from_first[1] @ RIGHT_FROM_LEFT.inverse()).log()
    chi2 = float(off @ np.linalg.solve(rig.covariance[1], off))
    assert chi2 < 35  # of six degrees of freedom, exceeded once in 200 000
    assert np.degrees(np.linalg.norm(off[:3])) < 0.2
    assert np.linalg.norm(off[3:]) < 1.0
