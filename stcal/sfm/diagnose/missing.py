"""Which circles of the design are in view in an image, by the final model: also those that were never mapped."""

import numpy as np

from stcal.design import BoardDesign, TargetDesign
from stcal.errors import DegenerateError
from stcal.geometry.align import align_rigid
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid
from stcal.sfm.data.model import MetricModel
from stcal.sfm.data.observations import ImageObservations
from stcal.sfm.data.patterns import Pattern, ideal_border, in_view, patterns_of
from stcal.sfm.diagnose.examine import Expected

MIN_MAPPED = 3
"""Circles of a plane that place the others."""


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
    patterns = patterns_of(target, board).values()
    placed = [(pattern, pose) for pattern in patterns if (pose := _placed(pattern, xyz)) is not None]
    border = ideal_border(camera)
    found = {}
    for name, camera_from_target in zip(model.images, model.camera_from_model, strict=True):
        seen = set(observations[name].labels)
        planes = []
        for pattern, target_from_plane in placed:
            pose = camera_from_target @ target_from_plane
            missing = in_view(pattern, pose, camera, border) & [label not in seen for label in pattern.labels]
            if missing.any():
                planes.append(Expected(pattern, pose, missing))
        if planes:
            found[name] = planes
    return found


def _placed(pattern: Pattern, xyz: dict[str, np.ndarray]) -> Rigid | None:
    """target_from_plane, the rigid fit to the mapped circles; None where they are too few or in line."""
    own = [i for i, label in enumerate(pattern.labels) if label in xyz]
    if len(own) < MIN_MAPPED:
        return None
    try:
        return align_rigid(np.array([xyz[pattern.labels[i]] for i in own]), pattern.xyz_mm()[own])
    except DegenerateError:
        return None
