"""Plausibility of robot poses and hand-eye transform: by distances, and by a target that stands still."""

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.errors import InputError
from stcal.geometry.rigid import Poses, Rigid
from stcal.geometry.uncertain import UncertainRigid
from stcal.io.quaternions import READINGS
from stcal.io.table import LENGTHS, UNIT_WORDS
from stcal.locate.report.chain import GoalChain

NEAR_BASE_MM, NEAR_FLANGE_MM = 20.0, 2.0
"""Least distances of flange or camera from the base's origin, which is in the robot's foot, and of a camera with its
housing from the flange's origin. Lengths in metres that are read as mm are smaller: 20 m become 20 mm, 2 m become 2 mm.
Exact zeros are taken as intended."""
STILL, STILL_RAD = 0.02, np.radians(2)
"""Largest RMS variation between scenes of a target that stands still: share of its distance from the camera, angle."""
FAR_BETTER, BETTER = 30.0, 5.0
"""Factors by which the product of both variations, and the variation in position, must shrink in another convention.
A target that moves does not stand still to 2 % of its distance in another convention by chance."""
UNITS = ("m", "in")
"""Units in which lengths may be given by mistake instead of mm."""


def on_chain(chain: GoalChain, seen: Mapping[str, UncertainRigid]) -> tuple[str, ...]:
    """Returns notes on doubtful robot poses or hand-eye transforms, judged by camera_from_obj of the scenes.

    A target that stands still while the flange turns reveals the convention. A single scene, a flange that stands still
    too, or a target that moves reveal nothing.

    Raises
    ------
    InputError
        The target would stand still in another unit or convention only; the message says which.
    """
    scenes = [scene for scene in seen if scene in chain.flange]
    if chain.moving and len(scenes) > 1:
        flange = Poses.of([chain.flange[scene].rigid for scene in scenes])
        _require_standing(chain.mount.rigid, flange, Poses.of([seen[scene].rigid for scene in scenes]))
    return (*_robot_near(chain), *_camera_near(chain))


def _robot_near(chain: GoalChain) -> Iterator[str]:
    distance = max((float(np.linalg.norm(each.rigid.translation)) for each in chain.flange.values()), default=0.0)
    if 0 < distance < NEAR_BASE_MM:
        yield (
            f"robot poses: the flange is within {distance:.2g} mm of the base's origin in all scenes, more than "
            f"{NEAR_BASE_MM:g} mm expected: if lengths are metres, name the columns _m"
        )


def _camera_near(chain: GoalChain) -> Iterator[str]:
    distance = float(np.linalg.norm(chain.mount.rigid.translation))
    frame, least = ("flange", NEAR_FLANGE_MM) if chain.moving else ("base", NEAR_BASE_MM)
    if 0 < distance < least:
        yield (
            f"{chain.source}: the camera is {distance:.2g} mm from the origin of the {frame}, more than {least:g} mm "
            "expected: if its lengths are metres, multiply them by 1000"
        )


def _require_standing(mount: Rigid, flange: Poses, seen: Poses) -> None:
    variation = _varies(flange @ mount @ seen)
    allowed = STILL * float(np.median(np.linalg.norm(seen.translation, axis=1))), STILL_RAD
    if variation[0] < allowed[0] and variation[1] < allowed[1]:
        return
    for reason, robot, camera in _guesses(mount, flange):
        mm, rad = _varies(robot @ camera @ seen)
        gain = variation[0] / max(mm, 1e-9) * variation[1] / max(rad, 1e-9)
        if mm < min(allowed[0], variation[0] / BETTER) and rad < allowed[1] and gain > FAR_BETTER:
            raise InputError(
                "E-LOCATE-VARIES",
                f"robot poses and hand-eye: the target's pose in the base varies by {variation[0]:.3g} mm and "
                f"{np.degrees(variation[1]):.3g}° (RMS of {len(seen)} scenes), but by {mm:.2g} mm and "
                f"{np.degrees(rad):.2g}° if {reason}",
            )


def _guesses(mount: Rigid, flange: Poses) -> Iterator[tuple[str, Poses, Rigid]]:
    """Yields frequent mistakes with their remedy, and base_from_flange and flange_from_camera after the remedy."""
    for reading in READINGS:
        yield f"the robot's quaternions were {reading.held}; {reading.remedy}", reading.poses(flange), mount
    yield "the robot's poses were flange_from_base; give base_from_flange", flange.inverse(), mount
    yield "the hand-eye were camera_from_flange; give flange_from_camera", flange, mount.inverse()
    for unit in UNITS:
        larger = replace(flange, translation=LENGTHS[unit] * flange.translation)
        yield f"the robot's lengths were {UNIT_WORDS[unit]}; name the columns _{unit}", larger, mount
        camera = Rigid(mount.rotation, LENGTHS[unit] * mount.translation)
        yield f"the hand-eye's lengths were {UNIT_WORDS[unit]}; multiply them by {LENGTHS[unit]:g}", flange, camera


def _varies(found: Poses) -> tuple[float, float]:
    """Returns the RMS deviations from the mean pose: mm and rad."""
    turns = Rotation.from_matrix(np.array(found.rotation))
    rad = (turns.mean().inv() * turns).magnitude()
    mm = np.linalg.norm(found.translation - found.translation.mean(axis=0), axis=1)
    return float(np.sqrt((mm**2).mean())), float(np.sqrt((rad**2).mean()))
