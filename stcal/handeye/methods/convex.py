"""Zhao's convex method: it minimises the largest error of all motions, with R_X any matrix.

Zhao, *Hand-eye calibration using convex optimization*, ICRA 2011, in the form of orthogonal matrices: minimise over
x = (vec R_X, b_X) the largest ‖C_i x − d_i‖, the twelve equations of motion i; then take the rotation nearest to R_X.
This second-order cone program has 13 unknowns and one smooth constraint for each motion. Sequential quadratic
programming solves it in a few dozen steps, and the multipliers at the solution prove that it is the minimum. A conic
solver is not needed.
"""

import numpy as np
from scipy.optimize import minimize, nnls

from stcal.errors import ConvergenceError
from stcal.geometry.rigid import Rigid
from stcal.handeye.data.pairs import Motions

GAP = 1e-4
"""Largest relative excess of the largest error over the proven bound: a hundredth of any σ."""


def convex(motions: Motions, unit_mm: float = 1000.0) -> Rigid:
    """Returns X by L∞ minimisation; ``unit_mm`` is the length that weighs like one radian.

    Raises ConvergenceError: the bound is not reached, or the matrix is not a rotation.
    """
    c, d = equations(motions, unit_mm)
    x, *_ = np.linalg.lstsq(c.reshape(-1, 12), d.ravel(), rcond=None)
    x = smallest_largest(c, d, x)
    u, s, vt = np.linalg.svd(x[:9].reshape(3, 3, order="F"))
    if np.linalg.det(u @ vt) < 0 or s[2] < 0.1:
        raise ConvergenceError(
            "E-HANDEYE-METHOD-FAILS", "hand-eye: zhao finds no rotation; the motions are too small or too alike for it"
        )
    return Rigid(u @ vt, unit_mm * x[9:])


def equations(motions: Motions, unit_mm: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns C (k, 12, 12) and d (k, 12) of the residuals R_A R_X − R_X R_B and (R_A − I) b_X − R_X b_B + b_A; x holds
    R_X by columns."""
    a, b, k = motions.mount, motions.camera, len(motions)
    eye = np.eye(3)
    c, d = np.zeros((k, 12, 12)), np.zeros((k, 12))
    left = np.einsum("ab,kij->kaibj", eye, a.rotation).reshape(k, 9, 9)
    right = np.einsum("kba,ij->kaibj", b.rotation, eye).reshape(k, 9, 9)
    c[:, :9, :9] = left - right
    c[:, 9:, :9] = -np.einsum("ka,ij->kiaj", b.translation / unit_mm, eye).reshape(k, 3, 9)
    c[:, 9:, 9:] = a.rotation - eye
    d[:, 9:] = -a.translation / unit_mm
    return c, d


def smallest_largest(c: np.ndarray, d: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Returns the x that minimises the largest ‖C_i x − d_i‖, from a start.

    Raises ConvergenceError: the result is not proven to be within :data:`GAP` of the minimum.
    """
    scale = np.linalg.norm(np.einsum("kij,j->ki", c, x) - d, axis=1).max()
    if scale < 1e-12:  # the start has no residuals
        return x
    hessian, pull = np.swapaxes(c, 1, 2) @ c / scale**2, np.einsum("kij,ki->kj", c, d) / scale**2
    level = (d**2).sum(1) / scale**2

    def squared(y):
        return (np.einsum("kij,j->ki", c, y) - d) ** 2 / scale**2

    def below(y):
        return y[-1] - squared(y[:-1]).sum(1)

    def below_slope(y):
        return np.column_stack([-2 * (hessian @ y[:-1] - pull), np.ones(len(c))])

    ahead = np.eye(13)[-1]
    solution = minimize(
        lambda y: y[-1],
        np.append(x, 1.0),
        jac=lambda _: ahead,
        method="SLSQP",
        constraints={"type": "ineq", "fun": below, "jac": below_slope},
        options={"maxiter": 500, "ftol": 1e-14},
    )
    x = solution.x[:-1]
    errors = squared(x).sum(1)
    # The minimum of a weighted mean of the squared errors is below that of the largest: multipliers give the best mean.
    active = errors > (1 - 1e-2) * errors.max()
    slopes = 2 * (hessian @ x - pull)[active]
    shares, _ = nnls(np.vstack([slopes.T, np.ones(active.sum())]), np.append(np.zeros(12), 1.0))
    shares /= shares.sum()
    mean, right = np.tensordot(shares, hessian[active], 1), shares @ pull[active]
    bound = shares @ level[active] - right @ np.linalg.lstsq(mean, right, rcond=None)[0]
    if errors.max() > (1 + 2 * GAP) * bound:
        raise ConvergenceError(
            "E-HANDEYE-METHOD-FAILS",
            f"hand-eye: zhao's largest error is {np.sqrt(errors.max() / max(bound, 1e-300)):.4g} times its proven "
            "bound; use another method",
        )
    return x
