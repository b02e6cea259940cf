"""Adjustment of one group: weighted bundle adjustment, alternating with the circles' eccentricity."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.linalg import LinAlgError
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial.transform import Rotation

from stcal.design import POINT_RADIUS_MM, BoardDesign, TargetDesign
from stcal.errors import ConvergenceError, DegenerateError, MappingError
from stcal.geometry.camera import Camera
from stcal.geometry.least_squares import minimise
from stcal.geometry.normal_equations import blocks_of, reduce
from stcal.geometry.plane import circle_image_offset, fit_plane
from stcal.geometry.rigid import Rigid, skew
from stcal.geometry.robust import robust_sigma
from stcal.labels import Label
from stcal.sfm.adjust.scale import find_scale
from stcal.sfm.data.model import MIN_POINTS, GroupModel, M, Outlier, WorldModel

EXACTLY = 1e-15
"""Largest predicted decrease of the last step, as a share of χ²: corrections of nanometres must be seen."""
MAX_STEPS = 50
DAMPING = 1e-10
"""Relative damping, which holds the seven free directions of the world."""


def adjust(model: M, camera: Camera) -> M:
    """Minimises the weighted reprojection error of the corrected centres over poses and points."""
    if not model.images:
        raise MappingError(
            "E-GROUP-FEW-IMAGES",
            f"group {model.group}: no two images have {MIN_POINTS} circles or corners in common; add images, until two "
            "show each face beside a neighbour",
        )
    minimum = minimise(
        model,
        lambda state: _Normal.of(state, camera),
        _moved,
        cost=lambda state: _cost(state, camera),
        damping=DAMPING,
        least_damping=DAMPING,
        settled=EXACTLY,
        max_steps=MAX_STEPS,
    )
    remedy = "check the camera file, and the sizes of printed faces in target.toml"
    return minimum.required(f"group {model.group}: bundle adjustment", remedy).state


def _cost(model: GroupModel, camera: Camera) -> float:
    if (model.xyz_camera()[:, 2] <= 0).any():
        return np.inf
    return float((model.whiten(model.residuals_px(camera)) ** 2).sum())


def projection_jacobians(model: GroupModel, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Returns the derivatives of the projections (px) by poses, left perturbed, (n, 2, 6), and by points, (n, 2, 3)."""
    xyz = model.xyz_camera()
    ideal = xyz[:, :2] / xyz[:, 2:]
    by_ideal = camera.distort_jacobian(ideal)[1] * camera.focal[:, None]
    by_camera = np.concatenate([by_ideal, -by_ideal @ ideal[..., None]], axis=2) / xyz[:, 2, None, None]
    translation = np.stack([pose.translation for pose in model.camera_from_model])[model.image_index]
    by_pose = np.concatenate([-by_camera @ skew(xyz - translation), by_camera], axis=2)
    rotation = np.stack([pose.rotation for pose in model.camera_from_model])[model.image_index]
    return by_pose, by_camera @ rotation


@dataclass(frozen=True, slots=True, eq=False)
class _Normal:
    """Normal equations of m poses and p points, and their ``cross`` blocks (m, p, 6, 3)."""

    cost: float
    poses: np.ndarray
    pose_right: np.ndarray
    points: np.ndarray
    point_right: np.ndarray
    cross: np.ndarray

    @classmethod
    def of(cls, model: GroupModel, camera: Camera) -> "_Normal":
        by_pose, by_point = (model.whiten(derivative) for derivative in projection_jacobians(model, camera))
        residual = model.whiten(model.residuals_px(camera))
        m, p = len(model.images), len(model.labels)
        cross = np.zeros((m, p, 6, 3))
        cross[model.image_index, model.point_index] = np.swapaxes(by_pose, 1, 2) @ by_point
        return cls(
            _cost(model, camera),
            *blocks_of(by_pose, residual, model.image_index, m),
            *blocks_of(by_point, residual, model.point_index, p),
            cross,
        )

    def step(self, damping: float | np.ndarray) -> tuple[np.ndarray, float]:
        """Returns the step (6m + 3p,) of poses, then points, and its gain; the larger of both sets is eliminated."""
        poses, points = (block + damping * block * np.eye(block.shape[1]) for block in (self.poses, self.points))
        if self.poses.size // 6 <= self.points.size // 3:
            pose_step, point_step = _solve(poses, self.pose_right, points, self.point_right, self.cross)
        else:
            cross = self.cross.transpose(1, 0, 3, 2)
            point_step, pose_step = _solve(points, self.point_right, poses, self.pose_right, cross)
        gain = float((pose_step * self.pose_right).sum() + (point_step * self.point_right).sum())
        return np.concatenate([pose_step.ravel(), point_step.ravel()]), gain


def _moved(model: M, step: np.ndarray) -> M:
    """Returns the model after steps of its poses and points."""
    poses, points = step[: 6 * len(model.images)].reshape(-1, 6), step[6 * len(model.images) :].reshape(-1, 3)
    return replace(
        model, camera_from_model=moved_poses(model.camera_from_model, poses), xyz_model=model.xyz_model + points
    )


def moved_poses(poses: tuple[Rigid, ...], step: np.ndarray) -> tuple[Rigid, ...]:
    """Returns poses after left perturbations (m, 6)."""
    turned = Rotation.from_rotvec(step[:, :3]).as_matrix()
    return tuple(
        Rigid(turn @ pose.rotation, pose.translation + shift)
        for turn, pose, shift in zip(turned, poses, step[:, 3:], strict=True)
    )


def _solve(kept, kept_right, dropped, dropped_right, cross) -> tuple[np.ndarray, np.ndarray]:
    """Returns the steps of the kept blocks (a, i) and of the eliminated ones (b, j); ``cross`` : (a, b, i, j)."""
    a, b, i, j = cross.shape
    reduction = reduce(dropped, dropped_right, cross.transpose(1, 3, 0, 2).reshape(b, j, a * i))
    normal = -reduction.normal
    normal.reshape(a, i, a, i)[np.arange(a), :, np.arange(a)] += kept
    step = _solve_symmetric(normal, kept_right.ravel() - reduction.right)
    return step.reshape(a, i), reduction.back(step)


def _solve_symmetric(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solves by Cholesky decomposition if the damping permits it; else returns the shortest solution."""
    try:
        return cho_solve(cho_factor(matrix), right)
    except LinAlgError:
        return np.linalg.lstsq(matrix, right, rcond=1e-14)[0]


MAX_ROUNDS = 20
SETTLED_PX = 1e-5
"""Largest change of corrections that have settled, in px: far below any centring noise."""
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
                _require_few(outliers, observations, model.group)
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


def _require_few(outliers: list[Outlier], observations: int, group: str) -> None:
    """Raises an error if the outliers are many: then the model is wrong, not the observations."""
    if len(outliers) > MAX_OUTLIER_SHARE * observations:
        raise MappingError(
            "E-GROUP-CONTRADICTS",
            f"group {group}: more than {100 * MAX_OUTLIER_SHARE:.0f} % of {observations} observations contradict the "
            f"others, first {outliers[0].image} {outliers[0].label} by {outliers[0].residual_px:.1f} px; "
            "check that nothing but the camera moved, and that the camera file belongs to the images (without --camera "
            "the camera is found from the board's dots)",
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
