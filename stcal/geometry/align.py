"""Least-squares alignment of corresponding points."""

import numpy as np

from stcal.errors import DegenerateError
from stcal.geometry.rigid import Rigid, Similarity


def align_rigid(xyz_a: np.ndarray, xyz_b: np.ndarray, weights: np.ndarray | None = None) -> Rigid:
    """a_from_b that minimises Σ wᵢ‖aᵢ − a_from_b bᵢ‖² (Kabsch 1976, with Umeyama's sign).

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
    """a_from_b with scale (Umeyama 1991); arguments and errors as :func:`align_rigid`."""
    return _align(xyz_a, xyz_b, weights, with_scale=True)


def _align(xyz_a, xyz_b, weights, with_scale: bool) -> Similarity:
    a, b = np.asarray(xyz_a, float), np.asarray(xyz_b, float)
    if a.shape != b.shape or len(a) < 3:
        raise DegenerateError(f"alignment: {len(a)} and {len(b)} points, 3 or more pairs needed")
    w = np.ones(len(a)) if weights is None else np.asarray(weights, float)
    if (w < 0).any() or not w.any():
        raise DegenerateError("alignment: weights are negative or all zero; positive weights needed")
    w = w / w.sum()
    mean_a, mean_b = w @ a, w @ b
    da, db = a - mean_a, b - mean_b
    for points in (da, db):
        s = np.linalg.svd(points[w > 0], compute_uv=False)
        if len(s) < 2 or s[1] <= 1e-9 * s[0]:
            raise DegenerateError("alignment: the points are collinear; points off the line are needed")
    u, s, vt = np.linalg.svd((w[:, None] * da).T @ db)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = (u * sign) @ vt
    scale = float((s * sign).sum() / (w @ (db**2).sum(1))) if with_scale else 1.0
    return Similarity(scale, Rigid(rotation, mean_a - scale * rotation @ mean_b))
