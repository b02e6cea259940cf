"""The effect of an error of the camera file on X and Z that were found with the camera as filed.

Parameters that are not solved for, but are not exact either, are *considered* (Schmidt 1966; Bierman, "Factorization
Methods for Discrete Sequential Estimation", 1977, ch. VIII): their prior covariance is carried through the solution.
"""

from dataclasses import dataclass
from functools import reduce
from operator import add

import numpy as np

from stcal.geometry.camera import intrinsic_basis
from stcal.geometry.normal_equations import generalised_inverse
from stcal.geometry.rigid import Poses
from stcal.handeye.data.pairs import Loop
from stcal.handeye.data.views import Views, whitened
from stcal.handeye.methods.bundle import RigBundle, RigCorners, camera_parts
from stcal.handeye.methods.noise import estimated
from stcal.handeye.methods.pose_adjustment import LoopState, PoseSolution
from stcal.io.cameras.model import CameraPrior

ROUNDS = 50
SETTLED = 1e-3
"""Relative change of the factors of σ below which the iteration has converged."""


@dataclass(frozen=True, slots=True, eq=False)
class CameraError:
    """``slope`` : (12, q) derivative of the gradient of X and Z by the intrinsics; ``moment`` : (q, q) second moment of
    the intrinsics' error about zero, from the prior and from the corners; ``noise`` : (12, 12) covariance of the
    gradient by all other errors, None where it equals the normal matrix. For a rig of c cameras, 6c + 6 replaces 12."""

    slope: np.ndarray
    moment: np.ndarray
    noise: np.ndarray | None = None

    def covariance(self, inverse: np.ndarray) -> np.ndarray:
        """Returns the covariance (12, 12) of X and Z, given their inverse normal matrix ``inverse`` (12, 12)."""
        moved = inverse @ self.slope
        without_camera = inverse if self.noise is None else inverse @ self.noise @ inverse
        return without_camera + moved @ self.moment @ moved.T


def considered(wider: RigCorners, state: RigBundle, free: tuple[str, ...]) -> CameraError:
    """Returns the effect of intrinsics that were not solved for, but are among the unknowns of ``wider``.

    Corners that are off by the camera's error make all ``free`` σ too large. These σ are therefore estimated again with
    the intrinsics among the unknowns, linear about the state.
    """
    factors, poses = wider.factors(), wider.places()["z"].stop
    sigma = wider.sigma | estimated(wider, state, (*free, *factors))
    camera = np.arange(wider.places()["camera"].start, wider.places()["camera"].stop)
    left = wider.with_sigma(sigma).linear(state).eliminated()
    covariance = generalised_inverse(left.normal)
    error = -covariance[camera] @ left.gradient
    # Equations and gradient noise of all other observations, in units of the σ that weighted the solution.
    parts = {name: part.equations for name, part in wider.parts(state).items() if name not in factors}
    scatter = {name: (sigma[name] / wider.sigma[name]) ** 2 if name in free else 1.0 for name in parts}
    known = reduce(add, parts.values())
    noise = reduce(add, (own.times(scatter[name]) for name, own in parts.items()))
    without_board = known.eliminated()
    others = np.setdiff1d(np.arange(len(known.gradient)), camera)
    eliminated, normal = others[poses:], without_board.normal
    reduced = np.eye(poses, len(others))
    reduced[:, poses:] = -normal[np.ix_(others[:poses], eliminated)] @ generalised_inverse(
        normal[np.ix_(eliminated, eliminated)]
    )
    scattered = noise.normal
    if known.cross is not None and without_board.from_kept is not None and noise.cross is not None:
        by_corner = without_board.from_kept  # what the gradient of the others takes over from that of the corners
        mixed = np.tensordot(by_corner, noise.cross, ((0, 1), (0, 1)))
        scattered = scattered - mixed - mixed.T
        scattered = scattered + np.tensordot(by_corner, noise.block @ by_corner, ((0, 1), (0, 1)))
    return CameraError(
        slope=reduced @ normal[np.ix_(others, camera)],
        moment=covariance[np.ix_(camera, camera)] + np.outer(error, error),
        noise=reduced @ scattered[np.ix_(others, others)] @ reduced.T,
    )


def of_poses(loop: Loop, solution: PoseSolution, views: Views, prior: CameraPrior) -> CameraError:
    """Returns the camera error of an adjustment of the board's poses, each of which was found from its view with the
    camera as filed."""
    basis = intrinsic_basis(prior.colmap_model)
    by_camera, second_moment = poses_by_camera(views, loop.camera_from_board, basis, prior)
    return CameraError(_slope(loop, solution, by_camera), second_moment)


def in_common(loop: Loop, solution: PoseSolution, common: np.ndarray) -> CameraError:
    """Returns the effect of errors (m, 6, k) that the board's poses have in common, which their residuals hardly show.

    The poses were weighed by their other errors alone.
    """
    return CameraError(_slope(loop, solution, common), np.eye(common.shape[2]))


def _slope(loop: Loop, solution: PoseSolution, by_unknown: np.ndarray) -> np.ndarray:
    """Returns the derivative (12, q) of the gradient of X and Z, from that of the board's poses (m, 6, q)."""
    used = np.flatnonzero(~solution.outliers)
    state: LoopState = solution.state
    jacobian = loop.jacobian(state.mount_from_camera, state.scale)[:, :, :12]
    moves = loop.by_camera(state.mount_from_camera, state.scale) @ by_unknown
    weighted = np.linalg.solve(solution.covariance[used], moves[used])
    return np.einsum("mai,maj->ij", jacobian[used], weighted)


def poses_by_camera(
    views: Views, camera_from_board: Poses, basis: np.ndarray, prior: CameraPrior
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the derivative (m, 6, q) of the board's pose in each view by the intrinsics, and the :func:`moment` (q,
    q) of the intrinsics."""
    q = basis.shape[1]
    information, gradient, cost, slopes = np.zeros((q, q)), np.zeros(q), 0.0, []
    for view, pose in zip(views.views, camera_from_board, strict=True):
        white, by_pose = whitened(view, views.camera, pose)
        point = pose @ view.xyz_board
        by_own = view.whitening() @ views.camera.parameter_jacobian(point[:, :2] / point[:, 2:]) @ basis
        by_own = by_own.reshape(-1, q)
        slopes.append(-np.linalg.lstsq(by_pose, by_own)[0])
        reduced = by_own + by_pose @ slopes[-1]
        information += reduced.T @ reduced
        gradient += reduced.T @ white
        cost += float(white @ white)
    gain = float(gradient @ generalised_inverse(information) @ gradient)
    redundancy = 2 * views.corners() - 6 * len(views) - q
    variance = (cost - gain) / redundancy if redundancy > 0 else 1.0
    return np.array(slopes), moment(information / variance, gradient / variance, basis, prior)


def moment(information: np.ndarray, gradient: np.ndarray, basis: np.ndarray, prior: CameraPrior) -> np.ndarray:
    """Returns the second moment (q, q) of the intrinsics' error: squared estimate plus covariance.

    Where the corners contradict the prior, the prior σ are widened by kind, as an adjustment of the intrinsics would
    do. The factors maximise the likelihood by expectation and maximisation (Dempster, Laird & Rubin 1977).
    """
    known = np.linalg.inv(prior.covariance)
    parts = [rows for _, rows in camera_parts(basis, known)]
    squared = np.ones(len(parts))
    for _ in range(ROUNDS):
        scaled = known.copy()
        for rows, value in zip(parts, squared, strict=True):
            scaled[np.ix_(rows, rows)] /= value
        covariance = np.linalg.inv(information + scaled)
        error = -covariance @ gradient
        second = covariance + np.outer(error, error)
        new = [max(float(np.trace(known[np.ix_(r, r)] @ second[np.ix_(r, r)])) / len(r), 1.0) for r in parts]
        settled = np.abs(np.log(new / squared)).max() < SETTLED
        squared = np.array(new)
        if settled:
            break
    return second
