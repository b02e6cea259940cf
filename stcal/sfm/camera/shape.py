"""The board's shape as unknowns of a calibration: design places of its dots, and prior of their deviations."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc

from stcal.geometry.normal_equations import Reduction

BOW_SHARE = 0.005
"""σ of a board's bends at its edge relative to its extent: 1 mm on 200 mm, more than that of any board in use."""
BENT_P = 1e-3
"""Significance level of bends. Insignificant bends are fixed to zero, as free bends cost accuracy."""


@dataclass(frozen=True, slots=True, eq=False)
class BoardShape:
    """Design places of a folder's dots, and the prior of their deviations.

    ``places`` : (n, 3) mm; ``bow`` : (3n, m) orthonormal, second-order bends of the board out of its plane;
    ``bow_sigma_mm`` : σ of the amplitude of each bend. All other deviations are independent with the board's σ.
    """

    places: np.ndarray
    bow: np.ndarray
    bow_sigma_mm: float

    @classmethod
    def of(cls, places: np.ndarray) -> "BoardShape":
        """Returns the shape of a board with these places, its bends scaled by their extent."""
        xy = places[:, :2] - places[:, :2].mean(axis=0)
        extent = max(float(np.ptp(xy, axis=0).max()), 1e-9)
        x, y = 2 * xy.T / extent
        flat = np.linalg.qr(np.column_stack([np.ones_like(x), x, y]))[0]
        bends = np.column_stack([x * x, x * y, y * y])
        bends -= flat @ (flat.T @ bends)
        u, size, _ = np.linalg.svd(bends, full_matrices=False)
        u = u[:, size > 1e-3 * np.sqrt(len(x))]  # fewer bends if the visible dots lie along a line
        bow = np.zeros((3 * len(places), u.shape[1]))
        bow[2::3] = u
        return cls(places, bow, BOW_SHARE * extent * float(np.sqrt(len(places))))

    def weight(self, sigma_mm: float) -> np.ndarray:
        """Returns the inverse covariance (3n, 3n) of the dots' places."""
        bent = 1 / (sigma_mm**2 + self.bow_sigma_mm**2)
        return np.eye(len(self.bow)) / sigma_mm**2 - (1 / sigma_mm**2 - bent) * (self.bow @ self.bow.T)

    def costs(self, xyz: np.ndarray, sigma_mm: float) -> tuple[float, float]:
        """Returns the χ² of the deviations of places (n, 3) from the design: without bends, and of the bends."""
        deviation = (xyz - self.places).ravel()
        bends = self.bow.T @ deviation
        cost_of_dots = float(deviation @ deviation - bends @ bends) / sigma_mm**2
        return cost_of_dots, float(bends @ bends) / (sigma_mm**2 + self.bow_sigma_mm**2)

    def redundancy(self, board: Reduction, covariance: np.ndarray, sigma_mm: float) -> float:
        """Returns the redundancy of the observations of the dots without the bends.

        ``board`` : reduction of the dots; ``covariance`` : of the unknowns that are kept.
        """
        inverse, from_kept = board.inverse[0], board.from_kept[0]
        bent = from_kept.T @ self.bow
        taken = np.trace(inverse) + np.sum((from_kept @ covariance) * from_kept)
        taken -= np.sum(self.bow * (inverse @ self.bow)) + np.sum((covariance @ bent) * bent)
        return board.step.size - self.bow.shape[1] - float(taken) / sigma_mm**2

    def flat_by_chance(
        self, xyz: np.ndarray, board: Reduction, covariance: np.ndarray, sigma_mm: float
    ) -> "BoardShape":
        """Returns the shape without bends if the bends of ``xyz`` (n, 3) are insignificant, else itself.

        Other arguments as in :meth:`redundancy`.
        """
        bends = self.bow.T @ (xyz - self.places).ravel()
        bent = board.from_kept[0].T @ self.bow
        spread = self.bow.T @ board.inverse[0] @ self.bow + bent.T @ covariance @ bent
        spread += sigma_mm**2 * np.eye(len(bends))
        chance = chdtrc(max(len(bends), 1), float(bends @ np.linalg.solve(spread, bends)))
        return self if chance < BENT_P else replace(self, bow=self.bow[:, :0])
