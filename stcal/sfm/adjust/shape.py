"""The points of one face of known shape against its design: their deviations, and what they weigh in an adjustment."""

from dataclasses import dataclass

import numpy as np

from stcal.geometry.align import align_rigid
from stcal.geometry.normal_equations import generalised_inverse
from stcal.geometry.rigid import Rigid, skew

SHAPE_STEPS, SHAPE_SETTLED = 20, 1e-13
"""Most steps of a design that is laid over points, and the step (rad, mm) at which they end."""


@dataclass(frozen=True, slots=True, eq=False)
class Shape:
    """The n points of a face of known shape against its design, which is laid over them with their weights.

    ``members`` : (n,) indices among the circles; ``rotation`` : (3, 3) model_from_face; ``off_mm`` : (n, 3) points
    minus design, face frame; ``weight`` : (n, 3) 1/σ²; ``by_pose`` : (3n, 7) derivative of ``off_mm`` by the pose and
    the relative size of the print; ``size`` : that size minus 1, of weight ``size_weight``, infinite if it is exact.
    """

    members: np.ndarray
    rotation: np.ndarray
    off_mm: np.ndarray
    weight: np.ndarray
    by_pose: np.ndarray
    size: float
    size_weight: float

    @classmethod
    def of(
        cls, members: np.ndarray, design: np.ndarray, xyz: np.ndarray, weight: np.ndarray, size_sigma: float
    ) -> "Shape":
        """Lays the design (n, 3) over points (n, 3); ``size_sigma`` : relative σ of its size."""
        pose, size = align_rigid(xyz, design), 0.0
        size_weight = size_sigma**-2 if size_sigma else np.inf
        free = 7 if size_sigma else 6
        for _ in range(SHAPE_STEPS):
            in_face = (xyz - pose.translation) @ pose.rotation
            off = in_face - (1 + size) * design
            unit = np.broadcast_to(np.eye(3), (len(xyz), 3, 3))
            by_pose = np.concatenate([skew(in_face), -unit, -design[:, :, None]], axis=2).reshape(-1, 7)[:, :free]
            weighted = weight.reshape(-1, 1) * by_pose
            normal, right = by_pose.T @ weighted, weighted.T @ off.ravel()
            if size_sigma:
                normal[6, 6] += size_weight
                right[6] += size_weight * size
            step = -np.linalg.lstsq(normal, right, rcond=1e-12)[0]
            if np.abs(step).max() < SHAPE_SETTLED:
                break
            pose, size = pose @ Rigid.exp(step[:6]), size + float(step[6]) if size_sigma else 0.0
        return cls(members, pose.rotation, off, weight, by_pose, size, size_weight)

    def cost(self) -> float:
        """Returns the squared deviations over σ²."""
        own = self.size_weight * self.size**2 if np.isfinite(self.size_weight) else 0.0
        return float((self.weight * self.off_mm**2).sum()) + own

    def _to_pose(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns the derivative (6, 3n) of the pose by the deviations, and the covariance (6, 6) of the pose; with one
        more row if the size is free."""
        weighted = self.weight.reshape(-1, 1) * self.by_pose
        normal = self.by_pose.T @ weighted
        if np.isfinite(self.size_weight):
            normal[6, 6] += self.size_weight
        inverse = generalised_inverse(normal)
        return inverse @ weighted.T, inverse

    def slope(self) -> np.ndarray:
        """Returns half the gradient of the cost by the points, (3n,), model frame."""
        return ((self.weight * self.off_mm) @ self.rotation.T).ravel()

    def normal(self) -> np.ndarray:
        """Returns the normal matrix (3n, 3n) over the points, model frame, with the pose eliminated."""
        n = len(self.members)
        weighted = self.weight.reshape(-1, 1) * self.by_pose
        inner = np.diag(self.weight.ravel()) - weighted @ self._to_pose()[0]
        blocks = inner.reshape(n, 3, n, 3)
        return np.einsum("ai,minj,bj->manb", self.rotation, blocks, self.rotation, optimize=True).reshape(3 * n, 3 * n)

    def by_size(self) -> np.ndarray:
        """Returns the right-hand side (3n,) of the normal equations that a stated size one σ off brings.

        Model frame; 0 for an exact size.
        """
        if not np.isfinite(self.size_weight):
            return np.zeros(self.off_mm.size)
        weighted = self.weight.reshape(-1, 1) * self.by_pose
        force = weighted @ self._to_pose()[1][:, 6] * np.sqrt(self.size_weight)
        return (force.reshape(-1, 3) @ self.rotation.T).ravel()

    def leverage(self, covariance_mm2: np.ndarray) -> np.ndarray:
        """Returns the variance of each adjusted deviation over its stated variance, (n, 3), at most 1.

        ``covariance_mm2`` : (3n, 3n) of the points."""
        n = len(self.members)
        turned = covariance_mm2.reshape(n, 3, n, 3)
        turned = np.einsum("ai,manb,bj->minj", self.rotation, turned, self.rotation, optimize=True)
        turned = turned.reshape(3 * n, 3 * n)
        to_pose, of_pose = self._to_pose()
        left = np.eye(3 * n) - self.by_pose @ to_pose
        variance = np.einsum("ij,jk,ik->i", left, turned, left, optimize=True)
        variance = variance + np.einsum("ij,jk,ik->i", self.by_pose, of_pose, self.by_pose)
        return self.weight * variance.reshape(n, 3)
