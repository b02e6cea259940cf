"""Ellipses of circles in images, exact and as a detector with noise would measure their centres."""

import numpy as np

from stcal.geometry.plane import circle_image_offset
from stcal.labels import DotLabel, Label
from stcal.synthetic.scene import MAX_FOUND_TILT_RAD, Scene, image_circles


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
