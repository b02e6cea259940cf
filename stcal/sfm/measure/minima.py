"""The minima of one image's residuals over the pose: two of them where a face is seen alone."""

import numpy as np

from stcal.errors import ConvergenceError, DegenerateError
from stcal.geometry.plane import camera_from_plane, fit_homography
from stcal.geometry.pose_descent import Minima, PoseStack
from stcal.geometry.rigid import Rigid
from stcal.labels import CircleLabel
from stcal.sfm.data.model import Outlier
from stcal.sfm.measure.problem import PoseProblem, descend, step_between, whitening_by_centre
from stcal.sfm.measure.target import TargetCircles

HUBER = 3.0
"""In σ of a centre, or of the residuals' robust spread if that is larger: one honest centre in ninety is beyond."""
MIN_CIRCLES = 4
"""Of one face: fewer do not fix its homography."""
OUTLIER = 6.0
"""In the same unit: by chance one centre in 6·10⁷ (Rayleigh). Such a centre is left out, and named."""
WORST_SHARE = 0.5
"""Centres at least so much beyond the limit as the worst one go with it; the others may only have been pulled along."""
MAX_OUTLIER_SHARE = 1 / 3
RAYLEIGH_MEDIAN = float(np.sqrt(2 * np.log(2)))
MIN_BREADTH = 0.05
"""Of the circles seen, over their length: in a row they leave the rotation about it open."""
SAME = 1.0
"""Minima nearer than this, in σ, are one: its covariance covers both."""


def start_pose(
    names: list[CircleLabel], problem: PoseProblem, target: TargetCircles, where: str
) -> tuple[PoseStack, Rigid]:
    """Pose by the homography of the face with the most circles, and target_from_plane of that face."""
    faces: dict[str, list[int]] = {}
    for i, name in enumerate(names):
        faces.setdefault(name.face, []).append(i)
    by_size = sorted((f for f in faces if f in target.target_from_plane), key=lambda f: -len(faces[f]))
    if not by_size or len(faces[by_size[0]]) < MIN_CIRCLES:
        seen = f"{len(faces[by_size[0]])} of face {by_size[0]}" if by_size else "0"
        raise DegenerateError(
            f"{where}: {seen} circles seen, {MIN_CIRCLES} of one face needed; show one face as a whole"
        )
    for face_id in by_size:
        rows, plane = faces[face_id], target.target_from_plane[face_id]
        plane_from_target = plane.inverse()
        xy = (plane_from_target @ problem.xyz[rows])[:, :2]
        long, broad = np.linalg.svd(xy - xy.mean(0), compute_uv=False)
        if broad < MIN_BREADTH * long:
            reason = f"{len(rows)} circles, {MIN_CIRCLES} off one line needed"
            continue
        try:
            homography = fit_homography(xy, problem.centre[rows])
        except DegenerateError as error:
            reason = error
            continue
        pose = camera_from_plane(homography) @ plane_from_target
        start = PoseStack(pose.rotation[None], pose.translation[None])
        if (problem.xyz @ pose.rotation[2] + pose.translation[2] <= 0).any():
            reason = "its circles would be behind the camera; check their labels"
            continue
        return start, plane
    raise DegenerateError(f"{where}: face {by_size[0]}: {reason}; show all of its circles")


def mirrored(poses: PoseStack, target_from_plane: Rigid) -> PoseStack:
    """Mirrored at the line of sight to the middle of the face: the plane's depths change their sign."""
    middle = poses.rotation @ target_from_plane.translation + poses.translation
    sight = middle / np.linalg.norm(middle, axis=1, keepdims=True)
    mirror = np.eye(3) - 2 * sight[:, :, None] * sight[:, None, :]
    axis = target_from_plane.rotation[:, 2]
    rotation = mirror @ poses.rotation @ (np.eye(3) - 2 * np.outer(axis, axis))
    return PoseStack(rotation, middle - rotation @ target_from_plane.translation)


def minima_without_outliers(problem: PoseProblem, start: PoseStack, plane: Rigid, names: list[CircleLabel], where: str):
    """The minima by single centres without those that contradict the others, the indices kept, and the outliers."""
    keep, outliers = np.arange(len(names)), []
    alone = len({name.face for name in names}) == 1
    poses = start.plus(mirrored(start, plane))
    while True:
        part = problem if len(keep) == len(names) else problem.select(keep)
        found, limit = _two_minima(part, poses, plane, alone, where)
        excess = found.length[0] / limit
        bad = excess > max(1.0, WORST_SHARE * excess.max())
        if not bad.any():
            return found, keep, tuple(outliers)
        residual = np.linalg.norm(part.in_px(part.seen(found.poses[[0]])[0][0]), axis=1)
        sigma = residual / found.length[0]
        outliers += [
            Outlier(where, names[keep[i]], float(residual[i]), float(limit * sigma[i])) for i in np.flatnonzero(bad)
        ]
        keep = keep[~bad]
        if len(outliers) > MAX_OUTLIER_SHARE * len(names) or len(keep) < MIN_CIRCLES:
            raise DegenerateError(
                f"{where}: {len(outliers)} of {len(names)} circles contradict the others, first {outliers[0].label} by "
                f"{outliers[0].residual_px:.2g} px; check that camera file, faces.json and images belong together"
            )
        poses = found.poses


def _two_minima(problem: PoseProblem, poses: PoseStack, plane: Rigid, alone: bool, where: str) -> tuple[Minima, float]:
    """One or two distinct minima by single centres, the better one first, and the outliers' limit in σ; ``alone`` :
    there is one face only."""
    if len(poses.rotation) == 1:
        poses = poses.plus(mirrored(poses, plane))
    whiten = whitening_by_centre(problem, poses[[0]])  # of one pose, so that the costs of both compare
    spread = 1.0
    for _ in range(2):  # the second time with the residuals' own spread, if that is larger
        found = descend(problem, poses, whiten, HUBER * spread)
        poses, best = found.poses, int(np.argmin(found.cost))
        wider = float(np.median(found.length[best])) / RAYLEIGH_MEDIAN
        if wider <= 1.1 * spread:
            break
        spread = wider
    if not np.isfinite(found.cost[best]) or not found.settled[best]:
        raise ConvergenceError(
            f"{where}: no pose found; check the labels, and that the camera file belongs to the images"
        )
    order = np.array([best, 1 - best])
    two = distinct(found.poses[order], found.normal[best])
    if alone and not two:  # perhaps both starts were on one side
        again = mirrored(found.poses[[best]], plane)
        found = _joined(found, best, descend(problem, again, whiten, HUBER * spread))
        order = np.argsort(found.cost)
        two = distinct(found.poses[order], found.normal[order[0]])
    if not two or not np.isfinite(found.cost[order[1]]):
        order = order[:1]
    return Minima(*(getattr(found, f)[order] for f in Minima.__slots__)), OUTLIER * spread


def _joined(found: Minima, row: int, other: Minima) -> Minima:
    poses = found.poses[[row]].plus(other.poses)
    rest = [np.concatenate([getattr(found, f)[[row]], getattr(other, f)]) for f in Minima.__slots__[1:]]
    return Minima(poses, *rest)


def distinct(poses: PoseStack, normal: np.ndarray) -> bool:
    """Whether the second of two poses is another than the first, which has this normal matrix."""
    way = step_between(poses[[0]], poses[[1]])
    return bool(way @ normal @ way > SAME**2)
