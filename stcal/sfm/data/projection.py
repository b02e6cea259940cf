"""Images of a target's circles in many poses at once: centres of the ellipses and their derivatives."""

from dataclasses import dataclass

import numpy as np

from stcal.geometry.conic import circle_image_offset
from stcal.geometry.rigid import skew

NEAREST_MM = 1e-6
"""Lower bound of the depth. Behind the camera the numbers only have to be finite."""


@dataclass(frozen=True, slots=True, eq=False)
class CircleImages:
    """n circles in h poses, seen by an ideal camera of focal length 1.

    ``centre`` : (h, n, 2) centres of the ellipses, normalised coordinates; ``depth`` : (h, n) depth of the circles'
    centres, mm, zero or negative behind the camera, where all other values are meaningless; ``by_pose`` : (h, n, 2, 6)
    derivative of ``centre`` by the left perturbation of camera_from_target (rad, mm); ``by_circle`` : (h, n, 2, 3)
    derivative by the circles' centres in the target frame, per mm, normals fixed.
    """

    centre: np.ndarray
    depth: np.ndarray
    by_pose: np.ndarray
    by_circle: np.ndarray

    def of(self, rows) -> "CircleImages":
        """Returns the images in the poses of the indices or mask ``rows``."""
        return CircleImages(*(getattr(self, name)[rows] for name in self.__slots__))


def project_circles(
    xyz: np.ndarray, normal: np.ndarray, radius_mm: np.ndarray, rotation: np.ndarray, translation: np.ndarray
) -> CircleImages:
    """Project circles, centres (n, 3), normals (n, 3), radii (n,), target frame, mm, by h poses camera_from_target.

    ``rotation`` : (h, 3, 3); ``translation`` : (h, 3). The derivatives include the eccentricity of
    :func:`stcal.geometry.conic.circle_image_offset`.
    """
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
