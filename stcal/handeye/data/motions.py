"""Motions between poses: A of the mount and B of the camera in AX = XB."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.errors import DegenerateError
from stcal.geometry.rigid import Poses
from stcal.handeye.data.loop import Loop

LARGEST_RAD = np.radians(170)
"""Angle beyond which the logarithm is ill-conditioned: at a half turn the smallest error reverses the axis."""


@dataclass(frozen=True, slots=True, eq=False)
class Motions:
    """k motions between two poses each.

    ``first``, ``second`` : (k,) poses i, j; ``mount`` : mount_j_from_mount_i, A; ``camera`` : camera_j_from_camera_i,
    B; ``alpha``, ``beta`` : (k, 3) their rotation vectors, rad.
    """

    first: np.ndarray
    second: np.ndarray
    mount: Poses
    camera: Poses
    alpha: np.ndarray
    beta: np.ndarray

    @classmethod
    def between(cls, loop: Loop, first: np.ndarray, second: np.ndarray) -> "Motions":
        """Returns the motions between poses ``first`` and ``second`` (k,) of a loop."""
        hand, eye = loop.stand_from_mount, loop.camera_from_board
        mount = hand[second].inverse() @ hand[first]
        camera = eye[second] @ eye[first].inverse()
        logs = (Rotation.from_matrix(np.array(p.rotation)).as_rotvec() for p in (mount, camera))
        return cls(np.asarray(first), np.asarray(second), mount, camera, *logs)

    @classmethod
    def consecutive(cls, loop: Loop) -> "Motions":
        """Returns the motions from each pose to the next."""
        at = np.arange(len(loop) - 1)
        return cls.between(loop, at, at + 1)

    @classmethod
    def all(cls, loop: Loop) -> "Motions":
        """Returns the motions between every pair of poses."""
        return cls.between(loop, *np.triu_indices(len(loop), 1))

    def __len__(self) -> int:
        return len(self.first)

    def __getitem__(self, index) -> "Motions":
        """Returns the motions selected by a mask, slice or list."""
        return Motions(*(getattr(self, name)[index] for name in self.__slots__))

    def has_log(self) -> np.ndarray:
        """Returns (k,) True where the logarithms of both rotations are well-conditioned."""
        return (np.linalg.norm(self.alpha, axis=1) < LARGEST_RAD) & (np.linalg.norm(self.beta, axis=1) < LARGEST_RAD)

    def with_log(self, method: str) -> "Motions":
        """Returns the motions that satisfy :meth:`has_log`.

        Raises
        ------
        DegenerateError
            Fewer than two motions do.
        """
        good = self.has_log()
        if good.sum() < 2:
            raise DegenerateError(
                "E-HANDEYE-LARGE-TURNS",
                f"hand-eye: {len(good) - good.sum()} of {len(good)} motions turn by more than "
                f"{np.degrees(LARGEST_RAD):.0f}°, {method} needs 2 that do not; use another method or order of poses",
            )
        return self[good]


def poses_with_log(loop: Loop) -> np.ndarray:
    """Returns which poses (m,) to use so that the logarithm between any two of them is well-conditioned. Poses with
    most ill-conditioned motions are left out first."""
    motions, used = Motions.all(loop), np.ones(len(loop), bool)
    bad = ~motions.has_log()
    while bad.any():
        worst = np.bincount(np.concatenate([motions.first[bad], motions.second[bad]]), minlength=len(loop)).argmax()
        used[worst] = False
        bad &= (motions.first != worst) & (motions.second != worst)
    return used
