"""An arm whose parameters are solved for together with X and Z: the motion of its flange by these parameters."""

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.geometry.rigid import Poses, skew

SETTLED_MM = 1e-3
"""Largest motion of a flange in a round of linear steps, in mm, after which only squares of the motion are
neglected."""
ROUNDS = 10
PARTS = ("arm_rad", "arm_mm")
"""Groups of σ of the parameters about the arm's file: directions of axes, and places of axes."""


@runtime_checkable
class ArmModel(Protocol):
    """An arm with k parameters and m joint vectors. The parameters are small motions of the axes, 0 where the arm is as
    its file says."""

    @property
    def angles(self) -> np.ndarray:
        """Boolean array (k,): True for parameters in rad, False for those in mm."""
        ...

    def poses(self, parameters: np.ndarray) -> Poses:
        """Returns base_from_flange, m poses."""
        ...

    def slope(self, parameters: np.ndarray) -> np.ndarray:
        """Returns the derivative (m, 6, k) of :meth:`poses`, left perturbation, by a small further motion of the axes
        about their places at ``parameters``."""
        ...

    def __getitem__(self, rows: Any) -> "ArmModel":
        """Returns the arm with these joint vectors alone."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class LinearArm:
    """An arm linearised about ``parameters`` (k,). ``slope`` : (m, 6, k) derivative of the flange's poses by the
    parameters; ``angles`` : (k,)."""

    parameters: np.ndarray
    slope: np.ndarray
    angles: np.ndarray

    @classmethod
    def about(cls, arm: ArmModel, parameters: np.ndarray) -> "LinearArm":
        """Returns the linearisation of a model."""
        return cls(parameters, arm.slope(parameters), arm.angles)

    def __getitem__(self, rows) -> "LinearArm":
        """Returns the linearisation with these poses alone."""
        return LinearArm(self.parameters, self.slope[rows], self.angles)

    def moved(self, base_from_flange: Poses, step: np.ndarray) -> Poses:
        """Returns the poses (m) of the flange after a step (k,) from the parameters."""
        motion = self.slope @ step
        turn = Rotation.from_rotvec(motion[:, :3]).as_matrix()
        return Poses(turn @ base_from_flange.rotation, base_from_flange.translation + motion[:, 3:])

    def slope_after(self, step: np.ndarray) -> np.ndarray:
        """Returns the derivative (m, 6, k) of :meth:`moved`, left perturbation. It depends on the step, since rotation
        vectors do not add."""
        turn = np.einsum("mak,k->ma", self.slope[:, :3], step)
        cross = skew(turn)
        to_left = np.eye(3) + cross / 2 + cross @ cross / 6  # series for rotations of some mrad
        return np.concatenate([to_left @ self.slope[:, :3], self.slope[:, 3:]], axis=1)

    def parts(self) -> dict[str, np.ndarray]:
        """Returns the rows of the parameters in each of :data:`PARTS` that has any."""
        rows_of_part = dict(zip(PARTS, (np.flatnonzero(self.angles), np.flatnonzero(~self.angles)), strict=True))
        return {name: rows for name, rows in rows_of_part.items() if len(rows)}

    def moves_mm(self, step: np.ndarray) -> float:
        """Returns the largest motion of a flange by the step (k,), in mm."""
        return float(np.linalg.norm(self.slope[:, 3:] @ step, axis=1).max())
