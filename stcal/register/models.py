"""The three models of a registration – rigid, similarity, affine – and their weighted least-squares fits.

Residuals are b − b_from_a a in frame b. ``precision`` describes their noise: None for equal and isotropic noise,
(n,) for weights 1/σ², (n, 3, 3) for inverse covariances.
"""

from dataclasses import dataclass

import numpy as np

from stcal.errors import DegenerateError
from stcal.geometry.least_squares import NormalEquations, minimise
from stcal.geometry.rigid import (
    Affine,
    Rigid,
    Similarity,
    align_affine,
    align_rigid,
    align_similarity,
    best_rotations,
    skew,
)

Transform = Rigid | Similarity | Affine

EXACT = 1e-11
"""Relative σ, as a share of the coordinates' size, below which residuals are rounding errors."""
CHUNK = 100_000
"""Number of points processed at once if a Jacobian of every point is held."""


@dataclass(frozen=True, slots=True)
class Model:
    """``name`` : ``rigid``, ``similarity`` or ``affine``; ``sample`` : least number of point pairs."""

    name: str
    parameters: int
    sample: int

    @property
    def needed(self) -> int:
        """Least number of point pairs of a fit with redundancy."""
        return max(self.sample, self.parameters // 3 + 1)

    def redundancy(self, n: int) -> int:
        """Returns the redundancy of a fit to n point pairs."""
        return 3 * n - self.parameters


MODELS = {m.name: m for m in (Model("rigid", 6, 3), Model("similarity", 7, 3), Model("affine", 12, 4))}


def parts(transform: Transform) -> tuple[np.ndarray, np.ndarray]:
    """Returns the linear part (3, 3) and the translation (3,)."""
    if isinstance(transform, Rigid):
        return transform.rotation, transform.translation
    if isinstance(transform, Similarity):
        return transform.scale * transform.rigid.rotation, transform.rigid.translation
    return transform.linear, transform.translation


def fit(model: Model, xyz_a: np.ndarray, xyz_b: np.ndarray, precision: np.ndarray | None = None) -> Transform:
    """Returns the b_from_a that minimises Σ rᵢᵀ Pᵢ rᵢ: in closed form, then by descent with inverse covariances.

    ``precision`` : (n,) weights, or (n, 3, 3) inverse covariances in frame b. Raises DegenerateError: too few points,
    collinear ones, or coplanar ones for the affine model. Raises ConvergenceError: no minimum is reached.
    """
    weights = precision
    if precision is not None and precision.ndim == 3:
        weights = np.trace(precision, axis1=1, axis2=2)
    closed = {"rigid": align_rigid, "similarity": align_similarity, "affine": align_affine}[model.name]
    start = closed(xyz_b, xyz_a, weights)
    if precision is None or weights is None or precision.ndim == 1:
        return start
    origin = weights @ xyz_a / weights.sum()
    fitted = minimise(
        start,
        lambda transform: _about(model, transform, origin, xyz_a, precision, xyz_b),
        lambda transform, step: _moved(transform, origin, step),
    )
    return fitted.required("registration", "are the covariances true, or some of them huge?").state


def squares(residuals: np.ndarray, precision: np.ndarray | None = None) -> np.ndarray:
    """Returns rᵀ P r, (n,), of residuals (n, 3)."""
    if precision is not None and precision.ndim == 3:
        return np.einsum("ni,nij,nj->n", residuals, precision, residuals)
    plain = np.einsum("ni,ni->n", residuals, residuals)
    return plain if precision is None else plain * precision


def rounding_mm(xyz_a: np.ndarray, xyz_b: np.ndarray) -> float:
    """Returns the rounding error of residuals, mm. It is robust against wrong points of any size."""
    return EXACT * float(max(np.median(np.maximum.reduce(np.abs(xyz.T))) for xyz in (xyz_a, xyz_b)))


def unit_covariance(
    model: Model, transform: Transform, xyz_a: np.ndarray, precision: np.ndarray | None = None
) -> np.ndarray:
    """Returns the covariance of a fit's parameters at unit noise (1 mm, or the covariances that ``precision`` inverts).

    Parameters of a left perturbation in frame b: rotation vector (rad) and translation (mm), R' = exp(w) R and
    t' = t + dt; then for a similarity its relative scale, s' = s (1 + ds). Affine: rows of the 3×4 matrix.

    ``model`` : model; ``transform`` : b_from_a; ``xyz_a`` : (n, 3) points that were fitted, mm; ``precision`` : (n,)
    precision as in :func:`fit`.
    """
    origin, normal = _normal(model, transform, xyz_a, precision)
    to_origin = _to_origin(model, transform, origin)
    scale = 1 / np.sqrt(np.diag(normal))
    covariance = np.linalg.inv(normal * scale[:, None] * scale) * scale[:, None] * scale
    return to_origin @ covariance @ to_origin.T


def leverages(
    model: Model, transform: Transform, xyz_a: np.ndarray, used: np.ndarray, precision: np.ndarray | None = None
) -> np.ndarray:
    """Returns H (n, 3, 3), the uncertainty that the fit of the ``used`` (n,) adds to every point's residual.

    H = Lᵀ J N⁻¹ Jᵀ L with P = L Lᵀ: whitened residuals Lᵀ r have covariance 1 − H for points that were used and 1 + H
    for others. An eigenvalue of 1 marks a direction in which no other point checks this one.
    """
    p = None if precision is None else precision[used]
    origin, normal = _normal(model, transform, xyz_a[used], p)
    by_step = jacobian(model, transform, xyz_a - origin)
    covariance = by_step @ np.linalg.inv(normal) @ np.swapaxes(by_step, 1, 2)
    if precision is None:
        return covariance
    if precision.ndim == 1:
        return covariance * precision[:, None, None]
    root = np.linalg.cholesky(precision)
    return np.swapaxes(root, 1, 2) @ covariance @ root


def whitened(residuals: np.ndarray, precision: np.ndarray | None = None) -> np.ndarray:
    """Returns Lᵀ r, (n, 3), of residuals (n, 3), with P = L Lᵀ."""
    if precision is None:
        return residuals
    if precision.ndim == 1:
        return residuals * np.sqrt(precision)[:, None]
    return np.einsum("nij,ni->nj", np.linalg.cholesky(precision), residuals)


def hypotheses(model: Model, xyz_a: np.ndarray, xyz_b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fits s minimal samples (s, m, 3) at once: linear parts (s, 3, 3), translations (s, 3) of b_from_a. Results for
    degenerate samples are finite and wrong."""
    mean_a, mean_b = xyz_a.mean(1), xyz_b.mean(1)
    a, b = xyz_a - mean_a[:, None], xyz_b - mean_b[:, None]
    cross = np.swapaxes(b, 1, 2) @ a
    if model.name == "affine":
        linear = cross @ np.linalg.pinv(np.swapaxes(a, 1, 2) @ a, hermitian=True)
    else:
        linear, product = best_rotations(cross)
        if model.name == "similarity":
            linear = linear * (product / np.maximum((a**2).sum((1, 2)), 1e-300))[:, None, None]
    return linear, mean_b - (linear @ mean_a[:, :, None])[:, :, 0]


def jacobian(model: Model, transform: Transform, from_origin: np.ndarray) -> np.ndarray:
    """Returns the derivative (n, 3, p) of b_from_a a by the parameters (see :func:`unit_covariance`) about a point of
    a, for points (n, 3) minus that point."""
    n = len(from_origin)
    by_step = np.zeros((n, 3, model.parameters))
    if model.name == "affine":
        for row in range(3):
            by_step[:, row, 4 * row : 4 * row + 3] = from_origin
            by_step[:, row, 4 * row + 3] = 1
        return by_step
    turned = from_origin @ parts(transform)[0].T
    by_step[:, :, :3] = -skew(turned)
    by_step[:, :, 3:6] = np.eye(3)
    if model.name == "similarity":
        by_step[:, :, 6] = turned
    return by_step


def _normal(
    model: Model, transform: Transform, xyz_a: np.ndarray, precision: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the origin in a, which is the points' weighted mean, and the normal matrix (p, p) about it."""
    if precision is None or precision.ndim == 1:
        weights = np.ones(len(xyz_a)) if precision is None else precision
        origin = weights @ xyz_a / weights.sum()
        return origin, _isotropic_normal(model, transform, xyz_a - origin, weights)
    weights = np.trace(precision, axis1=1, axis2=2)
    origin = weights @ xyz_a / weights.sum()
    return origin, _about(model, transform, origin, xyz_a, precision, transform @ xyz_a).normal


def _about(
    model: Model, transform: Transform, origin: np.ndarray, xyz_a: np.ndarray, precision: np.ndarray, xyz_b: np.ndarray
) -> NormalEquations:
    """Returns the normal equations of the parameters about a point ``origin`` of a, with inverse covariances."""
    cost, normal, gradient = 0.0, np.zeros((model.parameters,) * 2), np.zeros(model.parameters)
    for first in range(0, len(xyz_a), CHUNK):
        rows = slice(first, first + CHUNK)
        by_step = jacobian(model, transform, xyz_a[rows] - origin)
        weighted = np.swapaxes(by_step, 1, 2) @ precision[rows]
        residual = xyz_b[rows] - transform @ xyz_a[rows]
        normal += (weighted @ by_step).sum(0)
        gradient -= (weighted @ residual[:, :, None]).sum((0, 2))
        cost += float(squares(residual, precision[rows]).sum())
    return NormalEquations(cost, normal, gradient)


def _isotropic_normal(model: Model, transform: Transform, from_origin: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Returns the normal matrix, computed from the points' second moments instead of one Jacobian for each point."""
    second, total = (from_origin * weights[:, None]).T @ from_origin, weights.sum()
    normal = np.zeros((model.parameters,) * 2)
    if model.name == "affine":
        for row in range(3):
            normal[4 * row : 4 * row + 3, 4 * row : 4 * row + 3] = second
            normal[4 * row + 3, 4 * row + 3] = total
        return normal
    linear = parts(transform)[0]
    second = linear @ second @ linear.T
    normal[:3, :3] = np.trace(second) * np.eye(3) - second
    normal[3:6, 3:6] = total * np.eye(3)
    if model.name == "similarity":
        normal[6, 6] = np.trace(second)
    return normal


def _to_origin(model: Model, transform: Transform, origin: np.ndarray) -> np.ndarray:
    """Returns the matrix (p, p) from parameters about the point ``origin`` of a to parameters about a's origin."""
    change = np.eye(model.parameters)
    if model.name == "affine":
        for row in range(3):
            change[4 * row + 3, 4 * row : 4 * row + 3] = -origin
        return change
    turned = parts(transform)[0] @ origin
    change[3:6, :3] = skew(turned)
    if model.name == "similarity":
        change[3:6, 6] = -turned
    return change


def _moved(transform: Transform, origin: np.ndarray, step: np.ndarray) -> Transform:
    """Returns the transform after a step of the parameters about ``origin``."""
    if isinstance(transform, Affine):
        rows = step.reshape(3, 4)
        linear = transform.linear + rows[:, :3]
        return Affine(linear, transform @ origin + rows[:, 3] - linear @ origin)
    turn = Rigid.exp([*step[:3], 0, 0, 0]).rotation
    there = transform @ origin + step[3:6]
    if isinstance(transform, Rigid):
        rotation = turn @ transform.rotation
        return Rigid(rotation, there - rotation @ origin)
    scale, rotation = transform.scale * (1 + step[6]), turn @ transform.rigid.rotation
    if scale <= 0:
        raise DegenerateError(
            "E-REGISTER-SCALE", "registration: the scale is not determined; are the covariances true?"
        )
    return Similarity(scale, Rigid(rotation, there - scale * rotation @ origin))
