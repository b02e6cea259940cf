"""Adjustment of one group: weighted bundle adjustment, alternating with the circles' eccentricity."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from stcal.adjust.blocks import Block, Vector
from stcal.adjust.engine import Adjustment
from stcal.design import POINT_RADIUS_MM, BoardDesign, TargetDesign
from stcal.errors import ConvergenceError, DegenerateError, MappingError
from stcal.geometry.camera import PARAMETER_NAMES, Camera
from stcal.geometry.plane import circle_image_offset, fit_plane
from stcal.geometry.rigid import Poses, by_pose
from stcal.geometry.robust import robust_sigma
from stcal.labels import Label
from stcal.sfm.adjust.scale import find_scale
from stcal.sfm.data.group_model import MIN_POINTS, GroupModel, M, Outlier, WorldModel

EXACTLY = 1e-15
"""Largest predicted decrease of the last step, as a share of χ²: corrections of nanometres must be seen."""
MAX_STEPS = 50
DAMPING = 1e-10  # relative damping, which holds the seven free directions of the world
NO_PARAMETERS = np.zeros((len(PARAMETER_NAMES), 0))


def adjust(model: M, camera: Camera) -> M:
    """Minimises the weighted reprojection error of the corrected centres over poses and points."""
    if not model.images:
        raise MappingError(
            "E-GROUP-FEW-IMAGES",
            f"group {model.group}: no two images have {MIN_POINTS} circles or corners in common; add images, until two "
            "show each face beside a neighbour",
        )
    a, poses = Adjustment(), Poses.of(model.camera_from_model)
    few = 2 * len(model.images) <= len(model.labels)  # the larger part of the unknowns is eliminated
    cameras = a.block("poses", poses, eliminate=not few)
    points = a.block("points", Vector(model.xyz_model), eliminate=few)
    reproject(a, model, (points, cameras), lambda *_: camera)
    remedy = "check the camera file, and the sizes of printed faces in target.toml"
    minimum = a.minimum(damping=DAMPING, least_damping=DAMPING, settled=EXACTLY, max_steps=MAX_STEPS)
    values = minimum.required(f"group {model.group}: bundle adjustment", remedy).state
    return placed(model, values["poses"], values["points"])


def reproject(
    a: Adjustment,
    model: GroupModel,
    on: Sequence[Block],  # points, poses, and the parameters of a camera if they are adjusted
    camera_at: Callable[..., Camera],  # of these parameters
    basis: np.ndarray = NO_PARAMETERS,  # (16, q) derivative of the camera's parameters by them
    **known: Any,  # kind, cluster and loss of the rows
) -> None:
    """Adds the rows of a model's observations, projected minus measured centres, px; infinite where a point lies behind
    its camera."""
    point, image, measured_px = model.point_index, model.image_index, model.corrected_px()

    @lru_cache(maxsize=2)
    def seen(points: Vector, poses: Poses) -> np.ndarray:
        return np.einsum("nij,nj->ni", poses.rotation[image], points.array[point]) + poses.translation[image]

    def residuals(points: Vector, poses: Poses, *lens: Vector) -> np.ndarray:
        xyz = seen(points, poses)
        behind = (xyz[:, 2] <= 0).any()
        return np.full_like(measured_px, np.inf) if behind else camera_at(*lens).project(xyz) - measured_px

    def derivatives(points: Vector, poses: Poses, *lens: Vector) -> list[np.ndarray]:
        xyz, camera, own = seen(points, poses), camera_at(*lens), poses[image]
        of_poses, by_point = jacobians(xyz, own.rotation, own.translation, camera)
        return [by_point, of_poses, *(camera.parameter_jacobian(xyz[:, :2] / xyz[:, 2:]) @ basis for _ in lens)]

    root = model.whiten(np.tile(np.eye(2), (len(image), 1, 1)))
    a.factor(residuals, list(zip(on, (point, image, None), strict=False)), derivatives=derivatives, root=root, **known)


def placed(model: M, poses: Poses, points: Vector) -> M:
    """Returns the model with these poses and points."""
    return replace(model, camera_from_model=tuple(poses), xyz_model=points.array)


def projection_jacobians(model: GroupModel, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Returns the derivatives of the projections (px) by poses, left perturbed, (n, 2, 6), and by points, (n, 2, 3)."""
    own = Poses.of(model.camera_from_model)[model.image_index]
    return jacobians(model.xyz_camera(), own.rotation, own.translation, camera)


def jacobians(
    xyz: np.ndarray, rotation: np.ndarray, translation: np.ndarray, camera: Camera
) -> tuple[np.ndarray, np.ndarray]:
    """Returns :func:`projection_jacobians` of points (n, 3) in cameras with poses (n, 3, 3), (n, 3)."""
    by_camera = camera.projection_jacobian(xyz)
    return by_pose(by_camera, xyz - translation), by_camera @ rotation


MAX_ROUNDS = 20
SETTLED_PX = 1e-5  # largest change of corrections that have settled, in px: far below any centring noise
OUTLIER_RMS = 6.0
"""Limit of a residual, as a multiple of the residuals' robust RMS length, √2 σ. Observations that exceed it, and twice
this multiple of their own σ, are named and left out."""
MIN_OUTLIER_PX = 0.1
WORST_SHARE = 0.5
MAX_OUTLIER_SHARE = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Refined:
    model: WorldModel
    rounds: int
    outliers: tuple[Outlier, ...]  # observations that were left out


def refine(
    model: WorldModel, camera: Camera, target: TargetDesign, board: BoardDesign, eccentricity: bool = True
) -> Refined:
    """Alternates between the eccentricity of the circles and bundle adjustment until the corrections settle."""
    radius = target.radius_of() | board.radius_of()
    model = adjust(model, camera)
    observations = len(model.image_index)
    outliers: list[Outlier] = []
    rounds = 0
    while rounds < MAX_ROUNDS:  # rounds that find outliers do not count: their number is limited separately
        rounds += 1
        shift = np.zeros_like(model.shift_px)
        if eccentricity:
            shift = eccentricity_px(model, camera, radius, find_scale(model, board).mm_per_unit)
        change = np.abs(shift - model.shift_px).max(initial=0.0)
        model = replace(model, shift_px=shift)
        if change > SETTLED_PX:
            model = adjust(model, camera)
        if rounds >= 2 or not eccentricity:
            is_outlier, new_outliers = _outliers(model, camera)
            if len(new_outliers):
                outliers += new_outliers
                if len(outliers) > MAX_OUTLIER_SHARE * observations:  # the model is wrong, not the observations
                    raise MappingError(
                        "E-GROUP-CONTRADICTS",
                        f"group {model.group}: more than {100 * MAX_OUTLIER_SHARE:.0f} % of {observations} "
                        f"observations contradict the others, first {outliers[0].image} {outliers[0].label} by "
                        f"{outliers[0].residual_px:.1f} px; check that nothing but the camera moved, and that the "
                        "camera file belongs to the images (without --camera it is found from the board's dots)",
                    )
                model = adjust(model.without(is_outlier), camera)
                rounds -= 1
                continue
        if change <= SETTLED_PX:
            return Refined(model, rounds, tuple(outliers))
    raise ConvergenceError(
        "E-NO-MINIMUM",
        f"group {model.group}: the eccentricity still changes by {change:.2g} px after {MAX_ROUNDS} rounds, "
        f"{SETTLED_PX:g} needed; check the radii in the target and board files",
    )


def eccentricity_px(model: GroupModel, camera: Camera, radius_mm: dict[Label, float], mm_per_unit: float) -> np.ndarray:
    """Centre of the imaged ellipse minus the image of the circle's centre, (n, 2), for every observation."""
    normal = np.zeros((len(model.labels), 3))
    for key, members in model.points_by_face().items():
        if max(radius_mm[model.labels[i]] for i in members) <= POINT_RADIUS_MM:
            continue  # corners have no eccentricity
        try:
            normal[members] = fit_plane(model.xyz_model[members]).normal
        except DegenerateError as error:
            surface = "the board" if key == "board" else f"face {key}"
            raise MappingError(
                "E-GROUP-FEW-CIRCLES",
                f"group {model.group}: {surface}: {len(members)} circles mapped, 3 needed for its plane that are not "
                f"on one line; add views that show {surface}",
            ) from error
    radius = np.array([radius_mm[label] for label in model.labels]) / mm_per_unit
    rotation = np.stack([pose.rotation for pose in model.camera_from_model])[model.image_index]
    xyz = model.xyz_camera()
    normal_camera = np.einsum("nij,nj->ni", rotation, normal[model.point_index])
    ellipse = circle_image_offset(xyz, normal_camera, radius[model.point_index])
    return camera.project(ellipse) - camera.project(xyz)


def _outliers(model: GroupModel, camera: Camera) -> tuple[np.ndarray, list[Outlier]]:
    """Returns the worst observation of each image near the worst of all: a bad one affects others that share its point
    or camera."""
    residual = np.linalg.norm(model.residuals_px(camera), axis=1)
    rms = np.sqrt(2) * robust_sigma(residual, 2)
    limit = np.maximum(np.maximum(OUTLIER_RMS * rms, 2 * OUTLIER_RMS * model.sigma_px()), MIN_OUTLIER_PX)
    least = max(1.0, WORST_SHARE * float((residual / limit).max(initial=0.0)))
    is_outlier = np.zeros(len(residual), bool)
    outliers = []
    for name, rows in zip(model.images, model.rows_by_image(), strict=True):
        worst = rows[np.argmax(residual[rows] / limit[rows])]
        if residual[worst] > least * limit[worst]:
            is_outlier[worst] = True
            label = model.labels[model.point_index[worst]]
            outliers.append(Outlier(name, label, float(residual[worst]), float(limit[worst])))
    return is_outlier, outliers
