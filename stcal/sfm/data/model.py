"""The model of one group: cameras and labelled points, and the observations they explain. The mapper's world has no
unit, so that its models and those in millimetres are two types: whoever forgets the scale passes the wrong one."""

from dataclasses import dataclass, fields, replace
from typing import TypeVar

import numpy as np

from stcal.geometry.arrays import frozen
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid, Similarity
from stcal.labels import Label, parse_labels
from stcal.sfm.data.observations import ImageObservations

_PER_OBSERVATION = ("image_index", "point_index", "keypoint", "measured_px", "shift_px", "covariance_px2")
MIN_POINTS = 6
"""Labelled points that hold an image; thousands are what COLMAP's own defaults expect."""


@dataclass(frozen=True, slots=True)
class Outlier:
    """An observation that is left out: it contradicts all others."""

    image: str
    label: Label
    residual_px: float
    limit_px: float


@dataclass(frozen=True, slots=True, eq=False)
class GroupModel:
    """m images, p points, n observations of one group; what models with and without unit have in common.

    ``images`` : (m,) names; ``camera_from_model`` : (m,) poses; ``labels`` : (p,); ``xyz_model`` : (p, 3): the model's
    frame, and its unit, are what :class:`WorldModel` and :class:`MetricModel` say;
    ``image_index``, ``point_index`` : (n,); ``keypoint`` : (n,) place among the image's observations;
    ``measured_px`` : (n, 2) ellipse centres; ``shift_px`` : (n, 2) what eccentricity adds to the image of a circle's
    centre, zero until it is known; ``covariance_px2`` : (n, 2, 2) of the measured centres.
    """

    group: str
    images: tuple[str, ...]
    camera_from_model: tuple[Rigid, ...]
    labels: tuple[Label, ...]
    xyz_model: np.ndarray
    image_index: np.ndarray
    point_index: np.ndarray
    keypoint: np.ndarray
    measured_px: np.ndarray
    shift_px: np.ndarray
    covariance_px2: np.ndarray

    def __post_init__(self):
        object.__setattr__(self, "labels", parse_labels(self.labels))
        n = len(self.image_index)
        object.__setattr__(self, "xyz_model", frozen(self.xyz_model, (len(self.labels), 3), "points"))
        for name, shape in (("measured_px", (n, 2)), ("shift_px", (n, 2)), ("covariance_px2", (n, 2, 2))):
            object.__setattr__(self, name, frozen(getattr(self, name), shape, name))
        for name in ("image_index", "point_index", "keypoint"):
            object.__setattr__(self, name, frozen(getattr(self, name), (n,), name, dtype=int))

    def corrected_px(self) -> np.ndarray:
        """Images of the circles' centres, (n, 2): the measured ellipse centres less their eccentricity."""
        return self.measured_px - self.shift_px

    def sigma_px(self) -> np.ndarray:
        """Standard deviation per axis (RMS of the two), (n,)."""
        return np.sqrt(np.trace(self.covariance_px2, axis1=1, axis2=2) / 2)

    def whiten(self, values_px: np.ndarray) -> np.ndarray:
        """Values (n, 2) or (n, 2, k) in pixels, in units of σ along axes that are independent."""
        (xx, xy), (_, yy) = np.moveaxis(self.covariance_px2, (1, 2), (0, 1))
        across = np.sqrt(np.maximum(yy - xy * xy / xx, 1e-12 * yy))
        first, second = values_px[:, 0], values_px[:, 1]
        expand = (...,) if values_px.ndim == 2 else (..., None)
        slope, along, across = (xy / xx)[expand], np.sqrt(xx)[expand], across[expand]
        return np.stack([first / along, (second - slope * first) / across], axis=1)

    def rows_by_image(self) -> list[np.ndarray]:
        """Observations of every image, in the order of ``images``."""
        order = np.argsort(self.image_index, kind="stable")
        return np.split(order, np.searchsorted(self.image_index[order], np.arange(1, len(self.images))))

    def keypoints_px(self, image: ImageObservations, rows: np.ndarray) -> np.ndarray:
        """All keypoints of one image, (k, 2): corrected where the model has them (``rows``), measured elsewhere."""
        xy = image.centre_px.copy()
        xy[self.keypoint[rows]] = self.measured_px[rows] - self.shift_px[rows]
        return xy

    def xyz_camera(self) -> np.ndarray:
        """The observed points in the frames of the cameras that observe them, (n, 3)."""
        rotation = np.stack([pose.rotation for pose in self.camera_from_model])
        translation = np.stack([pose.translation for pose in self.camera_from_model])
        xyz = self.xyz_model[self.point_index]
        return np.einsum("nij,nj->ni", rotation[self.image_index], xyz) + translation[self.image_index]

    def residuals_px(self, camera: Camera) -> np.ndarray:
        """Corrected minus projected, (n, 2)."""
        return self.corrected_px() - camera.project(self.xyz_camera())

    def _placed(self, kind: type["M"], a_from_model: Similarity) -> "M":
        """The same model in another frame, its unit included."""
        rotation, scale = a_from_model.rigid.rotation, a_from_model.scale
        poses = tuple(
            Rigid(
                pose.rotation @ rotation.T,
                scale * pose.translation - pose.rotation @ rotation.T @ a_from_model.rigid.translation,
            )
            for pose in self.camera_from_model
        )
        same = {f.name: getattr(self, f.name) for f in fields(self)}
        return kind(**same | {"camera_from_model": poses, "xyz_model": a_from_model @ self.xyz_model})

    def observed(self: "M", rows: np.ndarray) -> "M":
        """The model with these of its observations, and all of its images and points."""
        return replace(self, **{name: getattr(self, name)[rows] for name in _PER_OBSERVATION})

    def points_by_face(self) -> dict[str, np.ndarray]:
        """Indices of the points of every face, and of the board under ``board``."""
        members: dict[str, list[int]] = {}
        for i, label in enumerate(self.labels):
            members.setdefault(label.plane, []).append(i)
        return {key: np.array(indices) for key, indices in members.items()}

    def without(self: "M", drop: np.ndarray) -> "M":
        """The model without the observations of mask ``drop``, and then without points that fewer than two images
        see and images that see fewer than six points."""
        keep = ~drop
        while True:
            points = np.bincount(self.point_index[keep], minlength=len(self.labels))
            images = np.bincount(self.image_index[keep], minlength=len(self.images))
            again = keep & (points[self.point_index] >= 2) & (images[self.image_index] >= MIN_POINTS)
            if (again == keep).all():
                break
            keep = again
        kept_points, kept_images = np.flatnonzero(points), np.flatnonzero(images)
        arrays = {name: getattr(self, name)[keep] for name in _PER_OBSERVATION}
        arrays["point_index"] = np.searchsorted(kept_points, arrays["point_index"])
        arrays["image_index"] = np.searchsorted(kept_images, arrays["image_index"])
        return replace(
            self,
            images=tuple(self.images[i] for i in kept_images),
            camera_from_model=tuple(self.camera_from_model[i] for i in kept_images),
            labels=tuple(self.labels[i] for i in kept_points),
            xyz_model=self.xyz_model[kept_points],
            **arrays,
        )


M = TypeVar("M", bound=GroupModel)
"""Models of either kind: what keeps the unit keeps the type."""


@dataclass(frozen=True, slots=True, eq=False)
class WorldModel(GroupModel):
    """A model as the mapper makes it: its frame is a world without unit, and lies by chance."""

    def moved(self, a_from_world: Similarity) -> "WorldModel":
        """The same model in another world, its unit included."""
        return self._placed(WorldModel, a_from_world)

    def metric(self, a_from_world: Similarity) -> "MetricModel":
        """The model in mm, in frame a."""
        return self._placed(MetricModel, a_from_world)


@dataclass(frozen=True, slots=True, eq=False)
class MetricModel(GroupModel):
    """A model in mm. Its frame is the target's where the group is chained to it, else the group's or the board's."""

    def moved(self, a_from_model: Rigid) -> "MetricModel":
        """The same model in another frame."""
        return self._placed(MetricModel, Similarity(1.0, a_from_model))

    def in_world(self, world_from_model: Similarity) -> "WorldModel":
        """The model as the mapper might have made it, for simulations."""
        return self._placed(WorldModel, world_from_model)
