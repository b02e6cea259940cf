"""Drawings as a camera sees them: pages as images, and seen obliquely."""

import shutil
import subprocess

import cv2
import numpy as np
import pytest

from stcal.drawing.formats import INCH_MM, figure_of
from stcal.geometry.camera import COEFFICIENTS, Camera

PER_MM = 4
"""With fewer, the letters beside a plate pass for circles seen from the side."""
OBLIQUE_RAD = np.radians(50)


def shapes_of(sheet) -> list:
    """All shapes of a page."""
    return [shape for item in sheet.placed for shape in item.shapes]


def page_image(sheet, per_mm: int = PER_MM) -> np.ndarray:
    """The page, grey, as matplotlib fills it: pixels ``per_mm`` a millimetre."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    figure = figure_of(sheet)
    figure.set_dpi(INCH_MM * per_mm)
    for patch in figure.axes[0].patches:
        patch.set_snap(False)  # not to whole pixels
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., 1].copy()


def pdf_pages(path, folder, per_mm: int = PER_MM) -> list[np.ndarray]:
    """Pages of a PDF as another program draws them, grey."""
    if shutil.which("pdftoppm") is None:
        pytest.skip("pdftoppm is not installed")
    subprocess.run(["pdftoppm", "-gray", "-r", str(INCH_MM * per_mm), str(path), str(folder / "page")], check=True)
    return [cv2.imread(str(page), cv2.IMREAD_GRAYSCALE) for page in sorted(folder.glob("page-*.pgm"))]


def pixel_from_page(image: np.ndarray, xy_mm: np.ndarray, per_mm: int = PER_MM) -> np.ndarray:
    """Places on a page in its image; centres of pixels are integers."""
    return per_mm * np.asarray(xy_mm) * [1, -1] + [0, len(image)] - 0.5


def camera_of(image: np.ndarray) -> Camera:
    """One that sees the page as it is from the front."""
    height, width = image.shape
    focal = 1.5 * max(height, width)
    return Camera(width, height, [focal, focal], [(width - 1) / 2, (height - 1) / 2], np.zeros(COEFFICIENTS))


def obliquely(image: np.ndarray) -> tuple[np.ndarray, np.ndarray, Camera]:
    """The page turned about a slanted axis; the homography from its image, and the camera."""
    camera = camera_of(image)
    matrix = np.array([[camera.focal[0], 0, camera.centre[0]], [0, camera.focal[1], camera.centre[1]], [0, 0, 1]])
    turn = cv2.Rodrigues(OBLIQUE_RAD * np.array([0.6, 0.8, 0.0]))[0]
    turn[:, 2] = [0, 0, 1.0]  # the plane's points x, y at depth 1: columns 1 and 2 of the turn, then the shift
    homography = matrix @ turn @ np.linalg.inv(matrix)
    seen = cv2.warpPerspective(cv2.GaussianBlur(image, (0, 0), 0.7), homography, image.shape[::-1], borderValue=255)
    return seen, homography, camera
