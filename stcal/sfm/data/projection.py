"""Images of the circles of a target in many poses at once: centres of the ellipses, and what moves them."""

from dataclasses import dataclass

import numpy as np

from stcal.geometry.conic import circle_image_offset
from stcal.geometry.rigid import skew

NEAREST_MM = 1e-6
"""Depth that stands for any that is smaller: behind the camera the numbers only have to be finite."""


@dataclass(frozen=True, slots=True, eq=False)
class CircleImages:
    """n circles in h poses, seen by an ideal camera of focal length 1.

    ``centre`` : (h, n, 2) of their ellipses, normalised coordinates; ``depth`` : (h, n) of the circles' centres, mm,
    not positive behind the camera, where nothing else means anything; ``by_pose`` : (h, n, 2, 6) by the left
    perturbation of camera_from_target (rad, mm); ``by_circle`` : (h, n, 2, 3) by the circles' centres in the target,
    per mm, normals held.
    """

    centre: np.ndarray
    depth: np.ndarray
    by_pose: np.ndarray
    by_circle: np.ndarray

    def of(self, rows) -> "CircleImages":
        """In those of the poses."""
        return CircleImages(*(getattr(self, name)[rows] for name in self.__slots__))


def project_circles(
    xyz: np.ndarray, normal: np.ndarray, radius_mm: np.ndarray, rotation: np.ndarray, translation: np.ndarray
) -> CircleImages:
    """Project circles (n, 3), (n, 3), (n,) of the target frame, mm, by h poses camera_from_target (h, 3, 3), (h, 3).

    The eccentricity is that of :func:`stcal.geometry.conic.circle_image_offset`, and is differentiated too.
    """
    back = np.swapaxes(rotation, 1, 2)
    turned, axis = xyz @ back, normal @ back
    centre = turned + translation[:, None]
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
    by_pose[..., :3] = -(by_centre @ skew(turned) + by_axis @ skew(axis))
    by_pose[..., 3:] = by_centre
    return CircleImages(image, depth, by_pose, by_centre @ rotation[:, None])
