"""Which robot poses would lower the worst σ of a hand-eye transform most."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.errors import InputError
from stcal.geometry.arrays import frozen
from stcal.geometry.camera import Camera
from stcal.geometry.normal_equations import generalised_inverse
from stcal.geometry.rigid import Poses, Rigid, skew
from stcal.handeye.data.loop import Loop
from stcal.handeye.data.pairs import HandEyePoses
from stcal.handeye.result import HandEye

CANDIDATES = 2000
"""Views of the board that are looked at for each pose that is named."""
ASKED = 64
"""Poses at a time of which is asked whether the robot reaches them."""
MOST_TILT = np.radians(40)
"""Of the board against the line of sight: beyond, dots and corners lose accuracy."""
MARGIN = 0.1
"""Of the image's sides that the board's outermost points keep off the border."""
ABOUT = 0.25
"""Points at which σ is judged lie so many distances of the board about it, and at it."""


@dataclass(frozen=True, slots=True, eq=False)
class NextPoses:
    """k poses to take next, in order.

    Parameters
    ----------
    base_from_flange : Poses
        Where the flange is to be, mm.
    camera_from_board : Poses
        How the camera would see the board there, mm.
    sigma_mm : (k + 1,) array
        Worst σ of a point at the board by the transform: now, and after each of them.
    turn_rad : (k,) array
        Rotation of the flange against the pose of those taken that is nearest in rotation.
    """

    base_from_flange: Poses
    camera_from_board: Poses
    sigma_mm: np.ndarray
    turn_rad: np.ndarray

    def __post_init__(self):
        k = len(self.base_from_flange)
        object.__setattr__(self, "sigma_mm", frozen(self.sigma_mm, (k + 1,), "σ"))
        object.__setattr__(self, "turn_rad", frozen(self.turn_rad, (k,), "turns"))


def plan_poses(
    pairs: HandEyePoses,
    result: HandEye,
    count: int = 3,
    outline: np.ndarray | None = None,
    camera: Camera | None = None,
    reachable: Callable[[Poses], np.ndarray] | None = None,
    seed: int = 0,
) -> NextPoses:
    """The poses that lower the worst σ of a point at the board most, one after the other.

    Candidates show the board as near and as far as it was seen, tilted by up to 40° and turned about the line of sight
    at will; each adds its information, with the σ of robot and camera that the result states or estimated, to that of
    the poses taken (so that the wide rotations of Tsai & Lenz 1989 come out by themselves). σ are of independent errors
    of the poses alone: without what the camera file errs, and without the scatter of :func:`~.scatter.scatter`, which
    further poses do not lower alike.

    Parameters
    ----------
    pairs : HandEyePoses
        Taken so far.
    result : HandEye
        Of them.
    count : int
        Poses wanted.
    outline : (n, 3) array, optional
        Points of the board that are to be in the image, mm; its origin where None.
    camera : Camera, optional
        Whose image they are to be in; without it they stay where the board's origin was seen.
    reachable : callable, optional
        Which of base_from_flange (n poses) the robot reaches, (n,) bool; all where None. It is asked for
        :data:`ASKED` at a time, the best first.
    seed : int
        Of the candidates.

    Returns
    -------
    NextPoses

    Raises
    ------
    InputError
        The result has no covariance, or no candidate is reachable with the board in view.
    """
    if result.covariance is None:
        raise InputError("E-PLAN-NO-SIGMA", f"plan: {result.method} gives no σ; give a result of pose or reprojection")
    kept = np.flatnonzero(~result.outliers)
    loop = Loop.of(pairs, result.setup)[kept]
    errors, rng = _Errors.of(loop, result), np.random.default_rng(seed)
    x, z = result.mount_from_camera, result.stand_from_board
    normal = _information(loop, errors, result).sum(0)
    eye = loop.camera_from_board
    seen = Poses(eye.rotation, result.scale * eye.translation)
    outline = np.zeros((1, 3)) if outline is None else result.scale * np.asarray(outline, float)
    points = judged_at(seen.rotation @ outline.mean(0) + seen.translation)
    sigma, flanges, views, turns = [worst_sigma(normal, x, points)], [], [], []
    taken = pairs.base_from_flange.rotation[kept]
    for _ in range(count):
        ahead = _views(rng, seen, outline, camera)
        stand_from_mount = z @ ahead.inverse() @ x.inverse()
        flange = stand_from_mount.inverse() if loop.inverted else stand_from_mount
        if not len(flange):
            raise InputError(
                "E-PLAN-NO-VIEW",
                f"plan: none of {CANDIDATES} views as near and as far as the board was seen holds all of it and "
                f"{MARGIN:.0%} of the image around; take it from farther away, or give a smaller board",
            )
        unscaled = Poses(ahead.rotation, ahead.translation / result.scale)
        each = normal + _information(Loop(stand_from_mount, unscaled, loop.inverted), errors, result)
        after = np.array([worst_sigma(own, x, points) for own in each])
        row = _first_reachable(flange, np.argsort(after), reachable)
        normal = each[row]
        sigma.append(float(after[row]))
        flanges.append(flange[row])
        views.append(ahead[row])
        cosine = (np.einsum("mab,ab->m", taken, flange.rotation[row]) - 1) / 2
        turns.append(float(np.arccos(np.clip(cosine, -1, 1)).min()))
        taken = np.concatenate([taken, flange.rotation[row][None]])
    return NextPoses(Poses.of(flanges), Poses.of(views), np.array(sigma), np.array(turns))


def worst_sigma(normal: np.ndarray, mount_from_camera: Rigid, points: np.ndarray) -> float:
    """Largest σ, mm, in any direction, of points (n, 3) in the camera's frame that are carried to the mount."""
    covariance = generalised_inverse(normal)[:6, :6]
    by = np.zeros((len(points), 3, 6))
    by[:, :, :3], by[:, :, 3:] = -skew(points @ mount_from_camera.rotation.T), np.eye(3)
    return float(np.sqrt(np.linalg.eigvalsh(by @ covariance @ np.swapaxes(by, 1, 2)).max()))


def _first_reachable(flange: Poses, order: np.ndarray, reachable: Callable[[Poses], np.ndarray] | None) -> int:
    """Row of the first pose, in this order (n,), that the robot reaches."""
    if reachable is None:
        return int(order[0])
    for start in range(0, len(order), ASKED):
        part = order[start : start + ASKED]
        within = np.flatnonzero(reachable(flange[part]))
        if len(within):
            return int(part[within[0]])
    raise InputError(
        "E-PLAN-OUT-OF-REACH",
        f"plan: none of {len(flange)} views of the whole board is in the robot's reach; check robot file, board and "
        "setup",
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Errors:
    """Covariances (6, 6) of a pose of the flange and of one of the board."""

    robot: np.ndarray
    camera: np.ndarray

    @classmethod
    def of(cls, loop: Loop, result: HandEye) -> "_Errors":
        """As stated with the poses, their mean, or as the result states or estimated them."""
        sigma = result.sigma
        robot, camera = (
            np.diag(np.square([sigma.get(f"{side}_rad", 0.0)] * 3 + [sigma.get(f"{side}_mm", 0.0)] * 3))
            for side in ("robot", "camera")
        )
        if loop.robot_covariance is not None and "robot_rad" not in sigma:
            robot = loop.robot_covariance.mean(0)
        if loop.camera_covariance is not None:
            camera = sigma.get("camera_factor", 1.0) ** 2 * loop.camera_covariance.mean(0)
        return cls(robot, camera)


def _information(loop: Loop, errors: _Errors, result: HandEye) -> np.ndarray:
    """(m, 12, 12) of each pose about X and Z."""
    x, scale = result.mount_from_camera, result.scale
    robot, camera = loop.by_robot(x, scale), loop.by_camera(x, scale)
    spread = robot @ errors.robot @ np.swapaxes(robot, 1, 2) + camera @ errors.camera @ np.swapaxes(camera, 1, 2)
    jacobian = loop.jacobian(x, scale)[:, :, :12]
    return np.swapaxes(jacobian, 1, 2) @ np.linalg.solve(spread, jacobian)


def judged_at(board_mm: np.ndarray) -> np.ndarray:
    """Points (7, 3) in the camera's frame at which σ is judged: the board's mean place (m, 3), and about it."""
    middle = board_mm.mean(0)
    reach = ABOUT * float(np.linalg.norm(board_mm, axis=1).mean())
    return middle + reach * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])


def _views(rng: np.random.Generator, seen: Poses, outline: np.ndarray, camera: Camera | None) -> Poses:
    """Views of the board (camera_from_board): its middle as near and far as it was seen, tilted and turned."""
    middle = outline.mean(0)
    places = seen.rotation @ middle + seen.translation
    distance = np.linalg.norm(places, axis=1)
    if camera is None:
        sight = places[rng.integers(len(places), size=CANDIDATES)]
    else:
        size = np.array([camera.width, camera.height])
        pixel = rng.uniform(MARGIN * size, (1 - MARGIN) * size, (CANDIDATES, 2))
        sight = np.column_stack([camera.normalised_from_pixel(pixel), np.ones(CANDIDATES)])
    sight = sight / np.linalg.norm(sight, axis=1)[:, None]
    place = rng.uniform(distance.min(), distance.max(), (CANDIDATES, 1)) * sight
    # As it was seen once, then turned about the line of sight, and tilted from where it faces the camera.
    of = rng.integers(len(seen), size=CANDIDATES)
    facing = seen.rotation[of, :, 2] * np.sign(np.einsum("ma,ma->m", seen.rotation[of, :, 2], places[of]))[:, None]
    straight = _turned_onto(facing, sight) @ seen.rotation[of]
    roll = Rotation.from_rotvec(rng.uniform(-np.pi, np.pi, (CANDIDATES, 1)) * sight).as_matrix()
    across = np.cross(sight, rng.normal(size=(CANDIDATES, 3)))
    across /= np.linalg.norm(across, axis=1)[:, None]
    tilt = Rotation.from_rotvec(rng.uniform(0, MOST_TILT, (CANDIDATES, 1)) * across).as_matrix()
    rotation = tilt @ roll @ straight
    poses = Poses(rotation, place - rotation @ middle)
    if camera is None:
        return poses
    points = np.einsum("mab,nb->mna", poses.rotation, outline) + poses.translation[:, None]
    front = (points[..., 2] > 0).all(1)
    pixels = camera.project(points[front].reshape(-1, 3)).reshape(-1, len(outline), 2)
    inside = ((pixels >= MARGIN * size) & (pixels <= (1 - MARGIN) * size)).all((1, 2))
    return poses[np.flatnonzero(front)[inside]]


def _turned_onto(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """(m, 3, 3) the smallest rotations that turn unit vectors (m, 3) onto others (m, 3)."""
    axis = np.cross(first, second)
    sine = np.linalg.norm(axis, axis=1)
    angle = np.arctan2(sine, np.einsum("ma,ma->m", first, second))
    return Rotation.from_rotvec(axis / np.maximum(sine, 1e-300)[:, None] * angle[:, None]).as_matrix()
