"""Planes, plane-to-plane homographies, and poses of planar patterns."""

from dataclasses import dataclass

import numpy as np

from stcal.errors import DegenerateError
from stcal.geometry.arrays import Array, freeze
from stcal.geometry.least_squares import NormalEquations, minimise, perturbed
from stcal.geometry.rigid import Rigid, skew

MAX_STEPS = 100
EXACT = 1e-22
"""What the last step of a pose may promise, in squared normalised coordinates: a hundred-billionth of the distance."""


@dataclass(frozen=True, slots=True, eq=False)
class Plane:
    """The plane ``normal · xyz = offset``; ``rms`` is the spread of the fitted points about it.

    ``normal`` : (3,) unit vector; ``offset``, ``rms`` : in the unit of the points.
    """

    normal: Array
    offset: float
    rms: float

    def __post_init__(self):
        freeze(self, "normal", (3,), "plane normal")

    def distance(self, xyz: np.ndarray) -> np.ndarray:
        """Signed distances, (n,), of points (n, 3)."""
        return np.asarray(xyz, float) @ self.normal - self.offset

    def project(self, xyz: np.ndarray) -> np.ndarray:
        """Foot points on the plane, same shape as ``xyz``."""
        return xyz - np.multiply.outer(self.distance(xyz), self.normal)


def fit_plane(xyz: np.ndarray, towards: np.ndarray | None = None) -> Plane:
    """Total-least-squares plane through (n, 3) points, normal on the side of direction ``towards``.

    Raises
    ------
    DegenerateError
        Fewer than three points, or collinear ones.
    """
    normal, offset, rms = fit_planes(np.asarray(xyz, float)[None], towards)
    return Plane(normal[0], float(offset[0]), float(rms[0]))


def fit_planes(xyz: np.ndarray, towards: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """:func:`fit_plane` of each of k sets of points, (k, n, 3): normals (k, 3), offsets (k,) and spreads (k,)."""
    n = xyz.shape[1]
    if n < 3:
        raise DegenerateError(f"plane: {n} points, 3 needed")
    mean = xyz.mean(1)
    _, s, vt = np.linalg.svd(xyz - mean[:, None], full_matrices=False)
    if (s[:, 1] <= 1e-9 * s[:, 0]).any():
        raise DegenerateError("plane: the points are collinear; points off the line are needed")
    normal = vt[:, 2]
    if towards is not None:
        normal = np.where((normal @ towards < 0)[:, None], -normal, normal)
    return normal, (normal * mean).sum(1), s[:, 2] / np.sqrt(n)


def fit_homography(xy_b: np.ndarray, xy_a: np.ndarray) -> np.ndarray:
    """3×3 homography a_from_b from n ≥ 4 point pairs, (n, 2): normalised DLT (Hartley & Zisserman, alg. 4.2).

    Raises
    ------
    DegenerateError
        Fewer than four pairs, or three of the four on a line.
    """
    b, a = np.asarray(xy_b, float), np.asarray(xy_a, float)
    if len(b) < 4:
        raise DegenerateError(f"homography: {len(b)} point pairs, 4 needed")

    def normaliser(p):
        x, y = mean = p.sum(0) / len(p)
        scale = np.sqrt(2) / max(np.sqrt(((p - mean) ** 2).sum(1)).sum() / len(p), 1e-300)
        return np.array([[scale, 0, -scale * x], [0, scale, -scale * y], [0, 0, 1]])

    na, nb = normaliser(a), normaliser(b)
    a = a @ na[:2, :2].T + na[:2, 2]
    b = b @ nb[:2, :2].T + nb[:2, 2]
    rows = np.zeros((2 * len(b), 9))
    rows[0::2, 0:2], rows[0::2, 2] = b, 1
    rows[1::2, 3:5], rows[1::2, 5] = b, 1
    rows[0::2, 6:8], rows[0::2, 8] = -a[:, :1] * b, -a[:, 0]
    rows[1::2, 6:8], rows[1::2, 8] = -a[:, 1:] * b, -a[:, 1]
    _, s, vt = np.linalg.svd(rows, full_matrices=len(b) == 4)
    # Three of four on a line in both planes leave it open; in one plane only, they force a singular matrix.
    if s[7] < 1e-9 * s[0] or np.linalg.cond(vt[8].reshape(3, 3)) > 1e9:
        raise DegenerateError("homography: the points do not determine it (three of four on a line)")
    h = np.linalg.inv(na) @ vt[8].reshape(3, 3) @ nb
    return h / np.linalg.norm(h) * np.sign(h[2] @ [*np.asarray(xy_b, float)[0], 1.0])


def apply_homography(a_from_b: np.ndarray, xy_b: np.ndarray) -> np.ndarray:
    """Map points (..., 2)."""
    xy_b = np.asarray(xy_b, float)
    mapped = xy_b @ a_from_b[:, :2].T + a_from_b[:, 2]
    return mapped[..., :2] / mapped[..., 2:]


def homography_jacobian(a_from_b: np.ndarray, xy_b: np.ndarray) -> np.ndarray:
    """Jacobians of :func:`apply_homography`, (n, 2, 2), at points (n, 2)."""
    xy_b = np.asarray(xy_b, float)
    mapped = xy_b @ a_from_b[:, :2].T + a_from_b[:, 2]
    w = mapped[:, 2, None, None]
    return (a_from_b[:2, :2] - mapped[:, :2, None] / w * a_from_b[2, :2]) / w


def camera_from_plane(normalised_from_plane: np.ndarray) -> Rigid:
    """Pose of a plane with a metric frame from its homography into normalised image coordinates.

    Zhang (2000), closed form: the first two columns are the plane's axes up to scale. The pattern lies in
    front of the camera (positive depth of the plane's origin where the homography has that sign).
    """
    h = np.asarray(normalised_from_plane, float)
    h = h / np.sqrt(np.linalg.norm(h[:, 0]) * np.linalg.norm(h[:, 1]))
    if h[2, 2] < 0:
        h = -h
    u, _, vt = np.linalg.svd(np.column_stack([h[:, 0], h[:, 1], np.cross(h[:, 0], h[:, 1])]))
    return Rigid(u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt, h[:, 2])


def refine_planar_pose(camera_from_plane: Rigid, xy_plane: np.ndarray, xy_normalised: np.ndarray) -> Rigid:
    """Pose of least reprojection error of a plane's points.

    Parameters
    ----------
    camera_from_plane : Rigid
        To start from, mm.
    xy_plane : (n, 2) array
        Points in the plane's frame, mm.
    xy_normalised : (n, 2) array
        Their ideal normalised image coordinates.

    Returns
    -------
    Rigid
        camera_from_plane.

    Raises
    ------
    DegenerateError
        At the start, points lie behind the camera.
    ConvergenceError
        No minimum is reached.
    """
    xyz = np.column_stack([xy_plane, np.zeros(len(xy_plane))])

    def linearise(pose: Rigid) -> NormalEquations:
        rotated = xyz @ pose.rotation.T
        p = rotated + pose.translation
        if (p[:, 2] <= 0).any():
            return NormalEquations.impossible(6)
        by_point = np.zeros((len(p), 2, 3))
        by_point[:, 0, 0] = by_point[:, 1, 1] = 1 / p[:, 2]
        by_point[:, :, 2] = -p[:, :2] / p[:, 2:] ** 2
        by_pose = np.concatenate([-by_point @ skew(rotated), by_point], axis=2)
        return NormalEquations.of((p[:, :2] / p[:, 2:] - xy_normalised).ravel(), by_pose.reshape(-1, 6))

    if not np.isfinite(linearise(camera_from_plane).cost):
        raise DegenerateError("planar pose: points behind the camera")
    found = minimise(camera_from_plane, linearise, perturbed, least_gain=EXACT, max_steps=MAX_STEPS)
    return found.required("planar pose", "check that the points are numbered rightly").state
