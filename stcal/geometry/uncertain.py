"""Poses with covariance, chained: rotation (rad) and translation (mm), left perturbation in the outer frame; how well
one fits its image."""

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from stcal.geometry.arrays import Array, freeze
from stcal.geometry.rigid import Rigid, skew


class ImageFit:
    """What a pose's residuals in an image say."""

    __slots__ = ()
    residuals_px: np.ndarray
    chi2: float
    redundancy: int

    def rms_px(self) -> float:
        """Of the residuals, per coordinate."""
        return float(np.sqrt((self.residuals_px**2).mean()))

    def chi2_per_redundancy(self) -> float:
        """About 1 where the σ of points, target and intrinsics are true."""
        return self.chi2 / self.redundancy

    def p_value(self) -> float:
        """Probability of residuals as large, with those σ."""
        return float(chdtrc(self.redundancy, self.chi2))


@dataclass(frozen=True, slots=True, eq=False)
class UncertainRigid:
    """a_from_b with ``covariance`` (6, 6): R' = exp(w) R, t' = t + dt; exact where it is zero."""

    rigid: Rigid
    covariance: Array

    def __post_init__(self):
        freeze(self, "covariance", (6, 6), "pose covariance")

    @classmethod
    def exact(cls, rigid: Rigid) -> "UncertainRigid":
        """Without error."""
        return cls(rigid, np.zeros((6, 6)))

    def __matmul__(self, other: "UncertainRigid") -> "UncertainRigid":
        """a_from_c, the errors of both independent, to first order."""
        arm = self.rigid.rotation @ other.rigid.translation
        by_self, by_other = np.eye(6), np.zeros((6, 6))
        by_self[3:, :3] = -skew(arm)
        by_other[:3, :3] = by_other[3:, 3:] = self.rigid.rotation
        covariance = by_self @ self.covariance @ by_self.T + by_other @ other.covariance @ by_other.T
        return UncertainRigid(self.rigid @ other.rigid, (covariance + covariance.T) / 2)
