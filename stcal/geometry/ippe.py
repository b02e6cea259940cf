"""The two candidate poses of a plane seen from afar (IPPE: Collins & Bartoli 2014, Infinitesimal plane-based pose
estimation, IJCV 109, sec. 3)."""

from dataclasses import dataclass

import numpy as np

from stcal.errors import DegenerateError
from stcal.geometry.plane import fit_homography, homography_jacobian
from stcal.geometry.rigid import Rigid, skew


@dataclass(frozen=True, slots=True, eq=False)
class PlanePoses:
    """The two poses camera_from_plane that agree with a homography about one point to first order.

    ``poses`` : both poses; ``determinant`` : determinant of the homography's derivative at the point, in (normalised
    coordinates per unit of the plane)²; ``foreshortening`` : cosine of the angle between the plane's normal and the
    line of sight, independent of the size and distance of the plane.
    """

    poses: tuple[Rigid, Rigid]
    determinant: float
    foreshortening: float


def poses_of_plane(xy_plane: np.ndarray, xy_normalised: np.ndarray) -> PlanePoses:
    """Return both poses from n ≥ 4 points (n, 2) of a plane and their ideal normalised coordinates (n, 2).

    The homography is computed by the normalised DLT, its derivative at the mean of the points. The Z axis of the plane
    points away from the camera.

    Raises
    ------
    DegenerateError
        The points do not determine a homography, or the plane is seen edge-on or from behind.
    """
    xy, xy_image = np.asarray(xy_plane, float), np.asarray(xy_normalised, float)
    middle = xy.mean(0)
    homography = fit_homography(xy - middle, xy_image)
    jacobian = homography_jacobian(homography, np.zeros((1, 2)))[0]
    determinant = float(np.linalg.det(jacobian))
    if determinant <= 0:
        raise DegenerateError(
            "E-POINTS-MIRRORED", "plane: its points are seen mirrored; seen from behind, or numbered wrongly"
        )
    sight_point = homography[:2, 2] / homography[2, 2]
    camera_from_sight = _turn_to(np.append(sight_point, 1.0))
    # Derivative of the projection onto a screen perpendicular to the line of sight, at unit distance.
    flat = np.linalg.solve(np.column_stack([np.eye(2), -sight_point]) @ camera_from_sight[:, :2], jacobian)
    large, small = np.linalg.svd(flat, compute_uv=False)
    upper = flat / large
    remainder = np.eye(2) - upper.T @ upper
    low = np.sqrt(np.maximum(np.diag(remainder), 0)) * [1.0, -1.0 if remainder[0, 1] < 0 else 1.0]
    poses = []
    for sign in (1.0, -1.0):
        first, second = np.append(upper[:, 0], sign * low[0]), np.append(upper[:, 1], sign * low[1])
        turn = np.column_stack([first, second, np.cross(first, second)])
        u, _, vt = np.linalg.svd(camera_from_sight @ turn)
        poses.append(_placed(u @ vt, xy, xy_image))
    return PlanePoses((poses[0], poses[1]), determinant, float(small / large))


def _turn_to(sight: np.ndarray) -> np.ndarray:
    """Return the smallest rotation that takes Z to the direction ``sight``, which points forwards (z > 0)."""
    x, y, z = sight / np.linalg.norm(sight)
    cross = skew(np.array([-y, x, 0.0]))
    return np.eye(3) + cross + cross @ cross / (1 + z)


def _placed(rotation: np.ndarray, xy: np.ndarray, seen: np.ndarray) -> Rigid:
    """Return the pose with this rotation and the translation that fits the points best (linear least squares)."""
    turned = xy @ rotation[:, :2].T
    rows = np.zeros((len(xy), 2, 3))
    rows[:, 0, 0] = rows[:, 1, 1] = 1
    rows[:, :, 2] = -seen
    right = seen * turned[:, 2:] - turned[:, :2]
    return Rigid(rotation, np.linalg.lstsq(rows.reshape(-1, 3), right.ravel())[0])
