"""Affine transforms: ``xyz_a = linear @ xyz_b + translation``, any 3×3 part."""

from dataclasses import dataclass
from typing import overload

import numpy as np
from numpy.typing import ArrayLike

from stcal.errors import DegenerateError
from stcal.geometry.arrays import Array, freeze


@dataclass(frozen=True, slots=True, eq=False)
class Affine:
    """An affine transform a_from_b of twelve parameters.

    Parameters
    ----------
    linear : (3, 3) array
    translation : (3,) array
        Image of b's origin in a, mm.
    """

    linear: Array
    translation: Array

    def __post_init__(self):
        freeze(self, "linear", (3, 3), "linear part")
        freeze(self, "translation", (3,), "translation")

    def matrix(self) -> np.ndarray:
        """Return the homogeneous 4×4 matrix."""
        m = np.eye(4)
        m[:3, :3], m[:3, 3] = self.linear, self.translation
        return m

    def inverse(self) -> "Affine":
        """Return b_from_a.

        Raises
        ------
        DegenerateError
            The linear part is singular.
        """
        if np.linalg.cond(self.linear) > 1e12:
            raise DegenerateError(
                "E-AFFINE-SINGULAR", "affine transform: its 3×3 part is singular; an invertible one needed"
            )
        back = np.linalg.inv(self.linear)
        return Affine(back, -back @ self.translation)

    @overload
    def __matmul__(self, other: "Affine") -> "Affine": ...
    @overload
    def __matmul__(self, other: ArrayLike) -> np.ndarray: ...
    def __matmul__(self, other):
        """Return a_from_c for a transform b_from_c, or points in frame a for points (..., 3) in frame b, mm."""
        if isinstance(other, Affine):
            return Affine(self.linear @ other.linear, self.linear @ other.translation + self.translation)
        return np.asarray(other, float) @ self.linear.T + self.translation
