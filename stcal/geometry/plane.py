"""Planes, plane-to-plane homographies, and poses of planar patterns."""

from dataclasses import dataclass

import numpy as np

from stcal.errors import DegenerateError
from stcal.geometry.arrays import Array, freeze
from stcal.geometry.least_squares import NormalEquations, minimise, perturbed
from stcal.geometry.rigid import Rigid, skew

MAX_STEPS = 100
EXACT = 1e-22
"""Largest predicted decrease at the minimum of a pose, in squared normalised coordinates: a step of a hundred-billionth
of the distance."""


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
        """Return the signed distances, (n,), of points (n, 3)."""
        return np.asarray(xyz, float) @ self.normal - self.offset

    def project(self, xyz: np.ndarray) -> np.ndarray:
        """Return the foot points on the plane, same shape as ``xyz``."""
        return xyz - np.multiply.outer(self.distance(xyz), self.normal)


def fit_plane(xyz: np.ndarray, towards: np.ndarray | None = None) -> Plane:
    """Return the total-least-squares plane through (n, 3) points, its normal on the side of direction ``towards``.

    Raises
    ------
    DegenerateError
        Fewer than three points, or collinear ones.
    """
    normal, offset, rms = fit_planes(np.asarray(xyz, float)[None], towards)
    return Plane(normal[0], float(offset[0]), float(rms[0]))


def fit_planes(xyz: np.ndarray, towards: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fit a plane to each of k sets of points, (k, n, 3); see :func:`fit_plane`.

    Returns normals (k, 3), offsets (k,) and RMS distances (k,).
    """
    n = xyz.shape[1]
    if n < 3:
        raise DegenerateError("E-POINTS-FEW", f"plane: {n} points, 3 needed")
    mean = xyz.mean(1)
    _, s, vt = np.linalg.svd(xyz - mean[:, None], full_matrices=False)
    if (s[:, 1] <= 1e-9 * s[:, 0]).any():
        raise DegenerateError("E-POINTS-COLLINEAR", "plane: the points are collinear; points off the line are needed")
    normal = vt[:, 2]
    if towards is not None:
        normal = np.where((normal @ towards < 0)[:, None], -normal, normal)
    return normal, (normal * mean).sum(1), s[:, 2] / np.sqrt(n)


def fit_homography(xy_b: np.ndarray, xy_a: np.ndarray) -> np.ndarray:
    """Return the 3×3 homography a_from_b of n ≥ 4 point pairs (n, 2): normalised DLT (Hartley & Zisserman, alg. 4.2).

    Raises
    ------
    DegenerateError
        Fewer than four pairs, or three of the four on a line.
    """
    b, a = np.asarray(xy_b, float), np.asarray(xy_a, float)
    if len(b) < 4:
        raise DegenerateError("E-POINTS-FEW", f"homography: {len(b)} point pairs, 4 needed")
    (homography,) = fit_homographies(b[None], a[None], np.ones((1, len(b)), bool))
    if not np.isfinite(homography).all():
        raise DegenerateError(
            "E-POINTS-COLLINEAR", "homography: the points do not determine it (three of four on a line)"
        )
    return homography


def fit_homographies(xy_b: np.ndarray, xy_a: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Return the homographies (k, 3, 3) of k sets of point pairs, (k, n, 2); see :func:`fit_homography`.

    ``used`` : (k, n) mask of the pairs to use, four or more per set. A homography that they do not determine is NaN.
    """
    count, on = used.sum(1), used[..., None]

    def normalised(p):
        mean = np.where(on, p, 0).sum(1) / count[:, None]
        away = p - mean[:, None]
        size = np.sqrt((away**2).sum(2))
        scale = np.sqrt(2) / np.maximum(np.where(used, size, 0).sum(1) / count, 1e-300)
        turn = np.zeros((len(p), 3, 3))
        turn[:, 0, 0] = turn[:, 1, 1] = scale
        turn[:, :2, 2], turn[:, 2, 2] = -scale[:, None] * mean, 1
        return turn, away * scale[:, None, None]

    (na, a), (nb, b) = normalised(xy_a), normalised(xy_b)
    rows = np.zeros((len(b), b.shape[1], 2, 9))
    rows[:, :, 0, 0:2] = rows[:, :, 1, 3:5] = b
    rows[:, :, 0, 2] = rows[:, :, 1, 5] = 1
    rows[..., 6:8], rows[..., 8] = -a[..., None] * b[:, :, None], -a
    rows = np.where(on[..., None], rows, 0).reshape(len(b), -1, 9)
    _, s, vt = np.linalg.svd(rows, full_matrices=rows.shape[1] < 9)
    normal = vt[:, 8].reshape(-1, 3, 3)
    # Three of four points on a line in both planes leave the homography undetermined; in one plane only, they force a
    # singular matrix.
    ok = (s[:, 7] >= 1e-9 * s[:, 0]) & (np.linalg.cond(normal) <= 1e9)
    h = np.full((len(b), 3, 3), np.nan)
    h[ok] = np.linalg.inv(na[ok]) @ normal[ok] @ nb[ok]
    first = np.take_along_axis(xy_b, used.argmax(1)[:, None, None], 1)[:, 0]
    side = np.sign((h[:, 2, :2] * first).sum(1) + h[:, 2, 2])
    return h / np.linalg.norm(h, axis=(1, 2), keepdims=True) * side[:, None, None]


def apply_homography(a_from_b: np.ndarray, xy_b: np.ndarray) -> np.ndarray:
    """Return points (..., 2) mapped by a homography, or (k, n, 2) mapped by k homographies (k, 3, 3)."""
    mapped = _mapped(a_from_b, xy_b)
    return mapped[..., :2] / mapped[..., 2:]


def _mapped(a_from_b: np.ndarray, xy_b: np.ndarray) -> np.ndarray:
    """Return the homogeneous images (..., 3) of points."""
    constant = a_from_b[:, 2] if a_from_b.ndim == 2 else a_from_b[:, None, :, 2]
    return np.asarray(xy_b, float) @ np.swapaxes(a_from_b[..., :2], -1, -2) + constant


def homography_jacobian(a_from_b: np.ndarray, xy_b: np.ndarray) -> np.ndarray:
    """Return the Jacobians (..., 2, 2) of :func:`apply_homography` at points (..., 2); also for k homographies."""
    mapped = _mapped(a_from_b, xy_b)
    w = mapped[..., 2, None, None]
    homography = a_from_b if a_from_b.ndim == 2 else a_from_b[:, None]
    return (homography[..., :2, :2] - mapped[..., :2, None] / w * homography[..., 2:, :2]) / w


def camera_from_plane(normalised_from_plane: np.ndarray) -> Rigid:
    """Return the pose of a plane with a metric frame from its homography into normalised image coordinates.

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
    """Return the pose that minimises the reprojection error of a plane's points.

    Parameters
    ----------
    camera_from_plane : Rigid
        Start of the descent, mm.
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
        Points lie behind the camera at the start.
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
        raise DegenerateError("E-POINTS-BEHIND", "planar pose: points behind the camera")
    minimum = minimise(camera_from_plane, linearise, perturbed, least_gain=EXACT, max_steps=MAX_STEPS)
    return minimum.required("planar pose", "check that the points are numbered rightly").state
