"""Inputs of a hand-eye calibration: pose pairs of one file or two, or images of a board with the robot's poses."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from decimal import Decimal
from functools import partial
from pathlib import Path

from stcal.boards.target_file import load_boards
from stcal.errors import InputError
from stcal.geometry.arrays import require_arguments
from stcal.geometry.rigid import Order
from stcal.handeye import View, Views, pairs_of_views
from stcal.handeye.data.pose_content import HandEyeInput, Said
from stcal.handeye.data.pose_files import read_pairs, read_side, read_two, require_unsaid
from stcal.handeye.data.pose_pairs import Setup
from stcal.handeye.data.pose_partners import paired, partners
from stcal.handeye.data.stream import TOLERANCE_S, Timed, stamps_of, time_of
from stcal.handeye.remarks import motions_missing
from stcal.io.cameras.camera_model import camera_prior, refinable
from stcal.io.cameras.read import read_camera
from stcal.io.images import find_images
from stcal.io.table import read_table
from stcal.parallel import Progress, one_thread
from stcal.workflows.board_views import detect_boards, kind_of


def times_of_images(names: Sequence[str], stated_in: Path | None) -> dict[str, Decimal] | None:
    """Returns times by image, as the file of times states them, or as the names state them."""
    if stated_in is None:
        times = stamps_of(names)
        return None if times is None else dict(zip(names, times, strict=True))
    table = read_table(stated_in, "image times")
    images, stated = table.text("image"), table.text("time_s")
    if (found := partners(images, names)) is None:
        said = f"no row is of an image, or an image has two: {images[0]} … there, {names[0]} … here"
        raise InputError("E-POSES-UNMATCHED", f"{table.where}: {said}")
    time_of_image = {}
    for i, j in found[0]:
        if (time := time_of(stated[i])) is None:
            said = f"{table.where}: time_s of {names[j]} is {stated[i]!r}, a number of seconds needed"
            raise InputError("E-TABLE-NUMBER", said)
        time_of_image[names[j]] = time
    return time_of_image


@require_arguments
def read_handeye(
    source: str | Path,
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
    robot, lens, design, other, times = (
        None if path is None else Path(path) for path in (poses, camera, board, second, image_times)
    )
    statements = Said.of_options(rotation, length_unit, poses_are, setup)
    timing = tolerance_s, times, time_offset
    files = Files(Path(source), robot, lens, design, other, key, statements, quaternions, *timing)
    return files.read(workers, progress)


@dataclass(frozen=True, slots=True, eq=False)
class Files:
    """Files of poses, or a folder of images with ``poses``, ``camera`` and ``board``.

    ``second`` : the camera's poses, where the source has the robot's; ``statements`` : the user's statements about what
    files do not state; the others as of :func:`read_handeye`.
    """

    source: Path
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

    @one_thread()
    def read(self, workers: int | None = None, progress: Progress | None = None) -> HandEyeInput:
        """Returns the pairs of poses, and the views of the board if there are images."""
        if self.second is None and self.source.is_dir():
            return _Photographs(self).pairs(workers, progress or (lambda *_: None))
        inputs = self._pairs()
        return replace(inputs, understood=()) if inputs.own else inputs

    def of_images(self) -> dict[str, Path | None]:
        """Returns the files beside images by their options."""
        return {"--poses": self.poses, "--camera": self.camera, "--board": self.board}

    def _pairs(self) -> HandEyeInput:
        """Returns the pairs of files of poses. Refuses options of images, and of times where the poses of both sides
        are not in files of their own."""
        source, stated = self.source, self.statements.setup
        if not source.exists():
            raise InputError("E-FILE-UNREADABLE", f"{source}: does not exist; poses or a folder of images needed")
        extra = ", ".join(name for name, path in self.of_images().items() if path is not None)
        times = f"{source}: --time-offset needs the robot's poses as a stream with times; give --a and --b, or images "
        for message, refused in {
            f"{extra}: only with a folder of images; {source} is a file of poses": bool(extra),
            "--image-times: only with a folder of images; poses have their times beside them": self.image_times,
            f"{times}and --poses, each with times": self.time_offset and self.second is None,
        }.items():
            if refused:
                raise InputError("E-OPTION-NEEDS", message)
        if self.second is None:
            told = read_pairs(source, self.statements, self.quaternions)
        else:
            timing = self.tolerance_s, self.time_offset
            told = read_two(source, self.second, self.statements, self.key, self.quaternions, *timing)
        if stated and told.setup and stated != told.setup:
            raise InputError("E-OPTION-CONTRADICTS", f"{told.where}: of {told.setup}, --setup {stated}; leave it out")
        return replace(told, setup=stated or told.setup)

    def dry_run(self) -> list[str]:
        """Returns lines on how the inputs are understood, without looking for the board in images."""
        if self.second is None and self.source.is_dir():
            own = _Photographs(self)
            stated, flange, left_out = self.statements.setup, own.robot.poses, own.left_out
            with_pose = f"{len(flange)} of {len(own.images)}"
            lines = [*own.understood, *own.lines]
            count = f"images: {with_pose} with a pose of the robot; the board was not looked for"
        else:
            inputs = self._pairs()
            stated, flange, left_out = inputs.setup, inputs.pairs.base_from_flange, inputs.left_out
            lines, count = list(inputs.understood), f"pairs: {len(inputs.pairs)}"
        setup = stated or "eye-in-hand"
        origin = "as you say" if self.statements.setup else "as the file says" if stated else "by default"
        lines += [f"setup: {setup}, {origin}", count, *motions_missing(flange, setup)]
        return lines + [f"left out {name}: {reason}" for name, reason in left_out]


class _Photographs:
    """The ``images`` of a folder, before the board is looked for: ``names`` of those with a pose of the ``robot``, in
    its order; ``timed`` : where these were taken by time; ``understood`` : how the poses were read and matched;
    ``left_out`` : (image, why)."""

    def __init__(self, files: Files):
        folder, poses, camera, board = files.source, files.poses, files.camera, files.board
        if poses is None or camera is None or board is None:
            missing = ", ".join(name for name, path in files.of_images().items() if path is None)
            raise InputError("E-OPTION-MISSING", f"image folder {folder}: {missing} needed with images")
        robot, _ = read_side(poses, "robot", files.statements, "image", files.quaternions)
        require_unsaid(files.statements, robot)
        self.folder, self.design, self.model = folder, load_boards(board), read_camera(camera)
        self.images, skipped = find_images(folder)
        every = [image.name for image in self.images]
        times = times_of_images(every, files.image_times)
        known = {"by_times": files.image_times is not None, "at_times": files.time_offset}
        found = paired(robot, every, str(folder), times, in_order=True, **known, tolerance_s=files.tolerance_s)
        self.robot, self.timed, self.names = found.robot, found.timed, [every[j] for j in found.rows]
        self.left_out = [*((each.name, each.reason) for each in skipped), *found.left_out]
        self.understood = [f"robot: {robot.understood}", *found.lines]
        self.told = () if robot.own and not found.lines else self.understood
        self.where, self.setup = f"{folder.name}, {poses.name}", files.statements.setup
        size = f"{self.model.width} × {self.model.height} px, focal length {self.model.focal[0]:.6g} px"
        self.lines = [f"camera: {camera.name}: {size}", f"board: {board.name}: {kind_of(self.design)}"]

    def pairs(self, workers: int | None, progress: Progress) -> HandEyeInput:
        """Returns the pairs of all images that show the board and have a pose."""
        with_pose = [image for image in self.images if image.name in self.names]
        detections = detect_boards(with_pose, self.model, self.design, (), workers, partial(progress, "board"))
        without_board = [(each.name, each.reason) for each in detections.skipped]
        if not (found := detections.views()):
            said = f"image folder {self.folder}: the board is in none of {len(with_pose)} images"
            raise InputError("E-IMAGES-NO-BOARD", f"{said}: {', '.join(without_board[0])}")
        camera, rows = detections.camera, [self.names.index(name) for name in found]
        views = Views(camera, tuple(View(v.xyz_board, v.xy_px, v.covariance_px2, v.normal) for v in found.values()))
        robot = self.robot[rows]
        pairs = pairs_of_views(robot.poses, views, tuple(found), str(self.folder))
        pairs = replace(pairs, base_from_flange_covariance=robot.covariance)
        timed = self.timed and Timed(self.timed.stream, self.timed.seconds[rows])
        stated = ("pitch_mm", "square_mm", "spacing_mm")  # by which boards state their size
        pitch_mm = next((getattr(self.design, key) for key in stated if hasattr(self.design, key)), None)
        prior = camera_prior(refinable(self.model.calibrated(camera.width, camera.height)))
        lines = (*self.told, *(f"board: {part}" for part in detections.unused()))
        more = ((*without_board, *self.left_out), lines, self.setup, timed)
        return HandEyeInput(self.where, pairs, views, detections.symmetries, prior, pitch_mm, *more)
