"""Least-squares adjustment of the poses of planes and of the cameras that see them."""

from dataclasses import dataclass

import numpy as np

from stcal.adjust.engine import Adjustment, Huber
from stcal.geometry.least_squares import PoseStack
from stcal.geometry.rigid import skew

HUBER_PX = 1.5
"""Residual beyond which an observation loses weight.

Such residuals are deviations of printed planes, not of centres.
"""
SETTLED = 1e-4
"""Relative decrease of χ² at convergence. A prediction to a fraction of a pixel is sufficient."""
MAX_STEPS = 30


@dataclass(frozen=True, slots=True, eq=False)
class PlaneBundle:
    """Points of planes: ``image``, ``plane`` (n,); ``xyz`` (n, 3) in the plane; ``seen`` (n, 2) measured, ideal px."""

    image: np.ndarray
    plane: np.ndarray
    xyz: np.ndarray
    seen: np.ndarray
    focal_px: float

    def adjusted(self, poses: PoseStack, planes: PoseStack) -> tuple[PoseStack, PoseStack]:
        """Returns the poses camera_from_world of the m images and world_from_plane of the planes; the first plane is
        fixed.

        Without convergence the last state is returned, and the start where a point lies behind its camera: predictions
        are verified anyway.
        """
        if not np.isfinite(self._off(planes, poses)).all():
            return poses, planes
        a = Adjustment()
        placed, cameras = a.block("planes", planes, fixed=[0]), a.block("cameras", poses, eliminate=True)
        on = [(placed, self.plane), (cameras, self.image)]
        a.factor(self._off, on, derivatives=self._slopes, loss=Huber(HUBER_PX))
        found = a.minimum(settled=SETTLED, max_steps=MAX_STEPS, damping=1e-3).state
        return found["cameras"], found["planes"]

    def _off(self, planes: PoseStack, poses: PoseStack) -> np.ndarray:
        xyz = self._placed(planes, poses)[2]
        if (xyz[:, 2] <= 0).any():
            return np.full(self.seen.shape, np.inf)
        return self.focal_px * xyz[:, :2] / xyz[:, 2:] - self.seen

    def _slopes(self, planes: PoseStack, poses: PoseStack) -> tuple[np.ndarray, np.ndarray]:
        turned, placed, xyz = self._placed(planes, poses)
        by_point = np.zeros((len(xyz), 2, 3))
        by_point[:, 0, 0] = by_point[:, 1, 1] = 1
        by_point[:, :, 2] = -xyz[:, :2] / xyz[:, 2:]
        by_point *= (self.focal_px / xyz[:, 2])[:, None, None]
        by_world = by_point @ poses.rotation[self.image]
        by_plane = np.concatenate([-by_world @ skew(turned), by_world], axis=2)
        return by_plane, np.concatenate([-by_point @ skew(placed), by_point], axis=2)

    def _placed(self, planes: PoseStack, poses: PoseStack) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns the points turned into the world, turned into the cameras, and in the cameras' frames, (n, 3)."""
        turned = np.einsum("nij,nj->ni", planes.rotation[self.plane], self.xyz)
        placed = np.einsum("nij,nj->ni", poses.rotation[self.image], turned + planes.translation[self.plane])
        return turned, placed, placed + poses.translation[self.image]
