"""Leave-one-out of the axes: their values without one row of the sweeps."""

from dataclasses import dataclass

import numpy as np

from stcal.errors import ConvergenceError, DegenerateError
from stcal.robot.axes.fit import AxisFit, refit_axis, unwound_by
from stcal.robot.axes.pairs import jacobian_by_axes, pair_values
from stcal.robot.kinematics.measurements import Measurements
from stcal.robot.kinematics.model import Robot

REFITTED = 200
"""Largest number of rows of the sweeps for which each is left out by a new fit; of more rows each is left out by
influence. For 600 rows the spread is 1 to 4 % less so."""


@dataclass(frozen=True, slots=True, eq=False)
class LeaveOneOut:
    """The values of each pair without one row of the sweeps (all its reflectors).

    ``lines`` : first line of each row that was left out; ``distance``, ``normal`` : (r, n − 1) mm, as in :class:`Pair`;
    nan where there is no value, or where the remaining rows do not determine an axis.
    """

    lines: tuple[int, ...]
    distance: np.ndarray
    normal: np.ndarray

    def __post_init__(self):  # nan is a value here
        for name in ("distance", "normal"):
            values = np.array(getattr(self, name))
            values.flags.writeable = False
            object.__setattr__(self, name, values)

    def spread(self, name: str) -> np.ndarray:
        """Returns the largest minus the smallest ``distance`` or ``normal``, (n − 1,); nan where there is none."""
        values = getattr(self, name)
        known = np.isfinite(values)
        high, low = np.where(known, values, -np.inf).max(axis=0), np.where(known, values, np.inf).min(axis=0)
        return np.where(known.any(axis=0), high - low, np.nan)


def leave_one_out(
    data: Measurements, fits: list[AxisFit], nominal: Robot, passed: list[list[np.ndarray]]
) -> LeaveOneOut:
    """Returns the values without each row; what comes after a changed axis is unwound and fitted again."""
    kinematic = data.q @ nominal.coupling.T
    start = [np.array(data.points())]
    for j, fit in enumerate(fits):
        start.append(unwound_by(fit.world_from_axis, start[-1], kinematic[:, j], bool(nominal.prismatic[j]))[1])
    used = np.unique(np.concatenate([fit.rows for fit in fits]))
    instants = [rows for rows in _instants(data) if np.isin(rows, used).any()]
    if len(instants) > REFITTED:
        values = _by_influence(instants, fits, start, passed, nominal)
    else:
        values = np.array([_refitted(rows, fits, start, kinematic, nominal) for rows in instants])
    lines = tuple(int(data.lines[rows[0]]) for rows in instants)
    return LeaveOneOut(lines, values[:, :, 3], values[:, :, 4])


def _refitted(
    rows: list[int], fits: list[AxisFit], start: list[np.ndarray], kinematic: np.ndarray, nominal: Robot
) -> np.ndarray:
    """Returns the values (n − 1, 6) of the pairs without these rows; nan if the remaining rows determine no axis."""
    first = next(j for j, fit in enumerate(fits) if np.isin(fit.rows, rows).any())
    frames, points = [fit.world_from_axis for fit in fits[:first]], start[first]
    try:
        for j in range(first, len(fits)):
            frames.append(refit_axis(fits[j], points, np.array(rows)))
            points = unwound_by(frames[j], points, kinematic[:, j], bool(nominal.prismatic[j]))[1]
        return pair_values(frames, nominal).reshape(-1, 6)
    except (DegenerateError, ConvergenceError):
        return np.full((len(fits) - 1, 6), np.nan)


def _by_influence(
    instants: list[list[int]],
    fits: list[AxisFit],
    start: list[np.ndarray],
    passed: list[list[np.ndarray]],
    nominal: Robot,
) -> np.ndarray:
    """Returns the values (r, n − 1, 6) of the pairs without each instant's rows, linear in the changes.

    Leaving a row out is giving it the residual by the fit of the others (Cook & Weisberg 1982, "Residuals and Influence
    in Regression").
    """
    number = np.zeros(len(start[0]), int)
    for i, rows in enumerate(instants):
        number[rows] = i
    changes = []
    for fit, points, derivatives in zip(fits, start, passed, strict=False):
        change = np.zeros((len(instants), len(fit.gain)))
        np.add.at(change, number[fit.rows], fit.influence(points[fit.rows]))
        for before, derivative in zip(changes, derivatives, strict=True):
            change += before @ derivative.T
        changes.append(change)
    frames = [fit.world_from_axis for fit in fits]
    values = pair_values(frames, nominal)
    slope = jacobian_by_axes(lambda f: pair_values(f, nominal), frames, nominal)
    return (values + np.concatenate(changes, axis=1) @ slope.T).reshape(len(instants), -1, 6)


def _instants(data: Measurements) -> list[list[int]]:
    """Returns the groups of rows that were measured together: the same joint values, each reflector once."""
    instants, counts = {}, {}
    for row, (q, target) in enumerate(zip(data.q, data.targets, strict=True)):
        values = q.tobytes()
        counts[values, target] = counts.get((values, target), 0) + 1
        instants.setdefault((values, counts[values, target]), []).append(row)
    return list(instants.values())
