"""Checks of the axes against the nominal robot: mirrored data, joints that count the other way, another build."""

from itertools import chain, combinations

import numpy as np

from stcal.errors import InputError
from stcal.geometry.rigid import Rigid
from stcal.robot.kinematics.forward import joint_frames
from stcal.robot.kinematics.model import Robot

LIKELY, MANY = 2.0, 4
"""Factor by which a mirror may fit worse than reversed joints and is preferred all the same, and number of reversed
joints from which on they are not tried. A mirror explains all joints at once, and arms are symmetric."""
LIKE_SIZE = 2.0
"""Largest ratio of the distances between axes to the nominal ones, or of these to them; wrong units differ by more."""
AGREES_RAD = np.radians(10.0)
"""Largest difference of axes and joint zeros from a nominal robot; beyond it the robot is another one, or counts
otherwise."""


def _shape(z: np.ndarray, origin: np.ndarray, sliding: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns values of directed axes that no motion changes, and the sign of each value after a mirror.

    The values are cosines and moments of pairs, and triple products of three axes. The direction of a revolute axis
    comes from its sense of rotation, which a mirror reverses; that of a prismatic axis does not.
    """
    size = max(float(np.linalg.norm(origin - origin[0], axis=1).max()), 1.0)
    values, mirrored = [], []
    for i, k in combinations(range(len(z)), 2):
        values.append(z[i] @ z[k])
        mirrored.append(1 if sliding[i] == sliding[k] else -1)
        if not sliding[i] and not sliding[k]:
            values.append((origin[k] - origin[i]) @ np.cross(z[i], z[k]) / size)
            mirrored.append(-1)
    for three in combinations(range(len(z)), 3):
        a, b, c = z[list(three)]
        values.append(a @ np.cross(b, c))
        mirrored.append(-1 if sliding[list(three)].sum() % 2 else 1)
    return np.array(values), np.array(mirrored)


def _distances(z: np.ndarray, origin: np.ndarray, sliding: np.ndarray) -> np.ndarray:
    """Returns the distance of every two revolute axes; for two nearly parallel ones, the distance across them."""
    distances = []
    for i, k in combinations(np.flatnonzero(~sliding), 2):
        between, normal = origin[k] - origin[i], np.cross(z[i], z[k])
        sine = np.linalg.norm(normal)
        parallel = sine < np.sin(AGREES_RAD)
        distances.append(np.linalg.norm(np.cross(between, z[i])) if parallel else abs(between @ normal) / sine)
    return np.array(distances)


def require_like_nominal(where: str, frames: list[Rigid], nominal: Robot) -> None:
    """Refuses mirrored positions, joints that count the other way, and another build."""
    rotation, origin = joint_frames(nominal.chain(), np.zeros((1, len(frames))))
    wanted, directions = rotation[:, 0, :, 2], np.array([f.rotation[:, 2] for f in frames])
    places = np.array([f.translation for f in frames])
    shape, _ = _shape(wanted, origin[:, 0], nominal.prismatic)
    values, mirror = _shape(directions, places, nominal.prismatic)
    as_it_is, mirrored = (float(np.linalg.norm(v - shape)) for v in (values, values * mirror))
    reversed_ = {}
    for flipped in chain.from_iterable(combinations(range(len(frames)), k) for k in range(1, MANY)):
        sign = np.where(np.isin(np.arange(len(frames)), flipped), -1.0, 1.0)
        reversed_[flipped] = float(
            np.linalg.norm(_shape(directions * sign[:, None], places, nominal.prismatic)[0] - shape)
        )
    best = min(reversed_, key=lambda flipped: reversed_[flipped])
    if mirrored < as_it_is / 2 and mirrored <= LIKELY * reversed_[best]:
        raise InputError(
            "E-AXES-MIRRORED",
            f"{where}: the axes are the mirror image of robot {nominal.name}'s: positions of a left-handed frame (or "
            "joints that count the other way); swap two columns of x, y, z or change the sign of one",
        )
    if reversed_[best] < as_it_is / 2:
        named = ", ".join(str(i + 1) for i in best)
        raise InputError(
            "E-AXES-SIGN",
            f"{where}: joint {named} counts against robot {nominal.name}'s; correct alpha in the robot file or "
            "the sign of its values",
        )
    apart, right = (
        _distances(z, o, nominal.prismatic).sum() for z, o in ((directions, places), (wanted, origin[:, 0]))
    )
    if right > 0 and not 1 / LIKE_SIZE < apart / right < LIKE_SIZE:
        raise InputError(
            "E-AXES-UNITS",
            f"{where}: the axes lie {apart / right:.3g} times as far apart as robot {nominal.name}'s; check the unit "
            "of x, y, z, and the lengths in the robot file",
        )
    for i in range(len(frames) - 1):
        angle, right = (np.degrees(np.arccos(np.clip(z[i] @ z[i + 1], -1, 1))) for z in (directions, wanted))
        if abs(angle - right) > np.degrees(AGREES_RAD):
            raise InputError(
                "E-AXES-ANGLE",
                f"{where}: axes of joints {i + 1} and {i + 2} are {angle:.1f}° apart, {right:.1f}° in robot "
                f"{nominal.name}; correct its alpha or theta, or the sign with which a joint counts",
            )
