"""camera_from_target of one image of a calibrated target, with both poses where a plane leaves two.

A face seen alone is a plane, and a plane seen from afar looks the same tilted to either side of the line of sight
(Oberkampf et al. 1996; Schweighofer & Pinz 2006): the reprojection error has two minima. Both are found, and one is
certain only where the circles speak clearly for it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.stats import chi2 as chi_square

from stcal.errors import DegenerateError, InputError
from stcal.geometry.arrays import frozen
from stcal.geometry.camera import Camera
from stcal.geometry.pose_descent import Minima, PoseStack, block_diagonal
from stcal.geometry.rigid import Rigid
from stcal.io.camera import CameraPrior, intrinsic_basis
from stcal.labels import CircleLabel, parse_labels
from stcal.sfm.data.model import Outlier
from stcal.sfm.data.projection import CircleImages
from stcal.sfm.measure.likelihood import spread
from stcal.sfm.measure.minima import HUBER, MIN_CIRCLES, distinct, minima_without_outliers, start_pose
from stcal.sfm.measure.problem import HOPELESS, PoseProblem, covariance_of_centres, rigid_of
from stcal.sfm.measure.target import TargetCircles

MAX_SIGMA_RAD = 0.5
"""A rotation whose σ is larger is none: linear propagation says nothing any more."""

Status = Literal["certain", "resolved", "ambiguous"]


@dataclass(frozen=True, slots=True)
class PoseOptions:
    """How to measure.

    ``flip_odds`` : at most these odds of the other pose for one to be certain, for Gaussian errors; ``sigma_margin`` :
    by which σ may be too small without that becoming untrue; ``sigma_factor`` : factor on the centres' own σ, that of
    the target's run where None.
    """

    flip_odds: float = 1e-6
    sigma_margin: float = 1.5
    sigma_factor: float | None = None

    def __post_init__(self):
        factor = 1.0 if self.sigma_factor is None else self.sigma_factor
        if not (0 < self.flip_odds < 1 and self.sigma_margin >= 1 and np.isfinite(factor) and factor > 0):
            raise InputError(
                f"flip odds {self.flip_odds:g}, σ margin {self.sigma_margin:g}, σ factor {factor:g}: odds between "
                "0 and 1, a margin of at least 1 and a positive factor needed"
            )

    def needed(self, chi2_per_dof: float) -> float:
        """Δχ² that makes a pose certain: −2 ln of the odds, times the variance factor that is to be allowed for."""
        return -2 * float(np.log(self.flip_odds)) * max(self.sigma_margin**2, chi2_per_dof)


@dataclass(frozen=True, slots=True, eq=False)
class TargetPose:
    """The pose of the target in one image.

    ``camera_from_target`` ; ``covariance`` : (6, 6), rad and mm, left perturbation in the camera frame, R' = exp(w) R,
    t' = t + dt; ``parts`` : what it is the sum of, (6, 6) each: ``image``, ``target`` and ``intrinsics``, of which the
    last two are common to all images of the same target and camera, and ``curvature``, by which the spread of all poses
    by their likelihood differs from these, zero where that is Gaussian; ``by_circles`` : (6, 3n), and ``by_intrinsics``
    : (6, q) derivatives, but for the sign, by errors of the circles (target frame, mm) and intrinsics; ``status`` : see
    ``delta_chi2``; ``faces`` and ``labels`` used; ``residuals_px`` : (n, 2) measured minus projected ellipse centres;
    ``weights`` : (n,) Huber's;
    ``outliers`` left out; ``chi2``, ``dof`` : of all residuals against their covariance; ``delta_chi2`` : by which the
    other minimum is worse, or, where both are one wide valley, the other side of it (infinite where there is neither);
    ``needed_chi2`` : the least of it for the pose to be certain; ``alternative`` : the other minimum where that is not
    reached.
    """

    camera_from_target: Rigid
    covariance: np.ndarray
    parts: dict[str, np.ndarray]
    by_circles: np.ndarray
    by_intrinsics: np.ndarray
    status: Status
    faces: tuple[str, ...]
    labels: tuple[CircleLabel, ...]
    residuals_px: np.ndarray
    weights: np.ndarray
    outliers: tuple[Outlier, ...]
    chi2: float
    dof: int
    delta_chi2: float
    needed_chi2: float
    alternative: "TargetPose | None" = None

    def __post_init__(self):
        n = len(self.labels)
        object.__setattr__(self, "covariance", frozen(self.covariance, (6, 6), "pose covariance"))
        object.__setattr__(self, "by_circles", frozen(self.by_circles, (6, 3 * n), "pose by circles"))
        object.__setattr__(self, "by_intrinsics", frozen(self.by_intrinsics, (6, None), "pose by intrinsics"))
        object.__setattr__(self, "residuals_px", frozen(self.residuals_px, (n, 2), "residuals"))
        object.__setattr__(self, "weights", frozen(self.weights, (n,), "weights"))

    def swapped(self) -> "TargetPose":
        """The alternative in its place, as ``resolved``."""
        own = replace(self, alternative=None)
        return replace(self.alternative, status="resolved", alternative=own)

    def rms_px(self) -> float:
        """Of the residuals, per coordinate."""
        return float(np.sqrt((self.residuals_px**2).mean()))

    def chi2_per_dof(self) -> float:
        """About 1 where the σ of centres, target and intrinsics are true."""
        return self.chi2 / self.dof

    def p_value(self) -> float:
        """Probability of residuals as large, with those σ."""
        return float(chi_square.sf(self.chi2, self.dof))


def pose_from_circles(
    labels: Sequence[str],
    centre_px: np.ndarray,
    covariance_px2: np.ndarray,
    target: TargetCircles,
    camera: Camera,
    options: PoseOptions | None = None,
    prior: CameraPrior | None = None,
    where: str = "image",
) -> TargetPose:
    """Pose of a calibrated target from the ellipse centres of its circles in one image.

    The first step minimises the residuals of the single centres with Huber's loss, from the homography of the face with
    the most circles and from its twin, mirrored at the line of sight. The second weighs them by their whole covariance
    (generalised least squares), to which the image's noise, the target's and the intrinsics' uncertainty add up, so
    that the covariance of the pose contains all three. Dots of the board are passed over.

    Parameters
    ----------
    labels : n labels ``face:circle``, or texts of that form; dots of the board are passed over
    centre_px : (n, 2) ellipse centres in the image as it is, px
    covariance_px2 : (n, 2, 2) their own, without the σ factor
    prior : covariance of the intrinsics, which are exact where None
    where : name of the image, for messages

    Raises
    ------
    InputError
        A circle that the target does not have, a label twice, or arrays of a wrong shape.
    DegenerateError
        No face has four circles in general position, or too many circles contradict the others.
    ConvergenceError
        No minimum is reached.
    """
    options = options or PoseOptions()
    labels = parse_labels(labels)
    used, problem = _problem(labels, centre_px, covariance_px2, target, camera, options, prior, where)
    names = [labels[i] for i in used]
    start, plane = start_pose(names, problem, target, where)
    found, keep, outliers = minima_without_outliers(problem, start, plane, names, where)
    problem, names = problem.select(keep), [names[i] for i in keep]
    dof = 2 * len(names) - 6
    if dof <= 0:
        raise DegenerateError(f"{where}: {len(names)} circles left, {MIN_CIRCLES} needed; show more of a face")
    pose = _answer(problem, found, names, plane, dof, options)
    if np.sqrt(np.diag(pose.covariance)[:3].max()) > MAX_SIGMA_RAD:
        raise DegenerateError(f"{where}: its circles leave the rotation open; show more of a face, off one line")
    return replace(
        pose, outliers=outliers, alternative=pose.alternative and replace(pose.alternative, outliers=outliers)
    )


def _problem(labels, centre_px, covariance_px2, target: TargetCircles, camera, options, prior, where):
    """Indices of the target's circles among the labels, and the problem that they make."""
    n = len(labels)
    centre, noise = frozen(centre_px, (n, 2), "centres"), frozen(covariance_px2, (n, 2, 2), "centres' covariance")
    used = [i for i, label in enumerate(labels) if isinstance(label, CircleLabel)]
    used.sort(key=lambda i: target.place.get(labels[i], -1))
    if len({labels[i] for i in used}) < len(used):
        raise InputError(f"{where}: a label twice; every circle is seen once")
    unknown = [labels[i] for i in used if labels[i] not in target.place]
    if unknown:
        raise InputError(f"{where}: circle {unknown[0]} is not in the calibrated target; give the target's own labels")
    if not ((noise[:, 0, 0] > 0) & (np.linalg.det(noise) > 0)).all():
        raise InputError(f"{where}: a covariance of a centre is not positive definite; correct it")
    place = np.array([target.place[labels[i]] for i in used], int)
    rows = (3 * place[:, None] + np.arange(3)).ravel()
    factor = target.sigma_factor if options.sigma_factor is None else options.sigma_factor
    ideal = camera.normalised_from_pixel(centre[used])
    slope = camera.distort_jacobian(ideal)[1] * camera.focal[:, None]
    back = np.linalg.inv(slope)
    by_camera, known = np.zeros((len(used), 2, 0)), np.zeros((0, 0))
    if prior is not None:
        by_camera = back @ (camera.parameter_jacobian(ideal) @ intrinsic_basis(prior.colmap_model))
        known = prior.covariance
    own = target.xyz[place], target.normal[place], target.radius[place], ideal, slope
    spread = factor**2 * back @ noise[used] @ np.swapaxes(back, 1, 2)
    return used, PoseProblem(*own, spread, by_camera, known, target.covariance[np.ix_(rows, rows)])


@dataclass(frozen=True, slots=True, eq=False)
class _Weighed:
    """One step of generalised least squares from h poses: the poses after it, ``residual`` (h, n, 2) that it leaves to
    first order, ``normal`` (h, 6, 6), ``chi2`` (h,)."""

    poses: PoseStack
    residual: np.ndarray
    normal: np.ndarray
    chi2: np.ndarray


def _weigh(residual: np.ndarray, by_pose: np.ndarray, full: np.ndarray, poses: PoseStack) -> _Weighed:
    """The step with residuals (h, n, 2), their derivative (h, n, 2, 6) and their covariance (h, 2n, 2n)."""
    h = len(residual)
    r, a = residual.reshape(h, -1, 1), by_pose.reshape(h, -1, 6)
    solved = np.linalg.solve(full, np.concatenate([a, r], axis=2))
    back = np.swapaxes(a, 1, 2) @ solved
    normal, right = back[..., :6], back[..., 6:]
    step = np.linalg.solve(normal, right)[..., 0]
    square = (np.swapaxes(r, 1, 2) @ solved[..., 6:])[:, 0, 0]
    left = residual - (a @ step[..., None]).reshape(residual.shape)
    return _Weighed(poses.moved(step), left, normal, square - (step * right[..., 0]).sum(1))


def _gain(image: CircleImages, full: np.ndarray) -> np.ndarray:
    """(6, 2n) derivative of the weighted pose by the centres."""
    a = image.by_pose.reshape(-1, 6)
    gain = np.linalg.solve(full, a)
    return np.linalg.solve(a.T @ gain, gain.T)


def _answer(
    problem: PoseProblem, found: Minima, names: list[CircleLabel], plane: Rigid, dof: int, options: PoseOptions
) -> TargetPose:
    """Decide between the minima, or what there is of a second one, and collect."""
    delta, rival = _rivalry(problem, found, dof)
    alone = rival is None and len({name.face for name in names}) == 1
    pose = _weighed(problem, found, 0, rival, names, dof, plane if alone else None, options)
    needed = options.needed(pose.chi2_per_dof())
    pose = replace(pose, delta_chi2=min(delta, pose.delta_chi2), needed_chi2=needed)
    if pose.delta_chi2 > needed:
        return replace(pose, status="certain")
    if rival is None:
        return pose
    other = _weighed(problem, found, 1, found.poses[[0]], names, dof, None, options)
    return replace(pose, alternative=replace(other, delta_chi2=-delta, needed_chi2=needed))


def _rivalry(problem: PoseProblem, found: Minima, dof: int) -> tuple[float, PoseStack | None]:
    """By how much χ² the second minimum is worse than the first, and its pose; infinite where there is none.

    Both weigh the circles alike, as the stricter of the two does, or an outlier of one of them could decide.
    """
    if len(found.cost) == 1:
        return np.inf, None
    behind = float(found.cost[1] - found.cost[0])
    if behind > HOPELESS * max(1.0, found.cost[0] / dof):  # whatever the weights
        return behind, found.poses[[1]]
    residual, image = problem.seen(found.poses)
    common = np.tile(problem.noise / _huber(found.length).min(0)[:, None, None], (2, 1, 1, 1))
    rivals = _weigh(residual, image.by_pose, covariance_of_centres(problem, image, common), found.poses)
    if not distinct(rivals.poses, rivals.normal[0]):
        return np.inf, None
    return float(rivals.chi2[1] - rivals.chi2[0]), rivals.poses[[1]]


def _huber(length: np.ndarray) -> np.ndarray:
    return np.minimum(1.0, HUBER / np.maximum(length, HUBER))


def _weighed(
    problem: PoseProblem,
    found: Minima,
    row: int,
    other: PoseStack | None,
    names: list[CircleLabel],
    dof: int,
    plane: Rigid | None,
    options: PoseOptions,
) -> TargetPose:
    """One minimum by the whole covariance of its centres, undecided; ``other``, ``plane`` : see
    :func:`stcal.sfm.measure.likelihood.spread`. Two steps: what the first leaves is of second order."""
    weights = _huber(found.length[row])
    noise = problem.noise / weights[:, None, None]
    start = found.poses[[row]]
    residual, image = problem.seen(start)
    full = covariance_of_centres(problem, image, noise[None])
    poses = _weigh(residual, image.by_pose, full, start).poses
    residual, image = problem.seen(poses)
    last = _weigh(residual, image.by_pose, full, poses)
    gain = _gain(image, full[0])
    by_circles = gain @ block_diagonal(image.by_circle)[0]
    by_intrinsics = gain @ problem.by_camera.reshape(len(full[0]), -1)
    parts = {
        "image": gain @ block_diagonal(noise[None])[0] @ gain.T,
        "target": by_circles @ problem.shape @ by_circles.T,
        "intrinsics": by_intrinsics @ problem.prior @ by_intrinsics.T,
    }
    gaussian = sum(parts.values())
    chi2 = float(last.chi2[0])
    # The samples span a valley from side to side: the margin for wrong σ is for what they do not show.
    plausible = options.needed(chi2 / dof) / options.sigma_margin**2
    covariance, other_side = spread(problem, last.poses, full[0], chi2, gaussian, other, plane, plausible)
    parts["curvature"] = covariance - gaussian
    return TargetPose(
        rigid_of(last.poses, 0),
        (covariance + covariance.T) / 2,
        parts,
        by_circles,
        by_intrinsics,
        "ambiguous",
        tuple(dict.fromkeys(name.face for name in names)),
        tuple(names),
        problem.in_px(last.residual[0]),
        weights,
        (),
        chi2,
        dof,
        other_side,
        0.0,
    )
