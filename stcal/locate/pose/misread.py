"""Frequent mistakes in layouts: what the layout would be without them, and whether the tags in an image fit then."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from stcal.errors import StcalError
from stcal.geometry.camera import Camera
from stcal.io.cameras.model import CameraPrior
from stcal.locate.data.layout import TargetLayout
from stcal.locate.pose.estimate import ObjPose, SeenTags, locate

LEAST_TAGS = 2
"""A single tag fits each way round."""
FITS = 0.02
"""Largest RMS distance of corners from where a layout has them, over the mean side of the tags in the image. A tag that
is turned or elsewhere misses by half a side and more; lens and print by less than a hundredth."""
BETTER = 3.0
"""Factor by which this distance must shrink for a mistake to be named."""
ALIKE = 1.5
"""Mistakes that fit within this factor of the best one fit as well: the first of them is named, the simplest."""
TURNS = {
    2: "every tag stood half a turn the other way (add 180 to each angle_deg; corners_mm begin at the opposite corner; "
    "of apriltag_ros give upright: true)",
    1: "every tag were turned by 90° more (add 90 to each angle_deg)",
    3: "every tag were turned by 90° less (subtract 90 from each angle_deg)",
}
MIRRORED = "Y pointed down (the layout has it upwards: change the signs of y_mm and angle_deg)"
PLACES_MIRRORED = "Y pointed down (the layout has it upwards: change the signs of y_mm)"


def likely_mistake(
    detected: SeenTags, layout: TargetLayout, camera: Camera, prior: CameraPrior | None, pose: ObjPose | None
) -> str | None:
    """Returns the mistake in a layout whose correction makes all tags fit; None if there is no such mistake.

    Parameters
    ----------
    seen : corners of the layout's tags, px
    layout : the layout as it is
    camera : the camera at the size of the image
    prior : covariance of the intrinsics
    pose : the pose by the layout as it is; None if none was found
    """
    if len(detected) < LEAST_TAGS:
        return None
    side = np.linalg.norm(detected.corners_px - np.roll(detected.corners_px, 1, axis=1), axis=2).mean()
    allowed = FITS * float(side)
    if pose is not None:
        allowed = min(allowed, _misfit_px(detected, layout, camera, pose) / BETTER)
    fitting = []
    for reason, variant in _variants(layout):
        try:
            misfit = _misfit_px(detected, variant, camera, locate(detected, variant, camera, prior))
        except StcalError:  # this layout does not fit either
            continue
        if misfit < allowed:
            fitting.append((misfit, reason))
    best = min((misfit for misfit, _ in fitting), default=0.0)
    return next((reason for misfit, reason in fitting if misfit <= ALIKE * best), None)


def _misfit_px(detected: SeenTags, layout: TargetLayout, camera: Camera, pose: ObjPose) -> float:
    """Returns the RMS distance of all corners, those left out by the pose too, from where the layout has them."""
    corners = layout.corners_mm[detected.rows].reshape(-1, 2)
    xyz_camera = pose.camera_from_obj @ np.column_stack([corners, np.zeros(len(corners))])
    if xyz_camera[:, 2].min() <= 0 or pose.foreshortening <= 0:
        return np.inf
    off = detected.corners_px.reshape(-1, 2) - camera.project(xyz_camera)
    return float(np.sqrt((off**2).sum(axis=1).mean()))


def _variants(layout: TargetLayout) -> Iterator[tuple[str, TargetLayout]]:
    """Yields each mistake with the layout as it would be without it."""
    corners = layout.corners_mm
    for turns, reason in TURNS.items():
        yield reason, replace(layout, corners_mm=np.roll(corners, -turns, axis=1))
    down = np.array([1.0, -1.0])
    # A mirrored tag has its upper corners where the lower ones were.
    mirrored = (corners * down)[:, [3, 2, 1, 0]]
    middles = corners.mean(axis=1, keepdims=True)
    moved = corners - middles + middles * down
    for reason, other in ((MIRRORED, mirrored), (PLACES_MIRRORED, moved)):
        yield reason, replace(layout, corners_mm=other)
        yield f"{reason} and {TURNS[2]}", replace(layout, corners_mm=np.roll(other, 2, axis=1))
