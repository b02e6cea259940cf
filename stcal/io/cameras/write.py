"""Writing of camera files, each of which is read again."""

from pathlib import Path

import numpy as np

from stcal.geometry.camera import Camera
from stcal.io.cameras.model import write_cameras_txt
from stcal.io.cameras.read import read_camera
from stcal.io.files import require_written

WRITTEN_PX = 1e-6
"""Largest difference of a projected point, px. Forms with few decimals, such as OpenCV's, round by 1e-8 px."""
ACROSS = 9
"""Number of points across the image, and down it, by which cameras are compared."""


def save_camera(path: str | Path, camera: Camera) -> None:
    """Write ``cameras.txt`` with one camera, its σ and correlations, and require that it is read as the same camera."""
    write_cameras_txt(path, camera)
    require_camera_written(path, camera)


def require_camera_written(path: str | Path, camera: Camera, name: str = "") -> None:
    """Read a written camera file again, and require that it projects points all over the image to the same pixels."""
    size = np.array([camera.width, camera.height])
    grid = np.stack(np.meshgrid(*2 * [np.linspace(0, 1, ACROSS)]), axis=-1) * size
    rays = camera.normalised_from_pixel(grid)
    rays = rays[np.isfinite(rays).all(axis=-1)]

    def again() -> np.ndarray:
        return read_camera(path, name).sized(*size).pixel_from_normalised(rays)

    require_written(path, again, camera.pixel_from_normalised(rays), WRITTEN_PX, "px")
