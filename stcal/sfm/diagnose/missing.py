"""The circles of the design that should be visible in an image according to the final model, even if never mapped."""

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
"""Least number of mapped circles that place the others of their plane."""


def missing_circles(
    model: MetricModel,
    circles: dict[str, np.ndarray],
    observations: dict[str, ImageObservations],
    camera: Camera,
    target: TargetDesign,
    board: BoardDesign,
) -> dict[str, list[Expected]]:
    """Returns, by image of one group, the planes with circles that should be visible but have no label.

    Parameters
    ----------
    model : the model of the group, target frame, mm
    circles : centres of the target's circles, (3,) by label, target frame, mm; centres of the model take precedence
    observations : observations by image
    """
    xyz = circles | dict(zip(model.labels, model.xyz_model, strict=True))
    patterns = patterns_of(target, board).values()
    placed = [(pattern, pose) for pattern in patterns if (pose := _placed(pattern, xyz)) is not None]
    border = ideal_border(camera)
    planes_by_image = {}
    for name, camera_from_target in zip(model.images, model.camera_from_model, strict=True):
        labels_observed = set(observations[name].labels)
        planes = []
        for pattern, target_from_plane in placed:
            pose = camera_from_target @ target_from_plane
            missing = in_view(pattern, pose, camera, border) & [
                label not in labels_observed for label in pattern.labels
            ]
            if missing.any():
                planes.append(Expected(pattern, pose, missing))
        if planes:
            planes_by_image[name] = planes
    return planes_by_image


def _placed(pattern: Pattern, xyz: dict[str, np.ndarray]) -> Rigid | None:
    """Returns target_from_plane, fitted to the mapped circles, or None if they are too few or collinear."""
    mapped_rows = [i for i, label in enumerate(pattern.labels) if label in xyz]
    if len(mapped_rows) < MIN_MAPPED:
        return None
    try:
        return align_rigid(np.array([xyz[pattern.labels[i]] for i in mapped_rows]), pattern.xyz_mm()[mapped_rows])
    except DegenerateError:
        return None
