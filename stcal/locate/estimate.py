"""Pose camera_from_obj from the corners of one scene, with covariance, and the second pose that may fit as well.
Corners of several exposures are merged, and it is tested whether the scene stood still."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from stcal.boards.edges import corners_by_edges
from stcal.boards.tags import Tags
from stcal.errors import DegenerateError
from stcal.geometry import least_squares
from stcal.geometry.arrays import Brief, freeze, require_arguments
from stcal.geometry.camera import Camera, intrinsic_basis
from stcal.geometry.least_squares import Minima, Normal, NormalEquations, block_diagonal, minimise, select_rows
from stcal.geometry.plane import (
    MAX_OUTLIER_SHARE,
    MAX_SIGMA_RAD,
    Descend,
    Weighed,
    generalised_equations,
    poses_of_plane,
    two_minima,
    weigh,
    weights_of,
)
from stcal.geometry.rigid import ImageFit, Poses, Rigid, by_pose, perspective
from stcal.io.cameras.camera_model import CameraPrior
from stcal.locate.layout import TargetLayout

SETTLED = 1e-5
"""Decrease of χ² at which the descent ends. A step that lowers χ² by less moves the pose by less than σ/100."""
WEIGHED = 1e-6  # least decrease of χ²: a step of less than σ/1000 is the last


@dataclass(frozen=True, slots=True, eq=False)
class PlanarProblem:
    """Measurements of n corners of a plane with their noise model, in normalised coordinates without distortion."""

    xy: np.ndarray  # (n, 2) in {obj}, mm
    seen: np.ndarray  # (n, 2)
    noise: np.ndarray  # (2n, 2n) covariance of ``seen``, tag by tag
    px_by_seen: np.ndarray  # (n, 2, 2) jacobian of the lens
    shape: np.ndarray  # (2n, 2n) covariance of ``xy``
    intrinsics: np.ndarray  # (2n, 2n) covariance of ``seen`` due to those of the camera

    def select(self, keep: np.ndarray) -> "PlanarProblem":
        """Returns the selected corners."""
        rows = (2 * keep[:, None] + np.arange(2)).ravel()
        at = np.ix_(rows, rows)
        points = self.xy[keep], self.seen[keep], self.noise[at], self.px_by_seen[keep]
        return PlanarProblem(*points, self.shape[at], self.intrinsics[at])

    def in_px(self, residual: np.ndarray) -> np.ndarray:
        """Returns the residuals (n, 2) in the image with distortion, px."""
        return (self.px_by_seen @ residual[..., None])[..., 0]


@dataclass(frozen=True, slots=True, eq=False)
class ProjectedCorners:
    """Corners as h poses project them; derivatives are negative."""

    residual: np.ndarray  # (h, n, 2) measured minus projected
    by_pose: np.ndarray  # (h, n, 2, 6)
    by_corner: np.ndarray  # (h, n, 2, 2)
    before: np.ndarray  # (h,) whether all corners are in front of the camera


def project(problem: PlanarProblem, poses: Poses) -> ProjectedCorners:
    """Returns the residuals of h poses, and their derivatives."""
    turned = np.einsum("hij,nj->hni", poses.rotation[:, :, :2], problem.xy)
    xyz = turned + poses.translation[:, None]
    uv, by_point = perspective(xyz)
    by_corner = by_point @ poses.rotation[:, None, :, :2]
    return ProjectedCorners(problem.seen - uv, by_pose(by_point, turned), by_corner, (xyz[..., 2] > 0).all(1))


def descent_near(problem: PlanarProblem, pose: Poses) -> Descend:
    """Returns the descent with residuals of single corners whitened near a pose by noise and layout errors."""
    by_corner = project(problem, pose).by_corner[0]
    n = len(problem.xy)
    seen, shape = (
        matrix.reshape(n, 2, n, 2)[np.arange(n), :, np.arange(n)]
        for matrix in (problem.noise + problem.intrinsics, problem.shape)
    )
    whiten = np.linalg.inv(np.linalg.cholesky(seen + by_corner @ shape @ np.swapaxes(by_corner, 1, 2)))

    def descend(poses: Poses, huber: float) -> Minima:
        def evaluate(poses: Poses) -> Normal:
            view = project(problem, poses)
            return Normal.of((whiten @ view.residual[..., None])[..., 0], whiten @ view.by_pose, view.before, huber)

        return least_squares.descend(evaluate, poses, SETTLED)

    return descend


def weighed(problem: PlanarProblem, pose: Poses, weights: np.ndarray) -> Weighed:
    """Estimates a pose by image noise over Huber's ``weights`` (n,), and the covariances of camera and layout."""
    root = np.repeat(np.sqrt(weights), 2)
    noise = problem.noise / (root[:, None] * root) + problem.intrinsics
    by_corner = block_diagonal(project(problem, pose).by_corner[0])
    full = (noise + by_corner @ problem.shape @ by_corner.T)[None]

    def linearise(poses: Poses) -> NormalEquations:
        view = project(problem, poses)
        equations = generalised_equations(view.residual, view.by_pose, full)
        return replace(equations, cost=np.where(view.before, equations.cost, np.inf))

    # A second solution that is far worse need not converge: it only shows that the first one is better.
    minimum = minimise(
        pose, linearise, Poses.moved, select=select_rows, damping=1e-6, least_gain=WEIGHED, max_steps=60
    ).state
    view = project(problem, minimum)
    return weigh(view.residual, view.by_pose, full, minimum)


START_PX = 2.0
"""Scale of the loss that selects a start, in px: typical error of one tag's pose at the other tags."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class SeenTags(Brief):
    """Corners of a layout's tags in one scene.

    ``rows`` : (k,) of the tags in the layout; ``corners_px`` : (k, 4, 2), with distortion; ``covariance_px2`` : (k, 8,
    8) of the four corners of each, with the common shift of its edges, and what the layout adds.
    """

    rows: np.ndarray
    corners_px: np.ndarray
    covariance_px2: np.ndarray

    def __post_init__(self):
        freeze(self, "rows", (None,), "rows", int)
        k = len(self.rows)
        freeze(self, "corners_px", (k, 4, 2), "tags' corners")
        freeze(self, "covariance_px2", (k, 8, 8), "corners' covariances")

    def __len__(self) -> int:
        return len(self.rows)


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class ObjPose(ImageFit, Brief):
    """Pose of the target in one scene.

    ``camera_from_obj`` : the pose, mm; ``covariance`` : (6, 6) covariance, rad and mm, left perturbation in the camera
    frame; ``rows`` : (k,) rows of the tags used in the layout; ``outliers`` : rows of the tags that were left out
    because they contradict the others; ``residuals_px`` : (4k, 2) measured minus projected corners; ``weights`` : (4k,)
    Huber's weights; ``chi2`` : χ² of the residuals with their full covariance; ``redundancy`` : number of measured
    coordinates minus the six unknowns of the pose; ``foreshortening`` : cosine between the target's normal and the line
    of sight to the middle of its corners; ``extent_px`` : extent of the corners in the image across their longer
    direction; ``delta_chi2`` : χ² of the second solution minus that of the pose; infinite if there is no second
    solution; ``second`` : the second solution, camera_from_obj.
    """

    camera_from_obj: Rigid
    covariance: np.ndarray
    rows: np.ndarray
    outliers: tuple[int, ...]
    residuals_px: np.ndarray
    weights: np.ndarray
    chi2: float
    redundancy: int
    foreshortening: float
    extent_px: float
    delta_chi2: float = np.inf
    second: Rigid | None = None

    def sigma_rad(self) -> float:
        """Returns σ of the rotation about the worst axis."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance[:3, :3])[-1]))

    def sigma_mm(self) -> float:
        """Returns σ of the translation along the worst direction."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance[3:, 3:])[-1]))


@require_arguments
def locate(
    seen: SeenTags, layout: TargetLayout, camera: Camera, prior: CameraPrior | None = None, where: str = "scene"
) -> ObjPose:
    """Estimates the target's pose camera_from_obj from the corners of its tags in one scene.

    The first step minimises the corners' residuals with Huber's loss. It starts from the best pose of all tags together
    or of a single tag, and from the mirror image of this pose. The second step weighs the residuals by their full
    covariance.

    Parameters
    ----------
    seen : corners of the layout's tags, px.
    layout : the target, with the covariance of its corners.
    camera : the camera at the size of the image.
    prior : covariance of the intrinsics; they are exact if None.
    where : name of the scene, for messages.

    Returns
    -------
    ObjPose : the better minimum, with the second solution if there is one.

    Raises DegenerateError: there is no tag, the tags contradict one another, or the corners do not determine the
    rotation. Raises ConvergenceError: no minimum is reached.
    """
    if not len(seen):
        raise DegenerateError("E-LOCATE-NO-TAG", f"{where}: no tag of the layout; 1 needed")
    problem = problem_of(seen, layout, camera, prior)
    start = Poses.of([_start(problem, where)])
    keep, outliers, all_corners = np.arange(len(seen)), [], problem
    failure = f"{where}: no pose found; check layout and camera file"
    while True:
        middle = Rigid(np.eye(3), np.append(problem.xy.mean(0), 0.0))
        minima, limit = two_minima(partial(descent_near, problem), start, middle, failure)
        excess = minima.length[0].reshape(-1, 4).max(1) / limit
        worst = int(excess.argmax())
        if excess[worst] <= 1:
            break
        outliers.append(int(seen.rows[keep[worst]]))
        keep = np.delete(keep, worst)
        if len(outliers) > MAX_OUTLIER_SHARE * len(seen):
            names = ", ".join(str(layout.tags[row][1]) for row in sorted(outliers))
            fault = f"{where}: {len(outliers)} of {len(seen)} tags contradict the others ({names})"
            remedy = "check that layout and camera file belong to the images"
            raise DegenerateError("E-LOCATE-CONTRADICTS", f"{fault}; {remedy}")
        problem = all_corners.select((4 * keep[:, None] + np.arange(4)).ravel())
        start = minima.poses[[0]]
    pose = _answer(problem, minima, seen.rows[keep], tuple(outliers))
    if pose.sigma_rad() > MAX_SIGMA_RAD:
        undetermined = f"{where}: its tags do not determine the rotation"
        raise DegenerateError("E-LOCATE-OPEN", f"{undetermined}; show more tags, or larger ones")
    return pose


def problem_of(
    detected: SeenTags, layout: TargetLayout, camera: Camera, prior: CameraPrior | None = None
) -> PlanarProblem:
    """Returns the corners with their full noise model."""
    rows = (8 * detected.rows[:, None] + np.arange(8)).ravel()
    pixels = detected.corners_px.reshape(-1, 2)
    ideal = camera.normalised_from_pixel(pixels)
    px_by_seen = camera.pixel_jacobian(ideal)
    seen_by_px = np.linalg.inv(px_by_seen)
    in_seen = block_diagonal(seen_by_px.reshape(-1, 4, 2, 2))
    noise = block_diagonal(in_seen @ detected.covariance_px2 @ np.swapaxes(in_seen, 1, 2))
    intrinsics = np.zeros_like(noise)
    if prior is not None:
        by_camera = seen_by_px @ (camera.parameter_jacobian(ideal) @ intrinsic_basis(prior.colmap_model))
        flat = by_camera.reshape(len(noise), -1)
        intrinsics = flat @ prior.covariance @ flat.T
    xy, shape = layout.corners_mm[detected.rows].reshape(-1, 2), layout.covariance_mm2[np.ix_(rows, rows)]
    return PlanarProblem(xy, ideal, noise, px_by_seen, shape, intrinsics)


def _start(problem: PlanarProblem, where: str) -> Rigid:
    """Returns the pose that fits most corners, among those from all corners together and from each tag alone."""
    tags = [slice(4 * k, 4 * k + 4) for k in range(len(problem.xy) // 4)]
    for sets in ([slice(None)], tags):
        poses = []
        for corners in sets:
            with suppress(DegenerateError):
                poses += poses_of_plane(problem.xy[corners], problem.seen[corners]).poses
        if not poses:
            continue
        view = project(problem, Poses.of(poses))
        distance = np.linalg.norm(problem.in_px(view.residual), axis=2)
        score = np.where(view.before, np.log1p((distance / START_PX) ** 2).sum(1), np.inf)
        best = int(score.argmin())
        # If all corners agree with one pose, none is wrong, and poses of single tags are not needed.
        if np.isfinite(score[best]) and (sets is tags or len(tags) == 1 or distance[best].max() < 2 * START_PX):
            return poses[best]
    fault = f"{where}: no pose explains the tags' corners"
    raise DegenerateError("E-LOCATE-NO-POSE", f"{fault}; check layout, camera file and tags")


def _answer(problem: PlanarProblem, found: Minima, rows: np.ndarray, outliers: tuple[int, ...]) -> ObjPose:
    """Chooses the better minimum, and returns it with the other one as the second solution."""
    weights, better, delta, second = weights_of(found.length), 0, np.inf, None
    if len(weights) > 1:
        # Both minima use the same weights, the smaller of the two. Otherwise an outlier of one minimum could decide.
        pair = [weighed(problem, found.poses[[i]], weights.min(0)) for i in range(2)]
        delta = float(pair[1].chi2[0] - pair[0].chi2[0])
        better = int(delta < 0)
        delta, second = abs(delta), pair[1 - better].poses[0]
    best = weighed(problem, found.poses[[better]], weights[better])
    pose = best.poses[0]
    middle = pose @ np.append(problem.xy.mean(0), 0.0)
    offset = problem.in_px(problem.seen - problem.seen.mean(0))
    covariance = np.linalg.inv(best.normal[0])
    return ObjPose(
        camera_from_obj=pose,
        covariance=(covariance + covariance.T) / 2,
        rows=rows,
        outliers=outliers,
        residuals_px=problem.in_px(best.residual[0]),
        weights=weights[better],
        chi2=float(best.chi2[0]),
        redundancy=2 * len(problem.xy) - 6,
        foreshortening=float(pose.rotation[:, 2] @ middle / np.linalg.norm(middle)),
        extent_px=float(np.ptp(offset @ np.linalg.svd(offset, full_matrices=False)[2][1])),
        delta_chi2=delta,
        second=second,
    )


def reprojection_rms(camera_from_obj: Rigid, xy: np.ndarray, pixels: np.ndarray, camera: Camera) -> float:
    """Returns the RMS distance of projected corners (n, 2), mm, from measured ones, px; infinite behind the camera."""
    xyz = camera_from_obj @ np.column_stack([xy, np.zeros(len(xy))])
    if (xyz[:, 2] <= 0).any():
        return np.inf
    return float(np.sqrt(((camera.project(xyz) - pixels) ** 2).sum(1).mean()))


PRIOR_SHARE, PRIOR_WEIGHT = 0.5, 20.0
"""Prior of the share of a corner's variance that differs between exposures, and its weight in differences."""


@dataclass(frozen=True, slots=True, eq=False)
class Shift:
    """Of tags' middles between exposures. ``tags`` : in common; ``shift_px`` : median; ``sigma_px`` : of one tag's."""

    exposures: tuple[str, str]
    tags: int
    shift_px: float
    sigma_px: float


@dataclass(frozen=True, slots=True, eq=False)
class Merged:
    """Corners of all exposures by :func:`merge`."""

    seen: SeenTags  # of the layout's tags
    share: float  # of the corners' variance that differs between exposures
    shifts: tuple[Shift, ...]  # of each exposure against the one with the most tags in common
    repeated: tuple[tuple[str, int], ...]  # tags that an exposure shows more than once
    unknown: tuple[tuple[str, int], ...]  # tags that the layout lacks

    @property
    def rows(self) -> np.ndarray:
        return self.seen.rows


def merge(exposures: Sequence[Tags], layout: TargetLayout, names: Sequence[str] = ()) -> Merged:
    """Returns weighted means of the corners, with their covariance. Errors that exposures share (print, lens),
    by differences against stated σ, do not average out; larger differences increase the σ."""
    rows = layout.rows()
    used = np.array(sorted({rows[tag] for tags in exposures for tag in tags.tags if tag in rows}), int)
    # corners, NaN if unseen; covariances of each and of a tag's four, px²; σ of the edges' common shift
    shape = len(exposures), len(used)
    corners, edge = np.full((*shape, 4, 2), np.nan), np.zeros(shape)
    covariance, joint = np.tile(np.eye(2), (*shape, 4, 1, 1)), np.tile(np.eye(8), (*shape, 1, 1))
    for e, tags in enumerate(exposures):
        own = [k for k, tag in enumerate(tags.tags) if tag in rows]
        seen = np.searchsorted(used, [rows[tags.tags[k]] for k in own])
        corners[e, seen], covariance[e, seen] = tags.corners_px[own], tags.corner_covariances_px2()[own]
        joint[e, seen], edge[e, seen] = tags.joint_px2[own], tags.edge_sigma_px()[own]
    visible = np.isfinite(corners[..., 0, 0])
    # At a right angle, a corner shifts by √2 times the shift of its edges.
    variance = np.trace(covariance, axis1=-2, axis2=-1) + 2 * edge[..., None] ** 2
    weight = np.where(visible[..., None], 1 / variance, 0.0)
    weight_share = weight / weight.sum(0)
    mean = (weight_share[..., None] * np.where(visible[..., None, None], corners, 0)).sum(0)
    share = _differing_share(corners, covariance, mean, visible)
    growth, differing = max(share, 1.0), min(share, 1.0)
    root = np.repeat(weight_share, 2, axis=2)[..., None] * np.linalg.cholesky(joint)
    independent = np.einsum("enij,enlj->nil", root, root)
    common = np.einsum("enij,fnlj->nil", root, root)
    shift = (weight_share.mean(2) * edge).sum(0)[:, None] * corners_by_edges(mean).reshape(-1, 8)
    whole = layout.tag_sigma_px * np.tile(np.eye(2), (4, 1))
    merged = growth * (differing * independent + (1 - differing) * common) + shift[:, :, None] * shift[:, None]
    merged += layout.sigma_px**2 * np.eye(8) + whole @ whole.T
    return Merged(
        SeenTags(used, mean, merged),
        share,
        _shifts(corners, covariance, visible, names or [str(k + 1) for k in range(len(exposures))]),
        tuple(sorted({tag for tags in exposures for tag in tags.repeated if tag in rows})),
        tuple(sorted({tag for tags in exposures for tag in tags.tags if tag not in rows})),
    )


def _differing_share(corners, covariance, mean, there) -> float:
    """Returns the share of stated variance in differences between exposures, beside common shifts of a tag's edges."""
    difference = np.where(there[..., None, None], corners - mean, 0)
    direction = corners_by_edges(mean)
    along = (difference * direction).sum((2, 3)) / (direction * direction).sum((1, 2))
    difference -= along[..., None, None] * direction
    square = np.einsum("enki,enkij,enkj->enk", difference, np.linalg.inv(covariance), difference)
    repeated = there.sum(0) > 1
    # Bounds the influence of a tag that one exposure gets wrong.
    square = np.minimum(square[:, repeated], 25.0)
    dof = 7 * float((there.sum(0)[repeated] - 1).sum())
    return float((square.sum() + PRIOR_SHARE * PRIOR_WEIGHT) / (dof + PRIOR_WEIGHT))


def _shifts(corners, covariance, there, names) -> tuple[Shift, ...]:
    """Returns the shift of each exposure against the one with most tags in common, among exposures with more tags."""
    order = sorted(range(len(there)), key=lambda e: -int(there[e].sum()))
    middle = corners.mean(2)
    variance = np.trace(covariance, axis1=-2, axis2=-1).mean(2) / 4
    shifts = []
    for place, e in enumerate(order):
        common, f = max(((int((there[e] & there[f]).sum()), f) for f in order[:place]), default=(0, -1))
        if common:
            both = there[e] & there[f]
            length = np.linalg.norm(middle[e, both] - middle[f, both], axis=1)
            sigma = np.sqrt((variance[e, both] + variance[f, both]).mean())
            shifts.append(Shift((names[f], names[e]), common, float(np.median(length)), float(sigma)))
    return tuple(shifts)
