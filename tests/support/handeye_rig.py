"""Simulated rigs of several cameras with known truth, for tests and studies."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.geometry.camera import Camera
from stcal.geometry.rigid import Rigid
from stcal.handeye.data.pairs import Setup
from stcal.handeye.data.views import RigCamera, RigPoses, View, Views
from stcal.io.cameras.model import CameraPrior
from tests.support.handeye import CAMERA, board_corners, disturbed, simulated

WIDE = Camera(1600, 1200, [1250.0, 1248.0], [805.0, 590.0], [-0.11, 0.06, -1e-4, 3e-4, 0, 0, 0, 0])
FIRST_FROM = (
    Rigid(),
    Rigid(Rotation.from_rotvec([0.02, -0.22, 0.05]).as_matrix(), [95.0, 8.0, 6.0]),
    Rigid(Rotation.from_rotvec([-0.18, 0.05, 1.6]).as_matrix(), [-30.0, 90.0, -12.0]),
)
"""Poses of the cameras in the first one."""
NAMES = ("left", "right", "up")


@dataclass(frozen=True, slots=True, eq=False)
class RigTruth:
    """``given`` : as measured; ``mount_from_camera`` : (c,) true, ``stand_from_board``; ``setup``."""

    given: RigPoses
    mount_from_camera: tuple[Rigid, ...]
    stand_from_board: Rigid
    setup: Setup


def simulated_rig(
    rng: np.random.Generator,
    count: int = 12,
    setup: Setup = "eye-in-hand",
    cameras: int = 3,
    robot: tuple[float, float] = (0.0, 0.0),
    corner_px: tuple[float, ...] = (0.0, 0.0, 0.0),
    board_mm: float = 0.0,
    seen: float = 1.0,
    prior: CameraPrior | None = None,
) -> RigTruth:
    """Two or three cameras that see a chessboard of 8×7 squares of 25 mm, each a share ``seen`` of the robot's poses;
    ``robot`` : σ (rad, mm) of one error for each of the robot's poses; ``prior`` : what is stated of each camera."""
    exact = simulated(rng, count, setup)
    flange, z = exact.pairs.base_from_flange, exact.stand_from_board
    mounts = tuple(exact.mount_from_camera @ FIRST_FROM[i] for i in range(cameras))
    mount_from_stand = flange if setup == "eye-to-hand" else flange.inverse()
    xyz = board_corners(8, 7, 25.0)
    made = xyz + rng.normal(0, 1, xyz.shape) * board_mm
    every = []
    for i, x in enumerate(mounts):
        lens = CAMERA if i % 2 == 0 else WIDE
        poses = x.inverse() @ mount_from_stand @ z
        rows = np.sort(rng.permutation(count)[: max(3, round(seen * count))])
        views = tuple(
            View(xyz, lens.project(poses[int(r)] @ made) + rng.normal(0, 1, (len(xyz), 2)) * corner_px[i]) for r in rows
        )
        images = tuple(f"{NAMES[i]}/{r}.png" for r in rows)
        every.append(RigCamera(NAMES[i], Views(lens, views), rows, images, prior))
    return RigTruth(RigPoses(disturbed(rng, flange, *robot), tuple(every)), mounts, z, setup)
