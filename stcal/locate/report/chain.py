"""From the camera to the robot: base_from_obj = base_from_flange · flange_from_camera · camera_from_obj · offset."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stcal.errors import InputError
from stcal.geometry.rigid import Rigid
from stcal.geometry.uncertain import UncertainRigid
from stcal.io.table import read_table

MOVING, FIXED = "flange_from_camera", "base_from_camera"
ROBOT = "base_from_flange_"


@dataclass(frozen=True, slots=True, eq=False)
class Chain:
    """``mount`` : flange_from_camera of a camera on the flange, base_from_camera of a fixed one; ``flange`` :
    base_from_flange by scene, empty for a fixed camera; ``offset`` : obj_from_goal, exact."""

    mount: UncertainRigid
    moving: bool
    flange: dict[str, UncertainRigid]
    offset: Rigid

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
            raise InputError(f"robot poses: none of scene {scene}; add a row, or take its exposures away")
        return self.flange[scene] @ chain

    def without_pose(self, scenes: Sequence[str]) -> list[str]:
        """Scenes that the robot poses lack."""
        return [scene for scene in scenes if self.moving and scene not in self.flange]


def read_chain(hand_eye: str | Path, robot_poses: str | Path | None, offset: str | Path | None = None) -> Chain:
    """Read the hand-eye file of ``stcal handeye``, the robot's poses by scene, and the offset.

    Raises
    ------
    InputError
        A file that is not as ``data_layout.md`` has it, or robot poses that are missing, or given for a fixed camera.
    """
    data = _json(hand_eye, "hand-eye file")
    where = f"hand-eye file {hand_eye}"
    names = [name for name in (MOVING, FIXED) if name in data]
    if len(names) != 1:
        raise InputError(f"{where}: {' and '.join(names) or 'neither'}; {MOVING} or {FIXED} needed")
    covariance = np.zeros((6, 6)) if data.get("covariance") is None else data["covariance"]
    mount = UncertainRigid(_matrix(data[names[0]], f"{where}: {names[0]}"), _numbers(covariance, where))
    moving = names[0] == MOVING
    if moving and robot_poses is None:
        raise InputError(f"{where}: the camera is on the flange; robot poses of the scenes (--robot-poses) needed")
    if not moving and robot_poses is not None:
        raise InputError(f"{where}: the camera is fixed; it needs no robot poses, leave --robot-poses away")
    shift = Rigid()
    if offset is not None:
        content = _json(offset, "offset file")
        if "obj_from_goal" not in content:
            raise InputError(f"offset file {offset}: no obj_from_goal; a 4×4 matrix under this key needed")
        shift = _matrix(content["obj_from_goal"], f"offset file {offset}")
    return Chain(mount, moving, read_robot_poses(robot_poses) if robot_poses else {}, shift)


def read_robot_poses(path: str | Path) -> dict[str, UncertainRigid]:
    """base_from_flange of each scene, from columns ``scene`` and ``x_mm … qz``, or ``base_from_flange_x_mm …``."""
    table = read_table(path, "robot poses")
    prefix = ROBOT if any(column.startswith(ROBOT) for column in table.columns) else ""
    poses, covariances = table.poses(prefix), table.pose_covariances(prefix)
    found = {}
    for row, (name, pose) in enumerate(zip(table.text("scene"), poses, strict=True)):
        if name in found:
            raise InputError(f"{table.where}: line {table.lines[row]}: scene {name} again; every scene once needed")
        found[name] = UncertainRigid(pose, np.zeros((6, 6)) if covariances is None else covariances[row])
    return found


def _json(path: str | Path, what: str) -> dict:
    try:
        data = json.loads(Path(path).read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise InputError(f"{what} {path}: {error.strerror or error}; check the path") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{what} {path}: not JSON ({' '.join(str(error).split())[:100]})") from error
    if not isinstance(data, dict):
        raise InputError(f"{what} {path}: a {type(data).__name__}; an object with named keys needed")
    return data


def _matrix(value, where: str) -> Rigid:
    try:
        return Rigid.from_matrix(_numbers(value, where))
    except InputError as error:
        raise InputError(f"{where}: {str(error).removeprefix(f'{where}: ')}") from error


def _numbers(value, where: str) -> np.ndarray:
    try:
        return np.array(value, float)
    except (ValueError, TypeError) as error:
        raise InputError(f"{where}: not a matrix of numbers; correct it") from error
