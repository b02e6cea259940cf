"""Hand-eye calibration from a file of poses or from images of any board: ``stcal handeye`` composes three systems."""

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from stcal.boards.file import load_flat_board
from stcal.errors import DegenerateError, InputError, StcalError
from stcal.geometry.rigid import Rigid
from stcal.handeye import HandEyeOptions, HandEyePoses, View, Views, handeye, pairs_of_views, read_poses
from stcal.handeye.choose import choose
from stcal.handeye.data.loop import Setup
from stcal.handeye.data.robot_poses import RobotPoses, read_robot_poses
from stcal.handeye.report.file import Outcome
from stcal.handeye.validate import LEAST_LEFT, better_setup, compare, cross_validate, predict_motions, splits
from stcal.io.camera import CameraPrior, camera_prior, read_camera, refinable
from stcal.io.images import ImageFile, find_images
from stcal.io.quaternions import Order
from stcal.io.table import Table
from stcal.parallel import Progress, one_thread
from stcal.workflows.board_views import detect_boards

ALL, AUTO = "all", "auto"
"""In place of a method's name: all of them, compared; the way of solving that predicts best."""


@dataclass(frozen=True, slots=True, eq=False)
class HandEyeInput:
    """What is calibrated from.

    ``where`` : its files; ``views`` : of the board, where images were given, with its ``symmetries`` and the camera's
    ``prior``; ``pitch_mm`` of the board's file; ``left_out`` : (image or row, why).
    """

    where: str
    pairs: HandEyePoses
    views: Views | None = None
    symmetries: tuple[Rigid, ...] = ()
    prior: CameraPrior | None = None
    pitch_mm: float | None = None
    left_out: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True, slots=True)
class Splits:
    """Of the cross-validation: how many, poses in each (a quarter if None), which, and processes for it; and the last
    motions to predict, if any."""

    repeats: int = 15
    held_out: int | None = None
    seed: int = 0
    workers: int | None = None
    motions: int | None = None


@one_thread()
def read_input(
    source: Path | Table,
    poses: Path | None = None,
    camera: Path | None = None,
    board: Path | None = None,
    workers: int | None = None,
    progress: Progress = lambda *_: None,
    quaternions: Order = "wxyz",
) -> HandEyeInput:
    """Pose pairs from their file; or from a folder of images with the files ``poses``, ``camera`` and ``board``.

    ``quaternions`` : ``xyzw`` where their columns hold x, y, z, w in the order in which they stand.

    Raises
    ------
    InputError
        A file is missing or not as it should be, one too many was given, or no image shows the board.
    """
    images = {"--poses": poses, "--camera": camera, "--board": board}
    extra = [name for name, path in images.items() if path is not None]
    if isinstance(source, Table):
        if extra:
            raise InputError(f"{', '.join(extra)}: only with a folder of images; {source.where} are poses")
        return HandEyeInput(source.where, read_poses(source, quaternions))
    if source.is_dir():
        missing = [name for name, path in images.items() if path is None]
        if poses is None or camera is None or board is None:
            raise InputError(f"image folder {source}: {', '.join(missing)} needed with images")
        return _from_images(source, read_robot_poses(poses, quaternions), poses, camera, board, workers, progress)
    if not source.exists():
        raise InputError(f"{source}: does not exist; a file of poses (CSV) or a folder of images needed")
    if extra:
        raise InputError(f"{', '.join(extra)}: only with a folder of images; {source} is a file of poses")
    return HandEyeInput(source.name, read_poses(source, quaternions))


def _from_images(
    source: Path, robot: RobotPoses, poses: Path, camera: Path, board: Path, workers: int | None, progress: Progress
) -> HandEyeInput:
    """Corners of the board in all images that have a pose."""
    design, model = load_flat_board(board), read_camera(camera)
    files, skipped = find_images(source)
    rows, missing = _rows_of_images(robot, files, source)
    with_pose = [file for file in files if file.name in rows]
    found = detect_boards(with_pose, model, design, (), workers, partial(progress, "board"))
    views = found.views()
    left_out = [(each.name, each.reason) for each in (*skipped, *found.skipped)]
    left_out += [(file.name, f"no row in {poses.name}") for file in files if file.name not in rows]
    left_out += [(name, f"no such image, in a row of {poses.name}") for name in missing]
    if not views:
        first = f"{found.skipped[0].name}: {found.skipped[0].reason}"
        raise InputError(f"image folder {source}: the board is in none of {len(with_pose)} images: {first}")
    seen = Views(found.camera, tuple(View(v.xyz_board, v.xy_px, v.covariance_px2) for v in views.values()))
    at = [rows[name] for name in views]
    pairs = pairs_of_views(robot.base_from_flange[at], seen, tuple(views), str(source))
    if robot.covariance is not None:
        pairs = replace(pairs, base_from_flange_covariance=robot.covariance[at])
    pitch = getattr(design, "pitch_mm", getattr(design, "square_mm", None))
    prior = camera_prior(refinable(model.calibrated(found.camera.width, found.camera.height)))
    where = f"{source.name}, {poses.name}"
    return HandEyeInput(where, pairs, seen, found.symmetries, prior, pitch, tuple(left_out))


def _rows_of_images(robot: RobotPoses, files: list[ImageFile], source: Path):
    rows, missing = robot.rows([file.name for file in files])
    if not rows:
        raise InputError(
            f"{robot.where}: no row is of an image in {source}: {robot.images[0]} … there, {files[0].name} … here; "
            "correct them"
        )
    return rows, missing


@one_thread()
def calibrate(
    given: HandEyeInput,
    setup: Setup,
    method: str | None,
    options: HandEyeOptions,
    validation: Splits,
    progress: Progress = lambda *_: None,
) -> Outcome:
    """The result, its errors on poses held out, and all methods compared where ``method`` is :data:`ALL`, or the way
    of solving that predicts best where it is :data:`AUTO`.

    Raises
    ------
    StcalError
        As :func:`stcal.handeye.handeye`; what was left out before is said with it.
    """
    try:
        return _outcome(given, setup, method, options, validation, progress)
    except StcalError as error:
        if not given.left_out:
            raise
        name, reason = given.left_out[0]
        raise type(error)(f"{error}; {len(given.left_out)} left out before, first {name}: {reason}") from error


def _outcome(
    given: HandEyeInput,
    setup: Setup,
    method: str | None,
    options: HandEyeOptions,
    validation: Splits,
    progress: Progress,
) -> Outcome:
    pairs, views = given.pairs, given.views
    asked = None if method in (ALL, AUTO) else method
    compared, held_out, notes, rows = (), None, (), np.zeros((0, 0), int)
    choice = None
    if validation.repeats and (validation.held_out or len(pairs) > LEAST_LEFT):
        rows = splits(len(pairs), validation.held_out, validation.repeats, validation.seed)
    if method == AUTO and len(rows):
        prior, done = given.prior if views is not None else None, partial(progress, "held out")
        try:
            choice = choose(pairs, setup, views, options, prior, rows, validation.workers, done)
        except DegenerateError as error:
            notes = (f"no errors on poses held out: {error}",)
    if choice is not None:
        options = choice.chosen.options(options, prior)
        result, held_out, asked = choice.result, choice.held_out, choice.chosen.method
    else:
        result = handeye(pairs, setup, asked, views, options)
    if method == ALL:
        done = partial(progress, "methods")
        compared = compare(pairs, setup, views, options, rows=rows, workers=validation.workers, progress=done)
        held_out = next(each.held_out for each in compared if each.method == result.method)
    elif len(rows) and choice is None and not notes:
        done = partial(progress, "held out")
        try:
            held_out = cross_validate(pairs, setup, asked, views, options, rows, validation.workers, done)
        except DegenerateError as error:
            notes = (f"no errors on poses held out: {error}",)
    if len(rows) and (meant := better_setup(pairs, setup, options, rows)):
        notes = (*notes, meant)
    motions = None
    if validation.motions is not None:
        motions = predict_motions(pairs, setup, result.method, views, options, validation.motions)
    model = options.intrinsics.colmap_model if options.intrinsics else ""
    own = views is not None and all(view.covariance is not None for view in views.views)
    return Outcome(
        given.where, result, held_out, compared, given.pitch_mm, model, own, given.left_out, notes, motions, choice
    )
