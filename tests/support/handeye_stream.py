"""A simulated robot that moves while its camera takes images, with two clocks, for tests and studies."""

from dataclasses import dataclass
from decimal import Decimal

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.geometry.rigid import Poses, Rigid
from stcal.handeye.data.pose_pairs import HandEyePoses, Setup
from stcal.handeye.data.stream import Stream
from tests.support.handeye import BASE_FROM_BOARD, BASE_FROM_CAMERA, FLANGE_FROM_BOARD, FLANGE_FROM_CAMERA, disturbed

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
