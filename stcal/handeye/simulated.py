"""Simulated pose pairs with known truth, for tests and studies."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.geometry.rigid import Poses, Rigid
from stcal.handeye.loop import Setup
from stcal.handeye.pairs import HandEyePoses

FLANGE_FROM_CAMERA = Rigid(Rotation.from_euler("zyx", [90, 4, -7], degrees=True).as_matrix(), [35.0, -62.0, 84.0])
BASE_FROM_BOARD = Rigid(Rotation.from_euler("zyx", [30, 176, 3], degrees=True).as_matrix(), [780.0, 120.0, 60.0])
BASE_FROM_CAMERA = Rigid(Rotation.from_euler("zyx", [80, -10, -115], degrees=True).as_matrix(), [1250.0, -150.0, 640.0])
FLANGE_FROM_BOARD = Rigid(Rotation.from_euler("zyx", [20, 178, 4], degrees=True).as_matrix(), [40.0, -55.0, 130.0])


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """``pairs`` : as measured; ``mount_from_camera``, ``stand_from_board`` : true."""

    pairs: HandEyePoses
    mount_from_camera: Rigid
    stand_from_board: Rigid


def simulated(
    rng: np.random.Generator,
    count: int = 15,
    setup: Setup = "eye-in-hand",
    robot: tuple[float, float] = (0.0, 0.0),
    camera: tuple[float, float] = (0.0, 0.0),
    tilt: float = 0.5,
) -> Truth:
    """Poses that look at the board from about 450 mm, tilted by up to ``tilt`` rad about random axes and turned about
    the optical axis; σ (rad, mm) of robot and camera are those of :class:`~stcal.handeye.noise.Noise`."""
    turn = rng.uniform(-tilt, tilt, (count, 3)) * [1, 1, 2]
    place = rng.uniform(-1, 1, (count, 3)) * [60, 60, 100] + [0, 0, 450]
    camera_from_board = Poses(Rotation.from_rotvec(turn).as_matrix(), place)
    in_hand = setup == "eye-in-hand"
    x, z = (FLANGE_FROM_CAMERA, BASE_FROM_BOARD) if in_hand else (BASE_FROM_CAMERA, FLANGE_FROM_BOARD)
    mount_from_stand = x @ camera_from_board @ z.inverse()
    base_from_flange = mount_from_stand.inverse() if in_hand else mount_from_stand
    pairs = HandEyePoses(disturbed(rng, base_from_flange, *robot), disturbed(rng, camera_from_board, *camera))
    return Truth(pairs, x, z)


def disturbed(rng: np.random.Generator, poses: Poses, sigma_rad: float, sigma_mm: float) -> Poses:
    """With Gaussian left perturbations."""
    turn = Rotation.from_rotvec(rng.normal(0, 1, (len(poses), 3)) * sigma_rad).as_matrix()
    return Poses(turn @ poses.rotation, poses.translation + rng.normal(0, 1, (len(poses), 3)) * sigma_mm)
