"""The two poses that a plane seen from afar leaves (IPPE: Collins & Bartoli 2014, Infinitesimal plane-based pose
estimation, IJCV 109, sec. 3)."""

from dataclasses import dataclass

import numpy as np

from stcal.errors import DegenerateError
from stcal.geometry.plane import fit_homography, homography_jacobian
from stcal.geometry.rigid import Rigid, skew


@dataclass(frozen=True, slots=True, eq=False)
class PlanePoses:
    """Two poses camera_from_plane that agree with a homography about one point to first order.

    ``poses`` : both; ``determinant`` : of the homography's derivative at the point, normalised coordinates by units of
    the plane, squared; ``foreshortening`` : the same for a plane at unit distance that is looked at straight: the
    cosine of the angle between its normal and the line of sight, whatever its size and distance.
    """

    poses: tuple[Rigid, Rigid]
    determinant: float
    foreshortening: float


def poses_of_plane(xy_plane: np.ndarray, xy_normalised: np.ndarray) -> PlanePoses:
    """Both poses from n ≥ 4 points (n, 2) of a plane and their ideal normalised coordinates (n, 2).

    The homography is that of the normalised DLT, its derivative the one at the mean of the points. The frame of the
    plane has its Z away from the camera.

    Raises
    ------
    DegenerateError
        Points that fix no homography, or a plane that is seen edge-on or from behind.
    """
    xy, seen = np.asarray(xy_plane, float), np.asarray(xy_normalised, float)
    middle = xy.mean(0)
    homography = fit_homography(xy - middle, seen)
    jacobian = homography_jacobian(homography, np.zeros((1, 2)))[0]
    determinant = float(np.linalg.det(jacobian))
    if determinant <= 0:
        raise DegenerateError(
            "E-POINTS-MIRRORED", "plane: its points are seen mirrored; seen from behind, or numbered wrongly"
        )
    at = homography[:2, 2] / homography[2, 2]
    camera_from_sight = _turn_to(np.append(at, 1.0))
    # What a step of the plane is on a screen square to the line of sight, at unit distance.
    flat = np.linalg.solve(np.column_stack([np.eye(2), -at]) @ camera_from_sight[:, :2], jacobian)
    large, small = np.linalg.svd(flat, compute_uv=False)
    upper = flat / large
    rest = np.eye(2) - upper.T @ upper
    low = np.sqrt(np.maximum(np.diag(rest), 0)) * [1.0, -1.0 if rest[0, 1] < 0 else 1.0]
    poses = []
    for sign in (1.0, -1.0):
        first, second = np.append(upper[:, 0], sign * low[0]), np.append(upper[:, 1], sign * low[1])
        turn = np.column_stack([first, second, np.cross(first, second)])
        u, _, vt = np.linalg.svd(camera_from_sight @ turn)
        poses.append(_placed(u @ vt, xy, seen))
    return PlanePoses((poses[0], poses[1]), determinant, float(small / large))


def _turn_to(sight: np.ndarray) -> np.ndarray:
    """Rotation that takes Z to the direction ``sight``, the shortest way; it lies before the camera."""
    x, y, z = sight / np.linalg.norm(sight)
    cross = skew(np.array([-y, x, 0.0]))
    return np.eye(3) + cross + cross @ cross / (1 + z)


def _placed(rotation: np.ndarray, xy: np.ndarray, seen: np.ndarray) -> Rigid:
    """With the translation that fits the points best, linear in the depths."""
    turned = xy @ rotation[:, :2].T
    rows = np.zeros((len(xy), 2, 3))
    rows[:, 0, 0] = rows[:, 1, 1] = 1
    rows[:, :, 2] = -seen
    right = seen * turned[:, 2:] - turned[:, :2]
    return Rigid(rotation, np.linalg.lstsq(rows.reshape(-1, 3), right.ravel())[0])
