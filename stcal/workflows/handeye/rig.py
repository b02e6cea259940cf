"""Hand-eye calibration of several cameras: inputs and solution."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from stcal.boards.several import load_boards
from stcal.errors import DegenerateError, InputError
from stcal.geometry.arrays import require_arguments
from stcal.geometry.rigid import Order, Poses, Rigid
from stcal.handeye.data.formats.record import Said
from stcal.handeye.data.robot_poses import RobotPoses, read_robot_poses
from stcal.handeye.data.stream import TOLERANCE_S
from stcal.handeye.data.views import RigCamera, RigFiles, RigPoses, read_rig_file
from stcal.handeye.report.outcome import Outcome, RigOutcome
from stcal.handeye.rig import (
    Rig,
    RigHeldOut,
    RigOptions,
    alone_or_none,
    cross_validate_rig,
    handeye_rig,
    of_places,
    same_numbering,
    widened_by_scatter,
)
from stcal.handeye.validate import LEAST_LEFT, splits
from stcal.io.cameras.read import read_camera
from stcal.parallel import Progress, one_thread
from stcal.workflows.handeye.inputs import Photographed, naming_left_out, photographed, pitch_of
from stcal.workflows.handeye.robot_at_images import Timing


@dataclass(frozen=True, slots=True, eq=False)
class RigInput:
    """``files``; ``given``; ``symmetries`` of the board and its ``pitch_mm``; ``left_out`` : (image or row, why) of
    each camera; ``understood`` : a line on each file of poses, and on the poses that cameras share; ``notes``."""

    files: RigFiles
    given: RigPoses
    symmetries: tuple[Rigid, ...]
    pitch_mm: float | None
    left_out: tuple[tuple[tuple[str, str], ...], ...]
    understood: tuple[str, ...]
    notes: tuple[str, ...] = ()


@require_arguments
@one_thread()
def read_handeye_rig(
    rig: RigFiles | str | Path,
    *,
    rotation: Sequence[str] = (),
    length_unit: Sequence[str] = (),
    poses_are: Sequence[str] = (),
    quaternions: Order = "wxyz",
    tolerance_s: float = TOLERANCE_S,
    workers: int | None = None,
    progress: Progress | None = None,
) -> RigInput:
    """Returns the board in all photographs of several cameras of one robot, with the robot's poses.

    Parameters
    ----------
    rig : str, Path or RigFiles
        The rig file (TOML), or what it names.
    rotation : sequence of str
        Convention of angles that files do not name, such as ``kuka-abc``, ``rpy``, ``rotvec`` or ``ZYX``; with
        ``robot=`` or ``camera=`` in front for one side.
    length_unit : sequence of str
        Unit of lengths in files that do not say it, ``mm``, ``m`` …, likewise.
    poses_are : sequence of str
        Names of the poses where files do not say it: ``base_from_flange`` or ``flange_from_base``, and
        ``camera_from_board`` or ``board_from_camera``.
    quaternions : {"wxyz", "xyzw"}
        As columns of quaternions are named, or x, y, z, w in the order in which they stand.
    tolerance_s : float
        Time within which the nearest of the robot's poses is taken where none can be interpolated, s.
    workers : int, optional
        Number of processes; one per core if None.
    progress : callable, optional
        Called with (stage, done, total).

    Returns
    -------
    RigInput
        For :func:`stcal.workflows.calibrate_handeye_rig`; ``left_out`` and ``understood`` in words.

    Raises
    ------
    InputError
        A file is not of the required form; the message names the camera.
    """
    files = rig if isinstance(rig, RigFiles) else read_rig_file(Path(rig))
    statements, progress = Said.of_options(rotation, length_unit, poses_are), progress or (lambda *_: None)
    design, cameras = load_boards(files.board), []
    by_file = {
        camera_files.poses: read_robot_poses(camera_files.poses, quaternions, statements)
        for camera_files in files.cameras
    }
    robots = [_of_camera(by_file[camera_files.poses], camera_files.images, files) for camera_files in files.cameras]
    for camera_files, robot in zip(files.cameras, robots, strict=True):
        named, timing = partial(_named, progress, camera_files.name), Timing(tolerance_s, camera_files.times)
        try:
            model = read_camera(camera_files.camera, camera_files.camera_name)
            photos = photographed(camera_files.images, robot, model, design, workers, named, timing)
        except InputError as error:
            raise InputError(error.code, f"camera {camera_files.name}: {error}") from error
        cameras.append(photos)
    flange, names, rows = _shared([(photos.robot, photos) for photos in cameras])
    every = tuple(
        RigCamera(camera_files.name, photos.seen, camera_rows, photos.names, photos.prior)
        for camera_files, photos, camera_rows in zip(files.cameras, cameras, rows, strict=True)
    )
    rig_poses = RigPoses(flange, every, names, files.file.name)
    understood = [f"robot: {robot.understood}" for robot in by_file.values()]
    for camera_files, photos in zip(files.cameras, cameras, strict=True):
        understood += [f"{camera_files.name}: images matched {photos.how}"] if photos.how else []
        if photos.timed is not None:
            understood.append(f"{camera_files.name}: {photos.robot.understood}")
    shared = np.bincount(np.concatenate(rows), minlength=len(names)) > 1
    if len(every) > 1:
        understood.append(f"{int(shared.sum())} of {len(names)} poses of the robot are of several cameras' images")
    notes: tuple[str, ...] = ()
    if len(every) > 1 and not shared.any():
        notes += ("no pose of the robot is of two cameras' images: they share the board alone",)
    if any(robot.covariance is not None for robot in by_file.values()):
        notes += ("covariances of the robot's poses are not used for a rig: σ of the robot are estimated",)
    left_out = tuple(photos.left_out for photos in cameras)
    return RigInput(files, rig_poses, cameras[0].symmetries, pitch_of(design), left_out, tuple(understood), notes)


def _named(progress: Progress, name: str, stage: str, done: int, total: int) -> None:
    progress(f"{stage}, {name}", done, total)


def _of_camera(robot: RobotPoses, images: Path, files: RigFiles) -> RobotPoses:
    """Returns the rows of one camera, where a file names the images of all cameras with their folders."""
    folders = {camera_files.images.name for camera_files in files.cameras}
    prefixed = [image.partition("/")[0] in folders and "/" in image for image in robot.images]
    if not all(prefixed) or not prefixed:
        return robot
    rows = [i for i, image in enumerate(robot.images) if image.partition("/")[0] == images.name]
    if not rows:
        raise InputError(
            "E-POSES-UNMATCHED",
            f"{robot.where}: no row is of an image in {images}: {robot.images[0]} … there; correct them",
        )
    return replace(
        robot,
        images=tuple(robot.images[i].partition("/")[2] for i in rows),
        base_from_flange=robot.base_from_flange[rows],
        covariance=None if robot.covariance is None else robot.covariance[rows],
        places=tuple(robot.places[i] for i in rows),
    )


def _shared(cameras: list[tuple[RobotPoses, Photographed]]) -> tuple[Poses, tuple[str, ...], list[np.ndarray]]:
    """Returns the poses of the robot at which any image was taken, their names, and the poses of each camera's images.

    Measured values are never equal to the last digit, so equal poses are one pose, whatever the row or the file. If one
    camera has a pose twice, the poses are commanded ones, and each row of a file counts as a pose of its own.
    """
    keys = []
    for _, photos in cameras:
        taken = photos.base_from_flange[photos.rows]
        both = zip(taken.rotation, taken.translation, strict=True)
        keys.append([turn.tobytes() + place.tobytes() for turn, place in both])
    if any(len(set(camera_keys)) < len(camera_keys) for camera_keys in keys):
        keys = [[f"{robot.where}: {robot.places[r]}".encode() for r in photos.rows] for robot, photos in cameras]
    number: dict[bytes, int] = {}
    flange, names, rows = [], [], []
    for (robot, photos), camera_keys in zip(cameras, keys, strict=True):
        for name, row, key in zip(photos.names, photos.rows, camera_keys, strict=True):
            if key not in number:
                number[key] = len(number)
                flange.append(photos.base_from_flange[int(row)])
                names.append(robot.images[row] if robot.images else name)
        rows.append(np.array([number[key] for key in camera_keys]))
    return Poses.of(flange), tuple(names), rows


@require_arguments
def calibrate_handeye_rig(
    given: RigInput,
    refine_camera: bool = False,
    with_scale: bool = False,
    *,
    repeats: int = 15,
    held_out: int | None = None,
    seed: int = 0,
    workers: int | None = None,
    progress: Progress | None = None,
) -> RigOutcome:
    """Returns where several cameras sit on one flange, or in one base, and in each other, from one adjustment.

    Each camera is solved by itself too, and both are compared on poses of the robot held out.

    Parameters
    ----------
    given : RigInput
        Of :func:`stcal.workflows.read_handeye_rig`.
    refine_camera : bool
        Whether the intrinsics are adjusted too, of each camera from its own with σ.
    with_scale : bool
        Whether the board's true size is found from the robot's motion.
    repeats : int
        Number of splits of the cross-validation; 0 for none.
    held_out : int, optional
        Number of poses of the robot held out in each; a quarter if None.
    seed : int
        Seed of the splits.
    workers : int, optional
        Number of processes; one per core if None.
    progress : callable, optional
        Called with (stage, done, total).

    Returns
    -------
    RigOutcome
        ``rig``, a :class:`stcal.handeye.Rig`, mm and rad; errors on poses ``held_out``; ``all_notes()``.

    Raises
    ------
    StcalError
        As of :func:`stcal.handeye.handeye_rig`; the message also names what was left out before.
    """
    progress = progress or (lambda *_: None)
    options = RigOptions(refine=refine_camera, with_scale=with_scale, symmetries=given.symmetries)
    poses, setup = given.given, given.files.setup
    left_out = zip(given.files.cameras, given.left_out, strict=True)
    with naming_left_out([(f"{camera.name}: {what}", why) for camera, items in left_out for what, why in items]):
        rig = handeye_rig(poses, setup, options)
    poses, options = same_numbering(poses, setup, given.symmetries), replace(options, symmetries=())
    notes, errors, factor = given.notes, None, 1.0
    if repeats and (held_out or len(poses) > LEAST_LEFT):
        rows = splits(len(poses), held_out, repeats, seed)
        done = partial(progress, "held out")
        try:
            errors = cross_validate_rig(poses, setup, options, rows, workers, done)
            rig, factor = widened_by_scatter(rig, errors)
        except DegenerateError as error:
            notes += (f"no errors on poses held out: {error}",)
    by_itself = tuple(alone_or_none(poses, i, setup, options) for i in range(len(poses.cameras)))
    notes += of_places(rig.names, list(by_itself))
    cameras = tuple(_part(given, poses, rig, errors, refine_camera, i) for i in range(len(poses.cameras)))
    return RigOutcome(given.files.file.name, rig, cameras, by_itself, errors, notes, given.understood, factor)


def _part(given: RigInput, poses: RigPoses, rig: Rig, held_out: RigHeldOut | None, refine: bool, i: int) -> Outcome:
    camera, result = poses.cameras[i], rig.cameras[i]
    own_sigmas = all(view.covariance is not None for view in camera.views.views)
    errors = None if held_out is None else held_out.cameras[i].poses()
    prior = camera.prior
    return Outcome(
        camera.name,
        result,
        errors,
        pitch_mm=given.pitch_mm,
        colmap_model=prior.colmap_model if refine and prior is not None else "",
        own_sigmas=bool(own_sigmas),
        left_out=given.left_out[i],
        pairs=poses.pairs(i),
        views=camera.views,
        folder=given.files.cameras[i].images,
    )
