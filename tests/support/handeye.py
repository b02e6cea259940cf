"""Simulated poses and corners with known truth, also of a robot that moves while its camera takes images, with two
clocks: for tests and studies."""

from dataclasses import dataclass
from decimal import Decimal

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Poses, Rigid
from stcal.handeye.data.corner_views import View, Views, pairs_of_views
from stcal.handeye.data.pose_pairs import HandEyePoses, Setup
from stcal.handeye.data.stream import Stream
from stcal.handeye.handeye_problem import HandEye, HandEyeOptions, HandEyeProblem

FLANGE_FROM_CAMERA = Rigid(Rotation.from_euler("zyx", [90, 4, -7], degrees=True).as_matrix(), [35.0, -62.0, 84.0])
BASE_FROM_BOARD = Rigid(Rotation.from_euler("zyx", [30, 176, 3], degrees=True).as_matrix(), [780.0, 120.0, 60.0])
BASE_FROM_CAMERA = Rigid(Rotation.from_euler("zyx", [80, -10, -115], degrees=True).as_matrix(), [1250.0, -150.0, 640.0])
FLANGE_FROM_BOARD = Rigid(Rotation.from_euler("zyx", [20, 178, 4], degrees=True).as_matrix(), [40.0, -55.0, 130.0])
CAMERA = Camera(1280, 1024, [1450.0, 1450.0], [639.5, 511.5], [-0.08, 0.05, 2e-4, -1e-4, 0, 0, 0, 0])


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """``pairs``, ``views`` : as measured; ``mount_from_camera``, ``stand_from_board`` : true; ``setup``."""

    pairs: HandEyePoses
    views: Views | None
    mount_from_camera: Rigid
    stand_from_board: Rigid
    setup: Setup


def simulated(
    rng: np.random.Generator,
    count: int = 15,
    setup: Setup = "eye-in-hand",
    robot: tuple[float, float] = (0.0, 0.0),
    camera: tuple[float, float] = (0.0, 0.0),
    tilt: float = 0.5,
) -> Truth:
    """Pose pairs; σ (rad, mm) of robot and camera are those of :class:`~stcal.handeye.Noise`; ``tilt`` in rad."""
    camera_from_board, base_from_flange, x, z = _poses(rng, count, setup, tilt)
    pairs = HandEyePoses(disturbed(rng, base_from_flange, *robot), disturbed(rng, camera_from_board, *camera))
    return Truth(pairs, None, x, z, setup)


def simulated_views(
    rng: np.random.Generator,
    count: int = 15,
    setup: Setup = "eye-in-hand",
    robot: tuple[float, float] = (0.0, 0.0),
    corner_px: float = 0.0,
    board_mm: float = 0.0,
    scale: float = 1.0,
    camera: Camera = CAMERA,
    tilt: float = 0.5,
) -> Truth:
    """Corners of a chessboard of 8×7 squares of 25 mm, whose corners are off by ``board_mm`` and whose size is off by
    ``scale``; the views state the designed ones."""
    camera_from_board, base_from_flange, x, z = _poses(rng, count, setup, tilt)
    xyz = board_corners(8, 7, 25.0)
    made = scale * xyz + rng.normal(0, 1, xyz.shape) * board_mm
    views = tuple(
        View(xyz, camera.project(pose @ made) + rng.normal(0, 1, (len(xyz), 2)) * corner_px)
        for pose in camera_from_board
    )
    views = Views(camera, views)
    return Truth(pairs_of_views(disturbed(rng, base_from_flange, *robot), views), views, x, z, setup)


def handeye(
    pairs: HandEyePoses,
    setup: Setup = "eye-in-hand",
    method: str | None = None,
    views: Views | None = None,
    options: HandEyeOptions | None = None,
) -> HandEye:
    """One method's result, with σ from its own residuals."""
    return HandEyeProblem(pairs, setup, views, options or HandEyeOptions()).solved(method).result


def error(found: HandEye, truth: Truth) -> np.ndarray:
    """Of X, (6,), as its covariance states it."""
    return found.mount_from_camera.difference(truth.mount_from_camera)


def squared(found: HandEye, truth: Truth) -> float:
    """eᵀ C⁻¹ e of X, six degrees of freedom."""
    off = error(found, truth)
    return float(off @ np.linalg.solve(found.covariance, off))


def normalised(errors, covariances) -> float:
    """RMS of errors in units of their covariances."""
    return float(np.sqrt(np.mean([e @ np.linalg.solve(c, e) for e, c in zip(errors, covariances, strict=True)]) / 6))


def board_corners(columns: int, rows: int, square_mm: float) -> np.ndarray:
    """Inner corners (k, 3) of a chessboard of so many squares, mm."""
    x, y = np.meshgrid(np.arange(1, columns), np.arange(1, rows))
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]) * square_mm


def disturbed(rng: np.random.Generator, poses: Poses, sigma_rad: float, sigma_mm: float) -> Poses:
    turn = Rotation.from_rotvec(rng.normal(0, 1, (len(poses), 3)) * sigma_rad).as_matrix()
    return Poses(turn @ poses.rotation, poses.translation + rng.normal(0, 1, (len(poses), 3)) * sigma_mm)


def _poses(rng: np.random.Generator, count: int, setup: Setup, tilt: float) -> tuple[Poses, Poses, Rigid, Rigid]:
    """True camera_from_board, base_from_flange, X and Z: the board about 450 mm away, tilted by up to ``tilt`` about
    both of its axes and turned by twice that about the optical axis."""
    turn = rng.uniform(-tilt, tilt, (count, 3)) * [1, 1, 2]
    place = rng.uniform(-1, 1, (count, 3)) * [50, 40, 100] + [-100, -87.5, 450]
    camera_from_board = Poses(Rotation.from_rotvec(turn).as_matrix(), place)
    in_hand = setup == "eye-in-hand"
    x, z = (FLANGE_FROM_CAMERA, BASE_FROM_BOARD) if in_hand else (BASE_FROM_CAMERA, FLANGE_FROM_BOARD)
    mount_from_stand = x @ camera_from_board @ z.inverse()
    return camera_from_board, mount_from_stand.inverse() if in_hand else mount_from_stand, x, z


SECONDS = 24.0  # that the robot moves
TURN_RAD, WAY_MM = np.array([0.5, 0.45, 0.5]), np.array([90.0, 80.0, 120.0])
TURN_RATE, WAY_RATE = np.array([1.1, 0.9, 0.7]), np.array([0.8, 1.3, 1.0])
MIDDLE_MM = np.array([-100.0, -87.5, 500.0])
SAMPLE = 2e-5, 0.01  # σ (rad, mm) of what a sample of the stream errs by


@dataclass(frozen=True, slots=True, eq=False)
class StreamTruth:
    """``stream`` of the robot's clock; ``pairs`` : at the images' stamps, without any offset; ``seconds`` : (m,) stamps
    after the stream's origin; ``offset_s`` : robot's clock minus camera's; ``mount_from_camera`` : true."""

    stream: Stream
    pairs: HandEyePoses
    seconds: np.ndarray
    offset_s: float
    mount_from_camera: Rigid
    setup: Setup


def swing(seconds: np.ndarray, phase: np.ndarray) -> Poses:
    """camera_from_board (k,) of a board that swings about all axes; ``phase`` : (2, 3)."""
    turn = TURN_RAD * np.sin(np.outer(seconds, TURN_RATE) + phase[0])
    way = MIDDLE_MM + WAY_MM * np.sin(np.outer(seconds, WAY_RATE) + phase[1])
    return Poses(Rotation.from_rotvec(turn).as_matrix(), way)


def simulated_stream(
    rng: np.random.Generator,
    count: int = 20,
    setup: Setup = "eye-in-hand",
    offset_s: float = 0.023,
    robot: tuple[float, float] = (3e-4, 0.1),
    camera: tuple[float, float] = (4e-4, 0.15),
    spacing_s: float = 0.02,
    still: bool = False,
) -> StreamTruth:
    """``robot``, ``camera`` : σ (rad, mm); ``still`` : the robot stops for half a second about every image."""
    phase, every = rng.uniform(0, 2 * np.pi, (2, 3)), np.arange(0, SECONDS, spacing_s)
    stamps = np.sort(rng.uniform(0.5, SECONDS - 1.0, count))

    x, z = (FLANGE_FROM_CAMERA, BASE_FROM_BOARD) if setup == "eye-in-hand" else (BASE_FROM_CAMERA, FLANGE_FROM_BOARD)

    def moving(seconds: np.ndarray) -> Poses:
        if still:
            seconds = stamps[np.abs(seconds[:, None] - stamps).argmin(1)]
        mount_from_stand = x @ swing(seconds, phase) @ z.inverse()
        return mount_from_stand.inverse() if setup == "eye-in-hand" else mount_from_stand

    stream = disturbed(rng, moving(every), *SAMPLE)
    there = moving(stamps if still else stamps + offset_s)
    was = disturbed(rng, there, *robot)
    mount_from_stand = was.inverse() if setup == "eye-in-hand" else was
    seen = disturbed(rng, x.inverse() @ mount_from_stand @ z, *camera)
    times = [Decimal(repr(round(float(t), 6))) for t in every]
    own = Stream.of(times, stream, "robot.csv")
    return StreamTruth(own, HandEyePoses(own.at(stamps), seen), stamps, offset_s, x, setup)
