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
from stcal.handeye.data.pairs import SETUPS, Loop, Setup
from stcal.handeye.data.record import Said
from stcal.handeye.data.stream import TOLERANCE_S, Timed
from stcal.handeye.judge.mistakes import flipped, tilted
from stcal.handeye.judge.remarks import spread_text
from stcal.handeye.solve import handeye
from stcal.io.cameras.model import CameraPrior, camera_prior, refinable
from stcal.io.cameras.read import read_camera
from stcal.io.images import ImageFile, find_images
from stcal.io.join import join_tables
from stcal.io.table import Table
from stcal.parallel import Progress, one_thread
from stcal.robot import Robot
from stcal.workflows.board_views import detect_boards, kind_of
from stcal.workflows.robot_at_images import Arm, RobotPoses, Timing, read_arm, read_robot_poses, robot_at_images

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
    file that is not a table of the package; ``setup`` : where a file states it; ``folder`` : of the images; ``arm`` :
    at the joint values of the ``pairs``, where its parameters are to be solved for; ``timed`` : times of the pairs in
    the robot's stream, where its poses were taken by time; ``notes`` : on rows of only one of two files.
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
    given = read_input(place, *files, workers, told, quaternions, statements, timing, robot)
    chosen = given.setup if setup is None else setup_of(statements, given.setup, given.where)
    return replace(given, setup=chosen, notes=notes)


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
        poses, camera, board = _all_three(source, poses, camera, board)
        if robot is None:
            robot_poses = read_robot_poses(poses, quaternions, statements)
            return _from_images(source, robot_poses, poses, camera, board, workers, progress, timing)
        _require_by_name(timing)
        robot_poses, arm = read_arm(poses, robot, quaternions)
        return _from_images(source, robot_poses, poses, camera, board, workers, progress, None, arm)
    if robot is not None:
        raise InputError(
            "E-OPTION-NEEDS", "--with-kinematics: only with a folder of images, which show the arm's errors"
        )
    _require_no_images(source, poses, camera, board)
    _require_timed(source, timing)
    if isinstance(source, Table):
        return HandEyeInput(source.where, read_poses(source, quaternions))
    if isinstance(source, Told):
        return _from_told(source, statements)
    told = read_pairs(source, statements, quaternions=quaternions)
    if told is not None:
        return _from_told(told, statements)
    pairs = read_poses(source, quaternions)  # first: a table that is not understood is no table whose columns say all
    _require_unsaid(statements, str(source))
    return HandEyeInput(source.name, pairs)


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


def _require_by_name(timing: Timing) -> None:
    if timing.offset or timing.image_times is not None:
        raise InputError(
            "E-OPTION-CONFLICT",
            "--time-offset, --image-times: not with --with-kinematics, whose joint values belong to images by name; "
            "name the images in the column image",
        )


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


def setup_of(statements: Said, told: str | None, where: str) -> Setup:
    """Returns the setup that the user states, or that a file states, or eye-in-hand."""
    if statements.setup and told and statements.setup != told:
        raise InputError(
            "E-OPTION-CONTRADICTS", f"{where}: of a setup {told}, --setup {statements.setup}; leave the option out"
        )
    name = statements.setup or told or SETUPS[0]
    return "eye-to-hand" if name == "eye-to-hand" else "eye-in-hand"


def _from_told(told: Told, statements: Said) -> HandEyeInput:
    setup = setup_of(statements, told.setup, told.pairs.where)
    return HandEyeInput(
        told.pairs.where,
        told.pairs,
        left_out=told.left_out,
        understood=told.understood,
        setup=setup if told.setup else None,
        timed=told.timed,
    )


def _from_images(
    source: Path,
    robot: RobotPoses,
    poses: Path,
    camera: Path,
    board: Path,
    workers: int | None,
    progress: Progress,
    timing: Timing | None,
    arm: Arm | None = None,
) -> HandEyeInput:
    """Returns the pairs of all images that show the board and have a pose."""
    design, model = load_boards(board), read_camera(camera)
    files, skipped = find_images(source)
    at_images = robot_at_images(robot, [file.name for file in files], timing)
    robot, late = at_images.robot, dict(at_images.left_out)
    files = [file for file in files if file.name not in late]
    row_of, missing, matching = _rows_of_images(robot, files, source)
    with_pose = [file for file in files if file.name in row_of]
    detections = detect_boards(with_pose, model, design, (), workers, partial(progress, "board"))
    left_out = [(skipped_image.name, skipped_image.reason) for skipped_image in (*skipped, *detections.skipped)]
    left_out += [*late.items(), *_without_partner(files, row_of, missing, robot.file)]
    if not (found := detections.views()):
        first = f"{detections.skipped[0].name}: {detections.skipped[0].reason}"
        raise InputError(
            "E-IMAGES-NO-BOARD", f"image folder {source}: the board is in none of {len(with_pose)} images: {first}"
        )
    views = Views(
        detections.camera, tuple(View(v.xyz_board, v.xy_px, v.covariance_px2, v.normal) for v in found.values())
    )
    rows = np.array([row_of[name] for name in found])
    pairs = pairs_of_views(robot.base_from_flange[rows], views, tuple(found), str(source))
    if robot.covariance is not None:
        pairs = replace(pairs, base_from_flange_covariance=robot.covariance[rows])
    understood = _robot_lines(robot, matching) if not robot.own else ()
    understood += tuple(f"board: {part}" for part in detections.unused())
    return HandEyeInput(
        f"{source.name}, {poses.name}",
        pairs,
        views,
        detections.symmetries,
        camera_prior(refinable(model.calibrated(detections.camera.width, detections.camera.height))),
        next((getattr(design, key) for key in PITCHES if hasattr(design, key)), None),
        tuple(left_out),
        understood,
        folder=source,
        arm=arm and arm[rows],
        timed=at_images.timed(tuple(found)),
    )


def _rows_of_images(
    robot: RobotPoses, files: list[ImageFile], source: Path
) -> tuple[dict[str, int], tuple[str, ...], str]:
    rows, missing, matching = robot.pairing([file.name for file in files])
    if not rows:
        raise InputError(
            "E-POSES-UNMATCHED",
            f"{robot.where}: no row is of an image in {source}: {robot.images[0]} … there, {files[0].name} … here; "
            "correct them",
        )
    return rows, missing, matching


def _without_partner(
    files: list[ImageFile], rows: dict[str, int], missing: tuple[str, ...], poses: str
) -> list[tuple[str, str]]:
    left_out = [(file.name, f"no row in {poses}") for file in files if file.name not in rows]
    return left_out + [(name, f"no such image, in a row of {poses}") for name in missing]


def _robot_lines(robot: RobotPoses, how: str) -> tuple[str, ...]:
    return (f"robot: {robot.understood}", *((f"images matched {how}",) if how else ()))


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
        return _dry_images(source, *_all_three(source, poses, camera, board), quaternions, statements, timing, robot)
    inputs = read_input(source, poses, camera, board, quaternions=quaternions, statements=statements, timing=timing)
    lines = list(inputs.understood) if isinstance(source, Told) or inputs.understood else own_told(source, quaternions)
    setup = setup_of(statements, inputs.setup, inputs.where)
    origin = "as you say" if statements.setup else "as the file says" if inputs.setup else "by default"
    lines += [f"setup: {setup}, {origin}", f"pairs: {len(inputs.pairs)}"]
    lines += spread_text(inputs.pairs.base_from_flange, setup)
    return lines + [f"left out {name}: {reason}" for name, reason in inputs.left_out]


def _dry_images(
    source: Path,
    poses: Path,
    camera: Path,
    board: Path,
    quaternions: Order,
    statements: Said,
    timing: Timing,
    arm: Robot | None,
) -> list[str]:
    """Returns the lines on a folder of images."""
    if arm is not None:
        _require_by_name(timing)
    robot = read_robot_poses(poses, quaternions, statements) if arm is None else read_arm(poses, arm, quaternions)[0]
    design, model = load_boards(board), read_camera(camera)
    files, skipped = find_images(source)
    at_images = robot_at_images(robot, [file.name for file in files], None if arm else timing)
    robot, every = at_images.robot, len(files)
    files = [file for file in files if file.name not in dict(at_images.left_out)]
    rows, missing, matching = _rows_of_images(robot, files, source)
    setup = setup_of(statements, None, source.name)
    kind = kind_of(design)
    lines = [
        *_robot_lines(robot, matching),
        f"camera: {camera.name}: {model.width} × {model.height} px, focal length {model.focal[0]:.6g} px",
        f"board: {board.name}: {kind}",
        f"setup: {setup}, {'as you say' if statements.setup else 'by default'}",
        f"images: {len(rows)} of {every} with a pose of the robot; the board was not looked for",
        *spread_text(robot.base_from_flange[list(rows.values())], setup),
    ]
    left_out = [(skipped_image.name, skipped_image.reason) for skipped_image in skipped] + list(at_images.left_out)
    left_out += _without_partner(files, rows, missing, poses.name)
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
