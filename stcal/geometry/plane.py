"""Planes, circles on them and their images, homographies, and the two poses from which a camera may see a plane
(Collins & Bartoli 2014). The centre of an ellipse is not the image of the circle's centre."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np

from stcal.errors import ConvergenceError, DegenerateError
from stcal.geometry.least_squares import Minima, NormalEquations, minimise
from stcal.geometry.rigid import Poses, Rigid, best_rotations, by_pose, perspective, skew
from stcal.geometry.robust import HUBER, huber_weights, robust_sigma


def circle_image_offset(xyz_camera: np.ndarray, normal_camera: np.ndarray, radius_mm: np.ndarray) -> np.ndarray:
    """Return points (..., 3) whose ordinary projection is the centre of the ellipse that each circle projects to.
    With centre C, unit normal n and radius r it is that of ``C + (r²/C_z)(n_z·n − e_z)``, e_z the optical axis (from
    the dual conic M·diag(r², r², −1)·Mᵀ, M = [e₁ e₂ C]; Hartley & Zisserman, sec. 2.2 and 8.3). All in the camera
    frame and one unit; normals (..., 3) of either sign."""
    c, n = np.asarray(xyz_camera, float), np.asarray(normal_camera, float)
    shift = n[..., 2:] * n - np.array([0.0, 0.0, 1.0])
    return c + (np.asarray(radius_mm, float) ** 2 / c[..., 2])[..., None] * shift


def circle_images(xyz_camera: np.ndarray, axes_camera: np.ndarray, radius_mm: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the image ellipses of n circles of one plane, by the dual conic of :func:`circle_image_offset`. Centres
    (n, 3), radii (n,), and two orthonormal directions in the plane, (3, 2), give centres (n, 2) and symmetric shapes
    (n, 2, 2), normalised: the rim is ``centre + shape @ unit circle``."""
    dual = radius_mm[:, None, None] ** 2 * (axes_camera @ axes_camera.T) - xyz_camera[:, :, None] * xyz_camera[:, None]
    dual = -dual / dual[:, 2:, 2:]
    centre = -dual[:, :2, 2]
    return centre, shape_of_square(dual[:, :2, :2] + centre[:, :, None] * centre[:, None])


def shape_of_square(square: np.ndarray) -> np.ndarray:
    """Return the symmetric shapes S of ellipses, (..., 2, 2), from S·Sᵀ; negative eigenvalues count as zero."""
    value, vector = np.linalg.eigh(square)
    return (vector * np.sqrt(np.maximum(value, 0))[..., None, :]) @ np.swapaxes(vector, -1, -2)


class Plane(NamedTuple):
    """The plane ``normal · xyz = offset``, or one for each of a stack of sets of points."""

    normal: np.ndarray  # (..., 3) of unit length
    offset: np.ndarray  # (...,)
    rms: np.ndarray  # (...,) spread of the fitted points


def fit_plane(xyz: np.ndarray, towards: np.ndarray | None = None) -> Plane:
    """Return the total-least-squares plane of n ≥ 3 points (..., n, 3) off a line, its normal ``towards`` a side."""
    xyz = np.asarray(xyz, float)
    n = xyz.shape[-2]
    if n < 3:
        raise DegenerateError("E-POINTS-FEW", f"plane: {n} points, 3 needed")
    mean = xyz.mean(-2)
    _, s, vt = np.linalg.svd(xyz - mean[..., None, :], full_matrices=False)
    if (s[..., 1] <= 1e-9 * s[..., 0]).any():
        raise DegenerateError("E-POINTS-COLLINEAR", "plane: the points are collinear; points off the line are needed")
    normal = vt[..., 2, :]
    if towards is not None:
        normal = np.where((normal @ towards < 0)[..., None], -normal, normal)
    return Plane(normal, (normal * mean).sum(-1), s[..., 2] / np.sqrt(n))


def singular_values(m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the largest and smallest singular values, (...,), of 2×2 matrices (..., 2, 2), in closed form."""
    half_trace = (m**2).sum((-1, -2)) / 2
    det = np.abs(m[..., 0, 0] * m[..., 1, 1] - m[..., 0, 1] * m[..., 1, 0])
    root = np.sqrt(np.maximum(half_trace**2 - det**2, 0))
    return np.sqrt(half_trace + root), np.sqrt(np.maximum(half_trace - root, 0))


def fit_homography(xy_b: np.ndarray, xy_a: np.ndarray) -> np.ndarray:
    """Return the 3×3 homography a_from_b of n ≥ 4 pairs (n, 2): normalised DLT (Hartley & Zisserman, alg. 4.2)."""
    b, a = np.asarray(xy_b, float), np.asarray(xy_a, float)
    if len(b) < 4:
        raise DegenerateError("E-POINTS-FEW", f"homography: {len(b)} point pairs, 4 needed")
    (homography,) = fit_homographies(b[None], a[None], np.ones((1, len(b)), bool))
    if not np.isfinite(homography).all():
        raise DegenerateError("E-POINTS-COLLINEAR", "homography: the points do not determine it (three on a line)")
    return homography


def fit_homographies(xy_b: np.ndarray, xy_a: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Return homographies (k, 3, 3) of k sets of pairs (k, n, 2) among ``used`` (k, n); NaN if undetermined."""
    count, on = used.sum(1), used[..., None]

    def normalised(p):
        mean = np.where(on, p, 0).sum(1) / count[:, None]
        away = p - mean[:, None]
        size = np.sqrt((away**2).sum(2))
        scale = np.sqrt(2) / np.maximum(np.where(used, size, 0).sum(1) / count, 1e-300)
        turn = np.zeros((len(p), 3, 3))
        turn[:, 0, 0] = turn[:, 1, 1] = scale
        turn[:, :2, 2], turn[:, 2, 2] = -scale[:, None] * mean, 1
        return turn, away * scale[:, None, None]

    (na, a), (nb, b) = normalised(xy_a), normalised(xy_b)
    rows = np.zeros((len(b), b.shape[1], 2, 9))
    rows[:, :, 0, 0:2] = rows[:, :, 1, 3:5] = b
    rows[:, :, 0, 2] = rows[:, :, 1, 5] = 1
    rows[..., 6:8], rows[..., 8] = -a[..., None] * b[:, :, None], -a
    rows = np.where(on[..., None], rows, 0).reshape(len(b), -1, 9)
    _, s, vt = np.linalg.svd(rows, full_matrices=rows.shape[1] < 9)
    normal = vt[:, 8].reshape(-1, 3, 3)
    # Three of four points on a line in both planes leave the homography undetermined; in one plane only, they force a
    # singular matrix.
    ok = (s[:, 7] >= 1e-9 * s[:, 0]) & (np.linalg.cond(normal) <= 1e9)
    h = np.full((len(b), 3, 3), np.nan)
    h[ok] = np.linalg.inv(na[ok]) @ normal[ok] @ nb[ok]
    first = np.take_along_axis(xy_b, used.argmax(1)[:, None, None], 1)[:, 0]
    side = np.sign((h[:, 2, :2] * first).sum(1) + h[:, 2, 2])
    return h / np.linalg.norm(h, axis=(1, 2), keepdims=True) * side[:, None, None]


def apply_homography(a_from_b: np.ndarray, xy_b: np.ndarray) -> np.ndarray:
    """Return points (..., 2) mapped by a homography, or (k, n, 2) mapped by k homographies (k, 3, 3)."""
    mapped = _mapped(a_from_b, xy_b)
    return mapped[..., :2] / mapped[..., 2:]


def _mapped(a_from_b: np.ndarray, xy_b: np.ndarray) -> np.ndarray:
    constant = a_from_b[:, 2] if a_from_b.ndim == 2 else a_from_b[:, None, :, 2]
    return np.asarray(xy_b, float) @ np.swapaxes(a_from_b[..., :2], -1, -2) + constant


def homography_jacobian(a_from_b: np.ndarray, xy_b: np.ndarray) -> np.ndarray:
    """Return the Jacobians (..., 2, 2) of :func:`apply_homography` at points (..., 2); also for k homographies."""
    mapped = _mapped(a_from_b, xy_b)
    w = mapped[..., 2, None, None]
    homography = a_from_b if a_from_b.ndim == 2 else a_from_b[:, None]
    return (homography[..., :2, :2] - mapped[..., :2, None] / w * homography[..., 2:, :2]) / w


def inside(polygon: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return which points (n, 2) lie in a polygon (k, 2), (n,) bool."""
    side = np.roll(polygon, -1, axis=0) - polygon
    above = polygon[:, 1] > points[:, 1:]
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing = polygon[:, 0] + (points[:, 1:] - polygon[:, 1]) * side[:, 0] / side[:, 1]
    return ((above != np.roll(above, -1, axis=1)) & (points[:, :1] < crossing)).sum(1) % 2 == 1


def camera_from_plane(normalised_from_plane: np.ndarray) -> Rigid:
    """Return the pose of a plane with a metric frame from its homography into normalised coordinates (Zhang 2000).
    The plane's origin has a positive depth where the homography has that sign."""
    h = np.asarray(normalised_from_plane, float)
    h = h / np.sqrt(np.linalg.norm(h[:, 0]) * np.linalg.norm(h[:, 1]))
    if h[2, 2] < 0:
        h = -h
    rotation, _ = best_rotations(np.column_stack([h[:, 0], h[:, 1], np.cross(h[:, 0], h[:, 1])]))
    return Rigid(rotation, h[:, 2])


MAX_STEPS = 100
EXACT = 1e-22
"""Largest predicted decrease at a pose's minimum, in squared normalised coordinates."""


def refine_planar_pose(camera_from_plane: Rigid, xy_plane: np.ndarray, xy_normalised: np.ndarray) -> Rigid:
    """Return camera_from_plane of least reprojection error, from a start before which the points lie. ``xy_plane`` :
    (n, 2) mm; ``xy_normalised`` : (n, 2) ideal coordinates."""
    xyz = np.column_stack([xy_plane, np.zeros(len(xy_plane))])

    def linearise(pose: Rigid) -> NormalEquations:
        rotated = xyz @ pose.rotation.T
        p = rotated + pose.translation
        if (p[:, 2] <= 0).any():
            return NormalEquations.impossible(6)
        xy, by_point = perspective(p)
        return NormalEquations.of((xy - xy_normalised).ravel(), by_pose(by_point, rotated).reshape(-1, 6))

    if ((camera_from_plane @ xyz)[:, 2] <= 0).any():
        raise DegenerateError("E-POINTS-BEHIND", "planar pose: points behind the camera")
    minimum = minimise(camera_from_plane, linearise, Rigid.moved, least_gain=EXACT, max_steps=MAX_STEPS)
    return minimum.required("planar pose", "check that the points are numbered rightly").state


OUTLIER = 6.0
"""Length of an outlier, in the larger of stated and robust σ; chance exceeds it in one of 6·10⁷ (Rayleigh)."""
MAX_OUTLIER_SHARE = 1 / 3
"""Largest share of outliers among the observed points; beyond it the inliers are no trustworthy majority."""
SAME = 1.0  # distance, in σ, below which two minima count as one: the covariance covers both
WIDER = 1.1
"""Increase of the residuals' robust σ beyond which the descent is repeated with a new limit of Huber's loss."""
MAX_SIGMA_RAD = 0.5  # largest σ of a usable rotation; beyond it linear error propagation is meaningless
Descend = Callable[[Poses, float], Minima]
"""Function that descends from h poses, with the limit of Huber's loss in σ, to the h minima next to them."""


def mirrored(poses: Poses, target_from_plane: Rigid) -> Poses:
    """Return h poses camera_from_target with the depths about the plane's origin mirrored along the line of sight."""
    middle = poses.rotation @ target_from_plane.translation + poses.translation
    sight = middle / np.linalg.norm(middle, axis=1, keepdims=True)
    mirror = np.eye(3) - 2 * sight[:, :, None] * sight[:, None, :]
    axis = target_from_plane.rotation[:, 2]
    rotation = mirror @ poses.rotation @ (np.eye(3) - 2 * np.outer(axis, axis))
    return Poses(rotation, middle - rotation @ target_from_plane.translation)


def distinct(poses: Poses, normal: np.ndarray, robust_sigma: float = 1.0) -> bool:
    """Return True if the second of two poses differs significantly from the first, of the normal matrix (6, 6).
    ``robust_sigma`` : of the residuals, in stated σ: where these are too small, so is σ of the pose."""
    step = poses[1].difference(poses[0])
    return bool(step @ normal @ step > (SAME * robust_sigma) ** 2)


def two_minima(
    descend_near: Callable[[Poses], Descend], start: Poses, target_from_plane: Rigid, failure: str, planar: bool = True
) -> tuple[Minima, float]:
    """Return one or two distinct minima of the residuals of single points, the better one first, and the length, in
    stated σ, beyond which a residual is an outlier. ``descend_near`` : whitens residuals near one pose, and returns the
    descent; ``start`` : one pose, to which its mirror image is added, or two; ``target_from_plane`` : origin in the
    middle of the points, Z along the normal; ``planar`` : whether all points are in the plane, so that the mirror image
    of a lone minimum is tried."""
    poses = start + mirrored(start, target_from_plane) if len(start) == 1 else start
    sigma = 1.0
    for _ in range(2):  # the second time with the residuals' robust σ, if that is larger
        descend = descend_near(poses[[0]])
        minima = descend(poses, HUBER * sigma).ordered()
        poses = minima.poses
        wider = robust_sigma(minima.length[0], 2)
        if wider <= WIDER * sigma:
            break
        sigma = wider
    if not np.isfinite(minima.cost[0]) or not minima.settled[0]:
        raise ConvergenceError("E-NO-MINIMUM", failure)
    is_double = distinct(minima.poses, minima.normal[0], sigma)
    if planar and not is_double:
        best = minima.poses[[0]]
        minima = descend(best + mirrored(best, target_from_plane), HUBER * sigma).ordered()
        is_double = distinct(minima.poses, minima.normal[0], sigma)
    return minima if is_double and np.isfinite(minima.cost[1]) else minima.rows([0]), OUTLIER * sigma


weights_of = partial(huber_weights, limit=HUBER)
"""Return Huber's weights of points, same shape, from the lengths of their residuals in σ."""


def deciding_delta(flip_odds: float, sigma_margin: float, variance_factor: float) -> float:
    """Return the Δχ² of the second solution that decides for the first: −2 ln of its largest odds, times a variance
    factor: the square of ``sigma_margin``, by which all σ may be too small, or χ² over redundancy if that is larger."""
    return -2 * float(np.log(flip_odds)) * max(sigma_margin**2, variance_factor)


def covariance_of_both(covariance: np.ndarray, away: np.ndarray, delta_chi2: float) -> np.ndarray:
    """Return the second moment (6, 6) about a pose if a second pose, ``away`` (6,) from it, may be the true one."""
    odds = np.exp(-delta_chi2 / 2)
    return covariance + odds / (1 + odds) * np.outer(away, away)


@dataclass(frozen=True, slots=True, eq=False)
class Weighed:
    """h poses after one step of generalised least squares."""

    poses: Poses
    residual: np.ndarray  # (h, n, 2) to first order
    normal: np.ndarray  # (h, 6, 6)
    chi2: np.ndarray  # (h,)


def generalised_equations(residual: np.ndarray, by_pose: np.ndarray, covariance: np.ndarray) -> NormalEquations:
    """Return the normal equations of h poses; arguments as of :func:`weigh`."""
    h = len(residual)
    r, a = residual.reshape(h, -1, 1), by_pose.reshape(h, -1, 6)
    solved = np.linalg.solve(covariance, np.concatenate([a, r], axis=2))
    weighted, cost = np.swapaxes(a, 1, 2) @ solved, np.swapaxes(r, 1, 2) @ solved[..., 6:]
    return NormalEquations(cost[:, 0, 0], weighted[..., :6], -weighted[..., 6])


def weigh(residual: np.ndarray, by_pose: np.ndarray, covariance: np.ndarray, poses: Poses) -> Weighed:
    """Return the step of h poses that weights the points by the full covariance (h, 2n, 2n) of their residuals (h, n,
    2); ``by_pose`` : (h, n, 2, 6) negative derivatives by left perturbations."""
    equations = generalised_equations(residual, by_pose, covariance)
    step = -np.linalg.solve(equations.normal, equations.gradient[..., None])
    remaining = residual - (by_pose.reshape(len(step), -1, 6) @ step).reshape(residual.shape)
    chi2 = equations.cost + (step[..., 0] * equations.gradient).sum(1)
    return Weighed(poses.moved(step[..., 0]), remaining, equations.normal, chi2)


@dataclass(frozen=True, slots=True, eq=False)
class PlanePoses:
    """Both poses camera_from_plane that agree with a homography about a point to first order."""

    poses: tuple[Rigid, Rigid]
    determinant: float  # of the homography's derivative there
    foreshortening: float  # cosine between the plane's normal and the line of sight


def poses_of_plane(xy_plane: np.ndarray, xy_normalised: np.ndarray) -> PlanePoses:
    """Return both poses from n ≥ 4 points (n, 2) of a plane and their ideal normalised coordinates (n, 2). The
    homography's derivative is taken at their mean. Z of the plane points away from the camera. DegenerateError: the
    points determine no homography, or the plane is seen edge-on or from behind."""
    xy, xy_image = np.asarray(xy_plane, float), np.asarray(xy_normalised, float)
    middle = xy.mean(0)
    homography = fit_homography(xy - middle, xy_image)
    jacobian = homography_jacobian(homography, np.zeros((1, 2)))[0]
    determinant = float(np.linalg.det(jacobian))
    if determinant <= 0:
        mirrored = "plane: its points appear mirrored: they are seen from behind, or numbered wrongly"
        raise DegenerateError("E-POINTS-MIRRORED", mirrored)
    sight_point = homography[:2, 2] / homography[2, 2]
    x, y, z = np.append(sight_point, 1.0) / np.hypot(1.0, np.linalg.norm(sight_point))
    cross = skew(np.array([-y, x, 0.0]))
    camera_from_sight = np.eye(3) + cross + cross @ cross / (1 + z)  # the smallest turn of Z to the line of sight
    # Derivative of the projection onto a screen perpendicular to the line of sight, at unit distance.
    flat = np.linalg.solve(np.column_stack([np.eye(2), -sight_point]) @ camera_from_sight[:, :2], jacobian)
    large, small = np.linalg.svd(flat, compute_uv=False)
    upper = flat / large
    remainder = np.eye(2) - upper.T @ upper
    low = np.sqrt(np.maximum(np.diag(remainder), 0)) * [1.0, -1.0 if remainder[0, 1] < 0 else 1.0]
    poses = []
    for sign in (1.0, -1.0):
        first, second = np.append(upper[:, 0], sign * low[0]), np.append(upper[:, 1], sign * low[1])
        turn = np.column_stack([first, second, np.cross(first, second)])
        poses.append(_placed(best_rotations(camera_from_sight @ turn)[0], xy, xy_image))
    return PlanePoses((poses[0], poses[1]), determinant, float(small / large))


def _placed(rotation: np.ndarray, xy: np.ndarray, seen: np.ndarray) -> Rigid:
    """Return the pose with this rotation and the translation that fits the points best (linear least squares)."""
    turned = xy @ rotation[:, :2].T
    rows = np.zeros((len(xy), 2, 3))
    rows[:, 0, 0] = rows[:, 1, 1] = 1
    rows[:, :, 2] = -seen
    right = seen * turned[:, 2:] - turned[:, :2]
    return Rigid(rotation, np.linalg.lstsq(rows.reshape(-1, 3), right.ravel())[0])
