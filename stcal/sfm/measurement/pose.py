"""Pose of the target in one image, its covariance, and the errors that all poses have in common."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import numpy as np

from stcal.errors import DegenerateError, DetectionError, InputError, StcalError
from stcal.geometry import least_squares
from stcal.geometry.arrays import OF_PIXEL, Brief, first_fault, freeze, require_fields, rms
from stcal.geometry.camera import PARAMETER_NAMES, Camera, intrinsic_basis
from stcal.geometry.least_squares import Minima, Normal, block_diagonal
from stcal.geometry.plane import (
    MAX_OUTLIER_SHARE,
    MAX_SIGMA_RAD,
    OUTLIER,
    Descend,
    camera_from_plane,
    deciding_delta,
    distinct,
    fit_homography,
    mirrored,
    two_minima,
    weigh,
    weights_of,
)
from stcal.geometry.rigid import ImageFit, Poses, Rigid
from stcal.io.cameras.camera_model import CameraPrior
from stcal.labels import CircleLabel, circle_labels
from stcal.sfm.adjust.equations import coordinates
from stcal.sfm.adjust.faces_file import TargetCircles
from stcal.sfm.data.group_model import ImageObservations, Outlier, rows_by
from stcal.sfm.data.patterns import CircleImages, project_circles

SETTLED = 1e-4
"""Decrease of χ² below which the descent ends. A smaller step moves the pose by less than a hundredth of its σ, and two
steps with new weights of the centres follow. A second solution with a large χ² needs no better accuracy."""
HOPELESS = 500.0  # excess in χ² that no weights can make up for


@dataclass(frozen=True, slots=True, eq=False)
class PoseProblem:
    """Data of a pose: n circles, their measured centres and all covariances. Centres are free of distortion."""

    labels: tuple[CircleLabel, ...]
    xyz: np.ndarray  # (n, 3) target frame, as ``normal``
    normal: np.ndarray
    radius: np.ndarray  # (n,)
    centre: np.ndarray  # (n, 2) of the ellipses, normalised coordinates
    px_by_centre: np.ndarray  # (n, 2, 2) Jacobian of the lens
    noise: np.ndarray  # (n, 2, 2) covariance of ``centre``
    by_camera: np.ndarray  # (n, 2, q) derivative of ``centre`` by the intrinsics, q = 0 if they are held fixed
    prior: np.ndarray  # (q, q) covariance of the intrinsics
    shape: np.ndarray  # (3n, 3n) mm² covariance of the circles
    outliers: tuple[Outlier, ...] = ()  # circles that were left out

    def seen(self, poses: Poses) -> tuple[np.ndarray, CircleImages]:
        """Returns, for h poses, measured minus projected centres (h, n, 2), and the projections."""
        image = project_circles(self.xyz, self.normal, self.radius, poses.rotation, poses.translation)
        return self.centre - image.centre, image

    def in_px(self, residual: np.ndarray) -> np.ndarray:
        return (self.px_by_centre @ residual[..., None])[..., 0]

    def without(self, bad: np.ndarray, outliers: list[Outlier]) -> "PoseProblem":
        """Returns the problem without the circles of a mask (n,), which are ``outliers``."""
        keep = np.flatnonzero(~bad)
        rows = coordinates(keep)
        by_circle = ("xyz", "normal", "radius", "centre", "px_by_centre", "noise", "by_camera")
        return replace(
            self,
            labels=tuple(self.labels[i] for i in keep),
            **{name: getattr(self, name)[keep] for name in by_circle},
            shape=self.shape[np.ix_(rows, rows)],
            outliers=(*self.outliers, *outliers),
        )


def covariance_of_centres(problem: PoseProblem, image: CircleImages, noise: np.ndarray) -> np.ndarray:
    """Returns the covariance (h, 2n, 2n) of all centres from noise (h, n, 2, 2), circles and intrinsics."""
    by_circle = block_diagonal(image.by_circle)
    full = block_diagonal(noise) + by_circle @ problem.shape @ np.swapaxes(by_circle, 1, 2)
    by_camera = problem.by_camera.reshape(full.shape[-1], -1)
    return full + by_camera @ problem.prior @ by_camera.T


def descent_near(problem: PoseProblem, pose: Poses) -> Descend:
    """Returns the descent near a pose: residuals whitened by each centre's noise and own circle, Huber's loss."""
    by_circle = problem.seen(pose)[1].by_circle
    n = len(problem.xyz)
    own = problem.shape.reshape(n, 3, n, 3)[np.arange(n), :, np.arange(n)]
    covariance = problem.noise + by_circle @ own @ np.swapaxes(by_circle, -1, -2)
    whiten = block_diagonal(np.linalg.inv(np.linalg.cholesky(covariance)))

    def descend(poses: Poses, huber: float) -> Minima:
        h = len(poses)

        def evaluate(poses: Poses) -> Normal:
            residual, image = problem.seen(poses)
            r = (whiten @ residual.reshape(h, 2 * n, 1)).reshape(h, n, 2)
            return Normal.of(r, whiten @ image.by_pose.reshape(h, 2 * n, 6), np.all(image.depth > 0, axis=1), huber)

        return least_squares.descend(evaluate, poses, SETTLED, HOPELESS)

    return descend


MIN_CIRCLES = 4  # least number of circles of one face that determine its homography
WORST_SHARE = 0.5  # of the worst excess, from which centres are removed with it; others may only be pulled along
MIN_BREADTH = 0.05  # ratio to the length of the visible circles: a row leaves the rotation about itself open


def start_pose(problem: PoseProblem, target: TargetCircles, where: str) -> tuple[Poses, Rigid]:
    """Returns the pose from the homography of the face with the most circles, and target_from_plane of that face."""
    faces = rows_by(label.face for label in problem.labels)
    by_size = sorted((face for face in faces if face in target.target_from_plane), key=lambda face: -len(faces[face]))
    if not by_size or len(faces[by_size[0]]) < MIN_CIRCLES:
        count = f"{len(faces[by_size[0]])} of face {by_size[0]}" if by_size else "0"
        fault = f"{where}: {count} circles seen, {MIN_CIRCLES} of one face needed"
        raise DegenerateError("E-MEASURE-FEW-CIRCLES", f"{fault}; show one face as a whole")
    reasons = []
    for face in by_size:
        rows, target_from_plane = faces[face], target.target_from_plane[face]
        if len(rows) < MIN_CIRCLES:
            break
        plane_from_target = target_from_plane.inverse()
        xy = (plane_from_target @ problem.xyz[rows])[:, :2]
        long, broad = np.linalg.svd(xy - xy.mean(0), compute_uv=False)
        if broad < MIN_BREADTH * long:
            reasons.append(f"{len(rows)} circles, {MIN_CIRCLES} needed that are not on one line")
            continue
        try:
            pose = camera_from_plane(fit_homography(xy, problem.centre[rows])) @ plane_from_target
        except DegenerateError as error:
            reasons.append(str(error))
            continue
        if (problem.xyz @ pose.rotation[2] + pose.translation[2] > 0).all():
            return Poses.of([pose]), target_from_plane
        reasons.append("its circles would be behind the camera; check their labels")
    raise DegenerateError("E-MEASURE-AMBIGUOUS", f"{where}: face {by_size[0]}: {reasons[0]}; show all of its circles")


def minima_without_outliers(problem: PoseProblem, start: Poses, plane: Rigid, where: str) -> tuple[Minima, PoseProblem]:
    """Returns the minima without centres that contradict the others, and the problem without these."""
    count, alone = len(problem.labels), len({label.face for label in problem.labels}) == 1
    failure = f"{where}: no pose found; check the labels, and that the camera file belongs to the images"
    while True:
        best, limit = two_minima(partial(descent_near, problem), start, plane, failure, planar=alone)
        excess = best.length[0] / limit
        bad = excess > max(1.0, WORST_SHARE * excess.max())
        if not bad.any():
            return best, problem
        residual = np.linalg.norm(problem.in_px(problem.seen(best.poses[[0]])[0][0]), axis=1)
        limits, labels = limit * (residual / best.length[0]), problem.labels
        off = [Outlier(where, labels[i], float(residual[i]), float(limits[i])) for i in np.flatnonzero(bad)]
        problem = problem.without(bad, off)
        outliers = problem.outliers
        if len(outliers) > MAX_OUTLIER_SHARE * count or len(problem.labels) < MIN_CIRCLES:
            first = f"first {outliers[0].label} by {outliers[0].residual_px:.2g} px"
            fault = f"{where}: {len(outliers)} of {count} circles contradict the others, {first}"
            remedy = "check that camera file, faces.json and images belong together"
            raise DegenerateError("E-MEASURE-CONTRADICTS", f"{fault}; {remedy}")
        start = best.poses


CURVED = 0.2  # relative deviation of χ² from its parabola, two σ away, from which the covariance is sampled
SAMPLES = 1000
SAMPLED_WIDER = 1.5  # factor on the σ with which samples are drawn; else the tails would rest on a few samples
SAMPLE_ROUNDS = 2
MIN_EFFECTIVE = 20  # least effective number of samples (Kong 1992); with fewer, what they are drawn from is better
OTHER_SIDE = 3.0  # distance in σ from which the pose mirrored at the line of sight is another solution


def covariance_of_likelihood(
    problem: PoseProblem,
    pose: Poses,
    full: np.ndarray,
    least: float,
    covariance: np.ndarray,
    second: Poses | None,
    plane: Rigid | None,
    plausible: float,
) -> tuple[np.ndarray, float]:
    """Returns the covariance of a pose (6, 6), and the excess in χ² of its mirror image, infinite if that does not
    matter: it does if its excess is below ``plausible``, and it is some σ away and far more probable than these say. If
    the likelihood is not Gaussian, the covariance is its second moment, by importance sampling with fixed numbers
    (Bishop 2006, Pattern Recognition and Machine Learning, sec. 11.1.4), without poses nearer to the ``second``
    solution. ``full``: (2n, 2n) of the centres; ``least``: χ² of the pose; ``covariance``: (6, 6), linearised."""
    whiten = np.linalg.inv(np.linalg.cholesky(full))

    def excess(step: np.ndarray) -> np.ndarray:
        poses = pose[np.zeros(len(step), int)].moved(step)
        residual, image = problem.seen(poses)
        square = ((residual.reshape(len(step), -1) @ whiten.T) ** 2).sum(1)
        return np.where((image.depth > 0).all(1), square, np.inf)

    axes = _principal(covariance)
    curved = np.abs((excess(2 * np.vstack([axes, -axes])) - least) / 4 - 1).max() >= CURVED
    other_side, first = np.inf, covariance
    if plane is not None:
        image_pose = mirrored(pose, plane)
        step_to_mirrored = image_pose.difference(pose)[0]
        square = float(step_to_mirrored @ np.linalg.solve(covariance, step_to_mirrored))
        residual, image = problem.seen(image_pose)
        free = np.zeros((6, 4))  # all parameters but the tilt of the plane, which are adjusted to first order
        free[:3, 0] = image_pose.rotation[0] @ plane.rotation[:, 2]
        free[3:, 1:] = np.eye(3)
        a, r = whiten @ image.by_pose.reshape(-1, 6) @ free, whiten @ residual.ravel()
        delta = float(((r - a @ np.linalg.lstsq(a, r)[0]) ** 2).sum()) - least
        if delta < min(plausible, square / 2) and square > OTHER_SIDE**2:
            other_side, curved = float(delta), True
            first = covariance + np.outer(step_to_mirrored, step_to_mirrored) / 4
    return (_sampled(excess, least, pose, first, second) if curved else covariance), other_side


def _sampled(excess, least: float, pose: Poses, covariance: np.ndarray, second: Poses | None) -> np.ndarray:
    """Returns the second moment (6, 6) of exp(−(excess − least)/2) about the pose, first guessed as ``covariance``."""
    normal = np.random.default_rng(0).standard_normal((SAMPLES, 6))
    precision = np.linalg.inv(covariance)
    for _ in range(SAMPLE_ROUNDS):
        step = SAMPLED_WIDER * normal @ _principal(covariance)
        log = (normal**2).sum(1) / 2 - (excess(step) - least) / 2
        if second is not None:
            step_to_second = second.difference(pose)[0]
            log[(step - step_to_second / 2) @ precision @ step_to_second > 0] = -np.inf
        weight = np.exp(log - log.max())
        weight /= weight.sum()
        if 1 / (weight**2).sum() < MIN_EFFECTIVE:
            break
        covariance = np.einsum("k,ki,kj->ij", weight, step, step)
    return covariance


def _principal(covariance: np.ndarray) -> np.ndarray:
    sigma = np.sqrt(np.diag(covariance))
    value, vector = np.linalg.eigh(covariance / sigma / sigma[:, None])
    return (vector * np.sqrt(np.maximum(value, 0))).T * sigma


MISFIT = 0.03  # largest RMS residual over the extent of the circles; mirrored photographs of two faces leave 9 to 18 %
NEAR_PREVIOUS = 1 / 3  # largest ratio of two rotations from the previous pose, the nearer over the other, that decides
NO_FACE = "no face of the target recognised; if a dot board is in view, give --board"
SUSPICIOUS, FAILED = 1e-3, 1e-5  # limits of the p-value of a fit's χ², the same as in the checks of a run
Status = Literal["certain", "resolved", "ambiguous"]


@dataclass(frozen=True, slots=True)
class PoseOptions:
    flip_odds: float = 1e-6  # largest odds of the second solution for a pose to be certain, for Gaussian errors
    sigma_margin: float = 1.5  # factor by which the stated σ may be too small while this holds
    sigma_factor: float | None = None  # on the centres' own σ; None: that of the target's run

    def __post_init__(self):
        require_fields(self, "options")
        factor = 1.0 if self.sigma_factor is None else self.sigma_factor
        if not (0 < self.flip_odds < 1 and self.sigma_margin >= 1 and np.isfinite(factor) and factor > 0):
            stated = f"flip odds {self.flip_odds:g}, σ margin {self.sigma_margin:g}, σ factor {factor:g}"
            needed = "odds between 0 and 1, a margin of at least 1 and a positive factor needed"
            raise InputError("E-OPTION-RANGE", f"{stated}: {needed}")


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class TargetPose(ImageFit, Brief):
    """The pose of the target in one image."""

    camera_from_target: Rigid
    covariance: np.ndarray  # (6, 6), rad and mm, left perturbation in the camera frame, R' = exp(w) R, t' = t + dt
    parts: dict[str, np.ndarray]  # (6, 6) summands, of which ``target`` and ``intrinsics`` are common to all images
    by_circles: np.ndarray  # (6, 3n) derivatives, but for the sign, by errors of the circles (target frame, mm)
    by_intrinsics: np.ndarray  # (6, q) the same by errors of the intrinsics
    status: Status  # certain, resolved or ambiguous
    faces: tuple[str, ...]
    labels: tuple[CircleLabel, ...]
    residuals_px: np.ndarray  # (n, 2) measured minus projected ellipse centres
    weights: np.ndarray  # (n,) Huber's
    outliers: tuple[Outlier, ...]
    chi2: float  # of all residuals with their covariance
    redundancy: int
    delta_chi2: float  # of the second solution or the other side of the valley, infinite if there is neither
    needed_chi2: float  # least ``delta_chi2`` with which the pose is certain
    second: "TargetPose | None" = None  # solution, unless the pose is certain

    def __post_init__(self):
        n = len(self.labels)
        shapes = {"covariance": (6, 6), "by_circles": (6, 3 * n), "by_intrinsics": (6, None), "weights": (n,)}
        for name, shape in {**shapes, "residuals_px": (n, 2)}.items():
            freeze(self, name, shape, f"pose: {name}")


def pose_from_circles(
    image: ImageObservations,  # whose dots of the board are ignored
    target: TargetCircles,
    camera: Camera,
    options: PoseOptions | None = None,
    prior: CameraPrior | None = None,  # covariance of the intrinsics, which are exact if None
) -> TargetPose:
    """Returns the pose of a calibrated target from the ellipse centres of its circles in one image. From the homography
    of the largest face, and from its reflection, Huber's loss of single centres is minimised. The minima are then
    weighed by the whole covariance of the centres: noise, target and intrinsics."""
    options, where = options or PoseOptions(), image.name
    problem = _problem(image, target, camera, options, prior)
    start, plane = start_pose(problem, target, where)
    minima, problem = minima_without_outliers(problem, start, plane, where)
    residual = problem.in_px(problem.seen(minima.poses[[0]])[0][0])
    rms_px, limit_px = rms(residual), MISFIT * float(np.ptp(problem.in_px(problem.centre), axis=0).max())
    if not rms_px <= limit_px:  # no covariance describes a pose of which most circles are elsewhere
        allowed = f"{limit_px:.2g} allowed, {MISFIT:.0%} of their extent"
        fault = f"{where}: circles lie {rms_px:.3g} px RMS from where the best pose has them, {allowed}"
        causes = "wrong labels, a mirrored image, another target, or another camera's file"
        raise DegenerateError("E-MEASURE-MISFIT", f"{fault}; {causes}")
    pose = _answer(problem, minima, plane, options)
    if np.sqrt(np.diag(pose.covariance)[:3].max()) > MAX_SIGMA_RAD:
        if pose.chi2_per_redundancy() > OUTLIER**2:  # the rotation is open because the residuals are large
            fault = f"{where}: its circles contradict each other, χ²/dof {pose.chi2_per_redundancy():.2g}"
            remedy = "check their labels, and that camera file, faces.json and images belong together"
            raise DegenerateError("E-MEASURE-CONTRADICTS", f"{fault}; {remedy}")
        raise DegenerateError(
            "E-MEASURE-OPEN", f"{where}: its circles do not determine the rotation; show more of a face, off one line"
        )
    return pose


def _problem(image: ImageObservations, target: TargetCircles, camera: Camera, options, prior) -> PoseProblem:
    used = [i for i, label in enumerate(image.labels) if isinstance(label, CircleLabel)]
    used.sort(key=lambda i: target.place.get(image.labels[i], -1))  # type: ignore[arg-type]
    seen, where = image.select(used), image.name
    if len(set(seen.labels)) < len(used):
        raise InputError("E-LABEL-REPEATED", f"{where}: a label twice; every circle is seen once")
    if unknown := [label for label in seen.labels if label not in target.place]:
        fault = f"{where}: circle {unknown[0]} is not in the calibrated target"
        raise InputError("E-LABEL-UNKNOWN", f"{fault}; give the target's own labels")
    fault = first_fault(seen.covariance_px2, OF_PIXEL, definite=True)
    if fault is not None:
        reason = f"covariance of the centre of {seen.labels[fault.row]}: {fault.reason}; correct it"
        raise InputError("E-COVARIANCE-VALUE", f"{where}: {reason}")
    labels = circle_labels(seen.labels)
    place = np.array([target.place[label] for label in labels], int)
    rows = coordinates(place)
    factor = target.sigma_factor if options.sigma_factor is None else options.sigma_factor
    ideal = camera.normalised_from_pixel(seen.centre_px)
    px_by_centre = camera.pixel_jacobian(ideal)
    centre_by_px = np.linalg.inv(px_by_centre)
    basis = np.zeros((len(PARAMETER_NAMES), 0)) if prior is None else intrinsic_basis(prior.colmap_model)
    return PoseProblem(
        labels=labels,
        xyz=target.xyz[place],
        normal=target.normal[place],
        radius=target.radius[place],
        centre=ideal,
        px_by_centre=px_by_centre,
        noise=factor**2 * centre_by_px @ seen.covariance_px2 @ np.swapaxes(centre_by_px, 1, 2),
        by_camera=centre_by_px @ (camera.parameter_jacobian(ideal) @ basis),
        prior=np.zeros((0, 0)) if prior is None else prior.covariance,
        shape=target.covariance[np.ix_(rows, rows)],
    )


def _answer(problem: PoseProblem, found: Minima, plane: Rigid, options: PoseOptions) -> TargetPose:
    excess, second = np.inf, None  # of the second minimum in χ², and its pose
    if len(found.cost) > 1:
        excess, second = float(found.cost[1] - found.cost[0]), found.poses[[1]]
    if second is not None and excess <= HOPELESS * max(1.0, found.cost[0] / (2 * len(problem.labels) - 6)):
        # Both minima give a circle the same weight, the smaller of the two. Else an outlier of one could decide.
        residual, image = problem.seen(found.poses)
        common = np.tile(problem.noise / weights_of(found.length).min(0)[:, None, None], (2, 1, 1, 1))
        weighed = weigh(residual, image.by_pose, covariance_of_centres(problem, image, common), found.poses)
        excess, second = np.inf, None
        if distinct(weighed.poses, weighed.normal[0]):
            excess, second = float(weighed.chi2[1] - weighed.chi2[0]), weighed.poses[[1]]
    alone = second is None and len({label.face for label in problem.labels}) == 1
    first = _solution(problem, found.rows([0]), second, plane if alone else None, options)
    first = replace(first, delta_chi2=min(excess, first.delta_chi2))
    if first.delta_chi2 > first.needed_chi2:
        return first
    if second is None:
        return replace(first, status="ambiguous")
    other = _solution(problem, found.rows([1]), found.poses[[0]], None, options)
    other = replace(other, status="ambiguous", delta_chi2=-excess, needed_chi2=first.needed_chi2)
    return replace(first, status="ambiguous", second=other)


def _solution(
    problem: PoseProblem, minimum: Minima, second: Poses | None, plane: Rigid | None, options: PoseOptions
) -> TargetPose:
    """Returns a minimum weighed by the whole covariance of its centres in two steps: the first errs by second order.
    Its ``delta_chi2`` is that of the other side of a wide valley, infinite if the minimum is no valley."""
    weights = weights_of(minimum.length[0])
    noise = problem.noise / weights[:, None, None]
    residual, image = problem.seen(minimum.poses)
    full = covariance_of_centres(problem, image, noise[None])
    poses = weigh(residual, image.by_pose, full, minimum.poses).poses
    residual, image = problem.seen(poses)
    last = weigh(residual, image.by_pose, full, poses)
    a = image.by_pose.reshape(-1, 6)
    gain = np.linalg.solve(full[0], a)
    gain = np.linalg.solve(a.T @ gain, gain.T)  # (6, 2n) derivative of the weighted pose by the centres
    by_circles = gain @ block_diagonal(image.by_circle)[0]
    by_intrinsics = gain @ problem.by_camera.reshape(len(full[0]), -1)
    parts = {
        "image": gain @ block_diagonal(noise[None])[0] @ gain.T,
        "target": by_circles @ problem.shape @ by_circles.T,
        "intrinsics": by_intrinsics @ problem.prior @ by_intrinsics.T,
    }
    gaussian = parts["image"] + parts["target"] + parts["intrinsics"]
    chi2, redundancy = float(last.chi2[0]), 2 * len(problem.labels) - 6
    needed = deciding_delta(options.flip_odds, options.sigma_margin, chi2 / redundancy)
    # The samples cover a valley from side to side, so that no margin for wrong σ is needed here.
    given = full[0], chi2, gaussian, second, plane, needed / options.sigma_margin**2
    covariance, other_side = covariance_of_likelihood(problem, last.poses, *given)
    parts["curvature"] = covariance - gaussian
    return TargetPose(
        camera_from_target=last.poses[0],
        covariance=(covariance + covariance.T) / 2,
        parts=parts,
        by_circles=by_circles,
        by_intrinsics=by_intrinsics,
        status="certain",
        faces=tuple(dict.fromkeys(label.face for label in problem.labels)),
        labels=problem.labels,
        residuals_px=problem.in_px(last.residual[0]),
        weights=weights,
        outliers=problem.outliers,
        chi2=chi2,
        redundancy=redundancy,
        delta_chi2=other_side,
        needed_chi2=needed,
    )


def measured_pose(
    image: ImageObservations,
    camera: Camera,
    target: TargetCircles,
    options: PoseOptions | None = None,
    prior: CameraPrior | None = None,
) -> TargetPose | StcalError:
    """Returns :func:`pose_from_circles` of the calibrated circles in one image, or the error if there is no pose."""
    calibrated = [i for i, label in enumerate(image.labels) if label in target.place]
    if not calibrated:
        faces = ", ".join(image.face_ids())
        why = f"face {faces} is not calibrated" if faces else NO_FACE
        return DetectionError("E-MEASURE-NO-FACE", f"{image.name}: {why}")
    try:
        return pose_from_circles(image.select(calibrated), target, camera, options, prior)
    except StcalError as error:
        return error


def resolved(pose: TargetPose, previous: Rigid) -> TargetPose:
    """Returns the pose with its ambiguity decided by the image before, if one solution is clearly nearer to it."""
    if pose.status == "certain" or pose.second is None:
        return pose
    both = pose.camera_from_target, pose.second.camera_from_target
    turn, turn_of_second = (Rigid(own.rotation @ previous.rotation.T).angle_rad() for own in both)
    if turn <= NEAR_PREVIOUS * turn_of_second:
        return replace(pose, status="resolved")
    if turn_of_second > NEAR_PREVIOUS * turn:
        return pose
    return replace(pose.second, status="resolved", second=replace(pose, second=None))


def fit_verdict(pose: TargetPose) -> str:
    """Returns ``passed``, ``suspicious`` or ``failed``, by the p-value of the residuals' χ²."""
    p = pose.p_value()
    return "failed" if p < FAILED else "suspicious" if p < SUSPICIOUS else "passed"


FELT = 0.5
"""Variance, in units of their noise, that a common error may have in the direction in which all poses together feel it
most, and still pass for independent: a result that feels nothing but this has a σ that is 20 % too small."""
MOST = 24  # largest number of directions
LARGEST_SHARE = 0.999
"""Largest common share of a pose's variance in any direction. The remainder must stay positive definite, even after
rounding or if the likelihood of a pose is narrower than its linearisation."""


def common_errors(poses: Sequence[TargetPose], target: TargetCircles, prior: CameraPrior | None) -> np.ndarray:
    """Returns the errors (m, 6, r) that circles and intrinsics add to all poses, in camera frames: ``common[i] @ z``, z
    normal. Only the largest directions that matter to the poses (:data:`FELT`) are kept."""
    if not poses:
        return np.zeros((0, 6, 0))
    circles, intrinsics = _root(target.covariance), np.zeros((0, 0)) if prior is None else _root(prior.covariance)
    effects = []
    for pose in poses:
        rows = coordinates(np.array([target.place[label] for label in pose.labels]))
        effects.append(np.hstack([pose.by_circles @ circles[rows], pose.by_intrinsics @ intrinsics]))
    pose_roots = np.linalg.cholesky(np.array([pose.covariance for pose in poses]))
    white = np.linalg.solve(pose_roots, np.array(effects))
    _, s, vt = np.linalg.svd(white.reshape(-1, white.shape[2]), full_matrices=False)
    white = white @ vt[: min(int((s**2 > FELT).sum()), MOST)].T
    u, s, vt = np.linalg.svd(white, full_matrices=False)
    return pose_roots @ (u * np.minimum(s, np.sqrt(LARGEST_SHARE))[:, None]) @ vt


def _root(covariance: np.ndarray) -> np.ndarray:
    value, vector = np.linalg.eigh(covariance)
    return vector * np.sqrt(np.maximum(value, 0))
