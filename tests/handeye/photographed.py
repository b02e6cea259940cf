"""Photographs of boards by a robot's camera, drawn, with the files that ``stcal handeye`` takes."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Poses, Rigid
from stcal.io.cameras.read import save_camera
from tests.boards.drawn import photograph
from tests.handeye.written import table
from tests.support.handeye import BASE_FROM_BOARD, FLANGE_FROM_CAMERA

BOARD = 'type = "chessboard"\nrows = 5\ncolumns = 8\nsquare_mm = 20\n'
CAMERA = Camera(800, 600, [1000, 1000], [406, 293], np.zeros(8))
PER_MM = 4
MARGIN_MM = 30.0


def sheet_of_dots(xy_mm: np.ndarray, radius_mm: np.ndarray) -> tuple[np.ndarray, float]:
    """The print with dark dots, and the place of the board's origin on it, mm."""
    width, height = ((xy_mm.max(0) + 2 * MARGIN_MM) * PER_MM).astype(int)
    sheet, shift = np.full((height, width), 255, np.uint8), 8
    for place, radius in zip(xy_mm, radius_mm, strict=True):
        # Pixel centres are integers: a place in mm is half a pixel more on the sheet.
        at = np.rint(((place + MARGIN_MM) * PER_MM - 0.5) * 2**shift).astype(int)
        cv2.circle(sheet, at.tolist(), round(radius * PER_MM * 2**shift), 0, -1, cv2.LINE_AA, shift)
    return sheet, MARGIN_MM


def take(sheet: np.ndarray, first_mm: float | np.ndarray, camera_from_board: Rigid) -> np.ndarray:
    """What :data:`CAMERA` sees of a sheet on which the board's origin is at (first_mm, first_mm)."""
    return photograph(sheet, PER_MM, image_from_sheet(first_mm, camera_from_board), (CAMERA.width, CAMERA.height))


def image_from_sheet(first_mm: float | np.ndarray, camera_from_board: Rigid) -> np.ndarray:
    """The homography, from millimetres on the sheet."""
    turn, place = camera_from_board.rotation, camera_from_board.translation
    matrix = np.array([[CAMERA.focal[0], 0, CAMERA.centre[0]], [0, CAMERA.focal[1], CAMERA.centre[1]], [0, 0, 1]])
    x, y = np.broadcast_to(first_mm, 2)
    off = np.array([[1, 0, -x], [0, 1, -y], [0, 0, 1]])
    image = matrix @ np.column_stack([turn[:, :2], place]) @ off
    return image / image[2, 2]


def looks(rng: np.random.Generator, count: int, middle_mm: np.ndarray, roll: float) -> Poses:
    """camera_from_board about 450 mm before the middle of the board, tilted by up to 0.45, rolled by up to ``roll``."""
    tilt = rng.uniform(-0.45, 0.45, (count, 2))
    turn = Rotation.from_rotvec(np.pad(tilt, ((0, 0), (0, 1)))) * Rotation.from_rotvec(
        np.outer(rng.uniform(-roll, roll, count), [0, 0, 1])
    )
    at = rng.uniform(-1, 1, (count, 3)) * [30, 20, 40] + [0, 0, 450]
    return Poses(turn.as_matrix(), at - turn.apply(np.append(middle_mm, 0)))


@dataclass(frozen=True, slots=True)
class Photographs:
    """Files: ``images`` folder, ``poses`` CSV, ``camera``, ``board`` TOML."""

    images: Path
    poses: Path
    camera: Path
    board: Path

    def arguments(self) -> list[str]:
        options = [("--poses", self.poses), ("--camera", self.camera), ("--board", self.board)]
        return [str(self.images), *(str(word) for pair in options for word in pair)]


def photographs(folder: Path, sheet: np.ndarray, first_mm: float, seen: Poses, board_toml: str) -> Photographs:
    """Eye-in-hand, without errors of the robot."""
    found = Photographs(*(folder / name for name in ("images", "poses.csv", "cameras.txt", "board.toml")))
    found.images.mkdir()
    base_from_flange = BASE_FROM_BOARD @ seen.inverse() @ FLANGE_FROM_CAMERA.inverse()
    for i, pose in enumerate(seen):
        cv2.imwrite(str(found.images / f"{i}.png"), take(sheet, first_mm, pose))
    table(found.poses, {"base_from_flange": base_from_flange}, image=[f"{i}.png" for i in range(len(seen))])
    save_camera(found.camera, Camera.of(CAMERA, "PINHOLE"))
    found.board.write_text(board_toml)
    return found
