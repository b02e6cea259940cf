"""Photographs of a chessboard by two cameras on one flange, drawn, with RIG.toml."""

from pathlib import Path

import cv2
import numpy as np

from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Poses, Rigid
from stcal.io.cameras.model import write_cameras_txt
from stcal.io.table import POSE, pose_cells
from tests.boards.drawn import chessboard_mm
from tests.handeye.photographed import CAMERA, looks, take
from tests.support.handeye import BASE_FROM_BOARD, FLANGE_FROM_CAMERA, disturbed

BOARD = 'type = "chessboard"\nrows = 5\ncolumns = 8\nsquare_mm = 20\n'
LEFT_FROM = {"left": Rigid(), "right": Rigid.exp([0.02, -0.22, 0.05, 60.0, 8.0, 6.0])}
MISSING = {"left": (), "right": (1,)}
"""Poses of which a camera has no image."""


def photographed_rig(folder: Path, count: int = 8, robot: tuple[float, float] = (4e-4, 0.12)) -> Path:
    """The rig's file; ``robot`` : σ (rad, mm) of its poses, which are called 00, 01 … as the images are."""
    rng = np.random.default_rng(2)
    seen = looks(rng, count, np.array([70.0, 40.0]), 0.6)
    flange = BASE_FROM_BOARD @ seen.inverse() @ FLANGE_FROM_CAMERA.inverse()
    reported = disturbed(rng, flange, *robot)
    write_poses(folder / "robot.csv", {f"{i:02d}": pose for i, pose in enumerate(reported)})
    (folder / "board.toml").write_text(BOARD)
    write_cameras_txt(folder / "cameras.txt", Camera.of(CAMERA, "PINHOLE"))
    sheet, lines = chessboard_mm(5, 8, 20.0), ['setup = "eye-in-hand"', 'board = "board.toml"', 'poses = "robot.csv"']
    for name, pose in LEFT_FROM.items():
        (folder / name).mkdir()
        views = Poses.of([(FLANGE_FROM_CAMERA @ pose).inverse()] * count) @ flange.inverse() @ BASE_FROM_BOARD
        for i in set(range(count)) - set(MISSING[name]):
            cv2.imwrite(str(folder / name / f"{i:02d}.png"), take(*sheet, views[i]))
        lines += ["[[camera]]", f'name = "{name}"', f'images = "{name}"', 'camera = "cameras.txt"']
    (folder / "rig.toml").write_text("\n".join(lines) + "\n")
    return folder / "rig.toml"


def write_poses(path: Path, poses: dict[str, Rigid], column: str = "image") -> None:
    rows = [",".join([column, *(f"base_from_flange_{c}" for c in POSE)])]
    rows += [",".join([name, *pose_cells(pose)]) for name, pose in poses.items()]
    path.write_text("\n".join(rows) + "\n")
