"""Poses with covariance, and the fit of a pose to its image.

Covariances are those of rotation (rad) and translation (mm), left perturbation in the outer frame.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from stcal.geometry.arrays import Array, freeze
from stcal.geometry.rigid import Rigid, skew


class ImageFit:
    """Statistics of a pose's residuals in an image."""

    __slots__ = ()
    residuals_px: np.ndarray
    chi2: float
    redundancy: int

    def rms_px(self) -> float:
        """Return the RMS of the residuals per coordinate."""
        return float(np.sqrt((self.residuals_px**2).mean()))

    def chi2_per_redundancy(self) -> float:
        """Return χ² per redundancy; it is about 1 if the σ of points, target and intrinsics are true."""
        return self.chi2 / self.redundancy

    def p_value(self) -> float:
        """Return the probability of residuals at least as large if the stated σ are true."""
        return float(chdtrc(self.redundancy, self.chi2))


@dataclass(frozen=True, slots=True, eq=False)
class UncertainRigid:
    """A transform a_from_b with ``covariance`` (6, 6) of its errors: R' = exp(w) R, t' = t + dt.

    A covariance of zero means an exact transform.
    """

    rigid: Rigid
    covariance: Array

    def __post_init__(self):
        freeze(self, "covariance", (6, 6), "pose covariance")

    @classmethod
    def exact(cls, rigid: Rigid) -> "UncertainRigid":
        """Return the transform with a covariance of zero."""
        return cls(rigid, np.zeros((6, 6)))

    def __matmul__(self, other: "UncertainRigid") -> "UncertainRigid":
        """Return a_from_c with its covariance to first order, the errors of both transforms being independent."""
        arm = self.rigid.rotation @ other.rigid.translation
        by_self, by_other = np.eye(6), np.zeros((6, 6))
        by_self[3:, :3] = -skew(arm)
        by_other[:3, :3] = by_other[3:, 3:] = self.rigid.rotation
        covariance = by_self @ self.covariance @ by_self.T + by_other @ other.covariance @ by_other.T
        return UncertainRigid(self.rigid @ other.rigid, (covariance + covariance.T) / 2)
