"""From the camera to the robot: base_from_obj = base_from_flange · flange_from_camera · camera_from_obj · offset."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from stcal.errors import InputError
from stcal.geometry.rigid import Rigid
from stcal.geometry.uncertain import UncertainRigid
from stcal.io.json import Matrix, Matrix4, Part, Pose, PoseCovariance, read_result
from stcal.io.quaternions import Order
from stcal.io.table import read_table

MOVING, FIXED = "flange_from_camera", "base_from_camera"
ROBOT = "base_from_flange_"


class HandEyeRead(Part):
    """What of the file of ``stcal handeye`` is needed here."""

    format: Literal["stcal handeye 1"] = "stcal handeye 1"
    flange_from_camera: Pose | None = None
    base_from_camera: Pose | None = None
    covariance: PoseCovariance | None = None


class RegistrationRead(Part):
    """What of the file of ``stcal register`` is needed here: a is the camera's frame, b the robot's base."""

    format: Literal["stcal registration 1"] = "stcal registration 1"
    model: str
    method: str
    b_from_a: Matrix4
    covariance: Matrix


class OffsetFile(Part):
    """Where to go in the target's frame, exact."""

    obj_from_goal: Pose


ROTATION_WITHIN = 1e-6
"""Of RᵀR − 1: a rigid registration is written with all its digits."""


@dataclass(frozen=True, slots=True, eq=False)
class GoalChain:
    """``mount`` : flange_from_camera of a camera on the flange, base_from_camera of a fixed one; ``flange`` :
    base_from_flange by scene, empty for a fixed camera; ``offset`` : obj_from_goal, exact; ``source`` : of ``mount``,
    for messages."""

    mount: UncertainRigid
    moving: bool
    flange: dict[str, UncertainRigid]
    offset: Rigid
    source: str = "hand-eye file"

    def base_from_goal(self, scene: str, camera_from_obj: UncertainRigid) -> UncertainRigid:
        """The target's pose (with the offset) in the robot's base; the errors of all links add up.

        Raises
        ------
        InputError
            No robot pose of this scene.
        """
        chain = self.mount @ camera_from_obj @ UncertainRigid.exact(self.offset)
        if not self.moving:
            return chain
        if scene not in self.flange:
            raise InputError(
                "E-ROBOT-POSES-SCENE", f"robot poses: none of scene {scene}; add a row, or take its exposures away"
            )
        return self.flange[scene] @ chain

    def without_pose(self, scenes: Sequence[str]) -> list[str]:
        """Scenes that the robot poses lack."""
        return [scene for scene in scenes if self.moving and scene not in self.flange]


def read_chain(
    hand_eye: str | Path,
    robot_poses: str | Path | None,
    offset: str | Path | None = None,
    quaternions: Order = "wxyz",
    key: str = "scene",
) -> GoalChain:
    """Read the hand-eye file of ``stcal handeye``, the robot's poses by scene, and the offset.

    ``quaternions`` : of the robot's poses, ``xyzw`` where the columns hold x, y, z, w in the order in which they stand.
    ``key`` : the column of the robot's poses that names the scenes.

    Raises
    ------
    InputError
        A file that is not as ``data_layout.md`` has it, or robot poses that are missing, or given for a fixed camera.
    """
    mounted = read_result(hand_eye, HandEyeRead, "hand-eye file", "give the file of stcal handeye")
    where = f"hand-eye file {hand_eye}"
    either = {MOVING: mounted.flange_from_camera, FIXED: mounted.base_from_camera}
    found = {name: matrix for name, matrix in either.items() if matrix is not None}
    if len(found) != 1:
        raise InputError("E-HANDEYE-FILE", f"{where}: {' and '.join(found) or 'neither'}; {MOVING} or {FIXED} needed")
    [(name, matrix)] = found.items()
    covariance = np.zeros((6, 6)) if mounted.covariance is None else mounted.covariance
    mount = UncertainRigid(Rigid.from_matrix(matrix), covariance)
    moving = name == MOVING
    if moving and robot_poses is None:
        raise InputError(
            "E-OPTION-MISSING",
            f"{where}: the camera is on the flange; robot poses of the scenes (--robot-poses) needed",
        )
    if not moving and robot_poses is not None:
        raise InputError(
            "E-OPTION-NEEDS", f"{where}: the camera is fixed; it needs no robot poses, leave --robot-poses away"
        )
    flange = read_robot_poses(robot_poses, quaternions, key) if robot_poses else {}
    return GoalChain(mount, moving, flange, _offset(offset))


def read_registered(registration: str | Path, offset: str | Path | None = None) -> GoalChain:
    """Read the file of ``stcal register`` for points that a fixed camera (a) and the robot (b, its base) measured.

    Raises
    ------
    InputError
        A file that is not as ``data_layout.md`` has it, or a registration that is not rigid.
    """
    advice = "give the file of stcal register --out"
    read = read_result(registration, RegistrationRead, "registration file", advice)
    where = f"registration file {registration}"
    linear = read.b_from_a[:3, :3]
    off = float(np.abs(linear.T @ linear - np.eye(3)).max())
    if read.covariance.shape != (6, 6) or off > ROTATION_WITHIN or np.linalg.det(linear) < 0:
        kind = read.method if read.method == "liu2017" else read.model
        raise InputError(
            "E-REGISTER-FILE",
            f"{where}: b_from_a is no rigid motion ({kind}: RᵀR is {off:.2g} from 1); base_from_camera needs one, "
            "register with --model rigid",
        )
    mount = UncertainRigid(Rigid.from_matrix(read.b_from_a), read.covariance)
    return GoalChain(mount, False, {}, _offset(offset), "registration file")


def _offset(offset: str | Path | None) -> Rigid:
    if offset is None:
        return Rigid()
    read = read_result(offset, OffsetFile, "offset file", "a 4×4 matrix under the key obj_from_goal needed")
    return Rigid.from_matrix(read.obj_from_goal)


def read_robot_poses(path: str | Path, quaternions: Order = "wxyz", key: str = "scene") -> dict[str, UncertainRigid]:
    """base_from_flange of each scene, named in column ``key``, from ``x_mm … qz``, or ``base_from_flange_x_mm …``."""
    table = read_table(path, "robot poses", quaternions)
    prefix = ROBOT if any(column.startswith(ROBOT) for column in table.columns) else ""
    poses, covariances = table.poses(prefix), table.pose_covariances(prefix)
    found = {}
    for row, (name, pose) in enumerate(zip(table.text(key), poses, strict=True)):
        if name in found:
            raise InputError(
                "E-TABLE-ROW-REPEATED",
                f"{table.where}: line {table.lines[row]}: scene {name} again; every scene once needed",
            )
        found[name] = UncertainRigid(pose, np.zeros((6, 6)) if covariances is None else covariances[row])
    return found
