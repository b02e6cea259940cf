"""Orientations in sweeps: a pose counts as several virtual reflectors, which the axis method takes like others.

Zhang & Wei (2017) measure poses of their target; the axis method, as usually written, uses their positions alone.
"""

from dataclasses import dataclass, replace

import numpy as np

from stcal.errors import InputError
from stcal.geometry.align import align_rigid
from stcal.geometry.arrays import Array, freeze
from stcal.geometry.rigid import Rigid, skew
from stcal.robot.kinematics.measurements import Measurements

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
    places: Array
    pose: Array
    lever: Array

    def __post_init__(self):
        freeze(self, "places", (None, 3), "places")
        freeze(self, "pose", (len(self.data),), "poses", int)
        freeze(self, "lever", (len(self.data), 3), "levers")

    def by_pose(self, response: np.ndarray) -> np.ndarray:
        """Returns the response (p, 6 m) to the noise of poses, given the ``response`` (p, km, 3) to the noise of
        independent rows.

        A pose errs by a translation of the reflectors' mean, and by a rotation that moves the reflectors as much (RMS);
        both together are √(1 + ⅔) of it.
        """
        by_row = np.concatenate([np.broadcast_to(np.eye(3), (len(self.lever), 3, 3)), -skew(self.lever)], axis=2)
        shared = np.zeros((len(response), int(self.pose.max()) + 1, 6))
        np.add.at(shared.swapaxes(0, 1), self.pose, np.einsum("pmc,mcd->mpd", response, by_row))
        return np.sqrt(3 / 5) * shared.reshape(len(response), -1)

    def tools(self, places: dict[str, Rigid], spread_mm: dict[str, float]) -> tuple[dict[str, Rigid], dict[str, float]]:
        """Returns the poses of the targets from the places of their reflectors, and the RMS of the reflectors about
        these places."""
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
    """Returns the distance, mm, at which the stated σ of rotations is worth that of positions; None if no σ are
    stated."""
    if data.rotations is None or data.covariance is None:
        return None
    variance = np.einsum("mii->mi", np.asarray(data.covariance))
    rotation, position = variance[:, :3].mean(axis=1), variance[:, 3:].mean(axis=1)
    if not (rotation > 0).all():
        return None
    return float(np.clip(np.median(np.sqrt(position / rotation)), SHORTEST_MM, LONGEST_MM))


def ring(length_mm: float) -> np.ndarray:
    """Returns places (3, 3) at ``length_mm`` from the target's origin; an error of rotation is worth one of position
    there.

    Raises
    ------
    InputError
        A length out of range.
    """
    if not SHORTEST_MM <= length_mm <= LONGEST_MM:
        raise InputError(
            "E-OPTION-RANGE", f"--orientations {length_mm:g}: {SHORTEST_MM:g} to {LONGEST_MM:g} mm needed, auto or off"
        )
    return length_mm * UNIT_PLACES


def virtual_reflectors(data: Measurements, places: np.ndarray) -> VirtualReflectors:
    """Returns reflectors that each pose carries at ``places`` (k, 3) of its target, mm; k ≥ 3, not in line.

    Raises
    ------
    InputError
        The measurements have no orientations.
    """
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
