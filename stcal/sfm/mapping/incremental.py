"""Incremental mapping with pycolmap, seeded with the initial pair, and resection of images that it left out."""

import shutil
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stcal.errors import MappingError
from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid
from stcal.labels import Label
from stcal.sfm.data.group_model import MIN_POINTS, ImageObservations, Outlier, WorldModel, assemble
from stcal.sfm.mapping.database import CAMERA_ID, pycolmap, unwritable
from stcal.sfm.mapping.models import points_by_votes, rigid_from_colmap
from stcal.sfm.mapping.pairs import PairScore, share_board_alone

MIN_SHARE = 0.25  # smallest share of an image's known circles that must fit, as in COLMAP (abs_pose_min_inlier_ratio)
MIN_RAY_ANGLE_RAD = np.radians(0.5)
"""Smallest value of the largest angle between the rays of a new point. Below it the depth is too uncertain."""


def complete(model: WorldModel, group: list[ImageObservations], camera: Camera, max_error_px: float) -> WorldModel:
    """Returns the model with all images of the group that its points can resect, and with the circles that these add.
    An image needs six labelled points, and a quarter of the model's, that fit within ``max_error_px``."""
    xyz = dict(zip(model.labels, model.xyz_model, strict=True))
    poses = dict(zip(model.images, model.camera_from_model, strict=True))
    for image in group:
        if image.name not in poses and (pose := _resect(image, xyz, camera, max_error_px)) is not None:
            poses[image.name] = pose
    placed = [image for image in group if image.name in poses]
    unknown = {label for image in placed for label in image.labels} - xyz.keys()
    for label, (centre, direction) in rays_of(placed, poses, unknown).items():
        if widest_angle_rad(direction) >= MIN_RAY_ANGLE_RAD:  # least squares of distances from the rays
            across = np.eye(3) - direction[:, :, None] * direction[:, None, :]
            xyz[label] = np.linalg.solve(across.sum(0), np.einsum("nij,nj->i", across, centre))
    return assemble(WorldModel, model.group, placed, [poses[image.name] for image in placed], xyz)


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


def rays_of(
    images: Sequence[ImageObservations], poses: dict[str, Rigid], labels: Collection[Label]
) -> dict[Label, tuple[np.ndarray, np.ndarray]]:
    """Returns by label the rays on which placed images see it: projection centres, (k, 3), and directions, (k, 3)."""
    rays: dict[Label, list[tuple[np.ndarray, np.ndarray]]] = {}
    for image in images:
        world_from_camera = poses[image.name].inverse()
        directions = np.pad(image.centre, ((0, 0), (0, 1)), constant_values=1.0) @ world_from_camera.rotation.T
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        for label, direction in zip(image.labels, directions, strict=True):
            if label in labels:
                rays.setdefault(label, []).append((world_from_camera.translation, direction))
    return {label: (rows[:, 0], rows[:, 1]) for label, rows in ((label, np.array(r)) for label, r in rays.items())}


def widest_angle_rad(direction: np.ndarray) -> float:
    """Returns the largest angle between unit directions (n, 3)."""
    return float(np.arccos(np.clip(direction @ direction.T, -1, 1)).max())


SEED = 1
MAX_REPROJECTION_PX = 4.0  # largest reprojection error of an observation in the model (COLMAP's filter)
MIN_AGREEMENT = 0.5  # share of the circles seen at least twice that a model must contain
LOG_ERRORS_ONLY = 3
SHOW_BOTH = "photograph faces and board together"
BY_PAIR = "the relative pose of the chosen pair"
BY_COLMAP = "COLMAP's estimate of the chosen pair"
BY_BOARD = f"{BY_PAIR}, by the board (a plane has two essential matrices)"


@dataclass(frozen=True, slots=True, eq=False)
class Mapping:
    """Result of mapping one group in any way."""

    model: WorldModel  # without the outliers
    outliers: tuple[Outlier, ...]  # observations with a large reprojection error
    left_out: dict[str, str]  # reason by image name
    seeded: str  # how the initial pair was registered, or the faces placed
    remedy: str  # for images with too few circles in the model


def map_group(
    database: Path,
    group: list[ImageObservations],
    skeleton: Collection[str],
    ids: dict[str, int],
    pairs: list[PairScore],
    camera: Camera,
) -> Mapping:
    """Maps one group: COLMAP maps the ``skeleton`` from the chosen pair and its pose in the ranking, the other images
    are resected by their labels. If that gives no model, COLMAP estimates the pair's pose itself."""
    names, pair = [i.name for i in group if i.name in skeleton], pairs[0]
    by_board = share_board_alone(*(i for i in group if i.name in (pair.first, pair.second)))
    seed, how = (ids[pair.first], ids[pair.second]), BY_BOARD if by_board else BY_PAIR
    assert pair.second_from_first is not None, "chosen pairs have a pose"
    try:
        reconstruction = _mapped(database, names, seed, pair.second_from_first)
        if reconstruction is None:
            reconstruction, how = seeded_mapping(database, Path(f"{database}.models"), names, seed), BY_COLMAP
    except RuntimeError as error:
        if "SQLite" not in str(error):
            raise
        raise unwritable(database, error) from error
    if reconstruction is None:
        of = f"no model from the pair {pair.first}, {pair.second} ({pair.shared} circles in common)"
        remedy = "add views between the two, or change --max-angle"
        raise MappingError("E-MAPPING-NO-MODEL", f"group {group[0].group}: {of}; {remedy}")
    model, outliers = labelled_model(reconstruction, group, ids, camera)
    count = Counter(label for image in group for label in image.labels)
    wanted = sum(n >= 2 for n in count.values())
    if len(model.labels) < MIN_AGREEMENT * wanted:
        agree = f"{len(model.labels)} of {wanted} circles agree between the images to {MAX_REPROJECTION_PX:g} px"
        fault = f"group {model.group}: {agree}, {MIN_AGREEMENT * wanted:.0f} needed"
        remedy = "check that the camera file belongs to the images, and that nothing but the camera moved"
        raise MappingError("E-MAPPING-DISAGREE", f"{fault}; {remedy}")
    return Mapping(model, outliers, left_out(group, model), how, SHOW_BOTH)


def left_out(group: Sequence[ImageObservations], model: WorldModel, remedy: str = SHOW_BOTH) -> dict[str, str]:
    """Returns why images of the group are not in the model, by image name; ``remedy`` for too few circles in it."""
    reasons = {}
    for image in group:
        if image.name not in model.images:
            known = len(set(image.labels) & set(model.labels))
            why = f"{known} of its circles or corners are in the model, {MIN_POINTS} needed; {remedy}"
            if known >= MIN_POINTS:
                fit = f"fewer than {MIN_POINTS} of its {known} circles fit the model to {MAX_REPROJECTION_PX:g} px"
                why = f"{fit}; check that it is sharp, and that nothing but the camera moved"
            reasons[image.name] = why
    return reasons


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


def _mapped(
    database: Path, names: list[str], pair: tuple[int, int], second_from_first: Rigid
) -> pycolmap.Reconstruction | None:
    """Runs COLMAP's incremental mapper step by step, starting from the relative pose of the pair (ids)."""
    pycolmap.logging.minloglevel = LOG_ERRORS_ONLY
    options = pipeline_options(names, pair)
    with pycolmap.Database.open(str(database)) as opened:
        cache = pycolmap.DatabaseCache.create(
            opened, pycolmap.DatabaseCacheOptions(min_num_matches=MIN_POINTS, image_names=set(names))
        )
    reconstruction = pycolmap.Reconstruction()
    mapper = pycolmap.IncrementalMapper(cache)
    mapper.begin_reconstruction(reconstruction)
    mapper_options, triangulation = options.get_mapper(), options.get_triangulation()
    pose = pycolmap.Rigid3d(pycolmap.Rotation3d(second_from_first.rotation), second_from_first.translation)
    mapper.register_initial_image_pair(mapper_options, *pair, pose)
    registered = list(pair)
    while registered:
        for image_id in registered:
            mapper.triangulate_image(triangulation, image_id)
        mapper.adjust_global_bundle(mapper_options, options.get_global_bundle_adjustment())
        mapper.filter_points(mapper_options)
        nearest = mapper.find_next_images(mapper_options, False)
        added = next((i for i in nearest if mapper.register_next_image(mapper_options, i)), None)
        registered = [] if added is None else [added]
    mapper.end_reconstruction(False)
    return reconstruction if reconstruction.num_reg_images() >= 2 and reconstruction.num_points3D() >= 4 else None


def labelled_model(
    reconstruction: pycolmap.Reconstruction, group: list[ImageObservations], ids: dict[str, int], camera: Camera
) -> tuple[WorldModel, tuple[Outlier, ...]]:
    """Model with a point for each label, and the outliers; images that COLMAP lacks are resected by labels."""
    colmap_images = reconstruction.images  # COLMAP drops images that have nothing in common with the others
    registered = [
        image for image in group if ids[image.name] in colmap_images and colmap_images[ids[image.name]].has_pose
    ]
    native = [colmap_images[ids[image.name]] for image in registered]
    poses = [rigid_from_colmap(image.cam_from_world()) for image in native]
    chosen, _ = points_by_votes(registered, native)
    xyz = {label: reconstruction.point3D(point).xyz for label, point in chosen.items()}
    model = assemble(WorldModel, group[0].group, registered, poses, xyz)
    if len(registered) < len(group):
        model = complete(model, group, camera, MAX_REPROJECTION_PX)
    residual = np.linalg.norm(model.residuals_px(camera), axis=1)
    far, seen = residual > MAX_REPROJECTION_PX, model.seen()
    outliers = tuple(Outlier(*seen[k], float(residual[k]), MAX_REPROJECTION_PX) for k in np.flatnonzero(far))
    return model.without(far), outliers
