"""camera_from_obj from the corners of one scene, with covariance, and with the second solution that a plane may leave.

Both are found (:mod:`stcal.geometry.plane_poses`) and refined, and compared by their χ².
"""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.linalg import block_diag

from stcal.boards.edges import corners_by_edges
from stcal.errors import DegenerateError
from stcal.geometry.arrays import frozen
from stcal.geometry.camera import Camera
from stcal.geometry.ippe import poses_of_plane
from stcal.geometry.plane_poses import (
    MAX_OUTLIER_SHARE,
    MAX_SIGMA_RAD,
    Weighed,
    covariance_of_both,
    step_between,
    two_minima,
    weights_of,
)
from stcal.geometry.pose_descent import Minima, PoseStack
from stcal.geometry.rigid import Poses, Rigid
from stcal.geometry.uncertain import ImageFit
from stcal.io.cameras.model import CameraPrior, intrinsic_basis
from stcal.locate.data.layout import TargetLayout
from stcal.locate.pose.problem import PlanarProblem, descent_near, project, weighed

START_PX = 2.0
"""Scale of the loss by which a start is chosen: one tag's own pose is off so much at the other tags."""


@dataclass(frozen=True, slots=True, eq=False)
class SeenTags:
    """Tags of a layout in one scene.

    Parameters
    ----------
    rows : (k,) int array
        Of the layout.
    corners_px : (k, 4, 2) array
        In the image as it is.
    covariance_px2 : (k, 4, 2, 2) array
        Of the corners, what the layout adds to single ones included.
    edge_sigma_px : (k,) array
        σ of a shift that all edges of a tag share.
    """

    rows: np.ndarray
    corners_px: np.ndarray
    covariance_px2: np.ndarray
    edge_sigma_px: np.ndarray

    def __post_init__(self):
        k = len(self.rows)
        object.__setattr__(self, "rows", frozen(self.rows, (k,), "rows", int))
        object.__setattr__(self, "corners_px", frozen(self.corners_px, (k, 4, 2), "tags' corners"))
        object.__setattr__(self, "covariance_px2", frozen(self.covariance_px2, (k, 4, 2, 2), "corners' covariances"))
        object.__setattr__(self, "edge_sigma_px", frozen(self.edge_sigma_px, (k,), "edges' σ"))

    def __len__(self) -> int:
        return len(self.rows)

    def select(self, keep) -> "SeenTags":
        """Those tags only."""
        return SeenTags(self.rows[keep], self.corners_px[keep], self.covariance_px2[keep], self.edge_sigma_px[keep])


@dataclass(frozen=True, slots=True, eq=False)
class ObjPose(ImageFit):
    """Where the target is in one scene.

    Parameters
    ----------
    camera_from_obj : Rigid
        mm.
    covariance : (6, 6) array
        rad and mm, left perturbation in the camera frame.
    rows : (k,) int array
        Of the layout's tags used.
    outliers : tuple of int
        Rows of those left out because they contradict the others.
    residuals_px : (4k, 2) array
        Measured minus projected corners.
    weights : (4k,) array
        Huber's.
    chi2 : float
        Of the residuals against their whole covariance.
    redundancy : int
        Coordinates measured, less the six of the pose.
    foreshortening : float
        Cosine between the target's normal and the line of sight to the middle of its corners.
    extent_px : float
        Of the corners in the image across their longer direction.
    delta_chi2 : float
        By which the second solution is worse; infinite where there is none.
    second : Rigid or None
        The second solution, camera_from_obj.
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
        """Of the rotation, about the worst axis."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance[:3, :3])[-1]))

    def sigma_mm(self) -> float:
        """Of the translation, along the worst direction."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance[3:, 3:])[-1]))


def locate(
    seen: SeenTags, layout: TargetLayout, camera: Camera, prior: CameraPrior | None = None, where: str = "scene"
) -> ObjPose:
    """The target's pose from the corners of its tags in one scene: camera_from_obj.

    The first step minimises the corners' residuals with Huber's loss, from the best of all poses that single tags and
    all of them together leave, and from its mirror image. The second weighs them by their whole covariance.

    Parameters
    ----------
    seen : SeenTags
        Corners of the layout's tags, px.
    layout : TargetLayout
        The target, with the covariance of its corners.
    camera : Camera
        At the size of the image.
    prior : CameraPrior, optional
        Covariance of the intrinsics, which are exact where None.
    where : str
        Name of the scene, for messages.

    Returns
    -------
    ObjPose
        The better of the minima, with the second solution where there is one.

    Raises
    ------
    DegenerateError
        No tag, tags that contradict one another, or corners that leave the rotation open.
    ConvergenceError
        No minimum is reached.
    """
    if not len(seen):
        raise DegenerateError("E-LOCATE-NO-TAG", f"{where}: no tag of the layout; 1 needed")
    problem = problem_of(seen, layout, camera, prior)
    start = PoseStack.of(_start(problem, where))
    keep, outliers, whole = np.arange(len(seen)), [], problem
    failure = f"{where}: no pose found; check layout and camera file"
    while True:
        middle = Rigid(np.eye(3), np.append(problem.xy.mean(0), 0.0))
        both = two_minima(partial(descent_near, problem), start, middle, failure)
        found = both.minima
        excess = found.length[0].reshape(-1, 4).max(1) / both.outlier_limit
        worst = int(excess.argmax())
        if excess[worst] <= 1:
            break
        outliers.append(int(seen.rows[keep[worst]]))
        keep = np.delete(keep, worst)
        if len(outliers) > MAX_OUTLIER_SHARE * len(seen):
            names = ", ".join(str(layout.tags[row][1]) for row in sorted(outliers))
            raise DegenerateError(
                "E-LOCATE-CONTRADICTS",
                f"{where}: {len(outliers)} of {len(seen)} tags contradict the others ({names}); check that layout and "
                "camera file belong to the images",
            )
        problem = whole.select((4 * keep[:, None] + np.arange(4)).ravel())
        start = found.poses[[0]]
    pose = _answer(problem, found, seen.rows[keep], tuple(outliers))
    if pose.sigma_rad() > MAX_SIGMA_RAD:
        raise DegenerateError(
            "E-LOCATE-OPEN", f"{where}: its tags leave the rotation open; show more tags, or larger ones"
        )
    return pose


def problem_of(seen: SeenTags, layout: TargetLayout, camera: Camera, prior: CameraPrior | None = None) -> PlanarProblem:
    """The corners with everything that is known of them."""
    rows = (8 * seen.rows[:, None] + np.arange(8)).ravel()
    pixels = seen.corners_px.reshape(-1, 2)
    ideal = camera.normalised_from_pixel(pixels)
    px_by_seen = camera.distort_jacobian(ideal)[1] * camera.focal[:, None]
    back = np.linalg.inv(px_by_seen)
    common = np.concatenate([_by_edges(seen, back), _by_tag(len(seen), back)], axis=2)
    known = np.diag(np.append(seen.edge_sigma_px**2, np.full(2 * len(seen), layout.tag_sigma_px**2)))
    if prior is not None:
        by_camera = back @ (camera.parameter_jacobian(ideal) @ intrinsic_basis(prior.colmap_model))
        common = np.concatenate([common, by_camera], axis=2)
        known = np.asarray(block_diag(known, prior.covariance))
    noise = back @ seen.covariance_px2.reshape(-1, 2, 2) @ np.swapaxes(back, 1, 2)
    xy = layout.corners_mm[seen.rows].reshape(-1, 2)
    return PlanarProblem(xy, ideal, noise, px_by_seen, layout.covariance_mm2[np.ix_(rows, rows)], common, known)


def _by_edges(seen: SeenTags, back: np.ndarray) -> np.ndarray:
    """Derivative (4k, 2, k) of the corners by the shift of each tag's edges, px."""
    k = len(seen)
    by = np.zeros((k, 4, 2, k))
    by[np.arange(k), :, :, np.arange(k)] = corners_by_edges(seen.corners_px)
    return back @ by.reshape(4 * k, 2, k)


def _by_tag(k: int, back: np.ndarray) -> np.ndarray:
    """Derivative (4k, 2, 2k) of the corners by the shift of each tag as a whole, px."""
    by = np.zeros((k, 4, 2, k, 2))
    by[np.arange(k), :, :, np.arange(k)] = np.eye(2)
    return back @ by.reshape(4 * k, 2, 2 * k)


def _start(problem: PlanarProblem, where: str) -> Rigid:
    """Of the poses of all corners together and of each tag alone, the one that fits most corners."""
    tags = [slice(4 * k, 4 * k + 4) for k in range(len(problem.xy) // 4)]
    for sets in ([slice(None)], tags):
        poses = _poses(problem, sets)
        if poses is None:
            continue
        view = project(problem, poses)
        off = np.linalg.norm((problem.px_by_seen @ view.residual[..., None])[..., 0], axis=2)
        score = np.where(view.before, np.log1p((off / START_PX) ** 2).sum(1), np.inf)
        best = int(score.argmin())
        # Where all corners agree, none is wrong, and single tags have nothing to add.
        if np.isfinite(score[best]) and (sets is tags or len(tags) == 1 or off[best].max() < 2 * START_PX):
            return poses[best]
    raise DegenerateError(
        "E-LOCATE-NO-POSE", f"{where}: no pose shows the tags' corners so; check layout, camera file and tags"
    )


def _poses(problem: PlanarProblem, sets: list[slice]) -> Poses | None:
    """Both poses of each set of corners."""
    found = []
    for part in sets:
        try:
            found += poses_of_plane(problem.xy[part], problem.seen[part]).poses
        except DegenerateError:
            continue
    return Poses.of(found) if found else None


def _answer(problem: PlanarProblem, found: Minima, rows: np.ndarray, outliers: tuple[int, ...]) -> ObjPose:
    """Decide between the minima, and collect."""
    own = weights_of(found.length)
    if len(own) == 1:
        return _collected(problem, weighed(problem, found.poses, own[0]), own[0], rows, outliers)
    # Both minima weigh the corners alike, as the stricter of the two does, or an outlier of one of them could decide.
    pair = [weighed(problem, found.poses[[i]], own.min(0)) for i in range(2)]
    delta = float(pair[1].chi2[0] - pair[0].chi2[0])
    better = int(delta < 0)
    best = weighed(problem, found.poses[[better]], own[better])
    pose = _collected(problem, best, own[better], rows, outliers)
    return replace(pose, delta_chi2=abs(delta), second=pair[1 - better].poses.rigid(0))


def _collected(problem: PlanarProblem, best: Weighed, weights: np.ndarray, rows, outliers: tuple[int, ...]) -> ObjPose:
    """One minimum, as if there were no second one."""
    pose = best.poses.rigid(0)
    middle = pose @ np.append(problem.xy.mean(0), 0.0)
    off = problem.in_px(problem.seen - problem.seen.mean(0))
    covariance = np.linalg.inv(best.normal[0])
    return ObjPose(
        camera_from_obj=pose,
        covariance=(covariance + covariance.T) / 2,
        rows=rows,
        outliers=outliers,
        residuals_px=problem.in_px(best.residual[0]),
        weights=weights,
        chi2=float(best.chi2[0]),
        redundancy=2 * len(problem.xy) - 6,
        foreshortening=float(pose.rotation[:, 2] @ middle / np.linalg.norm(middle)),
        extent_px=float(np.ptp(off @ np.linalg.svd(off, full_matrices=False)[2][1])),
    )


def covering_both(pose: ObjPose) -> ObjPose:
    """The pose with a covariance that covers its second solution too, by the odds of both."""
    if pose.second is None:
        return pose
    away = step_between(PoseStack.of(pose.camera_from_obj), PoseStack.of(pose.second))
    return replace(pose, covariance=covariance_of_both(pose.covariance, away, pose.delta_chi2))
