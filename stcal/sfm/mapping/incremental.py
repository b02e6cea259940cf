"""Incremental mapping with pycolmap: few points, fixed intrinsics, seeded with the initial pair chosen by stcal."""

import shutil
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stcal.errors import MappingError
from stcal.geometry.camera import Camera
from stcal.labels import Label
from stcal.sfm.data.model import MIN_POINTS, Outlier, WorldModel
from stcal.sfm.data.observations import ImageObservations
from stcal.sfm.mapping.colmap import pycolmap
from stcal.sfm.mapping.database import CAMERA_ID
from stcal.sfm.mapping.models import rigid_from_colmap
from stcal.sfm.mapping.pairs import PairScore, share_board_alone
from stcal.sfm.mapping.resect import assemble, complete

SEED = 1
MAX_REPROJECTION_PX = 4.0
"""Largest reprojection error of an observation in the model (COLMAP's filter)."""
MIN_AGREEMENT = 0.5
"""Share of the circles seen at least twice that a model must contain."""
LOG_ERRORS_ONLY = 3


@dataclass(frozen=True, slots=True, eq=False)
class Mapping:
    """Result of mapping one group.

    ``model`` : model of the group; ``outliers`` : observations with a large reprojection error; ``left_out`` : reason
    by image name; ``seeded`` : how the initial pair was registered.
    """

    model: WorldModel
    outliers: tuple[Outlier, ...]
    left_out: dict[str, str]
    seeded: str


def map_group(
    database: Path,
    scratch: Path,
    group: list[ImageObservations],
    skeleton: Collection[str],
    ids: dict[str, int],
    pairs: list[PairScore],
    camera: Camera,
) -> Mapping:
    """Maps one group of the database: COLMAP maps the ``skeleton``, the other images are resected by their labels.

    The chosen pair seeds COLMAP. If COLMAP's checks reject it, the relative pose of the ranking is registered instead.

    Raises
    ------
    MappingError
        There is no model of two or more images.
    """
    names = [image.name for image in group if image.name in skeleton]
    first, second = (next(i for i in group if i.name == name) for name in (pairs[0].first, pairs[0].second))
    reconstruction = None
    if share_board_alone(first, second):
        seeded = "our relative pose of the chosen pair, by the board (a plane has two essential matrices)"
        reconstruction = _own_mapping(database, names, ids, pairs[0])
    if reconstruction is None:
        seeded = "COLMAP's estimate of the chosen pair"
        reconstruction = seeded_mapping(database, scratch, names, (ids[first.name], ids[second.name]))
    if reconstruction is None:
        seeded = "our relative pose of the chosen pair (COLMAP's gates refused its own)"
        reconstruction = _own_mapping(database, names, ids, pairs[0])
    if reconstruction is None:
        raise MappingError(
            "E-MAPPING-NO-MODEL",
            f"group {group[0].group}: no model from the pair {pairs[0].first}, {pairs[0].second} "
            f"({pairs[0].shared} circles in common); add views between the two, or change --max-angle",
        )
    model, outliers = labelled_model(reconstruction, group, ids, camera)
    _require_agreement(model, group)
    return Mapping(model, outliers, left_out(group, model), seeded)


def left_out(group: list[ImageObservations], model: WorldModel) -> dict[str, str]:
    """Returns why images of the group are not in the model, by image name."""
    reasons = {}
    for image in group:
        if image.name not in model.images:
            known = len(set(image.labels) & set(model.labels))
            reasons[image.name] = (
                f"{known} of its circles are in the model, {MIN_POINTS} needed; photograph faces and board together"
                if known < MIN_POINTS
                else f"fewer than {MIN_POINTS} of its {known} circles fit the model to {MAX_REPROJECTION_PX:g} px; "
                "check that it is sharp, and that nothing but the camera moved"
            )
    return reasons


def _require_agreement(model: WorldModel, group: list[ImageObservations]) -> None:
    count: dict[str, int] = {}
    for image in group:
        for label in image.labels:
            count[label] = count.get(label, 0) + 1
    wanted = sum(n >= 2 for n in count.values())
    if len(model.labels) < MIN_AGREEMENT * wanted:
        raise MappingError(
            "E-MAPPING-DISAGREE",
            f"group {model.group}: {len(model.labels)} of {wanted} circles agree between the images to "
            f"{MAX_REPROJECTION_PX:g} px, {MIN_AGREEMENT * wanted:.0f} needed; "
            "check that the camera file belongs to the images, and that nothing but the camera moved",
        )


def pipeline_options(names: list[str], pair: tuple[int, int]) -> pycolmap.IncrementalPipelineOptions:
    """Returns COLMAP's options for few labelled points and a known camera."""
    options = pycolmap.IncrementalPipelineOptions()
    options.image_names = names
    options.init_image_id1, options.init_image_id2 = pair
    options.min_num_matches = MIN_POINTS
    options.multiple_models = False
    options.min_model_size = 2
    options.extract_colors = False
    options.ba_refine_focal_length = options.ba_refine_extra_params = options.ba_refine_principal_point = False
    options.constant_cameras = {CAMERA_ID}
    options.random_seed = SEED
    options.init_num_trials = 20
    options.structure_less_registration_fallback = False
    options.mapper.init_min_num_inliers = 8
    options.mapper.init_min_tri_angle = 1.0
    options.mapper.abs_pose_min_num_inliers = MIN_POINTS
    options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = False
    options.mapper.filter_max_reproj_error = MAX_REPROJECTION_PX
    options.mapper.filter_min_tri_angle = 0.5
    options.triangulation.min_angle = 0.5
    options.triangulation.ignore_two_view_tracks = False
    return options


def seeded_mapping(
    database: Path, scratch: Path, names: list[str], pair: tuple[int, int]
) -> pycolmap.Reconstruction | None:
    """Returns the largest model that COLMAP maps from the named images and initial pair (ids); None if it maps none."""
    pycolmap.logging.minloglevel = LOG_ERRORS_ONLY
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir(parents=True)
    options = pipeline_options(names, pair)
    models = pycolmap.incremental_mapping(str(database), str(scratch), str(scratch), options)
    shutil.rmtree(scratch, ignore_errors=True)
    best = max(models.values(), key=lambda m: m.num_reg_images(), default=None)
    return best if best is not None and best.num_reg_images() >= 2 else None


def _own_mapping(database: Path, names, ids, pair: PairScore) -> pycolmap.Reconstruction | None:
    """Runs COLMAP's incremental mapper step by step, starting from the relative pose of ``pair``."""
    pycolmap.logging.minloglevel = LOG_ERRORS_ONLY
    options = pipeline_options(names, (ids[pair.first], ids[pair.second]))
    with pycolmap.Database.open(str(database)) as opened:
        cache = pycolmap.DatabaseCache.create(
            opened, pycolmap.DatabaseCacheOptions(min_num_matches=MIN_POINTS, image_names=set(names))
        )
    reconstruction = pycolmap.Reconstruction()
    mapper = pycolmap.IncrementalMapper(cache)
    mapper.begin_reconstruction(reconstruction)
    mapper_options, triangulation = options.get_mapper(), options.get_triangulation()
    start = pair.pose()
    pose = pycolmap.Rigid3d(pycolmap.Rotation3d(start.rotation), start.translation)
    first, second = ids[pair.first], ids[pair.second]
    mapper.register_initial_image_pair(mapper_options, first, second, pose)
    for image_id in (first, second):
        mapper.triangulate_image(triangulation, image_id)
    mapper.adjust_global_bundle(mapper_options, options.get_global_bundle_adjustment())
    mapper.filter_points(mapper_options)
    while True:
        nearest = mapper.find_next_images(mapper_options, False)
        for image_id in nearest:
            if mapper.register_next_image(mapper_options, image_id):
                mapper.triangulate_image(triangulation, image_id)
                mapper.adjust_global_bundle(mapper_options, options.get_global_bundle_adjustment())
                mapper.filter_points(mapper_options)
                break
        else:
            break
    mapper.end_reconstruction(False)
    return reconstruction if reconstruction.num_reg_images() >= 2 and reconstruction.num_points3D() >= 4 else None


def labelled_model(
    reconstruction: pycolmap.Reconstruction, group: list[ImageObservations], ids: dict[str, int], camera: Camera
) -> tuple[WorldModel, tuple[Outlier, ...]]:
    """Returns a model with one point for each label and the observations that agree with it, and the outliers.

    Images of the group that the reconstruction lacks are resected by their labels.
    """
    colmap_images = reconstruction.images  # COLMAP drops images that have nothing in common with the others
    registered = [
        image for image in group if ids[image.name] in colmap_images and colmap_images[ids[image.name]].has_pose
    ]
    poses = [rigid_from_colmap(colmap_images[ids[image.name]].cam_from_world()) for image in registered]
    votes_of_label: dict[Label, dict[int, int]] = {}
    for image in registered:
        for k, point in enumerate(colmap_images[ids[image.name]].points2D):
            if point.has_point3D():
                votes = votes_of_label.setdefault(image.labels[k], {})
                votes[point.point3D_id] = votes.get(point.point3D_id, 0) + 1
    xyz = {
        label: reconstruction.point3D(max(votes, key=votes.__getitem__)).xyz for label, votes in votes_of_label.items()
    }
    model = assemble(WorldModel, group[0].group, registered, poses, xyz)
    if len(registered) < len(group):
        model = complete(model, group, camera, MAX_REPROJECTION_PX)
    residual = np.linalg.norm(model.residuals_px(camera), axis=1)
    is_outlier = residual > MAX_REPROJECTION_PX
    outliers = [
        Outlier(
            model.images[model.image_index[k]],
            model.labels[model.point_index[k]],
            float(residual[k]),
            MAX_REPROJECTION_PX,
        )
        for k in np.flatnonzero(is_outlier)
    ]
    return model.without(is_outlier), tuple(outliers)
