"""Smooth deviations of a printed plane from its drawing, and how large they are: a print is longer in one direction,
sheared, and by less curved; a sheet bends. All points follow together, by far more than each deviates by itself."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize_scalar

from stcal.geometry.arrays import kept

PRINT_SHARE = 0.003
"""σ of a print's stretch, shear and curving at its edge, relative to its half extent: printers are 0.2 to 0.5 % off."""
BEND_SHARE = 0.01
"""σ of a sheet's bends out of its plane, likewise: 1 mm on 200 mm, more than that of any board in use."""
LEAST_SHARE = 1e-3
"""A mode that moves the points by less than this share of what it moves others by is not told by them."""
AMPLITUDES = (1e-3, 10.0)  # smallest and largest factor on these σ
PRIOR_LOGS = np.log(10.0)  # σ of the logarithm of the factor before the data are seen


@dataclass(frozen=True, slots=True, eq=False)
class PrintModes:
    """Smooth deviations of n points, without that of their size."""

    modes: np.ndarray  # (3n, m), orthonormal
    spread_mm: np.ndarray  # (m,) σ of their coordinates
    affine: bool  # whether stretch and shear are the first two, which points on a line do not tell
    amplitude: float = 1.0  # factor on the σ of printers and paper

    @classmethod
    @kept
    def of(cls, xy: np.ndarray) -> "PrintModes":
        """Return the modes of points (n, 2) of a plane: stretch, shear, six of second order within it, three bends."""
        xy = xy - xy.mean(axis=0)
        half = max(float(np.ptp(xy, axis=0).max()) / 2, 1e-9)
        x, y = xy.T / half
        zero, one = np.zeros_like(x), np.ones_like(x)
        motions = [(one, zero, zero), (zero, one, zero), (-y, x, zero), *((zero, zero, v) for v in (one, x, y))]
        second = (x * x, x * y, y * y)
        within = [(x, -y, zero), (y, x, zero), *((v, zero, zero) for v in second), *((zero, v, zero) for v in second)]
        columns = [(mode, PRINT_SHARE) for mode in within] + [((zero, zero, v), BEND_SHARE) for v in second]
        known = np.linalg.qr(np.column_stack([np.column_stack(mode).ravel() for mode in [*motions, (x, y, zero)]]))[0]
        modes, spread, kept = [], [], []
        for k, (mode, share) in enumerate(columns):
            column = np.column_stack(mode).ravel()
            for _ in range(2):  # twice, for rounding
                column = column - known @ (known.T @ column)
            size = float(np.linalg.norm(column))
            if size > LEAST_SHARE * np.sqrt(len(x)):
                known = np.column_stack([known, column / size])
                modes.append(column / size)
                kept.append(k)
                spread.append(share * half * (size if share == PRINT_SHARE else np.sqrt(len(x))))
        table = np.column_stack(modes) if modes else np.zeros((3 * len(x), 0))
        return cls(table, np.array(spread), kept[:2] == [0, 1])

    def stretch(self, off_mm: np.ndarray) -> tuple[float, float]:
        """Return by how much more the print is stretched in x than in y, and its shear, from deviations (n, 3)."""
        if not self.affine:
            return 0.0, 0.0
        relative = self.modes[:, :2].T @ off_mm.ravel() * PRINT_SHARE / self.spread_mm[:2]  # to the half extent
        return 2 * float(relative[0]), 2 * float(relative[1])

    def weight(self, sigma_mm: float) -> np.ndarray:
        """Return the inverse covariance (3n, 3n) of the points' places, each of which also has its own ``sigma_mm``."""
        less = 1 / sigma_mm**2 - 1 / (sigma_mm**2 + (self.amplitude * self.spread_mm) ** 2)
        return np.eye(len(self.modes)) / sigma_mm**2 - (self.modes * less) @ self.modes.T

    def cost(self, off_mm: np.ndarray, sigma_mm: float) -> float:
        """Return the χ² of deviations (n, 3) from the drawing: of the points by themselves, without the modes."""
        flat = off_mm.ravel()
        along = self.modes.T @ flat
        return float(flat @ flat - along @ along) / sigma_mm**2

    def as_found(self, off_mm: np.ndarray, covariance: np.ndarray, sigma_mm: float) -> "PrintModes":
        """Return the modes with the amplitude that explains deviations (n, 3), adjusted with this one, best;
        ``covariance`` : (m, m) of the modes' coordinates after the adjustment."""
        told = Told(self.modes.T @ off_mm.ravel(), covariance, sigma_mm**2, self.spread_mm)
        return replace(self, amplitude=found_amplitude([told], self.amplitude))


LEAST_SAID = 5e-4
"""Smallest stretch or shear of a print that is worth a line: a quarter of what good printers do."""


def stretch_in_words(what: str, stretch: float, shear: float) -> list[str]:
    """Return a line on the print of ``what``, or none where it is as drawn; see :meth:`PrintModes.stretch`."""
    if max(abs(stretch), abs(shear)) < LEAST_SAID:
        return []
    way = "along its rows than across" if stretch > 0 else "across its rows than along"
    return [f"{what} is printed {100 * abs(stretch):.3f} % longer {way}, sheared by {100 * abs(shear):.3f} %"]


@dataclass(frozen=True, slots=True, eq=False)
class Told:
    """What an adjustment tells about the coordinates of the modes of one print, mm."""

    mean: np.ndarray  # (m,)
    covariance: np.ndarray  # (m, m)
    own: np.ndarray | float  # (m,) variance that they have anyway
    spread: np.ndarray  # (m,) at an amplitude of 1

    def prior(self, amplitude: float) -> np.ndarray:
        """Return the variances (m,) of the coordinates before the data."""
        return self.own + (amplitude * self.spread) ** 2


def found_amplitude(prints: Sequence[Told], amplitude: float) -> float:
    """Return the amplitude that explains the modes of all prints best (REML); near 1 where data tell nothing."""
    images = []
    for each in prints:
        known = np.linalg.inv(each.covariance)
        images.append((each, known - np.diag(1 / each.prior(amplitude)), known @ each.mean))

    def misfit(log: float) -> float:
        total = (log / PRIOR_LOGS) ** 2
        for each, told, right in images:
            root = np.sqrt(each.prior(np.exp(log)))
            inner, pull = np.eye(len(root)) + root[:, None] * told * root, root * right
            total += float(np.linalg.slogdet(inner)[1] - pull @ np.linalg.solve(inner, pull))
        return total

    found = minimize_scalar(misfit, bounds=np.log(AMPLITUDES), method="bounded", options={"xatol": 1e-3})
    return float(np.exp(found.x))
