"""Sweeps of single joints in measured data: rows that are arcs of one joint and one reflector."""

from collections import defaultdict
from dataclasses import dataclass

import numpy as np

from stcal.errors import InputError
from stcal.geometry.arrays import Array, freeze
from stcal.robot.kinematics.measurements import Measurements
from stcal.robot.kinematics.model import Robot

STILL_RAD = np.radians(1.5e-3)
"""Difference up to which joint values are equal: a controller shows 0.001°, and coupling adds two of them. It is 0.05
mm at 2 m."""
STILL_MM = 2e-3
DISTINCT = {"revolute": 3, "prismatic": 2}
"""Number of positions that give an arc its radius and height, or a line its direction."""
NOT_MOVED_MM = 1.0
"""Motion of a reflector below which it does not move; sweeps of a whole arm move a reflector on its flange by more."""


@dataclass(frozen=True, slots=True, eq=False)
class Arc:
    """Rows (indices into the measurements) of one reflector in one sweep of ``joint`` (from 0)."""

    joint: int
    target: str
    rows: Array

    def __post_init__(self):
        freeze(self, "rows", (None,), "rows", int)


def find_arcs(data: Measurements, robot: Robot, still_rad: float = STILL_RAD) -> tuple[list[Arc], list[str]]:
    """Returns the arcs of all joints, and notes on arcs that are not used, with the reason.

    Rows of one reflector that differ in exactly one *kinematic* joint value (the controller's after coupling) form an
    arc; a row may belong to several. Positions a full turn apart are one position of the joint that turns. A joint that
    should stand still must not be a full turn away, where gears and backlash need not repeat.

    Raises
    ------
    InputError
        No positions, a joint that is never swept, or a reflector that does not move.
    """
    if data.positions is None:
        raise InputError(
            "E-MEASURED-DISTANCES", f"{data.where}: distances only; columns x_mm, y_mm, z_mm needed for the axis method"
        )
    _require_motion(data)
    kinematic = data.q @ robot.coupling.T
    still = np.where(robot.prismatic, STILL_MM, still_rad)
    same = np.column_stack([_clusters(v, s) for v, s in zip(kinematic.T, still, strict=True)])
    arcs, notes, missing = [], [], []
    for j, joint in enumerate(robot.joints):
        groups = defaultdict(list)
        for row, others in enumerate(np.delete(same, j, axis=1)):
            groups[data.targets[row], *others.tolist()].append(row)
        arc_count = 0
        for (target, *_), rows in groups.items():
            values = kinematic[rows, j]
            places = values if robot.prismatic[j] else np.mod(values + STILL_RAD, 2 * np.pi)
            distinct = len(set(_clusters(places, still[j])))
            if distinct >= DISTINCT[joint.type]:
                arcs.append(Arc(j, target, rows))
                arc_count += 1
            elif distinct > 1:
                notes.append(
                    f"joint {j + 1}, {called(target)}, line {data.lines[rows[0]]}: an arc of {distinct} positions is "
                    f"not used, {DISTINCT[joint.type]} needed"
                )
        if not arc_count:
            missing.append(str(j + 1))
    if missing:
        raise InputError(
            "E-AXES-NO-SWEEP",
            f"{data.where}: joint {', '.join(missing)} is never swept: no rows of one reflector differ in that joint "
            "alone, 3 or more positions needed; measure its sweep, and if the controller couples joints, give "
            "`coupling` in the robot file",
        )
    return arcs, notes


def called(target: str) -> str:
    """Returns the name of a reflector in messages."""
    return f"reflector {target}" if target else "the reflector"


def _require_motion(data: Measurements) -> None:
    names = np.array(data.targets)
    for target in dict.fromkeys(data.targets):
        points = data.points()[names == target]
        moved = np.linalg.norm(points - np.median(points, axis=0), axis=1)
        if len(points) > 1 and np.quantile(moved, 0.9) < NOT_MOVED_MM:
            raise InputError(
                "E-TARGET-STILL",
                f"{data.where}: {called(target)} does not move: 90 % of its {len(points)} positions lie within "
                f"{np.quantile(moved, 0.9):.3g} mm while the joints move; a reflector on the flange, and each "
                "row's own measurement needed",
            )


def _clusters(values: np.ndarray, still: float) -> np.ndarray:
    """Returns the number of the cluster of each value; neighbours closer than ``still`` are in one cluster."""
    order = np.argsort(values)
    label = np.empty(len(values), int)
    label[order] = np.concatenate([[0], np.cumsum(np.diff(values[order]) > still)])
    return label
