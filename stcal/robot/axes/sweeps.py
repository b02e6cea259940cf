"""Sweeps of single joints in measured data; an orientation counts as several virtual reflectors."""

from collections import defaultdict
from dataclasses import dataclass, replace

import numpy as np

from stcal.errors import InputError
from stcal.geometry.rigid import Rigid, align_rigid, skew
from stcal.robot.kinematics.measurements import Measurements
from stcal.robot.kinematics.robot_model import Robot

STILL_RAD = np.radians(1.5e-3)
"""Difference up to which joint values are equal: a controller shows 0.001°, and coupling adds two of them."""
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
    rows: np.ndarray


def find_arcs(data: Measurements, robot: Robot, still_rad: float = STILL_RAD) -> tuple[list[Arc], list[str]]:
    """Returns the arcs of all joints, and notes on arcs that are not used. Rows of one reflector that differ in exactly
    one *kinematic* joint value form an arc. Positions a full turn apart are one only for the joint that turns.

    Raises InputError: no positions, a joint that is never swept, or a reflector that does not move.
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
            places = values if robot.prismatic[j] else _within_a_turn(values)
            distinct = len(set(_clusters(places, still[j])))
            if distinct >= DISTINCT[joint.type]:
                arcs.append(Arc(j, target, np.array(rows)))
                arc_count += 1
            elif distinct > 1:
                notes.append(
                    f"joint {j + 1}, {called(target)}, line {data.lines[rows[0]]}: an arc of {distinct} positions is "
                    f"not used, {DISTINCT[joint.type]} needed"
                )
        if not arc_count:
            missing.append(j)
    if missing:
        names, least = ", ".join(str(j + 1) for j in missing), DISTINCT[robot.joints[missing[0]].type]
        raise InputError(
            "E-AXES-NO-SWEEP",
            f"{data.where}: joint {names} is never swept: no rows of one reflector differ in that joint "
            f"alone, {least} or more positions needed; measure its sweep, and if the controller couples joints, give "
            "`coupling` in the robot file",
        )
    return arcs, notes


def called(target: str) -> str:
    """Returns the name by which messages refer to a reflector."""
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


def _within_a_turn(values: np.ndarray) -> np.ndarray:
    """Returns angles in 0 to 2π from the middle of the widest gap between them, so that no cluster lies across 0."""
    around = np.sort(np.mod(values, 2 * np.pi))
    gaps = np.diff(around, append=around[0] + 2 * np.pi)
    widest = int(gaps.argmax())
    return np.mod(values - around[widest] - gaps[widest] / 2, 2 * np.pi)


def _clusters(values: np.ndarray, still: float) -> np.ndarray:
    """Returns the number of the cluster of each value; neighbours closer than ``still`` are in one cluster."""
    order = np.argsort(values)
    label = np.empty(len(values), int)
    label[order] = np.concatenate([[0], np.cumsum(np.diff(values[order]) > still)])
    return label


SHORTEST_MM, LONGEST_MM = 1.0, 10_000.0
ANGLES = 2 * np.pi / 3 * np.arange(3)
UNIT_PLACES = np.column_stack([np.cos(ANGLES), np.sin(ANGLES), np.zeros(3)])
"""Places of the reflectors about the target's origin, in its XY plane; their mean is the origin."""


@dataclass(frozen=True, slots=True, eq=False)
class VirtualReflectors:
    """Virtual reflectors of poses. ``data`` : k rows for each of m poses; ``places`` : (k, 3) places of the reflectors
    in the target's frame, mm; ``pose`` : (km,) number of the pose of each row; ``lever`` : (km, 3) vectors from the
    reflectors' mean, of RMS length 1, in the instrument's frame."""

    data: Measurements
    places: np.ndarray
    pose: np.ndarray
    lever: np.ndarray

    def by_pose(self, response: np.ndarray) -> np.ndarray:
        """Returns the response (p, 6 m) to the noise of poses, given that (p, km, 3) to the noise of independent rows.
        A pose errs by a translation, and by a rotation that moves the reflectors as much (RMS)."""
        by_row = np.concatenate([np.broadcast_to(np.eye(3), (len(self.lever), 3, 3)), -skew(self.lever)], axis=2)
        shared = np.zeros((len(response), int(self.pose.max()) + 1, 6))
        np.add.at(shared.swapaxes(0, 1), self.pose, np.einsum("pmc,mcd->mpd", response, by_row))
        return np.sqrt(3 / 5) * shared.reshape(len(response), -1)

    def tools(self, places: dict[str, Rigid], spread_mm: dict[str, float]) -> tuple[dict[str, Rigid], dict[str, float]]:
        """Returns the poses of the targets from their reflectors' places, and the RMS about these places."""
        tools, spread = {}, {}
        for name in dict.fromkeys(self.data.targets):
            target, _, number = name.rpartition(SEPARATOR)
            if number == "1":
                names = [f"{target}{SEPARATOR}{i + 1}" for i in range(len(self.places))]
                xyz = np.array([places[each].translation for each in names])
                tools[target] = align_rigid(xyz, self.places)
                spread[target] = float(np.sqrt(np.mean([spread_mm[each] ** 2 for each in names])))
        return tools, spread


SEPARATOR = " point "


def length_of(data: Measurements) -> float | None:
    """Returns the distance, mm, at which σ of rotations moves a point by σ of positions; None if no σ are stated."""
    if data.rotations is None or data.covariance is None:
        return None
    variance = np.einsum("mii->mi", np.asarray(data.covariance))
    rotation, position = variance[:, :3].mean(axis=1), variance[:, 3:].mean(axis=1)
    if not (rotation > 0).all():
        return None
    return float(np.clip(np.median(np.sqrt(position / rotation)), SHORTEST_MM, LONGEST_MM))


def ring(length_mm: float) -> np.ndarray:
    """Returns places (3, 3) at ``length_mm`` from the target's origin; raises InputError: a length out of range."""
    if not SHORTEST_MM <= length_mm <= LONGEST_MM:
        raise InputError(
            "E-OPTION-RANGE", f"--orientations {length_mm:g}: {SHORTEST_MM:g} to {LONGEST_MM:g} mm needed, auto or off"
        )
    return length_mm * UNIT_PLACES


def virtual_reflectors(data: Measurements, places: np.ndarray) -> VirtualReflectors:
    """Returns reflectors carried at ``places`` (k, 3) of a target, mm; raises InputError if there are no
    orientations."""
    if data.rotations is None or data.positions is None:
        raise InputError(
            "E-MEASURED-NO-ORIENTATION",
            f"{data.where}: no orientations; columns of a rotation needed for --orientations, or leave it out",
        )
    m, k = len(data), len(places)
    about = places - places.mean(axis=0)
    lever = about / np.sqrt((about**2).sum(axis=1).mean())
    carried, lever = (np.einsum("mij,kj->mki", data.rotations, each).reshape(-1, 3) for each in (places, lever))
    row = np.repeat(np.arange(m), k)
    at = row.tolist()
    virtual = replace(
        data,
        lines=[data.lines[i] for i in at],
        q=data.q[row],
        targets=tuple(f"{data.targets[i]}{SEPARATOR}{n % k + 1}" for n, i in enumerate(at)),
        positions=np.asarray(data.positions)[row] + carried,
        rotations=None,
        covariance=None,
        common=None,
    )
    return VirtualReflectors(virtual, places, row, lever)
