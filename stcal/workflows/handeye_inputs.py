"""Inputs of a hand-eye calibration: pose pairs of one file or two, or images of a board with the robot's poses."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from stcal.boards.several import load_boards
from stcal.errors import InputError, StcalError
from stcal.geometry.arrays import require_arguments
from stcal.geometry.rigid import Order, Poses, Rigid
from stcal.handeye import HandEyeOptions, HandEyePoses, View, Views, pairs_of_views, read_poses
from stcal.handeye.data.inputs import Told, own_told, read_pairs, read_two, require_own
from stcal.handeye.data.pairs import Loop, Setup
from stcal.handeye.data.record import Said
from stcal.handeye.data.stream import TOLERANCE_S, Timed
from stcal.handeye.judge.mistakes import flipped, tilted
from stcal.handeye.judge.remarks import spread_text
from stcal.handeye.solve import handeye
from stcal.io.cameras.model import CameraModel, CameraPrior, camera_prior, refinable
from stcal.io.cameras.read import read_camera
from stcal.io.images import ImageFile, find_images
from stcal.io.join import join_tables
from stcal.io.table import Table
from stcal.parallel import Progress, one_thread
from stcal.robot import Robot
from stcal.workflows.board_views import Board, detect_boards, kind_of
from stcal.workflows.robot_at_images import Arm, AtImages, Timing, read_arm, read_robot_poses, robot_at_images

NOTHING_SAID = Said()
WITHOUT_OPTIONS = Timing()
PITCHES = ("pitch_mm", "square_mm", "spacing_mm")
"""Keys in board files for the distance by which a board's size is stated."""
OF_IMAGES = ("--poses", "--camera", "--board")
PREFIXES = "base_from_flange_", "camera_from_board_"
Source = Path | Table | Told


@dataclass(frozen=True, slots=True, eq=False)
class HandEyeInput:
    """Input of a hand-eye calibration.

    ``where`` : its files; ``views`` : of the board, where images were given, with its ``symmetries`` and the camera's
    ``prior``; ``pitch_mm`` of the board's file; ``left_out`` : (image or row, why); ``understood`` : a line for each
    file that is not a table of the package; ``setup`` : where the user or a file states it; ``folder`` : of the images;
    ``arm`` : at the joint values of the ``pairs``, where its parameters are to be solved for; ``timed`` : times of the
    pairs in the robot's stream, where its poses were taken by time; ``notes`` : on rows of only one of two files.
    """

    where: str
    pairs: HandEyePoses
    views: Views | None = None
    symmetries: tuple[Rigid, ...] = ()
    prior: CameraPrior | None = None
    pitch_mm: float | None = None
    left_out: tuple[tuple[str, str], ...] = ()
    understood: tuple[str, ...] = ()
    setup: Setup | None = None
    folder: Path | None = None
    arm: Arm | None = None
    timed: Timed | None = None
    notes: tuple[str, ...] = ()


def one_source(
    source: Path,
    second: Path | None,
    key: str,
    statements: Said,
    quaternions: Order = "wxyz",
    timing: Timing = WITHOUT_OPTIONS,
) -> tuple[Source, tuple[str, ...]]:
    """Returns the poses of two files, the robot's and the camera's, or of one, as one source; and notes on rows left
    out.

    Two tables of the package's own are joined as tables.
    """
    if second is None:
        return source, ()
    told = read_two(source, second, statements, key, quaternions, timing.tolerance_s, timing.offset)
    if told is not None:
        return told, ()
    for path in (source, second):
        require_own(path, quaternions)
    _require_unsaid(statements, f"{source}, {second}")
    joined = join_tables(str(source), str(second), key, PREFIXES, quaternions)
    return joined.table, joined.notes


@contextmanager
def naming_left_out(left_out: Sequence[tuple[str, str]]) -> Iterator[None]:
    """Adds to the message of an error what was left out before: (image or row, why)."""
    try:
        yield
    except StcalError as error:
        if left_out:
            error.append(f"; {len(left_out)} left out before, first {left_out[0][0]}: {left_out[0][1]}")
        raise


@require_arguments
def read_handeye(
    source: Source | str,
    poses: str | Path | None = None,
    camera: str | Path | None = None,
    board: str | Path | None = None,
    *,
    second: str | Path | None = None,
    key: str = "image",
    setup: Setup | None = None,
    rotation: Sequence[str] = (),
    length_unit: Sequence[str] = (),
    poses_are: Sequence[str] = (),
    quaternions: Order = "wxyz",
    tolerance_s: float = TOLERANCE_S,
    image_times: str | Path | None = None,
    time_offset: bool = False,
    robot: Robot | None = None,
    workers: int | None = None,
    progress: Progress | None = None,
) -> HandEyeInput:
    """Returns the poses of a hand-eye calibration, from photographs of a board or from a file of any known form.

    Parameters
    ----------
    source : str, Path or Table
        Folder of the photographs; a file of pairs of poses; or a file of the robot's poses, with ``second``.
    poses : str or Path, optional
        The robot's poses at the photographs.
    camera, board : str or Path, optional
        Files of the camera and of the board, or boards, in the photographs.
    second : str or Path, optional
        File of the camera's poses.
    key : str
        Column by which rows of both files belong together, or ``image=Point Name``.
    setup : {"eye-in-hand", "eye-to-hand"}, optional
        What carries the camera; as a file says, or ``eye-in-hand``, if None.
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
    image_times : str or Path, optional
        Table of the times of photographs.
    time_offset : bool
        Whether the offset of the two clocks is to be estimated.
    robot : Robot, optional
        The robot at whose joint values, in ``poses``, the photographs were taken, if its parameters are solved for.
    workers : int, optional
        Number of processes; one per core if None.
    progress : callable, optional
        Called with (stage, done, total).

    Returns
    -------
    HandEyeInput
        ``pairs`` of poses, mm; ``views`` of the board, ``left_out`` and ``understood``. For
        :func:`stcal.workflows.calibrate_handeye` and :func:`stcal.workflows.plan_handeye`.

    Raises
    ------
    InputError
        A file is missing or not of the required form, one file too many was given, or no image shows the board.
    """
    statements = Said.of_options(rotation, length_unit, poses_are, setup)
    timing = Timing(tolerance_s, _path(image_times), time_offset)
    place, told, notes = Path(source) if isinstance(source, str) else source, progress or (lambda *_: None), ()
    if isinstance(place, Path) and not place.is_dir():
        place, notes = one_source(place, _path(second), key, statements, quaternions, timing)
    files = _path(poses), _path(camera), _path(board)
    return replace(read_input(place, *files, workers, told, quaternions, statements, timing, robot), notes=notes)


def _path(path: str | Path | None) -> Path | None:
    return None if path is None else Path(path)


@one_thread()
def read_input(
    source: Source,
    poses: Path | None = None,
    camera: Path | None = None,
    board: Path | None = None,
    workers: int | None = None,
    progress: Progress = lambda *_: None,
    quaternions: Order = "wxyz",
    statements: Said = NOTHING_SAID,
    timing: Timing = WITHOUT_OPTIONS,
    robot: Robot | None = None,
) -> HandEyeInput:
    """Returns pose pairs from their files, or from a folder of images with ``poses``, ``camera`` and ``board``.

    ``quaternions`` : ``xyzw`` where their columns hold x, y, z, w in the order in which they stand; ``statements`` :
    the user's statements about what files do not state; ``timing`` : of poses by time; ``robot`` : the robot at whose
    joint values, in ``poses``, the images were taken, if its parameters are to be solved for.
    """
    if isinstance(source, Path) and source.is_dir():
        files = _all_three(source, poses, camera, board)
        photographs = _photographs(source, files, quaternions, statements, timing, robot)
        return _from_images(source, files[0], photographs, statements, workers, progress)
    if robot is not None:
        raise InputError(
            "E-OPTION-NEEDS", "--with-kinematics: only with a folder of images, which show the arm's errors"
        )
    _require_no_images(source, poses, camera, board)
    _require_timed(source, timing)
    if isinstance(source, Table):
        return HandEyeInput(source.where, read_poses(source, quaternions), setup=statements.setup)
    if isinstance(source, Told):
        return _from_told(source, statements)
    told = read_pairs(source, statements, quaternions=quaternions)
    if told is not None:
        return _from_told(told, statements)
    pairs = read_poses(source, quaternions)  # first: a table that is not understood is no table whose columns say all
    _require_unsaid(statements, str(source))
    return HandEyeInput(source.name, pairs, setup=statements.setup)


def _all_three(source: Path, poses: Path | None, camera: Path | None, board: Path | None) -> tuple[Path, Path, Path]:
    missing = [name for name, path in zip(OF_IMAGES, (poses, camera, board), strict=True) if path is None]
    if poses is None or camera is None or board is None:
        raise InputError("E-OPTION-MISSING", f"image folder {source}: {', '.join(missing)} needed with images")
    return poses, camera, board


def _place(source: Source) -> str:
    if isinstance(source, Path):
        return str(source)
    return source.where if isinstance(source, Table) else source.pairs.where


def _require_no_images(source: Source, poses: Path | None, camera: Path | None, board: Path | None) -> None:
    extra = [name for name, path in zip(OF_IMAGES, (poses, camera, board), strict=True) if path is not None]
    if isinstance(source, Path) and not source.exists():
        raise InputError("E-FILE-UNREADABLE", f"{source}: does not exist; a file of poses or a folder of images needed")
    if extra:
        held = "is a file of poses" if isinstance(source, Path) else "are poses"
        raise InputError("E-OPTION-NEEDS", f"{', '.join(extra)}: only with a folder of images; {_place(source)} {held}")


def _require_timed(source: Source, timing: Timing) -> None:
    """Refuse options of times without images or without poses of both sides in files of their own."""
    if timing.image_times is not None:
        raise InputError(
            "E-OPTION-NEEDS", "--image-times: only with a folder of images; poses have their times beside them"
        )
    if timing.offset and not (isinstance(source, Told) and source.timed is not None):
        raise InputError(
            "E-OPTION-NEEDS",
            f"{_place(source)}: --time-offset needs the robot's poses as a stream with times; give --a and --b, or "
            "images and --poses, each with times",
        )


def _require_unsaid(statements: Said, where: str) -> None:
    if statements.options():
        raise InputError(
            "E-OPTION-NEEDS",
            f"{where}: the names of columns state unit and rotation; leave {', '.join(statements.options())} out, and "
            "rename columns that are wrong (base_from_flange_x_m in place of …_x_mm, board_from_camera_x_mm in place "
            "of camera_from_board_x_mm)",
        )


def _from_told(told: Told, statements: Said) -> HandEyeInput:
    where, stated = told.pairs.where, statements.setup
    if stated and told.setup and stated != told.setup:
        raise InputError(
            "E-OPTION-CONTRADICTS", f"{where}: of a setup {told.setup}, --setup {stated}; leave the option out"
        )
    setup = stated or told.setup
    return HandEyeInput(
        where, told.pairs, left_out=told.left_out, understood=told.understood, setup=setup, timed=told.timed
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Photographs:
    """Images of a folder with the robot's poses, before the board is looked for.

    ``row_of`` : row of the robot's pose by image; ``matching`` : how these were matched; ``skipped``, ``unpaired`` :
    (image, why).
    """

    design: Board
    model: CameraModel
    files: list[ImageFile]
    at_images: AtImages
    arm: Arm | None
    row_of: dict[str, int]
    matching: str
    skipped: list[tuple[str, str]]
    unpaired: list[tuple[str, str]]

    def robot_lines(self) -> tuple[str, ...]:
        """Returns lines on how the robot's poses were read and matched."""
        matched = (f"images matched {self.matching}",) if self.matching else ()
        return f"robot: {self.at_images.robot.understood}", *matched


def _photographs(
    source: Path,
    files_of: tuple[Path, Path, Path],
    quaternions: Order,
    statements: Said,
    timing: Timing,
    robot: Robot | None,
) -> _Photographs:
    """Returns the images of a folder, matched with the poses in the first of the files of :func:`_all_three`."""
    (poses, camera, board), arm = files_of, None
    if robot is None:
        robot_poses = read_robot_poses(poses, quaternions, statements)
    elif timing.offset or timing.image_times is not None:
        raise InputError(
            "E-OPTION-CONFLICT",
            "--time-offset, --image-times: not with --with-kinematics, whose joint values belong to images by name; "
            "name the images in the column image",
        )
    else:
        robot_poses, arm = read_arm(poses, robot, quaternions)
    design, model = load_boards(board), read_camera(camera)
    files, skipped = find_images(source)
    at_images = robot_at_images(robot_poses, [file.name for file in files], timing if arm is None else None)
    robot_poses, late = at_images.robot, dict(at_images.left_out)
    names = [file.name for file in files if file.name not in late]
    row_of, missing, matching = robot_poses.pairing(names)
    if not row_of:
        raise InputError(
            "E-POSES-UNMATCHED",
            f"{robot_poses.where}: no row is of an image in {source}: {robot_poses.images[0]} … there, {names[0]} … "
            "here; correct them",
        )
    unpaired = list(late.items()) + [(name, f"no row in {poses.name}") for name in names if name not in row_of]
    unpaired += [(name, f"no such image, in a row of {poses.name}") for name in missing]
    reasons = [(each.name, each.reason) for each in skipped]
    return _Photographs(design, model, files, at_images, arm, row_of, matching, reasons, unpaired)


def _from_images(
    source: Path, poses: Path, own: _Photographs, statements: Said, workers: int | None, progress: Progress
) -> HandEyeInput:
    """Returns the pairs of all images that show the board and have a pose."""
    robot, with_pose = own.at_images.robot, [file for file in own.files if file.name in own.row_of]
    detections = detect_boards(with_pose, own.model, own.design, (), workers, partial(progress, "board"))
    without_board = [(each.name, each.reason) for each in detections.skipped]
    if not (found := detections.views()):
        raise InputError(
            "E-IMAGES-NO-BOARD",
            f"image folder {source}: the board is in none of {len(with_pose)} images: {': '.join(without_board[0])}",
        )
    views = Views(
        detections.camera, tuple(View(v.xyz_board, v.xy_px, v.covariance_px2, v.normal) for v in found.values())
    )
    rows = np.array([own.row_of[name] for name in found])
    pairs = pairs_of_views(robot.base_from_flange[rows], views, tuple(found), str(source))
    if robot.covariance is not None:
        pairs = replace(pairs, base_from_flange_covariance=robot.covariance[rows])
    understood = own.robot_lines() if not robot.own else ()
    understood += tuple(f"board: {part}" for part in detections.unused())
    return HandEyeInput(
        f"{source.name}, {poses.name}",
        pairs,
        views,
        detections.symmetries,
        camera_prior(refinable(own.model.calibrated(detections.camera.width, detections.camera.height))),
        next((getattr(own.design, key) for key in PITCHES if hasattr(own.design, key)), None),
        (*own.skipped, *without_board, *own.unpaired),
        understood,
        statements.setup,
        folder=source,
        arm=own.arm and own.arm[rows],
        timed=own.at_images.timed(tuple(found)),
    )


def dry_run(
    source: Source,
    poses: Path | None = None,
    camera: Path | None = None,
    board: Path | None = None,
    quaternions: Order = "wxyz",
    statements: Said = NOTHING_SAID,
    timing: Timing = WITHOUT_OPTIONS,
    robot: Robot | None = None,
) -> list[str]:
    """Returns lines on how the inputs are understood, without looking for the board in images."""
    if isinstance(source, Path) and source.is_dir():
        files = _all_three(source, poses, camera, board)
        own = _photographs(source, files, quaternions, statements, timing, robot)
        stated, flange = statements.setup, own.at_images.robot.base_from_flange[list(own.row_of.values())]
        (width, height), focal_px = (own.model.width, own.model.height), own.model.focal[0]
        lines = [
            *own.robot_lines(),
            f"camera: {files[1].name}: {width} × {height} px, focal length {focal_px:.6g} px",
            f"board: {files[2].name}: {kind_of(own.design)}",
        ]
        count = f"images: {len(own.row_of)} of {len(own.files)} with a pose of the robot; the board was not looked for"
        left_out = [*own.skipped, *own.unpaired]
    else:
        inputs = read_input(source, poses, camera, board, quaternions=quaternions, statements=statements, timing=timing)
        stated, flange, left_out = inputs.setup, inputs.pairs.base_from_flange, inputs.left_out
        lines = list(inputs.understood)
        if not lines and not isinstance(source, Told):
            lines = own_told(source, quaternions)
        count = f"pairs: {len(inputs.pairs)}"
    setup = stated or "eye-in-hand"
    origin = "as you say" if statements.setup else "as the file says" if stated else "by default"
    lines += [f"setup: {setup}, {origin}", count, *spread_text(flange, setup)]
    return lines + [f"left out {name}: {reason}" for name, reason in left_out]


MOST_ROUNDS = 3
"""Largest number of rounds of solving and tilting; a flip by few degrees stands out when the larger ones are gone."""


@require_arguments
def without_flips(given: HandEyeInput, options: HandEyeOptions | None = None) -> tuple[HandEyeInput, str]:
    """Returns the input with the second pose of a flat target, tilted the other way, for poses that agree only so.

    Parameters
    ----------
    given : HandEyeInput
        Pairs of poses, of :func:`stcal.workflows.read_handeye`.
    options : HandEyeOptions, optional
        As for :func:`stcal.workflows.calibrate_handeye`.

    Returns
    -------
    HandEyeInput, str
        The input, and a sentence that names the poses.

    Raises
    ------
    InputError
        The input consists of images, which determine the poses by themselves.
    """
    inputs, setup, options = given, given.setup or "eye-in-hand", options or HandEyeOptions()
    if inputs.views is not None:
        raise InputError(
            "E-OPTION-NEEDS", "--undo-flips: only with poses; with images, the corners decide the tilt; leave it out"
        )
    pairs, undone = inputs.pairs, np.zeros(len(inputs.pairs), bool)
    for _ in range(MOST_ROUNDS):
        result = handeye(pairs, setup, "pose", None, options)
        x, z = result.mount_from_camera, result.stand_from_board
        flips = flipped(Loop.of(pairs, setup), x, z, result.outliers) & ~undone
        if not flips.any():
            break
        seen, other = pairs.camera_from_board, tilted(pairs.camera_from_board)
        turned = np.where(flips[:, None, None], other.rotation, seen.rotation)
        pairs, undone = replace(pairs, camera_from_board=Poses(turned, seen.translation)), undone | flips
    shown = ", ".join(name for name, flip in zip(pairs.names, undone, strict=True) if flip)
    said = f"tilted the other way, as --undo-flips asks, {undone.sum()} of {len(pairs)} poses: {shown or 'none'}"
    return replace(inputs, pairs=pairs), said
