"""Poses with covariance, chained: rotation (rad) and translation (mm), left perturbation in the outer frame."""

from dataclasses import dataclass

import numpy as np

from stcal.geometry.arrays import Array, freeze
from stcal.geometry.rigid import Rigid, skew


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
