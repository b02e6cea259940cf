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
    weights = precision if precision is None or precision.ndim == 1 else np.trace(precision, axis1=1, axis2=2)
    closed = {"rigid": align_rigid, "similarity": align_similarity, "affine": align_affine}[model.name]
    start = closed(xyz_b, xyz_a, weights)
    if precision is None or weights is None or precision.ndim == 1:
        return start
    origin = weights @ xyz_a / weights.sum()

    def equations(transform: Transform) -> NormalEquations:
        residual = xyz_b - transform @ xyz_a
        pull = np.einsum("nr,nk->rk", np.einsum("nrs,ns->nr", precision, residual), _homogeneous(xyz_a - origin))
        gradient = -_motions(model, transform).T @ pull.ravel()
        return NormalEquations(
            float(squares(residual, precision).sum()), _normal(model, transform, xyz_a - origin, precision), gradient
        )

    fitted = minimise(start, equations, lambda transform, step: _moved(transform, origin, step))
    return fitted.required("registration", "are the covariances true, or some of them huge?").state


def squares(residuals: np.ndarray, precision: np.ndarray | None = None) -> np.ndarray:
    """Returns rᵀ P r, (n,), of residuals (n, 3)."""
    if precision is not None and precision.ndim == 3:
        return np.einsum("ni,nij,nj->n", residuals, precision, residuals)
    plain = np.einsum("ni,ni->n", residuals, residuals)
    return plain if precision is None else plain * precision


def unit_covariance(
    model: Model, transform: Transform, xyz_a: np.ndarray, precision: np.ndarray | None = None
) -> np.ndarray:
    """Returns the covariance of a fit's parameters at unit noise (1 mm, or the covariances that ``precision`` inverts).

    Parameters of a left perturbation in frame b: rotation vector (rad) and translation (mm), R' = exp(w) R and
    t' = t + dt; then for a similarity its relative scale, s' = s (1 + ds). Affine: rows of the 3×4 matrix.

    ``model`` : model; ``transform`` : b_from_a; ``xyz_a`` : (n, 3) points that were fitted, mm; ``precision`` : (n,)
    precision as in :func:`fit`.
    """
    origin = _middle(xyz_a, precision)
    normal = _normal(model, transform, xyz_a - origin, precision)
    motions, shift = _motions(model, transform), np.eye(4)
    shift[:3, 3] = -origin
    to_origin = np.linalg.pinv(motions) @ np.kron(np.eye(3), shift.T) @ motions
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
    origin = _middle(xyz_a[used], p)
    normal = _normal(model, transform, xyz_a[used] - origin, p)
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
    return np.einsum("nk,rkp->nrp", _homogeneous(from_origin), _motions(model, transform).reshape(3, 4, -1))


def _homogeneous(xyz: np.ndarray) -> np.ndarray:
    return np.column_stack([xyz, np.ones(len(xyz))])


def _motions(model: Model, transform: Transform) -> np.ndarray:
    """Returns the derivative (12, p) of the 3×4 matrix, row by row, by the parameters."""
    if model.name == "affine":
        return np.eye(12)
    linear = parts(transform)[0]
    motions = np.zeros((model.parameters, 3, 4))
    motions[:3, :, :3] = skew(np.eye(3)) @ linear
    motions[3:6, :, 3] = np.eye(3)
    motions[6:, :, :3] = linear
    return motions.reshape(model.parameters, 12).T


def _middle(xyz_a: np.ndarray, precision: np.ndarray | None) -> np.ndarray:
    """Returns the weighted mean of points (n, 3), about which their parameters correlate least."""
    weights = precision if precision is None or precision.ndim == 1 else np.trace(precision, axis1=1, axis2=2)
    return np.average(xyz_a, axis=0, weights=weights)


def _normal(model: Model, transform: Transform, from_origin: np.ndarray, precision: np.ndarray | None) -> np.ndarray:
    """Returns the normal matrix (p, p) about the origin, from the points' second moments."""
    places, motions = _homogeneous(from_origin), _motions(model, transform)
    if precision is not None and precision.ndim == 3:
        moments = np.einsum("nk,nrs,nl->rksl", places, precision, places)
    else:
        weighted = places if precision is None else places * precision[:, None]
        moments = np.einsum("rs,kl->rksl", np.eye(3), weighted.T @ places)
    return motions.T @ moments.reshape(12, 12) @ motions


def _moved(transform: Transform, origin: np.ndarray, step: np.ndarray) -> Transform:
    """Returns the transform after a step of the parameters about ``origin``."""
    there = transform @ origin
    if isinstance(transform, Affine):
        rows = step.reshape(3, 4)
        linear = transform.linear + rows[:, :3]
        return Affine(linear, there + rows[:, 3] - linear @ origin)
    scale, rigid = (1.0, transform) if isinstance(transform, Rigid) else (transform.scale, transform.rigid)
    scale *= 1 + step[6:].sum()
    if scale <= 0:
        raise DegenerateError(
            "E-REGISTER-SCALE", "registration: the scale is not determined; are the covariances true?"
        )
    rotation = Rigid.exp([*step[:3], 0, 0, 0]).rotation @ rigid.rotation
    moved = Rigid(rotation, there + step[3:6] - scale * rotation @ origin)
    return moved if isinstance(transform, Rigid) else Similarity(scale, moved)
