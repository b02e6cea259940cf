"""Poses with σ, for terminals and pages."""

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.geometry.rigid import Rigid
from stcal.report.text import number

HEADS = ("", "mm", "± σ", "rotation vector °", "± σ")
"""Heads of the columns of :func:`transform_rows`."""


def transform_rows(pose: Rigid, covariance: np.ndarray | None) -> list[list[str]]:
    """Return a row for each of x, y, z: translation in mm and rotation vector in degrees, each with σ."""
    turn = np.degrees(Rotation.from_matrix(np.array(pose.rotation)).as_rotvec())
    sigma = [None] * 6 if covariance is None else np.sqrt(np.maximum(np.diag(covariance), 0))
    sigma = [*(None if s is None else np.degrees(s) for s in sigma[:3]), *sigma[3:]]
    columns = zip("xyz", pose.translation, sigma[3:], turn, sigma[:3], strict=True)
    return [[a, number(t, 4), number(s, 4), number(r, 4), number(d, 4)] for a, t, s, r, d in columns]
