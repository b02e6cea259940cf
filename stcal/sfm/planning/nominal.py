"""Nominal poses of the faces before a photograph exists, and simulated scenes as labelled centres without pixels."""

from collections.abc import Sequence
from itertools import compress
from pathlib import Path

import numpy as np

from stcal.design import TargetDesign, reference_target
from stcal.errors import InputError
from stcal.geometry.conic import circle_image_offset
from stcal.geometry.rigid import Rigid
from stcal.io.design import ROUGH_KEYS
from stcal.io.json import read_result
from stcal.sfm.adjust.file import FacePoses
from stcal.sfm.data.model import ImageObservations, MetricModel, by_group
from stcal.sfm.mapping.incremental import assemble
from stcal.synthetic.observe import image_circles
from stcal.synthetic.scene import Scene


def nominal_poses(target: TargetDesign, faces: str | Path | None) -> dict[str, Rigid]:
    """Returns the pose of every face in one frame. ``faces`` : a ``faces.json``, or None for the rough poses of the
    design.

    Raises InputError if a face has no rough pose and there is no ``faces.json``, or if that file is invalid or lacks a
    face.
    """
    if faces is None:
        rough = target.rough_poses()
        if not rough and _is_reference(target):  # of files from before there were rough poses
            return reference_target().rough_poses()
        if missing := [face.id for face in target.faces if face.id not in rough]:
            raise InputError(
                "E-TARGET-ROUGH-POSE",
                f"target {target.name}: the design does not say where {_faces(missing)}; add approximate {ROUGH_KEYS} "
                "to each [[face]] of the target file, or for `plan` give --faces, the faces.json of an earlier run",
            )
        return rough
    poses = read_result(faces, FacePoses, "faces", "give RUN/faces.json, the faces.json of a run").poses()
    missing = [face.id for face in target.faces if face.id not in poses]
    if missing:
        raise InputError(
            "E-TARGET-NO-FACE",
            f"{faces}: no face {missing[0]} of target {target.name}; give a run that shows all of its faces",
        )
    return {face.id: poses[face.id] for face in target.faces}


def _faces(ids: list[str]) -> str:
    return f"face {ids[0]} is" if len(ids) == 1 else f"faces {', '.join(ids[:-1])} and {ids[-1]} are"


def _is_reference(target: TargetDesign) -> bool:
    places, reference = _places(target), _places(reference_target())
    return places.keys() == reference.keys() and all(np.allclose(places[k], reference[k], atol=0.5) for k in places)


def _places(target: TargetDesign) -> dict[str, np.ndarray]:
    return {label: xy for face in target.faces for label, xy in zip(face.labels(), face.xy_mm, strict=True)}


EXACT_SIGMA_PX = 0.005
"""The σ that is stated for centres without noise."""


def observe(scene: Scene, noise_px: float, rng: np.random.Generator, missing: float = 0.0) -> list[ImageObservations]:
    """Returns the ellipse centres of all circles that must be found, with Gaussian noise of σ ``noise_px`` per axis.

    ``missing`` : share of the circles that detection loses.
    """
    images = []
    for name, group in scene.groups.items():
        for i in range(len(group.camera_from_target)):
            circles = image_circles(scene, name, i)
            keep = circles.must_find & (rng.random(len(circles.labels)) >= missing)
            ideal = circle_image_offset(circles.xyz_camera[keep], circles.normal_camera[keep], circles.radius_mm[keep])
            centre_px = scene.camera.project(ideal) + noise_px * rng.standard_normal((len(ideal), 2))
            images.append(
                ImageObservations(
                    name=f"{name}/{i:04d}",
                    group=name,
                    labels=tuple(compress(circles.labels, keep.tolist())),
                    centre_px=centre_px,
                    centre=scene.camera.normalised_from_pixel(centre_px),
                    shape=np.zeros((len(ideal), 2, 2)),
                    covariance_px2=np.tile((noise_px or EXACT_SIGMA_PX) ** 2 * np.eye(2), (len(ideal), 1, 1)),
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
        labels = {label for image in images for label in image.labels}
        poses = [group.camera_from_target[int(image.name.rpartition("/")[2])] for image in images]
        models.append(assemble(MetricModel, name, images, poses, {label: place[label] for label in labels}))
    return models
