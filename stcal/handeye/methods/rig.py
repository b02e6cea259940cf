"""Reprojection adjustment of several cameras: X of each, one Z, one board and one robot, from all corners together."""

from dataclasses import dataclass

import numpy as np
from scipy.stats import f

from stcal.errors import DegenerateError
from stcal.geometry.camera import intrinsic_basis
from stcal.geometry.normal_equations import generalised_inverse
from stcal.geometry.rigid import Rigid
from stcal.handeye.data.pairs import Loop, Setup
from stcal.handeye.data.rig import RigPoses
from stcal.handeye.methods.bundle import RigBundle, RigCorners
from stcal.handeye.methods.camera_error import CameraError, considered
from stcal.handeye.methods.noise import Noise, adjust
from stcal.handeye.methods.pose_adjustment import FALSE_ALARM, LEAST_POSES
from stcal.handeye.methods.reprojection import (
    CAMERA_GAIN,
    GROSS_RAD,
    GROSS_SHARE,
    UNKNOWN_LENS,
    Reprojection,
    board_of,
    camera_gain,
    contradicting,
    found_of,
    problem,
    scale_hint,
)

LEAST_VIEWS = 1
"""Least number of views of a camera. One image of a board gives the camera's place if other cameras give the
board's."""
MISSED = 3.0
"""Factor over the usual discrepancy between a view's own pose of the board and that of the others, from which the view
is doubted."""


@dataclass(frozen=True, slots=True, eq=False)
class AdjustedRig:
    """``state`` : of the poses used; ``used`` : which views of each camera were used; ``outliers`` : (m,) poses of the
    robot that contradict the others; ``covariance`` : (6c + 6, 6c + 6) of all X and Z; ``sigma_scale``; ``sigma`` : by
    group; ``estimated`` : groups whose σ were estimated; ``scale_hint`` : the scale if it were solved for, and its σ;
    ``camera_gain`` : (c,) fall of the cost per parameter if a camera's intrinsics were solved for; ``found`` : results
    of each camera; ``settled`` : whether the estimated σ settled."""

    state: RigBundle
    used: tuple[np.ndarray, ...]
    outliers: np.ndarray
    covariance: np.ndarray
    sigma_scale: float | None
    sigma: dict[str, float]
    estimated: tuple[str, ...]
    scale_hint: tuple[float, float]
    camera_gain: np.ndarray
    found: tuple[Reprojection, ...]
    settled: bool


def adjust_rig(
    given: RigPoses,
    setup: Setup,
    first: tuple[list[Rigid], Rigid, float],
    noise: Noise,
    refine: bool = False,
    with_scale: bool = False,
) -> AdjustedRig:
    """Returns the least-squares adjustment of all corners of all cameras from ``first`` X of each, Z, scale.

    It is like :func:`~stcal.handeye.methods.reprojection.adjust_views`. The error of each pose of the robot is one
    unknown, to which all images from that pose contribute, and σ of the robot is estimated over all images. Poses of
    the robot that contradict the others are left out, and so is an image that contradicts the others of the same pose.

    Raises
    ------
    ConvergenceError
        No minimum is reached.
    DegenerateError
        Fewer than three poses of the robot agree, or no view of a camera agrees.
    """
    loops = [Loop.of(given.pairs(i), setup) for i in range(len(given.cameras))]
    used = tuple(_near(loop, x, *first[1:]) for loop, x in zip(loops, first[0], strict=True))
    outliers = np.zeros(len(given), bool)
    while True:
        rows = _rows(given, used, outliers)
        corners, free = _problem(given, loops, used, rows, noise, refine, with_scale)
        cameras = tuple(camera.views.camera for camera in given.cameras)
        begin = RigBundle(
            tuple(first[0]), first[1], corners.base_from_flange, corners.each[0].xyz_board, cameras, first[2]
        )
        solution = adjust(corners, begin, free)
        corners, state = solution.corners, solution.state
        inverse = solution.linear.inverse()
        bad = contradicting(corners, state, inverse)
        if bad.any() and len(rows) - bad.sum() >= LEAST_POSES:
            outliers[rows[bad]] = True
            used = tuple(u & ~outliers[c.rows] for u, c in zip(used, given.cameras, strict=True))
            continue
        worst = _worst_view(given, used, rows, corners, state)
        if worst is None or used[worst[0]].sum() < LEAST_POSES:
            break
        used[worst[0]][worst[1]] = False
    error = None if refine else _considered(given, corners, state, free)
    at = corners.places()
    poses = inverse[: at["z"].stop, : at["z"].stop]
    results = []
    for i, camera in enumerate(given.cameras):
        columns, view = corners.columns(i)[: corners.each[i].kept()], np.full(len(given), -1)
        view[camera.rows[used[i]]] = np.flatnonzero(used[i])
        own, reported = inverse[np.ix_(columns, columns)], given.base_from_flange[camera.rows]
        results.append(found_of(corners.each[i], state.of(i), own, reported, view[rows], refine))
    return AdjustedRig(
        state=state,
        used=used,
        outliers=outliers,
        covariance=poses if error is None else error.covariance(poses),
        sigma_scale=float(np.sqrt(inverse[at["scale"], at["scale"]].item())) if with_scale else None,
        sigma={name: float(value) for name, value in corners.sigma.items() if value},
        estimated=free,
        scale_hint=scale_hint(corners, state),
        camera_gain=np.ones(len(given.cameras)) if refine else _camera_gains(corners, state),
        found=tuple(results),
        settled=solution.settled,
    )


def _near(loop: Loop, x: Rigid, z: Rigid, scale: float) -> np.ndarray:
    """Returns which views (v,) are not wrong from the start."""
    miss = loop.residuals(x, z, scale)
    far = np.linalg.norm(miss[:, 3:], axis=1) > GROSS_SHARE * np.linalg.norm(loop.camera_from_board.translation, axis=1)
    return ~(far | (np.linalg.norm(miss[:, :3], axis=1) > GROSS_RAD))


def _rows(given: RigPoses, used: tuple[np.ndarray, ...], outliers: np.ndarray) -> np.ndarray:
    """Returns the poses of the robot that are used in some view."""
    for camera, good in zip(given.cameras, used, strict=True):
        if good.sum() < LEAST_VIEWS:
            raise DegenerateError(
                "E-HANDEYE-DISAGREE",
                f"camera {camera.name}: none of {len(good)} views agrees with the other cameras; check its images, "
                "intrinsics, board and poses",
            )
    rows = np.unique(np.concatenate([camera.rows[good] for camera, good in zip(given.cameras, used, strict=True)]))
    if len(rows) < 3:
        raise DegenerateError(
            "E-HANDEYE-DISAGREE",
            f"{given.where}: {len(rows)} of {len(given) - int(outliers.sum())} poses of the robot agree, 3 needed; "
            "check that poses and images belong together, and the conventions of both",
        )
    return rows


def _problem(
    given: RigPoses,
    loops: list[Loop],
    used: tuple[np.ndarray, ...],
    rows: np.ndarray,
    noise: Noise,
    refine: bool,
    with_scale: bool,
) -> tuple[RigCorners, tuple[str, ...]]:
    """Returns the problem with the poses ``rows`` of the robot, and the groups whose σ are to be estimated."""
    cameras = [camera[corners] for camera, corners in zip(given.cameras, used, strict=True)]
    board, flange = board_of([camera.views for camera in cameras]), given.base_from_flange[rows]
    problems, free = [], []
    for camera, loop in zip(cameras, loops, strict=True):
        at = np.searchsorted(rows, camera.rows)
        prior = camera.prior if refine else None
        corners, names = problem(loop, flange, camera.views, noise, prior, with_scale, rows=at, designed=board)
        problems.append(corners)
        named = RigCorners((camera.name,), (corners,))
        free += [name for name in (*named.sigma, *named.factors()) if name.split(":")[0] in names]
    return RigCorners(tuple(camera.name for camera in cameras), tuple(problems)), tuple(dict.fromkeys(free))


def _considered(given: RigPoses, corners: RigCorners, state: RigBundle, free: tuple[str, ...]) -> CameraError | None:
    """Returns the effect of the intrinsics as filed; None where no prior of any camera is known."""
    known = {}
    for i, camera in enumerate(given.cameras):
        if camera.prior is not None:
            known[i] = intrinsic_basis(camera.prior.colmap_model), np.linalg.inv(camera.prior.covariance)
    return considered(corners.with_intrinsics(known), state, free) if known else None


def _camera_gains(corners: RigCorners, state: RigBundle) -> np.ndarray:
    """Returns (c,) :func:`~stcal.handeye.methods.reprojection.camera_gain` of each camera.

    The worst camera is tested by itself, the next with the intrinsics of the worst free, since a wrong camera draws the
    board and the robot of all to its side.
    """
    wrong: list[int] = []
    gains, before = np.ones(len(corners.each)), 0.0
    while len(wrong) < len(gains):
        gain = {}
        for i in set(range(len(gains))) - set(wrong):
            wider = corners.with_intrinsics(dict.fromkeys((*wrong, i), UNKNOWN_LENS))
            gain[i] = camera_gain(wider, state) - before
            gains[i] = gain[i]
        worst = max(gain, key=gain.__getitem__)
        if gain[worst] <= CAMERA_GAIN:
            break
        wrong.append(worst)
        before += gain[worst]
    return gains


def _worst_view(
    given: RigPoses, used: tuple[np.ndarray, ...], rows: np.ndarray, corners: RigCorners, state: RigBundle
) -> tuple[int, int] | None:
    """Returns the view (camera, its number) that contradicts the others most, by the gain of its corners from a pose of
    their own; None where all agree."""
    worst, most = None, 1.0
    for i, camera in enumerate(given.cameras):
        corners_of_camera, numbers = corners.each[i], np.flatnonzero(used[i])
        white, derivatives = corners_of_camera.seen(state.of(i))
        gains = []
        for row in np.searchsorted(rows, camera.rows[numbers]):
            in_view = corners_of_camera.view == row
            slope, miss = (
                derivatives["x"][in_view].reshape(-1, 6),
                white[in_view].ravel(),
            )  # moving X is moving the board in the view
            gains.append(float(miss @ slope @ generalised_inverse(slope.T @ slope) @ slope.T @ miss))
        # An error that all views of a camera share comes from its lens or the board: a view is judged by the others.
        usual = max(1.0, float(np.median(gains)) / 6)
        limit = 6 * MISSED * usual * f.ppf(1 - FALSE_ALARM / len(gains), 6, len(white))
        k = int(np.argmax(gains))
        if gains[k] / limit > most:
            worst, most = (i, int(numbers[k])), gains[k] / limit
    return worst
