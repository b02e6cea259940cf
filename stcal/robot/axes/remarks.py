"""Remarks on fitted axes: outliers, reflectors too close or on no arc, zero positions."""

import numpy as np

from stcal.robot.axes.checks import AGREES_RAD
from stcal.robot.axes.fit import GROSS, REWEIGHTINGS, AxisFit
from stcal.robot.axes.sweeps import called
from stcal.robot.kinematics.dh import PARALLEL_RAD
from stcal.robot.kinematics.measurements import Measurements
from stcal.robot.kinematics.model import Robot

FEW = 3
"""Largest number of outliers of a joint that are named one by one."""
ONE_LINE_MM = 10.0
"""Largest distance between axes that are meant to be one line, such as those of a SCARA's spindle."""


def off_mm(fit: AxisFit) -> dict[int, float]:
    """Returns how far each outlier (by its row) is off its arc, mm, the farthest first."""
    distances = {}
    for row in fit.outliers:
        of_row = (fit.rows == row) & (fit.weights == 0)
        distances[int(row)] = float(np.linalg.norm(fit.residuals[of_row], axis=1).max())
    return dict(sorted(distances.items(), key=lambda item: -item[1]))


def _outliers_said(data: Measurements, fit: AxisFit) -> list[str]:
    """Returns a line for each of a few outliers, or one line for all of many."""
    off_arc, limit = off_mm(fit), f"{GROSS:g} σ is {GROSS * fit.sigma_mm:.2g} mm; left out"
    if len(off_arc) <= FEW:
        return [
            f"line {data.lines[row]}, {called(data.targets[row])}: {size:.3g} mm off its arc about joint "
            f"{fit.joint + 1}, {limit}"
            for row, size in off_arc.items()
        ]
    first = ", ".join(f"{data.lines[row]} ({size:.3g} mm)" for row, size in list(off_arc.items())[:FEW])
    return [
        f"joint {fit.joint + 1}: {len(off_arc)} of {len(set(fit.rows.tolist()))} rows are off their arcs, {limit}; the "
        f"farthest are lines {first}; all are in --json"
    ]


def remarks(data: Measurements, fits: list[AxisFit], robot: Robot, nominal: Robot) -> list[str]:
    """Returns remarks on the fitted axes and the robot that they make."""
    notes = [
        f"joint {fit.joint + 1}: the weights of its points still change after {REWEIGHTINGS} rounds; look at them"
        for fit in fits
        if not fit.settled
    ]
    for fit in fits:
        notes += _outliers_said(data, fit)
        for arc in fit.near:
            notes.append(
                f"line {data.lines[arc.rows[0]]}, {called(arc.target)}: too close to the axis of joint "
                f"{fit.joint + 1} to tell of it; its arc is not used"
            )
    notes += _alone(data, fits)
    for i, (row, wanted) in enumerate(zip(robot.rows, nominal.rows, strict=True)):
        after = robot.rows[i if robot.convention == "standard" else min(i + 1, len(fits) - 1)]
        one_line = abs(np.sin(after.alpha)) < np.sin(PARALLEL_RAD) and abs(after.a) < ONE_LINE_MM
        if abs(row.theta - wanted.theta) > AGREES_RAD and not one_line:  # on one line theta is arbitrary
            notes.append(
                f"joint {i + 1}: theta is {np.degrees(row.theta):.2f}°, {np.degrees(wanted.theta):.2f}° in the robot "
                "file: its zero position is elsewhere"
            )
    return notes


def _alone(data: Measurements, fits: list[AxisFit]) -> list[str]:
    """Returns notes on reflectors that are on no arc."""
    swept = {data.targets[row] for fit in fits for row in fit.rows.tolist()}
    notes = []
    for name in dict.fromkeys(data.targets):
        if name not in swept:
            rows = [i for i, target in enumerate(data.targets) if target == name]
            what = called(name) if name else "rows without a target, beside rows with one"
            notes.append(
                f"line {data.lines[rows[0]]}: {what}: on no arc of any joint ({len(rows)} rows), so that its place on "
                "the flange rests on these alone; name it as the others, or leave it out"
            )
    return notes
