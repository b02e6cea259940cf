"""Common part of the errors of all poses that is due to target and camera, expressed by a few directions."""

from collections.abc import Sequence

import numpy as np

from stcal.io.cameras.model import CameraPrior
from stcal.sfm.measurement.pose import TargetPose
from stcal.sfm.measurement.target import TargetCircles

FELT = 0.5
"""Variance, in units of their noise, that a common error may have in the direction in which all poses together feel it
most, and still pass for independent: a result that feels nothing but this has a σ that is 20 % too small."""
MOST = 24
"""Largest number of directions."""
LARGEST_SHARE = 0.999
"""Largest common share of a pose's variance in any direction. The remainder must stay positive definite, even after
rounding or if the likelihood of a pose is narrower than its linearisation."""


def common_errors(poses: Sequence[TargetPose], target: TargetCircles, prior: CameraPrior | None) -> np.ndarray:
    """Returns the common errors (m, 6, r): pose i has the common error ``common[i] @ z``.

    The vector z, r independent normal numbers of σ 1, is the same for all poses. The errors are those of the circles
    and of the intrinsics as far as they matter (:data:`FELT`): the largest directions over all poses, each pose in
    units of its covariance. rad and mm, left perturbation in the camera frame.
    """
    if not poses:
        return np.zeros((0, 6, 0))
    circles, intrinsics = _root(target.covariance), _root(np.zeros((0, 0)) if prior is None else prior.covariance)
    effects = []
    for pose in poses:
        place = np.array([target.place[label] for label in pose.labels])
        rows = (3 * place[:, None] + np.arange(3)).ravel()
        effects.append(np.hstack([pose.by_circles @ circles[rows], pose.by_intrinsics @ intrinsics]))
    full = np.array(effects)
    pose_roots = np.linalg.cholesky(np.array([pose.covariance for pose in poses]))
    white = np.linalg.solve(pose_roots, full)
    _, s, vt = np.linalg.svd(white.reshape(-1, full.shape[2]), full_matrices=False)
    white = white @ vt[: min(int((s**2 > FELT).sum()), MOST)].T
    u, s, vt = np.linalg.svd(white, full_matrices=False)
    return pose_roots @ (u * np.minimum(s, np.sqrt(LARGEST_SHARE))[:, None]) @ vt


def _root(covariance: np.ndarray) -> np.ndarray:
    """Returns a square root (n, n) of the covariance. Its product with its transpose is the covariance."""
    value, vector = np.linalg.eigh(covariance)
    return vector * np.sqrt(np.maximum(value, 0))
