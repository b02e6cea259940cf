"""The reprojection problem of a pose, and its minima."""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from stcal.errors import DegenerateError
from stcal.geometry import least_squares
from stcal.geometry.least_squares import Minima, Normal, PoseStack, block_diagonal
from stcal.geometry.plane import MAX_OUTLIER_SHARE, Descend, camera_from_plane, fit_homography, two_minima
from stcal.geometry.rigid import Rigid
from stcal.labels import CircleLabel
from stcal.sfm.data.model import Outlier
from stcal.sfm.data.patterns import CircleImages, project_circles
from stcal.sfm.measurement.known_target import TargetCircles

SETTLED = 1e-4
"""Decrease of χ² below which the descent ends. A smaller step moves the pose by less than a hundredth of its σ, and two
steps with new weights of the centres follow. A second solution with a large χ² needs no better accuracy."""
HOPELESS = 500.0
"""Excess in χ² that no weights can make up for."""


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

    def seen(self, poses: PoseStack) -> tuple[np.ndarray, CircleImages]:
        """Returns, for h poses, measured minus projected centres (h, n, 2), and the projections."""
        image = project_circles(self.xyz, self.normal, self.radius, poses.rotation, poses.translation)
        return self.centre - image.centre, image

    def in_px(self, residual: np.ndarray) -> np.ndarray:
        return (self.px_by_centre @ residual[..., None])[..., 0]

    def without(self, bad: np.ndarray, outliers: list[Outlier]) -> "PoseProblem":
        """Returns the problem without the circles of a mask (n,), which are ``outliers``."""
        keep = np.flatnonzero(~bad)
        rows = (3 * keep[:, None] + np.arange(3)).ravel()
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


def descent_near(problem: PoseProblem, pose: PoseStack) -> Descend:
    """Returns the descent near a pose, with residuals whitened by the σ of each centre's noise and own circle, and
    Huber's loss."""
    by_circle = problem.seen(pose)[1].by_circle
    n = len(problem.xyz)
    own = problem.shape.reshape(n, 3, n, 3)[np.arange(n), :, np.arange(n)]
    covariance = problem.noise + by_circle @ own @ np.swapaxes(by_circle, -1, -2)
    whiten = block_diagonal(np.linalg.inv(np.linalg.cholesky(covariance)))

    def descend(poses: PoseStack, huber: float) -> Minima:
        h = len(poses)

        def evaluate(poses: PoseStack) -> Normal:
            residual, image = problem.seen(poses)
            r = (whiten @ residual.reshape(h, 2 * n, 1)).reshape(h, n, 2)
            return Normal.of(r, whiten @ image.by_pose.reshape(h, 2 * n, 6), np.all(image.depth > 0, axis=1), huber)

        return least_squares.descend(evaluate, poses, SETTLED, HOPELESS)

    return descend


MIN_CIRCLES = 4
"""Least number of circles of one face. Fewer do not determine its homography."""
WORST_SHARE = 0.5
"""Share of the worst excess from which centres are removed with the worst one. The others may only be pulled along."""
MIN_BREADTH = 0.05
"""Least ratio of breadth to length of the visible circles. Circles in a row leave the rotation about the row open."""


def start_pose(problem: PoseProblem, target: TargetCircles, where: str) -> tuple[PoseStack, Rigid]:
    """Returns the pose from the homography of the face with the most circles, and target_from_plane of that face."""
    faces: dict[str, list[int]] = {}
    for i, label in enumerate(problem.labels):
        if label.face in target.target_from_plane:
            faces.setdefault(label.face, []).append(i)
    by_size = sorted(faces, key=lambda face: -len(faces[face]))
    if not by_size or len(faces[by_size[0]]) < MIN_CIRCLES:
        count = f"{len(faces[by_size[0]])} of face {by_size[0]}" if by_size else "0"
        raise DegenerateError(
            "E-MEASURE-FEW-CIRCLES",
            f"{where}: {count} circles seen, {MIN_CIRCLES} of one face needed; show one face as a whole",
        )
    reasons = []
    for face in by_size:
        if len(faces[face]) >= MIN_CIRCLES:
            try:
                pose = _pose_by_face(target.target_from_plane[face], problem, faces[face])
            except DegenerateError as error:
                reasons.append(error)
                continue
            return PoseStack.of(pose), target.target_from_plane[face]
    raise DegenerateError("E-MEASURE-AMBIGUOUS", f"{where}: face {by_size[0]}: {reasons[0]}; show all of its circles")


def _pose_by_face(target_from_plane: Rigid, problem: PoseProblem, rows: list[int]) -> Rigid:
    plane_from_target = target_from_plane.inverse()
    xy = (plane_from_target @ problem.xyz[rows])[:, :2]
    long, broad = np.linalg.svd(xy - xy.mean(0), compute_uv=False)
    if broad < MIN_BREADTH * long:
        reason = f"{len(rows)} circles, {MIN_CIRCLES} needed that are not on one line"
        raise DegenerateError("E-MEASURE-AMBIGUOUS", reason)
    pose = camera_from_plane(fit_homography(xy, problem.centre[rows])) @ plane_from_target
    if (problem.xyz @ pose.rotation[2] + pose.translation[2] <= 0).any():
        raise DegenerateError("E-MEASURE-AMBIGUOUS", "its circles would be behind the camera; check their labels")
    return pose


def minima_without_outliers(
    problem: PoseProblem, start: PoseStack, plane: Rigid, where: str
) -> tuple[Minima, PoseProblem]:
    """Returns the minima without centres that contradict the others, and the problem without these."""
    count, alone = len(problem.labels), len({label.face for label in problem.labels}) == 1
    failure = f"{where}: no pose found; check the labels, and that the camera file belongs to the images"
    while True:
        both = two_minima(partial(descent_near, problem), start, plane, failure, planar=alone)
        best, limit = both.minima, both.outlier_limit
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
            raise DegenerateError(
                "E-MEASURE-CONTRADICTS",
                f"{where}: {len(outliers)} of {count} circles contradict the others, first {outliers[0].label} by "
                f"{outliers[0].residual_px:.2g} px; check that camera file, faces.json and images belong together",
            )
        start = best.poses
