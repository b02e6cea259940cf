"""Drawings as a camera sees them: pages as images, and seen obliquely."""

import cv2
import numpy as np
from pypdfium2 import PdfDocument

from stcal.drawing.draw import POINT_MM, pdf
from stcal.geometry.camera import COEFFICIENTS, Camera

PER_MM = 4
"""With fewer, the letters beside a plate pass for circles seen from the side."""
FINE = 4
"""Pixels in which a page is drawn in a pixel of its image, along each side."""
OBLIQUE_RAD = np.radians(50)


def shapes_of(sheet) -> list:
    """All shapes of a page."""
    return [shape for item in sheet.placed for shape in item.shapes]


def page_image(sheet) -> np.ndarray:
    """The page, grey, as it is printed: pixels ``PER_MM`` a millimetre."""
    return pages_of(pdf([sheet]))[0]


def pages_of(content: bytes) -> list[np.ndarray]:
    """Pages of a PDF as another program draws them, grey."""
    scale, pages = PER_MM * POINT_MM, []
    for page in PdfDocument(content):
        whole = np.ceil(np.array(page.get_size()) * scale - 1e-3)  # else the page is stretched to whole pixels
        page.set_mediabox(0, 0, *(whole / scale).tolist())
        # PDFium moves the sides of rectangles to whole pixels: these are made small.
        fine = page.render(scale=FINE * scale * (1 - 1e-7), grayscale=True).to_numpy()
        pages.append(cv2.resize(fine, None, fx=1 / FINE, fy=1 / FINE, interpolation=cv2.INTER_AREA))
    return pages


def pixel_from_page(image: np.ndarray, xy_mm: np.ndarray) -> np.ndarray:
    """Places on a page in its image; centres of pixels are integers."""
    return PER_MM * np.asarray(xy_mm) * [1, -1] + [0, len(image)] - 0.5


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
