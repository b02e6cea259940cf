"""What an error of the camera file does to hand and eye that were found with the camera as filed.

Parameters that are not solved for, but are not exact either, are *considered* (Schmidt 1966; Bierman, "Factorization
Methods for Discrete Sequential Estimation", 1977, ch. VIII): what is known of them is carried through the solution.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from stcal.geometry.normal_equations import generalised_inverse
from stcal.geometry.rigid import Poses
from stcal.handeye.data.loop import Loop
from stcal.handeye.data.views import Views, whitened
from stcal.handeye.methods.bundle import Bundle, Corners, camera_parts
from stcal.handeye.methods.pose_adjustment import LoopState, PoseSolution
from stcal.handeye.methods.rounds import Problem, estimated
from stcal.io.cameras.model import CameraPrior, intrinsic_basis

ROUNDS = 50
SETTLED = 1e-3
"""Relative change of the factors of σ that moves nothing any more."""


@dataclass(frozen=True, slots=True, eq=False)
class CameraError:
    """``slope`` : (12, q) of the normal equations of X and Z, by the intrinsics; ``moment`` : (q, q) second moment of
    the intrinsics' error about zero, from what is known of them and from the corners; ``noise`` : (12, 12) covariance
    of the gradient by all other errors, None where it is the normal matrix. Of a rig of c cameras, 6c + 6 for 12."""

    slope: np.ndarray
    moment: np.ndarray
    noise: np.ndarray | None = None

    def covariance(self, inverse: np.ndarray) -> np.ndarray:
        """(12, 12) of X and Z, of which ``inverse`` (12, 12) is the inverse normal matrix."""
        moved = inverse @ self.slope
        own = inverse if self.noise is None else inverse @ self.noise @ inverse
        return own + moved @ self.moment @ moved.T


def of_corners(corners: Corners, state: Bundle, prior: CameraPrior, free: tuple[str, ...]) -> CameraError:
    """Of a reprojection adjustment with the intrinsics as filed."""
    known = np.linalg.inv(prior.covariance)
    return considered(corners.with_intrinsics(intrinsic_basis(prior.colmap_model), known), state, free)


def considered(wider: Problem, state: Any, free: tuple[str, ...]) -> CameraError:
    """Of intrinsics that were not solved for, but are among the unknowns of ``wider``.

    Corners that are off by the camera's error make all ``free`` σ too large: they are estimated anew with the
    intrinsics among the unknowns, linear about the state.
    """
    factors, poses = wider.factors(), wider.places()["z"].stop
    sigma = wider.sigma | estimated(wider, state, (*free, *factors))
    at, linear = wider.places(), wider.with_sigma(sigma).linear(state)
    camera = np.arange(at["camera"].start, at["camera"].stop)
    others = np.setdiff1d(np.arange(wider.count()), camera)
    covariance = generalised_inverse(linear.normal)
    error = -covariance[camera] @ linear.gradient
    # What all others follow, in units of the σ that the solution was weighted by.
    normal, noise = np.zeros((2, wider.count(), wider.count()))
    for group in wider.groups(state):
        for name, (_, part) in group.by_name().items():
            if name not in factors:
                normal += part.normal
                noise += part.normal * (sigma[name] / wider.sigma[name]) ** 2 if name in free else part.normal
    rest = others[poses:]
    reduced = np.eye(poses, len(others))
    reduced[:, poses:] = -normal[np.ix_(others[:poses], rest)] @ generalised_inverse(normal[np.ix_(rest, rest)])
    return CameraError(
        slope=reduced @ normal[np.ix_(others, camera)],
        moment=covariance[np.ix_(camera, camera)] + np.outer(error, error),
        noise=reduced @ noise[np.ix_(others, others)] @ reduced.T,
    )


def of_poses(loop: Loop, solution: PoseSolution, views: Views, prior: CameraPrior) -> CameraError:
    """Of an adjustment of the board's poses, each from its view by the camera as filed."""
    used = np.flatnonzero(~solution.outliers)
    basis = intrinsic_basis(prior.colmap_model)
    by_camera, own = poses_by_camera(views, loop.camera_from_board, basis, prior)
    state: LoopState = solution.state
    jacobian = loop.jacobian(state.mount_from_camera, state.scale)[:, :, :12]
    moves = loop.by_camera(state.mount_from_camera, state.scale) @ by_camera
    weighted = np.linalg.solve(solution.covariance[used], moves[used])
    return CameraError(np.einsum("mai,maj->ij", jacobian[used], weighted), own)


def poses_by_camera(
    views: Views, camera_from_board: Poses, basis: np.ndarray, prior: CameraPrior
) -> tuple[np.ndarray, np.ndarray]:
    """Derivative (m, 6, q) of the board's pose in each view by the intrinsics, and their :func:`moment` (q, q)."""
    q = basis.shape[1]
    information, gradient, cost, slopes = np.zeros((q, q)), np.zeros(q), 0.0, []
    for view, pose in zip(views.views, camera_from_board, strict=True):
        white, by_pose = whitened(view, views.camera, pose)
        point = pose @ view.xyz_board
        by_own = view.whitening() @ views.camera.parameter_jacobian(point[:, :2] / point[:, 2:]) @ basis
        by_own = by_own.reshape(-1, q)
        slopes.append(-np.linalg.lstsq(by_pose, by_own)[0])
        left = by_own + by_pose @ slopes[-1]
        information += left.T @ left
        gradient += left.T @ white
        cost += float(white @ white)
    gain = float(gradient @ generalised_inverse(information) @ gradient)
    redundancy = 2 * views.corners() - 6 * len(views) - q
    variance = (cost - gain) / redundancy if redundancy > 0 else 1.0
    return np.array(slopes), moment(information / variance, gradient / variance, basis, prior)


def moment(information: np.ndarray, gradient: np.ndarray, basis: np.ndarray, prior: CameraPrior) -> np.ndarray:
    """Second moment (q, q) of the intrinsics' error: squared estimate and its covariance.

    Where the corners contradict the prior, its σ are widened by kind, by expectation and maximisation of the likelihood
    (Dempster, Laird & Rubin 1977), as an adjustment of the intrinsics would.
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
        found = covariance + np.outer(error, error)
        new = [max(float(np.trace(known[np.ix_(r, r)] @ found[np.ix_(r, r)])) / len(r), 1.0) for r in parts]
        settled = np.abs(np.log(new / squared)).max() < SETTLED
        squared = np.array(new)
        if settled:
            break
    return found
