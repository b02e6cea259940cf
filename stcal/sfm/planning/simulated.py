"""A simulated scene as the stages after detection receive it: labelled centres without pixels, and the true models."""

from collections.abc import Sequence

import numpy as np

from stcal.geometry.conic import circle_image_offset
from stcal.sfm.data.model import MetricModel
from stcal.sfm.data.observations import ImageObservations, by_group
from stcal.sfm.mapping.resect import assemble
from stcal.synthetic.observe import image_circles
from stcal.synthetic.scene import Scene

EXACT_SIGMA_PX = 0.005
"""The σ that is stated for centres without noise."""


def observe(scene: Scene, noise_px: float, rng: np.random.Generator, missing: float = 0.0) -> list[ImageObservations]:
    """Returns the ellipse centres of all circles that must be found, with Gaussian noise of σ ``noise_px`` per axis.

    ``missing`` : share of the circles that detection loses.
    """
    images = []
    for name, group in scene.groups.items():
        for i in range(len(group.camera_from_target)):
            seen = image_circles(scene, name, i)
            keep = np.flatnonzero(seen.must_find & (rng.random(len(seen.labels)) >= missing))
            ideal = circle_image_offset(seen.xyz_camera[keep], seen.normal_camera[keep], seen.radius_mm[keep])
            centre_px = scene.camera.project(ideal) + noise_px * rng.standard_normal((len(keep), 2))
            images.append(
                ImageObservations(
                    name=f"{name}/{i:04d}",
                    group=name,
                    labels=tuple(seen.labels[k] for k in keep),
                    centre_px=centre_px,
                    centre=scene.camera.normalised_from_pixel(centre_px),
                    shape=np.zeros((len(keep), 2, 2)),
                    covariance_px2=np.tile((noise_px or EXACT_SIGMA_PX) ** 2 * np.eye(2), (len(keep), 1, 1)),
                )
            )
    return images


def true_models(scene: Scene, observations: Sequence[ImageObservations]) -> list[MetricModel]:
    """Returns models of the groups at the true geometry, mm, target frame, with these observations, not yet corrected
    for eccentricity."""
    models = []
    for name, images in by_group(observations).items():
        group = scene.groups[name]
        place = scene.circles_target | dict(zip(scene.board.labels(), group.board_circles_target, strict=True))
        seen = {label for image in images for label in image.labels}
        poses = [group.camera_from_target[int(image.name.rpartition("/")[2])] for image in images]
        models.append(assemble(MetricModel, name, images, poses, {label: place[label] for label in seen}))
    return models
