"""Result of a rig's calibration."""

from dataclasses import dataclass, replace

import numpy as np

from stcal.errors import InputError
from stcal.geometry.arrays import frozen
from stcal.geometry.rigid import Rigid, skew
from stcal.handeye.data.loop import Setup
from stcal.handeye.result import HandEye

POSE = 6
"""Number of parameters of a pose."""


@dataclass(frozen=True, slots=True, eq=False)
class Rig:
    """Poses of c cameras of one robot, from one adjustment of all their corners.

    Parameters
    ----------
    names : tuple of str
        Names of the cameras.
    cameras : tuple of HandEye
        Result of each camera: its ``mount_from_camera`` with covariance, residuals and corners of its own views, and σ
        by which these were weighted. ``stand_from_board`` and σ of robot and board are the same for all cameras.
    covariance : (6c + 6, 6c + 6) array
        Covariance of all ``mount_from_camera`` in their order and of ``stand_from_board``: rotation (rad), translation
        (mm) of each, left perturbations.
    poses : tuple of str
        Names of the robot's poses.
    outliers : (m,) bool array
        Poses of the robot that contradict the others.
    notes : tuple of str
        Notes on the rig as a whole, one line each.
    """

    names: tuple[str, ...]
    cameras: tuple[HandEye, ...]
    covariance: np.ndarray
    poses: tuple[str, ...]
    outliers: np.ndarray
    notes: tuple[str, ...] = ()

    def __post_init__(self):
        size = POSE * (len(self.names) + 1)
        object.__setattr__(self, "covariance", frozen(self.covariance, (size, size), "covariance"))
        object.__setattr__(self, "outliers", frozen(self.outliers, (len(self.poses),), "outliers", bool))

    @property
    def setup(self) -> Setup:
        """Setup, which says what carries the cameras."""
        return self.cameras[0].setup

    @property
    def stand_from_board(self) -> Rigid:
        """Pose of the board, mm."""
        return self.cameras[0].stand_from_board

    def camera(self, name: str) -> HandEye:
        """Returns the result of one camera.

        Raises
        ------
        InputError
            No camera has this name.
        """
        return self.cameras[self._number(name)]

    def relative(self, first: str, second: str) -> tuple[Rigid, np.ndarray]:
        """Returns the pose of one camera in another, with its covariance.

        Parameters
        ----------
        first, second : str
            Names of two cameras.

        Returns
        -------
        Rigid
            first_from_second, mm.
        (6, 6) array
            Its covariance, rotation (rad) and translation (mm), left perturbation. It includes the correlation of the
            two ``mount_from_camera``: common errors due to board and robot cancel.

        Raises
        ------
        InputError
            No camera has this name.
        """
        i, j = self._number(first), self._number(second)
        x, y = self.cameras[i].mount_from_camera, self.cameras[j].mount_from_camera
        x_from_mount, jacobian = x.rotation.T, np.zeros((POSE, len(self.covariance)))
        # X and Y perturbed by u and w give exp(v) X⁻¹ Y: v is w − u in axes of X, plus u's turn times the lever arm.
        by_x, by_y = jacobian[:, POSE * i : POSE * i + POSE], jacobian[:, POSE * j : POSE * j + POSE]
        by_y[:3, :3] = by_y[3:, 3:] = x_from_mount
        by_x[:3, :3] -= x_from_mount
        by_x[3:, 3:] -= x_from_mount
        by_x[3:, :3] += x_from_mount @ skew(y.translation - x.translation)
        return x.inverse() @ y, jacobian @ self.covariance @ jacobian.T

    def widened(self, factor: float) -> "Rig":
        """Returns the rig with all σ of the transforms multiplied by ``factor``."""
        cameras = tuple(camera.widened(factor) for camera in self.cameras)
        return replace(self, cameras=cameras, covariance=factor**2 * self.covariance)

    def all_notes(self) -> tuple[str, ...]:
        """Returns the notes on the rig, then those on each camera under its name."""
        of_cameras = (
            type(n)(f"{name}: {n}") for name, c in zip(self.names, self.cameras, strict=True) for n in c.notes
        )
        return (*self.notes, *of_cameras)

    def _number(self, name: str) -> int:
        if name not in self.names:
            raise InputError("E-RIG-NO-CAMERA", f"rig: no camera {name!r}; one of {', '.join(self.names)} needed")
        return self.names.index(name)
