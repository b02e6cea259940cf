"""Least-squares alignment of corresponding points."""

import numpy as np

from stcal.errors import DegenerateError
from stcal.geometry.rigid import Affine, Rigid, Similarity


def align_rigid(xyz_a: np.ndarray, xyz_b: np.ndarray, weights: np.ndarray | None = None) -> Rigid:
    """Return the a_from_b that minimises Σ wᵢ‖aᵢ − a_from_b bᵢ‖² (Kabsch 1976, with Umeyama's sign).

    Parameters
    ----------
    xyz_a, xyz_b : (n, 3) arrays, n ≥ 3, not collinear
    weights : (n,) array, optional
        Not negative; the points of positive weight must not be collinear.

    Raises
    ------
    DegenerateError
        Fewer than three points, or collinear ones.
    """
    return _align(xyz_a, xyz_b, weights, with_scale=False).rigid


def align_similarity(xyz_a: np.ndarray, xyz_b: np.ndarray, weights: np.ndarray | None = None) -> Similarity:
    """Return a_from_b with scale (Umeyama 1991); arguments and errors as :func:`align_rigid`."""
    return _align(xyz_a, xyz_b, weights, with_scale=True)


def align_affine(xyz_a: np.ndarray, xyz_b: np.ndarray, weights: np.ndarray | None = None) -> Affine:
    """Return a_from_b with twelve parameters by linear least squares; arguments as :func:`align_rigid`.

    Raises
    ------
    DegenerateError
        Fewer than four points, or b's points are coplanar to rounding.
    """
    a, b, w = _checked(xyz_a, xyz_b, weights, 4)
    mean_a, mean_b = w @ a, w @ b
    root = np.sqrt(w)[:, None]
    linear, _, _, s = np.linalg.lstsq(root * (b - mean_b), root * (a - mean_a), rcond=None)
    if s[2] <= 1e-9 * s[0]:
        raise DegenerateError(
            "E-POINTS-COPLANAR", "alignment: the points are coplanar; an affine transform needs points off the plane"
        )
    return Affine(linear.T, mean_a - linear.T @ mean_b)


def best_rotations(cross: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the rotations R, (..., 3, 3), that maximise tr(Rᵀ cross), and these maxima, (...).

    ``cross`` : (..., 3, 3). If it is Σ wᵢ aᵢ bᵢᵀ of centred points, R is the rotation of a_from_b (Kabsch 1976).
    """
    u, s, vt = np.linalg.svd(cross)
    sign = np.ones(s.shape)
    sign[..., 2] = np.sign(np.linalg.det(u @ vt))
    return (u * sign[..., None, :]) @ vt, (s * sign).sum(-1)


def _checked(xyz_a, xyz_b, weights, needed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the points as arrays, and the weights normalised to sum 1; refuse too few points and invalid weights."""
    a, b = np.asarray(xyz_a, float), np.asarray(xyz_b, float)
    if a.shape != b.shape or len(a) < needed:
        raise DegenerateError("E-POINTS-FEW", f"alignment: {len(a)} and {len(b)} points, {needed} or more pairs needed")
    w = np.ones(len(a)) if weights is None else np.asarray(weights, float)
    if (w < 0).any() or not w.any():
        raise DegenerateError("E-ALIGN-WEIGHTS", "alignment: weights are negative or all zero; positive weights needed")
    return a, b, w / w.sum()


def _collinear(centred: np.ndarray) -> bool:
    values = np.linalg.eigvalsh(centred.T @ centred)
    if values[1] > 1e-12 * values[2]:  # clear without the SVD, which is slow for a million points
        return False
    s = np.linalg.svd(centred, compute_uv=False)
    return len(s) < 2 or s[1] <= 1e-9 * s[0]


def _align(xyz_a, xyz_b, weights, with_scale: bool) -> Similarity:
    a, b, w = _checked(xyz_a, xyz_b, weights, 3)
    mean_a, mean_b = w @ a, w @ b
    da, db = a - mean_a, b - mean_b
    for points in (da, db):
        if _collinear(points[w > 0]):
            raise DegenerateError(
                "E-POINTS-COLLINEAR", "alignment: the points are collinear; points off the line are needed"
            )
    rotation, product = best_rotations((w[:, None] * da).T @ db)
    scale = float(product / (w @ (db**2).sum(1))) if with_scale else 1.0
    return Similarity(scale, Rigid(rotation, mean_a - scale * rotation @ mean_b))
