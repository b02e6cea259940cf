"""What a rig's calibration returns."""

from dataclasses import dataclass, replace

import numpy as np

from stcal.errors import InputError
from stcal.geometry.arrays import frozen
from stcal.geometry.rigid import Rigid, skew
from stcal.handeye.data.loop import Setup
from stcal.handeye.result import HandEye

POSE = 6
"""Numbers of a pose."""


@dataclass(frozen=True, slots=True, eq=False)
class Rig:
    """Where c cameras of one robot are, from one adjustment of all their corners.

    Parameters
    ----------
    names : tuple of str
        Of the cameras.
    cameras : tuple of HandEye
        Each camera's part: its ``mount_from_camera`` with covariance, residuals and corners of its own views, and σ by
        which these were weighted; ``stand_from_board`` and σ of robot and board are the same in all.
    covariance : (6c + 6, 6c + 6) array
        Of all ``mount_from_camera`` in their order and of ``stand_from_board``: rotation (rad), translation (mm) of
        each, left perturbations.
    poses : tuple of str
        Names of the robot's poses.
    outliers : (m,) bool array
        Poses of the robot that contradict the others.
    notes : tuple of str
        What should be known about the rig as a whole, one line each.
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
        """What carries the cameras."""
        return self.cameras[0].setup

    @property
    def stand_from_board(self) -> Rigid:
        """Where the board is, mm."""
        return self.cameras[0].stand_from_board

    def camera(self, name: str) -> HandEye:
        """The part of one camera.

        Raises
        ------
        InputError
            No camera is called so.
        """
        return self.cameras[self._number(name)]

    def relative(self, first: str, second: str) -> tuple[Rigid, np.ndarray]:
        """Pose of one camera in another.

        Parameters
        ----------
        first, second : str
            Names of two cameras.

        Returns
        -------
        Rigid
            first_from_second, mm.
        (6, 6) array
            Its covariance, rotation (rad) and translation (mm), left perturbation, with the correlation of the two
            ``mount_from_camera``: what board and robot do to both alike cancels.

        Raises
        ------
        InputError
            No camera is called so.
        """
        i, j = self._number(first), self._number(second)
        x, y = self.cameras[i].mount_from_camera, self.cameras[j].mount_from_camera
        back, by = x.rotation.T, np.zeros((POSE, len(self.covariance)))
        # exp(v) X⁻¹ Y of X and Y moved by u and w: v = Ad-like of w − u, and the arm between the two for u's turn.
        of_x, of_y = by[:, POSE * i : POSE * i + POSE], by[:, POSE * j : POSE * j + POSE]
        of_y[:3, :3] = of_y[3:, 3:] = back
        of_x[:3, :3] -= back
        of_x[3:, 3:] -= back
        of_x[3:, :3] += back @ skew(y.translation - x.translation)
        return x.inverse() @ y, by @ self.covariance @ by.T

    def widened(self, factor: float) -> "Rig":
        """With all σ of the transforms times ``factor``."""
        cameras = tuple(camera.widened(factor) for camera in self.cameras)
        return replace(self, cameras=cameras, covariance=factor**2 * self.covariance)

    def all_notes(self) -> tuple[str, ...]:
        """On the rig, then on each camera by its name."""
        own = (type(n)(f"{name}: {n}") for name, c in zip(self.names, self.cameras, strict=True) for n in c.notes)
        return (*self.notes, *own)

    def _number(self, name: str) -> int:
        if name not in self.names:
            raise InputError("E-RIG-NO-CAMERA", f"rig: no camera {name!r}; one of {', '.join(self.names)} needed")
        return self.names.index(name)
