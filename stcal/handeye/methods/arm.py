"""An arm whose parameters are solved for beside hand and eye: how its flange moves by them."""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.geometry.rigid import Poses, skew

SETTLED_MM = 1e-3
"""Motion of a flange by a round of linear steps that leaves squares of it only."""
ROUNDS = 10
PARTS = ("arm_rad", "arm_mm")
"""σ of the parameters about the arm's file: of directions, and of places of axes."""


class ArmModel(Protocol):
    """k parameters, small motions of the axes, 0 where the arm is as its file says, and m joint vectors."""

    @property
    def angles(self) -> np.ndarray:
        """(k,) of bool: which parameters are rad; the others are mm."""
        ...

    def poses(self, parameters: np.ndarray) -> Poses:
        """base_from_flange, m."""
        ...

    def slope(self, parameters: np.ndarray) -> np.ndarray:
        """(m, 6, k) of :meth:`poses`, left perturbation, by a small further motion of the axes where they are then."""
        ...

    def __getitem__(self, rows: Any) -> "ArmModel":
        """With those joint vectors."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class LinearArm:
    """About ``parameters`` (k,): ``slope`` (m, 6, k) of the flange's poses by a step of them; ``angles`` : (k,)."""

    parameters: np.ndarray
    slope: np.ndarray
    angles: np.ndarray

    @classmethod
    def about(cls, arm: ArmModel, parameters: np.ndarray) -> "LinearArm":
        """Of a model."""
        return cls(parameters, arm.slope(parameters), arm.angles)

    def __getitem__(self, rows) -> "LinearArm":
        """With those poses."""
        return LinearArm(self.parameters, self.slope[rows], self.angles)

    def moved(self, base_from_flange: Poses, step: np.ndarray) -> Poses:
        """Poses (m) of the flange at the parameters, after a step (k,) of them."""
        by = self.slope @ step
        turn = Rotation.from_rotvec(by[:, :3]).as_matrix()
        return Poses(turn @ base_from_flange.rotation, base_from_flange.translation + by[:, 3:])

    def slope_after(self, step: np.ndarray) -> np.ndarray:
        """(m, 6, k) derivative of :meth:`moved`, left perturbation: rotation vectors do not add."""
        turn = np.einsum("mak,k->ma", self.slope[:, :3], step)
        cross = skew(turn)
        to_left = np.eye(3) + cross / 2 + cross @ cross / 6  # of turns of some mrad
        return np.concatenate([to_left @ self.slope[:, :3], self.slope[:, 3:]], axis=1)

    def parts(self) -> dict[str, np.ndarray]:
        """Rows of the parameters of each of :data:`PARTS` there are."""
        of = dict(zip(PARTS, (np.flatnonzero(self.angles), np.flatnonzero(~self.angles)), strict=True))
        return {name: rows for name, rows in of.items() if len(rows)}

    def moves_mm(self, step: np.ndarray) -> float:
        """By how much the step (k,) moves a flange at most."""
        return float(np.linalg.norm(self.slope[:, 3:] @ step, axis=1).max())
