"""Pose of the target in one image, its covariance, and the errors that all poses have in common."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from stcal.errors import DegenerateError, DetectionError, InputError, StcalError
from stcal.geometry.arrays import frozen
from stcal.geometry.camera import Camera
from stcal.geometry.least_squares import Minima, PoseStack, block_diagonal
from stcal.geometry.plane import (
    MAX_SIGMA_RAD,
    OUTLIER,
    deciding_delta,
    distinct,
    mirrored,
    step_between,
    weigh,
    weights_of,
)
from stcal.geometry.rigid import Rigid
from stcal.geometry.uncertain import ImageFit
from stcal.io.cameras.model import CameraPrior, intrinsic_basis
from stcal.io.covariance import OF_PIXEL, first_fault
from stcal.labels import CircleLabel, circle_labels, parse_labels
from stcal.sfm.data.model import ImageObservations, Outlier
from stcal.sfm.data.patterns import CircleImages
from stcal.sfm.measurement.minima import (
    HOPELESS,
    MIN_CIRCLES,
    PoseProblem,
    covariance_of_centres,
    minima_without_outliers,
    start_pose,
)
from stcal.sfm.measurement.target import TargetCircles

CURVED = 0.2
"""χ² two σ away that differs from its parabola by more than this share: the covariance is then taken from samples."""
SAMPLES = 1000
SAMPLED_WIDER = 1.5
"""Samples are drawn with σ so much larger, or their tails would rest on a few of them."""
SAMPLE_ROUNDS = 2
MIN_EFFECTIVE = 20
"""Effective number of samples (Kong 1992) below which they say less than what they were drawn from."""
OTHER_SIDE = 3.0
"""A pose mirrored at the line of sight is another one from this distance on, in σ; nearer, the covariance covers it."""


def covariance_of_likelihood(
    problem: PoseProblem,
    pose: PoseStack,
    full: np.ndarray,
    least: float,
    covariance: np.ndarray,
    second: PoseStack | None,
    plane: Rigid | None,
    plausible: float,
) -> tuple[np.ndarray, float]:
    """Covariance of a pose (6, 6), and by how much χ² its mirror image is worse, infinite where that is no matter.

    The covariance is the given one where the likelihood is Gaussian. Else it is the second moment about the pose of all
    poses by their likelihood: importance sampling with fixed numbers (Bishop 2006, Pattern Recognition and Machine
    Learning, sec. 11.1.4); poses nearer to the ``second`` solution are that one's.

    Parameters
    ----------
    full : (2n, 2n) covariance of the centres
    least : χ² of the pose
    covariance : (6, 6) of the linearised problem
    second : the second solution, or None
    plane : target_from_plane of a face seen alone and without a second minimum, else None. The two may have grown
        together: a valley of which the linearised problem sees one side. The mirror image matters where it is
        ``plausible``, some σ off, and far more probable than these say.
    plausible : what χ² of the mirror image may be worse by
    """
    whiten = np.linalg.inv(np.linalg.cholesky(full))

    def excess(step: np.ndarray) -> np.ndarray:
        near = PoseStack(np.repeat(pose.rotation, len(step), 0), np.repeat(pose.translation, len(step), 0)).moved(step)
        residual, image = problem.seen(near)
        square = ((residual.reshape(len(step), -1) @ whiten.T) ** 2).sum(1)
        return np.where((image.depth > 0).all(1), square, np.inf)

    axes = _principal(covariance)
    curved = np.abs((excess(2 * np.vstack([axes, -axes])) - least) / 4 - 1).max() >= CURVED
    other_side, first = np.inf, covariance
    if plane is not None:
        image_pose = mirrored(pose, plane)
        away = step_between(pose, image_pose)
        square = float(away @ np.linalg.solve(covariance, away))
        worse = _best_of_tilt(problem, image_pose, plane, whiten) - least
        if worse < min(plausible, square / 2) and square > OTHER_SIDE**2:
            other_side, first, curved = float(worse), covariance + np.outer(away, away) / 4, True
    return (_sampled(excess, least, pose, first, second) if curved else covariance), other_side


def _best_of_tilt(problem: PoseProblem, pose: PoseStack, plane: Rigid, whiten: np.ndarray) -> float:
    """χ² of a pose when everything but the tilt of the plane may follow, to first order."""
    residual, image = problem.seen(pose)
    free = np.zeros((6, 4))
    free[:3, 0] = pose.rotation[0] @ plane.rotation[:, 2]
    free[3:, 1:] = np.eye(3)
    a, r = whiten @ image.by_pose.reshape(-1, 6) @ free, whiten @ residual.ravel()
    rest = r - a @ np.linalg.lstsq(a, r)[0]
    return float(rest @ rest)


def _sampled(excess, least: float, pose: PoseStack, covariance: np.ndarray, second: PoseStack | None) -> np.ndarray:
    """Second moment (6, 6) of exp(−(excess − least)/2) about the pose; ``covariance`` : about what it will be."""
    normal = np.random.default_rng(0).standard_normal((SAMPLES, 6))
    precision = np.linalg.inv(covariance)
    for _ in range(SAMPLE_ROUNDS):
        step = SAMPLED_WIDER * normal @ _principal(covariance)
        log = (normal**2).sum(1) / 2 - (excess(step) - least) / 2
        if second is not None:
            away = step_between(pose, second)
            log[(step - away / 2) @ precision @ away > 0] = -np.inf
        weight = np.exp(log - log.max())
        weight /= weight.sum()
        if 1 / (weight**2).sum() < MIN_EFFECTIVE:
            break
        covariance = np.einsum("k,ki,kj->ij", weight, step, step)
    return covariance


def _principal(covariance: np.ndarray) -> np.ndarray:
    """Rows whose summed outer products are the covariance: principal axes in units of σ."""
    sigma = np.sqrt(np.diag(covariance))
    value, vector = np.linalg.eigh(covariance / sigma / sigma[:, None])
    return (vector * np.sqrt(np.maximum(value, 0))).T * sigma


NEAR_PREVIOUS = 1 / 3
"""The pose nearer to the previous image's is taken where its turn from there is at most this share of the other's."""
NO_FACE = "no face of the target recognised; if a dot board is in view, give --board"
SUSPICIOUS, FAILED = 1e-3, 1e-5
"""Probabilities of a fit's χ², as the checks of a run have them."""
Status = Literal["certain", "resolved", "ambiguous"]


@dataclass(frozen=True, slots=True)
class PoseOptions:
    """How to measure.

    ``flip_odds`` : at most these odds of the second solution for a pose to be certain, for Gaussian errors;
    ``sigma_margin`` : by which σ may be too small without that becoming untrue; ``sigma_factor`` : factor on the
    centres' own σ, that of the target's run where None.
    """

    flip_odds: float = 1e-6
    sigma_margin: float = 1.5
    sigma_factor: float | None = None

    def __post_init__(self):
        factor = 1.0 if self.sigma_factor is None else self.sigma_factor
        if not (0 < self.flip_odds < 1 and self.sigma_margin >= 1 and np.isfinite(factor) and factor > 0):
            raise InputError(
                "E-OPTION-RANGE",
                f"flip odds {self.flip_odds:g}, σ margin {self.sigma_margin:g}, σ factor {factor:g}: odds between "
                "0 and 1, a margin of at least 1 and a positive factor needed",
            )

    def needed(self, chi2_per_dof: float) -> float:
        """Δχ² that makes a pose certain."""
        return deciding_delta(self.flip_odds, self.sigma_margin, chi2_per_dof)


@dataclass(frozen=True, slots=True, eq=False)
class TargetPose(ImageFit):
    """The pose of the target in one image.

    ``camera_from_target`` ; ``covariance`` : (6, 6), rad and mm, left perturbation in the camera frame, R' = exp(w) R,
    t' = t + dt; ``parts`` : what it is the sum of, (6, 6) each: ``image``, ``target`` and ``intrinsics``, of which the
    last two are common to all images of the same target and camera, and ``curvature``, by which the spread of all poses
    by their likelihood differs from these, zero where that is Gaussian; ``by_circles`` : (6, 3n), and ``by_intrinsics``
    : (6, q) derivatives, but for the sign, by errors of the circles (target frame, mm) and intrinsics; ``status`` : see
    ``delta_chi2``; ``faces`` and ``labels`` used; ``residuals_px`` : (n, 2) measured minus projected ellipse centres;
    ``weights`` : (n,) Huber's;
    ``outliers`` left out; ``chi2``, ``redundancy`` : of all residuals against their covariance; ``delta_chi2`` : by
    which the second solution is worse, or, where both are one wide valley, the other side of it (infinite where there
    is neither); ``needed_chi2`` : the least of it for the pose to be certain; ``second`` : the second solution, where
    that is not reached.
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
    redundancy: int
    delta_chi2: float
    needed_chi2: float
    second: "TargetPose | None" = None

    def __post_init__(self):
        n = len(self.labels)
        object.__setattr__(self, "covariance", frozen(self.covariance, (6, 6), "pose covariance"))
        object.__setattr__(self, "by_circles", frozen(self.by_circles, (6, 3 * n), "pose by circles"))
        object.__setattr__(self, "by_intrinsics", frozen(self.by_intrinsics, (6, None), "pose by intrinsics"))
        object.__setattr__(self, "residuals_px", frozen(self.residuals_px, (n, 2), "residuals"))
        object.__setattr__(self, "weights", frozen(self.weights, (n,), "weights"))

    def swapped(self) -> "TargetPose":
        """The second solution in its place, as ``resolved``; this one where there is none."""
        if self.second is None:
            return self
        return replace(self.second, status="resolved", second=replace(self, second=None))


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
    the most circles and from its mirror image at the line of sight. The second weighs them by their whole covariance
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
        No face has four circles in general position, or too many circles contradict each other.
    ConvergenceError
        No minimum is reached.
    """
    options = options or PoseOptions()
    labels = parse_labels(labels)
    used, problem = _problem(labels, centre_px, covariance_px2, target, camera, options, prior, where)
    names = list(circle_labels(labels[i] for i in used))
    start, plane = start_pose(names, problem, target, where)
    found, keep, outliers = minima_without_outliers(problem, start, plane, names, where)
    problem, names = problem.select(keep), [names[i] for i in keep]
    if len(names) < MIN_CIRCLES:
        raise DegenerateError(
            "E-MEASURE-FEW-CIRCLES", f"{where}: {len(names)} circles left, {MIN_CIRCLES} needed; show more of a face"
        )
    pose = _answer(problem, found, names, outliers, plane, options)
    if np.sqrt(np.diag(pose.covariance)[:3].max()) > MAX_SIGMA_RAD:
        if pose.chi2_per_redundancy() > OUTLIER**2:  # what leaves the rotation open are the residuals
            raise DegenerateError(
                "E-MEASURE-CONTRADICTS",
                f"{where}: its circles contradict each other, χ²/dof {pose.chi2_per_redundancy():.2g}; check their "
                "labels, and that camera file, faces.json and images belong together",
            )
        raise DegenerateError(
            "E-MEASURE-OPEN", f"{where}: its circles leave the rotation open; show more of a face, off one line"
        )
    return pose


def _problem(labels, centre_px, covariance_px2, target: TargetCircles, camera, options, prior, where):
    """Indices of the target's circles among the labels, and the problem that they make."""
    n = len(labels)
    centre, noise = frozen(centre_px, (n, 2), "centres"), frozen(covariance_px2, (n, 2, 2), "centres' covariance")
    used = [i for i, label in enumerate(labels) if isinstance(label, CircleLabel)]
    used.sort(key=lambda i: target.place.get(labels[i], -1))
    if len({labels[i] for i in used}) < len(used):
        raise InputError("E-LABEL-REPEATED", f"{where}: a label twice; every circle is seen once")
    unknown = [labels[i] for i in used if labels[i] not in target.place]
    if unknown:
        raise InputError(
            "E-LABEL-UNKNOWN",
            f"{where}: circle {unknown[0]} is not in the calibrated target; give the target's own labels",
        )
    fault = first_fault(noise, OF_PIXEL, definite=True)
    if fault is not None:
        raise InputError(
            "E-COVARIANCE-VALUE",
            f"{where}: covariance of the centre of {labels[fault.row]}: {fault.reason}; correct it",
        )
    place = np.array([target.place[labels[i]] for i in used], int)
    rows = (3 * place[:, None] + np.arange(3)).ravel()
    factor = target.sigma_factor if options.sigma_factor is None else options.sigma_factor
    ideal = camera.normalised_from_pixel(centre[used])
    px_by_centre = camera.distort_jacobian(ideal)[1] * camera.focal[:, None]
    back = np.linalg.inv(px_by_centre)
    by_camera, known = np.zeros((len(used), 2, 0)), np.zeros((0, 0))
    if prior is not None:
        by_camera = back @ (camera.parameter_jacobian(ideal) @ intrinsic_basis(prior.colmap_model))
        known = prior.covariance
    own = target.xyz[place], target.normal[place], target.radius[place], ideal, px_by_centre
    noise_of_centres = factor**2 * back @ noise[used] @ np.swapaxes(back, 1, 2)
    return used, PoseProblem(*own, noise_of_centres, by_camera, known, target.covariance[np.ix_(rows, rows)])


def _gain(image: CircleImages, full: np.ndarray) -> np.ndarray:
    """(6, 2n) derivative of the weighted pose by the centres."""
    a = image.by_pose.reshape(-1, 6)
    gain = np.linalg.solve(full, a)
    return np.linalg.solve(a.T @ gain, gain.T)


def _answer(
    problem: PoseProblem,
    found: Minima,
    names: list[CircleLabel],
    outliers: tuple[Outlier, ...],
    plane: Rigid,
    options: PoseOptions,
) -> TargetPose:
    """Decide between the minima, or what there is of a second one, and collect."""
    redundancy = 2 * len(names) - 6
    seen = {
        "faces": tuple(dict.fromkeys(name.face for name in names)),
        "labels": tuple(names),
        "outliers": outliers,
        "redundancy": redundancy,
    }
    delta, second = _second_solution(problem, found, redundancy)
    alone = second is None and len(seen["faces"]) == 1
    first = _solution(problem, found.rows([0]), second, plane if alone else None, options)
    seen["needed_chi2"] = options.needed(first.chi2 / redundancy)
    if min(delta, first.other_side) > seen["needed_chi2"]:
        return first.pose("certain", min(delta, first.other_side), seen)
    if second is None:
        return first.pose("ambiguous", first.other_side, seen)
    rest = _solution(problem, found.rows([1]), found.poses[[0]], None, options)
    return first.pose("ambiguous", min(delta, first.other_side), seen, rest.pose("ambiguous", -delta, seen))


def _second_solution(problem: PoseProblem, found: Minima, redundancy: int) -> tuple[float, PoseStack | None]:
    """By how much χ² the second minimum is worse than the first, and its pose; infinite where there is none.

    Both weigh the circles alike, as the stricter of the two does, or an outlier of one of them could decide.
    """
    if len(found.cost) == 1:
        return np.inf, None
    behind = float(found.cost[1] - found.cost[0])
    if behind > HOPELESS * max(1.0, found.cost[0] / redundancy):  # whatever the weights
        return behind, found.poses[[1]]
    residual, image = problem.seen(found.poses)
    common = np.tile(problem.noise / weights_of(found.length).min(0)[:, None, None], (2, 1, 1, 1))
    both = weigh(residual, image.by_pose, covariance_of_centres(problem, image, common), found.poses)
    if not distinct(both.poses, both.normal[0]):
        return np.inf, None
    return float(both.chi2[1] - both.chi2[0]), both.poses[[1]]


@dataclass(frozen=True, slots=True, eq=False)
class _Solution:
    """One minimum by the whole covariance of its centres; fields as in :class:`TargetPose`. ``other_side`` : by how
    much χ² the other side of a wide valley is worse, infinite where the minimum is none."""

    camera_from_target: Rigid
    covariance: np.ndarray
    parts: dict[str, np.ndarray]
    by_circles: np.ndarray
    by_intrinsics: np.ndarray
    residuals_px: np.ndarray
    weights: np.ndarray
    chi2: float
    other_side: float

    def pose(self, status: Status, delta_chi2: float, seen: dict, second: TargetPose | None = None) -> TargetPose:
        """With the decision, and what does not depend on the minimum."""
        own = {name: getattr(self, name) for name in _Solution.__slots__ if name != "other_side"}
        return TargetPose(**own, **seen, status=status, delta_chi2=delta_chi2, second=second)


def _solution(
    problem: PoseProblem, minimum: Minima, second: PoseStack | None, plane: Rigid | None, options: PoseOptions
) -> _Solution:
    """One minimum weighed.

    ``second``, ``plane`` : see :func:`stcal.sfm.measurement.pose.covariance_of_likelihood`

    Two steps: what the first leaves is of second order.
    """
    weights = weights_of(minimum.length[0])
    noise = problem.noise / weights[:, None, None]
    residual, image = problem.seen(minimum.poses)
    full = covariance_of_centres(problem, image, noise[None])
    poses = weigh(residual, image.by_pose, full, minimum.poses).poses
    residual, image = problem.seen(poses)
    last = weigh(residual, image.by_pose, full, poses)
    gain = _gain(image, full[0])
    by_circles = gain @ block_diagonal(image.by_circle)[0]
    by_intrinsics = gain @ problem.by_camera.reshape(len(full[0]), -1)
    parts = {
        "image": gain @ block_diagonal(noise[None])[0] @ gain.T,
        "target": by_circles @ problem.shape @ by_circles.T,
        "intrinsics": by_intrinsics @ problem.prior @ by_intrinsics.T,
    }
    gaussian = parts["image"] + parts["target"] + parts["intrinsics"]
    chi2 = float(last.chi2[0])
    # The samples span a valley from side to side: the margin for wrong σ is for what they do not show.
    plausible = options.needed(chi2 / (2 * len(weights) - 6)) / options.sigma_margin**2
    covariance, other_side = covariance_of_likelihood(
        problem, last.poses, full[0], chi2, gaussian, second, plane, plausible
    )
    parts["curvature"] = covariance - gaussian
    return _Solution(
        camera_from_target=last.poses.rigid(0),
        covariance=(covariance + covariance.T) / 2,
        parts=parts,
        by_circles=by_circles,
        by_intrinsics=by_intrinsics,
        residuals_px=problem.in_px(last.residual[0]),
        weights=weights,
        chi2=chi2,
        other_side=other_side,
    )


def measured_pose(
    image: ImageObservations,
    camera: Camera,
    target: TargetCircles,
    options: PoseOptions | None = None,
    prior: CameraPrior | None = None,
) -> TargetPose | StcalError:
    """:func:`pose_from_circles` of what one image shows of the calibrated target, or why there is no pose."""
    known = [i for i, label in enumerate(image.labels) if label in target.place]
    if not known:
        seen = ", ".join(image.face_ids())
        return DetectionError(
            "E-MEASURE-NO-FACE", f"{image.name}: " + (f"face {seen} is not calibrated" if seen else NO_FACE)
        )
    own = image.select(known)
    try:
        return pose_from_circles(
            own.labels, own.centre_px, own.covariance_px2, target, camera, options, prior, image.name
        )
    except StcalError as error:
        return error


def resolved(pose: TargetPose, previous: Rigid) -> TargetPose:
    """The pose with its two-fold ambiguity decided by another one that is near, camera_from_target of the image before;
    the same where it is certain, or where that one is near to neither."""
    if pose.status == "certain" or pose.second is None:
        return pose
    own, other = (
        Rigid(each.camera_from_target.rotation @ previous.rotation.T).angle_rad() for each in (pose, pose.second)
    )
    if own <= NEAR_PREVIOUS * other:
        return replace(pose, status="resolved")
    return pose.swapped() if other <= NEAR_PREVIOUS * own else pose


def fit_verdict(pose: TargetPose) -> str:
    """``passed``, ``suspicious`` or ``failed`` of the χ² of the residuals."""
    p = pose.p_value()
    return "failed" if p < FAILED else "suspicious" if p < SUSPICIOUS else "passed"


FELT = 0.5
"""Variance, in units of their noise, that a common error may have in the direction in which all poses together feel it
most, and still pass for independent: a result that feels nothing but this has a σ that is 20 % too small."""
MOST = 24
"""Largest number of directions."""
LARGEST_SHARE = 0.999
"""Largest common share of a pose's variance in any direction. The remainder must stay positive definite, even after
rounding or if the likelihood of a pose is narrower than its linearisation."""


def common_errors(poses: Sequence[TargetPose], target: TargetCircles, prior: CameraPrior | None) -> np.ndarray:
    """Returns the common errors (m, 6, r): pose i has the common error ``common[i] @ z``.

    The vector z, r independent normal numbers of σ 1, is the same for all poses. The errors are those of the circles
    and of the intrinsics as far as they matter (:data:`FELT`): the largest directions over all poses, each pose in
    units of its covariance. rad and mm, left perturbation in the camera frame.
    """
    if not poses:
        return np.zeros((0, 6, 0))
    circles, intrinsics = _root(target.covariance), _root(np.zeros((0, 0)) if prior is None else prior.covariance)
    effects = []
    for pose in poses:
        place = np.array([target.place[label] for label in pose.labels])
        rows = (3 * place[:, None] + np.arange(3)).ravel()
        effects.append(np.hstack([pose.by_circles @ circles[rows], pose.by_intrinsics @ intrinsics]))
    full = np.array(effects)
    pose_roots = np.linalg.cholesky(np.array([pose.covariance for pose in poses]))
    white = np.linalg.solve(pose_roots, full)
    _, s, vt = np.linalg.svd(white.reshape(-1, full.shape[2]), full_matrices=False)
    white = white @ vt[: min(int((s**2 > FELT).sum()), MOST)].T
    u, s, vt = np.linalg.svd(white, full_matrices=False)
    return pose_roots @ (u * np.minimum(s, np.sqrt(LARGEST_SHARE))[:, None]) @ vt


def _root(covariance: np.ndarray) -> np.ndarray:
    """Returns a square root (n, n) of the covariance. Its product with its transpose is the covariance."""
    value, vector = np.linalg.eigh(covariance)
    return vector * np.sqrt(np.maximum(value, 0))
