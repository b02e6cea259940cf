"""Inputs of a hand-eye calibration: pose pairs of one file or two, or images of a board with the robot's poses."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from decimal import Decimal
from functools import partial
from pathlib import Path

import numpy as np

from stcal.boards.target_file import load_boards
from stcal.errors import InputError
from stcal.geometry.arrays import require_arguments
from stcal.geometry.rigid import Order
from stcal.handeye import View, Views, pairs_of_views
from stcal.handeye.data.pose_content import HandEyeInput, PoseSide, Said
from stcal.handeye.data.pose_files import (
    own_told,
    read_pairs,
    read_robot,
    read_two,
    require_own,
    require_unsaid,
)
from stcal.handeye.data.pose_pairs import Setup
from stcal.handeye.data.pose_partners import rows_of_images
from stcal.handeye.data.stream import TOLERANCE_S, Stream, Timed, stamps_of, stem_of, taken_at, time_of
from stcal.handeye.remarks import motions_missing
from stcal.io.cameras.camera_model import camera_prior, refinable
from stcal.io.cameras.read import read_camera
from stcal.io.images import find_images
from stcal.io.join import join_tables
from stcal.io.table import Table, read_table
from stcal.parallel import Progress, one_thread
from stcal.workflows.board_views import detect_boards, kind_of

LeftOut = tuple[tuple[str, str], ...]  # names of images or rows, and why they do not take part
Clock = tuple[Stream, dict[str, float]]  # the robot's stream, and the time of each image after its origin, by name


def robot_at_images(robot: PoseSide, names: Sequence[str], files: "Files") -> tuple[PoseSide, LeftOut, Clock | None]:
    """Returns poses at the times of images, where both have times that are not simply equal; else as they are. Raises
    InputError: an option needs times, or no image lies within the stream."""
    images, where = _times_of_images(names, files.image_times), f"robot poses {robot.where}"
    samples = [time_of(name) for name in robot.names] if robot.timed else stamps_of(robot.names)
    known = [] if samples is None else [time for time in samples if time is not None]
    untimed = not known or len(known) < len(robot)
    if files.time_offset or files.image_times or robot.timed:
        if images is None:
            said = f"its name is not a time, but the robot's poses are matched by time ({Path(robot.where).name}); name"
            remedy = "images by seconds (1689.25.png), or give --image-times"
            raise InputError("E-IMAGE-NAME-TIME", f"image {names[0]}: {said} {remedy}")
        if untimed:
            first = f", but {robot.names[0]} …" if robot.names else ""
            said = f"{where}: no times of its poses{first}; give a column time_s, or a TUM trajectory"
            raise InputError("E-POSES-UNTIMED", said)
    by_name = not robot.timed and any(stem_of(name) != name for name in robot.names)
    if images is None or untimed or by_name:
        return robot, (), None

    def clock() -> Clock:
        stream = Stream.of(known, robot.poses, Path(robot.where).name)
        return stream, dict(zip(images, stream.after_origin(list(images.values())).tolist(), strict=True))

    if not files.time_offset and all(time in known for time in images.values()):  # rows without an image are no mistake
        rows = [known.index(time) for time in images.values()]
        lines = f"{robot.understood}; {len(rows)} of them at the times of images"
        dense = len(images) < len(known) == len(set(known))
        robot = replace(robot[rows], names=tuple(images), understood=lines, own=False, timed=False)
        return robot, (), clock() if dense else None
    stream, seconds = clock()
    seen = tuple(images)
    taken = taken_at(stream, np.array(list(seconds.values())), seen, files.tolerance_s)
    if not taken.rows:
        raise InputError("E-POSES-UNMATCHED", f"{where}: no image has a pose: {': '.join(taken.left_out[0])}")
    kept = tuple(seen[i] for i in taken.rows)
    note = "" if robot.covariance is None else "; its covariances are of other times and not used"
    places, lines = tuple(f"time of {name}" for name in kept), f"{robot.understood}{note}; {taken.said}"
    told = {"places": places, "understood": lines, "covariance": None, "own": False, "timed": False}
    untimed_images = tuple((name, f"no time in {files.image_times}") for name in names if name not in images)
    at_images = replace(robot, poses=taken.base_from_flange, names=kept, **told)
    return at_images, taken.left_out + untimed_images, (stream, seconds)


def _times_of_images(names: Sequence[str], stated_in: Path | None) -> dict[str, Decimal] | None:
    """Returns times by image, as the file of times states them, or as the names state them."""
    if stated_in is None:
        times = stamps_of(names)
        return None if times is None else dict(zip(names, times, strict=True))
    table = read_table(stated_in, "image times")
    stated = dict(zip(table.text("image"), table.text("time_s"), strict=True))
    if len(stated) < len(table):
        raise InputError("E-TABLE-ROW-REPEATED", f"{table.where}: an image in two rows; one each needed")
    time_of_image = {}
    for name in names:
        file_name = name.rsplit("/", 1)[-1]
        text = next((stated[key] for key in (name, file_name, file_name.rsplit(".", 1)[0]) if key in stated), None)
        if text is not None and (time := time_of(text)) is None:
            said = f"{table.where}: time_s of {name} is {text!r}, a number of seconds needed"
            raise InputError("E-TABLE-NUMBER", said)
        time_of_image |= {} if text is None else {name: time}
    if not time_of_image:
        said = f"no row is of an image: {next(iter(stated))} … there, {names[0]} … here"
        raise InputError("E-POSES-UNMATCHED", f"{table.where}: {said}")
    return time_of_image


PREFIXES = "base_from_flange_", "camera_from_board_"
Source = Path | Table | HandEyeInput


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
    workers: int | None = None,
    progress: Progress | None = None,
) -> HandEyeInput:
    """Returns the poses of a hand-eye calibration, from photographs of a board or from a file of any known form.

    Parameters
    ----------
    source : folder of the photographs; a file of pairs of poses; or a file of the robot's poses, with ``second``
    poses : the robot's poses at the photographs
    camera, board : files of the camera and of the board, or boards, in the photographs
    second : file of the camera's poses
    key : column by which rows of both files belong together, or ``image=Point Name``
    setup : {"eye-in-hand", "eye-to-hand"}, what carries the camera; as a file says, or ``eye-in-hand``, if None
    rotation : convention of angles that files do not name, such as ``kuka-abc``, ``rpy``, ``rotvec`` or ``ZYX``; with
        ``robot=`` or ``camera=`` in front for one side
    length_unit : unit of lengths in files that do not say it, ``mm``, ``m`` …, likewise
    poses_are : names of the poses where files do not say it: ``base_from_flange`` or ``flange_from_base``, and
        ``camera_from_board`` or ``board_from_camera``
    quaternions : {"wxyz", "xyzw"}, as columns of quaternions are named, or x, y, z, w in the order in which they stand
    tolerance_s : time within which the nearest of the robot's poses is taken where none can be interpolated, s
    image_times : table of the times of photographs
    time_offset : whether the offset of the two clocks is to be estimated
    workers : number of processes; one per core if None
    progress : called with (stage, done, total)

    Returns
    -------
    HandEyeInput : ``pairs`` of poses, mm; ``views`` of the board, ``left_out`` and ``understood``. For
        :func:`stcal.workflows.calibrate_handeye` and :func:`stcal.workflows.plan_handeye`.

    Raises InputError: A file is missing or not of the required form, one file too many was given, or no image shows the
    board.
    """
    paths = (None if path is None else Path(path) for path in (poses, camera, board, second, image_times))
    robot, lens, design, other, times = paths
    place = Path(source) if isinstance(source, str) else source
    statements = Said.of_options(rotation, length_unit, poses_are, setup)
    timing = tolerance_s, times, time_offset
    files = Files(place, robot, lens, design, other, key, statements, quaternions, *timing)
    return files.read(workers, progress)


@dataclass(frozen=True, slots=True, eq=False)
class Files:
    """Files of poses, or a folder of images with ``poses``, ``camera`` and ``board``.

    ``second`` : the camera's poses, where the source has the robot's; ``statements`` : the user's statements about what
    files do not state; the others as of :func:`read_handeye`.
    """

    source: Source
    poses: Path | None = None
    camera: Path | None = None
    board: Path | None = None
    second: Path | None = None
    key: str = "image"
    statements: Said = field(default_factory=Said)
    quaternions: Order = "wxyz"
    tolerance_s: float = TOLERANCE_S
    image_times: Path | None = None
    time_offset: bool = False

    def _folder(self) -> Path | None:
        """Returns the folder of the images; None for files of poses."""
        source = self.source if self.second is None else None
        return source if isinstance(source, Path) and source.is_dir() else None

    @one_thread()
    def read(self, workers: int | None = None, progress: Progress | None = None) -> HandEyeInput:
        """Returns the pairs of poses, and the views of the board if there are images."""
        if folder := self._folder():
            return _Photographs(self, folder).pairs(workers, progress or (lambda *_: None))
        return self._pairs(*self._joined())

    def _joined(self) -> tuple[Source, tuple[str, ...]]:
        """Returns the poses of both files as one source, own tables joined as tables, and notes on rows left out."""
        first, second = self.source, self.second
        if second is None or not isinstance(first, Path):
            return first, ()
        timing = self.tolerance_s, self.time_offset
        if told := read_two(first, second, self.statements, self.key, self.quaternions, *timing):
            return told, ()
        for path in (first, second):
            require_own(path, self.quaternions)
        require_unsaid(self.statements, f"{first}, {second}")
        joined = join_tables(str(first), str(second), self.key, PREFIXES, self.quaternions)
        return joined.table, joined.notes

    def _pairs(self, source: Source, notes: tuple[str, ...]) -> HandEyeInput:
        self._require_no_images(source)
        stated = self.statements.setup
        told = source if isinstance(source, HandEyeInput) else read_pairs(source, self.statements, self.quaternions)
        where = source.name if isinstance(source, Path) else told.where
        if stated and told.setup and stated != told.setup:
            raise InputError("E-OPTION-CONTRADICTS", f"{where}: of {told.setup}, --setup {stated}; leave it out")
        return replace(told, where=where, setup=stated or told.setup, notes=notes)

    def _of_images(self) -> dict[str, Path | None]:
        return {"--poses": self.poses, "--camera": self.camera, "--board": self.board}

    def _require_no_images(self, source: Source) -> None:
        """Refuse options of images, and of times where the poses of both sides are not in files of their own."""
        place, held = source, "is a file of poses"
        if not isinstance(source, Path):
            place, held = source.where, "are poses"
        elif not source.exists():
            raise InputError("E-FILE-UNREADABLE", f"{source}: does not exist; poses or a folder of images needed")
        extra = ", ".join(name for name, path in self._of_images().items() if path is not None)
        timed = isinstance(source, HandEyeInput) and source.timed is not None
        times = f"{place}: --time-offset needs the robot's poses as a stream with times; give --a and --b, or images "
        for message, refused in {
            f"{extra}: only with a folder of images; {place} {held}": bool(extra),
            "--image-times: only with a folder of images; poses have their times beside them": self.image_times,
            f"{times}and --poses, each with times": self.time_offset and not timed,
        }.items():
            if refused:
                raise InputError("E-OPTION-NEEDS", message)

    def dry_run(self) -> list[str]:
        """Returns lines on how the inputs are understood, without looking for the board in images."""
        if folder := self._folder():
            own = _Photographs(self, folder)
            stated, flange = self.statements.setup, own.robot.poses[list(own.row_of.values())]
            lines, left_out = own.understood + own.lines, own.left_out
            with_pose = f"{len(own.row_of)} of {len(own.images)}"
            count = f"images: {with_pose} with a pose of the robot; the board was not looked for"
        else:
            source, notes = self._joined()
            inputs = self._pairs(source, notes)
            stated, flange, left_out = inputs.setup, inputs.pairs.base_from_flange, inputs.left_out
            lines, count = list(inputs.understood), f"pairs: {len(inputs.pairs)}"
            if not lines and not isinstance(source, HandEyeInput):
                lines = own_told(source, self.quaternions)
            lines = [*(f"note: {note}" for note in notes), *lines]
        setup = stated or "eye-in-hand"
        origin = "as you say" if self.statements.setup else "as the file says" if stated else "by default"
        lines += [f"setup: {setup}, {origin}", count, *motions_missing(flange, setup)]
        return lines + [f"left out {name}: {reason}" for name, reason in left_out]


class _Photographs:
    """The ``images`` of a folder with the robot's poses, before the board is looked for: ``row_of`` an image, how poses
    were ``understood``, the ``clock`` where they were taken by time, and (image, why) ``left_out``."""

    def __init__(self, files: Files, folder: Path):
        poses, camera, board = files.poses, files.camera, files.board
        if poses is None or camera is None or board is None:
            missing = ", ".join(name for name, path in files._of_images().items() if path is None)
            raise InputError("E-OPTION-MISSING", f"image folder {folder}: {missing} needed with images")
        robot = read_robot(poses, files.statements, files.quaternions)
        self.files, self.folder, self.design, self.model = files, folder, load_boards(board), read_camera(camera)
        self.images, skipped = find_images(folder)
        names = [image.name for image in self.images]
        self.robot, late, self.clock = robot_at_images(robot, names, files)
        names = [name for name in names if name not in dict(late)]
        self.row_of, missing, how = rows_of_images(self.robot, names)
        if not self.row_of:
            said = f"no row is of an image in {folder}: {self.robot.names[0]} … there, {names[0]} … here"
            raise InputError("E-POSES-UNMATCHED", f"robot poses {self.robot.where}: {said}; correct them")
        self.left_out = [*((each.name, each.reason) for each in skipped), *late]
        self.left_out += [(name, f"no row in {poses.name}") for name in names if name not in self.row_of]
        self.left_out += [(name, f"no such image, in a row of {poses.name}") for name in missing]
        self.understood = [f"robot: {self.robot.understood}", *([f"images matched {how}"] if how else [])]
        self.where = f"{folder.name}, {poses.name}"
        size = f"{self.model.width} × {self.model.height} px, focal length {self.model.focal[0]:.6g} px"
        self.lines = [f"camera: {camera.name}: {size}", f"board: {board.name}: {kind_of(self.design)}"]

    def pairs(self, workers: int | None, progress: Progress) -> HandEyeInput:
        """Returns the pairs of all images that show the board and have a pose."""
        with_pose = [image for image in self.images if image.name in self.row_of]
        detections = detect_boards(with_pose, self.model, self.design, (), workers, partial(progress, "board"))
        without_board = [(each.name, each.reason) for each in detections.skipped]
        if not (found := detections.views()):
            said = f"image folder {self.folder}: the board is in none of {len(with_pose)} images"
            raise InputError("E-IMAGES-NO-BOARD", f"{said}: {': '.join(without_board[0])}")
        camera, rows = detections.camera, np.array([self.row_of[name] for name in found])
        views = Views(camera, tuple(View(v.xyz_board, v.xy_px, v.covariance_px2, v.normal) for v in found.values()))
        pairs = pairs_of_views(self.robot.poses[rows], views, tuple(found), str(self.folder))
        if self.robot.covariance is not None:
            pairs = replace(pairs, base_from_flange_covariance=self.robot.covariance[rows])
        understood = () if self.robot.own else self.understood
        timed = self.clock and Timed(self.clock[0], np.array([self.clock[1][name] for name in found]))
        stated = ("pitch_mm", "square_mm", "spacing_mm")  # by which boards state their size
        pitch_mm = next((getattr(self.design, key) for key in stated if hasattr(self.design, key)), None)
        prior = camera_prior(refinable(self.model.calibrated(camera.width, camera.height)))
        lines = (*understood, *(f"board: {part}" for part in detections.unused()))
        more = ((*without_board, *self.left_out), lines, self.files.statements.setup, timed)
        return HandEyeInput(self.where, pairs, views, detections.symmetries, prior, pitch_mm, *more)
