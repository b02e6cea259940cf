"""Which circles of the design are in view in an image, by the final model: also those that were never mapped."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stcal.design import BoardDesign, TargetDesign
from stcal.errors import DegenerateError
from stcal.geometry.align import align_rigid
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid
from stcal.labels import BOARD, Label
from stcal.sfm.data.in_view import ideal_border, in_view
from stcal.sfm.data.model import MetricModel
from stcal.sfm.data.observations import ImageObservations
from stcal.sfm.diagnose.examine import Expected

MIN_MAPPED = 3
"""Circles of a plane that place the others."""


@dataclass(frozen=True, slots=True, eq=False)
class _Plane:
    """The design of a face or the board; ``side`` : as of :func:`in_view`."""

    name: str
    labels: Sequence[Label]
    xy_mm: np.ndarray
    radius_mm: np.ndarray
    side: int

    def placed(self, xyz: dict[str, np.ndarray]) -> Rigid | None:
        """target_from_plane, the rigid fit to the mapped circles; None where they are too few or in line."""
        own = [i for i, label in enumerate(self.labels) if label in xyz]
        if len(own) < MIN_MAPPED:
            return None
        flat = np.column_stack([self.xy_mm[own], np.zeros(len(own))])
        try:
            return align_rigid(np.array([xyz[self.labels[i]] for i in own]), flat)
        except DegenerateError:
            return None


def missing_circles(
    model: MetricModel,
    circles: dict[str, np.ndarray],
    observations: dict[str, ImageObservations],
    camera: Camera,
    target: TargetDesign,
    board: BoardDesign,
) -> dict[str, list[Expected]]:
    """Planes of which circles are in view and have no label, by image of one group.

    Parameters
    ----------
    model : the group's, target frame, mm
    circles : centres of the target's circles, (3,) by label, target frame, mm; the model's own go first
    observations : by image
    """
    xyz = circles | dict(zip(model.labels, model.xyz_model, strict=True))
    designs = [_Plane(f.id, f.labels(), f.xy_mm, f.radius_mm, 1) for f in target.faces]
    designs.append(_Plane(BOARD, board.labels(), board.xy_mm(), board.radii_mm(), -1))  # Z points into the board
    placed = [(plane, pose) for plane in designs if (pose := plane.placed(xyz)) is not None]
    border = ideal_border(camera)
    found = {}
    for name, camera_from_target in zip(model.images, model.camera_from_model, strict=True):
        seen = set(observations[name].labels)
        planes = []
        for plane, target_from_plane in placed:
            pose = camera_from_target @ target_from_plane
            missing = in_view(pose, plane.xy_mm, plane.radius_mm, plane.side, camera, border)
            missing &= [label not in seen for label in plane.labels]
            if missing.any():
                homography = np.column_stack([pose.rotation[:, :2], pose.translation])
                planes.append(
                    Expected(plane.name, homography, tuple(plane.labels), plane.xy_mm, plane.radius_mm, missing)
                )
        if planes:
            found[name] = planes
    return found
