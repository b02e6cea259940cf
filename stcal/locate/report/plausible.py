"""Whether robot poses and hand-eye can be meant as they stand: by where things are, and by a target that stands."""

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
"""Nearer no flange or camera comes to the base's origin, which is in the robot's foot, and no camera that has a housing
to the flange's; 20 m in metres are 20 mm, 2 m are 2 mm. Exact zeros are meant."""
STILL, STILL_RAD = 0.02, np.radians(2)
"""Of its distance from the camera, and angle: by less a target that stands still differs between scenes, RMS."""
FAR_BETTER, BETTER = 30.0, 5.0
"""By so many times the product of both must shrink, and the place: targets that move do not stand still by chance in
another convention, to 2 % of their distance."""
UNITS = ("m", "in")
"""What lengths in mm may be."""


def on_chain(chain: GoalChain, seen: Mapping[str, UncertainRigid]) -> tuple[str, ...]:
    """What is doubtful of robot poses and hand-eye, by camera_from_obj of scenes.

    A target that stands still while the flange turns shows the convention. Nothing is told of one scene, of a flange
    that stands still itself, or of a target that moves.

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
    away = max((float(np.linalg.norm(each.rigid.translation)) for each in chain.flange.values()), default=0.0)
    if 0 < away < NEAR_BASE_MM:
        yield (
            f"robot poses: the flange is within {away:.2g} mm of the base's origin in all scenes, more than "
            f"{NEAR_BASE_MM:g} mm expected: if lengths are metres, name the columns _m"
        )


def _camera_near(chain: GoalChain) -> Iterator[str]:
    away = float(np.linalg.norm(chain.mount.rigid.translation))
    frame, least = ("flange", NEAR_FLANGE_MM) if chain.moving else ("base", NEAR_BASE_MM)
    if 0 < away < least:
        yield (
            f"{chain.source}: the camera is {away:.2g} mm from the origin of the {frame}, more than {least:g} mm "
            "expected: if its lengths are metres, multiply them by 1000"
        )


def _require_standing(mount: Rigid, flange: Poses, seen: Poses) -> None:
    own = _varies(flange @ mount @ seen)
    allowed = STILL * float(np.median(np.linalg.norm(seen.translation, axis=1))), STILL_RAD
    if own[0] < allowed[0] and own[1] < allowed[1]:
        return
    for reason, robot, camera in _guesses(mount, flange):
        mm, rad = _varies(robot @ camera @ seen)
        gain = own[0] / max(mm, 1e-9) * own[1] / max(rad, 1e-9)
        if mm < min(allowed[0], own[0] / BETTER) and rad < allowed[1] and gain > FAR_BETTER:
            raise InputError(
                "E-LOCATE-VARIES",
                f"robot poses and hand-eye: the target's pose in the base varies by {own[0]:.3g} mm and "
                f"{np.degrees(own[1]):.3g}° (RMS of {len(seen)} scenes), but by {mm:.2g} mm and "
                f"{np.degrees(rad):.2g}° if {reason}",
            )


def _guesses(mount: Rigid, flange: Poses) -> Iterator[tuple[str, Poses, Rigid]]:
    """Frequent mistakes: what to do, with base_from_flange and flange_from_camera as if it were done."""
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
    """About the mean, RMS: mm and rad."""
    turns = Rotation.from_matrix(np.array(found.rotation))
    rad = (turns.mean().inv() * turns).magnitude()
    mm = np.linalg.norm(found.translation - found.translation.mean(axis=0), axis=1)
    return float(np.sqrt((mm**2).mean())), float(np.sqrt((rad**2).mean()))
