"""Bring the images of a group that the mapper did not take into its model: by their labels, one at a time."""

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
"""Of an image's known circles that must fit, as COLMAP's own registration asks (abs_pose_min_inlier_ratio)."""
MIN_RAY_ANGLE_RAD = np.radians(0.5)
"""Between some two rays of a new point, or its depth is a guess."""


def complete(model: WorldModel, group: list[ImageObservations], camera: Camera, max_error_px: float) -> WorldModel:
    """The model with every further image of the group that its points place, and with the circles that these add.

    An image is placed by six or more labelled points, and a quarter of those that it shows, within ``max_error_px``
    (RANSAC and refinement of pycolmap on ideal coordinates); circles that the model lacks are triangulated from all
    images then placed. Observations are all of each placed image.
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
    """The model of placed images and labelled points with all observations that they have of one another."""
    labels = sorted(xyz)
    index = {label: i for i, label in enumerate(labels)}
    rows = [
        (i, index[label], k) for i, image in enumerate(images) for k, label in enumerate(image.labels) if label in index
    ]
    image_index, point_index, keypoint = np.array(rows, int).reshape(-1, 3).T
    first = np.cumsum([0, *(len(image) for image in images)])[image_index] + keypoint
    return kind(
        group=group,
        images=tuple(image.name for image in images),
        camera_from_model=tuple(poses),
        labels=tuple(labels),
        xyz_model=np.array([xyz[label] for label in labels]).reshape(-1, 3),
        image_index=image_index,
        point_index=point_index,
        keypoint=keypoint,
        measured_px=np.concatenate([image.centre_px for image in images])[first],
        shift_px=np.zeros((len(rows), 2)),
        covariance_px2=np.concatenate([image.covariance_px2 for image in images])[first],
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
    """Circles that are not known, each where its rays meet best (least squares of distances), by label."""
    rays: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
    for image in images:
        pose = poses[image.name]
        for k, label in enumerate(image.labels):
            if label not in known:
                direction = pose.rotation.T @ np.append(image.centre[k], 1.0)
                rays.setdefault(label, []).append((pose.inverse().translation, direction / np.linalg.norm(direction)))
    found = {}
    for label, own in rays.items():
        centre, direction = (np.array(each) for each in zip(*own, strict=True))
        if np.arccos(np.clip(direction @ direction.T, -1, 1)).max() < MIN_RAY_ANGLE_RAD:
            continue
        across = np.eye(3) - direction[:, :, None] * direction[:, None, :]
        found[label] = np.linalg.solve(across.sum(0), np.einsum("nij,nj->i", across, centre))
    return found
