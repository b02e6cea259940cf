"""A model that goes out must be the run's: what it shows of every keypoint, and where its cameras stand."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stcal.errors import InputError
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid
from stcal.io.json import Part
from stcal.labels import Label
from stcal.sfm.runs.report import CameraInSpace, ImageResiduals, ReportCamera

ROUNDING = 1e-6
"""Of a residual, relative, …"""
ROUNDING_PX = 1e-4
"""… and in px: computed again from the model's files."""
SAME_PLACE_MM = 1e-6
SAME_AXES = 1e-9
"""Of cameras in the model and in ``report.json``, which have the same doubles."""


class Cameras(Part):
    """What of the report's picture in space is needed."""

    cameras: list[CameraInSpace]


class ReportOfModel(Part):
    """What ``report.json`` says of the run's final model."""

    camera: ReportCamera
    residuals_by_image: list[ImageResiduals]
    scene: Cameras


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """What an image shows of the model: ``labels`` of n points, ``xyz`` (n, 3) mm, target frame, and ``xy_px`` (n, 2)
    of their keypoints, OpenCV pixel origin."""

    camera_from_target: Rigid
    labels: Sequence[Label]
    xyz: np.ndarray
    xy_px: np.ndarray

    def off_px(self, camera: Camera) -> np.ndarray:
        """(n,) how far keypoints are from the images of their points; infinite where a point is behind the camera."""
        inside = self.camera_from_target @ self.xyz
        with np.errstate(all="ignore"):
            off = np.linalg.norm(camera.project(inside) - self.xy_px, axis=1)
        return np.where((inside[:, 2] > 0) & np.isfinite(off), off, np.inf)


def require_fit(path: Path, views: Mapping[str, View], camera: Camera, report: ReportOfModel) -> None:
    """Every keypoint must be as near to its point's image as the report says, and every camera where it says.

    Parameters
    ----------
    path : Path
        Of the model, for messages.
    views : mapping of str to View
        By image.
    camera : Camera
        The model's.
    report : ReportOfModel
        Of its run.

    Raises
    ------
    InputError
        Names the image, the point that is farthest off by its limit, and by how much.
    """
    limits = {row.image: row for row in report.residuals_by_image}
    worst = (1.0, "")
    for image, view in views.items():
        row = limits.get(image)
        if row is None or row.observations != len(view.labels) or not len(view.labels):
            known = 0 if row is None else row.observations
            raise InputError(
                "E-MODEL-NOT-OF-RUN",
                f"model {path}: image {image} shows {len(view.labels)} points, {known} by report.json; run it again",
            )
        limit = (1 + ROUNDING) * max(row.max_px, 0.0) + ROUNDING_PX
        off = view.off_px(camera)
        k = int(np.argmax(off))
        if off[k] / limit > worst[0]:
            far = f"{off[k]:.3g} px from its keypoint, {row.max_px:.3g} px allowed by report.json"
            where = far if np.isfinite(off[k]) else "behind the camera"
            worst = off[k] / limit, f"{view.labels[k]} in {image} is {where}"
    if worst[1]:
        raise InputError(
            "E-MODEL-NOT-OF-RUN",
            f"model {path}: {worst[1]}; is it mirrored, or was a point or a pose moved? Run it again",
        )
    _require_places(path, views, report)


def _require_places(path: Path, views: Mapping[str, View], report: ReportOfModel) -> None:
    """Residuals do not tell a model that was moved, turned or scaled as a whole."""
    known = {camera.image: camera for camera in report.scene.cameras}
    missing = sorted(known.keys() ^ views.keys())
    if missing:
        raise InputError(
            "E-MODEL-NOT-OF-RUN", f"model {path}: image {missing[0]} is not in both model and report.json; run it again"
        )
    for image, view in views.items():
        apart = np.linalg.norm(view.camera_from_target.inverse().translation - known[image].position_mm)
        turned = np.abs(view.camera_from_target.rotation - known[image].axes).max()
        if not (apart <= SAME_PLACE_MM and turned <= SAME_AXES):
            raise InputError(
                "E-MODEL-NOT-OF-RUN",
                f"model {path}: image {image}: its camera is {apart:.3g} mm from where report.json has it (axes differ "
                f"by {turned:.2g}), {SAME_PLACE_MM:g} mm allowed; run it again",
            )
