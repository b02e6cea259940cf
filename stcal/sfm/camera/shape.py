"""The board's own shape among the unknowns of a calibration: where its dots are by design, and how they may be off."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc

from stcal.geometry.normal_equations import Reduction

BOW_SHARE = 0.005
"""σ of a board's bends at its edge, in parts of its extent: a millimetre on 200 mm, more than any that is in use."""
BENT_P = 1e-3
"""Bends that chance makes in more than one flat board of a thousand are none: to leave them free costs accuracy."""


@dataclass(frozen=True, slots=True, eq=False)
class BoardShape:
    """Where a folder's dots are by design, ``places`` (n, 3) mm, and how they may be off.

    ``bow`` : (3n, m) orthonormal, the second-order bends of the board out of its plane; ``bow_sigma_mm`` : of the
    amplitude along each. All else is off by the board's σ, independently.
    """

    places: np.ndarray
    bow: np.ndarray
    bow_sigma_mm: float

    @classmethod
    def of(cls, places: np.ndarray) -> "BoardShape":
        """Bends of the places' own extent."""
        xy = places[:, :2] - places[:, :2].mean(axis=0)
        extent = max(float(np.ptp(xy, axis=0).max()), 1e-9)
        x, y = 2 * xy.T / extent
        flat = np.linalg.qr(np.column_stack([np.ones_like(x), x, y]))[0]
        bends = np.column_stack([x * x, x * y, y * y])
        bends -= flat @ (flat.T @ bends)
        u, size, _ = np.linalg.svd(bends, full_matrices=False)
        u = u[:, size > 1e-3 * np.sqrt(len(x))]  # fewer where the dots that are seen lie along a line
        bow = np.zeros((3 * len(places), u.shape[1]))
        bow[2::3] = u
        return cls(places, bow, BOW_SHARE * extent * float(np.sqrt(len(places))))

    def weight(self, sigma_mm: float) -> np.ndarray:
        """Inverse covariance (3n, 3n) of the dots' places."""
        bent = 1 / (sigma_mm**2 + self.bow_sigma_mm**2)
        return np.eye(len(self.bow)) / sigma_mm**2 - (1 / sigma_mm**2 - bent) * (self.bow @ self.bow.T)

    def costs(self, xyz: np.ndarray, sigma_mm: float) -> tuple[float, float]:
        """χ² of places (n, 3): of the board's σ, and of its bends."""
        gap = (xyz - self.places).ravel()
        bends = self.bow.T @ gap
        own = float(gap @ gap - bends @ bends) / sigma_mm**2
        return own, float(bends @ bends) / (sigma_mm**2 + self.bow_sigma_mm**2)

    def redundancy(self, board: Reduction, covariance: np.ndarray, sigma_mm: float) -> float:
        """Redundancy of the observations of the dots, but for bends; ``board`` : the dots, reduced away from equations
        over unknowns of this ``covariance``."""
        inverse, from_kept = board.inverse[0], board.from_kept[0]
        bent = from_kept.T @ self.bow
        taken = np.trace(inverse) + np.sum((from_kept @ covariance) * from_kept)
        taken -= np.sum(self.bow * (inverse @ self.bow)) + np.sum((covariance @ bent) * bent)
        return board.step.size - self.bow.shape[1] - float(taken) / sigma_mm**2

    def flat_by_chance(
        self, xyz: np.ndarray, board: Reduction, covariance: np.ndarray, sigma_mm: float
    ) -> "BoardShape":
        """This, without bends where those of ``xyz`` (n, 3) may be chance; the rest as of :meth:`redundancy`."""
        bends = self.bow.T @ (xyz - self.places).ravel()
        bent = board.from_kept[0].T @ self.bow
        spread = self.bow.T @ board.inverse[0] @ self.bow + bent.T @ covariance @ bent
        spread += sigma_mm**2 * np.eye(len(bends))
        chance = chdtrc(max(len(bends), 1), float(bends @ np.linalg.solve(spread, bends)))
        return self if chance < BENT_P else replace(self, bow=self.bow[:, :0])
