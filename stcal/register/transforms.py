"""Point pairs with their noise, and the weighted least-squares fits of a registration's three models to them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from stcal.errors import DegenerateError, InputError
from stcal.geometry.arrays import OF_POINT, first_fault
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
SHOWN = 5
"""Number of rows that a message names."""


@dataclass(frozen=True, slots=True)
class Model:
    """``sample`` : least number of point pairs; ``align`` : fit to points b and a with weights (n,)."""

    name: str
    parameters: int
    sample: int
    align: Callable[[np.ndarray, np.ndarray, np.ndarray], Transform]

    @property
    def needed(self) -> int:
        """Least number of point pairs of a fit with redundancy."""
        return max(self.sample, self.parameters // 3 + 1)

    def redundancy(self, n: int) -> int:
        """Returns the redundancy of a fit to n point pairs."""
        return 3 * n - self.parameters


RIGID, SIMILARITY, AFFINE = (
    Model("rigid", 6, 3, align_rigid),
    Model("similarity", 7, 3, align_similarity),
    Model("affine", 12, 4, align_affine),
)
MODELS = {model.name: model for model in (RIGID, SIMILARITY, AFFINE)}


def parts(transform: Transform) -> tuple[np.ndarray, np.ndarray]:
    """Returns the linear part (3, 3) and the translation (3,)."""
    matrix = transform.matrix()
    return matrix[:3, :3], matrix[:3, 3]


def rotation_of(transform: Transform) -> np.ndarray:
    """Returns the rotation (3, 3) nearest to the linear part."""
    return best_rotations(parts(transform)[0])[0]


def some_of(items: Sequence | np.ndarray, say: Callable[[Any], str]) -> str:
    """Returns the first of some items in words, and the number of others."""
    more = f" and {len(items) - SHOWN} more" if len(items) > SHOWN else ""
    return ", ".join(say(item) for item in items[:SHOWN]) + more


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """Point pairs (n, 3) mm, neither copied nor checked, as subsets are taken in inner loops, and a model.

    Residuals are b − b_from_a a in frame b. ``precision`` : (n,) inverse variances per axis, or (n, 3, 3) inverse
    covariances in frame b, scaled to mean σ 1 (the RMS of all σ), so that whitened residuals are mm of such a point;
    ``sigma_mm`` : mean σ if given; ``lines`` : of a file, by which messages name all points; subsets have none.
    """

    model: Model
    xyz_a: np.ndarray
    xyz_b: np.ndarray
    precision: np.ndarray
    sigma_mm: float | None = None
    lines: Sequence[int] | None = None

    def __len__(self) -> int:
        return len(self.xyz_a)

    def __getitem__(self, rows: np.ndarray) -> "Problem":
        """Returns the point pairs selected by a mask or by indices."""
        return Problem(self.model, self.xyz_a[rows], self.xyz_b[rows], self.precision[rows], self.sigma_mm)

    def name(self, row: Any) -> str:
        """Returns a point's name for messages: its line in the file, else its row from 1."""
        return f"row {row + 1}" if self.lines is None else f"line {self.lines[row]}"

    def names(self, rows: np.ndarray) -> str:
        """Returns the names of the first of some points, and the number of others."""
        return some_of(rows, self.name)

    @property
    def redundancy(self) -> int:
        """Redundancy of a fit to all points."""
        return self.model.redundancy(len(self))

    @property
    def weights(self) -> np.ndarray:
        """Weights (n,) of the points, proportional to 1/σ²."""
        return self.precision if self.precision.ndim == 1 else np.trace(self.precision, axis1=1, axis2=2)

    def rounding_mm(self) -> float:
        """Returns the rounding error of residuals, mm. It is robust against wrong points of any size."""
        return EXACT * float(max(np.median(np.abs(xyz).max(1)) for xyz in (self.xyz_a, self.xyz_b)))

    def residuals(self, b_from_a: Transform) -> np.ndarray:
        """Returns b − b_from_a a, (n, 3) mm, frame b."""
        return self.xyz_b - b_from_a @ self.xyz_a

    def squares(self, b_from_a: Transform) -> np.ndarray:
        """Returns rᵀ P r, (n,), mm² of a point of mean σ."""
        residuals = self.residuals(b_from_a)
        if self.precision.ndim == 3:
            return np.einsum("ni,nij,nj->n", residuals, self.precision, residuals)
        return np.einsum("ni,ni->n", residuals, residuals) * self.precision

    def whitened(self, values: np.ndarray) -> np.ndarray:
        """Returns Lᵀ v of values (n, 3, …), with the precision P = L Lᵀ; residuals become mm of a point of mean σ."""
        if self.precision.ndim == 3:
            return np.einsum("nij,ni...->nj...", np.linalg.cholesky(self.precision), values)
        return values * np.sqrt(self.precision).reshape(-1, *[1] * (values.ndim - 1))

    def fit(self) -> Transform:
        """Returns the b_from_a that minimises Σ rᵢᵀ Pᵢ rᵢ: in closed form, then by descent with inverse covariances.

        Raises DegenerateError: too few points, collinear ones, or coplanar ones for the affine model. Raises
        ConvergenceError: no minimum is reached.
        """
        start = self.model.align(self.xyz_b, self.xyz_a, self.weights)
        if self.precision.ndim == 1:
            return start
        origin = self.weights @ self.xyz_a / self.weights.sum()

        def equations(transform: Transform) -> NormalEquations:
            force = np.einsum("nrs,ns->nr", self.precision, self.residuals(transform))
            pull = np.einsum("nr,nk->rk", force, _homogeneous(self.xyz_a - origin))
            gradient = -_motions(self.model, transform).T @ pull.ravel()
            return NormalEquations(float(self.squares(transform).sum()), self._normal(transform, origin), gradient)

        fitted = minimise(start, equations, lambda transform, step: _moved(transform, origin, step))
        return fitted.required("registration", "are the covariances true, or some of them huge?").state

    def unit_covariance(self, transform: Transform) -> np.ndarray:
        """Returns the covariance (p, p) of a fit's parameters at unit noise.

        Parameters of a left perturbation in frame b: rotation vector (rad) and translation (mm), R' = exp(w) R and
        t' = t + dt; then for a similarity its relative scale, s' = s (1 + ds). Affine: rows of the 3×4 matrix.
        """
        origin = self._middle()
        normal, motions, shift = self._normal(transform, origin), _motions(self.model, transform), np.eye(4)
        shift[:3, 3] = -origin
        to_origin = np.linalg.pinv(motions) @ np.kron(np.eye(3), shift.T) @ motions
        scale = 1 / np.sqrt(np.diag(normal))
        covariance = np.linalg.inv(normal * scale[:, None] * scale) * scale[:, None] * scale
        return to_origin @ covariance @ to_origin.T

    def leverages(self, transform: Transform, used: np.ndarray) -> np.ndarray:
        """Returns H (n, 3, 3), the uncertainty that the fit of the ``used`` (n,) adds to every point's residual.

        H = Lᵀ J N⁻¹ Jᵀ L with P = L Lᵀ: whitened residuals have covariance 1 − H for points that were used and 1 + H
        for others. An eigenvalue of 1 marks a direction in which no other point checks this one.
        """
        origin = self[used]._middle()
        by_step = jacobian(self.model, transform, self.xyz_a - origin)
        added = by_step @ np.linalg.inv(self[used]._normal(transform, origin)) @ np.swapaxes(by_step, 1, 2)
        if self.precision.ndim == 1:
            return added * self.precision[:, None, None]
        root = np.linalg.cholesky(self.precision)
        return np.swapaxes(root, 1, 2) @ added @ root

    def _middle(self) -> np.ndarray:
        """Returns the weighted mean of a, about which the parameters correlate least."""
        return np.average(self.xyz_a, axis=0, weights=self.weights)

    def _normal(self, transform: Transform, origin: np.ndarray) -> np.ndarray:
        """Returns the normal matrix (p, p) about the origin, from the points' second moments."""
        places, motions = _homogeneous(self.xyz_a - origin), _motions(self.model, transform)
        if self.precision.ndim == 3:
            moments = np.einsum("nk,nrs,nl->rksl", places, self.precision, places)
        else:
            moments = np.einsum("rs,kl->rksl", np.eye(3), (places * self.precision[:, None]).T @ places)
        return motions.T @ moments.reshape(12, 12) @ motions


def problem_of(
    model: Model,
    xyz_a: np.ndarray,
    xyz_b: np.ndarray,
    weights: np.ndarray | None = None,
    covariances: np.ndarray | None = None,
    lines: Sequence[int] | None = None,
) -> Problem:
    """Returns the problem of pairs with (n,) weights, in 1/σ², or (n, 3, 3) covariances, or variances per axis (n,), of
    b − b_from_a a in frame b, mm². Raises InputError: both are given, a wrong shape, or not positive."""
    n = len(xyz_a)
    if weights is not None and covariances is not None:
        raise InputError("E-REGISTER-WEIGHTS", "registration: weights and covariances given; give only one of them")
    if weights is None and covariances is None:
        return Problem(model, xyz_a, xyz_b, np.ones(n), None, lines)
    name = "weights" if covariances is None else "covariances"
    given = np.asarray(weights if covariances is None else covariances, float)
    if given.shape != (n,) and (name == "weights" or given.shape != (n, 3, 3)):
        raise InputError(
            "E-ARRAY-SHAPE", f"registration: {name} of shape {given.shape} for {n} point pairs; one for each needed"
        )
    if given.ndim == 3:
        fault = first_fault(given, OF_POINT, definite=True)
        trouble = fault and f"row {fault.row + 1}: {fault.reason}"
    else:
        bad = np.flatnonzero(~(np.isfinite(given) & (given > 0)))
        trouble = f"row {bad[0] + 1} has {given[bad[0]]:.3g}, a positive number needed" if len(bad) else None
    if trouble:
        raise InputError("E-REGISTER-WEIGHTS", f"registration: {name}: {trouble}; leave a row out to give it no weight")
    if name == "weights":
        return Problem(model, xyz_a, xyz_b, given * np.mean(1 / given), None, lines)
    variance = float(np.mean(np.trace(given, axis1=1, axis2=2) / 3 if given.ndim == 3 else given))
    precision = (np.linalg.inv(given) if given.ndim == 3 else 1 / given) * variance
    return Problem(model, xyz_a, xyz_b, precision, float(np.sqrt(variance)), lines)


def hypotheses(model: Model, xyz_a: np.ndarray, xyz_b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fits s minimal samples (s, m, 3) at once: linear parts (s, 3, 3), translations (s, 3) of b_from_a. Results for
    degenerate samples are finite and wrong."""
    mean_a, mean_b = xyz_a.mean(1), xyz_b.mean(1)
    a, b = xyz_a - mean_a[:, None], xyz_b - mean_b[:, None]
    cross = np.swapaxes(b, 1, 2) @ a
    if model == AFFINE:
        linear = cross @ np.linalg.pinv(np.swapaxes(a, 1, 2) @ a, hermitian=True)
    else:
        linear, product = best_rotations(cross)
        if model == SIMILARITY:
            linear = linear * (product / np.maximum((a**2).sum((1, 2)), 1e-300))[:, None, None]
    return linear, mean_b - (linear @ mean_a[:, :, None])[:, :, 0]


def jacobian(model: Model, transform: Transform, from_origin: np.ndarray) -> np.ndarray:
    """Returns the derivative (n, 3, p) of b_from_a a by the parameters of :meth:`Problem.unit_covariance` about a point
    of a, for points (n, 3) minus that point."""
    return np.einsum("nk,rkp->nrp", _homogeneous(from_origin), _motions(model, transform).reshape(3, 4, -1))


def _homogeneous(xyz: np.ndarray) -> np.ndarray:
    return np.column_stack([xyz, np.ones(len(xyz))])


def _motions(model: Model, transform: Transform) -> np.ndarray:
    """Returns the derivative (12, p) of the 3×4 matrix, row by row, by the parameters."""
    if model == AFFINE:
        return np.eye(12)
    linear = parts(transform)[0]
    motions = np.zeros((model.parameters, 3, 4))
    motions[:3, :, :3] = skew(np.eye(3)) @ linear
    motions[3:6, :, 3] = np.eye(3)
    motions[6:, :, :3] = linear
    return motions.reshape(model.parameters, 12).T


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
