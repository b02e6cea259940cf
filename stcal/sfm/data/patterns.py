"""Circles of the faces and the board by plane, and their visibility in an image for a given pose of the plane."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np

from stcal.design import BoardDesign, Polarity, TargetDesign
from stcal.geometry.arrays import frozen
from stcal.geometry.camera import Camera
from stcal.geometry.conic import circle_images, shape_of_square
from stcal.geometry.rigid import Rigid
from stcal.labels import BOARD, Label

MAX_TILT_RAD = np.radians(70.0)
"""Largest angle between a circle's normal and the line of sight. Circles seen more obliquely need not be found."""
RIM = np.stack([np.cos(np.arange(24) * np.pi / 12), np.sin(np.arange(24) * np.pi / 12)], axis=1)
BORDER_POINTS = 33


@dataclass(frozen=True, slots=True, eq=False)
class Pattern:
    """The n circles of one plane according to the design.

    ``plane`` : face id or ``board``; ``labels``; ``xy_mm`` : (n, 2); ``radius_mm`` : (n,); ``polarity``; ``side`` : 1
    if the circles are seen from the side that the plane's Z points to, −1 if they are seen from the other side.
    """

    plane: str
    labels: Sequence[Label]
    xy_mm: np.ndarray
    radius_mm: np.ndarray
    polarity: Polarity
    side: Literal[1, -1]

    def xyz_mm(self) -> np.ndarray:
        """Returns the centres, (n, 3), in the plane's frame."""
        return np.column_stack([self.xy_mm, np.zeros(len(self.xy_mm))])


def patterns_of(target: TargetDesign, board: BoardDesign | None) -> dict[str, Pattern]:
    """Returns the patterns of the faces and the board by name."""
    patterns = {f.id: Pattern(f.id, f.labels(), f.xy_mm, f.radius_mm, target.polarity, 1) for f in target.faces}
    if board is not None:  # its Z points into it
        patterns[BOARD] = Pattern(BOARD, board.labels(), board.xy_mm(), board.radii_mm(), board.polarity, -1)
    return patterns


def in_view(
    pattern: Pattern,
    camera_from_plane: Rigid,
    camera: Camera,
    border: np.ndarray,
    max_tilt_rad: float = MAX_TILT_RAD,
) -> np.ndarray:
    """Returns the mask of the circles that face the camera and lie in the image with their whole rim.

    ``border`` : result of :func:`ideal_border`; beyond this border a lens model may fold back.
    """
    axes = camera_from_plane.rotation
    xyz = camera_from_plane @ pattern.xyz_mm()
    cosine = -pattern.side * (xyz @ axes[:, 2]) / np.linalg.norm(xyz, axis=1)
    shown = (cosine > np.cos(max_tilt_rad)) & (xyz[:, 2] > pattern.radius_mm)
    if not shown.any():
        return shown
    rim = xyz[shown, None] + pattern.radius_mm[shown, None, None] * (RIM @ axes[:, :2].T)
    ideal = rim[..., :2] / rim[..., 2:]
    whole = ((ideal > border[0]) & (ideal < border[1])).all((1, 2))
    rim_px = camera.pixel_from_normalised(np.clip(ideal, *border))
    whole &= ((rim_px >= 0) & (rim_px <= [camera.width - 1, camera.height - 1])).all((1, 2))
    shown[shown] = whole
    return shown


def images_px(
    pattern: Pattern, camera_from_plane: Rigid, camera: Camera, circles: np.ndarray | slice = slice(None)
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the ellipses that the circles project to in the original image, px: centres (n, 2) and symmetric shapes
    (n, 2, 2). Lens distortion of the shapes is of first order."""
    xyz = camera_from_plane @ pattern.xyz_mm()[circles]
    centre, shape = circle_images(xyz, camera_from_plane.rotation[:, :2], pattern.radius_mm[circles])
    distorted, by_ideal = camera.distort_jacobian(centre)
    shape_px = camera.focal[:, None] * (by_ideal @ shape)
    return distorted * camera.focal + camera.centre, shape_of_square(shape_px @ np.swapaxes(shape_px, 1, 2))


@lru_cache(maxsize=8)
def ideal_border(camera: Camera) -> np.ndarray:
    """Returns the smallest and largest ideal coordinates along the image's border, (2, 2)."""
    t = np.linspace(0, 1, BORDER_POINTS)
    x, y = t * (camera.width - 1), t * (camera.height - 1)
    zero = np.zeros(BORDER_POINTS)
    sides = [(x, zero), (x, zero + camera.height - 1), (zero, y), (zero + camera.width - 1, y)]
    ideal = camera.normalised_from_pixel(np.concatenate([np.column_stack(side) for side in sides]))
    return frozen(np.stack([ideal.min(0), ideal.max(0)]))
