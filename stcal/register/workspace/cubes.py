"""How far a registration reaches: fitted in a cube, what are the errors there and farther out? Nothing is assumed."""

from dataclasses import dataclass

import numpy as np

from stcal.errors import StcalError
from stcal.geometry.arrays import Array, freeze
from stcal.register.core.models import MODELS, Transform
from stcal.register.core.problem import Problem, noise_of
from stcal.register.core.result import ErrorFigures, Registration
from stcal.register.core.validate import held_out

SHARES = (0.25, 0.5, 0.75, 1.0)
"""Sides of the cubes, of that which holds all points."""
LEAST_POINTS = 10
"""Fewest points in the inner cube: 30 coordinates for the six parameters of a rigid transform."""
DIGITS = 2
"""Significant digits of the outer side, which is rounded up."""


@dataclass(frozen=True, slots=True, eq=False)
class Cubes:
    """Errors by where the transform was fitted and where it is used.

    Parameters
    ----------
    middle : (3,) array
        mm, frame a; cubes stand along its axes.
    sides_mm : (k,) array
        Growing.
    errors : k tuples of k ErrorFigures
        ``errors[i][j]`` : fitted to the points in cube i, of the points in cube j that are not in cube j − 1; those
        that the fit used are held out in turn. None where there are none.
    """

    middle: Array
    sides_mm: Array
    errors: tuple[tuple[ErrorFigures | None, ...], ...]

    def __post_init__(self):
        freeze(self, "middle", (3,), "middle")
        freeze(self, "sides_mm", (None,), "sides")


def cubes(
    registration: Registration,
    xyz_a: np.ndarray,
    xyz_b: np.ndarray,
    taken_back: np.ndarray | None = None,
    weights: np.ndarray | None = None,
    covariances: np.ndarray | None = None,
    folds: int = 6,
) -> Cubes | None:
    """Fits of the registration's model in cubes about the middle of its inliers.

    Parameters
    ----------
    registration : Registration
    xyz_a, xyz_b, weights, covariances, folds :
        As of :func:`stcal.register.register`.
    taken_back : (m,) int array, optional
        Indices of outliers that count too.

    Returns
    -------
    Cubes or None
        None where there are too few points.
    """
    used = registration.inliers.copy()
    used[np.zeros(0, int) if taken_back is None else taken_back] = True
    every = Problem(
        MODELS[registration.model],
        np.asarray(xyz_a, float),
        np.asarray(xyz_b, float),
        noise_of(len(xyz_a), weights, covariances),
    )
    problem = every[np.flatnonzero(used)]
    a = problem.xyz_a
    middle = (a.min(0) + a.max(0)) / 2
    reach = 2 * np.abs(a - middle).max(1)
    step = 10.0 ** (np.floor(np.log10(reach.max())) - DIGITS + 1)
    outer = np.ceil(reach.max() / step * (1 - 1e-9)) * step
    sides = [share * outer for share in SHARES if (reach <= share * outer).sum() >= LEAST_POINTS]
    table = []
    for side in sides:
        try:
            table.append((side, _errors(problem, reach <= side, folds, registration.seed)))
        except StcalError:  # the points of the inner cube may lie in a plane
            continue
    if not table:
        return None
    sides = [side for side, _ in table]
    shell = np.searchsorted(sides, reach * (1 - 1e-12))
    errors = tuple(
        tuple(ErrorFigures.of(error[shell == j]) if (shell == j).any() else None for j in range(len(sides)))
        for _, error in table
    )
    return Cubes(middle, np.array(sides), errors)


def _errors(problem: Problem, inside: np.ndarray, folds: int, seed: int) -> np.ndarray:
    """(n,) of all points, mm, of the fit to those ``inside``, (n,) mask, which are held out in turn."""
    cube = problem[inside]
    error = np.linalg.norm(problem.residuals(cube.fit()), axis=1)

    def fitted(rows: np.ndarray) -> Transform:
        return cube[rows].fit()

    every, least = np.ones(len(cube), bool), problem.model.sample + 1
    held = held_out(fitted, cube.xyz_a, cube.xyz_b, every, folds, least, seed)
    if held is not None:
        error[np.flatnonzero(inside)[held.rows]] = held.error_mm
    return error
