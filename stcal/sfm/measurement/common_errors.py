"""What the errors of target and camera do to all poses together: their common part, by a few directions."""

from collections.abc import Sequence

import numpy as np

from stcal.io.cameras.model import CameraPrior
from stcal.sfm.measurement.pose import TargetPose
from stcal.sfm.measurement.target import TargetCircles

FELT = 0.5
"""Variance, in units of their noise, that a common error may have in the direction in which all poses together feel it
most, and still pass for independent: a result that feels nothing but this has a σ that is 20 % too small."""
MOST = 24
"""Directions at the most."""
LARGEST_SHARE = 0.999
"""Of a pose's variance, in any direction: what is left must be one, also where the likelihood of a pose is narrower
than its linearisation, and after rounding."""


def common_errors(poses: Sequence[TargetPose], target: TargetCircles, prior: CameraPrior | None) -> np.ndarray:
    """(m, 6, r): pose i errs by ``common[i] @ z``, z the same r independent normal numbers of σ 1 for all poses.

    The circles' errors, and those of the intrinsics, as far as they are felt (:data:`FELT`): the largest directions of
    the whole, each pose in units of its covariance. rad and mm, left perturbation in the camera frame.
    """
    if not poses:
        return np.zeros((0, 6, 0))
    circles, intrinsics = _root(target.covariance), _root(np.zeros((0, 0)) if prior is None else prior.covariance)
    every = []
    for pose in poses:
        place = np.array([target.place[label] for label in pose.labels])
        rows = (3 * place[:, None] + np.arange(3)).ravel()
        every.append(np.hstack([pose.by_circles @ circles[rows], pose.by_intrinsics @ intrinsics]))
    full = np.array(every)
    own = np.linalg.cholesky(np.array([pose.covariance for pose in poses]))
    white = np.linalg.solve(own, full)
    _, s, vt = np.linalg.svd(white.reshape(-1, full.shape[2]), full_matrices=False)
    white = white @ vt[: min(int((s**2 > FELT).sum()), MOST)].T
    u, s, vt = np.linalg.svd(white, full_matrices=False)
    return own @ (u * np.minimum(s, np.sqrt(LARGEST_SHARE))[:, None]) @ vt


def _root(covariance: np.ndarray) -> np.ndarray:
    """(n, n) of which the product with its transpose is the covariance."""
    value, vector = np.linalg.eigh(covariance)
    return vector * np.sqrt(np.maximum(value, 0))
