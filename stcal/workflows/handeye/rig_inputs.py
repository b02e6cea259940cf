"""What a rig is calibrated from: the images of each camera, and the robot's poses that several of them share."""

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from stcal.boards.several import load_boards
from stcal.errors import InputError
from stcal.geometry.rigid import Poses, Rigid
from stcal.handeye.data.formats.record import Said
from stcal.handeye.data.rig import RigCamera, RigPoses
from stcal.handeye.data.rig_file import RigFiles
from stcal.handeye.data.robot_poses import RobotPoses, read_robot_poses
from stcal.handeye.data.stream import TOLERANCE_S
from stcal.io.quaternions import Order
from stcal.parallel import Progress, one_thread
from stcal.workflows.handeye.inputs import Photographed, photographed, pitch_of
from stcal.workflows.handeye.times import Timing


@dataclass(frozen=True, slots=True, eq=False)
class RigInput:
    """``files``; ``given``; ``symmetries`` of the board and its ``pitch_mm``; ``left_out`` : of each camera (image or
    row, why); ``understood`` : a line on each file of poses, and on what the cameras share; ``notes``."""

    files: RigFiles
    given: RigPoses
    symmetries: tuple[Rigid, ...]
    pitch_mm: float | None
    left_out: tuple[tuple[tuple[str, str], ...], ...]
    understood: tuple[str, ...]
    notes: tuple[str, ...] = ()


@one_thread()
def read_rig(
    files: RigFiles,
    workers: int | None = None,
    progress: Progress = lambda *_: None,
    quaternions: Order = "wxyz",
    said: Said | None = None,
    tolerance_s: float = TOLERANCE_S,
) -> RigInput:
    """The board in all images of all cameras, with the robot's poses.

    Raises
    ------
    InputError
        What is wrong with a file; the message names the camera.
    """
    design, cameras = load_boards(files.board), []
    by_file = {each.poses: read_robot_poses(each.poses, quaternions, said) for each in files.cameras}
    robots = [_of_camera(by_file[each.poses], each.images, files) for each in files.cameras]
    for each, robot in zip(files.cameras, robots, strict=True):
        named, timing = partial(_named, progress, each.name), Timing(tolerance_s, each.times)
        try:
            seen = photographed(each.images, robot, each.camera, design, workers, named, timing)
        except InputError as error:
            raise InputError(error.code, f"camera {each.name}: {error}") from error
        cameras.append(seen)
    flange, names, rows = _shared([(seen.robot, seen) for seen in cameras])
    every = tuple(
        RigCamera(each.name, seen.seen, own, seen.names, seen.prior)
        for each, seen, own in zip(files.cameras, cameras, rows, strict=True)
    )
    given = RigPoses(flange, every, names, files.file.name)
    understood = [f"robot: {robot.understood}" for robot in by_file.values()]
    for each, seen in zip(files.cameras, cameras, strict=True):
        understood += [f"{each.name}: images matched {seen.how}"] if seen.how else []
        if seen.timed is not None:
            understood.append(f"{each.name}: {seen.robot.understood}")
    shared = np.bincount(np.concatenate(rows), minlength=len(names)) > 1
    if len(every) > 1:
        understood.append(f"{int(shared.sum())} of {len(names)} poses of the robot are of several cameras' images")
    notes: tuple[str, ...] = ()
    if len(every) > 1 and not shared.any():
        notes += ("no pose of the robot is of two cameras' images: they share the board alone",)
    if any(robot.covariance is not None for robot in by_file.values()):
        notes += ("covariances of the robot's poses are not used for a rig: σ of the robot are estimated",)
    left_out = tuple(seen.left_out for seen in cameras)
    return RigInput(files, given, cameras[0].symmetries, pitch_of(design), left_out, tuple(understood), notes)


def _named(progress: Progress, name: str, stage: str, done: int, total: int) -> None:
    progress(f"{stage}, {name}", done, total)


def _of_camera(robot: RobotPoses, images: Path, files: RigFiles) -> RobotPoses:
    """Rows of one camera, where a file names all cameras' images with the folders in which they lie."""
    folders = {each.images.name for each in files.cameras}
    prefixed = [image.partition("/")[0] in folders and "/" in image for image in robot.images]
    if not all(prefixed) or not prefixed:
        return robot
    own = [i for i, image in enumerate(robot.images) if image.partition("/")[0] == images.name]
    if not own:
        raise InputError(
            "E-POSES-UNMATCHED",
            f"{robot.where}: no row is of an image in {images}: {robot.images[0]} … there; correct them",
        )
    return replace(
        robot,
        images=tuple(robot.images[i].partition("/")[2] for i in own),
        base_from_flange=robot.base_from_flange[own],
        covariance=None if robot.covariance is None else robot.covariance[own],
        places=tuple(robot.places[i] for i in own),
    )


def _shared(cameras: list[tuple[RobotPoses, Photographed]]) -> tuple[Poses, tuple[str, ...], list[np.ndarray]]:
    """Poses of the robot that any image is of, what each is called, and those of each camera's images.

    Measured values are never equal to the last digit: equal poses are one, whatever the row or the file. A camera that
    has one pose twice says that poses are commanded ones: then a row of a file is a pose.
    """
    keys = []
    for _, seen in cameras:
        taken = seen.base_from_flange[seen.rows]
        both = zip(taken.rotation, taken.translation, strict=True)
        keys.append([turn.tobytes() + place.tobytes() for turn, place in both])
    if any(len(set(own)) < len(own) for own in keys):
        keys = [[f"{robot.where}: {robot.places[r]}".encode() for r in seen.rows] for robot, seen in cameras]
    number: dict[bytes, int] = {}
    flange, names, rows = [], [], []
    for (robot, seen), own in zip(cameras, keys, strict=True):
        for name, row, key in zip(seen.names, seen.rows, own, strict=True):
            if key not in number:
                number[key] = len(number)
                flange.append(seen.base_from_flange[int(row)])
                names.append(robot.images[row] if robot.images else name)
        rows.append(np.array([number[key] for key in own]))
    return Poses.of(flange), tuple(names), rows
