"""The example target drawn as a camera without distortion sees it."""

import cv2
import numpy as np

from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid
from stcal.locate.layout import TargetLayout
from tests.boards.drawn import photograph
from tests.support.tags import example_layout

CAMERA = Camera(1200, 900, [1300.0, 1300.0], [599.5, 449.5], np.zeros(8))
PER_MM = 6
SHEET_MM = np.array([220.0, 200.0])
LAYOUT = example_layout(sigma_mm=0.02, sigma_px=0.05)


def sheet(layout: TargetLayout = LAYOUT) -> np.ndarray:
    """The target as printed, its origin in the middle."""
    white = np.full((SHEET_MM[::-1] * PER_MM).astype(int), 255, np.uint8)
    for (name, tag), corners in zip(layout.tags, layout.corners_mm, strict=True):
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
        left, top = np.rint((corners[0] + SHEET_MM / 2) * PER_MM).astype(int)
        side = int(np.rint((corners[1, 0] - corners[0, 0]) * PER_MM))
        white[top : top + side, left : left + side] = cv2.aruco.generateImageMarker(dictionary, tag, side)
    return white


def photo(camera_from_obj: Rigid, printed: np.ndarray | None = None, camera: Camera = CAMERA) -> np.ndarray:
    matrix = np.array([[camera.focal[0], 0, camera.centre[0]], [0, camera.focal[1], camera.centre[1]], [0, 0, 1]])
    origin = camera_from_obj @ np.array([*-SHEET_MM / 2, 0.0])
    image_from_mm = matrix @ np.column_stack([camera_from_obj.rotation[:, :2], origin])
    return photograph(sheet() if printed is None else printed, PER_MM, image_from_mm, (camera.width, camera.height))


def tilted(degrees: float, depth_mm: float = 500.0) -> Rigid:
    """Turned about Y, in the middle of the image."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return Rigid(np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]), [5.0, -3.0, depth_mm])
