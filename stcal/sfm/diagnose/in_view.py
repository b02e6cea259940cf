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
from stcal.sfm.data.model import MetricModel
from stcal.sfm.data.observations import ImageObservations
from stcal.sfm.diagnose.examine import Expected

MAX_TILT_RAD = np.radians(70.0)
"""Between a circle's normal and the line of sight; what is seen more obliquely need not be found."""
MIN_MAPPED = 3
"""Circles of a plane that place the others."""
RIM = np.stack([np.cos(np.arange(24) * np.pi / 12), np.sin(np.arange(24) * np.pi / 12)], axis=1)
BORDER_POINTS = 33


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


def in_view(
    camera_from_plane: Rigid, xy_mm: np.ndarray, radius_mm: np.ndarray, side: int, camera: Camera, border: np.ndarray
) -> np.ndarray:
    """Mask of the circles that face the camera and lie in the image with their whole rim.

    ``side`` : 1 where the plane's Z is the side that the circles are seen from, −1 where it is the other;
    ``border`` : of :func:`ideal_border`; beyond it a lens model may fold back.
    """
    axes = camera_from_plane.rotation
    xyz = camera_from_plane @ np.column_stack([xy_mm, np.zeros(len(xy_mm))])
    cosine = -side * (xyz @ axes[:, 2]) / np.linalg.norm(xyz, axis=1)
    shown = (cosine > np.cos(MAX_TILT_RAD)) & (xyz[:, 2] > radius_mm)
    rim = xyz[shown, None] + radius_mm[shown, None, None] * (RIM @ axes[:, :2].T)
    ideal = rim[..., :2] / rim[..., 2:]
    whole = ((ideal > border[0]) & (ideal < border[1])).all((1, 2))
    rim_px = camera.pixel_from_normalised(np.clip(ideal, *border))
    whole &= ((rim_px >= 0) & (rim_px <= [camera.width - 1, camera.height - 1])).all((1, 2))
    shown[shown] = whole
    return shown


def ideal_border(camera: Camera) -> np.ndarray:
    """Least and largest ideal coordinates, (2, 2), along the image's border."""
    t = np.linspace(0, 1, BORDER_POINTS)
    x, y = t * (camera.width - 1), t * (camera.height - 1)
    zero = np.zeros(BORDER_POINTS)
    sides = [(x, zero), (x, zero + camera.height - 1), (zero, y), (zero + camera.width - 1, y)]
    ideal = camera.normalised_from_pixel(np.concatenate([np.column_stack(side) for side in sides]))
    return np.stack([ideal.min(0), ideal.max(0)])
