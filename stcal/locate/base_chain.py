"""Chain base_from_goal = base_from_flange · flange_from_camera · camera_from_goal, its plausibility, and the poses that
``locate run`` gives in the base beside camera_from_obj."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from stcal.errors import InputError
from stcal.explain import Candidate, explain
from stcal.geometry.arrays import Brief, require_arguments, rms
from stcal.geometry.rigid import Order, Poses, Rigid, UncertainRigid
from stcal.io.json import Matrix, Part, Pose, PoseCovariance, TransformMatrix, checked, read_result
from stcal.io.rotations import READINGS
from stcal.io.table import LENGTHS, UNIT_WORDS, read_table
from stcal.locate.scenes import Located

MOVING, FIXED = "flange_from_camera", "base_from_camera"
ROBOT = "base_from_flange_"


class HandEyeRead(Part):
    """Part of the file of ``stcal handeye`` that is read here."""

    format: Literal["stcal handeye 1"] = "stcal handeye 1"
    flange_from_camera: Pose | None = None
    base_from_camera: Pose | None = None
    covariance: PoseCovariance | None = None


class RegistrationRead(Part):
    """Part of the file of ``stcal register`` that is read here: a is the camera's frame, b the robot's base."""

    format: Literal["stcal registration 1"] = "stcal registration 1"
    model: str
    method: str
    b_from_a: TransformMatrix
    covariance: Matrix


class OffsetFile(Part):
    """File of the goal's pose in the target's frame, which is exact."""

    obj_from_goal: Pose


ROTATION_WITHIN = 1e-6
"""Largest element of RᵀR − 1 of a rotation. The file of a rigid registration holds all digits."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class GoalChain(Brief):
    """Chain of transforms from the camera to the robot's base, made by :func:`~stcal.locate.goal_chain`.

    ``mount`` : flange_from_camera of a camera on the flange, base_from_camera of a fixed camera; mm; ``moving`` :
    whether the camera is on the flange; ``flange`` : base_from_flange by scene, mm; empty for a fixed camera;
    ``offset`` : obj_from_goal, mm, which is exact; ``source`` : origin of ``mount``, for messages; ``poses_source`` :
    origin of ``flange``, for messages.
    """

    mount: UncertainRigid
    moving: bool
    flange: dict[str, UncertainRigid]
    offset: Rigid
    source: str = "hand-eye file"
    poses_source: str = "robot poses"

    def base_from_goal(self, scene: str, camera_from_obj: UncertainRigid) -> UncertainRigid:
        """Returns the goal's pose in the robot's base, with the errors of all links; InputError: no robot pose."""
        self.require_poses([scene])
        chain = self.mount @ camera_from_obj @ UncertainRigid.exact(self.offset)
        return self.flange[scene] @ chain if self.moving else chain

    def require_poses(self, scenes: Sequence[str]) -> None:
        """Refuses scenes without a robot pose, by InputError."""
        if self.moving and (missing := [scene for scene in scenes if scene not in self.flange]):
            fault = f"{self.poses_source}: none of scene {missing[0]}"
            raise InputError("E-ROBOT-POSES-SCENE", f"{fault}; add a row, or remove the scene")


def _mounted(hand_eye: object, robot_poses: object) -> tuple[bool, UncertainRigid]:
    """Returns whether the camera is on the flange, and its pose; robot poses decide what an unnamed transform is."""
    if isinstance(hand_eye, Rigid):
        return robot_poses is not None, UncertainRigid.exact(hand_eye)
    if isinstance(hand_eye, str | Path):
        read = read_result(hand_eye, HandEyeRead, "hand-eye file", "give the file of stcal handeye")
    else:
        transforms = getattr(hand_eye, "transforms", {})
        read = checked({**transforms, "covariance": getattr(hand_eye, "covariance", None)}, HandEyeRead)
    either = {MOVING: read.flange_from_camera, FIXED: read.base_from_camera}
    given = {name: Rigid.from_matrix(matrix) for name, matrix in either.items() if matrix is not None}
    if len(given) != 1:
        found = f"{_named('hand-eye', hand_eye)}: {' and '.join(given) or 'neither'}"
        raise InputError("E-HANDEYE-FILE", f"{found}; {MOVING} or {FIXED} needed")
    [(name, pose)] = given.items()
    return name == MOVING, UncertainRigid(pose, np.zeros((6, 6)) if read.covariance is None else read.covariance)


def _registered(registration: object) -> UncertainRigid:
    """Returns base_from_camera by a registration of camera (a) and base (b); raises InputError: not rigid."""
    if isinstance(registration, str | Path):
        advice = "give the file of stcal register --out"
        read = read_result(registration, RegistrationRead, "registration file", advice)
    else:
        read = RegistrationRead.model_validate(registration)
    linear = read.b_from_a[:3, :3]
    residual = float(np.abs(linear.T @ linear - np.eye(3)).max())
    if read.covariance.shape != (6, 6) or residual > ROTATION_WITHIN or np.linalg.det(linear) < 0:
        kind = read.method if read.method == "liu2017" else read.model
        fault = f"b_from_a is no rigid motion ({kind}: RᵀR is {residual:.2g} from 1)"
        remedy = "base_from_camera needs one, register with --model rigid"
        raise InputError("E-REGISTER-FILE", f"{_named('registration', registration)}: {fault}; {remedy}")
    return UncertainRigid(Rigid.from_matrix(read.b_from_a), read.covariance)


def _named(what: str, given: object) -> str:
    """Returns the name of an argument for messages, with its file if it is one."""
    return f"{what} file {given}" if isinstance(given, str | Path) else what


def read_robot_poses(path: str | Path, quaternions: Order = "wxyz", key: str = "scene") -> dict[str, UncertainRigid]:
    """Reads base_from_flange of each scene, column ``key``, from ``x_mm … qz`` or ``base_from_flange_x_mm …``."""
    table = read_table(path, "robot poses", quaternions)
    prefix = ROBOT if any(column.startswith(ROBOT) for column in table.columns) else ""
    poses, covariances = table.poses(prefix), table.pose_covariances(prefix)
    scenes, every = table.text(key), np.zeros((len(table), 6, 6)) if covariances is None else covariances
    table.refuse(
        np.array([name in scenes[:row] for row, name in enumerate(scenes)], bool),
        "E-TABLE-ROW-REPEATED",
        lambda row: f"scene {scenes[row]} again; every scene once needed",
    )
    return {name: UncertainRigid(pose, own) for name, pose, own in zip(scenes, poses, every, strict=True)}


NEAR_BASE_MM, NEAR_FLANGE_MM = 20.0, 2.0
"""Least distances of flange or camera from the base's origin in the robot's foot, and of a camera from the flange's.
Metres that are read as mm are less: 20 m become 20 mm, 2 m become 2 mm. Exact zeros are taken as intended."""
STILL, STILL_RAD = 0.02, np.radians(2)
"""Largest RMS variation between scenes of a target that stands still: share of its distance from the camera, angle."""
FAR_BETTER, BETTER = 30.0, 5.0
"""Factors by which the product of both variations, and that in position, must shrink in another convention."""
UNITS = ("m", "in")  # units in which lengths may be given by mistake instead of mm


def on_chain(chain: GoalChain, seen: Mapping[str, UncertainRigid]) -> tuple[str, ...]:
    """Returns notes on doubtful robot poses or hand-eye transforms by camera_from_obj of scenes. Raises InputError: a
    target stands still, while the flange turns, in another unit or convention only."""
    scenes = [scene for scene in seen if scene in chain.flange]
    if chain.moving and len(scenes) > 1:
        flange = Poses.of([chain.flange[scene].rigid for scene in scenes])
        _require_standing(chain.mount.rigid, flange, Poses.of([seen[scene].rigid for scene in scenes]))
    apart = max((float(np.linalg.norm(each.rigid.translation)) for each in chain.flange.values()), default=0.0)
    mounted = float(np.linalg.norm(chain.mount.rigid.translation))
    frame, least = ("flange", NEAR_FLANGE_MM) if chain.moving else ("base", NEAR_BASE_MM)
    notes = {
        f"robot poses: the flange is within {apart:.2g} mm of the base's origin in all scenes, more than "
        f"{NEAR_BASE_MM:g} mm expected: if lengths are metres, name the columns _m": 0 < apart < NEAR_BASE_MM,
        f"{chain.source}: the camera is {mounted:.2g} mm from the origin of the {frame}, more than {least:g} mm "
        "expected: if its lengths are metres, multiply them by 1000": 0 < mounted < least,
    }
    return tuple(note for note, doubtful in notes.items() if doubtful)


def _require_standing(mount: Rigid, flange: Poses, seen: Poses) -> None:
    still_mm = STILL * float(np.median(np.linalg.norm(seen.translation, axis=1)))
    mm, rad = _varies(flange @ mount @ seen)
    if mm < still_mm and rad < STILL_RAD:
        return

    def variation(robot_and_camera: tuple[Poses, Rigid]) -> float:
        robot, camera = robot_and_camera
        left_mm, left_rad = _varies(robot @ camera @ seen)
        stands = left_mm < min(still_mm, mm / BETTER) and left_rad < STILL_RAD
        return left_mm * left_rad if stands else np.inf

    for mistake, _ in explain(_mistakes(mount, flange), variation, mm * rad / FAR_BETTER)[:1]:
        robot, camera = mistake.change()
        left_mm, left_rad = _varies(robot @ camera @ seen)
        varies = f"{mm:.3g} mm and {np.degrees(rad):.3g}° (RMS of {len(seen)} scenes)"
        fault = f"robot poses and hand-eye: the target's pose in the base varies by {varies}"
        less = f"{left_mm:.2g} mm and {np.degrees(left_rad):.2g}°"
        raise InputError("E-LOCATE-VARIES", f"{fault}, but by {less} if {mistake.words}")


def _mistakes(mount: Rigid, flange: Poses) -> Iterator[Candidate]:
    """Yields frequent mistakes with their remedy, and base_from_flange and flange_from_camera after the remedy."""
    cases = [(f"the robot's quaternions were {r.held}; {r.remedy}", r.poses(flange), mount) for r in READINGS]
    cases.append(("the robot's poses were flange_from_base; give base_from_flange", flange.inverse(), mount))
    cases.append(("the hand-eye were camera_from_flange; give flange_from_camera", flange, mount.inverse()))
    for unit in UNITS:
        by, named = LENGTHS[unit], UNIT_WORDS[unit]
        longer = replace(flange, translation=by * flange.translation)
        cases.append((f"the robot's lengths were {named}; name the columns _{unit}", longer, mount))
        farther = Rigid(mount.rotation, by * mount.translation)
        cases.append((f"the hand-eye's lengths were {named}; multiply them by {by:g}", flange, farther))
    for words, *case in cases:
        yield Candidate(words, partial(tuple, case))


def _varies(found: Poses) -> tuple[float, float]:
    """Returns the RMS deviations from the mean pose: mm and rad."""
    turns = Rotation.from_matrix(np.array(found.rotation))
    mm = np.linalg.norm(found.translation - found.translation.mean(axis=0), axis=1)
    return max(rms(mm), 1e-9), max(rms((turns.mean().inv() * turns).magnitude()), 1e-9)


def uncertain(located: Located) -> UncertainRigid:
    """Returns camera_from_obj with its covariance, which is zero for the patent's method."""
    pose = located.camera_from_obj
    if pose is None:
        raise InputError("E-LOCATED-NO-POSE", f"{located.name}: no pose; {located.verdict.decision}")
    return UncertainRigid(pose, np.zeros((6, 6)) if located.pose is None else located.pose.covariance)


def accepted(results: Sequence[Located]) -> list[Located]:
    """Returns the results whose pose may be used."""
    return [each for each in results if each.verdict.decision == "accept"]


@require_arguments
def goal_chain(
    hand_eye: object | None = None,
    registration: object | None = None,
    *,
    robot_poses: Mapping[str, Rigid] | str | Path | None = None,
    offset: Rigid | str | Path | None = None,
    key: str = "scene",
    quaternions: Order = "wxyz",
) -> GoalChain:
    """Returns the chain base_from_goal = base_from_flange · flange_from_camera · camera_from_obj · obj_from_goal.

    For a fixed camera, base_from_camera stands in place of the first two.

    Parameters
    ----------
    hand_eye : result of :func:`stcal.handeye.handeye`, or its file; or an exact transform, mm: flange_from_camera with
        ``robot_poses``, base_from_camera without.
    registration : result of :func:`stcal.register.register`, or its file, in place of ``hand_eye``. It must be rigid; a
        is the frame of a fixed camera, b the robot's base.
    robot_poses : base_from_flange of each scene by its name, mm, exact; or a table of them (CSV), whose covariances are
        used. Needed for a camera on the flange only.
    offset : obj_from_goal, mm, exact; or a file with it (JSON). The goal is the target itself by default.
    key : column of the table that names the scenes.
    quaternions : {"wxyz", "xyzw"}; order of the table's quaternions: by the names of their columns, or x, y, z, w in
        the order of the columns.

    Returns
    -------
    GoalChain : for :func:`~stcal.locate.goals` and :func:`~stcal.locate.poses_csv`.

    Raises InputError: neither or both of ``hand_eye`` and ``registration`` are given, robot poses are missing or not
    needed, the registration is not rigid, or a file does not follow ``data_layout.md``.
    """
    two = "of --hand-eye and --registration, which lead to the robot's base"
    if hand_eye is not None and registration is not None:
        raise InputError("E-OPTION-CONFLICT", f"goals: both {two}; give one")
    if hand_eye is None and registration is None:
        raise InputError("E-OPTION-MISSING", f"goals: neither {two}; give one")
    if hand_eye is None:
        moving, mount, source = False, _registered(registration), _named("registration", registration)
    else:
        (moving, mount), source = _mounted(hand_eye, robot_poses), _named("hand-eye", hand_eye)
    if moving and robot_poses is None:
        fault = f"{source}: the camera is on the flange"
        raise InputError("E-OPTION-MISSING", f"{fault}; robot poses of the scenes (--robot-poses) needed")
    if not moving and robot_poses is not None:
        fault = f"{source}: the camera is fixed and needs no robot poses"
        raise InputError("E-OPTION-NEEDS", f"{fault}; leave --robot-poses out")
    if isinstance(offset, str | Path):
        read = read_result(offset, OffsetFile, "offset file", "a 4×4 matrix under the key obj_from_goal needed")
        offset = Rigid.from_matrix(read.obj_from_goal)
    if isinstance(robot_poses, str | Path):
        flange, poses_source = read_robot_poses(robot_poses, quaternions, key), f"robot poses {robot_poses}"
    else:
        flange = {scene: UncertainRigid.exact(pose) for scene, pose in (robot_poses or {}).items()}
        poses_source = "robot poses"
    return GoalChain(mount, moving, flange, offset or Rigid(), source, poses_source)


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Goals(Brief):
    """Goals of the accepted scenes in the robot's base.

    ``base_from_goal`` : pose by scene, mm; ``covariance`` : (6, 6) of each, rad and mm, left perturbation in the base,
    with the errors of all links of the chain (the patent's method states none); ``notes`` : doubts about the robot's
    poses or the transform.
    """

    base_from_goal: dict[str, Rigid]
    covariance: dict[str, np.ndarray]
    notes: tuple[str, ...] = ()


@require_arguments
def goals(results: Sequence[Located], chain: GoalChain) -> Goals:
    """Returns the goal's pose in the robot's base of each accepted scene, so that no robot moves to a rejected one.

    ``results`` : of :func:`~stcal.locate.run` or :func:`~stcal.locate.locate_image`, by whose names the robot's poses
    are found; ``chain`` : to the robot's base, of :func:`~stcal.locate.goal_chain`.

    Raises InputError: a scene has no robot pose; or the target stands still between the scenes only in another unit or
    convention of the robot's poses or the transform, which the message names.
    """
    chain.require_poses([each.name for each in results])
    seen = {each.name: uncertain(each) for each in accepted(results)}
    notes = on_chain(chain, seen)
    found = {name: chain.base_from_goal(name, pose) for name, pose in seen.items()}
    covariances = {name: goal.covariance for name, goal in found.items()}
    return Goals({name: goal.rigid for name, goal in found.items()}, covariances, notes)
