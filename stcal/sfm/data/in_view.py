"""Which circles of a plane an image shows, by the plane's pose."""

import numpy as np

from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid

MAX_TILT_RAD = np.radians(70.0)
"""Between a circle's normal and the line of sight; what is seen more obliquely need not be found."""
RIM = np.stack([np.cos(np.arange(24) * np.pi / 12), np.sin(np.arange(24) * np.pi / 12)], axis=1)
BORDER_POINTS = 33


def in_view(
    camera_from_plane: Rigid, xy_mm: np.ndarray, radius_mm: np.ndarray, side: int, camera: Camera, border: np.ndarray
) -> np.ndarray:
    """Mask of the circles that face the camera and lie in the image with their whole rim.

    ``side`` : 1 where the plane's Z is the side that the circles are seen from, −1 where it is the other;
    ``border`` : of :func:`ideal_border`; beyond it a lens model may fold back.
    """
    axes = camera_from_plane.rotation
    xyz = camera_from_plane @ np.column_stack([xy_mm, np.zeros(len(xy_mm))])
    cosine = -side * (xyz @ axes[:, 2]) / np.linalg.norm(xyz, axis=1)
    shown = (cosine > np.cos(MAX_TILT_RAD)) & (xyz[:, 2] > radius_mm)
    rim = xyz[shown, None] + radius_mm[shown, None, None] * (RIM @ axes[:, :2].T)
    ideal = rim[..., :2] / rim[..., 2:]
    whole = ((ideal > border[0]) & (ideal < border[1])).all((1, 2))
    rim_px = camera.pixel_from_normalised(np.clip(ideal, *border))
    whole &= ((rim_px >= 0) & (rim_px <= [camera.width - 1, camera.height - 1])).all((1, 2))
    shown[shown] = whole
    return shown


def ideal_border(camera: Camera) -> np.ndarray:
    """Least and largest ideal coordinates, (2, 2), along the image's border."""
    t = np.linspace(0, 1, BORDER_POINTS)
    x, y = t * (camera.width - 1), t * (camera.height - 1)
    zero = np.zeros(BORDER_POINTS)
    sides = [(x, zero), (x, zero + camera.height - 1), (zero, y), (zero + camera.width - 1, y)]
    ideal = camera.normalised_from_pixel(np.concatenate([np.column_stack(side) for side in sides]))
    return np.stack([ideal.min(0), ideal.max(0)])
