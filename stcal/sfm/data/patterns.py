"""Patterns of the faces and the board, and their projection into an image."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np

from stcal.design import BoardDesign, Polarity, TargetDesign
from stcal.errors import ConvergenceError, DegenerateError
from stcal.geometry.arrays import frozen
from stcal.geometry.camera import Camera
from stcal.geometry.plane import (
    camera_from_plane,
    circle_image_offset,
    circle_images,
    fit_homography,
    refine_planar_pose,
    shape_of_square,
)
from stcal.geometry.rigid import Rigid, skew
from stcal.labels import BOARD, Label

MAX_TILT_RAD = np.radians(70.0)
"""Largest angle between a circle's normal and the line of sight. Circles seen more obliquely need not be found."""
RIM = np.stack([np.cos(np.arange(24) * np.pi / 12), np.sin(np.arange(24) * np.pi / 12)], axis=1)
BORDER_POINTS = 33


@dataclass(frozen=True, slots=True, eq=False)
class Pattern:
    """The n circles of one plane according to the design."""

    plane: str  # face id or ``board``
    labels: Sequence[Label]
    xy_mm: np.ndarray  # (n, 2)
    radius_mm: np.ndarray  # (n,)
    polarity: Polarity
    side: Literal[1, -1]  # 1 if the circles are seen from the side that the plane's Z points to, else −1

    def xyz_mm(self) -> np.ndarray:
        """Returns the centres, (n, 3), in the plane's frame."""
        return np.column_stack([self.xy_mm, np.zeros(len(self.xy_mm))])


def patterns_of(target: TargetDesign, board: BoardDesign | None) -> dict[str, Pattern]:
    """Returns the patterns of the faces and the board by name."""
    patterns = {f.id: Pattern(f.id, f.labels(), f.xy_mm, f.radius_mm, target.polarity, 1) for f in target.faces}
    return patterns if board is None else patterns | pattern_of_board(board)


def pattern_of_board(board: BoardDesign) -> dict[str, Pattern]:
    """Returns the pattern of the board by its name. Its Z points into it."""
    return {BOARD: Pattern(BOARD, board.labels(), board.xy_mm(), board.radii_mm(), board.polarity, -1)}


def in_view(
    pattern: Pattern, camera_from_plane: Rigid, camera: Camera, border: np.ndarray, max_tilt_rad: float
) -> np.ndarray:
    """Returns the mask of the circles that face the camera and lie in the image with their whole rim; ``border`` : of
    :func:`ideal_border`, beyond which a lens model may fold back."""
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
    """Ellipses that circles project to, px: centres (n, 2), shapes (n, 2, 2) with distortion of first order."""
    xyz = camera_from_plane @ pattern.xyz_mm()[circles]
    centre, shape = circle_images(xyz, camera_from_plane.rotation[:, :2], pattern.radius_mm[circles])
    distorted, by_ideal = camera.distort_jacobian(centre)
    shape_px = camera.focal[:, None] * (by_ideal @ shape)
    return distorted * camera.focal + camera.centre, shape_of_square(shape_px @ np.swapaxes(shape_px, 1, 2))


@lru_cache(maxsize=8)
def ideal_border(camera: Camera) -> np.ndarray:
    """Returns the smallest and largest ideal coordinates along the image's border, (2, 2)."""
    t, last = np.linspace(0, 1, BORDER_POINTS), np.array([camera.width - 1, camera.height - 1])
    sides = [np.column_stack(side) for end in (0 * t, 0 * t + 1) for side in ((t, end), (end, t))]
    ideal = camera.normalised_from_pixel(np.concatenate(sides) * last)
    return frozen(np.stack([ideal.min(0), ideal.max(0)]))


def planar_pose(xy_mm: np.ndarray, xy: np.ndarray) -> Rigid | None:
    """Returns camera_from_plane by points of a plane, (n, 2), and their ideal images; None if these determine none."""
    try:
        return refine_planar_pose(camera_from_plane(fit_homography(xy_mm, xy)), xy_mm, xy)
    except (ConvergenceError, DegenerateError):
        return None


NEAREST_MM = 1e-6  # lower bound of the depth. Behind the camera the numbers only have to be finite.


@dataclass(frozen=True, slots=True, eq=False)
class CircleImages:
    """n circles in h poses, seen by an ideal camera of focal length 1."""

    centre: np.ndarray  # (h, n, 2) of the ellipses, normalised coordinates
    depth: np.ndarray  # (h, n) of the circles' centres, mm; where it is not positive, nothing else has a meaning
    by_pose: np.ndarray  # (h, n, 2, 6) by the left perturbation of camera_from_target (rad, mm)
    by_circle: np.ndarray  # (h, n, 2, 3) by the circles' centres in the target frame, per mm, normals fixed


def project_circles(
    xyz: np.ndarray, normal: np.ndarray, radius_mm: np.ndarray, rotation: np.ndarray, translation: np.ndarray
) -> CircleImages:
    """Projects circles, centres and normals (n, 3), radii (n,), target frame, mm, by h poses camera_from_target, (h, 3,
    3) and (h, 3); derivatives include the eccentricity."""
    back = np.swapaxes(rotation, 1, 2)
    rotated, axis = xyz @ back, normal @ back
    centre = rotated + translation[:, None]
    depth = centre[..., 2].copy()
    np.maximum(centre[..., 2], NEAREST_MM, out=centre[..., 2])
    point = circle_image_offset(centre, axis, radius_mm)
    per_depth = 1 / np.maximum(point[..., 2], NEAREST_MM)
    image = point[..., :2] * per_depth[..., None]
    by_point = np.zeros((*depth.shape, 2, 3))
    by_point[..., 0, 0] = by_point[..., 1, 1] = per_depth
    by_point[..., 2] = -image * per_depth[..., None]

    # point = C + q (n_z n − e_z) with q = r² / C_z
    per_z = 1 / centre[..., 2:]
    q = radius_mm[:, None] ** 2 * per_z
    by_centre = by_point.copy()
    by_centre[..., 2] -= (by_point @ ((point - centre) * per_z)[..., None])[..., 0]
    by_axis = (q * axis[..., 2:])[..., None] * by_point
    by_axis[..., 2] += q * (by_point @ axis[..., None])[..., 0]
    by_pose = np.empty((*depth.shape, 2, 6))
    by_pose[..., :3] = -(by_centre @ skew(rotated) + by_axis @ skew(axis))
    by_pose[..., 3:] = by_centre
    return CircleImages(image, depth, by_pose, by_centre @ rotation[:, None])


MIN_DOTS = 9  # smallest number of dots in an image that is used
