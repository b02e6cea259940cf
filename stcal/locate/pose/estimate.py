"""camera_from_obj from the corners of one scene, with covariance, and with the second pose that a plane may leave.

A plane seen from afar looks the same tilted to either side of the line of sight (Oberkampf et al. 1996; Schweighofer &
Pinz 2006): the reprojection error has two minima. Both are found and refined, and compared by their χ².
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag
from scipy.stats import chi2 as chi_square

from stcal.boards.edges import corners_by_edges
from stcal.errors import ConvergenceError, DegenerateError
from stcal.geometry.arrays import frozen
from stcal.geometry.camera import Camera
from stcal.geometry.ippe import poses_of_plane
from stcal.geometry.pose_descent import Minima
from stcal.geometry.rigid import Poses, Rigid
from stcal.io.camera import CameraPrior, intrinsic_basis
from stcal.locate.data.layout import TargetLayout
from stcal.locate.pose.problem import (
    HUBER,
    PlanarProblem,
    Weighed,
    descend,
    mirrored,
    own_whitening,
    project,
    weigh,
)

START_PX = 2.0
"""Scale of the loss by which a start is chosen: one tag's own pose is off so much at the other tags."""
OUTLIER = 6.0
"""In σ, or in the residuals' robust spread: by chance one corner in 6·10⁷ (Rayleigh). Its tag is left out and named."""
RAYLEIGH_MEDIAN = float(np.sqrt(2 * np.log(2)))
MAX_OUTLIER_SHARE = 1 / 3
SAME = 1.0
"""Minima nearer than this, in σ, are one: its covariance covers both."""
MAX_SIGMA_RAD = 0.5
"""A rotation whose σ is larger is none: linear propagation says nothing any more."""


@dataclass(frozen=True, slots=True, eq=False)
class SeenTags:
    """Tags of a layout in one scene.

    ``rows`` : (k,) of the layout; ``corners_px`` : (k, 4, 2); ``covariance_px2`` : (k, 4, 2, 2), what the
    layout adds to single corners included; ``edge_sigma_px`` : (k,) of a shift that all edges of a tag share.
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
class ObjPose:
    """Where the target is in one scene.

    ``camera_from_obj``; ``covariance`` : (6, 6) rad and mm, left perturbation in the camera frame; ``rows`` : (k,) of
    the layout's tags used, ``outliers`` : of those left out because they contradict the others; ``residuals_px`` :
    (4k, 2) measured minus projected; ``weights`` : (4k,) Huber's; ``chi2``, ``dof`` against the whole covariance;
    ``delta_chi2`` : by which the other minimum is worse, infinite where there is none; ``twin`` : that minimum's pose;
    ``foreshortening`` : cosine between the target's normal and the line of sight to the middle of its corners;
    ``spread_px`` : extent of the corners in the image across their longer direction.
    """

    camera_from_obj: Rigid
    covariance: np.ndarray
    rows: np.ndarray
    outliers: tuple[int, ...]
    residuals_px: np.ndarray
    weights: np.ndarray
    chi2: float
    dof: int
    delta_chi2: float
    foreshortening: float
    spread_px: float
    twin: Rigid | None = None

    def rms_px(self) -> float:
        """Of the residuals, per coordinate."""
        return float(np.sqrt((self.residuals_px**2).mean()))

    def chi2_per_dof(self) -> float:
        """About 1 where the σ of corners, layout and intrinsics are true."""
        return self.chi2 / self.dof

    def p_value(self) -> float:
        """Probability of residuals as large, with those σ."""
        return float(chi_square.sf(self.chi2, self.dof))

    def sigma_rad(self) -> float:
        """Of the rotation, about the worst axis."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance[:3, :3])[-1]))

    def sigma_mm(self) -> float:
        """Of the translation, along the worst direction."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance[3:, 3:])[-1]))


def locate(
    seen: SeenTags, layout: TargetLayout, camera: Camera, prior: CameraPrior | None = None, where: str = "scene"
) -> ObjPose:
    """The target's pose from the corners of its tags in one scene.

    The first step minimises the corners' residuals with Huber's loss, from the best of all poses that single tags and
    all of them together leave, and from its mirror image. The second weighs them by their whole covariance.

    Raises
    ------
    DegenerateError
        No tag, tags that contradict one another, or corners that leave the rotation open.
    ConvergenceError
        No minimum is reached.
    """
    if not len(seen):
        raise DegenerateError(f"{where}: no tag of the layout; 1 needed")
    problem = problem_of(seen, layout, camera, prior)
    start = _start(problem, where)
    keep, outliers, whole = np.arange(len(seen)), [], problem
    while True:
        found, limit = _two_minima(problem, start, where)
        excess = found.length[0].reshape(-1, 4).max(1) / limit
        worst = int(excess.argmax())
        if excess[worst] <= 1:
            break
        outliers.append(int(seen.rows[keep[worst]]))
        keep = np.delete(keep, worst)
        if len(outliers) > MAX_OUTLIER_SHARE * len(seen):
            names = ", ".join(str(layout.tags[row][1]) for row in sorted(outliers))
            raise DegenerateError(
                f"{where}: {len(outliers)} of {len(seen)} tags contradict the others ({names}); check that layout and "
                "camera file belong to the images"
            )
        problem = whole.select((4 * keep[:, None] + np.arange(4)).ravel())
        start = found.poses[0]
    pose = _answer(problem, found, seen.rows[keep], tuple(outliers))
    if pose.sigma_rad() > MAX_SIGMA_RAD:
        raise DegenerateError(f"{where}: its tags leave the rotation open; show more tags, or larger ones")
    return pose


def problem_of(seen: SeenTags, layout: TargetLayout, camera: Camera, prior: CameraPrior | None = None) -> PlanarProblem:
    """The corners with everything that is known of them."""
    rows = (8 * seen.rows[:, None] + np.arange(8)).ravel()
    pixels = seen.corners_px.reshape(-1, 2)
    ideal = camera.normalised_from_pixel(pixels)
    slope = camera.distort_jacobian(ideal)[1] * camera.focal[:, None]
    back = np.linalg.inv(slope)
    common = np.concatenate([_by_edges(seen, back), _by_tag(len(seen), back)], axis=2)
    known = np.diag(np.append(seen.edge_sigma_px**2, np.full(2 * len(seen), layout.tag_sigma_px**2)))
    if prior is not None:
        by_camera = back @ (camera.parameter_jacobian(ideal) @ intrinsic_basis(prior.colmap_model))
        common, known = np.concatenate([common, by_camera], axis=2), block_diag(known, prior.covariance)
    noise = back @ seen.covariance_px2.reshape(-1, 2, 2) @ np.swapaxes(back, 1, 2)
    xy = layout.corners_mm[seen.rows].reshape(-1, 2)
    return PlanarProblem(xy, ideal, noise, slope, layout.covariance_mm2[np.ix_(rows, rows)], common, known)


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
        off = np.linalg.norm((problem.slope @ view.residual[..., None])[..., 0], axis=2)
        score = np.where(view.before, np.log1p((off / START_PX) ** 2).sum(1), np.inf)
        best = int(score.argmin())
        # Where all corners agree, none is wrong, and single tags have nothing to add.
        if np.isfinite(score[best]) and (sets is tags or len(tags) == 1 or off[best].max() < 2 * START_PX):
            return poses[best]
    raise DegenerateError(f"{where}: no pose shows the tags' corners so; check layout, camera file and tags")


def _poses(problem: PlanarProblem, sets: list[slice]) -> Poses | None:
    """Both poses of each set of corners."""
    found = []
    for part in sets:
        try:
            found += poses_of_plane(problem.xy[part], problem.seen[part]).poses
        except DegenerateError:
            continue
    return Poses.of(found) if found else None


def _two_minima(problem: PlanarProblem, start: Rigid, where: str) -> tuple[Minima, float]:
    """One or two distinct minima by single corners, the better one first, and the outliers' limit in σ."""
    middle = problem.xy.mean(0)
    poses = Poses.of([start, mirrored(start, middle)])
    spread = 1.0
    for _ in range(2):  # the second time with the residuals' own spread, if that is larger
        whiten = own_whitening(problem, poses[[0]])
        found = descend(problem, poses, whiten, HUBER * spread)
        best = int(np.argmin(found.cost))
        poses = found.poses[[best, 1 - best]]
        wider = float(np.median(found.length[best])) / RAYLEIGH_MEDIAN
        if wider <= 1.1 * spread:
            break
        spread = wider
    if not np.isfinite(found.cost[best]) or not found.settled[best]:
        raise ConvergenceError(f"{where}: no pose found; check layout and camera file")
    order = [best, 1 - best]
    if not _distinct(found.poses[order], found.normal[best] / spread**2):  # perhaps both starts were on one side
        again = descend(problem, Poses.of([mirrored(found.poses[best], middle)]), whiten, HUBER * spread)
        found = _joined(found, best, again)
        order = np.argsort(found.cost)
        if not _distinct(found.poses[order], found.normal[order[0]] / spread**2):
            order = order[:1]
    order = [i for i in order if np.isfinite(found.cost[i])]
    return _rows(found, order), OUTLIER * spread


def _rows(found: Minima, rows) -> Minima:
    return Minima(*(getattr(found, name)[rows] for name in Minima.__slots__))


def _joined(found: Minima, row: int, other: Minima) -> Minima:
    poses = Poses.of([found.poses[row], *other.poses])
    rest = [np.concatenate([getattr(found, name)[[row]], getattr(other, name)]) for name in Minima.__slots__[1:]]
    return Minima(poses, *rest)


def _distinct(poses: Poses, normal: np.ndarray) -> bool:
    """Whether the second of two poses is another than the first, which has this normal matrix."""
    way = poses[[1]].difference(poses[[0]])[0]
    return bool(way @ normal @ way > SAME**2)


def _answer(problem: PlanarProblem, found: Minima, rows: np.ndarray, outliers: tuple[int, ...]) -> ObjPose:
    """Decide between the minima, and collect."""
    huber = np.minimum(1.0, HUBER / np.maximum(found.length, HUBER))
    # Both minima weigh the corners alike, as the stricter of the two does, or an outlier of one of them could decide.
    common = huber.min(0)
    best = weigh(problem, found.poses[[0]], common if len(huber) == 1 else huber[0])
    delta, twin = np.inf, None
    if len(huber) == 2:
        pair = [weigh(problem, found.poses[[i]], common) for i in range(2)]
        delta, twin = pair[1].chi2 - pair[0].chi2, pair[1].pose[0]
        if delta < 0:
            best, delta, twin = weigh(problem, found.poses[[1]], huber[1]), -delta, pair[0].pose[0]
            huber = huber[::-1]
    return _collected(problem, best, huber[0], rows, outliers, float(delta), twin)


def _collected(
    problem: PlanarProblem, best: Weighed, weights: np.ndarray, rows, outliers, delta: float, twin: Rigid | None
) -> ObjPose:
    pose = best.pose[0]
    middle = pose @ np.append(problem.xy.mean(0), 0.0)
    foreshortening = float(pose.rotation[:, 2] @ middle / np.linalg.norm(middle))
    residuals = problem.in_px(best.residual)
    off = problem.in_px(problem.seen - problem.seen.mean(0))
    spread = float(np.ptp(off @ np.linalg.svd(off, full_matrices=False)[2][1]))
    dof = 2 * len(problem.xy) - 6
    own = (best.covariance, rows, outliers, residuals, weights, best.chi2, dof, delta, foreshortening, spread, twin)
    return ObjPose(pose, *own)


def covering_both(pose: ObjPose) -> ObjPose:
    """The pose with a covariance that covers its twin too, by the odds of both."""
    if pose.twin is None:
        return pose
    away = Poses.of([pose.twin]).difference(Poses.of([pose.camera_from_obj]))[0]
    odds = np.exp(-pose.delta_chi2 / 2)
    return replace(pose, covariance=pose.covariance + odds / (1 + odds) * np.outer(away, away))
