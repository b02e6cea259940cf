"""Minima of one image's residuals over the pose. There are two if a single face is visible."""

from functools import partial

import numpy as np

from stcal.errors import DegenerateError
from stcal.geometry.plane import camera_from_plane, fit_homography
from stcal.geometry.plane_poses import MAX_OUTLIER_SHARE, two_minima
from stcal.geometry.pose_descent import PoseStack
from stcal.geometry.rigid import Rigid
from stcal.labels import CircleLabel
from stcal.sfm.data.model import Outlier
from stcal.sfm.measurement.problem import PoseProblem, descent_near
from stcal.sfm.measurement.target import TargetCircles

MIN_CIRCLES = 4
"""Least number of circles of one face. Fewer do not determine its homography."""
WORST_SHARE = 0.5
"""Share of the worst excess from which centres are removed with the worst one. The others may only be pulled along."""
MIN_BREADTH = 0.05
"""Least ratio of breadth to length of the visible circles. Circles in a row leave the rotation about the row open."""


def start_pose(
    names: list[CircleLabel], problem: PoseProblem, target: TargetCircles, where: str
) -> tuple[PoseStack, Rigid]:
    """Returns the pose from the homography of the face with the most circles, and target_from_plane of that face."""
    faces: dict[str, list[int]] = {}
    for i, name in enumerate(names):
        faces.setdefault(name.face, []).append(i)
    by_size = sorted((f for f in faces if f in target.target_from_plane), key=lambda f: -len(faces[f]))
    if not by_size or len(faces[by_size[0]]) < MIN_CIRCLES:
        seen = f"{len(faces[by_size[0]])} of face {by_size[0]}" if by_size else "0"
        raise DegenerateError(
            "E-MEASURE-FEW-CIRCLES",
            f"{where}: {seen} circles seen, {MIN_CIRCLES} of one face needed; show one face as a whole",
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
        if (problem.xyz @ pose.rotation[2] + pose.translation[2] <= 0).any():
            reason = "its circles would be behind the camera; check their labels"
            continue
        return PoseStack.of(pose), plane
    raise DegenerateError("E-MEASURE-AMBIGUOUS", f"{where}: face {by_size[0]}: {reason}; show all of its circles")


def minima_without_outliers(problem: PoseProblem, start: PoseStack, plane: Rigid, names: list[CircleLabel], where: str):
    """Returns the minima without centres that contradict the others, the indices kept, and the outliers.

    Each centre is weighted on its own, without covariance between centres.
    """
    keep, outliers = np.arange(len(names)), []
    alone = len({name.face for name in names}) == 1
    failure = f"{where}: no pose found; check the labels, and that the camera file belongs to the images"
    while True:
        subset = problem if len(keep) == len(names) else problem.select(keep)
        both = two_minima(partial(descent_near, subset), start, plane, failure, planar=alone)
        best, limit = both.minima, both.outlier_limit
        excess = best.length[0] / limit
        bad = excess > max(1.0, WORST_SHARE * excess.max())
        if not bad.any():
            return best, keep, tuple(outliers)
        residual = np.linalg.norm(subset.in_px(subset.seen(best.poses[[0]])[0][0]), axis=1)
        sigma = residual / best.length[0]
        outliers += [
            Outlier(where, names[keep[i]], float(residual[i]), float(limit * sigma[i])) for i in np.flatnonzero(bad)
        ]
        keep = keep[~bad]
        if len(outliers) > MAX_OUTLIER_SHARE * len(names) or len(keep) < MIN_CIRCLES:
            raise DegenerateError(
                "E-MEASURE-CONTRADICTS",
                f"{where}: {len(outliers)} of {len(names)} circles contradict the others, first {outliers[0].label} by "
                f"{outliers[0].residual_px:.2g} px; check that camera file, faces.json and images belong together",
            )
        start = best.poses
