"""The one equation of both setups: stand_from_mount · mount_from_camera · camera_from_board = stand_from_board.

The *mount* carries the camera, the *stand* carries the board:

============  ========  ========  =====================  =====================
setup         mount     stand     mount_from_camera, X   stand_from_board, Z
============  ========  ========  =====================  =====================
eye-in-hand   flange    base      flange_from_camera     base_from_board
eye-to-hand   base      flange    base_from_camera       flange_from_board
============  ========  ========  =====================  =====================

X and Z are the same for all poses. Two poses give AX = XB with A = mount_j_from_mount_i and B = camera_j_from_camera_i.
One pose gives AX = ZB with A = mount_from_stand, B = board_from_camera and the roles of the two unknowns exchanged.
"""

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from stcal.errors import InputError
from stcal.geometry.rigid import Poses, Rigid, skew
from stcal.handeye.data.pairs import HandEyePoses, inverse_jacobian

Setup = Literal["eye-in-hand", "eye-to-hand"]
SETUPS: tuple[str, ...] = get_args(Setup)


@dataclass(frozen=True, slots=True)
class Frames:
    """Names of the frame that carries the camera and of the frame that carries the board."""

    mount: str
    stand: str

    @property
    def camera(self) -> str:
        """Name of mount_from_camera."""
        return f"{self.mount}_from_camera"

    @property
    def board(self) -> str:
        """Name of stand_from_board."""
        return f"{self.stand}_from_board"


FRAMES = {"eye-in-hand": Frames("flange", "base"), "eye-to-hand": Frames("base", "flange")}


@dataclass(frozen=True, slots=True, eq=False)
class Loop:
    """m pose pairs in the terms of the one equation.

    ``inverted`` : whether stand_from_mount is the inverse of what the robot reports, base_from_flange;
    ``robot_covariance``, ``camera_covariance`` : (m, 6, 6) of base_from_flange and camera_from_board, where known.
    """

    stand_from_mount: Poses
    camera_from_board: Poses
    inverted: bool = False
    robot_covariance: np.ndarray | None = None
    camera_covariance: np.ndarray | None = None

    @classmethod
    def of(cls, pairs: HandEyePoses, setup: Setup) -> "Loop":
        """Returns the loop of pairs in one of the setups."""
        if setup not in SETUPS:
            raise InputError("E-HANDEYE-SETUP", f"hand-eye: setup {setup!r}; {' or '.join(SETUPS)} needed")
        inverted = setup == "eye-to-hand"
        hand = pairs.base_from_flange.inverse() if inverted else pairs.base_from_flange
        covariances = (pairs.base_from_flange_covariance, pairs.camera_from_board_covariance)
        return cls(hand, pairs.camera_from_board, inverted, *covariances)

    def __len__(self) -> int:
        return len(self.stand_from_mount)

    def __getitem__(self, index) -> "Loop":
        """Returns the pairs selected by a mask, slice or list."""
        covariances = (None if c is None else c[index] for c in (self.robot_covariance, self.camera_covariance))
        return Loop(self.stand_from_mount[index], self.camera_from_board[index], self.inverted, *covariances)

    def chain(self, mount_from_camera: Rigid, scale: float = 1.0) -> Poses:
        """Returns stand_from_board by each pose; the camera's lengths are multiplied by ``scale``."""
        camera = self.camera_from_board
        if scale != 1:
            camera = Poses(camera.rotation, scale * camera.translation)
        return self.stand_from_mount @ mount_from_camera @ camera

    def residuals(self, mount_from_camera: Rigid, stand_from_board: Rigid, scale: float = 1.0) -> np.ndarray:
        """Returns the residuals of the chains against ``stand_from_board``, (m, 6): rad, and mm at the board's origin;
        stand axes."""
        chain = self.chain(mount_from_camera, scale)
        return chain.difference(Poses.of([stand_from_board] * len(self)))

    def jacobian(self, mount_from_camera: Rigid, scale: float = 1.0) -> np.ndarray:
        """Returns the derivative (m, 6, 13) of :meth:`residuals` by left perturbations of X and Z, and by the scale.

        The dependence of the rotation's derivative on the size of the residual is neglected. Its contribution to the
        gradient of a squared rotation residual is zero, since φ × φ = 0.
        """
        to_stand = self.stand_from_mount.rotation
        arm = self.camera_from_board.translation @ mount_from_camera.rotation.T
        derivative = np.zeros((len(self), 6, 13))
        derivative[:, :3, :3] = derivative[:, 3:, 3:6] = to_stand
        derivative[:, 3:, :3] = -to_stand @ skew(scale * arm)
        derivative[:, :, 6:12] = -np.eye(6)
        derivative[:, 3:, 12] = np.einsum("mij,mj->mi", to_stand, arm)
        return derivative

    def by_camera(self, mount_from_camera: Rigid, scale: float = 1.0) -> np.ndarray:
        """Returns the derivative (m, 6, 6) of :meth:`residuals` by left perturbations of camera_from_board."""
        to_stand = self.stand_from_mount.rotation @ mount_from_camera.rotation
        derivative = np.zeros((len(self), 6, 6))
        derivative[:, :3, :3], derivative[:, 3:, 3:] = to_stand, scale * to_stand
        return derivative

    def by_robot(self, mount_from_camera: Rigid, scale: float = 1.0) -> np.ndarray:
        """Returns the derivative (m, 6, 6) of :meth:`residuals` by left perturbations of base_from_flange."""
        derivative = np.tile(np.eye(6), (len(self), 1, 1))
        arm = self.chain(mount_from_camera, scale).translation - self.stand_from_mount.translation
        derivative[:, 3:, :3] = -skew(arm)
        return derivative @ inverse_jacobian(self.stand_from_mount.inverse()) if self.inverted else derivative
