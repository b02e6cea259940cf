"""Resection of the images that the mapper did not register: one image at a time, by the labels."""

import numpy as np

from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid
from stcal.labels import Label
from stcal.sfm.data.model import MIN_POINTS, M, WorldModel
from stcal.sfm.data.observations import ImageObservations
from stcal.sfm.mapping.colmap import pycolmap
from stcal.sfm.mapping.models import rigid_from_colmap

SEED = 1
MIN_SHARE = 0.25
"""Smallest share of an image's known circles that must fit, as in COLMAP (abs_pose_min_inlier_ratio)."""
MIN_RAY_ANGLE_RAD = np.radians(0.5)
"""Smallest value of the largest angle between the rays of a new point. Below it the depth is too uncertain."""


def complete(model: WorldModel, group: list[ImageObservations], camera: Camera, max_error_px: float) -> WorldModel:
    """Returns the model with all images of the group that its points can resect, and with the circles that these add.

    An image is placed if at least six of its labelled points, and at least a quarter of those that the model contains,
    fit within ``max_error_px`` (RANSAC and refinement of pycolmap on ideal coordinates). Circles that the model lacks
    are then triangulated from all placed images. All observations of placed images are used.
    """
    xyz = dict(zip(model.labels, model.xyz_model, strict=True))
    poses = dict(zip(model.images, model.camera_from_model, strict=True))
    for image in group:
        if image.name not in poses:
            pose = _resect(image, xyz, camera, max_error_px)
            if pose is not None:
                poses[image.name] = pose
    placed = [image for image in group if image.name in poses]
    xyz |= _triangulated(placed, poses, xyz.keys())
    return assemble(WorldModel, model.group, placed, [poses[image.name] for image in placed], xyz)


def assemble(
    kind: type[M], group: str, images: list[ImageObservations], poses: list[Rigid], xyz: dict[Label, np.ndarray]
) -> M:
    """Returns the model of placed images and labelled points, with all observations of these points in these images."""
    labels = sorted(xyz)
    index = {label: i for i, label in enumerate(labels)}
    rows = [
        (i, index[label], k) for i, image in enumerate(images) for k, label in enumerate(image.labels) if label in index
    ]
    image_index, point_index, keypoint = np.array(rows, int).reshape(-1, 3).T
    row = np.cumsum([0, *(len(image) for image in images)])[image_index] + keypoint
    return kind(
        group=group,
        images=tuple(image.name for image in images),
        camera_from_model=tuple(poses),
        labels=tuple(labels),
        xyz_model=np.array([xyz[label] for label in labels]).reshape(-1, 3),
        image_index=image_index,
        point_index=point_index,
        keypoint=keypoint,
        measured_px=np.concatenate([image.centre_px for image in images])[row],
        shift_px=np.zeros((len(rows), 2)),
        covariance_px2=np.concatenate([image.covariance_px2 for image in images])[row],
    )


def _resect(
    image: ImageObservations, xyz: dict[Label, np.ndarray], camera: Camera, max_error_px: float
) -> Rigid | None:
    known = [k for k, label in enumerate(image.labels) if label in xyz]
    if len(known) < MIN_POINTS:
        return None
    focal = float(np.sqrt(camera.focal.prod()))
    ideal = pycolmap.Camera(model="SIMPLE_PINHOLE", width=camera.width, height=camera.height, params=[focal, 0, 0])
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error = max_error_px
    options.ransac.random_seed = SEED
    answer = pycolmap.estimate_and_refine_absolute_pose(
        focal * image.centre[known], np.array([xyz[image.labels[k]] for k in known]), ideal, options
    )
    if answer is None or answer["num_inliers"] < max(MIN_POINTS, MIN_SHARE * len(known)):
        return None
    return rigid_from_colmap(answer["cam_from_world"])


def _triangulated(images: list[ImageObservations], poses: dict[str, Rigid], known) -> dict[Label, np.ndarray]:
    """Returns the places of circles that are not ``known``, by label: least squares of distances from the rays."""
    rays: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
    for image in images:
        pose = poses[image.name]
        for k, label in enumerate(image.labels):
            if label not in known:
                direction = pose.rotation.T @ np.append(image.centre[k], 1.0)
                rays.setdefault(label, []).append((pose.inverse().translation, direction / np.linalg.norm(direction)))
    places = {}
    for label, rays_of_label in rays.items():
        centre, direction = (np.array(values) for values in zip(*rays_of_label, strict=True))
        if np.arccos(np.clip(direction @ direction.T, -1, 1)).max() < MIN_RAY_ANGLE_RAD:
            continue
        across = np.eye(3) - direction[:, :, None] * direction[:, None, :]
        places[label] = np.linalg.solve(across.sum(0), np.einsum("nij,nj->i", across, centre))
    return places
