"""How far a registration reaches: fitted in a cube, what are the errors there and farther out? Nothing is assumed."""

from dataclasses import dataclass

import numpy as np

from stcal.errors import StcalError
from stcal.geometry.arrays import frozen
from stcal.register.core.covariance import noise_of
from stcal.register.core.models import MODELS, fit
from stcal.register.core.result import Registration
from stcal.register.core.validate import held_out

SHARES = (0.25, 0.5, 0.75, 1.0)
"""Sides of the cubes, of that which holds all points."""
LEAST_POINTS = 10
"""In the inner cube: 30 numbers for a rigid transform's six."""


DIGITS = 2
"""Of the outer side, rounded up."""


@dataclass(frozen=True, slots=True)
class Errors:
    """Of ``points`` between two cubes: lengths of their errors, mm."""

    points: int
    mean_mm: float
    rms_mm: float
    max_mm: float

    @classmethod
    def of(cls, errors: np.ndarray) -> "Errors":
        return cls(len(errors), float(errors.mean()), float(np.sqrt((errors**2).mean())), float(errors.max()))


@dataclass(frozen=True, slots=True, eq=False)
class Cubes:
    """Errors by where the transform was fitted and where it is used.

    ``middle`` : (3,) mm, frame a; cubes stand along its axes. ``sides_mm`` : (k,), growing. ``errors[i][j]`` : fitted
    to the points in cube i, of the points in cube j that are not in cube j − 1; those that the fit used are held out
    in turn. None where there are none.
    """

    middle: np.ndarray
    sides_mm: np.ndarray
    errors: tuple[tuple[Errors | None, ...], ...]

    def __post_init__(self):
        object.__setattr__(self, "middle", frozen(self.middle, (3,), "middle"))
        object.__setattr__(self, "sides_mm", frozen(self.sides_mm, (None,), "sides"))


def cubes(
    registration: Registration,
    xyz_a: np.ndarray,
    xyz_b: np.ndarray,
    taken_back: np.ndarray | None = None,
    weights: np.ndarray | None = None,
    covariances: np.ndarray | None = None,
    folds: int = 6,
) -> Cubes | None:
    """Fits of the registration's model in cubes about the middle of its inliers; None where there are too few.

    ``taken_back`` : indices of outliers that count too; the others as of :func:`stcal.register.pipeline`.
    """
    a, b = np.asarray(xyz_a, float), np.asarray(xyz_b, float)
    noise = noise_of(len(a), weights, covariances)
    used = registration.inliers.copy()
    used[np.zeros(0, int) if taken_back is None else taken_back] = True
    rows = np.flatnonzero(used)
    a, b, noise = a[rows], b[rows], noise[rows]
    middle = (a.min(0) + a.max(0)) / 2
    reach = 2 * np.abs(a - middle).max(1)
    step = 10.0 ** (np.floor(np.log10(reach.max())) - DIGITS + 1)
    outer = np.ceil(reach.max() / step * (1 - 1e-9)) * step
    sides = [share * outer for share in SHARES if (reach <= share * outer).sum() >= LEAST_POINTS]
    model = MODELS[registration.model]
    table = []
    for side in sides:
        inside = reach <= side

        def fitted(of: np.ndarray, inside=inside):
            own = np.flatnonzero(inside)[of]
            return fit(model, a[own], b[own], noise[own].precision)

        try:
            transform = fitted(np.arange(inside.sum()))
        except StcalError:  # the points of the inner cube may lie in a plane
            continue
        error = np.linalg.norm(b - transform @ a, axis=1)
        every = np.ones(inside.sum(), bool)
        held = held_out(fitted, a[inside], b[inside], every, folds, model.sample + 1, registration.seed)
        if held is not None:
            error[np.flatnonzero(inside)[held.rows]] = held.error_mm
        table.append((side, error))
    if not table:
        return None
    sides = [side for side, _ in table]
    shell = np.searchsorted(sides, reach * (1 - 1e-12))
    errors = tuple(
        tuple(Errors.of(error[shell == j]) if (shell == j).any() else None for j in range(len(sides)))
        for _, error in table
    )
    return Cubes(middle, np.array(sides), errors)
