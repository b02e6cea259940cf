"""Boards rendered by area: each pixel holds the exact share of it that is black, then blur, noise and rounding.
Ellipses of circles in images, exact and as a detector with noise would measure their centres."""

from collections.abc import Sequence

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter

from stcal.boards.board_designs import SquaresOrTags, black_areas
from stcal.geometry.plane import apply_homography, circle_image_offset
from stcal.labels import DotLabel, Label
from stcal.synthetic.body_scene import covered_share
from stcal.synthetic.scene import MAX_FOUND_TILT_RAD, Scene, image_circles

FINE = 4  # pixels of the grid, along each axis of a pixel, on which blur is applied


def rendered(
    board: SquaresOrTags,
    image_from_mm: np.ndarray,
    size: tuple[int, int],
    rng: np.random.Generator,
    blur_px: float = 0.5,
    grey: tuple[float, float] = (20.0, 220.0),
    noise: float = 2.0,
) -> np.ndarray:
    """The board (mm) through a homography to pixels; Gaussian blur, ``grey`` values of black and white."""
    width, height = size
    fine = FINE if blur_px else 1
    areas = [[(apply_homography(image_from_mm, line) + 0.5) * fine for line in lines] for lines in black_areas(board)]
    black = covered_share(areas, (height * fine, width * fine)).astype(float)
    if blur_px:
        black = gaussian_filter(black, blur_px * fine).reshape(height, fine, width, fine).mean((1, 3))
    level = grey[1] + (grey[0] - grey[1]) * black + noise * rng.standard_normal((height, width))
    return np.clip(np.rint(level), 0, 255).astype(np.uint8)


def warped(
    sheet: np.ndarray,
    image_from_sheet: np.ndarray,
    size: tuple[int, int],
    rng: np.random.Generator,
    blur_px: float = 0.5,
    grey: tuple[float, float] = (20.0, 220.0),
    noise: float = 2.0,
) -> np.ndarray:
    """A drawn sheet by OpenCV's warp on the finer grid, averaged: its edges lie on pixels of the sheet, to 0.01 px."""
    from_image = np.array([[FINE, 0, (FINE - 1) / 2], [0, FINE, (FINE - 1) / 2], [0, 0, 1.0]])
    fine_size = (FINE * size[0], FINE * size[1])
    fine = cv2.warpPerspective(sheet, from_image @ image_from_sheet, fine_size, borderValue=255)
    seen = cv2.GaussianBlur(cv2.resize(fine, size, interpolation=cv2.INTER_AREA).astype(float), (0, 0), blur_px)
    level = grey[0] + (grey[1] - grey[0]) * seen / 255 + noise * rng.standard_normal(seen.shape)
    return np.clip(np.rint(level), 0, 255).astype(np.uint8)


def squares_nees(error: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Squares of errors (n, d) by their covariances (n, d, d), over d: 1 is expected."""
    return (error * np.linalg.solve(covariance, error[..., None])[..., 0]).sum(-1) / error.shape[-1]


def homography(camera_matrix: np.ndarray, rotation: np.ndarray, translation: Sequence[float]) -> np.ndarray:
    return camera_matrix @ np.column_stack([rotation[:, :2], translation])


def circle_conic(xyz_camera: np.ndarray, normal_camera: np.ndarray, radius_mm: float) -> np.ndarray:
    """Return the conic matrix Q (3, 3) of one circle's image.

    xᵀ Q x = 0 in normalised coordinates, and Q[0, 0] + Q[1, 1] > 0.
    """
    n = np.asarray(normal_camera, float)
    e1 = np.cross(n, [1.0, 0, 0] if abs(n[0]) < 0.9 else [0, 1.0, 0])
    e1 /= np.linalg.norm(e1)
    m = np.column_stack([e1, np.cross(n, e1), np.asarray(xyz_camera, float)])
    inverse = np.linalg.inv(m)
    q = inverse.T @ np.diag([1.0, 1.0, -(radius_mm**2)]) @ inverse
    return q * np.sign(q[0, 0] + q[1, 1])


def ellipse_of_conic(conic: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centre (2,) and shape (2, 2) of an ellipse; the rim is ``centre + shape @ unit circle``, shape symmetric."""
    q = conic[:2, :2]
    centre = -np.linalg.solve(q, conic[:2, 2])
    level = -(conic[2, 2] + conic[:2, 2] @ centre)
    value, vector = np.linalg.eigh(q / level)
    return centre, (vector / np.sqrt(value)) @ vector.T


def area_and_centroid(polygon: np.ndarray) -> tuple[float, np.ndarray]:
    """Of a polygon (n, 2), by Green's theorem."""
    middle = polygon.mean(0)
    p, q = polygon - middle, np.roll(polygon - middle, -1, axis=0)
    cross = p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]
    return abs(cross.sum()) / 2, middle + ((p + q) * cross[:, None]).sum(0) / (3 * cross.sum())


def simulate_centres(
    scene: Scene, group: str, image: int, noise_px: float, rng: np.random.Generator
) -> dict[Label, np.ndarray]:
    """Simulates measured ellipse centres of one image by label, (2,) px, as from a detector with this noise.

    A measurement is the centre of the ideal ellipse (not the image of the circle's centre), distorted by the lens, plus
    Gaussian noise of ``noise_px`` per axis. It covers circles of all faces with a tilt up to 70°, and all dots.
    """
    circles = image_circles(scene, group, image)
    ellipse_centre = scene.camera.project(
        circle_image_offset(circles.xyz_camera, circles.normal_camera, circles.radius_mm)
    )
    measured = ellipse_centre + noise_px * rng.standard_normal(ellipse_centre.shape)
    keep = (circles.tilt_rad <= MAX_FOUND_TILT_RAD) | np.array(
        [isinstance(label, DotLabel) for label in circles.labels]
    )
    return {label: xy for label, xy, k in zip(circles.labels, measured, keep, strict=True) if k}
